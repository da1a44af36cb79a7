"""Every covariate of a look by plain geometry, car by car, and a car's neighbours against every pair of cars."""

from __future__ import annotations

import numpy as np
import pytest
from perception_examples import capture
from scipy.spatial.transform import Rotation

from sortie.perception.geometry import Cameras, camera_margins
from sortie.perception.scene.height_field import RES_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.features import (
    LOOK_COVARIATES,
    NEXT_M,
    CaptureColumns,
    Eyes,
    Looks,
    Traffic,
    axes,
    square,
)
from sortie.perception.surrogate.kerbs import NEAR_M, Kerbs, next_of
from sortie.perception.types import Capture
from sortie.scenarios.schema import Scene, Target

TOWN = Scene(
    parked_density=0.2, moving_cars_per_km=9, sun_elevation_deg=20, overcast=0.3, brightness=1.2, building_density=0.8
)


SCENE = SceneModel(
    TOWN, Target(waypoints_m=((-60.0, 0.0), (-10.0, 0.0), (-10.0, 60.0)), speed_mps=6.0), (-60, -60, 60, 60)
)


FLEET = [
    capture(-20.0, 10.0, 48.0, yaw=0.5, pitch=0.08, roll=-0.05, t_s=4.0, est=(-15.0, 14.0, 54.0, 1.4)),
    capture(15.0, -5.0, 61.0, yaw=-2.2, pitch=-0.1, roll=0.2, drone=1, t_s=12.5)._replace(cameras=Cameras(96.0, 30.0)),
]


@pytest.fixture(scope="module")
def looks() -> Looks:
    return Eyes(SCENE).look(CaptureColumns.of(FLEET))


def of(looks: Looks, k: int, name: str) -> np.ndarray:
    return np.asarray(looks.covariates[looks.capture == k][:, LOOK_COVARIATES.index(name)], float)


def cars_of(looks: Looks, k: int, ego: Capture) -> tuple[np.ndarray, ...]:
    """Of each look of a capture: place, heading, length, colour and whether it moves, from the scene itself."""
    cars = SCENE.cars_at(ego.t_s)
    at = looks.world_m[looks.capture == k]
    which = np.hypot(cars.x_m[:, None] - at[:, 0], cars.y_m[:, None] - at[:, 1]).argmin(axis=0)
    assert len(set(which.tolist())) == len(which)
    np.testing.assert_allclose(np.stack([cars.x_m, cars.y_m], axis=1)[which], at, atol=1e-6)
    parked = np.isin(which, np.flatnonzero(np.isin(cars.x_m, SCENE.parked_cars.x_m)))
    return at, cars.yaw_rad[which], cars.length_m[which], cars.colour[which].astype(float), ~parked


@pytest.mark.parametrize("k", [0, 1])
def test_a_look_is_of_every_car_in_the_true_square_where_the_map_shows_it(k: int, looks: Looks) -> None:
    """In the drone's true frame, farther out by as much as it believes to be too high."""
    ego, cars = FLEET[k], SCENE.cars_at(FLEET[k].t_s)
    x, y, yaw = ego.true_pose
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, left = c * (cars.x_m - x) + s * (cars.y_m - y), c * (cars.y_m - y) - s * (cars.x_m - x)
    inside = (np.abs(ahead) < 102.4) & (np.abs(left) < 102.4)
    mine = looks.capture == k
    assert mine.sum() == inside.sum() > 15
    stretch = ego.est_position_m[2] / ego.position_m[2]
    expected = stretch * np.stack([ahead, left], axis=1)[inside]
    found = looks.xy_m[mine]
    order, other = np.lexsort(expected.T), np.lexsort(found.T)
    np.testing.assert_allclose(found[other], expected[order], atol=1e-4)


