"""Boxes with uncertainty: the fitted covariances, and how a receiver joins them."""

from __future__ import annotations

import numpy as np
import pytest

from research.train.box_errors import Errors, calibration, common, errors_of, fit
from sortie.perception.types import Boxes
from sortie.perception.uncertainty import BoxErrors

HERE = (0.0, 0.0, 0.0)
FITTED = BoxErrors((-0.7, -0.2, 0.01, 0.6, -0.1), (-0.6, -0.2, 0.02, 0.2, 0.05), 0.17)


def boxes(*rows: tuple[float, float, float]) -> Boxes:
    table = np.array([(x, y, 4.5, 1.9, 0.0, score) for x, y, score in rows])
    return Boxes.placed(table.reshape(-1, 6), HERE)


def synthetic(rng: np.random.Generator, model: BoxErrors, shared: float) -> list[Errors]:
    """Five drones' normal errors of the same cars, as the model has them, with a part in common."""
    cars = 60
    together = rng.normal(size=(cars, 2))
    out = []
    for _ in range(5):
        score, distance, angle = rng.uniform(0.1, 0.95, cars), rng.uniform(5, 120, cars), rng.uniform(0, 7, cars)
        sight = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        mixed = np.sqrt(shared) * together + np.sqrt(1.0 - shared) * rng.normal(size=(cars, 2))
        c, s = sight.T
        own = np.stack([c * mixed[:, 0] + s * mixed[:, 1], c * mixed[:, 1] - s * mixed[:, 0]], axis=1)
        own = own * model.deviations_m(score, distance)
        back = np.stack([c * own[:, 0] - s * own[:, 1], s * own[:, 0] + c * own[:, 1]], axis=1)
        out.append(Errors(np.arange(cars), score, distance, sight, back))
    return out


def test_the_fit_finds_what_errors_were_drawn_by_and_is_calibrated_on_others() -> None:
    rng = np.random.default_rng(3)
    first, second = ([synthetic(rng, FITTED, 0.3) for _ in range(60)] for _ in range(2))
    model = fit(first)
    at = rng.uniform(0.15, 0.9, 200), rng.uniform(10, 110, 200)
    np.testing.assert_allclose(model.deviations_m(*at), FITTED.deviations_m(*at), rtol=0.06)
    assert model.common == pytest.approx(0.3, abs=0.03)
    found = calibration(model, second)
    assert found.boxes == 60 * 5 * 60
    assert found.within == pytest.approx((0.6827, 0.9545), abs=0.01)
    assert found.within_ellipse == pytest.approx((0.3935, 0.8647), abs=0.01)
    near = calibration(model, second, lambda e: e.distance_m < 40.0)
    assert near.boxes < found.boxes
    assert near.within == pytest.approx((0.6827, 0.9545), abs=0.02)
    assert common(model, [synthetic(rng, FITTED, 0.0) for _ in range(60)]) == pytest.approx(0.0, abs=0.03)


def test_errors_are_those_of_boxes_that_lie_on_a_car_each_car_once() -> None:
    cars = np.array([[30.0, 40.0, 4.5, 1.9, 0.0], [np.nan] * 5, [-50.0, 0.0, 4.5, 1.9, 0.0]])
    found = errors_of(boxes((30.6, 40.8, 0.9), (30.0, 40.1, 0.8), (90, 0, 0.7), (-50, 0.4, 0.6)), HERE, cars)
    assert found.car.tolist() == [0, 1]
    assert found.score == pytest.approx([0.9, 0.6])
    np.testing.assert_allclose(found.off_m, [[0.6, 0.8], [0.0, 0.4]], atol=1e-5)
    np.testing.assert_allclose(found.by_sight_m, [[1.0, 0.0], [0.0, -0.4]], atol=0.01)
    with pytest.raises(ValueError, match="2 boxes lie on a car, must be at least 100"):
        fit([[found]])
