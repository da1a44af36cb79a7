"""Evaluate ways of sharing over frames: each ego's boxes, matched to ground truth, as one `Evaluation`. Free of torch.

Scores are kept down to a low floor, and a threshold τ is applied afterwards (`Evaluation.at`). Suppression and matching
begin with the best box, so a box below τ affects only boxes below τ.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sortie.perception.code_digest import boxes_digest
from sortie.perception.errors import InputError
from sortie.perception.evaluation.sharing import (
    CELL_BYTES,
    FOOTPRINT_M,
    Exchange,
    Floats,
    FrameView,
    Rank,
    Sharing,
    footprint_overlap,
    in_disc,
    link_bytes,
    sending_order,
)
from sortie.perception.geometry import CELLS, Geometry, to_world
from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import NMS_IOU
from sortie.perception.metrics.ap import CONVENTIONS, Matched, average_precision, judge, ranks, suppressed
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc
from sortie.scenarios.regular import regular
from sortie.scenarios.replacing import replacing
from sortie.scenarios.streams import stream

Ints = NDArray[np.int64]
Key = tuple[int, int]
"""Scene, and number within the scene: what the random draws of a frame are keyed by."""
Region = Literal["full", "mission", "ego"]
By = Literal["frame", "scene"]
FLOOR = 0.01
REGION_M = 32.0
"""Radius of the mission's disc, and of the one around the ego."""


class FleetFrames(Protocol):
    """n fleet-frames of d drones: their poses and the cars."""

    @property
    def true_pose(self) -> Floats:
        """[n, d, 3] x, y, yaw, ENU."""

    @property
    def est_pose(self) -> Floats:
        """[n, d, 3] as the drones believed."""

    @property
    def cars(self) -> Floats:
        """[n, m, 5] x, y, length, width, yaw of every car, NaN-padded."""

    @property
    def scene(self) -> Ints:
        """[n] the scene of each frame."""


