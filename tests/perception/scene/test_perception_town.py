"""The town follows from its seed block by block, every knob of it shows, and cars are a function of time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import EMPTY, capture
from wrong_rows import wrong_rows

from sortie.perception.scene.height_field import RES_M as FIELD_RES_M
from sortie.perception.scene.height_field import _plant
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import KERB_M, PAVEMENT_M, RES_M, TILE_M, TILE_PX, Town, _shadows, block, zigzag
from sortie.perception.scene.traffic import TARGET_ID, TargetPath
from sortie.scenarios.schema import Person, Scene, Target


def test_zigzag_is_one_to_one() -> None:
    assert sorted(zigzag(k) for k in range(-50, 50)) == list(range(100))


def test_a_block_depends_on_its_index_alone() -> None:
    scene = Scene()
    town = Town(scene)
    town.blocks(-300, -300, 300, 300)
    alone = block(scene, -2, 1)
    met = town.block(-2, 1)
    assert np.array_equal(alone.buildings, met.buildings)
    assert np.array_equal(alone.parked, met.parked)
    assert not np.array_equal(alone.trees, block(scene, 1, -2).trees)


def test_tiles_do_not_depend_on_the_order_of_asking() -> None:
    forwards, backwards = Town(Scene()), Town(Scene())
    there = [forwards.tile(i, 0) for i in range(2)]
    back = [backwards.tile(i, 0) for i in reversed(range(2))]
    for one, other in ((there[0], back[1]), (there[1], back[0])):
        assert all(np.array_equal(getattr(one, f), getattr(other, f)) for f in one.__slots__)


def test_buildings_stand_where_the_block_says_also_across_tiles() -> None:
    town = Town(Scene(tree_density=0))
    seen = 0
    for b in town.blocks(-150, -150, 150, 150):
        for x0, y0, x1, y1, height, _ in b.buildings:
            for x, y in ((x0 + 0.5, y0 + 0.5), (x1 - 0.5, y1 - 0.5)):
                ix, iy = int(np.floor(x / TILE_M)), int(np.floor(y / TILE_M))
                column, row = int((x - ix * TILE_M) / RES_M), int((y - iy * TILE_M) / RES_M)
                assert town.tile(ix, iy).height_m[row, column] == pytest.approx(height, rel=1e-6)
                seen += 1
    assert seen > 50


def test_roads_are_free_of_buildings_and_trunks_stand_on_the_pavement() -> None:
    scene = Scene(building_density=1, tree_density=1)
    for b in (block(scene, i, j) for i in range(-2, 2) for j in range(-2, 2)):
        edges = b.buildings[:, :4] % scene.block_m
        assert (np.minimum(edges, scene.block_m - edges) >= PAVEMENT_M - 1e-9).all()
        folded = b.trees[:, :2] % scene.block_m
        assert (np.minimum(folded, scene.block_m - folded).min(axis=1) > KERB_M).all()


@pytest.mark.parametrize(("style", "among_houses"), [("suburb", True), ("town", False), ("old_town", False)])
def test_houses_of_a_green_style_have_gardens_and_others_leave_no_room(style: str, among_houses: bool) -> None:
    """Where every lot is built on and every tree stands."""
    found = block(Scene(style=style, building_density=1.0, tree_density=1.0), 0, 0)
    xy = found.trees[:, :2]
    assert ((xy > PAVEMENT_M) & (xy < Scene().block_m - PAVEMENT_M)).all(axis=1).any() == among_houses


def test_a_denser_town_keeps_what_the_sparser_one_has() -> None:
    sparse, dense = block(Scene(parked_density=0.2), 0, 0), block(Scene(parked_density=0.8), 0, 0)
    assert {tuple(p) for p in sparse.parked} < {tuple(p) for p in dense.parked}


OTHERS = {
    "seed": 8,
    "style": "suburb",
    "block_m": 90.0,
    "building_density": 0.3,
    "building_height_m": 6.0,
    "tree_density": 0.9,
    "parked_density": 0.7,
    "moving_cars_per_km": 30.0,
    "moving_speed_mps": 3.0,
    "trucks": 0.8,
    "sun_azimuth_deg": 30.0,
    "sun_elevation_deg": 25.0,
    "overcast": 0.5,
    "brightness": 0.8,
}


LIGHT = ("sun_azimuth_deg", "sun_elevation_deg", "overcast", "brightness")
"""Knobs that change what is seen and not what is there."""


def there(scene: Scene) -> tuple[bytes, ...]:
    """What stands where."""
    model = SceneModel(scene, None, (0, 0, 50, 50))
    cars = model.cars_at(3.0)
    return model.town.tile(0, 0).height_m.tobytes(), cars.x_m.tobytes(), cars.y_m.tobytes()


def look(scene: Scene) -> bytes:
    """What one drone's cameras see of it."""
    return Renderer(SceneModel(scene, None, (0, 0, 50, 50)), 1).render([capture(20.0, 20.0)]).tobytes()


