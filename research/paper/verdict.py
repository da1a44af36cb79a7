"""The rules that turn a figure of the paper and ours into a verdict; pure.

A *contrast* is a difference of APs that the paper finds. Like the paper's, ours is significant when its 95 % interval
leaves zero out:

| here | verdict |
|---|---|
| significant, same sign | reproduced |
| significant, other sign | opposite |
| not significant | not reproduced |

A claim of *no difference*, and a claim of a *size*, are claims that a figure has a value: zero, or the paper's. An interval
that holds the value does not show them: a noisy measurement holds anything. They are judged by two one-sided tests (TOST) at
5 % each (Schuirmann, J. Pharmacokinet. Biopharm. 15, 1987), which is to say by the 90 % interval, with a margin that the
claim states (`claims.MARGIN`):

| here | verdict |
|---|---|
| the 90 % interval lies within the margin around the value | reproduced |
| otherwise, and the 95 % interval leaves the value out | not reproduced |
| otherwise | inconclusive |

A claim that *most* of the gain is kept asks for more than a sign: the interval has to lie above one half.

Of contrasts the size is reported separately from the verdict: *same size* when the intervals overlap (where the paper prints
none, when ours holds the paper's value), else *larger* or *smaller* by magnitude. Absolute APs are *not comparable*: the
paper says so of its own split, and this is another benchmark.

A *quantity* (bytes, milliseconds) has no interval. One that follows by counting is exact: reproduced when it rounds
to the paper's print. One that depends on the machine or the flight is reproduced when it is within half an order of
magnitude, or beyond that on the side which only strengthens the claim.

The rules were written before anything was measured, except those of no difference and of a size. These replaced weaker ones
after the table had been seen (a difference that was not significant counted as none; a size was tested against zero). Their
margins follow from the paper's intervals alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

HALF_AN_ORDER = math.sqrt(10.0)
HALF = 50.0
"""Per cent."""


class ClaimVerdict(StrEnum):
    """What became of a claim."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    OPPOSITE = "opposite"
    INCONCLUSIVE = "inconclusive"
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
    margin: float | None = None
    """Of a claim of no difference or of a size: how far from the claimed value a figure may lie and count as equal."""
    digits: int = 1
    """Decimals printed."""


@dataclass(frozen=True, slots=True)
class MeasuredValue:
    """What we measured, in the claim's unit, with its intervals where there are any."""

    value: float
    low: float | None = None
    high: float | None = None
    """The 95 % interval."""
    low_90: float | None = None
    high_90: float | None = None
    """The 90 % interval, by which equivalence is tested."""
    p: float | None = None
    """The two-sided level at which zero leaves the interval."""
    note: str = ""
    """Context for a reader: which policy was the best, on which machine."""

    @property
    def significant(self) -> bool:
        """Whether the 95 % interval leaves zero out; False without one."""
        return self.leaves_out(0.0)

    def leaves_out(self, value: float) -> bool:
        """Whether the 95 % interval leaves a value out; False without one."""
        return self.low is not None and self.high is not None and not self.low <= value <= self.high

    def equals(self, value: float, margin: float) -> bool:
        """Whether the 90 % interval lies within `margin` around a value; False without one."""
        if self.low_90 is None or self.high_90 is None:
            return False
        return value - margin < self.low_90 <= self.high_90 < value + margin


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict, and how the sizes compare."""

    verdict: ClaimVerdict
    size: Size = Size.NOT_COMPARED


def contrast(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Judge a difference that the paper finds, in points, by sign, significance and overlap (see the module)."""
    if ours is None or not _known(ours.value) or ours.low is None or ours.high is None:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    size = _size(paper, ours)
    if not ours.significant:
        return Judgement(ClaimVerdict.NOT_REPRODUCED, size)
    if paper.value is not None and paper.value * ours.value < 0:
        return Judgement(ClaimVerdict.OPPOSITE, size)
    return Judgement(ClaimVerdict.REPRODUCED, size)


def no_difference(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Judge a claim that two ways do not differ: reproduced when ours is equivalent to zero within the paper's margin."""
    return Judgement(_equivalent(0.0, paper.margin, ours))


def same_value(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """Judge a claim of a size: reproduced when ours is equivalent to the paper's value within its margin."""
    if ours is None or paper.value is None:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    verdict = _equivalent(paper.value, paper.margin, ours)
    if verdict == ClaimVerdict.NOT_REPRODUCED:
        return Judgement(verdict, Size.LARGER if ours.value > paper.value else Size.SMALLER)
    return Judgement(verdict)


def most(paper: Paper, ours: MeasuredValue | None) -> Judgement:
    """A claim that most of something is kept: reproduced when our interval lies above a half, opposite when below."""
    if ours is None or not _known(ours.value) or ours.low is None or ours.high is None:
        return Judgement(ClaimVerdict.NOT_MEASURABLE)
    size = _size(paper, ours)
    if ours.low > HALF:
        return Judgement(ClaimVerdict.REPRODUCED, size)
    return Judgement(ClaimVerdict.OPPOSITE if ours.high < HALF else ClaimVerdict.NOT_REPRODUCED, size)


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


def _equivalent(value: float, margin: float | None, ours: MeasuredValue | None) -> ClaimVerdict:
    if margin is None:
        raise ValueError("a claim of a value needs a margin")
    if ours is None or not _known(ours.value) or ours.low is None or ours.low_90 is None:
        return ClaimVerdict.NOT_MEASURABLE
    if ours.equals(value, margin):
        return ClaimVerdict.REPRODUCED
    return ClaimVerdict.NOT_REPRODUCED if ours.leaves_out(value) else ClaimVerdict.INCONCLUSIVE


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
