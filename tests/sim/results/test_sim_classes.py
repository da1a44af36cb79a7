"""AP of each class in the outcome, from records of detectors that are right, or wrong about the class alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.perception.classes import CAR, PERSON, TRUCK, vehicle_classes
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.playback.layout import legend
from sortie.sim.playback.recording import save_rrd
from sortie.sim.results.accuracy import matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES, SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.report import page
from sortie.sim.results.run_folder import load, save
from sortie.sim.results.sightings import sightings
from sortie.sim.results.summary import Summary, outcome_table
from sortie.sim.studies.compare import Contender, compare
from sortie.sim.studies.comparison_text import comparison_table

TRUCKS = (
    "perception.scene.trucks=0.4",
    "perception.scene.moving_cars_per_km=30",
    "duration_s=5",
    "perception.detector=surrogate",
)
WALKS = "perception.people=[{waypoints_m: [[20, 20], [24, 24]]}]"
OPEN = ("perception.scene.building_density=0", "perception.scene.tree_density=0")
SURE = (
    "perception.thermal={near_probability: 1, half_range_m: 2000, position_error_m: 0, false_alarms_per_min: 0, "
    "field_of_view_deg: 150}"
)


class AllSeeing:
    """Finds every vehicle where it is, and says of what class it is."""

    def __init__(self, scene: SceneModel, *, trucks_are_cars: bool = False) -> None:
        self._scene, self._trucks_are_cars = scene, trucks_are_cars

    def detect(self, jobs: Sequence[tuple[Capture, Any]]) -> list[Boxes]:
        out = [self.truth(ego.t_s + 0.095, ego) for ego, _ in jobs]
        kinds = [vehicle_classes(b.size_m[:, 0]) * (not self._trucks_are_cars) for b in out]
        return [replace(b, kind=k) for b, k in zip(out, kinds, strict=True)]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        cars = self._scene.cars_at(t_s)
        x_m, y_m, _ = ego.position_m
        table = cars.where(np.maximum(abs(cars.x_m - x_m), abs(cars.y_m - y_m)) < 70).table()
        return Boxes(table[:, :2], table[:, 2:4], table[:, 4], np.ones(len(table))).single()

    def count_boxes(self, capture: Capture, roi: Any) -> int:
        return 3


def flown(*overrides: str, trucks_are_cars: bool = False, policy: Any = None) -> SortieRecord:
    def made(scene: SceneModel, config: object, seed: int, replication: int) -> Any:
        return AllSeeing(scene, trucks_are_cars=trucks_are_cars)

    return run_sortie(example(*overrides), policy, detector_of=made)


@pytest.fixture(scope="module")
def right() -> SortieRecord:
    return flown(*TRUCKS, *OPEN, WALKS, SURE)


def boxes_to_all(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, p, Representation.DETECTIONS, 0.0, None, 5.0, reason="all") for p in view.peers]


def test_a_detector_that_is_right_about_every_class_has_an_ap_of_one(right: SortieRecord) -> None:
    told = outcome(right)
    for name in ("car", "truck", "person"):
        assert told["ap_by_class"][name]["full_scene"] == pytest.approx(1.0), name
    assert told["ap50"]["full_scene"] == told["ap_by_class"]["car"]["full_scene"]
    kinds = right.tables["truths"]["kind"].to_numpy()
    assert [np.count_nonzero(kinds == k) > 20 for k in (CAR, TRUCK, PERSON)] == [True] * 3
    cars = sum(m.truths for m in matched(right, mission=False).values())
    flying = right.tables["fusions"].num_rows
    assert cars == np.count_nonzero(kinds == CAR), "ap50 is of cars alone"
    assert flying == len(matched(right, mission=False))


def test_trucks_that_are_called_cars_cost_the_ap_of_both() -> None:
    told = outcome(flown(*TRUCKS, trucks_are_cars=True))["ap_by_class"]
    assert told["truck"] == {"full_scene": 0.0, "mission": told["truck"]["mission"]}
    assert 0.4 < told["car"]["full_scene"] < 0.95
    assert told["person"] == {"full_scene": None, "mission": None}, "nobody looks for people"


def test_without_other_classes_the_record_has_no_class_and_the_outcome_says_it_once() -> None:
    plain = flown("duration_s=4")
    for name in ("detections", "truths"):
        assert plain.tables[name].column_names == list(TABLES[name])
    told = outcome(plain)
    assert {v for ap in told["ap_by_class"].values() for v in ap.values()} == {None}
    assert told["ap50"]["full_scene"] == pytest.approx(1.0)


def test_hota_judges_vehicles_alone() -> None:
    """A car of its own detector knows no identity, so the surrogate flies; people have no overlap to be judged by.

    Nothing is sent, because boxes of people would change when the others' frames are on the air.
    """
    quiet = ("duration_s=5", "perception.detector=surrogate", "policy={name: silence}")
    with_, without = (outcome(run_sortie(example(*quiet, *more))) for more in ((WALKS, SURE), ()))
    assert with_["tracking"] == without["tracking"]
    assert with_["tracking"]["hota"] is not None
    assert with_["ap50"]["full_scene"] == without["ap50"]["full_scene"]


def test_a_run_with_classes_is_read_back_and_drawn(right: SortieRecord, tmp_path: Path) -> None:
    save(right, tmp_path / "run")
    again = load(tmp_path / "run")
    assert again.fingerprint == right.fingerprint
    assert outcome(again)["ap_by_class"] == outcome(right)["ap_by_class"]
    save_rrd(right, tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").stat().st_size > 10_000
    assert "trucks" in legend(right.scenario).text.as_arrow_array()[0].as_py()  # type: ignore[union-attr]
    assert "Accuracy, people" in page(right)
    assert "AP of trucks" in str(Summary(outcome_table(outcome(right))))


def test_what_was_missed_is_of_the_class_that_was_missed() -> None:
    """Every truck is called a car: it is a false car and a missed truck, in the playback and in nothing else."""
    record = flown(*TRUCKS, trucks_are_cars=True)
    for seen in sightings(record.tables, Regions(record.tables["mission"], record.scenario.mission)):
        assert set(seen.missed.kind.tolist()) <= {TRUCK}
        assert set(seen.hits.kind.tolist()) == {CAR}
        assert len(seen.missed) == len(seen.false)
        assert seen.full.truths == len(seen.hits)


def test_the_playbacks_accuracy_is_of_cars_among_cars(right: SortieRecord) -> None:
    """A truck that is found as a truck is neither a car nor a false one."""
    seen = list(sightings(right.tables, Regions(right.tables["mission"], right.scenario.mission)))
    assert any(TRUCK in each.hits.kind for each in seen)
    for each in seen:
        cars = int((each.hits.kind == CAR).sum())
        assert (each.full.truths, each.full.hit.tolist()) == (cars, [True] * cars)


def test_a_comparison_has_a_row_for_each_class() -> None:
    scenario = example("duration_s=4", "perception.detector=surrogate", WALKS, SURE)
    contenders = [Contender("silence", scenario, lambda view: []), Contender("boxes", scenario, boxes_to_all)]
    rows = [str(cell) for cell in comparison_table(compare(contenders, [1])).columns[0].cells]
    assert "AP of people, full scene" in rows
    assert not [row for row in rows if "trucks" in row]
