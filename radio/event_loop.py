"""SimPy's clock, on which a callback may go on at once when nothing else is due first."""

from __future__ import annotations

from typing import Any

import simpy


class EventLoop(simpy.Environment):
    """A `simpy.Environment` with `skip_to`; any other `simpy.Environment` gives the same results, a little slower.

    Example:
        >>> loop = EventLoop()
        >>> loop.run(until=3.0)
        >>> loop.now, loop.skip_to(4.0)
        (3.0, False)
    """

    __slots__ = ("_now",)

    def __init__(self, initial_time: float = 0) -> None:
        super().__init__(initial_time)
        self._is_running = False

    def run(self, until: float | simpy.Event | None = None) -> Any:
        """As SimPy's."""
        self._is_running = True
        try:
            return super().run(until)
        finally:
            self._is_running = False

    def skip_to(self, t_s: float) -> bool:
        """Move on to `t_s` if nothing is due until then, and return whether this was done.

        A callback whose next thing to do is at `t_s` can then do it at once, without an event. This works in `run` only: who
        calls `step` instead may want to stop after any event.
        """
        if not self._is_running or (self._queue and self._queue[0][0] <= t_s):
            return False
        self._now = t_s
        return True


# the time is read several times an event, and a slot is read faster than SimPy's property
EventLoop.now = EventLoop.__dict__["_now"]  # type: ignore[method-assign]
