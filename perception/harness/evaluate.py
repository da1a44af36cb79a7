"""Conditions over frames: what each ego finds under each way of sharing, matched to what was there. Free of torch.

Scores are kept down to a low floor, and a threshold τ is applied afterwards (`Evaluation.at`): suppression and
matching go best first, so what a box below τ does concerns boxes below τ alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from perception.ap import Matched, average_precision, match, suppress
from perception.geometry import CELLS, Geometry
from perception.harness import selection
from perception.harness.condition import Condition
from perception.harness.contract import Exchange, FleetFrames, Floats, Instrument, View
from perception.types import Boxes
from scenarios.streams import stream

Region = Literal["full", "mission", "ego"]
REGION_M = 32.0
"""Radius of the mission's disc, and of the one around the ego."""
NMS_IOU, FLOOR = 0.15, 0.01


@dataclass(frozen=True, slots=True)
class Settings:
    """What the numbers depend on beside the instrument, the frames and the condition."""

    egos: int = 5
    """The first so many drones of a frame are egos."""
    floor: float = FLOOR
    """The lowest score that is kept."""
    nms_iou: float = NMS_IOU
    seed: int = 0
    """Of the mission's targets and of random peers."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """n frames × `egos` under every condition. A unit is one ego of one frame, frame by frame."""

    conditions: tuple[Condition, ...]
    regions: tuple[Region, ...]
    settings: Settings
    scene: NDArray[np.int64]
    """[n]"""
    target: Floats
    """[n, 2] centre of the mission's disc; NaN where the frame has none and does not count for the mission."""
    units: Mapping[tuple[Condition, Region], Sequence[Matched]]
    """One `Matched` per unit [n · egos]."""
    cells: Mapping[Condition, NDArray[np.int64]]
    """[n · egos] cells shared to the unit, in all."""
    payload_bytes: Mapping[Condition, NDArray[np.int64]]
    """[n · egos] cells × 80 × 2."""
    index_bytes: Mapping[Condition, NDArray[np.int64]]
    """[n · egos] which cells they are, counted apart."""

    def at(self, tau: float) -> Evaluation:
        """The same with every box below `tau` gone.

        Raises:
            ValueError: below the floor, where boxes were not kept.
        """
        if tau < self.settings.floor:
            raise ValueError(f"tau is {tau}, must be at least the floor {self.settings.floor}")
        cut = {key: [m.at(tau) for m in several] for key, several in self.units.items()}
        return replace(self, units=cut, settings=replace(self.settings, floor=tau))

    def counts(self, region: Region) -> NDArray[np.bool_]:
        """[n · egos]: the units that count in a region; for the mission those of frames that have a target."""
        every = np.ones(len(self.scene), bool) if region != "mission" else ~np.isnan(self.target[:, 0])
        return np.repeat(every, self.settings.egos)

    def matched(self, condition: Condition, region: Region = "full") -> list[Matched]:
        """The units that count, in order."""
        several = self.units[condition, region]
        return [several[i] for i in np.flatnonzero(self.counts(region)).tolist()]

    def groups(self, region: Region = "full", by: Literal["frame", "scene"] = "frame") -> NDArray[np.int64]:
        """A label for each unit of `matched`: units of one frame, or of one scene, stand or fall together in a bootstrap."""
        label = np.arange(len(self.scene)) if by == "frame" else self.scene
        return np.repeat(label, self.settings.egos)[self.counts(region)]

    def ap(self, condition: Condition, region: Region = "full") -> float:
        """AP@0.5 over the units that count."""
        return average_precision(self.matched(condition, region))


