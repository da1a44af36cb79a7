"""Average precision of a sortie: the boxes of every scored fusion matched to the truth.

Fusions are matched in blocks, so that memory keeps scores and hits alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.classes import CAR, TargetClass
from sortie.perception.metrics.ap import Judged, Matched, average_precision, judge
from sortie.perception.types import Boxes
from sortie.scenarios.plugins.reference import is_file
from sortie.sim.results.box_rows import Columns, Key, columns_of, fusion_blocks, fusions_of, kinds_of
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.section import Count, Flown, Hertz, OutcomeSection, Share, figure, once
from sortie.sim.results.spool import InTime

Both = dict[str, dict[Key, Matched]]
"""Matched fusions, `full_scene` and `mission`."""
FULL_SCENE, MISSION = "full_scene", "mission"


def matched(record: SortieRecord, *, mission: bool, begin_s: float = 0.0) -> dict[Key, Matched]:
    """The cars of every scored fusion from `begin_s` on, by (time, ego), matched to the truth.

    Args:
        mission: count the mission disc alone, and only fusions made while there is one.
    """
    return score(record, [CAR], begin_s).pools[CAR, MISSION if mission else FULL_SCENE].by_fusion()


def both_matched(record: SortieRecord) -> Both:
    """The cars of every scored fusion matched in the full scene and in the mission disc."""
    scored = score(record, [CAR])
    return {scope: scored.pools[CAR, scope].by_fusion() for scope in (FULL_SCENE, MISSION)}


@dataclass(frozen=True, slots=True)
class Pool:
    """Matched detections of n fusions, one fusion after the other, each best first."""

    t_s: NDArray[np.float64]
    drone: NDArray[np.int32]
    first: NDArray[np.int64]
    """[n + 1]: the detections of fusion k are first[k] … first[k + 1] − 1."""
    score: NDArray[np.float64]
    hit: NDArray[np.bool_]
    truths: NDArray[np.int64]

    def by_fusion(self) -> dict[Key, Matched]:
        """Each fusion by itself."""
        keys = zip(self.t_s.tolist(), self.drone.tolist(), strict=True)
        return dict(zip(keys, self.fusions(np.arange(len(self.t_s))), strict=True))

    def fusions(self, which: NDArray[np.intp]) -> list[Matched]:
        """Some fusions, by their places."""
        spans = zip(
            self.first[which].tolist(), self.first[which + 1].tolist(), self.truths[which].tolist(), strict=True
        )
        return [Matched(self.score[a:b], self.hit[a:b], n) for a, b, n in spans]

    def ap_of(self, drone: int) -> float | None:
        """AP of one ego's fusions; None without a truth."""
        ap = average_precision(self.fusions(np.flatnonzero(self.drone == drone)))
        return None if np.isnan(ap) else ap

    def ap(self, begin_s: float = 0.0, end_s: float = float("inf")) -> float | None:
        """AP of the fusions from `begin_s` to before `end_s`; None without a truth."""
        a, b = np.searchsorted(self.t_s, [begin_s, end_s])
        here = slice(self.first[a], self.first[b])
        ap = average_precision([Matched(self.score[here], self.hit[here], int(self.truths[a:b].sum()))])
        return None if np.isnan(ap) else ap


@dataclass(frozen=True, slots=True)
class Scored:
    """The fusions of a record, matched."""

    pools: Mapping[tuple[TargetClass, str], Pool]
    """By class, and `full_scene` or `mission`."""
    grounded: Mapping[str, int]
    """Cars about the places of drones that left the air, by `full_scene` and `mission`."""

    def ap(self, kind: TargetClass, begin_s: float = 0.0, end_s: float = float("inf")) -> dict[str, float | None]:
        """AP of a class in the full scene and in the mission disc."""
        return {scope: self.pools[kind, scope].ap(begin_s, end_s) for scope in (FULL_SCENE, MISSION)}

    def grounded_blind(self) -> dict[str, float | None]:
        """AP of cars with every drone that left the air counted as one that detects nothing.

        Its cars join the truths and it adds no detection. So precision stays, and each recall and AP shrink by one factor.
        """
        blind = {}
        for scope, ap in self.ap(CAR).items():
            sought = int(self.pools[CAR, scope].truths.sum())
            every = sought + self.grounded[scope]
            blind[scope] = sought / every * (ap or 0.0) if every else None
        return blind


class Accuracy(OutcomeSection):
    full_scene: Share | None = figure(
        "AP@0.5 over all targets within range, pooled over egos and scored fusions; of vehicles by rotated BEV IoU."
    )
    mission: Share | None = figure("The same within the mission disc, while there is one: by the centres of boxes.")


