"""The town follows from its seed block by block, and every knob of it shows."""

import numpy as np
import pytest

from perception.scene import SceneModel
from perception.town import KERB_M, PAVEMENT_M, RES_M, TILE_M, TILE_PX, Town, block, zigzag
from scenarios.schema import Scene


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


def test_a_denser_town_keeps_what_the_sparser_one_has() -> None:
    sparse, dense = block(Scene(parked_density=0.2), 0, 0), block(Scene(parked_density=0.8), 0, 0)
    assert {tuple(p) for p in sparse.parked} < {tuple(p) for p in dense.parked}


def test_every_knob_of_the_scene_changes_what_is_there() -> None:
    def look(scene: Scene) -> tuple[bytes, ...]:
        model = SceneModel(scene, None, (0, 0, 50, 50))
        tile, cars = model.town.tile(0, 0), model.cars_at(3.0)
        return tile.height_m.tobytes(), tile.albedo.tobytes(), cars.x_m.tobytes(), cars.y_m.tobytes()

    default = look(Scene())
    others = {
        "seed": 8,
        "block_m": 90.0,
        "building_density": 0.3,
        "building_height_m": 6.0,
        "tree_density": 0.9,
        "parked_density": 0.7,
        "moving_cars_per_km": 30.0,
        "moving_speed_mps": 3.0,
    }
    assert set(others) == set(Scene.model_fields)
    for field, value in others.items():
        assert look(Scene(**{field: value})) != default, field
    assert look(Scene()) == default


def test_shadows_fall_away_from_the_sun_and_join_across_tiles() -> None:
    town = Town(Scene(tree_density=0, building_density=1))
    left, right = town.tile(0, 0), town.tile(1, 0)
    assert 0.02 < (left.light < 1).mean() < 0.5
    # a column either side of the seam agrees nearly everywhere, as any two neighbouring columns do
    assert (left.light[:, TILE_PX - 1] == right.light[:, 0]).mean() > 0.95
