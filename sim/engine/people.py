"""People in the scene, what each drone's thermal camera found of them lately, and what drones know of them after sharing."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sortie.perception.classes import PERSON
from sortie.perception.geometry import in_square
from sortie.perception.joining import EgoSources, SourceBoxes, joined_many, source_of
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.thermal import Sighting, boxes_of, look, looked_at, people_boxes
from sortie.perception.types import Boxes, Capture, Share
from sortie.policies.contract import Disc
from sortie.scenarios.frames import frame_at, instant
from sortie.scenarios.schema import Scenario, Thermal
from sortie.sim.results.record import Recorder

KEPT_S = 5.0
"""So long looks are kept: longer than a tracker makes up for (`sortie.sim.engine.tracking.WARM_UP_S`)."""


class Look(NamedTuple):
    """What a drone's thermal camera found in a frame."""

    frame: int
    capture: Capture
    boxes: Boxes | None
    """None where it was covered, so that its frame says nothing."""


class People:
    """Where people are, and what the fleet's thermal cameras find.

    A camera looks in every frame, whatever the duty cycle of perception. A detection is known the
    drone's compute delay after its frame, and counts for `perception.thermal.remembers_s`.
    """

    def __init__(self, scenario: Scenario, scene: SceneModel, recorder: Recorder, key: tuple[int, int]) -> None:
        """Args: `key`: seed and replication."""
        perception = scenario.perception
        self._walkers, self._camera, self._join = scene.walkers, perception.thermal, perception.join
        self._delays_s, self._frame_s = scenario.compute_delays_s, scenario.frame_s
        self._scene, self._rows, self._key = scene, recorder.rows, key
        self._without_camera = scenario.fleet.without_camera
        self._has_trucks = perception.scene.trucks > 0.0
        self._lately: list[deque[Sighting]] = [deque() for _ in range(scenario.fleet.drones)]
        self._looks: list[deque[Look]] = [deque() for _ in range(scenario.fleet.drones)]

    def write(self, now_s: float) -> None:
        """Record where everybody is."""
        if self._walkers:
            at = enumerate(self._walkers.at(now_s).tolist())
            self._rows["people"].extend((now_s, person, x_m, y_m) for person, (x_m, y_m) in at)

    def look(self, capture: Capture, frame: int, *, is_blocked: bool = False) -> None:
        """A drone's thermal camera looks; one that is blocked sees nothing."""
        camera = self._camera
        if camera is None or capture.drone in self._without_camera:
            return
        found = [] if is_blocked else self._seen(camera, capture, frame)
        self._rows["sightings"].extend((s.t_s, capture.drone, s.x_m, s.y_m, s.score, s.person) for s in found)
        lately, looks = self._lately[capture.drone], self._looks[capture.drone]
        lately.extend(found)
        while lately and instant(lately[0].t_s) < instant(capture.t_s - camera.remembers_s):
            lately.popleft()
        looks.append(Look(frame, capture, None if is_blocked else boxes_of(found)))
        while looks[0].capture.t_s < capture.t_s - KEPT_S:
            looks.popleft()

    def _seen(self, camera: Thermal, capture: Capture, frame: int) -> Sequence[Sighting]:
        at_m, scene = self._walkers.at(capture.t_s), self._scene
        trucks = scene.trucks(capture.t_s) if self._has_trucks else None
        return look(camera, at_m, scene.height_field, capture, frame, self._frame_s, self._key, trucks)

    def known_in(self, drone: int, region: Disc | None, now_s: float) -> bool:
        """Whether the drone's own camera found a person in its region lately."""
        if region is None:
            return False
        return any(
            instant(s.t_s + self._delays_s[drone]) <= instant(now_s)
            and math.hypot(s.x_m - region.x_m, s.y_m - region.y_m) <= region.radius_m
            for s in self._lately[drone]
        )

    def found(self, capture: Capture) -> Boxes:
        """What the drone's thermal camera found at the moment of a capture."""
        frame = frame_at(capture.t_s, self._frame_s)
        its = next((its for its in self._looks[capture.drone] if its.frame == frame), None)
        return Boxes.empty() if its is None or its.boxes is None else its.boxes

    def joined(self, vehicles: Boxes, capture: Capture) -> Boxes:
        """A drone's own detections with the people that its thermal camera found, for its tracker."""
        return vehicles if self._camera is None else Boxes.join([vehicles, self.found(capture)])

    def known(self, here: Capture, shares: Sequence[Share], now_s: float) -> Boxes:
        """The people that a drone knows of at a fusion: those that its own camera found last, joined with received ones.

        Args:
            here: where the drone is.
            shares: what it received.
        """
        camera = self._camera
        if camera is None:
            return Boxes.empty()
        known = (
            its
            for its in reversed(self._looks[here.drone])
            if instant(its.capture.t_s + self._delays_s[here.drone]) <= instant(now_s)
        )
        sources = []
        if (last := next(known, None)) is not None and last.boxes is not None:
            own = last.capture
            sources.append(SourceBoxes(last.boxes, 1.0, own.est_pose, looked_at(camera, own), age_s=now_s - own.t_s))
        sources += [_received(s, camera) for s in shares if s.weight > 0.0 and (s.people is not None or _has_tracks(s))]
        ego = EgoSources(here.est_pose, Boxes.empty(), False, sources, looked=False)
        return joined_many([ego], self._join)[0]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The people in an ego's square at `t_s`, if its fleet looks for people."""
        if self._camera is None or not self._walkers:
            return Boxes.empty()
        at_m = self._walkers.at(t_s)
        here = np.flatnonzero(in_square(at_m, [ego.true_pose])[:, 0])
        return people_boxes(at_m[here], np.ones(len(here)), here)


def _received(share: Share, camera: Thermal) -> SourceBoxes:
    """The people in a share, and where their sender would have found more."""
    if _has_tracks(share):  # a person is tracked after three looks, so that none is tracked means nothing
        assert share.tracks is not None  # noqa: S101 (`_has_tracks`)
        of_people = share.tracks.take(share.tracks.kind == PERSON)
        return replace(source_of(share._replace(tracks=of_people), None), truncated=True)
    # of class person nobody fitted a covariance: people are joined as detections are
    rung = "detections" if share.representation == "uncertain_boxes" else share.representation
    source = source_of(share._replace(boxes=share.people, representation=rung), None)
    part = _common(looked_at(camera, share.capture), share.roi)
    return replace(source, roi=part, truncated=part is None)


def _has_tracks(share: Share) -> bool:
    return share.representation == "tracks" and share.tracks is not None


def _common(cone: Disc, roi: Disc | None) -> Disc | None:
    """The disc in which the camera looked and people were requested; None where that is no disc."""
    if roi is None:
        return cone
    apart_m = math.hypot(cone.x_m - roi.x_m, cone.y_m - roi.y_m)
    if apart_m + roi.radius_m <= cone.radius_m:
        return roi
    return cone if apart_m + cone.radius_m <= roi.radius_m else None
