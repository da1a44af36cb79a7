"""Detectors with which experiments fly in place of the scenario's own; `maker` has them by name."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa

from sortie.perception.detectors import Constructor, Detector, Jobs, KeepsCaptures, make_detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import BoxColumns, SurrogateDetector
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.schema import Perception
from sortie.sim.engine.scoring import unfold_detections
from sortie.sim.engine.sortie import DetectorMaker
from sortie.sim.results.record import SortieRecord

SHARED, ANSWERS, DRAWS = "torch shared", "torch answers", "surrogate draws"
SHARED_CAPTURES = 400
"""Captures that stay encoded for the other policies of a seed."""


def maker(seen_by: str) -> tuple[DetectorMaker, int]:
    """What makes the detector, and how many draws of its boxes there are.

    Args:
        seen_by: empty for the scenario's own detector; `SHARED` for one that the flights of a group share; `ANSWERS` for the
            surrogate's traffic with torch's boxes; `DRAWS` and a number for the surrogate with so many draws of its boxes.
    """
    if seen_by == SHARED:
        return _shared, 1
    if seen_by == ANSWERS:
        return _answers(), 1
    if seen_by.startswith(DRAWS):
        return DrawsAgain(), int(seen_by.removeprefix(DRAWS))
    return make_detector, 1


@functools.cache
def _answers() -> Constructor:
    return torch_answers()


class SharedDetector:
    """Makes detectors so that sorties of one seed, flown one after the other, share the torch detector.

    Policies do not change where drones fly, so the sorties of a seed mostly encode the same captures. Boxes may
    differ slightly from those of a detector of its own, because captures are rendered together with others
    (perception/README.md).
    """

    def __init__(self) -> None:
        self._last: list[tuple[object, Detector | None]] = []

    def __call__(self, scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector | None:
        if config.detector != "torch":
            return make_detector(scene, config, seed, replication)
        key = scene.made_of, config, seed, replication
        if not self._last or self._last[0][0] != key:
            detector = make_detector(scene, config, seed, replication)
            self._last[:] = [(key, detector)]
            if isinstance(detector, KeepsCaptures):
                detector.kept_captures = SHARED_CAPTURES
        return self._last[0][1]


_shared = SharedDetector()


class BothDetectors:
    """The torch detector's boxes, and the traffic of the surrogate: its guess of how many a drone would send, and its tracks."""

    name = "torch, with the traffic of the surrogate"

    def __init__(self, torch: Detector, surrogate: Detector) -> None:
        self.detect, self.truth = torch.detect, torch.truth
        self.count_boxes, self.camera_views = surrogate.count_boxes, torch.camera_views
        self.looks = surrogate


def torch_answers(calibration: Path | None = None, weights: Path | None = None) -> Constructor:
    """What makes a sortie's detector so that its traffic is the surrogate's and its boxes are the torch detector's, which is
    asked at scored moments alone. None takes what is shipped.

    Sorties that are made one after the other in one scene, under several policies, share the torch detector, its scenery
    and what it has encoded.
    """
    from sortie.perception.network.detector import TorchDetector  # here: torch takes a second to import

    ours = surrogate_of(calibration)
    last: list[tuple[object, Detector]] = []

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
        key = scene.made_of, config, seed, replication
        if not last or last[0][0] != key:
            last[:] = [(key, TorchDetector(scene, config, seed, weights, replication))]
        return BothDetectors(last[0][1], ours(scene, config, seed, replication))

    return make


def surrogate_of(calibration: Path | None) -> Constructor:
    """What makes a sortie's surrogate, with a calibration or the shipped one."""

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
        return SurrogateDetector(scene, config, seed, calibration, replication)

    return make


class DrawsAgain:
    """Makes surrogates that keep the scored moments of their last flight, so that other draws can be made of them.

    What the surrogate finds is drawn at random. Half of the variation of a sortie's AP can come from these draws. The mean
    over several draws on one flight varies less, and follows the torch detector's AP more closely. A flight takes far
    longer than another draw of its boxes.
    """

    def __call__(self, scene: SceneModel, config: Perception, seed: int, replication: int) -> KeepsMoments:
        self.made = KeepsMoments(scene, config, seed, replication)
        return self.made


class KeepsMoments:
    """The surrogate as it flies, which also keeps the scored moments."""

    name = SurrogateDetector.name

    def __init__(self, scene: SceneModel, config: Perception, seed: int, replication: int) -> None:
        weights = None if config.weights is None else Path(config.weights)
        self._made_with = scene, config, seed, weights, replication
        flown = SurrogateDetector(scene, config, seed, weights, replication)
        self.looks, self.calibration = flown, flown.calibration
        self.detect, self.truth = flown.detect, flown.truth
        self.count_boxes, self.camera_views = flown.count_boxes, flown.camera_views
        self._moments: list[Jobs] = []
        self._keys: list[tuple[float, int]] = []
        """When and for whom each of their jobs is."""

    def detect_many(self, moments: Sequence[Jobs]) -> BoxColumns:
        """The boxes that are recorded."""
        self._moments += moments
        return self.looks.detect_many(moments)

    def truth_many(self, t_s: Sequence[float], egos: Sequence[Capture]) -> BoxColumns:
        """The truths that are recorded, of the moments that `detect_many` got just before."""
        times = [t for t, _ in itertools.groupby(t_s)]
        for when, jobs in zip(times, self._moments[len(self._moments) - len(times) :], strict=True):
            self._keys += [(when, ego.drone) for ego, _ in jobs]
        return self.looks.truth_many(t_s, egos)

    def draw(self, number: int) -> list[tuple[float, int, Boxes]]:
        """Another draw of the boxes of every scored fusion with a job: time, ego and boxes. Number 0 is the recorded one."""
        scene, config, seed, weights, replication = self._made_with
        other = SurrogateDetector(scene, config, seed, weights, replication + number)
        boxes = other.detect_many(self._moments)
        return [(t_s, drone, found) for (t_s, drone), found in zip(self._keys, boxes, strict=True)]


def boxes_of_draws(record: SortieRecord, make: DetectorMaker, draws: int) -> Iterator[SortieRecord]:
    """The record with the boxes of each further draw, and only the tables that accuracy reads."""
    if not isinstance(make, DrawsAgain):
        return
    old = record.tables["detections"].schema
    kept = {name: record.tables[name] for name in ("fusions", "truths", "mission")}
    for number in range(1, draws):
        boxes = make.made.draw(number)
        columns = unfold_detections(boxes, classes="kind" in old.names) if boxes else [[] for _ in old]
        table = pa.table([pa.array(c, f.type) for c, f in zip(columns, old, strict=True)], schema=old)
        yield dataclasses.replace(record, tables={**kept, "detections": table})
