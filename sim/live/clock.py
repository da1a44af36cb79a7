"""A SimPy environment on wall-clock time, so that the simulator's agents run on it unchanged."""

from __future__ import annotations

import time

import simpy
from simpy.core import SimTime
from simpy.events import NORMAL, Event, EventPriority


class WallClock(simpy.Environment):
    """Time is `begin_s` when the host's monotonic clock shows `begin_monotonic_s`, and runs with that clock.

    A late event sees the real time, and what it schedules counts from there. Events for a past time run at once.
    """

    def __init__(self, begin_s: float, begin_monotonic_s: float) -> None:
        super().__init__(begin_s)
        self._offset_s = begin_s - begin_monotonic_s

    @property
    def now(self) -> SimTime:
        """Seconds; it also runs while events are handled."""
        return time.monotonic() + self._offset_s

    def schedule(self, event: Event, priority: EventPriority = NORMAL, delay: SimTime = 0) -> None:
        """Put an event `delay` seconds from now."""
        super().schedule(event, priority, self.now - self._now + delay)

    def catch_up(self) -> None:
        """Handle all events that are due. Those that become due meanwhile are for the next call, so that none lasts for ever."""
        due_s = self.now
        while self.peek() <= due_s:
            self.step()
