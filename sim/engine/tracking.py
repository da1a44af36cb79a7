"""The trackers of a sortie: what each drone follows, in flight.

A drone's tracker takes in its own detections of some of its looks, `Scenario.tracked_frames`. They are computed when
somebody needs tracks: a payload of tracks, late boxes that are to be moved, or a mission with a target. Looks older than
`WARM_UP_S` are not made up for then.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from sortie.fleet.coverage import RANGE_M
from sortie.perception.geometry import Lens
from sortie.perception.motion import Tracks
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.traffic import TARGET_SIZE_M
from sortie.perception.tracking.following import agree_loop, followed
from sortie.perception.tracking.tracker import step
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.disc import Disc
from sortie.scenarios.frames import frame_at, instant
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.people import People
from sortie.sim.results.mission_outcome import sees_ground

WARM_UP_S = 4.0
"""Longer than a track is confirmed in and coasts, so that what a tracker follows does not depend on when it began."""
CUE_S = 0.5
"""A target's velocity is the difference of the ground station's cues over this time."""
CUE_MOST_S = 2.5
"""... of this time at most, where cues come more rarely."""
AHEAD = 100
"""Captures that are expected next and computed together."""

OwnBoxesOf = Callable[[Sequence[Capture]], Sequence[Boxes]]


class _Followed(NamedTuple):
    """What a drone followed when that was last judged."""

    target: int
    tracks: dict[int, int]
    """By target, the id of its track."""
    judged_by: Tracks | None
    at_s: float


class FleetTracking:
    """Every drone's tracker."""

    def __init__(self, scenario: Scenario, own_boxes: OwnBoxesOf, people: People | None = None) -> None:
        """Args:
        own_boxes: gives each capture's detections by its drone alone.
        people: what thermal cameras found, which is tracked too.
        """
        n = scenario.fleet.drones
        self._looks, self._frame_s = scenario.tracked_frames, scenario.frame_s
        self._own_boxes, self._people = own_boxes, people
        self._taken = [0] * n
        self._waiting: deque[Capture] = deque()
        self._tracks, self._next_id = Tracks.empty(), np.zeros(n, np.int64)
        self._of: dict[int, Tracks] = {}
        self._cues: dict[int, deque[tuple[float, tuple[float, float]]]] = {}
        self._followed = [_Followed(-1, {}, None, -math.inf)] * n
        agree_loop()

    def perceived(self, capture: Capture) -> None:
        """A drone's perception has worked on a capture; its tracker takes it in if a look is due."""
        drone, frame = capture.drone, frame_at(capture.t_s, self._frame_s)
        due = self._taken[drone]
        if due < len(self._looks) and frame >= self._looks[due]:
            self._taken[drone] = bisect_right(self._looks, frame)
            self._waiting.append(capture)
            while instant(self._waiting[0].t_s) < instant(capture.t_s - WARM_UP_S):
                self._waiting.popleft()

    def tracks(self, drone: int) -> Tracks:
        """What a drone follows, after the last look of its tracker; tentative tracks too."""
        if self._waiting:
            self._catch_up()
        if drone not in self._of:
            self._of[drone] = self._tracks.take(self._tracks.owner == drone)
        return self._of[drone]

    def follows(self, drone: int, target: int, cue_m: tuple[float, float], now_s: float) -> bool:
        """Whether a drone has a confirmed track of a target, by the ground station's cue: where it is believed to be.

        It is judged anew after a look of the drone's tracker, and `CUE_S` after the last time.
        """
        cues = self._cues.setdefault(target, deque())
        if not cues or cues[-1][0] < now_s:
            cues.append((now_s, cue_m))
        while len(cues) > 2 and instant(cues[1][0]) <= instant(now_s - CUE_S):
            cues.popleft()
        since_s, (x_m, y_m) = cues[0]
        lasts_s = now_s - since_s
        if not instant(CUE_S) <= instant(lasts_s) <= instant(CUE_MOST_S):
            return False
        tracks, before = self.tracks(drone), self._followed[drone]
        is_due = math.isinf(before.at_s) or instant(now_s - before.at_s) >= instant(CUE_S)
        if tracks is not before.judged_by or target != before.target or is_due:
            cue = (*cue_m, (cue_m[0] - x_m) / lasts_s, (cue_m[1] - y_m) / lasts_s)
            following = followed(tracks, {target: cue}, before.tracks, now_s)
            before = self._followed[drone] = _Followed(target, following, tracks, now_s)
        return target in before.tracks

    def _catch_up(self) -> None:
        waiting = list(self._waiting)
        self._waiting.clear()
        self._of.clear()
        rounds: list[dict[int, tuple[Capture, Boxes]]] = []  # each holds one look of a drone at most, in order of time
        behind = dict.fromkeys(range(len(self._taken)), 0)
        for capture, vehicles in zip(waiting, self._own_boxes(waiting), strict=True):
            boxes = vehicles if self._people is None else self._people.joined(vehicles, capture)
            k = behind[capture.drone]
            behind[capture.drone] += 1
            if k == len(rounds):
                rounds.append({})
            rounds[k][capture.drone] = capture, boxes
        for looks in rounds:
            looks_s = np.full(len(self._taken), np.nan)
            looks_s[list(looks)] = [capture.t_s for capture, _ in looks.values()]
            seen = [boxes for _, boxes in looks.values()]
            owner = np.repeat(list(looks), [len(boxes) for boxes in seen])
            self._tracks, self._next_id, _ = step(self._tracks, Boxes.join(seen), owner, looks_s, self._next_id)


