"""What Python does with objects that refer to one another, before, during and after a flight.

A flight's parts do so, and hold arrays of up to tens of megabytes. Python searches for such cycles by itself, but looks
at objects that are as old as these only when very many new ones have been made.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

MOST_OF_TIME = 0.05
"""Share of the time that the search for the parts of flights that have ended may take."""
NEW_OBJECTS = 10_000
"""In flight Python searches after so many new objects. Searching more often finds nothing: a frame leaves no cycles."""


@contextmanager
def cycles_searched_rarely() -> Iterator[None]:
    """Let Python search for cyclic garbage less often than it does by itself, and spare what was there before the flight:
    mostly modules, which stay for good."""
    _FLIGHTS.begin()
    try:
        yield
    finally:
        _FLIGHTS.end()


class _Flights:
    """Those under way in this process: environments fly side by side. The first to begin sets how often
    Python searches, the last to end puts that back."""

    def __init__(self) -> None:
        self._lock, self._count, self._before = threading.Lock(), 0, gc.get_threshold()

    def begin(self) -> None:
        with self._lock:
            self._count += 1
            if self._count == 1:
                self._before = new, *rest = gc.get_threshold()
                gc.set_threshold(max(NEW_OBJECTS, new) if new else 0, *rest)  # 0: somebody turned the search off
            gc.freeze()

    def end(self) -> None:
        with self._lock:
            self._count -= 1
            if not self._count:
                gc.set_threshold(*self._before)
            gc.unfreeze()  # also where others fly on: a flight that was left in the middle never ends


_FLIGHTS = _Flights()


class Leftovers:
    """The parts of flights that have ended. Without this, a campaign by torch grows with each flight."""

    def __init__(self) -> None:
        self._took_s, self._free_s = 0.0, 0.0

    def free(self) -> None:
        """Free them, unless that would take too large a share of the time."""
        begin_s = perf_counter()
        if (begin_s - self._free_s) * MOST_OF_TIME >= self._took_s:
            gc.collect()
            self._free_s = perf_counter()
            self._took_s = self._free_s - begin_s


LEFTOVERS = Leftovers()
"""Of this process."""