def test_every_knob_of_the_scene_changes_what_is_there_or_only_how_it_is_lit() -> None:
    assert set(OTHERS) == set(Scene.model_fields)
    others = {field: Scene(**{field: value}) for field, value in OTHERS.items()}
    assert [field for field, scene in others.items() if there(scene) == there(Scene())] == list(LIGHT)
    assert [field for field, scene in others.items() if look(scene) == look(Scene())] == []


def test_a_shadow_lies_on_the_far_side_and_is_as_long_as_its_house_is_high() -> None:
    def check(azimuth: float, east: int, north: int) -> None:
        height = np.zeros((200, 200), np.float32)
        height[95:105, 95:105] = 8.0
        light = _shadows(height, Scene(sun_azimuth_deg=azimuth, sun_elevation_deg=45.0))

        def lit(metres: float) -> bool:
            """Beyond the house's edge by this much on the side away from the sun (negative: towards it)."""
            px = np.sign(metres) * 5 + metres / RES_M
            return bool(light[round(99.5 + north * px), round(99.5 + east * px)] == 1)

        assert [lit(m) for m in (1.0, 6.0, 10.0, -1.0, -6.0)] == [False, False, True, True, True]

    assert wrong_rows([(0.0, -1, 0), (90.0, 0, -1), (180.0, 1, 0), (270.0, 0, 1)], check) == {}


def test_an_overcast_sky_casts_no_shadow_and_a_half_clear_one_half_of_it() -> None:
    darkest = [float(Town(Scene(overcast=part)).tile(0, 0).light.min()) for part in (0.0, 0.5, 1.0)]
    assert darkest == pytest.approx([0.6, 0.8, 1.0])


def test_shadows_join_across_tiles() -> None:
    """The ground around a tile is drawn as far as the longest shadow reaches."""
    long = dict(building_height_m=25, sun_elevation_deg=20.0, sun_azimuth_deg=180.0)
    for more in ({}, long):
        town = Town(Scene(tree_density=0, building_density=1, **more))
        left, right = town.tile(0, 0), town.tile(1, 0)
        assert (left.light < 1).mean() > 0.02
        # a column either side of the seam agrees nearly everywhere, as any two neighbouring columns do
        assert (left.light[:, TILE_PX - 1] == right.light[:, 0]).mean() > 0.95


SMALL = (-20.0, -20.0, 20.0, 20.0)


def test_scenes_that_differ_in_anything_are_not_made_of_the_same() -> None:
    """What is computed of one scene may be kept for another that is made of the same."""
    target, other = Target(waypoints_m=((0, 0), (9, 0))), Target(waypoints_m=((5, 0), (9, 0)))
    person = Person(waypoints_m=((1, 1), (2, 5)))
    scenes = [
        SceneModel(EMPTY, target, SMALL),
        SceneModel(EMPTY, None, SMALL),
        SceneModel(EMPTY, target, (-20.0, -20.0, 20.0, 21.0)),
        SceneModel(EMPTY, target, SMALL, [other]),
        SceneModel(EMPTY, target, SMALL, [], [person]),
        SceneModel(EMPTY.model_copy(update={"brightness": 0.8}), target, SMALL),
    ]
    assert len({s.made_of for s in scenes}) == len(scenes)
    assert (
        SceneModel(EMPTY, target, SMALL, (other,), (person,)).made_of
        == SceneModel(EMPTY, target, SMALL, [other], [person]).made_of
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
                    part = (
                        ((column + 0.5) * FIELD_RES_M - 1.0 - x) ** 2 + ((row + 0.5) * FIELD_RES_M - 2.0 - y) ** 2
                    ) / radius**2
                    if part < 1.0:
                        wanted[row, column] = max(wanted[row, column], top * (1.0 - 0.35 * part))
        _plant(field, some, -1.0, -2.0)
        np.testing.assert_allclose(field, wanted, rtol=1e-5)


BOUNDS = (-100.0, -100.0, 200.0, 150.0)


@pytest.fixture(scope="module")
def model() -> SceneModel:
    return SceneModel(Scene(), Target(waypoints_m=((0, 0), (30, 0), (30, 40)), speed_mps=5.0), BOUNDS)


def test_the_target_follows_its_waypoints_and_stays(model: SceneModel) -> None:
    up = np.pi / 2
    for t_s, pose in {
        0.0: (0, 0, 0),
        2.0: (10, 0, 0),
        8.0: (30, 10, up),
        14.0: (30, 40, up),
        99.0: (30, 40, up),
    }.items():
        cars = model.cars_at(t_s)
        assert cars.ids[0] == TARGET_ID
        assert (cars.x_m[0], cars.y_m[0], cars.yaw_rad[0]) == pytest.approx(pose)
    twice = TargetPath.of(Target(waypoints_m=((0, 0), (10, 0), (10, 0), (20, 0)), speed_mps=1.0))
    assert twice.pose(15.0) == pytest.approx((15, 0, 0))


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
