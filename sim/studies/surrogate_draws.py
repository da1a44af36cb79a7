"""Accuracy of one flight by several draws of the surrogate's boxes.

What the surrogate finds is drawn at random. Half of the variation of a sortie's AP can come from these draws. The mean over
several draws on one flight varies less, and follows the torch detector's AP more closely. A flight takes far longer than
another draw of its boxes.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa

from sortie.perception.detectors import Jobs
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import BoxColumns, SurrogateDetector
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Policy
from sortie.scenarios.schema import Perception, Scenario
from sortie.sim.engine.scoring import unfold_detections
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import Both, both_matched
from sortie.sim.results.record import SortieRecord


class KeepsMoments:
    """The surrogate as it flies, which also keeps the scored moments, so that other draws can be made of them."""

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


def fly_with_draws(scenario: Scenario, policy: Policy | None, seed: int, draws: int) -> list[Both]:
    """Fly a sortie with the surrogate, and match the boxes of several draws with the truth.

    Args:
        scenario: with `perception.detector: surrogate`.
        policy: decides in place of the scenario's; None takes its own.
        draws: 1 or more. The first is the sortie's own, as `run_sortie` records it.

    Returns:
        Each draw's matched fusions, in the full scene and in the mission disc.
    """
    made: list[KeepsMoments] = []

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> KeepsMoments:
        made.append(KeepsMoments(scene, config, seed, replication))
        return made[-1]

    record = run_sortie(scenario, policy, seed, detector_of=make)
    return [both_matched(record), *(both_matched(_with(record, made[0].draw(k))) for k in range(1, draws))]


def _with(record: SortieRecord, boxes: Sequence[tuple[float, int, Boxes]]) -> SortieRecord:
    """The record with other detections, and only the tables that accuracy reads."""
    old = record.tables["detections"].schema
    columns = unfold_detections(boxes, classes="kind" in old.names) if boxes else [[] for _ in old]
    table = pa.table([pa.array(c, f.type) for c, f in zip(columns, old, strict=True)], schema=old)
    kept = {name: record.tables[name] for name in ("fusions", "truths", "mission")}
    return dataclasses.replace(record, tables={**kept, "detections": table})
