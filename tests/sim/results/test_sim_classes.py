"""AP of each class in the outcome, from records of detectors that are right, or wrong about the class alone."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import recorded
from sim_examples import example

from sortie.perception.classes import CAR, PERSON, TRUCK, vehicle_classes
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.playback.layout import legend
from sortie.sim.playback.recording import save_rrd
from sortie.sim.results.accuracy import matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES, SortieRecord
from sortie.sim.results.regions import Regions
from sortie.sim.results.report import page
from sortie.sim.results.run_folder import load, save
from sortie.sim.results.sightings import Sighting, sightings
from sortie.sim.results.summary import Summary, outcome_table

TRUCKS = ("duration_s=4", "perception.detector=surrogate", "perception.scene={trucks: 0.4, moving_cars_per_km: 30}")
ALL_IN_VIEW = (
    "perception.scene.building_density=0",
    "perception.scene.tree_density=0",
    "perception.people=[{waypoints_m: [[20, 20], [24, 24]]}]",
    "perception.thermal={near_probability: 1, half_range_m: 2000, position_error_m: 0, false_alarms_per_min: 0, "
    "field_of_view_deg: 150}",
)


class AllSeeing:
    """Finds every vehicle where it is, and says of what class it is."""

    def __init__(self, scene: SceneModel, *, trucks_are_cars: bool) -> None:
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


@functools.cache
def flown(*, trucks_are_cars: bool = False) -> SortieRecord:
    """A flight of its own: of the detector above. People are in it where the detector is right."""
    made: Any = lambda scene, *_: AllSeeing(scene, trucks_are_cars=trucks_are_cars)  # noqa: E731
    return run_sortie(example(*TRUCKS, *(() if trucks_are_cars else ALL_IN_VIEW)), "silence", detector_of=made)


def seen_in(record: SortieRecord) -> list[Sighting]:
    return list(sightings(record.tables, Regions(record.tables["mission"], record.scenario.mission)))


def test_a_detector_that_is_right_about_every_class_has_an_ap_of_one() -> None:
    right = flown()
    found = outcome(right)
    assert {name: ap["full_scene"] for name, ap in found["ap_by_class"].items()} == pytest.approx(
        {"car": 1.0, "truck": 1.0, "person": 1.0}
    )
    assert found["ap50"]["full_scene"] == found["ap_by_class"]["car"]["full_scene"]
    kinds = right.tables["truths"]["kind"].to_numpy()
    assert [np.count_nonzero(kinds == k) > 20 for k in (CAR, TRUCK, PERSON)] == [True] * 3
    cars = sum(m.truths for m in matched(right, mission=False).values())
    assert cars == np.count_nonzero(kinds == CAR), "ap50 is of cars alone"
    assert right.tables["fusions"].num_rows == len(matched(right, mission=False))


def test_trucks_that_are_called_cars_cost_the_ap_of_both() -> None:
    """Each is a false car and a missed truck, in the playback too, and nothing else."""
    wrong = flown(trucks_are_cars=True)
    found = outcome(wrong)["ap_by_class"]
    assert found["truck"]["full_scene"] == 0.0
    assert 0.4 < found["car"]["full_scene"] < 0.95
    assert found["person"] == {"full_scene": None, "mission": None}, "nobody looks for people"
    for seen in seen_in(wrong):
        assert set(seen.missed.kind.tolist()) <= {TRUCK}
        assert set(seen.hits.kind.tolist()) == {CAR}
        assert len(seen.missed) == len(seen.false)
        assert seen.full.truths == len(seen.hits)


def test_the_playback_s_accuracy_is_of_cars_among_cars() -> None:
    """A truck that is found as a truck is neither a car nor a false one."""
    seen = seen_in(flown())
    assert any(TRUCK in each.hits.kind for each in seen)
    for each in seen:
        cars = int((each.hits.kind == CAR).sum())
        assert (each.full.truths, each.full.hit.tolist()) == (cars, [True] * cars)


def test_without_other_classes_the_record_has_no_class() -> None:
    plain = recorded("surrogate")
    for name in ("detections", "truths"):
        assert plain.tables[name].column_names == list(TABLES[name])
    assert {v for ap in outcome(plain)["ap_by_class"].values() for v in ap.values()} == {None}


def test_a_run_with_classes_is_read_back_and_drawn(tmp_path: Path) -> None:
    right = flown()
    again = load(save(right, tmp_path / "run"))
    assert again.fingerprint == right.fingerprint
    assert outcome(again)["ap_by_class"] == outcome(right)["ap_by_class"]
    save_rrd(right, tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").stat().st_size > 10_000
    assert "trucks" in legend(right.scenario).text.as_arrow_array()[0].as_py()  # type: ignore[union-attr]
    assert "Accuracy, people" in page(right)
    assert "AP of trucks" in str(Summary(outcome_table(outcome(right))))
