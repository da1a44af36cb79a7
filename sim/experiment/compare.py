"""Policies side by side on one scenario: same seeds, same scenes, same draws, paired intervals."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sortie.perception.metrics.ap import Matched, average_precision
from sortie.perception.metrics.bootstrap import compare as bootstrap
from sortie.policies.contract import Policy
from sortie.policies.registry import own_fusion, resolve
from sortie.scenarios.intervals import SHARE, Estimate, mean_interval
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.flight import MATCHED, OUTCOME, Task, task_of
from sortie.sim.experiment.flight_file import fly_all
from sortie.sim.experiment.pools import processes
from sortie.sim.folders import RunError
from sortie.sim.results.accuracy import FULL_SCENE, MISSION, Both
from sortie.sim.results.box_rows import Key
from sortie.sim.results.outcome import OutcomeDict
from sortie.sim.results.record import SortieRecord

SEEDS = 8
"""Sorties a policy where nothing else is asked and the detector is quick."""
MOST_SEEDS = 10_000
TOGETHER = 50
"""Seeds that fly together; of the others the outcomes alone stay in memory."""
TOWNS = 2**63
BLOCK_S = 5.0
"""Instants of a sortie that are resampled together. Neighbouring instants see the same cars over the same links. On
`track_target`, gains in AP at instants 5 s apart correlate by about 0.1, and by about 0.3 at 0.5 s."""
AREAS = (FULL_SCENE, MISSION)
"""Where AP is scored, by its names in the outcome."""
BY_BOTH = "sorties by both detectors"
"""`Gain.over` where the surrogate's sorties were control variates (`sortie.sim.experiment.half_width`)."""


class Contender(NamedTuple):
    """One of the policies that are compared."""

    label: str
    scenario: Scenario
    """With this policy in it; otherwise alike among contenders."""
    function: Policy | None = None
    """Decides in place of the scenario's policy; None where the scenario names it."""
    named: bool = False
    """Whether the function's name and file decide what it does, so that its flights may be kept."""

    def with_own_fusion(self) -> Contender:
        """The same with the fusion that its method was published with, where it is a prior method, and with that fusion's network.

        These networks were all trained on the same few frames; the default one was trained on many more.
        """
        fusion = None if self.function is not None else own_fusion(self.scenario.policy.name)
        if fusion is None:
            return self
        perception = self.scenario.perception.model_copy(update={"fusion": fusion, "weights": f"{fusion}.safetensors"})
        return self._replace(scenario=self.scenario.model_copy(update={"perception": perception}))


@dataclass(frozen=True)
class Compared:
    """One policy's sortie under one seed, and its accuracy against the first policy's."""

    policy: str
    seed: int
    town_seed: int
    """`perception.scene.seed`: the town that it flew in."""
    outcome: OutcomeDict
    gain: dict[str, float | None]
    """AP@0.5 minus the first policy's in this sortie, `full_scene` and `mission`, over the fusions that both policies
    made; None where it is not defined."""
    fly: Callable[[], SortieRecord] | None = None
    """Gives the record, of the first seed alone: the records of all of them would fill the memory."""

    @functools.cached_property
    def record(self) -> SortieRecord | None:
        """The first seed's record, flown again where its row was there already; None of the other seeds."""
        return None if self.fly is None else self.fly()


@dataclass(frozen=True, slots=True)
class Gain:
    """One policy's AP@0.5 minus the first policy's.

    With several seeds it is the mean over sorties of each sortie's own difference, not the difference of two APs that
    pool the fusions of all sorties: a sortie with many cars counts as much as one with few.
    """

    policy: str
    metric: str
    """`ap50.full_scene` or `ap50.mission`: over the fusions that both policies made. Where drones left the air and several
    seeds were flown, also `ap50.grounded_blind.full_scene` and `.mission`: over all drones."""
    gain: float
    low: float
    high: float
    """The paired 95 % interval over what `over` names."""
    over: str
    """What the interval covers: `sorties` (Student's over the sorties' differences, which have towns and draws of their
    own), `sorties by both detectors` (the same, with the surrogate's sorties as control variates), or `blocks of one
    sortie` (a bootstrap over its blocks of `BLOCK_S`: descriptive, for this town and this flight alone)."""
    count: int
    """How many of these: sorties in which both policies have an AP, or blocks with fusions that both made. A single one has
    no interval, and `low` and `high` are NaN."""


