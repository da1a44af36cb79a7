"""Cars are a function of time: speeds, wraps, the target's path, and what the bounds may not change."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.traffic import TARGET_ID, TargetPath
from sortie.scenarios.schema import Scene, Target

BOUNDS = (-100.0, -100.0, 200.0, 150.0)


@pytest.fixture(scope="module")
def model() -> SceneModel:
    return SceneModel(Scene(), Target(waypoints_m=((0, 0), (30, 0), (30, 40)), speed_mps=5.0), BOUNDS)


@pytest.mark.parametrize(
    ("t_s", "pose"),
    [
        (0.0, (0, 0, 0)),
        (2.0, (10, 0, 0)),
        (8.0, (30, 10, np.pi / 2)),
        (14.0, (30, 40, np.pi / 2)),
        (99.0, (30, 40, np.pi / 2)),
    ],
)
def test_the_target_follows_its_waypoints_and_stays(model: SceneModel, t_s: float, pose: tuple[float, ...]) -> None:
    cars = model.cars_at(t_s)
    assert cars.ids[0] == TARGET_ID
    assert (cars.x_m[0], cars.y_m[0], cars.yaw_rad[0]) == pytest.approx(pose)


def test_a_waypoint_given_twice_does_not_stop_the_target() -> None:
    path = TargetPath.of(Target(waypoints_m=((0, 0), (10, 0), (10, 0), (20, 0)), speed_mps=1.0))
    assert path.pose(15.0) == pytest.approx((15, 0, 0))


def test_moving_cars_keep_their_speed_and_parked_ones_their_place(model: SceneModel) -> None:
    a, b = model.cars_at(10.0), model.cars_at(10.5)
    both, ia, ib = np.intersect1d(a.ids, b.ids, return_indices=True)
    step = np.hypot(b.x_m[ib] - a.x_m[ia], b.y_m[ib] - a.y_m[ia]) / 0.5
    parked = np.isin(both, model.parked_cars.ids)
    assert parked.sum() > 50
    assert (step[parked] == 0).all()
    moving = step[~parked & (both != TARGET_ID)]
    moving = moving[moving < 100]  # the others left at one edge and came in at the other
    assert len(moving) > 30
    assert (moving > 0.74 * 8).all()
    assert (moving < 1.26 * 8).all()


def test_cars_keep_to_the_right(model: SceneModel) -> None:
    cars = model.moving_cars(4.0).where(model.moving_cars(4.0).ids != TARGET_ID)
    right_x, right_y = np.sin(cars.yaw_rad), -np.cos(cars.yaw_rad)
    from_road_x = (cars.x_m + 40) % 80 - 40
    from_road_y = (cars.y_m + 40) % 80 - 40
    along_x = np.abs(np.cos(cars.yaw_rad)) > 0.5
    offset = np.where(along_x, from_road_y * right_y, from_road_x * right_x)
    assert offset == pytest.approx(1.6)


@settings(max_examples=20, deadline=None)
@given(t_s=st.floats(0, 600), x=st.floats(-100, 200), y=st.floats(-100, 150), radius=st.floats(1, 150))
def test_cars_near_counts_what_cars_at_shows(t_s: float, x: float, y: float, radius: float) -> None:
    model = SceneModel(Scene(), Target(waypoints_m=((0, 0),)), BOUNDS)
    cars = model.cars_at(t_s)
    assert model.cars_near(t_s, x, y, radius) == int(np.sum((cars.x_m - x) ** 2 + (cars.y_m - y) ** 2 <= radius**2))


@pytest.mark.parametrize("t_s", [0.0, 33.3, 400.0])
def test_wider_bounds_only_add_cars(t_s: float) -> None:
    def inside(bounds: tuple[float, float, float, float]) -> set[tuple[float, float]]:
        cars = SceneModel(Scene(), None, bounds).cars_at(t_s)
        keep = (np.abs(cars.x_m) < 200) & (np.abs(cars.y_m) < 200)
        return {(round(x, 6), round(y, 6)) for x, y in zip(cars.x_m[keep], cars.y_m[keep], strict=True)}

    assert inside((-10, -10, 10, 10)) == inside((-900, -300, 1500, 40))


def test_time_may_be_asked_in_any_order(model: SceneModel) -> None:
    first = model.cars_at(7.0)
    model.cars_at(99.0)
    again = model.cars_at(7.0)
    assert np.array_equal(first.x_m, again.x_m)
    assert np.array_equal(first.ids, again.ids)


def test_ids_are_unique_and_as_many_cars_are_near_as_meant(model: SceneModel) -> None:
    cars = model.cars_at(12.0)
    assert len(set(cars.ids.tolist())) == len(cars)
    counts = [
        np.sum((np.abs(cars.x_m - x) < 102.4) & (np.abs(cars.y_m - y) < 102.4)) for x in (0, 100, 200) for y in (0, 100)
    ]
    assert 20 <= np.mean(counts) <= 65


def test_bounds_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(ValueError, match=r"bounds are \(1, 0, 0, 1\), must be \(x_min, y_min, x_max, y_max\)"):
        SceneModel(Scene(), None, (1, 0, 0, 1))
