"""Figures of the mission as a whole: who flew, and what of the region and the target the fleet saw.

Accuracy covers the drones that still fly. A fleet that loses drones may keep its accuracy and miss its mission, and these
figures show it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sortie.fleet.coverage import cameras_of
from sortie.perception.geometry import FULL, USUAL, Cameras, Lens, camera_margins
from sortie.perception.metrics.overlap import overlapping
from sortie.perception.scene.traffic import TARGET_SIZE_M, TargetPath
from sortie.scenarios.frames import instant, instants
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.section import Flown, OutcomeSection, Seconds, Share, figure
from sortie.sim.results.spool import batches, in_blocks

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LOOK_S = 1.0
"""The region is sampled this often, and a drone's look counts for so long: at 5 m/s it has moved by a tenth of its nadir
picture."""
PLACES = 400
"""Places in the region, spread evenly; each stands for a 400th of its area."""
FOUND_IOU = 0.5
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
BLOCK_FRAMES = 512
"""Frames worked out at once."""


class MissionOutcome(OutcomeSection):
    flown_share: Share = figure("Share of drone-seconds flown, without ground stations: 1 where all fly to the end.")
    region_observed_share: Share | None = figure(
        "Share of the mission region's area in view, averaged over the time in which there is a region. A place is in "
        "view where it lies in the picture of one of the five cameras of a drone, on flat ground without houses and "
        "trees, and in the square of the drone's feature map. The drone flies, and its perception ran within the last "
        "second."
    )
    target_in_view_share: Share | None = figure("Share of phase `track` with the target's place in view, as above.")
    target_longest_out_of_view_s: Seconds | None = figure("Longest gap in phase `track`: the target is in no view.")
    target_detected_share: Share | None = figure(
        "Share of the time of phase `track` in which a box of at least one drone overlaps the target with an IoU of at "
        "least 0.5. Each scored instant stands for its scoring period. Null where drones take turns at being scored: a "
        "drone that is not scored may have the target."
    )
    target_longest_undetected_s: Seconds | None = figure("Longest gap in phase `track`: the target is in no box.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, float | None]:
        record, n = flown.record, flown.scenario.fleet.drones
        t_s, flying, looked = _flown(record.tables, n)
        width_s = np.diff(t_s, append=record.scenario.duration_s)
        looking = flying & _lately(looked, _frames_a_look(record))
        groups = _groups(record.tables["mission"])
        tracks = _tracked(groups, len(t_s))
        in_view, region_share = _seen(record, groups, tracks, looking, t_s)
        tracked = {k: now for k, (_, now) in tracks.items()}
        in_view_share, out_of_view_s = _share_and_gap((in_view[k], now, width_s) for k, now in tracked.items())
        detected_share, undetected_s = _detected(record, t_s, tracked)
        in_the_air = np.delete(flying, [station.drone for station in record.scenario.fleet.ground], axis=1)
        return {
            "flown_share": _flown_share(in_the_air, width_s),
            "region_observed_share": region_share,
            "target_in_view_share": in_view_share,
            "target_longest_out_of_view_s": out_of_view_s,
            "target_detected_share": detected_share,
            "target_longest_undetected_s": undetected_s,
        }


def _flown_share(flying: Bools, width_s: Floats) -> float:
    """Share of drone-seconds flown, of [T, n]; 1 where nobody is to fly."""
    every_s = float((width_s * flying.shape[1]).sum())
    return float((width_s * flying.sum(axis=1)).sum()) / every_s if every_s else 1.0


def _flown(tables: Mapping[str, pa.Table], n: int) -> tuple[Floats, Bools, Bools]:
    """When the frames began [T], and of each drone whether it flew and whether its perception ran [T, N].

    A frame's rows say how often it had run before. So what it did in the last frame is not known: the one before stands
    for it.
    """
    parts, before = [], np.zeros((0, n), np.int32)
    for piece in in_blocks(tables, "states", ["t_s", "airborne", "looks"], n * BLOCK_FRAMES):
        flying, looks = (np.reshape(piece[c].to_numpy(), (-1, n)) for c in ("airborne", "looks"))
        parts.append((piece["t_s"].to_numpy()[::n], flying, np.diff(np.concatenate([before, looks]), axis=0) > 0))
        before = looks[-1:]
    t_s, flying, looked = (np.concatenate(each) for each in zip(*parts, strict=True))
    last = looked[-1:] if len(looked) else np.ones((len(t_s), n), bool)
    return t_s, flying, np.concatenate([looked, last])


def _frames_a_look(record: SortieRecord) -> int:
    return max(1, round(LOOK_S / record.scenario.frame_s))


def _groups(missions: pa.Table) -> list[pa.Table]:
    """The table `mission` by group of drones."""
    return [missions.filter(pc.equal(missions["group"], g)) for g in pc.unique(missions["group"]).to_pylist()]


def _tracked(groups: Sequence[pa.Table], frames: int) -> dict[int, tuple[Floats, Bools]]:
    """Every target that a group tracks at some time: where it is [T, 2], and when a group tracks it [T]."""
    out: dict[int, tuple[Floats, Bools]] = {}
    for rows in groups:
        target, tracking = rows["target"].to_numpy(), np.array(rows["phase"].to_pylist()) == "track"
        xy_m = np.stack([rows[c].to_numpy() for c in ("target_x_m", "target_y_m")], axis=-1)
        for k in np.unique(target[tracking & (target >= 0)]).tolist():
            now = tracking & (target == k)
            where, when = out.setdefault(k, (np.full((frames, 2), np.nan), np.zeros(frames, bool)))
            where[now] = xy_m[now]
            when |= now
    return out


def sees_ground(xy_m: Floats, position_m: Floats, orientation_xyzw: Floats, lens: Lens = USUAL.lens) -> Bools:
    """Which places on the ground lie in the picture of one of a drone's five cameras.

    The ground is flat, and nothing hides a place. Places outside the square that the drone's feature map covers do not
    count, because no detection comes from there.

    Args:
        xy_m: [T, P, 2] places at T instants, ENU.
        position_m: [T, 3] the drone, ENU.
        orientation_xyzw: [T, 4] its attitude, FLU in ENU.
        lens: of its cameras, numbers or arrays [T, 1].

    Returns:
        [T, P].
    """
    turn = Rotation.from_quat(orientation_xyzw).as_matrix()  # body to world
    away = xy_m - position_m[:, None, :2]
    drop = np.broadcast_to(-position_m[:, None, 2:], (*away.shape[:2], 1))
    body = np.concatenate([away, drop], axis=-1) @ turn
    seen = np.maximum(*camera_margins(body[..., 0], body[..., 1], body[..., 2], lens)) > 0.0
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])[:, None]
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead, left = cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]
    inside: Bools = (np.abs(ahead) < FULL.half_extent_m) & (np.abs(left) < FULL.half_extent_m)
    inside &= seen
    return inside


def _in_any_view(xy_m: Floats, pose: Floats, looking: Bools, cameras: Sequence[Cameras]) -> Bools:
    """Which places [T, P, 2] at least one drone sees: [T, P]; `pose` [T, N, 7], `looking` [T, N]."""
    seen = np.zeros(xy_m.shape[:2], bool)
    for drone in range(pose.shape[1]):
        at = np.flatnonzero(looking[:, drone])
        if len(at):
            seen[at] |= sees_ground(xy_m[at], pose[at, drone, :3], pose[at, drone, 3:], cameras[drone].lens)
    return seen


def _seen(
    record: SortieRecord,
    groups: Sequence[pa.Table],
    tracks: Mapping[int, tuple[Floats, Bools]],
    looking: Bools,
    t_s: Floats,
) -> tuple[dict[int, Bools], float | None]:
    """Whether each target was in view in each frame [T], and the share of the mission regions' area that was: averaged over
    regions and the time in which there are any."""
    n, every, cameras = looking.shape[1], _frames_a_look(record), cameras_of(record.scenario.fleet)
    in_view = {k: np.zeros(len(looking), bool) for k in tracks}
    discs = [np.stack([rows[f"region_{c}"].to_numpy() for c in ("x_m", "y_m", "radius_m")], axis=-1) for rows in groups]
    shares: list[list[Floats]] = [[] for _ in groups]
    frames = every * -(-BLOCK_FRAMES // every)  # each block begins with a frame in which the region is sampled
    for k, piece in enumerate(in_blocks(record.tables, "states", POSE, n * frames)):
        pose = np.stack([piece[c].to_numpy() for c in POSE], axis=-1).reshape(-1, n, len(POSE))
        here = slice(k * frames, k * frames + len(pose))
        for target, (xy_m, tracked) in tracks.items():
            wanted = looking[here] & tracked[here, None]
            in_view[target][here] = _in_any_view(xy_m[here, None], pose, wanted, cameras)[:, 0]
        for disc, share in zip(discs, shares, strict=True):
            disc = disc[here][::every]
            there = ~np.isnan(disc[:, 2])
            if there.any():
                share.append(_disc_in_view(disc[there], pose[::every][there], looking[here][::every][there], cameras))
    seconds_s = np.diff(t_s[::every], append=record.scenario.duration_s)
    observed = lasts_s = 0.0
    for disc, share in zip(discs, shares, strict=True):
        if share:
            there = ~np.isnan(disc[::every, 2])
            observed += float(np.concatenate(share) @ seconds_s[there])
            lasts_s += float(seconds_s[there].sum())
    return in_view, observed / lasts_s if lasts_s else None


def _disc_in_view(disc: Floats, pose: Floats, looking: Bools, cameras: Sequence[Cameras]) -> Floats:
    """Share of a disc [T, 3] that is in a drone's view: [T]."""
    k = np.arange(PLACES) + 0.5  # a sunflower's seeds: equal areas, and no row of them along a camera's edge
    turn, out = k * np.pi * (3.0 - math.sqrt(5.0)), np.sqrt(k / PLACES)
    seeds = np.stack([out * np.cos(turn), out * np.sin(turn)], axis=-1)
    places = disc[:, None, :2] + disc[:, None, 2:] * seeds
    share: Floats = _in_any_view(places, pose, looking, cameras).mean(axis=1)
    return share


