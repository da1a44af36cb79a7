"""Numbers, intervals and tables as every report writes them: in Markdown, on HTML pages and in the terminal. Pure text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

MINUS, NONE, ALL_EQUAL = "−", "–", "(all equal)"


def visible(text: str) -> str:
    """Text with everything escaped that a terminal or a page does not show: control characters, odd spaces, marks of direction.

    Ends of lines stay.

    Example:
        >>> visible("a \\x1b[31mred\\u202e")
        'a \\\\x1b[31mred\\\\u202e'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def number(value: Any, form: str = ".3f", unit: str = "") -> str:
    """A number with its unit; a dash where there is none."""
    return NONE if value is None or value != value else f"{value:{form}}{unit and ' ' + unit}"


def fixed(value: float, decimals: int = 1) -> str:
    """A number with a minus sign of its own width."""
    return f"{value:.{decimals}f}".replace("-", MINUS)


def signed(value: float, decimals: int = 1) -> str:
    """A difference with its sign; zero has none.

    Example:
        >>> signed(-0.26), signed(1.0), signed(-0.01)
        ('−0.3', '+1.0', '0.0')
    """
    text = f"{value:+.{decimals}f}"
    return f"{0:.{decimals}f}" if float(text) == 0 else text.replace("-", MINUS)


def interval(value: float, low: float | None, high: float | None, text: Callable[[float], str], unit: str = "") -> str:
    """A value with its interval, or alone where the interval is missing or NaN; "all equal" where nothing spreads.

    Example:
        >>> interval(2.0, 1.5, 2.5, signed), interval(0.0, 0.0, 0.0, signed)
        ('+2.0 [+1.5, +2.5]', '0.0 (all equal)')
    """
    if low is None or high is None or math.isnan(low):
        return text(value) + unit
    if low == high:
        return f"{text(value)}{unit} {ALL_EQUAL}"
    return f"{text(value)}{unit} [{text(low)}, {text(high)}]"


def points(estimate: tuple[float, float, float], form: str = ".1f") -> str:
    """An AP or a difference of two, with its interval, in points."""
    value, low, high = (100 * part for part in estimate)
    return interval(value, low, high, lambda v: f"{v:{form}}")


def size(count: float) -> str:
    """Bytes in the unit that reads best (decimal prefixes)."""
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= limit:
            return f"{count / limit:.1f} {unit}"
    return f"{count:.0f} B"


def percent(value: float | None) -> str:
    """A share as percent; a dash where there is none."""
    return NONE if value is None else f"{100 * value:.1f} %" if value >= 1e-3 else f"{100 * value:.2g} %"


def prefixed(*values: float) -> list[str]:
    """Four significant digits, with one unit prefix for all of the values beyond a thousand.

    Example:
        >>> prefixed(2317.0, 962.4)
        ['2.317 k', '0.9624 k']
    """
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    limit, prefix = next(((x, p) for x, p in ((1e9, " G"), (1e6, " M"), (1e3, " k")) if largest >= x), (1.0, ""))
    return [NONE if math.isnan(v) else f"{v / limit:.4g}{prefix}" for v in values]


def listed(items: Sequence[object]) -> str:
    """ "a, b and c"."""
    *most, last = map(str, items)
    return f"{', '.join(most)} and {last}" if most else last


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table, a line each.

    Example:
        >>> table(["", "AP"], [["alone", "31.0"]])
        ['| | AP |', '|---|---|', '| alone | 31.0 |']
    """
    top = "|" + "".join(f" {cell} |" if cell else " |" for cell in head)
    return [top, f"|{'---|' * len(head)}", *(f"| {' | '.join(row)} |" for row in rows)]


def replace_section(text: str, section: str, begin: str, end: str) -> str:
    """A text with what stands between its markers replaced, the markers too.

    Raises:
        ValueError: the markers are missing, doubled or in the wrong order.

    Example:
        >>> replace_section("a <b> old </b> c", "<b> new </b>", "<b>", "</b>")
        'a <b> new </b> c'
    """
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"must hold {begin} and {end} once each, in this order")
    before, _, rest = text.partition(begin)
    return before + section + rest.partition(end)[2]


def picture(file: str, caption: str) -> list[str]:
    """A figure with its caption in Markdown, a line each, an empty one after it."""
    return [f"![{caption}]({file})", "", f"*{caption}.*", ""]
