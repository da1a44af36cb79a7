"""People in the scene, and what each drone's thermal camera found of them lately."""

from __future__ import annotations

import math
from collections import deque

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.thermal import Sighting, Walkers, look
from sortie.perception.types import Capture
from sortie.policies.contract import Disc
from sortie.scenarios.schema import Scenario
from sortie.sim.results.record import Recorder

_INSTANT_S = 1e-9


class People:
    """Where people are, and what the fleet's thermal cameras find.

    A camera looks in every frame, whatever the duty cycle of perception. A detection is known `perception.compute_delay_s`
    after its frame, and counts for `perception.thermal.remembers_s`.
    """

    def __init__(self, scenario: Scenario, scene: SceneModel, recorder: Recorder, key: tuple[int, int]) -> None:
        """Args: `key`: seed and replication."""
        perception = scenario.perception
        self._walkers, self._camera = Walkers(perception.people), perception.thermal
        self._delay_s, self._frame_s = perception.compute_delay_s, scenario.frame_s
        self._scene, self._rows, self._key = scene, recorder.rows, key
        self._lately: list[deque[Sighting]] = [deque() for _ in range(scenario.fleet.drones)]

    def write(self, now_s: float) -> None:
        """Record where everybody is."""
        if self._walkers:
            at = enumerate(self._walkers.at(now_s).tolist())
            self._rows["people"].extend((now_s, person, x_m, y_m) for person, (x_m, y_m) in at)

    def look(self, capture: Capture, frame: int) -> None:
        """A drone's thermal camera looks."""
        camera = self._camera
        if camera is None:
            return
        at_m, field = self._walkers.at(capture.t_s), self._scene.height_field
        found = look(camera, at_m, field, capture, frame, self._frame_s, self._key)
        self._rows["sightings"].extend((s.t_s, capture.drone, s.x_m, s.y_m, s.score, s.person) for s in found)
        lately = self._lately[capture.drone]
        lately.extend(found)
        while lately and lately[0].t_s < capture.t_s - camera.remembers_s - _INSTANT_S:
            lately.popleft()

    def known_in(self, drone: int, region: Disc | None, now_s: float) -> bool:
        """Whether the drone's own camera found a person in its region lately."""
        if region is None:
            return False
        return any(
            s.t_s + self._delay_s <= now_s + _INSTANT_S
            and math.hypot(s.x_m - region.x_m, s.y_m - region.y_m) <= region.radius_m
            for s in self._lately[drone]
        )
