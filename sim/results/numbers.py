"""Numbers as people read them: with a unit, as points of AP, as bytes, as percent."""

from __future__ import annotations

from typing import Any


def number(value: Any, form: str = ".3f", unit: str = "") -> str:
    """A figure with its unit; a dash where there is none."""
    return "–" if value is None or value != value else f"{value:{form}}{unit and ' ' + unit}"


def points(found: tuple[float, float, float], form: str = ".1f") -> str:
    """An AP or a difference of two with its interval, in points; alone where the interval is NaN."""
    value, low, high = (100 * f for f in found)
    return f"{value:{form}}" + ("" if low != low else f" [{low:{form}}, {high:{form}}]")


def size(count: float) -> str:
    """Bytes in the unit that reads best (decimal prefixes)."""
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= limit:
            return f"{count / limit:.1f} {unit}"
    return f"{count:.0f} B"


def percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %" if value >= 1e-3 else f"{100 * value:.2g} %"
