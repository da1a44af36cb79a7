"""The interface of a detector, and the table of detectors that `perception.detector` names.

Free of torch: a constructor imports what it needs when it is called, so that sorties without the network never load it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import update_wrapper
from numbers import Integral
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sortie.perception.box_bounds import wrong_box
from sortie.perception.classes import TargetClass
from sortie.perception.errors import InputError
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.perception.uncertainty import BoxErrors
from sortie.scenarios.disc import Disc
from sortie.scenarios.plugins.reference import Guard, PluginError, checked_call, real_array, resolve
from sortie.scenarios.schema import Perception

MOST_BOXES = 1_000_000
"""A detector's count of boxes in one payload at most."""


class Detector(Protocol):
    """Turns a drone's own images and the data it received into boxes."""

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        """Each ego's boxes from its own capture and the shares it received, ENU, best first."""

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The cars in the ego's square at `t_s`, ENU: what it should detect."""

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """The number of detections that the drone would send for this capture, inside the disc if there is one."""

    def camera_views(self, capture: Capture) -> NDArray[Any]:
        """The camera images [cameras, height, width, 3]; ValueError where there are none."""


@runtime_checkable
class DetectsAhead(Protocol):
    """A detector that works in the background, so that a sortie flies on while this moment is computed.

    A sortie calls `begin` instead of `detect` where there is one, so a subclass overrides both.
    """

    def begin(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> Callable[[], list[Boxes]]:
        """Start `detect` in the background; calling the result waits for its boxes."""


@runtime_checkable
class DetectsMany(Protocol):
    """A detector that computes many moments together, at the end of a sortie or of a batch."""

    calibration: str
    """The name of its calibration, for the outcome."""

    def detect_many(self, moments: Sequence[Sequence[tuple[Capture, Sequence[Share]]]]) -> Iterable[Boxes]:
        """As `detect`, moment after moment, job after job."""

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> Iterable[Boxes]:
        """As `truth`, ego by ego."""


@runtime_checkable
class HasBoxErrors(Protocol):
    """A detector that tells how uncertain its boxes are, so that drones can send boxes with covariances."""

    @property
    def box_errors(self) -> BoxErrors:
        """How uncertain the boxes of a drone alone are; InputError where nobody fitted it."""


def box_errors_of(detector: Detector) -> BoxErrors:
    """How uncertain a detector's boxes are.

    Raises:
        InputError: a detector that does not tell.
    """
    if not isinstance(detector, HasBoxErrors):
        name = str(getattr(detector, "name", type(detector).__name__))
        raise InputError(f"detector {name} does not tell how uncertain its boxes are: let policies send detections")
    return detector.box_errors


@runtime_checkable
class LooksByAnother(Protocol):
    """A detector that leaves to another what drones' trackers take in, so that decisions in flight follow that one."""

    looks: Detector
    """Detects for the trackers."""


@runtime_checkable
class KeepsCaptures(Protocol):
    """A detector that keeps what it encoded of the latest captures."""

    kept_captures: int
    """How many."""


Jobs = Sequence[tuple[Capture, Sequence[Share]]]
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
    """The detector that the scenario names; None where only traffic is simulated.

    Raises:
        InputError: weights or a recording that are missing or do not fit, naming the file.
    """
    if config.detector not in DETECTORS:
        return _own(scene, config, seed, replication)
    make = DETECTORS[config.detector].make
    return None if make is None else make(scene, config, seed, replication)


def _own(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
    """A detector from outside: a class, or a function, that takes the arguments of a `Constructor`."""
    constructor = resolve("detector", config.detector, config.detector_params)
    made = checked_call("detector", constructor, scene, config, seed, replication)
    needed = ("detect", "truth", "count_boxes", "camera_views")
    found: Any = Guard("detector", made, needed, Path(config.detector).name, timed=False)  # a network takes its time
    detect, truth, count = found.detect, found.truth, found.count_boxes

    def boxes(made: object, what: str) -> Boxes:
        if not isinstance(made, Boxes):
            raise PluginError(f"detector {found.name}: {what} returns {made!r:.60}, must be Boxes")
        n = len(made)
        columns = {"xy_m": (n, 2), "size_m": (n, 2)} | dict.fromkeys(("yaw_rad", "score", "car", "kind"), (n,))
        for column, shape in columns.items():
            value = real_array(getattr(made, column))
            if value is None or np.asarray(getattr(made, column)).dtype.kind == "O":
                raise PluginError(
                    f"detector {found.name}: {what} returns {column} without numbers, must be of shape {shape}"
                )
            if value.shape != shape:
                raise PluginError(
                    f"detector {found.name}: {what} returns {column} of shape {value.shape}, must be {shape}"
                )
        for column, low, high in (("kind", 0, max(TargetClass)), ("car", -1, 2**31 - 1)):
            value = np.asarray(getattr(made, column))
            if value.dtype.kind not in "iu" or not ((value >= low) & (value <= high)).all():
                must = f"must be whole numbers from {low} to {high}"
                raise PluginError(f"detector {found.name}: {what} returns {column} {value!r:.60}, {must}")
        if wrong := wrong_box(np.column_stack([made.table(), made.score])):
            raise PluginError(f"detector {found.name}: {what} returns boxes: {wrong}")
        return made

    def apart(jobs: Jobs) -> list[tuple[Capture, list[Share]]]:
        """The jobs with copies of all arrays: the detector may change them, and other drones have received the same."""
        names = ("tracks", "boxes", "people")
        return [
            (ego, [s._replace(**{n: deepcopy(getattr(s, n)) for n in names}) for s in shares]) for ego, shares in jobs
        ]

    def checked(several: Any, count: int, what: str = "detect") -> list[Boxes]:
        whole = isinstance(several, Sequence) and len(several) == count
        if not whole or not all(isinstance(each, Boxes) for each in several):
            each_of = "egos" if what == "truth_many" else "jobs"
            raise PluginError(
                f"detector {found.name}: {what} returns {several!r:.60}, must be Boxes for each of the {each_of}"
            )
        return [boxes(each, what) for each in several]

    def listed(method: Callable[..., Any], *args: Any) -> Any:
        """What a method returns or yields, so that it fails here."""
        return checked_call("detector", update_wrapper(lambda: list(method(*args)), method))

    def counted(capture: Capture, roi: Disc | None) -> int:
        number = count(capture, roi)
        if not isinstance(number, Integral) or not 0 <= int(number) <= MOST_BOXES:
            must = f"must be a whole number from 0 to {MOST_BOXES:,}"
            raise PluginError(f"detector {found.name}: count_boxes returns {number!r:.60}, {must}")
        return int(number)

    found.detect = lambda jobs: checked(detect(apart(jobs)), len(jobs))
    found.truth = lambda t_s, ego: boxes(truth(t_s, ego), "truth")
    found.count_boxes = counted
    if isinstance(made, DetectsAhead):
        begin = found.begin

        def begun(jobs: Jobs) -> Callable[[], list[Boxes]]:
            finish = begin(apart(jobs))
            return lambda: checked(checked_call("detector", finish), len(jobs))

        found.begin = begun
    if isinstance(made, DetectsMany):
        many, truths = made.detect_many, made.truth_many
        found.detect_many = lambda moments: checked(
            listed(many, [apart(jobs) for jobs in moments]), sum(map(len, moments)), "detect_many"
        )
        found.truth_many = lambda t_s, egos: checked(listed(truths, t_s, egos), len(egos), "truth_many")
    detector: Detector = found
    return detector


def _torch(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
    try:
        from sortie.perception.network.detector import TorchDetector
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise InputError(
            "perception.detector is torch, which is not installed: pip install 'sortie-sim[torch]', or take surrogate"
        ) from None

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
        "another model's recorded detections, from perception.recording; its features may be fused by its own code",
        _recorded,
    ),
    "surrogate": DetectorKind(
        "a fast model fitted to the torch detector by `python -m research calibrate`; nothing is rendered", _surrogate
    ),
    "none": DetectorKind("traffic alone; boxes are counted from the scene", None),
}
"""A new detector needs a constructor, a line here, and its name in the schema."""