@pytest.mark.parametrize("k", [0, 1])
def test_a_look_is_as_the_drone_truly_hangs_in_the_air(k: int, looks: Looks) -> None:
    ego = FLEET[k]
    at, heading, length, _, moving = cars_of(looks, k, ego)
    x, y, yaw = ego.true_pose
    height = ego.position_m[2]
    np.testing.assert_allclose(of(looks, k, "range"), np.hypot(at[:, 0] - x, at[:, 1] - y) / 100, atol=1e-5)
    seen_from = np.column_stack([at - (x, y), np.full(len(at), 0.8 - height)])
    body = Rotation.from_quat(ego.orientation_xyzw).inv().apply(seen_from)
    down, side = camera_margins(*body.T, ego.cameras.lens)
    np.testing.assert_array_equal(of(looks, k, "nadir"), down > 0)
    np.testing.assert_allclose(of(looks, k, "margin"), np.clip(np.maximum(down, side), -0.4, 0.4), atol=1e-4)
    assert 0 < (down > 0).sum() < len(down)
    bearing = np.arctan2(at[:, 1] - y, at[:, 0] - x)
    np.testing.assert_allclose(of(looks, k, "across"), np.abs(np.sin(heading - bearing)), atol=1e-4)
    np.testing.assert_array_equal(of(looks, k, "moving"), moving)
    assert 3 < moving.sum() < len(moving)
    np.testing.assert_allclose(of(looks, k, "length"), np.minimum(length, 5.8) - 4.6, atol=1e-6)
    np.testing.assert_allclose(of(looks, k, "altitude"), height / 60 - 1, atol=1e-6)
    np.testing.assert_allclose(of(looks, k, "strange"), abs(height / 60 - 1), atol=1e-6)
    np.testing.assert_allclose(of(looks, k, "square"), square(heading - yaw), atol=1e-4)


@pytest.mark.parametrize("k", [0, 1])
def test_a_car_is_seen_in_parts_of_its_length_and_as_bright_as_it_stands_in_the_light(k: int, looks: Looks) -> None:
    """Of three points along it; in the shadow it has a part of its light, the more the more cloud there is."""
    ego = FLEET[k]
    at, heading, length, colour, _ = cars_of(looks, k, ego)
    eye = np.tile(ego.position_m, (len(at), 1))
    along = 0.35 * np.minimum(length, 5.8)[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    seen = [SCENE.height_field.seen(*(at + k * along).T, eye) for k in (-1, 0, 1)]
    np.testing.assert_allclose(of(looks, k, "visible"), np.mean(seen, axis=0), atol=1e-6)
    assert len(set(np.sum(seen, axis=0).tolist())) > 2
    lit = SCENE.height_field.lit(*at.T)
    np.testing.assert_array_equal(of(looks, k, "lit"), lit)
    assert 0 < lit.sum() < len(lit)
    light = np.where(lit, 1.0, 0.6 + 0.4 * 0.3)
    tone = colour @ [0.299, 0.587, 0.114] / 255
    np.testing.assert_allclose(of(looks, k, "tone"), 1.2 * (tone * light - 0.34), atol=1e-5)
    tint = (colour.max(axis=1) - colour.min(axis=1)) / 255
    np.testing.assert_allclose(of(looks, k, "tint"), 1.2 * tint * light, atol=1e-5)
    np.testing.assert_allclose(of(looks, k, "shade"), 0.7 * 2.5, atol=1e-6)  # at most two and a half times as high
    np.testing.assert_allclose(of(looks, k, "brightness"), 0.2, atol=1e-6)


def test_a_drone_s_looks_do_not_depend_on_who_else_looks_nor_when(looks: Looks) -> None:
    for k, ego in enumerate(FLEET):
        alone = Eyes(SCENE).look(CaptureColumns.of([ego]))
        np.testing.assert_array_equal(alone.covariates, looks.covariates[looks.capture == k])
        np.testing.assert_array_equal(alone.xy_m, looks.xy_m[looks.capture == k])
        np.testing.assert_array_equal(alone.yaw_rad, looks.yaw_rad[looks.capture == k])


COLUMN = {name: k for k, name in enumerate(LOOK_COVARIATES)}
DRIVES = Target(waypoints_m=((-60.0, -1.75), (200.0, -1.75)), speed_mps=5)


def passing(t_s: float, drone: int = 0) -> Capture:
    at = (-60.0 + 5.0 * t_s + 20.0 * drone, 0.0, 60.0)
    return Capture(drone, t_s, at, (0.0, 0.0, 0.0, 1.0), at, 0.0)


@pytest.mark.parametrize("style", ["town", "old_town"])
def test_the_next_car_is_the_nearest_of_all_parked_driving_or_the_target(style: str) -> None:
    scene = SceneModel(Scene(style=style, parked_density=0.5, moving_cars_per_km=14), DRIVES, (-60, -20, 200, 20))
    captures = [passing(t, d) for t in (0.0, 3.7, 20.0) for d in range(2)]
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
    scene = SceneModel(Scene(parked_density=0.9, moving_cars_per_km=60), DRIVES, (-60, -20, 100, 20))
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
    scene = SceneModel(Scene(parked_density=0.0, moving_cars_per_km=0), DRIVES, (-60, -20, 200, 20))
    covariates = Eyes(scene).look(CaptureColumns.of([passing(4.0)])).covariates
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
