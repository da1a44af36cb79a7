"""Detectors by name: what a sortie asks of one, and the table from which a scenario's `perception.detector` is made.

Free of torch: a constructor imports what it needs when it is called, so that sorties without the network never load it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception


class Detector(Protocol):
    """What a sortie asks of a detector."""

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        """Each ego's boxes from its own look and what it was sent, ENU, best first."""

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """What there is to find in the ego's square at `t_s`, ENU."""

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """How many detections the drone would send for this capture, inside a disc (x, y, radius) if there is one."""

    def camera_views(self, capture: Capture) -> NDArray[Any]:
        """The camera images [cameras, height, width, 3]; ValueError where there are none."""


@runtime_checkable
class DetectsAhead(Protocol):
    """A detector that works in the background: a sortie flies on to the next moment while it looks at this one.

    One that has `begin` is asked by it alone: who overrides `detect` overrides `begin`.
    """

    def begin(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> Callable[[], list[Boxes]]:
        """Begin what `detect` does; what is returned waits for it."""


@runtime_checkable
class DetectsMany(Protocol):
    """A detector that need not be asked at once: a sortie gathers its moments and asks for many together."""

    calibration: str
    """Which fit it is of, for outcomes."""

    def detect_many(self, moments: Sequence[Sequence[tuple[Capture, Sequence[Share]]]]) -> Iterable[Boxes]:
        """As `detect`, moment after moment, job after job."""

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> Iterable[Boxes]:
        """As `truth`, ego by ego."""


Constructor = Callable[[SceneModel, Perception, int, int], Detector]
"""From the scene, the scenario's `perception` section, the sortie's seed and its replication."""


@dataclass(frozen=True, slots=True)
class DetectorKind:
    """One value of `perception.detector`."""

    about: str
    """One line for lists."""
    make: Constructor | None
    """None flies without a detector."""


def make_detector(scene: SceneModel, config: Perception, seed: int, replication: int = 0) -> Detector | None:
    """The detector that the scenario names; None where it flies the traffic alone.

    Raises:
        ValueError: weights or a recording that are missing or do not fit, naming the file.
    """
    make = DETECTORS[config.detector].make
    return None if make is None else make(scene, config, seed, replication)


def _torch(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
    from sortie.perception.network.detector import TorchDetector

    weights = None if config.weights is None else Path(config.weights)
    return TorchDetector(scene, config, seed, weights, replication)


def _recorded(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
    from sortie.perception.recordings.detector import RecordedDetector

    return RecordedDetector(config)


def _surrogate(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
    from sortie.perception.surrogate.detector import SurrogateDetector

    weights = None if config.weights is None else Path(config.weights)
    return SurrogateDetector(scene, config, seed, weights, replication)


DETECTORS: dict[str, DetectorKind] = {
    "torch": DetectorKind(
        "the shipped network on rendered views: encoder, fusion by perception.fusion, centre head", _torch
    ),
    "recorded": DetectorKind(
        "what another model saw, from perception.recording; its features may be fused by its own code", _recorded
    ),
    "surrogate": DetectorKind(
        "a fast model fitted to the torch detector by `sortie calibrate`; nothing is rendered", _surrogate
    ),
    "none": DetectorKind("traffic alone; boxes are counted from the scene", None),
}
"""A new detector is one constructor and one line here, and one word in the schema."""