class Flown(NamedTuple):
    """All sorties of a comparison, and what they come to."""

    sorties: tuple[Compared, ...]
    """Seed by seed, policies in the order in which they were named."""
    gains: tuple[Gain, ...]
    """Of every policy but the first, where there is something to find."""


def chosen_seeds(scenario: Scenario, first: int | None = None, count: int | None = None) -> range:
    """The seeds that a comparison flies when they are not listed.

    Args:
        scenario: what is flown.
        first: None is the scenario's own seed.
        count: None is eight for the surrogate's sorties, which take seconds, where no first seed is named either. It is
            one for all others.

    Raises:
        RunError: too many.
    """
    surrogate = scenario.perception.detector == "surrogate" and first is None
    count = (SEEDS if surrogate else 1) if count is None else count
    if not 1 <= count <= MOST_SEEDS:
        raise RunError(f"seeds is {count}, must be 1 to {MOST_SEEDS}")
    begin = scenario.seed if first is None else first
    return range(begin, begin + count)


def compare(
    contenders: Sequence[Contender],
    seeds: Sequence[int],
    *,
    progress: Callable[[str, int, float], None] | None = None,
    workers: int = 1,
    kept: Path | None = None,
) -> Flown:
    """Fly a scenario under several policies on the same seeds.

    Args:
        seeds: one flies in the scenario's own town, as `sortie fly` does. Of several, each has a town of its own as well as
            random draws of its own: as far from the scenario's town seed as it is from the scenario's seed.
        progress: called with the label, the seed and the simulated time.
        workers: more than one fly in processes of their own; a policy that is a function flies in this one.
        kept: the file that flights are taken from, and kept in.

    Raises:
        PolicyError: an unknown policy or parameter, before anything is flown.
        RunError: a flight failed in its worker.
    """
    ensure_known(contenders)
    flown: list[Compared] = []
    within: list[Gain] = []
    with nullcontext() if workers == 1 else processes(min(workers, len(seeds) * len(contenders))) as pool:
        for begin in range(0, len(seeds), TOGETHER):
            asked = [(seed, contender) for seed in seeds[begin : begin + TOGETHER] for contender in contenders]
            towns = [c.scenario if len(seeds) == 1 else in_town_of(c.scenario, seed) for seed, c in asked]
            tasks = [
                task_of(town, (OUTCOME, MATCHED), seed=seed, function=c.function, named=c.named)
                for town, (seed, c) in zip(towns, asked, strict=True)
            ]
            records: dict[int, SortieRecord] = {}
            watch, keep = _watching(asked, progress), _keeping(asked, seeds[0], records)
            rows = fly_all(tasks, pool, kept, watch, keep)
            for k, ((seed, contender), town, row) in enumerate(zip(asked, towns, rows, strict=True)):
                if row.error:
                    raise RunError(f"{contender.label}, seed {seed}: {row.error}")
                again: Callable[[], SortieRecord] | None = None
                if seed == seeds[0]:
                    again = functools.partial(run_sortie, town, contender.function, seed)
                    again = functools.partial(records.__getitem__, k) if k in records else again
                gains: dict[str, float | None] = dict.fromkeys(AREAS)
                if first := k % len(contenders):
                    ours, its = (rows[n].values[MATCHED][0] for n in (k - first, k))
                    gains = gains_over(ours, its)
                    within += _within(contender.label, ours, its, gains) if len(seeds) == 1 else ()
                town_seed = town.perception.scene.seed
                flown.append(Compared(contender.label, seed, town_seed, row.outcome, gains, again))
    return Flown(tuple(flown), tuple(within if len(seeds) == 1 else _over_sorties(flown)))


Asked = Sequence[tuple[int, Contender]]


def _watching(asked: Asked, progress: Callable[[str, int, float], None] | None) -> Callable[[Task, float], None]:
    """Tells of the sortie that flies."""

    def watch(task: Task, t_s: float) -> None:
        seed, contender = asked[task.number]
        if progress is not None:
            progress(contender.label, seed, min(t_s, contender.scenario.duration_s))

    return watch


def _keeping(asked: Asked, first: int, records: dict[int, SortieRecord]) -> Callable[[Task, SortieRecord], None]:
    """Keeps the records of the first seed."""

    def keep(task: Task, record: SortieRecord) -> None:
        if asked[task.number][0] == first:
            records[task.number] = record

    return keep


