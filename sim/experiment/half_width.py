"""Policies compared by the torch detector to a given half-width, with the surrogate's sorties as control variates.

A *paired* seed is flown by both detectors under every policy, a *further* seed by the surrogate alone. Seeds are flown in
batches. After each batch the gains are estimated (`sortie.scenarios.control_variates`); the comparison stops when all
intervals of one metric are narrow enough, or else plans the next batch. `next_batch` is a function of the rows alone, so a
comparison whose rows are kept goes through the same batches again, and on from where it was killed.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sortie.scenarios.control_variates import Controlled, controlled_mean, plan_units, widened
from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import build
from sortie.sim.experiment.compare import (
    AREAS,
    BY_BOTH,
    MOST_SEEDS,
    Compared,
    Contender,
    Gain,
    ensure_known,
    gains_over,
    in_town_of,
)
from sortie.sim.experiment.detectors import DRAWS as SURROGATE_DRAWS
from sortie.sim.experiment.detectors import SHARED
from sortie.sim.experiment.flight import MATCHED, OUTCOME, PROCESSOR_S, Flight, task_of
from sortie.sim.experiment.flight_file import fly_all
from sortie.sim.folders import RunError
from sortie.sim.identity import name_of
from sortie.sim.results.accuracy import Both
from sortie.sim.results.outcome import OutcomeDict
from sortie.sim.user_errors import user_errors

METRICS = tuple(f"ap50.{area}" for area in AREAS)
PILOT = 12
"""Paired seeds that are flown before anything is planned. It, `BATCH` and `GROWTH` were chosen by simulation, together with
`control_variates.STOPPING`; `make figures FIGURE=half_width` measures how often intervals contain the truth with them."""
MOST = 200
"""Paired seeds at most."""
DRAWS = 8
"""Draws of the surrogate's boxes on each of its flights."""
BATCH = 4
"""Numbers of paired seeds are multiples of it, so that few looks are taken."""
GROWTH = 2
"""A batch at most doubles the paired seeds: the first plans stand on few of them."""
WORTH = 0.9
"""The surrogate is used where it is predicted to save a tenth or more."""
FURTHER = 1_000_000
"""Further seeds begin so far above the first paired one."""

Gains = Mapping[str, Mapping[str, float | None]]
"""By policy and metric, over the first policy; None where it is not defined."""
Report = Callable[[str, int, float], None]
"""Called with a stage, the seeds flown in it and all its seeds."""


class Row(NamedTuple):
    """One seed by one detector, under all policies."""

    by: str
    """`torch` (or the scenario's own detector) or `surrogate`."""
    seed: int
    gains: Gains
    processor_s: float
    outcomes: Mapping[str, OutcomeDict] = {}
    """By policy; of the surrogate none."""


class Batch(NamedTuple):
    """What is to be flown in all until the next look."""

    paired: int
    further: int
    control: bool
    """Whether the surrogate is used; decided after the pilot."""
    cost_ratio: float = math.nan
    """Predicted cost relative to torch alone; NaN of the pilot."""


@dataclass(frozen=True)
class Settings:
    """What is asked."""

    half_width: float
    """In AP: 0.01 is one point."""
    metric: str = METRICS[0]
    pilot: int = PILOT
    most: int = MOST
    """Paired seeds."""

    def __post_init__(self) -> None:
        if not 0 < self.half_width < 1:
            raise RunError(f"half-width: {self.half_width:g}, must be above 0 and below 1; 0.01 is one AP point")
        if self.metric not in METRICS:
            raise RunError(f"metric: {self.metric}, must be one of {', '.join(METRICS)}")
        if not 4 <= self.pilot <= self.most:
            raise RunError(f"pilot: {self.pilot}, must be 4 or more and at most the seeds to fly ({self.most})")
        if self.most > MOST_SEEDS:
            raise RunError(f"most_seeds: {self.most}, must be at most {MOST_SEEDS}")


