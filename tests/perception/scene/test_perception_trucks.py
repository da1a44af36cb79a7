"""Trucks: their sizes, the gaps between them, what they hide, and how detectors see them. People in pictures."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from perception_examples import EMPTY, capture

from sortie.perception.classes import PERSON_SIZE_M, TRUCK_FROM_M
from sortie.perception.metrics.overlap import overlapping
from sortie.perception.scene.behind_trucks import behind
from sortie.perception.scene.height_field import CAR_TOP_M, TRUCK_TOP_M, HeightField
from sortie.perception.scene.render import CAMERAS, Renderer, Window
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats, Town
from sortie.perception.scene.traffic import Cars, lanes
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.thermal import look
from sortie.scenarios.schema import Person, Scene, Thermal

AREA = (-200.0, -200.0, 200.0, 200.0)


def model(trucks: float, per_km: float = 60.0, **scene: float) -> SceneModel:
    return SceneModel(Scene(trucks=trucks, moving_cars_per_km=per_km, **scene), None, AREA)


def test_trucks_are_as_many_and_as_large_as_they_should_be() -> None:
    cars = model(0.3).moving_cars(2.0)
    truck = cars.length_m >= TRUCK_FROM_M
    assert truck.mean() == pytest.approx(0.3, abs=0.06)
    assert not np.any((cars.length_m > 5.8) & (cars.length_m < 7.0))
    for values, low, high in ((cars.length_m, 7.0, 9.0), (cars.width_m, 2.45, 2.55), (cars.height_m, 3.0, 3.4)):
        assert low <= values[truck].min() <= values[truck].max() <= high
    assert cars.length_m[truck].mean() == pytest.approx(8.0, abs=0.2)
    assert len(model(0.3).trucks(2.0)) == truck.sum()


def test_no_share_of_trucks_moves_or_changes_any_other_vehicle() -> None:
    """Vans give way first. Parked cars stay as they are: kerb spots are too short for trucks."""
    before, after = model(0.0), model(0.3)
    for f in fields(Cars):
        np.testing.assert_array_equal(getattr(before.parked_cars, f.name), getattr(after.parked_cars, f.name))
    one, other = before.moving_cars(0.0), after.moving_cars(0.0)
    rest = {id_: k for k, id_ in enumerate(one.ids.tolist())}
    kept = [(rest[i], k) for k, i in enumerate(other.ids.tolist()) if other.length_m[k] < TRUCK_FROM_M and i in rest]
    assert len(kept) > 100
    a, b = np.array(kept).T
    np.testing.assert_array_equal(one.where(a).table(), other.where(b).table())


def test_trucks_do_not_stand_in_each_other_or_in_cars() -> None:
    """Also where every slot of a lane is taken. Lanes cross, so those along one axis are looked at."""
    cars = model(0.5, per_km=100.0).moving_cars(0.0)
    along = cars.where(np.abs(np.sin(cars.yaw_rad)) < 0.5)
    assert (along.length_m >= TRUCK_FROM_M).sum() > 50
    i, j, iou = overlapping(along.table(), along.table())
    assert not (iou[i < j] > 0).any()


def test_a_truck_stands_in_the_middle_of_its_slot_and_touches_nobody() -> None:
    """Cars are off the middle by up to 2 m either way; slots are 10 m."""
    scene = Scene(moving_cars_per_km=90, trucks=0.4)
    found = lanes(scene, (0.0, 0.0, 300.0, 300.0))
    length, off = found.size_m[:, 0], np.mod(found.s0_m, 10.0) - 5.0
    trucks = length > 6.0
    assert 0.2 < trucks.mean() < 0.6
    assert (off[trucks] == 0.0).all()
    assert np.abs(off[~trucks]).max() <= 2.0
    assert np.ptp(off[~trucks]) > 3.5
    lane = np.unique(np.column_stack([found.east, found.lateral_m]), axis=0, return_inverse=True)[1].ravel()
    for k in range(lane.max() + 1):
        order = np.argsort(found.s0_m[lane == k])
        s, half = found.s0_m[lane == k][order], length[lane == k][order] / 2
        assert (np.diff(s) > half[1:] + half[:-1]).all()


# --- what they hide --------------------------------------------------------------------------------


def truck(x_m: float = 0.0, y_m: float = 0.0, yaw: float = 0.0) -> Cars:
    one = np.ones(1)
    colour = np.full((1, 3), 200, np.uint8)
    return Cars(np.array([1]), x_m * one, y_m * one, yaw * one, 8.0 * one, 2.5 * one, 3.2 * one, colour)


@pytest.mark.parametrize(
    ("y_m", "eye", "hidden"),
    [
        (2.0, (0.0, -60.0, 60.0), True),  # the ray rises by 0.95 m a metre: at the truck's side it is 1.9 m high
        (3.6, (0.0, -60.0, 60.0), False),  # 3.4 m high there, above the roof
        (2.0, (0.0, 2.0, 60.0), False),  # from straight above
        (2.0, (0.0, 60.0, 60.0), False),  # from the other side
        (0.5, (0.0, -60.0, 60.0), False),  # on the truck's own ground
    ],
)
def test_a_truck_hides_what_lies_in_its_lee(y_m: float, eye: tuple[float, ...], hidden: bool) -> None:
    for yaw in (0.0, np.pi / 2, 0.7):
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        at, eyes = np.array([[1.0, y_m]]) @ turn, np.array([[*np.array(eye[:2]) @ turn, eye[2]]])
        assert behind(truck(yaw=yaw), at, eyes, CAR_TOP_M).tolist() == [hidden]


def test_a_truck_hides_as_far_as_its_height_above_the_point_carries() -> None:
    """A ray from 1.2 m to an eye 6 m above that, 30 m away, is 2 m higher after 10 m; a truck of 3.2 m ends it."""

    def hidden(tail_m: float, height_m: float = 3.2, from_m: float = 1.2, y_m: float = 0.0) -> bool:
        there = replace(truck(tail_m + 4.0, y_m), height_m=np.array([height_m]))
        (found,) = behind(there, np.zeros((1, 2)), np.array([[30.0, 0.0, from_m + 6.0]]), from_m)
        return bool(found)

    assert hidden(9.9)
    assert not hidden(10.1)
    assert hidden(15.9, from_m=0.0)
    assert not hidden(16.1, from_m=0.0)
    assert not hidden(2.0, height_m=1.1), "lower than the point"
    assert not hidden(-4.0), "the point lies within the truck's own ground"
    assert not hidden(-9.0), "the truck stands on the other side"
    assert hidden(5.0, y_m=1.2)
    assert not hidden(5.0, y_m=1.3)


def test_a_thermal_camera_does_not_see_a_person_behind_a_truck() -> None:
    camera = Thermal(near_probability=1.0, half_range_m=2000.0, false_alarms_per_min=0.0, field_of_view_deg=120.0)
    field, at = HeightField(Town(EMPTY), AREA), np.array([[0.0, 2.0]])
    frame = (camera, at, field, capture(0.0, -60.0), 3, 0.1, (1, 0))
    assert len(look(*frame)) == len(look(*frame, truck(30.0))) == 1
    assert look(*frame, truck()) == []


def test_trucks_hide_cars_from_the_surrogate() -> None:
    """Of cars the share that is seen falls where trucks drive. A truck is not hidden by its own body."""
    captures = CaptureColumns.of([capture(10.0 * k, 5.0, t_s=1.0 + k, drone=k) for k in range(5)])
    bare = dict(building_density=0.0, tree_density=0.0)

    def seen(trucks: float, scene: dict[str, float]) -> tuple[float, float]:
        eyes = Eyes(model(trucks, **scene))
        looks = eyes.look(captures)
        visible, large = looks.covariates[:, 3], eyes.traffic.truck[looks.car]
        return float(visible[~large].mean()), float(visible[large].mean()) if large.any() else float("nan")

    assert seen(0.0, bare)[0] == 1.0
    assert 0.9 < seen(0.4, bare)[0] < 0.999
    assert seen(0.4, bare)[1] == 1.0


def test_of_a_truck_a_higher_top_has_to_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three points of each truck are looked at. More is hidden of low points than of high ones."""
    eyes, captures = Eyes(model(0.5)), CaptureColumns.of([capture(10.0, 5.0)])
    judged: dict[float, int] = {}
    seen = HeightField.seen

    def counted(self: HeightField, x: Floats, y: Floats, eye: Floats, top_m: float = CAR_TOP_M) -> NDArray[np.bool_]:
        judged[top_m] = judged.get(top_m, 0) + len(x)
        return seen(self, x, y, eye, top_m)

    monkeypatch.setattr(HeightField, "seen", counted)
    looks = eyes.look(captures)
    assert judged[TRUCK_TOP_M] == 3 * eyes.traffic.truck[looks.car].sum() > 0
    field, at = HeightField(Town(Scene()), AREA), np.random.default_rng(0).uniform(-90, 90, (2, 4000))
    eye = np.tile([0.0, 0.0, 60.0], (4000, 1))
    low, high = (seen(field, *at, eye, top_m) for top_m in (CAR_TOP_M, TRUCK_TOP_M))
    assert high.sum() > low.sum() + 20


