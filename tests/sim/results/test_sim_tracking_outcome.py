"""HOTA in the outcome: from what is detected, by which car is which."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyarrow as pa
import pytest
from recorded import recorded

from sortie.perception.classes import CAR, TRUCK
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Capture
from sortie.scenarios.reading.load import load
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord


def with_tables(**tables: pa.Table) -> SortieRecord:
    record = recorded("surrogate")
    return dataclasses.replace(record, tables={**record.tables, **tables})


def with_cars(numbers: np.ndarray) -> SortieRecord:
    truths = recorded("surrogate").tables["truths"]
    return with_tables(truths=truths.set_column(truths.column_names.index("car"), "car", pa.array(numbers, pa.int32())))


def test_cars_that_change_places_cost_association_and_no_detection() -> None:
    record = recorded("surrogate")
    before = outcome(record)["tracking"]
    assert 0.0 < before["hota"] < before["ass_a"] < 1.0
    assert 0.0 < before["det_a"] < 1.0
    truths = record.tables["truths"]
    late, car = truths["t_s"].to_numpy() > 3.0, truths["car"].to_numpy()
    after = outcome(with_cars(np.where(late, car + 100_000, car)))["tracking"]
    assert after["ass_a"] < 0.8 * before["ass_a"]
    assert after["det_a"] == pytest.approx(before["det_a"], rel=0.1)


def test_a_vehicle_that_is_taken_for_one_of_another_class_is_not_followed() -> None:
    truths = recorded("surrogate").tables["truths"]
    every_car = truths.drop_columns(["car"]).append_column("score", pa.array(np.full(truths.num_rows, 0.9)))
    cars, trucks = (np.full(truths.num_rows, kind, np.int8) for kind in (CAR, TRUCK))

    def judged(there: np.ndarray, found: np.ndarray) -> dict[str, float | None]:
        kinds = {"truths": (truths, there), "detections": (every_car, found)}
        return outcome(
            with_tables(**{name: table.append_column("kind", pa.array(k)) for name, (table, k) in kinds.items()})
        )["tracking"]

    assert judged(cars, cars) == judged(trucks, trucks) == outcome(with_tables(detections=every_car))["tracking"]
    assert judged(trucks, cars) == judged(cars, trucks) == {"hota": 0.0, "det_a": 0.0, "ass_a": 0.0}


def test_without_identities_or_a_detector_there_is_none() -> None:
    nameless = with_cars(np.full(recorded("surrogate").tables["truths"].num_rows, -1))
    nothing = {"hota": None, "det_a": None, "ass_a": None}
    assert outcome(nameless)["tracking"] == outcome(recorded("base"))["tracking"] == nothing


def test_a_car_has_the_number_that_the_scene_gives_it() -> None:
    scenario = load("track_target")
    scene = SceneModel(scenario.perception.scene, scenario.mission.target, (-240.0, 0.0, 400.0, 160.0))
    ego = Capture(0, 3.0, (-220.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (-220.0, 0.0, 60.0), 0.0)
    truth, cars = SurrogateDetector(scene, scenario.perception, 1).truth(3.0, ego), scene.cars_at(3.0)
    where = {i: (x, y) for i, x, y in zip(cars.ids.tolist(), cars.x_m, cars.y_m, strict=True)}
    assert 0 in truth.car.tolist()
    assert len(set(truth.car.tolist())) == len(truth) > 20
    np.testing.assert_allclose(truth.xy_m, [where[i] for i in truth.car.tolist()], atol=1e-4)
