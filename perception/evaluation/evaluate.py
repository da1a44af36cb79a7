"""Evaluate conditions over frames: each ego's boxes under each way of sharing, matched to ground truth. Free of torch.

Scores are kept down to a low floor, and a threshold τ is applied afterwards (`Evaluation.at`): suppression and
matching go best first, so a box below τ affects only boxes below τ.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from sortie.perception.budget import cells_in
from sortie.perception.errors import InputError
from sortie.perception.evaluation import selection
from sortie.perception.evaluation.condition import Sharing
from sortie.perception.evaluation.contract import Exchange, FleetFrames, Floats, FrameView, Instrument
from sortie.perception.evaluation.matched import (
    FLOOR,
    Evaluation,
    FrameResult,
    MatchedStore,
    Region,
    Settings,
    assemble,
)
from sortie.perception.geometry import CELLS, Geometry, to_world
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import CONVENTIONS, Matched, best_first, best_pairs, hits, suppressed
from sortie.perception.metrics.overlap import overlapping
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc
from sortie.scenarios.streams import stream

__all__ = ["FLOOR", "REGION_M", "Evaluation", "Region", "Settings", "evaluate", "mission_target", "truth"]

T = TypeVar("T")
REGION_M = 32.0
"""Radius of the mission's disc, and of the one around the ego."""
IOU = 0.5
FLUSH_FRAMES = 4
"""Finished frames that are lost when the process is killed, at most; an exception loses none."""