class Ap50(Accuracy):
    detector: str = figure("`perception.detector`, or of one that was passed its `name`, or module and class.")
    fusion: str | None = figure("`perception.fusion` or `recorded_fusion`; null where another detector flew.")
    calibration: str | None = figure("Which fit a surrogate detector is of.")
    grounded_blind: Accuracy = figure(
        "The same with every drone that left the air, or has not joined yet, counted as blind: at each scored instant "
        "it detects nothing, and the cars about the place that it would have in the formation count as missed. Equal "
        "where all fly to the end."
    )
    sample_rate_hz: Hertz = figure("Accuracy is sampled at this rate while traffic runs at the full one.")
    scored_fusions: Count = figure("How many fusions were scored.")
    scored_drones: Count = figure(
        "How many drones are scored at each scored instant (`perception.egos`), 0 without a detector. Where they are "
        "fewer than `scorable_drones`, drones take turns in a random order, and accuracy is an estimate for the whole "
        "fleet."
    )
    scorable_drones: Count = figure("How many drones may be scored: all but ground stations that are not.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, Any]:
        record, scenario = flown.record, flown.scenario
        return {
            **scored(flown).ap(CAR),
            "detector": record.detector,
            "fusion": _fusion(record),
            "calibration": record.calibration,
            "grounded_blind": scored(flown).grounded_blind(),
            "sample_rate_hz": min(scenario.perception.sample_rate_hz, scenario.context.rate_hz),
            "scored_fusions": flown.tables["fusions"].num_rows,
            "scored_drones": 0 if record.detector == "none" else scenario.scored_drones,
            "scorable_drones": len(scenario.scorable_drones),
        }


def _fusion(record: SortieRecord) -> str | None:
    """What fuses payloads, as the scenario names it; None where a detector flew that the scenario does not name."""
    section = record.scenario.perception
    fuses = record.detector == section.detector != "none" and not is_file(section.detector)
    return (section.recorded_fusion or section.fusion) if fuses else None


class ByClass(OutcomeSection):
    car: Accuracy = figure("The same as `ap50`.")
    truck: Accuracy = figure("Trucks, likewise. The shipped detectors call every vehicle a car.")
    person: Accuracy = figure(
        "People, by distance: a box may be of a person within 2 m of it. Boxes are those of the ego's own thermal "
        "camera joined with those that its peers sent; everybody in the ego's square counts, hidden or not."
    )

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, dict[str, float | None]]:
        """The figures of a sortie; null of classes that drones do not look for."""
        wanted = _looked_for(flown)
        return {
            kind.name.lower(): scored(flown).ap(kind) if kind in wanted else dict.fromkeys((FULL_SCENE, MISSION))
            for kind in TargetClass
        }


def _looked_for(flown: Flown) -> list[TargetClass]:
    """The classes that drones look for; none where cars are the only one, as `ap50` says it."""
    classes = flown.scenario.perception.classes
    return [kind for kind in TargetClass if len(classes) > 1 and kind.name.lower() in classes]


@once
def scored(flown: Flown) -> Scored:
    """The fusions of a sortie, matched for cars and for all classes that drones look for."""
    return score(flown.record, [CAR, *(kind for kind in _looked_for(flown) if kind != CAR)])


def score(record: SortieRecord, kinds: Sequence[TargetClass], begin_s: float = 0.0) -> Scored:
    """Match the boxes of some classes in every scored fusion from `begin_s` on."""
    fusions = record.tables["fusions"]
    t_s, drone = fusions["t_s"].to_numpy(), fusions["drone"].to_numpy()
    within = begin_s <= t_s
    t_s, drone = t_s[within], drone[within]
    regions = Regions(record.tables["mission"], record.scenario.mission)
    found, truth = InTime(record.tables, "detections"), InTime(record.tables, "truths")
    parts: dict[tuple[TargetClass, str], list[Pool]] = {
        (kind, scope): [] for kind in kinds for scope in (FULL_SCENE, MISSION)
    }
    grounded = dict.fromkeys((FULL_SCENE, MISSION), 0)
    for here, until_s in fusion_blocks(t_s, record.scenario.duration_s):
        keys = list(zip(t_s[here].tolist(), drone[here].tolist(), strict=True))
        discs = regions.at(t_s[here], drone[here])
        block = _Block(keys, discs, columns_of(found.before(until_s)), columns_of(truth.before(until_s)))
        for kind in kinds:
            parts[kind, FULL_SCENE].append(block.in_full(kind))
            parts[kind, MISSION].append(block.in_mission(kind))
        for scope, count in block.grounded(regions).items():
            grounded[scope] += count
    return Scored({key: _joined(pools) for key, pools in parts.items()}, grounded)


