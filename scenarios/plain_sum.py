"""A sum of floats that is the same in every Python.

From Python 3.12 on, the built-in `sum` corrects the rounding of floats; earlier it did not. Records are equal under all
Pythons only if sums that enter them do not go through it. Sums of integers may.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from functools import reduce


def plain_sum(values: Iterable[float]) -> float:
    """Sum of the values, added one after another from the left; 0 without any.

    Example:
        >>> plain_sum([1e16, 1.0, -1e16])
        0.0
    """
    return reduce(operator.add, values, 0)
