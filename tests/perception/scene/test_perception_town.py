"""The town follows from its seed block by block, and every knob of it shows."""

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import KERB_M, PAVEMENT_M, RES_M, TILE_M, TILE_PX, Town, _shadows, block, zigzag
from sortie.scenarios.schema import Scene


def same(a: object, b: object) -> bool:
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in a.__slots__)  # type: ignore[attr-defined]


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
    assert same(there[0], back[1])
    assert same(there[1], back[0])


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
    inside = (found.trees[:, :2] > PAVEMENT_M).all(axis=1) & (found.trees[:, :2] < Scene().block_m - PAVEMENT_M).all(
        axis=1
    )
    assert inside.any() == among_houses


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


@pytest.fixture(scope="module")
def default() -> tuple[tuple[bytes, ...], bytes]:
    return there(Scene()), look(Scene())


def test_the_table_names_every_knob_of_the_scene() -> None:
    assert set(OTHERS) == set(Scene.model_fields)


@pytest.mark.parametrize("field", OTHERS)
def test_every_knob_of_the_scene_changes_what_is_there_or_only_how_it_is_lit(
    field: str, default: tuple[tuple[bytes, ...], bytes]
) -> None:
    other = Scene(**{field: OTHERS[field]})
    assert (there(other) == default[0]) == (field in LIGHT)
    assert look(other) != default[1]


def test_shadows_fall_away_from_the_sun_and_join_across_tiles() -> None:
    town = Town(Scene(tree_density=0, building_density=1))
    left, right = town.tile(0, 0), town.tile(1, 0)
    assert 0.02 < (left.light < 1).mean() < 0.5
    # a column either side of the seam agrees nearly everywhere, as any two neighbouring columns do
    assert (left.light[:, TILE_PX - 1] == right.light[:, 0]).mean() > 0.95


@pytest.mark.parametrize(("azimuth", "east", "north"), [(0.0, -1, 0), (90.0, 0, -1), (180.0, 1, 0), (270.0, 0, 1)])
def test_a_shadow_lies_on_the_far_side_and_is_as_long_as_its_house_is_high(
    azimuth: float, east: int, north: int
) -> None:
    height = np.zeros((200, 200), np.float32)
    height[95:105, 95:105] = 8.0
    light = _shadows(height, Scene(sun_azimuth_deg=azimuth, sun_elevation_deg=45.0))

    def lit(metres: float) -> bool:
        """Beyond the house's edge by this much on the side away from the sun (negative: towards it)."""
        px = np.sign(metres) * 5 + metres / RES_M
        return bool(light[round(99.5 + north * px), round(99.5 + east * px)] == 1)

    assert [lit(m) for m in (1.0, 6.0, 10.0, -1.0, -6.0)] == [False, False, True, True, True]


def test_an_overcast_sky_casts_no_shadow_and_a_half_clear_one_half_of_it() -> None:
    darkest = [float(Town(Scene(overcast=part)).tile(0, 0).light.min()) for part in (0.0, 0.5, 1.0)]
    assert darkest == pytest.approx([0.6, 0.8, 1.0])


def test_long_shadows_join_across_tiles() -> None:
    """The ground around a tile is drawn as far as the longest shadow reaches."""
    town = Town(
        Scene(tree_density=0, building_density=1, building_height_m=25, sun_elevation_deg=20.0, sun_azimuth_deg=180.0)
    )
    left, right = town.tile(0, 0), town.tile(1, 0)
    assert (left.light[:, TILE_PX - 1] == right.light[:, 0]).mean() > 0.95
