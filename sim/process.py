"""Settings of a process that belongs to Sortie alone: the command line, and the workers of a campaign."""

import gc

from sortie.scenarios.plugins.user_calls import limit_calls

ALLOCATIONS = 200_000
"""Net allocations between two looks for reference cycles; Python's own 700 cost a flight of twenty drones a tenth."""


def own_process() -> None:
    """Have the garbage collector run rarely, and let calls of a user's code have their limits.

    Libraries must not call this: it changes the whole process.
    """
    gc.set_threshold(ALLOCATIONS)
    limit_calls()