class Instrument(Protocol):
    """A model with its weights."""

    @property
    def fingerprint(self) -> str:
        """A hash of everything that the boxes depend on, except the frames and the exchange."""

    @property
    def geometry(self) -> Geometry:
        """Its grids; the cars in the ego's square of that size are the ground truth."""

    def look(self, frames: FleetFrames, frame: int) -> FrameView:
        """Look at one fleet-frame; what conditions have in common is computed once."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings that the results depend on, beside instrument, frames and condition."""

    egos: int = 5
    """The first so many drones of a frame are egos."""
    floor: float = FLOOR
    """The lowest score that is kept."""
    convention: str = "rotated"
    """A name of `ap.CONVENTIONS`."""
    seed: int = 0
    """Of the mission's targets and of random peers."""
    nms_iou: float = NMS_IOU
    cell_bytes: int = CELL_BYTES
    """Payload of one cell."""
    regions: tuple[Region, ...] = ("full", "mission")
    """full: every car in the ego's square; mission: 32 m around the frame's target; ego: 32 m around the ego."""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame under some conditions, each by its label."""

    target: tuple[float, float]
    """Centre of the mission's disc; NaN where there is none."""
    units: Mapping[tuple[str, Region], Sequence[Matched]]
    """One for each ego."""
    cost: Mapping[str, Sequence[tuple[int, int, int]]]
    """For each ego: cells received, their bytes, and the bytes that say which cells they are."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """n frames × `egos` under every condition. A unit is one ego of one frame, frame by frame."""

    conditions: tuple[Sharing, ...]
    settings: Settings
    scene: Ints
    """[n]"""
    target: Floats
    """[n, 2] centre of the mission's disc; NaN where the frame has none and does not count for the mission."""
    units: Mapping[tuple[Sharing, Region], Sequence[Matched]]
    """One `Matched` per unit [n · egos]."""
    cells: Mapping[Sharing, Ints]
    """[n · egos] cells received by the unit, from all peers."""
    payload_bytes: Mapping[Sharing, Ints]
    """[n · egos] the bytes of these cells."""
    index_bytes: Mapping[Sharing, Ints]
    """[n · egos] which cells they are, counted apart."""

    def at(self, tau: float) -> Evaluation:
        """The same without boxes below `tau`.

        Raises:
            InputError: below the floor, where boxes were not kept.
        """
        if not tau >= self.settings.floor:  # NaN is neither
            raise InputError(f"tau is {tau}, must be at least the floor {self.settings.floor}")
        cut = {key: [m.at(tau) for m in several] for key, several in self.units.items()}
        return replace(self, units=cut, settings=replace(self.settings, floor=tau))

    def counts(self, region: Region) -> NDArray[np.bool_]:
        """[n · egos]: the units that count in a region; for the mission those of frames that have a target."""
        every = np.ones(len(self.scene), bool) if region != "mission" else ~np.isnan(self.target[:, 0])
        return np.repeat(every, self.settings.egos)

    def matched(self, condition: Sharing, region: Region = "full") -> list[Matched]:
        """The units that count, in order."""
        several = self.units[condition, region]
        return [several[i] for i in np.flatnonzero(self.counts(region)).tolist()]

    def groups(self, region: Region = "full", by: By = "frame") -> Ints:
        """A label for each unit of `matched`: a bootstrap draws the units of one frame, or of one scene, together."""
        label = np.arange(len(self.scene)) if by == "frame" else self.scene
        return np.repeat(label, self.settings.egos)[self.counts(region)]

    def ap(self, condition: Sharing, region: Region = "full") -> float:
        """AP@0.5 over the units that count, in the convention of the settings."""
        return average_precision(self.matched(condition, region), CONVENTIONS[self.settings.convention])

    @property
    def resampled(self) -> By:
        """What `gain` resamples: scenes, because frames of one scene are alike; frames where there is one scene."""
        return "scene" if len(np.unique(self.scene)) > 1 else "frame"

    def gain(self, condition: Sharing, over: Sharing, region: Region = "full") -> Difference:
        """AP of `condition` minus AP of `over`, with its paired 95 % interval: both get the same resamples.

        Raises:
            InputError: the convention is not `rotated`, the only one that the bootstrap computes.
        """
        if self.settings.convention != "rotated":
            raise InputError(f"convention is {self.settings.convention!r}, must be 'rotated' to be resampled")
        groups = self.groups(region, self.resampled)
        return compare(self.matched(over, region), self.matched(condition, region), groups)

    def save(self, path: Path) -> None:
        """Write everything as one Parquet file, under a temporary name first."""
        facts = {
            "settings": asdict(self.settings),
            "scene": self.scene.tolist(),
            "conditions": [c.label for c in self.conditions],
        }
        write_frames(path, {f"{f:06d}": self._frame(f) for f in range(len(self.scene))}, facts)

    @classmethod
    def load(cls, path: Path) -> Evaluation:
        """Read what `save` wrote.

        Raises:
            InputError: no such file, or not one of these; the message names it.
        """
        try:
            results, facts = read_frames(path)
            frames = [results[f"{f:06d}"] for f in range(len(facts["scene"]))]
            conditions = [Sharing.parse(label) for label in facts["conditions"]]
            settings = facts["settings"] | {"regions": tuple(facts["settings"]["regions"])}
            return assemble(frames, conditions, Settings(**settings), facts["scene"])
        except (OSError, pa.ArrowInvalid, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not an evaluation of this project ({error!r})") from None

    def _frame(self, f: int) -> FrameResult:
        these = slice(f * self.settings.egos, (f + 1) * self.settings.egos)
        costs = (self.cells, self.payload_bytes, self.index_bytes)
        return FrameResult(
            (float(self.target[f, 0]), float(self.target[f, 1])),
            {(c.label, region): several[these] for (c, region), several in self.units.items()},
            {c.label: list(zip(*(cost[c][these].tolist() for cost in costs), strict=True)) for c in self.conditions},
        )


def assemble(
    frames: Sequence[FrameResult], conditions: Sequence[Sharing], settings: Settings, scene: Sequence[int] | Ints
) -> Evaluation:
    """Frames in order as one evaluation."""
    cost = {c: [ego for frame in frames for ego in frame.cost[c.label]] for c in conditions}
    table = {c: np.array(rows, np.int64).reshape(-1, 3) for c, rows in cost.items()}
    return Evaluation(
        tuple(conditions),
        settings,
        np.asarray(scene, np.int64),
        np.array([frame.target for frame in frames], np.float64).reshape(-1, 2),
        {
            (c, r): [m for frame in frames for m in frame.units[c.label, r]]
            for c in conditions
            for r in settings.regions
        },
        *({c: rows[:, i] for c, rows in table.items()} for i in range(3)),
    )


Each = Callable[[Callable[[int], FrameResult], Iterable[int]], Iterable[FrameResult]]


def evaluate(
    instrument: Instrument,
    frames: FleetFrames,
    conditions: Sequence[Sharing],
    settings: Settings = Settings(),
    *,
    store: Path | None = None,
    each: Each = map,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Every ego of every frame under every condition.

    Args:
        conditions: duplicates are evaluated once.
        store: a folder for finished frames, so that a later call goes on where this one ended.
        each: applies a function to every frame's number, in order: `map`, or the `map` of a pool of threads.
        progress: called with frames done and frames in all.

    Raises:
        InputError: an unknown region or convention, more egos than drones, or a condition that does not fit the fleet.
    """
    drones = frames.est_pose.shape[1]
    if not 1 <= settings.egos <= drones:
        raise InputError(f"egos is {settings.egos}, must be 1 to the {drones} drones of a frame")
    for region in settings.regions:
        if region not in get_args(Region):
            raise InputError(f"region is {region!r}, must be {' or '.join(get_args(Region))}")
    if settings.convention not in CONVENTIONS:
        raise InputError(f"convention is {settings.convention!r}, must be {' or '.join(CONVENTIONS)}")
    conditions = tuple(dict.fromkeys(conditions))
    keys = frame_keys(frames)
    kept = None if store is None else MatchedStore(store, instrument.fingerprint, settings)

    def task(f: int) -> FrameResult:
        name = frame_hash(frames, f, keys[f])
        known = None if kept is None else kept.read(name)
        missing = [c for c in conditions if known is None or c.label not in known.cost]
        if known is not None and not missing:
            return known
        new = _frame(instrument, frames, f, keys[f], missing, settings)
        return new if kept is None else kept.add(name, known, new)

    results: list[FrameResult] = []
    for found in each(task, range(len(keys))):
        results.append(found)
        if progress is not None:
            progress(len(results), len(keys))
    return assemble(results, conditions, settings, frames.scene)


def frame_keys(frames: FleetFrames) -> list[Key]:
    """The key of each frame."""
    seen: dict[int, int] = {}
    out = []
    for scene in np.asarray(frames.scene).tolist():
        seen[scene] = seen.get(scene, -1) + 1
        out.append((int(scene), seen[scene]))
    return out


def frame_hash(frames: FleetFrames, f: int, key: Key) -> str:
    """A frame by its content and its key; `images` count where there are any, and the `index` of a recorded frame."""
    digest = hashlib.blake2b(repr(key).encode(), digest_size=16)
    for name in ("true_pose", "est_pose", "cars", "images", "index"):
        if hasattr(frames, name):
            part = np.ascontiguousarray(getattr(frames, name)[f])
            if name == "cars":  # padded to the fullest frame that it was loaded with
                part = part[~np.isnan(part[:, 0])]
            digest.update(part.tobytes())
    return digest.hexdigest()


def mission_target(frames: FleetFrames, f: int, key: Key, seed: int = 0) -> tuple[float, float] | None:
    """The car that the mission is about: one of those within a footprint's radius (42 m) of the fleet's true centre.

    Drawn evenly from the frame's own stream, before any model has looked; None where there is no such car.
    """
    cars = frames.cars[f][~np.isnan(frames.cars[f][:, 0]), :2]
    near = cars[np.hypot(*(cars - frames.true_pose[f][:, :2].mean(axis=0)).T) <= FOOTPRINT_M]
    if not len(near):
        return None
    x, y = near[int(stream(seed, 0, key, "harness.mission_target").integers(len(near)))]
    return float(x), float(y)


def truth(frames: FleetFrames, f: int, ego: int, geometry: Geometry) -> Boxes:
    """The cars in the ego's true square in frame `f`."""
    return ground_truth(frames.cars[f], frames.true_pose[f, ego], geometry.half_extent_m)


def exchanges(
    view: FrameView,
    frames: FleetFrames,
    f: int,
    key: Key,
    conditions: Sequence[Sharing],
    settings: Settings,
    geometry: Geometry,
    target: tuple[float, float] | None,
) -> list[tuple[Exchange, list[int]]]:
    """For every condition and ego in turn: what is exchanged, and how many cells each of its peers sends."""
    est = frames.est_pose[f]
    overlap = footprint_overlap(est[:, :2], np.full(len(est), FOOTPRINT_M))
    roi = None if target is None else in_disc(est, Disc(*target, REGION_M), geometry)
    orders: dict[tuple[Rank, bool], NDArray[np.int16]] = {}
    out = []
    for c in conditions:
        which = (c.rank, c.roi and roi is not None)
        for ego in range(settings.egos):
            count = c.cells_from(ego, overlap[ego], key, settings.seed)
            sent = np.zeros((len(count), CELLS, CELLS), np.bool_)
            if any(count.values()):
                if which not in orders:
                    orders[which] = sending_order(c.rank(view), roi if which[1] else None)
                sent = orders[which][list(count)] < np.array(list(count.values()))[:, None, None]
            out.append((Exchange(ego, tuple(count), sent, c.unsent), list(count.values())))
    return out


def _frame(
    instrument: Instrument, frames: FleetFrames, f: int, key: Key, conditions: Sequence[Sharing], settings: Settings
) -> FrameResult:
    view = instrument.look(frames, f)
    target = mission_target(frames, f, key, settings.seed)
    given = exchanges(view, frames, f, key, conditions, settings, instrument.geometry, target)
    local = view.detect([e for e, _ in given], settings.floor)
    there = [truth(frames, f, ego, instrument.geometry) for ego in range(settings.egos)]
    discs: dict[Region, Floats | None] = {
        "full": None,
        "ego": frames.true_pose[f, : settings.egos, :2],
        "mission": np.tile(target or (np.inf, np.inf), (settings.egos, 1)),
    }
    ego_of = np.array([e.ego for e, _ in given], np.int64)
    matched = match_all(local, ego_of, frames.est_pose[f], there, {r: discs[r] for r in settings.regions}, settings)
    costs = [(sum(count), *link_bytes(count, settings.cell_bytes)) for _, count in given]
    part = {c.label: slice(n * settings.egos, (n + 1) * settings.egos) for n, c in enumerate(conditions)}
    units = {(label, r): matched[r][these] for label, these in part.items() for r in settings.regions}
    cost = {label: costs[these] for label, these in part.items()}
    return FrameResult(target or (np.nan, np.nan), units, cost)


def match_all(
    local: Sequence[Floats],
    ego_of: Ints,
    est_pose: Floats,
    there: Sequence[Boxes],
    discs: Mapping[Region, Floats | None],
    settings: Settings,
) -> dict[Region, list[Matched]]:
    """Many images of one frame at once: put boxes into the world, suppress, match in every region.

    Args:
        local: boxes [m, 6] of each image in its ego's estimated frame; ego_of: [images] which ego's.
        est_pose: [drones, 3]; there: each ego's cars.
        discs: by region the discs' centres [egos, 2], or None for everything.
    """
    image = np.repeat(np.arange(len(local)), [len(boxes) for boxes in local])
    boxes = np.concatenate([np.zeros((0, 6)), *local])
    pose = est_pose[ego_of[image]].T
    xy = np.stack(to_world(boxes[:, 0], boxes[:, 1], pose), axis=1)
    found = Boxes(xy, boxes[:, 2:4], boxes[:, 4] + pose[2], boxes[:, 5].astype(np.float32))  # as it is stored
    left = suppressed(found.table(), ranks(boxes, boxes[:, 5], image), image, settings.nms_iou)
    found, image = found.take(left), image[left]
    truths = [there[ego] for ego in ego_of.tolist()]
    cars, cars_of = Boxes.join(truths), np.repeat(np.arange(len(truths)), [len(t) for t in truths])
    judged = judge(found, image, cars, cars_of, len(local), convention=CONVENTIONS[settings.convention])
    out: dict[Region, list[Matched]] = {}
    for region, centre in discs.items():
        if centre is None:
            out[region] = judged.matched()
        else:
            own = np.hypot(*(found.xy_m[judged.order] - centre[ego_of[judged.image]]).T) <= REGION_M
            out[region] = judged.matched(own, np.hypot(*(cars.xy_m - centre[ego_of[cars_of]]).T) <= REGION_M)
    return out


class MatchedStore:
    """Finished frames of one instrument under one set of settings, by one version of the code: a Parquet file each.

    A later evaluation takes from it what it needs, whichever conditions and frames the earlier ones were about.
    """

    def __init__(self, folder: Path, fingerprint: str, settings: Settings) -> None:
        what = json.dumps([boxes_digest(), fingerprint, asdict(settings)])
        self._folder = folder / hashlib.blake2b(what.encode(), digest_size=8).hexdigest()

    def read(self, name: str) -> FrameResult | None:
        """What is known of a frame.

        Raises:
            InputError: its file is broken; the message names it.
        """
        path = self._folder / f"{name}.parquet"
        try:
            return read_frames(path)[0].get(name)
        except FileNotFoundError:
            return None
        except (OSError, pa.ArrowInvalid, KeyError, ValueError) as error:
            raise InputError(f"{path}: not part of an evaluation ({error!r}); remove it to go on") from None

    def add(self, name: str, known: FrameResult | None, new: FrameResult) -> FrameResult:
        """Keep what was newly found of a frame beside what is known of it; all of it."""
        if known is not None:
            new = FrameResult(new.target, {**known.units, **new.units}, {**known.cost, **new.cost})
        write_frames(self._folder / f"{name}.parquet", {name: new}, {})
        return new


SCHEMA = pa.schema(
    [(name, pa.string()) for name in ("frame", "condition", "region")]
    + [("ego", pa.int32())]
    + [(name, pa.float64()) for name in ("target_x_m", "target_y_m")]
    + [(name, pa.int32()) for name in ("cells", "payload_bytes", "index_bytes", "truths")]
    + [("score", pa.list_(pa.float32())), ("hit", pa.list_(pa.bool_()))]
)
"""One row per frame, condition, region and ego."""


def write_frames(path: Path, frames: Mapping[str, FrameResult], facts: Mapping[str, Any]) -> None:
    """Some frames by key, and facts about them as JSON, as one Parquet file; under a temporary name first."""
    rows = [
        (key, label, region, ego, *frame.target, *cost, unit.truths, unit.score, unit.hit)
        for key, frame in frames.items()
        for (label, region), several in frame.units.items()
        for ego, (unit, cost) in enumerate(zip(several, frame.cost[label], strict=True))
    ]
    columns = zip(*rows, strict=True) if rows else ((),) * len(SCHEMA)
    arrays = [pa.array(column, kind) for column, kind in zip(columns, SCHEMA.types, strict=True)]
    table = pa.Table.from_arrays(arrays, schema=SCHEMA.with_metadata({"sortie": json.dumps(dict(facts))}))
    with replacing(path) as part:
        pq.write_table(table, part, compression="zstd")


def read_frames(path: Path) -> tuple[dict[str, FrameResult], dict[str, Any]]:
    """Read what `write_frames` wrote.

    Raises:
        Exception: OSError, pyarrow.ArrowInvalid, KeyError or ValueError where it is not such a file.
    """
    table = pq.read_table(regular(path))
    *plain, scores, hits = (table[name] for name in SCHEMA.names)
    rows = zip(*(column.to_pylist() for column in plain), scores.to_numpy(), hits.to_numpy(), strict=True)
    out: dict[str, FrameResult] = {}
    for key, label, region, ego, x, y, cells, payload, index, truths, score, hit in rows:
        frame: Any = out.get(key) or out.setdefault(key, FrameResult((x, y), {}, {}))
        frame.units.setdefault((label, region), []).append(Matched(score.astype(np.float64), hit, truths))
        cost = frame.cost.setdefault(label, [])
        if len(cost) == ego:  # repeated for each region
            cost.append((cells, payload, index))
    return out, json.loads(table.schema.metadata[b"sortie"])
