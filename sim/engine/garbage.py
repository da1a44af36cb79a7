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


@contextmanager
def older_objects_kept() -> Iterator[None]:
    """Spare Python's search for cyclic garbage what was there before the flight: mostly modules, which stay for good."""
    gc.freeze()
    try:
        yield
    finally:
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
