"""Settings of a process that belongs to Sortie alone: the command line, and the workers of a campaign."""

import gc

ALLOCATIONS = 200_000
"""Net allocations between two looks for reference cycles; Python's own 700 cost a flight of twenty drones a tenth."""


def own_process() -> None:
    """Have the garbage collector run rarely. Libraries must not call this: it changes the whole process."""
    gc.set_threshold(ALLOCATIONS)
