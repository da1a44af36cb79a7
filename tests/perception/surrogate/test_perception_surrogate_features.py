"""What looks say of a car's surroundings, against every pair of cars one by one."""

from __future__ import annotations

import numpy as np
import pytest

from sortie.perception.scene.height_field import RES_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.features import LOOK_COVARIATES, NEXT_M, CaptureColumns, Eyes, Traffic, axes
from sortie.perception.surrogate.kerbs import NEAR_M, Kerbs, next_of
from sortie.perception.types import Capture
from sortie.scenarios.schema import Scene, Target

COLUMN = {name: k for k, name in enumerate(LOOK_COVARIATES)}
TARGET = Target(waypoints_m=((-60.0, -1.75), (200.0, -1.75)), speed_mps=5)


def capture(t_s: float, drone: int = 0) -> Capture:
    at = (-60.0 + 5.0 * t_s + 20.0 * drone, 0.0, 60.0)
    return Capture(drone, t_s, at, (0.0, 0.0, 0.0, 1.0), at, 0.0)


@pytest.mark.parametrize("style", ["town", "old_town"])
def test_the_next_car_is_the_nearest_of_all_parked_driving_or_the_target(style: str) -> None:
    scene = SceneModel(Scene(style=style, parked_density=0.5, moving_cars_per_km=14), TARGET, (-60, -20, 200, 20))
    captures = [capture(t, d) for t in (0.0, 3.7, 20.0) for d in range(2)]
    looks, seen = Eyes(scene).look(CaptureColumns.of(captures)), set()
    for k, (of, here, yaw) in enumerate(zip(looks.capture, looks.world_m, looks.yaw_rad, strict=True)):
        cars = scene.cars_at(captures[of].t_s)
        away = np.stack([cars.x_m, cars.y_m], axis=1) - here
        itself, following = np.argsort(np.hypot(*away.T))[:2]
        close = max(0.0, 1.0 - float(np.hypot(*away[following])) / NEXT_M)
        found = looks.covariates[k]
        assert found[COLUMN["next"]] == pytest.approx(close, abs=1e-5)
        angle, _ = axes(np.array([yaw]), here[None] - captures[of].position_m[:2])
        ahead = np.array([np.cos(angle[0]), np.sin(angle[0])])
        along = close * float(away[following] @ ahead) / max(float(np.hypot(*away[following])), 0.1)
        assert found[COLUMN["next_along"]] == pytest.approx(along, abs=1e-5)
        across = np.sqrt(max(close**2 - along**2, 0.0))
        assert abs(found[COLUMN["next_across"]]) == pytest.approx(across, abs=2e-3)
        if close:
            seen.add((bool(cars.ids[itself] == 0), bool(cars.ids[following] == 0)))
    assert seen == {(False, False), (False, True), (True, False)}  # and the target is next to something


def test_the_next_car_is_that_of_plain_loops_to_the_last_bit() -> None:
    """Also between cars at equal distances, and in the same place."""
    scene = SceneModel(Scene(parked_density=0.9, moving_cars_per_km=60), TARGET, (-60, -20, 100, 20))
    traffic, rng = Traffic(scene), np.random.Generator(np.random.PCG64(3))
    parked = np.flatnonzero(rng.random(traffic.parked) < 0.7)
    xy, _, there = traffic.at(np.array([0.0, 1.0, 7.3]), parked)
    first = len(parked)
    xy[2, first:] = np.round(xy[2, first:] / 4) * 4
    expected = np.full(xy.shape, np.inf)
    for at, here, to in zip(xy, there, expected, strict=True):
        for k in np.flatnonzero(here):
            away = at - at[k]
            far = np.where(here, away[:, 0] ** 2 + away[:, 1] ** 2, np.inf)
            far[k] = np.inf
            others = [far.argmin()]
            if k < first:  # of its like all that park count, also those that are not among these
                to[k] = next_of(traffic.parked_xy)[parked[k]]
                others = [j for j in [first + far[first:].argmin()] if far[j] < to[k, 0] ** 2 + to[k, 1] ** 2]
            for j in others:
                to[k] = away[j]
            if to[k, 0] ** 2 + to[k, 1] ** 2 > NEXT_M**2:
                to[k] = np.inf
    found = traffic.next_to(parked, xy, there)
    for now, (mine, plain) in enumerate(zip(found, expected, strict=True)):
        assert np.isfinite(plain[there[now]]).mean() > 0.3
        np.testing.assert_array_equal(mine[there[now]], plain[there[now]])


def test_a_car_that_is_alone_has_none_next_to_it() -> None:
    scene = SceneModel(Scene(parked_density=0.0, moving_cars_per_km=0), TARGET, (-60, -20, 200, 20))
    covariates = Eyes(scene).look(CaptureColumns.of([capture(4.0)])).covariates
    assert len(covariates) == 1
    assert not covariates[:, [COLUMN[n] for n in ("next", "next_along", "next_across")]].any()


def test_how_near_parked_cars_are_is_the_nearest_ones_on_the_raster_and_at_the_edge() -> None:
    scene = SceneModel(Scene(parked_density=0.5, style="old_town"), None, (-60, -20, 60, 20))
    kerbs, cars, (x0, y0, x1, y1) = Kerbs(scene), scene.parked_cars, scene.rect
    rng = np.random.Generator(np.random.PCG64(2))
    x, y = rng.uniform(x0, x1, 3000), rng.uniform(y0, y1, 3000)
    x[:40], y[:40] = np.repeat((x0, x1), 20), rng.uniform(y0, y1, 40)

    def pixel(at: np.ndarray, corner: float) -> np.ndarray:
        return ((at - corner) / RES_M).astype(int)

    away = np.hypot(pixel(x, x0)[:, None] - pixel(cars.x_m, x0), pixel(y, y0)[:, None] - pixel(cars.y_m, y0)) * RES_M
    expected = np.maximum(0.0, 1.0 - away.min(axis=1) / NEAR_M)
    assert 0.1 < (expected > 0).mean() < 0.9
    np.testing.assert_allclose(kerbs.near(x, y), expected, atol=1e-6)
    gap = np.hypot(cars.x_m[:, None] - cars.x_m, cars.y_m[:, None] - cars.y_m)
    np.fill_diagonal(gap, np.inf)
    np.testing.assert_allclose(kerbs.parked, np.maximum(0.0, 1.0 - gap.min(axis=1) / NEAR_M), atol=1e-6)


def test_a_car_that_stands_alone_has_no_next_one() -> None:
    assert np.isinf(next_of(np.array([[3.0, 4.0]]))).all()
    assert next_of(np.zeros((0, 2))).shape == (0, 2)
