"""Drones that hold payloads, and a detector that keeps what it was asked, for tests of what drones fuse."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from agent_rig import capture, payload

from sortie.fleet.memory import Received
from sortie.fleet.plane import DroneStatus
from sortie.perception.types import Boxes, Capture


class Mind:
    """What a drone received, and what it thinks of its peers."""

    def __init__(self, held: Sequence[tuple[int, float, float, float, Any]] = ()) -> None:
        """Args: `held`: of each payload its sender, when it was captured, how old the drone takes it to be, trust, changes."""
        self._age_s = {peer: age_s for peer, _, age_s, _, _ in held}
        self._trust = {peer: trust for peer, _, _, trust, _ in held}
        self.held = {
            peer: Received(capture(peer, t_s), payload()._replace(fusion_weight=0.5, **more), t_s, t_s, (3,))
            for peer, t_s, _, _, more in held
        }

    def payload_age_s(self, received: Received, now_s: float) -> float:
        return self._age_s[received.capture.drone]

    def trust_in(self, peer: int) -> float:
        return self._trust[peer]


class Seer:
    """A detector that finds nothing and keeps what it was asked."""

    def __init__(self) -> None:
        self.jobs: dict[int, Any] = {}

    def detect(self, jobs: Sequence[Any]) -> list[Boxes]:
        for here, shares in jobs:
            self.jobs[here.drone] = here, list(shares)
        return [Boxes(np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1), np.ones(1)) for _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return Boxes(np.zeros((2, 2)), np.full((2, 2), 4.0), np.zeros(2), np.ones(2))

    count_boxes = camera_views = None


def agent(
    drone: int, here_s: float, latest_s: float | None, mind: Mind, *, airborne: bool = True, looks: bool = True
) -> Any:
    status = DroneStatus(airborne=airborne, looks=looks)
    latest = None if latest_s is None else capture(drone, latest_s)
    return SimpleNamespace(drone=drone, here=capture(drone, here_s), latest=latest, memory=mind, status=status)
