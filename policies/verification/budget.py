"""How much searches and tests of a policy may do, counted in views and cells: the same on every machine."""

from __future__ import annotations


class Budget:
    """So many views or cells that several searches or tests of a policy may take together.

    Example:
        >>> budget = Budget(2)
        >>> budget.spend()
        >>> budget.is_spent
        False
    """

    def __init__(self, units: int) -> None:
        self.units = units
        self.used = 0

    @property
    def is_spent(self) -> bool:
        """Whether nothing is left."""
        return self.used >= self.units

    def spend(self, units: int = 1) -> None:
        """Count what was done."""
        self.used += units