def ensure_known(contenders: Sequence[Contender]) -> None:
    """Refuse policies that are not there, before anything is flown. Raises PolicyError."""
    for contender in contenders:
        if contender.function is None:
            resolve(contender.scenario.policy.name, contender.scenario.policy.params)


def _within(policy: str, first: Both, other: Both, gains: Mapping[str, float | None]) -> Iterator[Gain]:
    """Gains in one sortie, with intervals over its blocks."""
    for area in AREAS:
        if gains[area] is not None:
            pairs = pair_up(first[area], other[area])
            d = bootstrap(*pairs)
            yield Gain(policy, f"ap50.{area}", d.delta, d.low, d.high, "blocks of one sortie", len(set(pairs[2])))


def _over_sorties(flown: Sequence[Compared]) -> Iterator[Gain]:
    first = {f.seed: f for f in flown if f.policy == flown[0].policy}
    for label in dict.fromkeys(f.policy for f in flown if f.policy != flown[0].policy):
        its = [f for f in flown if f.policy == label]
        gains = {f"ap50.{name}": [f.gain[name] for f in its] for name in AREAS}
        if any(f.outcome["mission"]["flown_share"] < 1.0 for f in flown):
            gains |= {f"ap50.grounded_blind.{name}": [_blind(f, first[f.seed], name) for f in its] for name in AREAS}
        for metric, of_sorties in gains.items():
            kept = [gain for gain in of_sorties if gain is not None]
            if kept:
                e = over_sorties(kept)
                yield Gain(label, metric, e.mean, e.low, e.high, "sorties", e.count)


def _blind(its: Compared, first: Compared, area: str) -> float | None:
    """AP minus the first policy's, with drones that left the air counted as blind under both."""
    ap, before = (f.outcome["ap50"]["grounded_blind"][area] for f in (its, first))
    return None if ap is None or before is None else ap - before


def gains_over(first: Both, other: Both) -> dict[str, float | None]:
    """AP@0.5 of one sortie minus that of the first, over the fusions that both made, by area."""
    return {area: gain_between(*pair_up(first[area], other[area])[:2]) for area in AREAS}


def gain_between(first: Sequence[Matched], other: Sequence[Matched]) -> float | None:
    """AP@0.5 of one arm's fusions minus that of the first arm's; None where there was nothing to find."""
    if not all(any(m.truths for m in arm) for arm in (first, other)):
        return None
    return average_precision(other) - average_precision(first)


def over_sorties(gains: Sequence[float]) -> Estimate:
    """The gain that a comparison of several seeds prints: the mean of the sorties' own, and its 95 % interval."""
    return mean_interval(gains, SHARE.of_differences())


def in_town_of(scenario: Scenario, seed: int) -> Scenario:
    """The scenario in the town that a seed has when several are compared; its own seed has its own town."""
    scene = scenario.perception.scene
    moved = scene.model_copy(update={"seed": (scene.seed + seed - scenario.seed) % TOWNS})
    return scenario.model_copy(update={"perception": scenario.perception.model_copy(update={"scene": moved})})


def pair_up(
    first: Mapping[Key, Matched], other: Mapping[Key, Matched]
) -> tuple[list[Matched], list[Matched], list[float]]:
    """The fusions that two sorties both scored, side by side, and the begin of the block of `BLOCK_S` that each is in.

    The bootstrap draws whole blocks: instants of a sortie that are close in time are not independent.
    """
    both = [key for key in first if key in other]
    return [first[k] for k in both], [other[k] for k in both], [t_s // BLOCK_S for t_s, _ in both]


def kept_text(flown: Flown, precision: Any = None) -> str:
    """What `--out` holds, as JSON; where there is no interval, or nothing was found, null.

    Args:
        precision: a dataclass, of a comparison to a half-width.
    """
    sorties = [
        {"policy": s.policy, "seed": s.seed, "town_seed": s.town_seed, "gain_over_first": s.gain, "outcome": s.outcome}
        for s in flown.sorties
    ]
    plain: dict[str, Any] = {"gains": [_known(asdict(gain)) for gain in flown.gains], "sorties": sorties}
    if precision is not None:
        plain["precision"] = _known(asdict(precision))
    return json.dumps(plain, indent=2, allow_nan=False) + "\n"


def _known(value: Any) -> Any:
    """With null for NaN, which JSON has not."""
    if isinstance(value, dict):
        return {key: _known(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_known(v) for v in value]
    return None if value != value else value
