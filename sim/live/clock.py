"""SimPy's clock, but the wall's: the agents of the simulator live on it as they are."""

from __future__ import annotations

import time

import simpy
from simpy.core import SimTime
from simpy.events import NORMAL, Event, EventPriority


class WallClock(simpy.Environment):
    """Time is `begin_s` when the host's monotonic clock shows `begin_monotonic_s`, and goes on with it.

    A late event finds the clock at the time it really is, and what it schedules counts from there: nothing is made up
    for but what is planned for a moment that has passed.
    """

    def __init__(self, begin_s: float, begin_monotonic_s: float) -> None:
        super().__init__(begin_s)
        self._offset_s = begin_s - begin_monotonic_s

    @property
    def now(self) -> SimTime:
        """Seconds; runs on while events are handled."""
        return time.monotonic() + self._offset_s

    def schedule(self, event: Event, priority: EventPriority = NORMAL, delay: SimTime = 0) -> None:
        """Put an event `delay` seconds from now."""
        super().schedule(event, priority, self.now - self._now + delay)

    def catch_up(self) -> None:
        """Handle everything that is due."""
        while self.peek() <= self.now:
            self.step()
