"""The scene's joints: what makes two scenes the same, trees over roofs, windows that move, what stands behind a truck."""

from __future__ import annotations

import numpy as np
from perception_examples import EMPTY, capture

from sortie.perception.scene.behind_trucks import behind
from sortie.perception.scene.height_field import RES_M, _plant
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import TILE_M
from sortie.perception.scene.traffic import Cars, lanes
from sortie.scenarios.schema import Person, Scene, Target

BOUNDS = (-20.0, -20.0, 20.0, 20.0)


def test_scenes_that_differ_in_anything_are_not_made_of_the_same() -> None:
    """What is computed of one scene may be kept for another that is made of the same."""
    target, other = Target(waypoints_m=((0, 0), (9, 0))), Target(waypoints_m=((5, 0), (9, 0)))
    person = Person(waypoints_m=((1, 1), (2, 5)))
    scenes = [
        SceneModel(EMPTY, target, BOUNDS),
        SceneModel(EMPTY, None, BOUNDS),
        SceneModel(EMPTY, target, (-20.0, -20.0, 20.0, 21.0)),
        SceneModel(EMPTY, target, BOUNDS, [other]),
        SceneModel(EMPTY, target, BOUNDS, [], [person]),
        SceneModel(EMPTY.model_copy(update={"brightness": 0.8}), target, BOUNDS),
    ]
    assert len({s.made_of for s in scenes}) == len(scenes)
    assert (
        SceneModel(EMPTY, target, BOUNDS, (other,), (person,)).made_of
        == SceneModel(EMPTY, target, BOUNDS, [other], [person]).made_of
    )


def test_a_tree_raises_what_is_lower_and_nothing_else() -> None:
    """Over a roof, and over another tree, whichever is planted first; pixel by pixel."""
    trees = np.array([(6.0, 6.0, 3.0, 8.0, 0.5), (8.0, 7.0, 2.5, 4.0, 0.5), (9.0, 3.0, 2.0, 6.0, 0.5)])
    for some in (trees, trees[::-1]):
        field = np.zeros((20, 18), np.float32)
        field[5:9, 4:9] = 6.5
        wanted = field.copy()
        for row in range(20):
            for column in range(18):
                for x, y, radius, top, _ in some:
                    part = (((column + 0.5) * RES_M - 1.0 - x) ** 2 + ((row + 0.5) * RES_M - 2.0 - y) ** 2) / radius**2
                    if part < 1.0:
                        wanted[row, column] = max(wanted[row, column], top * (1.0 - 0.35 * part))
        _plant(field, some, -1.0, -2.0)
        np.testing.assert_allclose(field, wanted, rtol=1e-5)


def test_a_window_covers_who_looks_wherever_the_one_before_lay() -> None:
    """Along either axis; it is kept where it still covers them."""
    renderer = Renderer(SceneModel(EMPTY, None, BOUNDS), 1)
    first = renderer._window_over([capture(50.0, 50.0, 10.0)])
    assert renderer._window_over([capture(52.0, 49.0, 10.0)]) is first
    for x, y in ((50.0, 50.0 + TILE_M), (50.0 + TILE_M, 50.0)):
        renderer._window_over([capture(50.0, 50.0, 10.0)])
        window = renderer._window_over([capture(x, y, 10.0)])
        column, row = window.pixel(x, y)
        rows, columns = window.height.shape
        assert 31.0 / 0.32 <= column <= columns - 31.0 / 0.32
        assert 31.0 / 0.32 <= row <= rows - 31.0 / 0.32


def test_a_truck_hides_as_far_as_its_height_above_the_point_carries() -> None:
    """A ray from 1.2 m to an eye 6 m above that, 30 m away, is 2 m higher after 10 m; a truck of 3.2 m ends it before."""

    def hidden(tail_m: float, height_m: float = 3.2, from_m: float = 1.2, y_m: float = 0.0) -> bool:
        one = np.ones(1)
        truck = Cars(
            np.zeros(1, np.int64), (tail_m + 4.0) * one, y_m * one, 0.0 * one, 8.0 * one, 2.5 * one, height_m * one,
            np.zeros((1, 3), np.uint8),
        )  # fmt: skip
        (found,) = behind(truck, np.zeros((1, 2)), np.array([[30.0, 0.0, from_m + 6.0]]), from_m)
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
