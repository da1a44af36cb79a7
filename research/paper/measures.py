"""The measures that claims refer to, and how they follow from bootstrapped APs. Pure.

All of a table's figures come from one bootstrap: the same resampled frames for every condition, so that any
difference is paired and any arithmetic of APs has its interval by doing it to every draw.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from research.paper.verdict import MeasuredValue
from research.paper.ways import FULL_SHARING, PAPER_WAYS, SINGLE, CellsBy, Sharing, Ways
from sortie.perception.evaluation.sharing import Unsent
from sortie.scenarios.intervals import p_value, percentile_interval

Region = Literal["full", "mission"]
Floats = NDArray[np.float64]
POINTS = 100.0
"""AP points to one."""


class Scores(Protocol):
    """Bootstrapped APs (0 … 1) by condition and region, every draw made of the same frames for all of them."""

    def ap(self, condition: Sharing, region: Region) -> float:
        """On all frames."""
        ...

    def draws(self, condition: Sharing, region: Region) -> Floats:
        """[b], on resampled frames."""
        ...

    def halves(self, condition: Sharing, region: Region, *, resampled: bool) -> Floats:
        """[s, 2], on the two halves of s random splits of the frames, resampled within each half or not."""
        ...

    def fleet_frame_bytes(self, condition: Sharing) -> Sequence[float]:
        """Payload bytes of each frame, summed over all egos."""
        ...


@dataclass(frozen=True, slots=True)
class ApOf:
    """The AP of one way of sharing."""

    of: Sharing
    region: Region = "full"

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        yield self.of

    def measure(self, scores: Scores) -> MeasuredValue:
        """AP, 0 … 1."""
        return _interval(scores.ap(self.of, self.region), scores.draws(self.of, self.region), test=False)


@dataclass(frozen=True, slots=True)
class Contrast:
    """AP of `of` minus AP of `over`, in points. Of several ways the best in this region, chosen once on all frames."""

    of: tuple[Sharing, ...]
    over: tuple[Sharing, ...]
    region: Region = "full"

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        yield from (*self.of, *self.over)

    def measure(self, scores: Scores) -> MeasuredValue:
        """The difference."""
        a, b = best(self.of, self.region, scores), best(self.over, self.region, scores)
        names = " − ".join(c.peers for c in (a, b)) if len(self.of) + len(self.over) > 2 else ""
        value = scores.ap(a, self.region) - scores.ap(b, self.region)
        draws = scores.draws(a, self.region) - scores.draws(b, self.region)
        return _interval(POINTS * value, POINTS * draws, names)


@dataclass(frozen=True, slots=True)
class Widest:
    """Of several contrasts the one of the largest magnitude."""

    among: tuple[Contrast, ...]

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        for contrast in self.among:
            yield from contrast.conditions()

    def measure(self, scores: Scores) -> MeasuredValue:
        """That contrast's difference."""
        measured = [(abs(m.value), -i, m) for i, m in enumerate(c.measure(scores) for c in self.among)]
        _, minus_i, widest = max(measured)
        return replace(widest, note=f"at a budget of {self.among[-minus_i].of[0].received_budget:g}")


@dataclass(frozen=True, slots=True)
class Kept:
    """The part of the cooperative gain that a way of sharing keeps, in per cent."""

    of: Sharing

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        yield from (self.of, SINGLE, FULL_SHARING)

    def measure(self, scores: Scores) -> MeasuredValue:
        """(AP − AP alone) / (AP at full sharing − AP alone)."""

        def part(of: Floats | float, alone: Floats | float, full: Floats | float) -> Floats:
            gain = np.asarray(np.asarray(full) - alone)
            return np.asarray((np.asarray(of) - alone) / np.where(gain == 0, np.nan, gain))

        three = (self.of, SINGLE, FULL_SHARING)
        value = float(part(*(scores.ap(c, "full") for c in three)))
        return _interval(POINTS * value, POINTS * part(*(scores.draws(c, "full") for c in three)))


Policies = tuple[tuple[Sharing, ...], ...]
"""Fixed policies in rows, the same budgets in columns."""


@dataclass(frozen=True, slots=True)
class OfPolicies:
    """A measure of a whole table of policies."""

    policies: Policies

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        for row in self.policies:
            yield from row


