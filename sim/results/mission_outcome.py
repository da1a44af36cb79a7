"""Figures of the mission as a whole: who flew, and what of the region and the target the fleet saw.

Accuracy covers the drones that still fly. A fleet that loses drones may keep its accuracy and miss its mission, and these
figures show it. `sortie.sim.results.outcome_fields.MissionOutcome` defines each of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sortie.fleet.coverage import cameras_of
from sortie.perception.geometry import FULL, USUAL, Cameras, Lens, camera_margins
from sortie.perception.metrics.overlap import overlapping
from sortie.perception.scene.traffic import TARGET_SIZE_M, TargetPath
from sortie.sim.results.record import SortieRecord

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LOOK_S = 1.0
"""The region is sampled this often, and a drone's look counts for so long: at 5 m/s it has moved by a tenth of its nadir
picture."""
PLACES = 400
"""Places in the region, spread evenly; each stands for a 400th of its area."""
FOUND_IOU = 0.5
_INSTANT_S = 1e-6


def mission_outcome(record: SortieRecord) -> dict[str, float | None]:
    """The section `mission` of the outcome."""
    states, n = record.tables["states"], record.scenario.fleet.drones
    t_s = states["t_s"].to_numpy()[::n]
    width_s = np.diff(t_s, append=record.scenario.duration_s)
    flying = np.reshape(states["airborne"].to_numpy(zero_copy_only=False), (-1, n))
    looks = np.reshape(states["looks"].to_numpy(), (-1, n))
    looking = flying & _looked_lately(looks, max(1, round(LOOK_S / record.scenario.frame_s)))
    pose = np.stack([states[c].to_numpy() for c in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")], axis=-1)
    pose = pose.reshape(-1, n, 7)
    groups = _groups(record.tables["mission"])
    cameras = cameras_of(record.scenario.fleet)
    tracks = _tracked(groups, len(t_s))
    seen = []
    for target_xy_m, tracked in tracks.values():
        in_view = _in_any_view(target_xy_m[:, None], pose, looking & tracked[:, None], cameras)[:, 0]
        seen.append((in_view, tracked, width_s))
    in_view_share, out_of_view_s = _share_and_gap(seen)
    detected_share, undetected_s = _detected(record, t_s, {k: tracked for k, (_, tracked) in tracks.items()})
    return {
        "flown_share": 1.0 - float(width_s @ (~flying).sum(axis=1)) / (n * float(width_s.sum())),
        "region_observed_share": _region_observed(record, groups, t_s, pose, looking),
        "target_in_view_share": in_view_share,
        "target_longest_out_of_view_s": out_of_view_s,
        "target_detected_share": detected_share,
        "target_longest_undetected_s": undetected_s,
    }


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
    ahead = np.cos(yaw) * away[..., 0] + np.sin(yaw) * away[..., 1]
    left = np.cos(yaw) * away[..., 1] - np.sin(yaw) * away[..., 0]
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


def _region_observed(
    record: SortieRecord, groups: Sequence[pa.Table], t_s: Floats, pose: Floats, looking: Bools
) -> float | None:
    """Share of the mission regions' area that is in view, averaged over regions and the time in which there are any."""
    every = max(1, round(LOOK_S / record.scenario.frame_s))
    width_s = np.diff(t_s[::every], append=record.scenario.duration_s)
    cameras = cameras_of(record.scenario.fleet)
    shares = lasts_s = 0.0
    for rows in groups:
        disc = np.stack([rows[f"region_{c}"].to_numpy() for c in ("x_m", "y_m", "radius_m")], axis=-1)[::every]
        there = ~np.isnan(disc[:, 2])
        if there.any():
            seen = _disc_in_view(disc[there], pose[::every][there], looking[::every][there], cameras)
            shares += float(seen @ width_s[there])
            lasts_s += float(width_s[there].sum())
    return shares / lasts_s if lasts_s else None


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
    scenario, boxes = record.scenario, record.tables["detections"]
    if record.detector == "none" or not tracked:
        return None, None
    instants = np.array(scenario.scored_frames) * scenario.frame_s + scenario.perception.fusion_delay_s
    periods_s = np.array([period.start for period in scenario.scoring_periods]) * scenario.frame_s
    flown = instants < scenario.duration_s - _INSTANT_S
    instants, lasts_s = instants[flown], np.diff(periods_s, append=scenario.duration_s)[flown]
    columns = ("x_m", "y_m", "length_m", "width_m", "yaw_rad")
    found = np.stack([boxes[c].to_numpy() for c in columns], axis=-1)
    of = np.searchsorted(instants, boxes["t_s"].to_numpy() - _INSTANT_S)
    size_m, seen = TARGET_SIZE_M[:2], []
    frame = np.searchsorted(frame_s, instants + _INSTANT_S, side="right") - 1
    for k, now in tracked.items():
        path = TargetPath.of(scenario.mission.targets[k])
        truth = np.array([(x, y, *size_m, yaw) for x, y, yaw in map(path.pose, instants.tolist())]).reshape(-1, 5)
        _, which, iou = overlapping(found, truth, of, np.arange(len(instants)))
        hit = np.zeros(len(instants), bool)
        hit[which[iou >= FOUND_IOU]] = True
        seen.append((hit, now[frame], lasts_s))
    return _share_and_gap(seen)


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


def _looked_lately(looks: NDArray[np.int64], frames: int) -> Bools:
    """Whether a drone's perception ran in a frame, or in one of the `frames` - 1 frames before it: [T, N].

    Args:
        looks: [T, N] frames before this one in which it ran. What it did in the last frame is not in it: the one before
            stands for it.
        frames: how many a look is good for.
    """
    ran = np.diff(looks, axis=0, append=2 * looks[-1:] - looks[-2:-1] if len(looks) > 1 else looks[-1:] + 1)
    total = np.cumsum(np.concatenate([np.zeros_like(ran[:1]), ran]), axis=0)
    since = np.maximum(np.arange(1, len(ran) + 1) - frames, 0)
    return np.asarray(total[1:] > total[since])
