"""HOTA in the outcome: from what is detected, by which car is which."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from sortie.perception.classes import CAR, TRUCK
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Capture
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.tracking_outcome import tracking_outcome


@cache
def flown(detector: str = "surrogate") -> SortieRecord:
    return run_sortie(load("track_target", [f"perception.detector={detector}", "duration_s=12"]))


def with_table(record: SortieRecord, name: str, table: pa.Table) -> SortieRecord:
    return dataclasses.replace(record, tables={**record.tables, name: table})


def as_seen(truths: pa.Table) -> pa.Table:
    """A detector that finds every car where it is."""
    return truths.drop_columns(["car"]).append_column("score", pa.array(np.full(truths.num_rows, 0.9)))


def test_it_stands_in_the_outcome() -> None:
    value = outcome(flown())["tracking"]
    assert 0.0 < value["hota"] < value["ass_a"] < 1.0
    assert 0.0 < value["det_a"] < 1.0


def test_cars_that_change_places_cost_association_and_no_detection() -> None:
    record = flown()
    truths = record.tables["truths"]
    late = truths["t_s"].to_numpy() > 6.0
    car = truths["car"].to_numpy()
    swapped = np.where(late, car + 100_000, car)
    other = with_table(record, "truths", truths.set_column(truths.column_names.index("car"), "car", pa.array(swapped)))
    before, after = tracking_outcome(record), tracking_outcome(other)
    assert after["ass_a"] < 0.8 * before["ass_a"]
    assert after["det_a"] == pytest.approx(before["det_a"], rel=0.1)


def test_a_vehicle_that_is_taken_for_one_of_another_class_is_not_followed() -> None:
    record = flown()
    truths = record.tables["truths"]
    found, classes = as_seen(truths), [np.full(truths.num_rows, kind, np.int8) for kind in (CAR, TRUCK)]

    def judged(there: np.ndarray, told: np.ndarray) -> dict[str, float | None]:
        tables = {
            "truths": truths.append_column("kind", pa.array(there)),
            "detections": found.append_column("kind", pa.array(told)),
        }
        return tracking_outcome(dataclasses.replace(record, tables={**record.tables, **tables}))

    cars, trucks = classes
    assert judged(cars, cars) == judged(trucks, trucks) == tracking_outcome(with_table(record, "detections", found))
    assert judged(trucks, cars) == judged(cars, trucks) == {"hota": 0.0, "det_a": 0.0, "ass_a": 0.0}


def test_without_identities_or_a_detector_there_is_none() -> None:
    record = flown()
    truths = record.tables["truths"]
    unknown = pa.array(np.full(truths.num_rows, -1, np.int32))
    nameless = with_table(record, "truths", truths.set_column(truths.column_names.index("car"), "car", unknown))
    nothing = {"hota": None, "det_a": None, "ass_a": None}
    assert tracking_outcome(nameless) == tracking_outcome(flown("none")) == nothing


def test_a_car_has_the_number_that_the_scene_gives_it() -> None:
    scenario = load("track_target")
    scene = SceneModel(scenario.perception.scene, scenario.mission.target, (-240.0, 0.0, 400.0, 160.0))
    ego = Capture(0, 3.0, (-220.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (-220.0, 0.0, 60.0), 0.0)
    truth, cars = SurrogateDetector(scene, scenario.perception, 1).truth(3.0, ego), scene.cars_at(3.0)
    where = {i: (x, y) for i, x, y in zip(cars.ids.tolist(), cars.x_m, cars.y_m, strict=True)}
    assert 0 in truth.car.tolist()
    assert len(set(truth.car.tolist())) == len(truth) > 20
    np.testing.assert_allclose(truth.xy_m, [where[i] for i in truth.car.tolist()], atol=1e-4)
