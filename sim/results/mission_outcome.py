"""Figures of the mission as a whole: who flew, and what of the region and the target the fleet saw.

Accuracy covers the drones that still fly. A fleet that loses drones may keep its accuracy and miss its mission, and these
figures show it. `sortie.sim.results.outcome_fields.MissionOutcome` defines each of them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sortie.perception.geometry import FULL, camera_margins
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
    mission, states, n = record.tables["mission"], record.tables["states"], record.scenario.fleet.drones
    t_s = mission["t_s"].to_numpy()
    width_s = np.diff(t_s, append=record.scenario.duration_s)
    flying = np.reshape(states["airborne"].to_numpy(zero_copy_only=False), (-1, n))
    looks = np.reshape(states["looks"].to_numpy(), (-1, n))
    looking = flying & _looked_lately(looks, max(1, round(LOOK_S / record.scenario.frame_s)))
    pose = np.stack([states[c].to_numpy() for c in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")], axis=-1)
    pose = pose.reshape(-1, n, 7)
    target = np.stack([mission[c].to_numpy() for c in ("target_x_m", "target_y_m")], axis=-1)
    tracked = np.array(mission["phase"].to_pylist()) == "track"
    tracked &= ~np.isnan(target[:, 0])
    in_view = _in_any_view(target[:, None], pose, looking & tracked[:, None])[:, 0]
    in_view_share, out_of_view_s = _share_and_gap(in_view, tracked, width_s)
    detected_share, undetected_s = _detected(record, t_s, tracked)
    return {
        "flown_share": 1.0 - float(width_s @ (~flying).sum(axis=1)) / (n * float(width_s.sum())),
        "region_observed_share": _region_observed(record, t_s, pose, looking),
        "target_in_view_share": in_view_share,
        "target_longest_out_of_view_s": out_of_view_s,
        "target_detected_share": detected_share,
        "target_longest_undetected_s": undetected_s,
    }


def sees_ground(xy_m: Floats, position_m: Floats, orientation_xyzw: Floats) -> Bools:
    """Which places on the ground lie in the picture of one of a drone's five cameras.

    The ground is flat, and nothing hides a place. Places outside the square that the drone's feature map covers do not
    count, because no detection comes from there.

    Args:
        xy_m: [T, P, 2] places at T instants, ENU.
        position_m: [T, 3] the drone, ENU.
        orientation_xyzw: [T, 4] its attitude, FLU in ENU.

    Returns:
        [T, P].
    """
    turn = Rotation.from_quat(orientation_xyzw).as_matrix()  # body to world
    away = xy_m - position_m[:, None, :2]
    drop = np.broadcast_to(-position_m[:, None, 2:], (*away.shape[:2], 1))
    body = np.concatenate([away, drop], axis=-1) @ turn
    seen = np.maximum(*camera_margins(body[..., 0], body[..., 1], body[..., 2])) > 0.0
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])[:, None]
    ahead = np.cos(yaw) * away[..., 0] + np.sin(yaw) * away[..., 1]
    left = np.cos(yaw) * away[..., 1] - np.sin(yaw) * away[..., 0]
    inside: Bools = (np.abs(ahead) < FULL.half_extent_m) & (np.abs(left) < FULL.half_extent_m)
    inside &= seen
    return inside


def _in_any_view(xy_m: Floats, pose: Floats, looking: Bools) -> Bools:
    """Which places [T, P, 2] at least one drone sees: [T, P]; `pose` [T, N, 7], `looking` [T, N]."""
    seen = np.zeros(xy_m.shape[:2], bool)
    for drone in range(pose.shape[1]):
        at = np.flatnonzero(looking[:, drone])
        if len(at):
            seen[at] |= sees_ground(xy_m[at], pose[at, drone, :3], pose[at, drone, 3:])
    return seen


def _region_observed(record: SortieRecord, t_s: Floats, pose: Floats, looking: Bools) -> float | None:
    """Share of the mission region's area that is in view, averaged over the time in which there is a region."""
    every = max(1, round(LOOK_S / record.scenario.frame_s))
    disc = np.stack([record.tables["mission"][f"region_{c}"].to_numpy() for c in ("x_m", "y_m", "radius_m")], axis=-1)[
        ::every
    ]
    width_s = np.diff(t_s[::every], append=record.scenario.duration_s)
    there = ~np.isnan(disc[:, 2])
    if not there.any():
        return None
    k = np.arange(PLACES) + 0.5  # a sunflower's seeds: equal areas, and no row of them along a camera's edge
    turn, out = k * np.pi * (3.0 - math.sqrt(5.0)), np.sqrt(k / PLACES)
    seeds = np.stack([out * np.cos(turn), out * np.sin(turn)], axis=-1)
    places = disc[there, None, :2] + disc[there, None, 2:] * seeds
    seen = _in_any_view(places, pose[::every][there], looking[::every][there]).mean(axis=1)
    return float(seen @ width_s[there] / width_s[there].sum())


def _detected(record: SortieRecord, frame_s: Floats, tracked: Bools) -> tuple[float | None, float | None]:
    """Share of the scored instants at which a drone's boxes hold the target, and the longest time without."""
    scenario, boxes = record.scenario, record.tables["detections"]
    if record.detector == "none" or scenario.mission.target is None:
        return None, None
    instants = np.array(scenario.scored_frames) * scenario.frame_s + scenario.perception.fusion_delay_s
    instants = instants[instants < scenario.duration_s - _INSTANT_S]
    path = TargetPath.of(scenario.mission.target)
    size_m = TARGET_SIZE_M[:2]
    truth = np.array([(x, y, *size_m, yaw) for x, y, yaw in map(path.pose, instants.tolist())]).reshape(-1, 5)
    columns = ("x_m", "y_m", "length_m", "width_m", "yaw_rad")
    found = np.stack([boxes[c].to_numpy() for c in columns], axis=-1)
    of = np.searchsorted(instants, boxes["t_s"].to_numpy() - _INSTANT_S)
    _, which, iou = overlapping(found, truth, of, np.arange(len(instants)))
    hit = np.zeros(len(instants), bool)
    hit[which[iou >= FOUND_IOU]] = True
    counted = tracked[np.searchsorted(frame_s, instants + _INSTANT_S, side="right") - 1]
    return _share_and_gap(hit, counted, np.diff(instants, append=scenario.duration_s))


def _share_and_gap(seen: Bools, counted: Bools, width_s: Floats) -> tuple[float | None, float | None]:
    """Share of the counted time that is seen, and the longest unbroken time that is counted and not seen.

    Args:
        seen, counted: [T] at instants that follow each other.
        width_s: [T] each instant stands for so long.
    """
    if not counted.any():
        return None, None
    missed = counted & ~seen
    longest_s = run_s = 0.0
    for miss, lasts_s in zip(missed.tolist(), width_s.tolist(), strict=True):
        run_s = run_s + lasts_s if miss else 0.0
        longest_s = max(longest_s, run_s)
    return 1.0 - float(width_s[missed].sum() / width_s[counted].sum()), longest_s


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
