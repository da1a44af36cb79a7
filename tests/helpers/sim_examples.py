"""Small sorties that several tests of the room fly, and what stands in the torch detector's place in them."""

from __future__ import annotations

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Perception, Scenario

BASE = """
name: example
duration_s: 6
fleet:
  route: {waypoints_m: [[-60, 0], [60, 0]]}
mission:
  target: {waypoints_m: [[-60, -1.75], [200, -1.75]]}
  phases:
    - {at_s: 0, phase: search}
    - {at_s: 3, phase: track, region: {radius_m: 32}}
perception: {detector: none}
policy: {name: worked, params: {rho: 0.25}, dwell_s: 0.3}
"""


PATIENT = ("context.degraded_after_periods=100", "context.detached_after_periods=1000")
"""Links stay fresh however many descriptors are lost: some collide, and a degraded link sends boxes instead of what was
asked. For tests of what is asked."""


def example(*overrides: str, text: str = BASE) -> Scenario:
    """The base scenario with `--set` overrides."""
    return loads(text, overrides=overrides)


class Seer:
    """In the torch detector's place: finds every car, and notes what it is asked."""

    asked = 0

    def __init__(self, scene: SceneModel, config: Perception, seed: int, weights: object, replication: int) -> None:
        self._truth = SurrogateDetector(scene, config.model_copy(update={"weights": None}), seed, None, replication)

    def detect(self, jobs: list[tuple[Capture, object]]) -> list[Boxes]:
        Seer.asked += len(jobs)
        return [self._truth.truth(ego.t_s + 0.06, ego) for ego, _ in jobs]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        return self._truth.truth(t_s, ego)

    def camera_views(self, capture: Capture) -> None: ...