def evaluate(
    instrument: Instrument,
    frames: FleetFrames,
    conditions: Sequence[Condition],
    *,
    regions: Sequence[Region] = ("full", "mission"),
    egos: int = 5,
    floor: float = FLOOR,
    seed: int = 0,
    store: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Every ego of every frame under every condition.

    Args:
        instrument, frames: a model and what it looks at.
        conditions: duplicates are evaluated once, and so are those that differ in nothing (`Condition.plain`).
        regions: full: every car in the ego's square; mission: 32 m around the frame's target; ego: around the ego.
        egos: how many drones of each frame are egos, the first ones.
        floor: the lowest score that is kept.
        seed: of targets and random peers.
        store: a folder for finished frames, so that a later call goes on where this one ended.
        progress: called with frames done and frames in all.

    Raises:
        ValueError: an unknown region, more egos than drones, or a condition that does not fit the fleet.
    """
    drones = frames.est_pose.shape[1]
    if not 1 <= egos <= drones:
        raise ValueError(f"egos is {egos}, must be 1 to the {drones} drones of a frame")
    for region in regions:
        if region not in get_args(Region):
            raise ValueError(f"region is {region!r}, must be {' or '.join(get_args(Region))}")
    conditions = tuple(dict.fromkeys(conditions))
    settings = Settings(egos, floor, NMS_IOU, seed)
    plain = {c: c.plain(drones) for c in conditions}
    todo = tuple(dict.fromkeys(plain.values()))
    keys = frame_keys(frames)
    rows = []
    for f in range(len(keys)):
        rows.append(_frame(instrument, frames, f, keys[f], todo, regions, settings))
        if progress is not None:
            progress(f + 1, len(keys))
    return Evaluation(
        conditions,
        tuple(regions),
        settings,
        np.asarray(frames.scene),
        np.array([row.target for row in rows]),
        {(c, r): [m for row in rows for m in row.units[plain[c], r]] for c in conditions for r in regions},
        *(
            {c: np.array([cost[i] for row in rows for cost in row.cost[plain[c]]]) for c in conditions}
            for i in range(3)
        ),
    )


@dataclass(frozen=True, slots=True)
class _Row:
    """One frame's results."""

    target: tuple[float, float]
    units: dict[tuple[Condition, Region], list[Matched]]
    cost: dict[Condition, list[tuple[int, int, int]]]


def frame_keys(frames: FleetFrames) -> list[tuple[int, int]]:
    """(scene, number within the scene) of each frame: what its random draws are keyed by, whatever else is evaluated."""
    seen: dict[int, int] = {}
    out = []
    for scene in np.asarray(frames.scene).tolist():
        seen[scene] = seen.get(scene, -1) + 1
        out.append((int(scene), seen[scene]))
    return out


def mission_target(frames: FleetFrames, f: int, key: tuple[int, int], seed: int = 0) -> tuple[float, float] | None:
    """The car that the mission is about: one of those within a footprint's radius (42 m) of the fleet's true centre.

    Drawn evenly from the frame's own stream, before any model has looked; None where there is no such car.
    """
    cars = frames.cars[f][~np.isnan(frames.cars[f][:, 0]), :2]
    near = cars[np.hypot(*(cars - frames.true_pose[f][:, :2].mean(axis=0)).T) <= selection.FOOTPRINT_M]
    if not len(near):
        return None
    x, y = near[int(stream(seed, 0, key, "harness.mission_target").integers(len(near)))]
    return float(x), float(y)


def truth(frames: FleetFrames, f: int, ego: int, geometry: Geometry) -> Boxes:
    """The cars whose centres lie in the ego's true square, whether anyone can see them or not; scores are 1."""
    cars = frames.cars[f][~np.isnan(frames.cars[f][:, 0])]
    x, y, yaw = frames.true_pose[f, ego]
    dx, dy, c, s = cars[:, 0] - x, cars[:, 1] - y, np.cos(yaw), np.sin(yaw)
    reach = geometry.half_extent_m
    cars = cars[(np.abs(c * dx + s * dy) < reach) & (np.abs(c * dy - s * dx) < reach)]
    return Boxes(cars[:, :2], cars[:, 2:4], cars[:, 4], np.ones(len(cars)))


def exchanges(
    view: View,
    frames: FleetFrames,
    f: int,
    key: tuple[int, int],
    conditions: Sequence[Condition],
    settings: Settings,
    geometry: Geometry,
    target: tuple[float, float] | None,
) -> list[tuple[Exchange, list[int]]]:
    """For every condition and ego in turn: what is exchanged, and how many cells each of its peers sends."""
    est = frames.est_pose[f]
    drones = len(est)
    overlap = selection.footprint_overlap(est[:, :2], np.full(drones, selection.FOOTPRINT_M))
    roi = None if target is None else selection.in_disc(est, (*target, REGION_M), geometry)
    orders: dict[tuple[str, bool], NDArray[np.int16]] = {}
    out = []
    for c in conditions:
        total = selection.total_cells(c.rho, drones - 1)
        which = (c.cells_by, c.roi and roi is not None)
        if total and which not in orders:
            orders[which] = selection.sending_order(view.rank(c.cells_by), roi if which[1] else None)
        for ego in range(settings.egos):
            peers = selection.choose(c, ego, overlap[ego], key, settings.seed)
            count = selection.allocate(total, [float(overlap[ego, p]) for p in peers], c.allocation)
            if total:
                sent = orders[which][list(peers)] < np.array(count)[:, None, None]
            else:
                sent = np.zeros((len(peers), CELLS, CELLS), np.bool_)
            out.append((Exchange(ego, peers, sent, c.unsent), count))
    return out


def _frame(
    instrument: Instrument,
    frames: FleetFrames,
    f: int,
    key: tuple[int, int],
    conditions: Sequence[Condition],
    regions: Sequence[Region],
    settings: Settings,
) -> _Row:
    view = instrument.look(frames, f)
    target = mission_target(frames, f, key, settings.seed)
    given = exchanges(view, frames, f, key, conditions, settings, instrument.geometry, target)
    found = view.detect([e for e, _ in given], settings.floor)
    there = [truth(frames, f, ego, instrument.geometry) for ego in range(settings.egos)]
    discs: dict[tuple[Region, int], tuple[float, float, float] | None] = {}
    for ego in range(settings.egos):
        x, y = frames.true_pose[f, ego, :2]
        discs["full", ego] = None
        discs["ego", ego] = (float(x), float(y), REGION_M)
        discs["mission", ego] = (*target, REGION_M) if target else (0.0, 0.0, -1.0)
    units: dict[tuple[Condition, Region], list[Matched]] = {(c, r): [] for c in conditions for r in regions}
    cost: dict[Condition, list[tuple[int, int, int]]] = {c: [] for c in conditions}
    for i, ((e, count), boxes) in enumerate(zip(given, found, strict=True)):
        c = conditions[i // settings.egos]
        cost[c].append((sum(count), *selection.link_bytes(count)))
        x, y, yaw = frames.est_pose[f, e.ego].tolist()
        placed = suppress(Boxes.placed(boxes, (x, y, yaw)), settings.nms_iou)
        for r in regions:
            if r == "mission" and target is None:
                units[c, r].append(Matched(np.zeros(0), np.zeros(0, bool), 0))
            else:
                units[c, r].append(match(placed, there[e.ego], discs[r, e.ego]))
    return _Row(target or (np.nan, np.nan), units, cost)