def _detected(record: SortieRecord, frame_s: Floats, tracked: dict[int, Bools]) -> tuple[float | None, float | None]:
    """Share of the scoring periods in which a drone's boxes hold the target, and the longest time without."""
    scenario = record.scenario
    if record.detector == "none" or not tracked or scenario.takes_turns:  # then boxes of the others may hold it
        return None, None
    scored_s = np.array(scenario.scored_frames) * scenario.frame_s + scenario.perception.fusion_delay_s
    periods_s = np.array([period.start for period in scenario.scoring_periods]) * scenario.frame_s
    flown = instants(scored_s) < instant(scenario.duration_s)
    scored_s, lasts_s = scored_s[flown], np.diff(periods_s, append=scenario.duration_s)[flown]
    size_m = TARGET_SIZE_M[:2]
    paths = {k: TargetPath.of(scenario.mission.targets[k]) for k in tracked}
    truths = {
        k: np.array([(x, y, *size_m, yaw) for x, y, yaw in map(path.pose, scored_s.tolist())]).reshape(-1, 5)
        for k, path in paths.items()
    }
    hit = {k: np.zeros(len(scored_s), bool) for k in tracked}
    for batch in batches(record.tables, "detections", ("t_s", "x_m", "y_m", "length_m", "width_m", "yaw_rad")):
        if not batch.num_rows:
            continue
        at_s, *box = (column.to_numpy() for column in batch.columns)
        found, of = np.stack(box, axis=-1), np.searchsorted(instants(scored_s), instants(at_s))
        here = slice(int(of.min()), int(of.max()) + 1)
        for k, truth in truths.items():
            _, which, iou = overlapping(found, truth[here], of, np.arange(len(scored_s))[here])
            hit[k][here][which[iou >= FOUND_IOU]] = True
    frame = np.searchsorted(instants(frame_s), instants(scored_s), side="right") - 1
    return _share_and_gap((hit[k], now[frame], lasts_s) for k, now in tracked.items())


def _share_and_gap(targets: Iterable[tuple[Bools, Bools, Floats]]) -> tuple[float | None, float | None]:
    """Share of the counted time that targets are seen, and the longest unbroken time that one is counted and not seen.

    Args:
        targets: of each whether it is seen and whether that counts [T] at instants that follow each other, and for how
            long each instant stands [T].
    """
    missed_s = counted_s = longest_s = 0.0
    for seen, counted, width_s in targets:
        missed, run_s = counted & ~seen, 0.0
        missed_s += float(width_s[missed].sum())
        counted_s += float(width_s[counted].sum())
        for miss, lasts_s in zip(missed.tolist(), width_s.tolist(), strict=True):
            run_s = run_s + lasts_s if miss else 0.0
            longest_s = max(longest_s, run_s)
    return (1.0 - missed_s / counted_s, longest_s) if counted_s else (None, None)


def _lately(looked: Bools, frames: int) -> Bools:
    """Whether something was so in a frame, or in one of the `frames` - 1 frames before it: [T, N]."""
    lately = looked.copy()
    for back in range(1, min(frames, len(looked))):
        lately[back:] |= looked[:-back]
    return lately
