"""What Python does with objects that refer to one another, before, during and after a flight.

A flight's parts do so, and hold arrays of up to tens of megabytes. Python searches for such cycles by itself, but looks
at objects that are as old as these only when very many new ones have been made.
"""

from __future__ import annotations

import gc
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
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(max(NEW_OBJECTS, before[0]) if before[0] else 0, *before[1:])  # 0: somebody turned the search off
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


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