@dataclass(frozen=True)
class Flown:
    """Everything that a comparison has flown and planned so far."""

    torch: list[Row] = field(default_factory=list)
    surrogate: list[Row] = field(default_factory=list)
    """Of paired and of further seeds."""
    plans: list[Batch] = field(default_factory=list)

    def add(self, row: Row) -> None:
        """One more row."""
        (self.surrogate if row.by == "surrogate" else self.torch).append(row)

    @property
    def control(self) -> bool:
        """Whether the surrogate is used; the pilot alone does not use it."""
        return len(self.plans) > 1 and self.plans[-1].control

    def estimate(self, policy: str, metric: str, *, control: bool) -> Controlled:
        """A policy's gain; seeds without a car to be found count nowhere.

        Args:
            control: with the surrogate's rows as control variates, over paired seeds. False takes all of torch's rows alone;
                the correlation is still that of the paired seeds.
        """
        torch, cheap = (
            {row.seed: _number(row.gains[policy][metric]) for row in rows} for rows in (self.torch, self.surrogate)
        )
        paired = [seed for seed in torch if seed in cheap]
        further = [value for seed, value in cheap.items() if seed not in torch]
        found = controlled_mean([torch[s] for s in paired], [cheap[s] for s in paired], further, control=control)
        if control:
            return found
        alone = mean_interval(list(torch.values()))
        spread = [value for value in torch.values() if not math.isnan(value)]
        variance = float(np.var(spread, ddof=1)) if len(spread) > 1 else math.nan
        return replace(found, estimate=alone, variance=variance)

    def seconds(self) -> tuple[float, float]:
        """Median processor seconds of a seed by torch and by the surrogate."""
        torch, cheap = (
            float(np.median([row.processor_s for row in rows])) if rows else math.nan
            for rows in (self.torch, self.surrogate)
        )
        return torch, cheap


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def next_batch(flown: Flown, policies: Sequence[str], settings: Settings) -> Batch | None:
    """What is to be flown next, or None at the end; called when everything that was planned is flown.

    Args:
        policies: all but the first.

    Returns:
        The batch. The first is the pilot. The second decides for good whether the surrogate is used.
    """
    if not flown.plans:
        return Batch(settings.pilot, 0, control=True)
    last, n = flown.plans[-1], len(flown.torch)
    pilot = len(flown.plans) == 1
    if _narrow(flown, policies, settings, control=flown.control):
        return None
    if n >= settings.most and not (pilot and last.control):
        return None
    looked = [flown.estimate(p, settings.metric, control=last.control) for p in policies]
    if any(math.isnan(found.variance) for found in looked):
        raise RunError(f"{settings.metric}: fewer than two of {n} seeds have a gain, so no interval can be planned")
    plan = plan_units(looked, settings.half_width, *flown.seconds(), measured=n, control=last.control)
    control = last.control and (not pilot or plan.cost_ratio <= WORTH)
    if not control:
        plan = plan_units(looked, settings.half_width, 1.0, 1.0, measured=n, control=False)
    grow = not (pilot and control)
    paired = max(plan.expensive, n + grow)
    paired = max(n, min(-(-paired // BATCH) * BATCH, GROWTH * n, settings.most))
    if not control:
        return Batch(paired, 0, control, 1.0)
    per_pair = plan.cheap / plan.expensive
    return Batch(
        paired, max(math.ceil(per_pair * paired), last.further + BATCH * grow, BATCH), control, plan.cost_ratio
    )


def _narrow(flown: Flown, policies: Sequence[str], settings: Settings, *, control: bool) -> bool:
    """Whether all intervals are; NaN are not."""
    found = (widened(flown.estimate(p, settings.metric, control=control).estimate) for p in policies)
    return all(e.reaches(settings.half_width) for e in found)


def gains_between(policies: Sequence[str], matched: Sequence[Both]) -> Gains:
    """Every policy's AP@0.5 minus the first policy's, over the fusions that both made.

    Args:
        policies: labels, the first one first.
        matched: their matched fusions.
    """
    first, *others = matched
    return {
        policy: {f"ap50.{area}": gain for area, gain in gains_over(first, its).items()}
        for policy, its in zip(policies[1:], others, strict=True)
    }


def _mean_of(several: Sequence[Gains]) -> Gains:
    """The mean over draws; None where one has no value."""
    first = several[0]

    def mean(values: Iterable[float | None]) -> float | None:
        kept = [_number(v) for v in values]
        return None if any(map(math.isnan, kept)) else math.fsum(kept) / len(kept)

    return {p: {m: mean(gains[p][m] for gains in several) for m in first[p]} for p in first}


def with_detector(contender: Contender, detector: str) -> Contender:
    """A contender with another detector; weights are the shipped ones, as a file is of one detector.

    Raises:
        ScenarioError: the scenario has an option that this detector cannot fly.
    """
    scenario = contender.scenario
    if scenario.perception.detector == detector:
        return contender
    own: dict[str, Any] = {"detector": detector, "weights": None, "detector_params": {}}
    changed = scenario.model_copy(update={"perception": scenario.perception.model_copy(update=own)})
    return contender._replace(scenario=build(changed.model_dump(mode="json", exclude_none=True), source=scenario.name))


def fly_torch(contenders: Sequence[Contender], seed: int, kept: Path | None = None) -> Row:
    """One seed under every policy by the detector of the contenders' scenarios, which they share."""
    flights = _fly(contenders, seed, SHARED, (OUTCOME, MATCHED, PROCESSOR_S), kept)
    gains = gains_between([c.label for c in contenders], [flight.values[MATCHED][0] for flight in flights])
    outcomes = {c.label: flight.outcome for c, flight in zip(contenders, flights, strict=True)}
    return Row("torch", seed, gains, _processor_s(flights), outcomes)


def fly_surrogate(contenders: Sequence[Contender], seed: int, draws: int = DRAWS, kept: Path | None = None) -> Row:
    """One seed under every policy by the surrogate; gains are means over draws of its boxes."""
    flights = _fly(contenders, seed, f"{SURROGATE_DRAWS} {draws}", (MATCHED, PROCESSOR_S), kept)
    labels = [c.label for c in contenders]
    of_draws = zip(*(flight.values[MATCHED] for flight in flights), strict=True)
    return Row("surrogate", seed, _mean_of([gains_between(labels, draw) for draw in of_draws]), _processor_s(flights))


def _fly(
    contenders: Sequence[Contender], seed: int, seen_by: str, figures: Sequence[str], kept: Path | None
) -> list[Flight]:
    towns = [in_town_of(c.scenario, seed) for c in contenders]
    group = ""
    if seen_by == SHARED:  # boxes depend on who shares the detector
        together = "".join(
            f"{town.model_dump_json()}{c.function and name_of(c.function)}"
            for c, town in zip(contenders, towns, strict=True)
        )
        group = f"{seed} {hashlib.sha256(together.encode()).hexdigest()}"
    return fly_all(
        [
            task_of(town, figures, seed=seed, function=c.function, named=c.named, seen_by=seen_by, group=group)
            for c, town in zip(contenders, towns, strict=True)
        ],
        kept=kept,
    )


def _processor_s(flights: Sequence[Flight]) -> float:
    return math.fsum(flight.values[PROCESSOR_S] for flight in flights)


def run(
    contenders: Sequence[Contender], settings: Settings, kept: Path | None = None, report: Report | None = None
) -> Flown:
    """Fly batches until the intervals are narrow enough or the seeds are used up.

    Args:
        contenders: two or more; their scenarios have the detector that answers.
        kept: the file that flights are taken from, and kept in.
        report: called after each seed.

    Raises:
        SortieError: the scenario cannot be flown by both detectors; the first seed shows it.
    """
    first = contenders[0].scenario.seed
    cheap = [with_detector(c, "surrogate") for c in contenders]
    policies = [c.label for c in contenders[1:]]
    flown = Flown()

    def fly(stage: str, seeds: range, make: Callable[[int], Iterable[Row]]) -> None:
        known = {row.seed for row in (*flown.torch, *flown.surrogate)}
        for k, seed in enumerate(seeds):
            if report is not None:
                report(f"batch {len(flown.plans)}: {stage}", k, len(seeds))
            if seed not in known:
                for row in make(seed):
                    flown.add(row)
        if report is not None and seeds:
            report(f"batch {len(flown.plans)}: {stage}", len(seeds), len(seeds))

    while (batch := next_batch(flown, policies, settings)) is not None:
        flown.plans.append(batch)

        def paired(seed: int, control: bool = batch.control) -> Iterable[Row]:
            if control:  # first: it takes a second to learn that it cannot fly
                yield fly_surrogate(cheap, seed, kept=kept)
            yield fly_torch(contenders, seed, kept)

        fly("paired seeds", range(first, first + batch.paired), paired)
        further = range(first + FURTHER, first + FURTHER + batch.further)
        fly("further seeds by the surrogate", further, lambda seed: [fly_surrogate(cheap, seed, kept=kept)])
    return flown


@dataclass(frozen=True, slots=True)
class Contrast:
    """How one gain was estimated."""

    policy: str
    metric: str
    half_width: float
    """Of its 95 % interval, in AP; 0 where all gains are equal, which have no interval."""
    correlation: float
    """Of the torch detector's gain and the surrogate's over paired seeds; NaN where either does not vary."""
    explained: float
    """Share of the variance of the torch detector's gain that the surrogate predicts for seeds that were left out; below 0
    where it predicts worse than no prediction."""
    coefficient: float
    """By which the surrogate's deviation was subtracted; 0 where it was not used."""


@dataclass(frozen=True, slots=True)
class Precision:
    """How a comparison to a given half-width came to its gains, and what it cost."""

    detector: str
    """The detector that answers."""
    metric: str
    """The metric that had to reach the half-width."""
    asked: float
    """The half-width that was asked for, in AP."""
    reached: bool
    """False where the seeds were used up first. Gains that are all equal count from 30 seeds on (`intervals.EQUAL`)."""
    paired: int
    """Seeds flown by the detector that answers; in the pilot, and where `control`, by the surrogate as well."""
    further: int
    """Seeds flown by the surrogate alone."""
    control: bool
    """Whether the surrogate's gains were used."""
    contrasts: tuple[Contrast, ...]
    """Every policy but the first by metric, where there is something to find."""
    seconds: tuple[float, float]
    """Processor seconds of a seed, all policies together, by the detector that answers and by the surrogate: medians."""
    cost_ratio: float
    """What all seeds cost relative to the detector alone at the same half-width, predicted from the spread found."""


def precision_of(flown: Flown, policies: Sequence[str], settings: Settings, detector: str) -> Precision:
    """What a finished comparison says of its own precision and cost."""
    contrasts = []
    for policy, metric in ((p, m) for p in policies for m in METRICS):
        used = flown.estimate(policy, metric, control=flown.control)
        if used.estimate.count:
            off = widened(used.estimate).half_width
            contrasts.append(Contrast(policy, metric, off, used.correlation, used.explained, used.coefficient))
    widest = max((c.half_width for c in contrasts if c.metric == settings.metric), default=math.nan)
    torch_s, cheap_s = flown.seconds()
    ratio = math.nan
    if widest > 0:
        found = [flown.estimate(p, settings.metric, control=False) for p in policies]
        alone = plan_units(found, widest, torch_s, cheap_s, control=False).expensive
        ratio = (len(flown.torch) * torch_s + len(flown.surrogate) * cheap_s) / (alone * torch_s)
    paired = {row.seed for row in flown.torch}
    reached = _narrow(flown, policies, settings, control=flown.control)
    return Precision(
        detector,
        settings.metric,
        settings.half_width,
        reached,
        len(paired),
        sum(row.seed not in paired for row in flown.surrogate),
        flown.control,
        tuple(contrasts),
        (torch_s, cheap_s),
        ratio,
    )


def results(flown: Flown, contenders: Sequence[Contender]) -> tuple[tuple[Compared, ...], tuple[Gain, ...]]:
    """The sorties by the detector that answers, and the gains with their widened intervals."""
    sorties = []
    for row in sorted(flown.torch, key=lambda row: row.seed):
        for c in contenders:
            its = {area: row.gains[c.label][f"ap50.{area}"] if c.label in row.gains else None for area in AREAS}
            town = in_town_of(c.scenario, row.seed).perception.scene.seed
            sorties.append(Compared(c.label, row.seed, town, row.outcomes[c.label], its, None))
    gains = []
    for policy, metric in ((c.label, m) for c in contenders[1:] for m in METRICS):
        found = widened(flown.estimate(policy, metric, control=flown.control).estimate)
        if found.count:
            over = BY_BOTH if flown.control else "sorties"
            gains.append(Gain(policy, metric, found.mean, found.low, found.high, over, found.count))
    return tuple(sorties), tuple(gains)


class Answered(NamedTuple):
    """A comparison that reached its half-width, or used up its seeds."""

    sorties: tuple[Compared, ...]
    gains: tuple[Gain, ...]
    precision: Precision


def compare_to(
    contenders: Sequence[Contender],
    settings: Settings,
    kept: Path | None,
    report: Report | None = None,
) -> Answered:
    """Compare policies until the intervals of a metric are narrow enough.

    Args:
        contenders: two or more. Their scenario's detector answers; where it is the surrogate, the torch detector.
        kept: keeps what is flown, so that the same call goes on after an interruption; None keeps nothing.
        report: called with a stage, the seeds flown in it and all its seeds.

    Raises:
        RunError: a detector that cannot answer, or a file that cannot be used.
        PolicyError: an unknown policy or parameter, before anything is flown.
    """
    asked = contenders[0].scenario.perception.detector
    if asked in ("none", "recorded"):
        raise RunError(f"perception.detector is {asked}, must be torch or one of your own to compare to a half-width")
    if len(contenders) < 2:
        raise RunError("policies: one, must be two or more to compare to a half-width")
    ensure_known(contenders)
    detector = "torch" if asked == "surrogate" else asked
    answering = [with_detector(c, detector) for c in contenders]
    with user_errors():
        flown = run(answering, settings, kept, report)
    precision = precision_of(flown, [c.label for c in contenders[1:]], settings, detector)
    return Answered(*results(flown, answering), precision)