@dataclass(frozen=True, slots=True)
class WrongChoice:
    """What the policy that wins at one budget loses to the winner at another."""

    policies: Policies
    chosen_at: int
    """Column in which the policy wins."""
    judged_at: int
    """Column in which it is used."""

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        yield from (row[i] for row in self.policies for i in (self.chosen_at, self.judged_at))

    def measure(self, scores: Scores) -> MeasuredValue:
        """Its AP minus the winner's there, in points; 0 where one policy wins at both."""
        ap = table(self.policies, scores)
        chosen, winner = (int(np.argmax(ap[:, i])) for i in (self.chosen_at, self.judged_at))
        a, b = (self.policies[row][self.judged_at] for row in (chosen, winner))
        draws = scores.draws(a, "full") - scores.draws(b, "full")
        value = ap[chosen, self.judged_at] - ap[winner, self.judged_at]
        return _interval(POINTS * value, POINTS * draws, f"{a.peers} for {b.peers}" if a != b else f"{a.peers} wins")


@dataclass(frozen=True, slots=True)
class Oracle(OfPolicies):
    """The best policy of each budget against the best single one, mean AP over the budgets, in points.

    The winners are chosen once on all frames and then held fixed, in every draw too, so that the interval can hold
    zero. `held_out`: chosen on one half of the frames, evaluated on the other and the other way round, averaged over
    many random splits; the interval resamples frames within the halves.
    """

    held_out: bool = False

    def measure(self, scores: Scores) -> MeasuredValue:
        """The gain."""
        if self.held_out:
            value = float(np.mean(held_out(self._halves(scores, resampled=False))))
            return _interval(POINTS * value, POINTS * held_out(self._halves(scores, resampled=True)))
        ap, draws = table(self.policies, scores), _table_draws(self.policies, scores)
        each, fixed = np.argmax(ap, axis=0), int(np.argmax(ap.mean(axis=1)))
        columns = np.arange(ap.shape[1])
        gain = draws[each, columns].mean(axis=0) - draws[fixed].mean(axis=0)
        note = ", ".join(self.policies[r][c].peers for c, r in enumerate(each.tolist()))
        note += f" over {self.policies[fixed][0].peers}"
        return _interval(POINTS * float(ap[each, columns].mean() - ap[fixed].mean()), POINTS * gain, note)

    def _halves(self, scores: Scores, *, resampled: bool) -> Floats:
        """[policies, budgets, splits, 2]."""
        return np.array([[scores.halves(c, "full", resampled=resampled) for c in row] for row in self.policies])


@dataclass(frozen=True, slots=True)
class MeanLevel(OfPolicies):
    """Mean AP over the budgets, of the best policy of each or of the best single one."""

    fixed: bool

    def measure(self, scores: Scores) -> MeasuredValue:
        """AP, 0 … 1."""
        ap, draws = table(self.policies, scores), _table_draws(self.policies, scores)
        columns = np.arange(ap.shape[1])
        rows = np.full(ap.shape[1], np.argmax(ap.mean(axis=1))) if self.fixed else np.argmax(ap, axis=0)
        note = self.policies[rows[0]][0].peers if self.fixed else ""
        return _interval(float(ap[rows, columns].mean()), draws[rows, columns].mean(axis=0), note, test=False)


@dataclass(frozen=True, slots=True)
class Crossover:
    """The budget below which concentrating wins and above which spreading does; NaN where there is none."""

    contrasts: tuple[Contrast, ...]
    """Concentrating over spreading, by ascending budget."""

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        for contrast in self.contrasts:
            yield from contrast.conditions()

    def measure(self, scores: Scores) -> MeasuredValue:
        """Where the line between the last significant lead of concentrating and the first of spreading meets zero, in per cent."""
        seen = [(c.of[0].received_budget, c.measure(scores)) for c in self.contrasts]
        signs = [(1 if m.value > 0 else -1) if m.significant else 0 for _, m in seen]
        if 1 not in signs or -1 not in signs:
            ahead = {(True, False): "concentrating never trails", (False, True): "concentrating never leads"}
            return MeasuredValue(float("nan"), note=ahead.get((1 in signs, -1 in signs), "no significant lead"))
        last = max(i for i, s in enumerate(signs) if s == 1)
        first = min(i for i, s in enumerate(signs) if s == -1)
        if last > first:
            return MeasuredValue(float("nan"), note="the lead changes more than once")
        (low, a), (high, b) = seen[last], seen[first]
        at = low + (high - low) * a.value / (a.value - b.value)
        return MeasuredValue(POINTS * at, note=f"between {low:g} and {high:g}")