def _pool(keys: Sequence[Key], each: Sequence[Matched]) -> Pool:
    """Fusions of one block."""
    t_s, drone = zip(*keys, strict=True) if keys else ((), ())
    return Pool(
        np.array(t_s, np.float64),
        np.array(drone, np.int32),
        np.concatenate([[0], np.cumsum([len(m.score) for m in each])]).astype(np.int64),
        np.concatenate([np.zeros(0), *(m.score for m in each)]),
        np.concatenate([np.zeros(0, bool), *(m.hit for m in each)]),
        np.array([m.truths for m in each], np.int64),
    )


def _joined(pools: Sequence[Pool]) -> Pool:
    """The blocks of a class and scope as one."""
    begins = np.cumsum([0, *(len(pool.score) for pool in pools)])
    first = [pool.first[:-1] + begin for pool, begin in zip(pools, begins[:-1], strict=True)]
    return Pool(
        np.concatenate([pool.t_s for pool in pools]),
        np.concatenate([pool.drone for pool in pools]),
        np.concatenate([*first, begins[-1:]]),
        np.concatenate([pool.score for pool in pools]),
        np.concatenate([pool.hit for pool in pools]),
        np.concatenate([pool.truths for pool in pools]),
    )


class _Block:
    """Some fusions; overlaps are computed once for all classes, and for the scene and the disc."""

    def __init__(self, keys: Sequence[Key], discs: NDArray[np.float64], found: Columns, truth: Columns) -> None:
        self._keys, self._discs, self._rows = keys, discs, truth
        boxes, at = _boxes_of(keys, found)
        self._at = fusions_of(keys, truth)
        self._truth, cars = _boxes_of(keys, truth)
        self._judged: Judged = judge(boxes, at, self._truth, cars, len(keys))
        self._boxes = boxes.take(self._judged.order)

    def in_full(self, kind: TargetClass) -> Pool:
        """Those of a class in the full scene."""
        return _pool(self._keys, self._judged.matched(*self._of(kind)))

    def in_mission(self, kind: TargetClass) -> Pool:
        """Those of a class in the mission disc, of fusions that have one."""
        disc, (boxes, truth) = self._discs, self._of(kind)
        images, cars = self._judged.image, self._judged.cars
        inside = self._judged.matched(
            boxes & _within(self._boxes, disc[images]), truth & _within(self._truth, disc[cars])
        )
        there = np.flatnonzero(~np.isnan(disc[:, 2])).tolist()
        return _pool([self._keys[k] for k in there], [inside[k] for k in there])

    def grounded(self, regions: Regions) -> dict[str, int]:
        """Cars of drones that have no fusion: they left the air."""
        blind = (self._at < 0) & (kinds_of(self._rows) == CAR)
        t_s, drone, x_m, y_m = (self._rows[c][blind] for c in ("t_s", "drone", "x_m", "y_m"))
        disc_x_m, disc_y_m, radius_m = regions.at(t_s, drone).T
        inside = (x_m - disc_x_m) ** 2 + (y_m - disc_y_m) ** 2 <= radius_m**2
        return {FULL_SCENE: len(t_s), MISSION: int(np.count_nonzero(inside))}

    def _of(self, kind: TargetClass) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which boxes and which truths are of a class."""
        return self._boxes.kind == kind, self._truth.kind == kind


def _within(boxes: Boxes, disc: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each box's centre is in its disc [n, 3], as `Boxes.inside` says; in none that is NaN."""
    dx, dy = boxes.xy_m[:, 0] - disc[:, 0], boxes.xy_m[:, 1] - disc[:, 1]
    return np.asarray(dx * dx + dy * dy <= disc[:, 2] ** 2)


def _boxes_of(keys: Sequence[Key], rows: Columns) -> tuple[Boxes, NDArray[np.int64]]:
    """The boxes of some fusions (time, ego), and which of them each is of; both in order of time."""
    at = fusions_of(keys, rows)
    xy, size = (np.column_stack([rows[a], rows[b]]) for a, b in (("x_m", "y_m"), ("length_m", "width_m")))
    boxes = Boxes(xy, size, rows["yaw_rad"], rows.get("score", np.ones(len(at))), kind=kinds_of(rows))
    return (boxes, at) if len(at) == 0 or at.min() >= 0 else (boxes.take(at >= 0), at[at >= 0])