# --- how they look ---------------------------------------------------------------------------------


def test_a_trucks_body_is_as_high_behind_as_in_front() -> None:
    window = Window(SceneModel(EMPTY, None, (-20, -20, 20, 20)), range(-1, 1), range(-1, 1))
    with window.with_cars(truck()):
        x, y = (int(v) for v in window.pixel(0.0, 0.0))
        along = window.height[y, x - 11 : x + 11]  # 7 m of the 8
        assert (along == np.float32(3.2)).all()
    assert window.height.max() == 0.0


def test_a_person_is_in_the_picture_and_is_no_car() -> None:
    walker = Person(waypoints_m=((0.0, 0.0), (0.0, 20.0)), speed_mps=1.0)
    scene, empty = (SceneModel(EMPTY, None, (-20, -20, 20, 20), people=p) for p in ((walker,), ()))
    here = capture(0.0, 5.0, z_m=25.0, t_s=5.0)  # the person has come below the drone
    with_, without = (Renderer(s, 1).render([here])[0, CAMERAS.index("nadir")].astype(int) for s in (scene, empty))
    rows, columns = np.nonzero(np.abs(with_ - without).max(axis=-1) > 15)
    assert 1 <= len(rows) <= 30
    assert abs(rows.mean() - 45) < 4
    assert abs(columns.mean() - 80) < 4
    assert len(scene.cars_at(5.0)) == 0
    assert scene.walkers.bodies(5.0).height_m.tolist() == [PERSON_SIZE_M[2]]