def evaluate(
    instrument: Instrument,
    frames: FleetFrames,
    conditions: Sequence[Sharing],
    *,
    regions: Sequence[Region] = ("full", "mission"),
    egos: int = 5,
    floor: float = FLOOR,
    convention: str = "rotated",
    seed: int = 0,
    store: Path | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Every ego of every frame under every condition.

    Args:
        instrument, frames: a model and what it looks at.
        conditions: duplicates are evaluated once, and so are those that differ in nothing (`Sharing.plain`).
        regions: full: every car in the ego's square; mission: 32 m around the frame's target; ego: around the ego.
        egos: how many drones of each frame are egos, the first ones.
        floor: the lowest score that is kept.
        convention: a name of `ap.CONVENTIONS`: how boxes are matched and AP is worked out.
        seed: of targets and random peers.
        store: a folder for finished frames, so that a later call goes on where this one ended.
        workers: frames worked on side by side, each in one thread. The numbers do not depend on it.
        progress: called with frames done and frames in all.

    Raises:
        InputError: an unknown region or convention, more egos than drones, or a condition that does not fit the fleet.
    """
    drones = frames.est_pose.shape[1]
    if not 1 <= egos <= drones:
        raise InputError(f"egos is {egos}, must be 1 to the {drones} drones of a frame")
    for region in regions:
        if region not in get_args(Region):
            raise InputError(f"region is {region!r}, must be {' or '.join(get_args(Region))}")
    if convention not in CONVENTIONS:
        raise InputError(f"convention is {convention!r}, must be {' or '.join(CONVENTIONS)}")
    conditions = tuple(dict.fromkeys(conditions))
    settings = Settings(egos, floor, convention, seed)
    plain = {c: c.plain(drones) for c in conditions}
    todo = tuple(dict.fromkeys(plain.values()))
    keys = frame_keys(frames)
    kept = None if store is None else MatchedStore(store, instrument.fingerprint, settings, regions)

    def task(f: int) -> tuple[str, FrameResult]:
        name = "" if kept is None else frame_hash(frames, f, keys[f])
        known = None if kept is None else kept.get(name)
        missing = [c for c in todo if known is None or c not in known.cost]
        if known is not None and not missing:
            return name, known
        return name, _frame(instrument, frames, f, keys[f], missing, regions, settings)

    results: list[FrameResult] = []
    try:
        for name, found in in_order(task, len(keys), workers, getattr(instrument, "start_worker", None)):
            results.append(found if kept is None else kept.add(name, found))
            if kept is not None and len(results) % FLUSH_FRAMES == 0:
                kept.flush()
            if progress is not None:
                progress(len(results), len(keys))
    finally:
        if kept is not None:
            kept.flush()
    return assemble(results, conditions, regions, settings, np.asarray(frames.scene), plain)


def in_order(task: Callable[[int], T], count: int, workers: int, start: Callable[[], None] | None) -> Iterator[T]:
    """task(0), task(1), … by so many threads, never more than twice as many ahead as there are threads."""
    if workers <= 1:
        yield from map(task, range(count))
        return
    with ThreadPoolExecutor(workers, "evaluate", initializer=start) as pool:
        ahead: list[Future[T]] = []
        try:
            for f in range(count):
                ahead.append(pool.submit(task, f))
                if len(ahead) == 2 * workers:
                    yield ahead.pop(0).result()
            while ahead:
                yield ahead.pop(0).result()
        finally:
            for future in ahead:
                future.cancel()


def frame_keys(frames: FleetFrames) -> list[tuple[int, int]]:
    """(scene, number within the scene) of each frame: what its random draws are keyed by, whatever else is evaluated."""
    seen: dict[int, int] = {}
    out = []
    for scene in np.asarray(frames.scene).tolist():
        seen[scene] = seen.get(scene, -1) + 1
        out.append((int(scene), seen[scene]))
    return out


def frame_hash(frames: FleetFrames, f: int, key: tuple[int, int]) -> str:
    """A frame by its content and its key; `images` count where there are any, and which of a recording it is (`index`)."""
    digest = hashlib.blake2b(repr(key).encode(), digest_size=16)
    for name in ("true_pose", "est_pose", "cars", "images", "index"):
        if hasattr(frames, name):
            part = np.ascontiguousarray(getattr(frames, name)[f])
            if name == "cars":  # padded to the fullest frame that it was loaded with
                part = part[~np.isnan(part[:, 0])]
            digest.update(part.tobytes())
    return digest.hexdigest()


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
    """The cars in the ego's true square in frame `f`."""
    return ground_truth(frames.cars[f], frames.true_pose[f, ego], geometry.half_extent_m)


def exchanges(
    view: FrameView,
    frames: FleetFrames,
    f: int,
    key: tuple[int, int],
    conditions: Sequence[Sharing],
    settings: Settings,
    geometry: Geometry,
    target: tuple[float, float] | None,
) -> list[tuple[Exchange, list[int]]]:
    """For every condition and ego in turn: what is exchanged, and how many cells each of its peers sends."""
    est = frames.est_pose[f]
    drones = len(est)
    overlap = selection.footprint_overlap(est[:, :2], np.full(drones, selection.FOOTPRINT_M))
    roi = None if target is None else selection.in_disc(est, Disc(*target, REGION_M), geometry)
    orders: dict[tuple[str, bool], NDArray[np.int16]] = {}
    out = []
    for c in conditions:
        total = cells_in(c.received_budget, drones - 1)
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
            if c.absent == "zeros":
                rest = tuple(i for i in range(drones) if i != ego and i not in peers)
                peers, count = (*peers, *rest), [*count, *[0] * len(rest)]
                sent = np.concatenate([sent, np.zeros((len(rest), CELLS, CELLS), np.bool_)])
            out.append((Exchange(ego, peers, sent, c.unsent), count))
    return out


def _frame(
    instrument: Instrument,
    frames: FleetFrames,
    f: int,
    key: tuple[int, int],
    conditions: Sequence[Sharing],
    regions: Sequence[Region],
    settings: Settings,
) -> FrameResult:
    view = instrument.look(frames, f)
    target = mission_target(frames, f, key, settings.seed)
    given = exchanges(view, frames, f, key, conditions, settings, instrument.geometry, target)
    local = view.detect([e for e, _ in given], settings.floor)
    there = [truth(frames, f, ego, instrument.geometry).table() for ego in range(settings.egos)]
    discs: dict[Region, Floats | None] = {
        "full": None,
        "ego": frames.true_pose[f, : settings.egos, :2],
        "mission": np.tile(target or (np.inf, np.inf), (settings.egos, 1)),
    }
    ego_of = np.array([e.ego for e, _ in given])
    matched = match_all(local, ego_of, frames.est_pose[f], there, {r: discs[r] for r in regions}, settings)
    cost: dict[Sharing, list[tuple[int, int, int]]] = {}
    units: dict[tuple[Sharing, Region], list[Matched]] = {}
    for n, c in enumerate(conditions):
        these = slice(n * settings.egos, (n + 1) * settings.egos)
        cost[c] = [(sum(count), *selection.link_bytes(count)) for _, count in given[these]]
        for r in regions:
            units[c, r] = matched[r][these]
    return FrameResult(target or (np.nan, np.nan), units, cost)


def match_all(
    local: Sequence[Floats],
    ego_of: NDArray[np.int64],
    est_pose: Floats,
    there: Sequence[Floats],
    discs: dict[Region, Floats | None],
    settings: Settings,
) -> dict[Region, list[Matched]]:
    """Many images of one frame at once: put boxes into the world, suppress, match in every region.

    Args:
        local: boxes [m, 6] of each image in its ego's estimated frame; ego_of: [images] which ego's.
        est_pose: [drones, 3]; there: each ego's cars [m, 5].
        discs: by region the discs' centres [egos, 2], or None for everything.
    """
    convention = CONVENTIONS[settings.convention]
    image = np.repeat(np.arange(len(local)), [len(boxes) for boxes in local])
    boxes = np.concatenate([np.zeros((0, 6)), *local])
    order = best_first(boxes[:, :5], boxes[:, 5], image)
    boxes, image = boxes[order], image[order]
    pose = est_pose[ego_of[image]].T
    world = np.stack(
        [*to_world(boxes[:, 0], boxes[:, 1], pose), boxes[:, 2], boxes[:, 3], boxes[:, 4] + pose[2]], axis=1
    )
    left = suppressed(world, np.arange(len(world)), image, settings.nms_iou)
    world, image = world[left], image[left]
    score = boxes[left, 5].astype(np.float32).astype(np.float64)  # as it is stored

    cars = np.concatenate([np.zeros((0, 5)), *there])
    cars_of = np.repeat(np.arange(len(there)), [len(t) for t in there])
    ego = ego_of[image]
    i, j, value = overlapping(world, cars, ego, cars_of, convention.overlap)
    good = value >= IOU
    i, j, value = i[good], j[good], value[good]
    order = best_pairs(world[i], score[i], cars[j], value)
    i, j = i[order], j[order]
    out: dict[Region, list[Matched]] = {}
    for region, centre in discs.items():
        found, real = np.ones(len(world), bool), np.ones(len(cars), bool)
        if centre is not None:
            found = np.hypot(*(world[:, :2] - centre[ego]).T) <= REGION_M
            real = np.hypot(*(cars[:, :2] - centre[cars_of]).T) <= REGION_M
        both = found[i] & real[j]
        # every image has cars of its own
        hit = hits(len(world), i[both], j[both] + image[i[both]] * len(cars), convention.match)
        truths = np.bincount(cars_of[real], minlength=len(there))
        ends = np.searchsorted(image[found], np.arange(1, len(local)))
        scores, found_hits = np.split(score[found], ends), np.split(hit[found], ends)
        out[region] = [
            Matched(a, b, int(truths[e])) for a, b, e in zip(scores, found_hits, ego_of.tolist(), strict=True)
        ]
    return out
