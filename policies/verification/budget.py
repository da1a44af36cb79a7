"""The processor time that searches and tests of a policy may take."""

from __future__ import annotations

import copy
from time import process_time


class Budget:
    """The processor time that several searches or tests of a policy may take together, from now on."""

    def __init__(self, budget_s: float) -> None:
        self.budget_s = budget_s
        self._begin_s = process_time()

    @property
    def is_spent(self) -> bool:
        """Whether the time is over."""
        return self.used_s >= self.budget_s

    @property
    def used_s(self) -> float:
        """The time used so far."""
        return process_time() - self._begin_s

    def shares(self, count: int) -> list[Budget]:
        """An even share for each of several that follow each other. What one leaves, the next may use."""
        ends = [copy.copy(self) for _ in range(count)]
        for k, end in enumerate(ends, 1):
            end.budget_s *= k / count
        return ends
