"""Seeds and counts as callers from Python pass them."""

from __future__ import annotations

import operator
from typing import Any

from sortie.scenarios.reading.nodes import ScenarioError


def whole(name: str, value: Any, bits: int = 63) -> int | None:
    """A seed or a count as Python's own whole number, also from numpy's; None stays.

    Raises:
        ScenarioError: it is no whole number, or does not fit into `bits`.
    """
    if value is None:
        return None
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:  # arrays of several numbers or of fractions, too, which have `__index__`
        number = -1
    if not 0 <= number < 2**bits:
        raise ScenarioError(f"{name}: {value!r}, must be a whole number from 0 to 2^{bits} - 1")
    return number
