"""The rules that turn a figure of the paper and ours into a verdict; pure.

They were written before anything was measured, except the half point. That was added when a second seed had shown that
differences of 0.1 to 0.2 points come and go.

A *contrast* (a difference of APs) is judged as the paper judges its own: it is significant when its 95 % interval
does not contain zero.

| paper | here | verdict |
|---|---|---|
| significant | significant, same sign | reproduced |
| significant | significant, other sign | opposite |
| significant | not significant | not reproduced |
| not significant | not significant | reproduced |
| not significant | significant, but wholly within half a point of zero | reproduced |
| not significant | significant | not reproduced |
| anything | not measured | not measurable here |

A claim that *most* of the gain is kept asks for more than a sign: the interval has to lie above one half.

Its size is reported separately from the verdict: *same size* when the intervals overlap (where the paper prints none, when
ours holds the paper's value), else *larger* or *smaller* by magnitude. Absolute APs are *not comparable*: the paper
says so of its own split, and this is another benchmark.

A *quantity* (bytes, milliseconds) has no interval. One that follows by counting is exact: reproduced when it rounds
to the paper's print. One that depends on the machine or the flight is reproduced when it is within half an order of
magnitude, or beyond that on the side which only strengthens the claim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

HALF_AN_ORDER = math.sqrt(10.0)
HALF = 50.0
"""Per cent."""
NEGLIGIBLE = 0.5
"""Points of AP. Where the paper finds no difference its intervals reach a point and more to either side, so it could
not tell half a point from zero; and with enough frames any difference is significant."""


class ClaimVerdict(StrEnum):
    """What became of a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    OPPOSITE = "opposite"
    NOT_COMPARABLE = "not comparable"
    NOT_MEASURABLE = "not measurable here"


class Size(StrEnum):
    """How our figure compares with the paper's, apart from the verdict."""

    SAME = "same size"
    LARGER = "larger"
    SMALLER = "smaller"
    NOT_COMPARED = ""


@dataclass(frozen=True, slots=True)
class Paper:
    """What the paper prints."""

    value: float | None = None
    """None where it gives no number."""
    low: float | None = None
    high: float | None = None
    significant: bool = True
    """What it says, by interval or in words."""
    digits: int = 1
    """Decimals printed."""


@dataclass(frozen=True, slots=True)
class MeasuredValue:
    """What we measured, in the claim's unit; `low`, `high` the 95 % interval and `p` its two-sided level, where there are any."""

    value: float
    low: float | None = None
    high: float | None = None
    p: float | None = None
    note: str = ""
    """Context for a reader: which policy was the best, on which machine."""

    @property
    def significant(self) -> bool:
        """Whether the interval leaves zero out; False without one."""
        return self.low is not None and self.high is not None and not self.low <= 0.0 <= self.high

    @property
    def negligible(self) -> bool:
        """Whether the whole interval lies within half a point of zero."""
        return self.low is not None and self.high is not None and -NEGLIGIBLE < self.low <= self.high < NEGLIGIBLE


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, and how the sizes compare."""

    verdict: ClaimVerdict
    size: Size = Size.NOT_COMPARED


def contrast(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Judge a difference in points by sign, significance and overlap (see the module)."""
    if ours is None or not _known(ours.value) or ours.low is None or ours.high is None:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    size = _size(paper, ours)
    if not paper.significant and ours.negligible:
        return Judgement(ClaimVerdict.REPRODUCED, size)
    if paper.significant != ours.significant:
        return Judgement(ClaimVerdict.NOT_REPRODUCED, size)
    if paper.significant and paper.value is not None and paper.value * ours.value < 0:
        return Judgement(ClaimVerdict.OPPOSITE, size)
    return Judgement(ClaimVerdict.REPRODUCED, size)


def most(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """A claim that most of something is kept: reproduced when our interval lies above a half, opposite when below."""
    judgement = contrast(paper, ours)
    if judgement.verdict == ClaimVerdict.NOT_MEASURABLE or ours is None or ours.low is None or ours.high is None:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    if ours.low > HALF:
        return Judgement(ClaimVerdict.REPRODUCED, judgement.size)
    return Judgement(ClaimVerdict.OPPOSITE if ours.high < HALF else ClaimVerdict.NOT_REPRODUCED, judgement.size)


def level(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Absolute APs are shown side by side and not judged."""
    return Judgement(
        ClaimVerdict.NOT_MEASURABLE if ours is None or not _known(ours.value) else ClaimVerdict.NOT_COMPARABLE
    )


def exact(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Reproduced when ours rounds to what the paper prints."""
    if ours is None or paper.value is None or not _known(ours.value):
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    if abs(ours.value - paper.value) <= 0.5 * 10.0**-paper.digits * (1 + 1e-9):
        return Judgement(ClaimVerdict.REPRODUCED, Size.SAME)
    return Judgement(ClaimVerdict.NOT_REPRODUCED, Size.LARGER if ours.value > paper.value else Size.SMALLER)


def at_most(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """A claim that something is small: reproduced up to half an order of magnitude above the paper's figure."""
    return _order(paper, ours, good=Size.SMALLER)


def at_least(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """A claim that something is large: reproduced down to half an order of magnitude below the paper's figure."""
    return _order(paper, ours, good=Size.LARGER)


def same_order(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Reproduced within half an order of magnitude either way."""
    return _order(paper, ours, good=Size.SAME)


def same_place(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """A place on the axis of budgets (a crossover, a peak): reproduced inside the paper's bracket, ends included."""
    if ours is None or paper.low is None or paper.high is None:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    if not _known(ours.value):  # measured, and there is no such place
        return Judgement(ClaimVerdict.NOT_REPRODUCED)
    if paper.low <= ours.value <= paper.high:
        return Judgement(ClaimVerdict.REPRODUCED, Size.SAME)
    return Judgement(ClaimVerdict.NOT_REPRODUCED, Size.LARGER if ours.value > paper.high else Size.SMALLER)


def _size(paper: Paper, ours: MeasuredValue) -> Size:
    if paper.value is None or ours.low is None or ours.high is None:
        return Size.NOT_COMPARED
    low = paper.value if paper.low is None else paper.low
    high = paper.value if paper.high is None else paper.high
    if ours.low <= high and low <= ours.high:
        return Size.SAME
    return Size.LARGER if abs(ours.value) > abs(paper.value) else Size.SMALLER


def _order(paper: Paper, ours: MeasuredValue | None, good: Size) -> Judgement:
    if ours is None or paper.value is None or not _known(ours.value) or ours.value <= 0:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    ratio = ours.value / paper.value
    size = Size.LARGER if ratio > HALF_AN_ORDER else Size.SMALLER if ratio < 1 / HALF_AN_ORDER else Size.SAME
    return Judgement(ClaimVerdict.REPRODUCED if size in (Size.SAME, good) else ClaimVerdict.NOT_REPRODUCED, size)


def _known(value: float) -> bool:
    return math.isfinite(value)