@dataclass(frozen=True, slots=True)
class Peak:
    """The budget at which a curve is highest, in per cent of full sharing."""

    curve: tuple[Sharing, ...]
    region: Region

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        yield from self.curve

    def measure(self, scores: Scores) -> MeasuredValue:
        """That budget; NaN where there was nothing to find under any."""
        top = best(self.curve, self.region, scores)
        if not np.isfinite(scores.ap(top, self.region)):
            return MeasuredValue(float("nan"), note="nothing was there to be found")
        return MeasuredValue(POINTS * top.received_budget)


@dataclass(frozen=True, slots=True)
class FleetFrameBytes:
    """Feature bytes of one fleet-frame, all egos together, in MB."""

    of: Sharing

    def conditions(self) -> Iterator[Sharing]:
        """What has to be evaluated."""
        yield self.of

    def measure(self, scores: Scores) -> MeasuredValue:
        """Mean over the frames."""
        return MeasuredValue(float(np.mean(scores.fleet_frame_bytes(self.of))) / 1e6)


@dataclass(frozen=True, slots=True)
class UnequalBytes(OfPolicies):
    """By how much the bytes of matched policies differ at the same budget, at most, in per cent."""

    def measure(self, scores: Scores) -> MeasuredValue:
        """The largest relative spread in any frame of any budget."""
        worst = 0.0
        for column in zip(*self.policies, strict=True):
            sent = np.array([scores.fleet_frame_bytes(c) for c in column])
            worst = max(worst, float(np.max(np.ptp(sent, axis=0) / np.maximum(sent.max(axis=0), 1.0))))
        return MeasuredValue(POINTS * worst)


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """A quantity measured outside this room, under this name."""

    name: str

    def conditions(self) -> Iterator[Sharing]:
        """Nothing."""
        yield from ()


Accuracy = ApOf | Contrast | Widest | Kept | WrongChoice | Oracle | MeanLevel | Crossover | Peak
Counted = FleetFrameBytes | UnequalBytes
Measure = Accuracy | Counted | Elsewhere


def under(condition: Sharing, unsent: Unsent, cells_by: CellsBy = "confidence", ways: Ways = PAPER_WAYS) -> Sharing:
    """A claim's condition under another instrument; unchanged where every cell is sent, or none."""
    if condition.peers == "none" or (condition.rule == "all" and condition.received_budget >= 1.0):
        return condition
    roi = condition.roi or ways.serve == "region_first"
    return replace(condition, unsent=unsent, cells_by=cells_by, absent=ways.absent, roi=roi)


def best(conditions: Sequence[Sharing], region: Region, scores: Scores) -> Sharing:
    """The one with the highest AP; the first of equal ones."""
    return max(conditions, key=lambda c: scores.ap(c, region))


def table(policies: Policies, scores: Scores) -> Floats:
    """APs [policies, budgets] of the full scene."""
    return np.array([[scores.ap(c, "full") for c in row] for row in policies])


def held_out(halves: Floats) -> Floats:
    """The oracle's gain [splits] on halves [policies, budgets, splits, 2], each half judged by the other's choice."""
    gains = []
    for chosen_on, judged_on in ((0, 1), (1, 0)):
        a, b = halves[..., chosen_on], halves[..., judged_on]
        each = np.argmax(a, axis=0)[None]
        fixed = np.argmax(a.mean(axis=1), axis=0)[None]
        gains.append(
            np.take_along_axis(b, each, axis=0)[0].mean(axis=0) - np.take_along_axis(b.mean(axis=1), fixed, axis=0)[0]
        )
    return np.asarray(np.mean(gains, axis=0))


def _table_draws(policies: Policies, scores: Scores) -> Floats:
    return np.array([[scores.draws(c, "full") for c in row] for row in policies])


def _interval(value: float, draws: Floats, note: str = "", *, test: bool = True) -> MeasuredValue:
    """The value with its 95 % and 90 % percentile intervals, and the two-sided level at which zero leaves the interval."""
    if not np.isfinite(draws).any():
        return MeasuredValue(value, note=note)
    p = p_value(draws) if test else None
    return MeasuredValue(value, *percentile_interval(draws), *percentile_interval(draws, 0.90), p, note)