class Captures(Protocol):
    """Where drones are."""

    def capture(self, drone: int, frame: int) -> Capture:
        """A drone's capture in a frame."""


class Ahead:
    """The next captures that trackers take in, if all drones fly on and perceive in every frame."""

    def __init__(self, scenario: Scenario, captures: Captures) -> None:
        self._frames, self._n, self._frame_s = scenario.tracked_frames, scenario.fleet.drones, scenario.frame_s
        self._captures = captures

    def after(self, t_s: float) -> Iterable[Capture]:
        """Those after a moment."""
        first = bisect_right(self._frames, frame_at(t_s, self._frame_s))
        frames = self._frames[first : first + max(1, AHEAD // self._n)]
        return (self._captures.capture(drone, frame) for frame in frames for drone in range(self._n))


class TargetSeen:
    """Own detections where no detector flies: a drone finds a target, and nothing else, wherever it has it in view.

    In view: in the picture of one of its cameras, within its feature map, and not hidden by houses or trees. It is found
    where it is, with a score of 1.
    """

    def __init__(self, scene: SceneModel) -> None:
        self._scene = scene

    def __call__(self, captures: Sequence[Capture]) -> list[Boxes]:
        """The targets that each capture shows."""
        targets = self._scene.targets
        pose = np.array([[path.pose(c.t_s) for path in targets] for c in captures]).reshape(len(captures), -1, 3)
        position, attitude = (
            np.array([c.position_m for c in captures]),
            np.array([c.orientation_xyzw for c in captures]),
        )
        lens = Lens(*np.array([c.cameras.lens for c in captures]).reshape(-1, 4, 1).transpose(1, 0, 2))
        seen = sees_ground(pose[..., :2], position, attitude, lens)
        flat = pose.reshape(-1, 3)
        eyes = np.repeat(position, len(targets), axis=0)
        seen &= self._scene.height_field.seen(flat[:, 0], flat[:, 1], eyes).reshape(seen.shape)
        size, score = np.tile(TARGET_SIZE_M[:2], (len(targets), 1)), np.ones(len(targets))
        found = [each[here] for each, here in zip(pose, seen, strict=True)]
        return [Boxes(each[:, :2], size[: len(each)], each[:, 2], score[: len(each)]) for each in found]


def cars_in_reach(scene: SceneModel, capture: Capture, roi: Disc | None) -> int:
    """How many cars a drone could report: within its range, or within a disc."""
    x_m, y_m, radius_m = capture.position_m[0], capture.position_m[1], RANGE_M
    if roi is not None:
        x_m, y_m, radius_m = roi.x_m, roi.y_m, min(roi.radius_m, RANGE_M)
    return scene.cars_near(capture.t_s, x_m, y_m, radius_m)
