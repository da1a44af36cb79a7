"""What the benchmark draws: splits that do not meet, styles that differ where it matters, figures as they are named."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import EMPTY, capture, only_target

from research.benchmark.dataset import SIZES, Benchmark
from research.benchmark.difficulty import DENSITIES, Difficulty, Layout
from research.benchmark.scenes import AREA_M, DRONES, SPLITS, draw_captures, draw_scene, scene_id
from research.benchmark.survey import Counts, by_style, survey
from research.benchmark.visibility import in_a_camera, inside, past_houses, past_trees, visible
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import STYLES
from sortie.scenarios.schema import Scene

split_names = st.sampled_from(sorted(SPLITS))
indices = st.integers(0, 99_999)
RANGES = {"building_density", "building_height_m", "tree_density", "moving_speed_mps", "sun_elevation_deg", "overcast", "brightness"}  # fmt: skip


@given(*(st.tuples(st.integers(0, 50), split_names, indices) for _ in range(2)))
def test_every_scene_has_a_number_of_its_own(a: tuple, b: tuple) -> None:
    """Numbers follow seed, split and index in that order, so that no two meet."""
    key_a, key_b = ((seed, SPLITS[split], index) for seed, split, index in (a, b))
    assert (scene_id(*a) < scene_id(*b)) == (key_a < key_b)


@given(st.integers(0, 50), split_names, indices)
@settings(max_examples=40)
def test_a_scene_is_drawn_within_its_ranges(seed: int, split: str, index: int) -> None:
    d = Difficulty()
    scene, layout = draw_scene(seed, split, index, d), d.layout(split)
    assert scene.style in layout.styles
    assert layout.block_m[0] <= scene.block_m <= layout.block_m[1]
    for name in RANGES:
        low, high = getattr(d, name)
        assert low <= getattr(scene, name) <= high
    for name in ("parked_density", "moving_cars_per_km"):
        low, high = getattr(DENSITIES["default"], name)
        assert low <= getattr(scene, name) <= high
    assert draw_scene(seed, split, index, d) == scene


def test_test_layouts_are_met_in_no_other_split() -> None:
    d = Difficulty()
    assert set(d.unseen.styles) - set(d.seen.styles) == {"yard"}
    assert d.unseen.block_m[0] > d.seen.block_m[1]
    assert [d.layout(s) for s in SPLITS] == [d.seen, d.seen, d.seen, d.unseen]
    assert set(d.seen.styles) | set(d.unseen.styles) <= set(STYLES)
    drawn = {s: [draw_scene(0, s, k, d) for k in range(SIZES[s][0])] for s in SPLITS}
    test, others = drawn.pop("test"), [s for several in drawn.values() for s in several]
    assert {s.style for s in test} == set(d.unseen.styles)
    assert min(s.block_m for s in test) > max(s.block_m for s in others)
    assert all(s.style != "yard" for s in others)
    assert len({s.seed for s in test + others}) == len(test + others)


@pytest.mark.parametrize("name", sorted(RANGES))
def test_moving_one_parameter_leaves_all_others_as_they_were(name: str) -> None:
    """What makes a table of difficulties a paired one."""
    high = getattr(Difficulty(), name)[1]
    plain, moved = (draw_scene(0, "test", 3, d) for d in (Difficulty(), Difficulty(**{name: (high, high)})))
    assert plain.model_dump() | {name: high} == moved.model_dump()


def test_more_cars_change_nothing_but_cars() -> None:
    plain, dense = (draw_scene(0, "train", 3, Difficulty(density=d)) for d in ("default", "dense"))
    differ = {k for k, v in plain.model_dump().items() if dense.model_dump()[k] != v}
    assert differ == {"parked_density", "moving_cars_per_km"}


def test_another_seed_is_another_benchmark() -> None:
    assert Benchmark(0).key() != Benchmark(1).key()
    a, b = (draw_scene(seed, "test", 0, Difficulty()) for seed in (0, 1))
    assert all(getattr(a, f) != getattr(b, f) for f in set(Scene.model_fields) - {"style", "trucks"})
    assert draw_captures(0, "test", 0, 0, Difficulty()) != draw_captures(1, "test", 0, 0, Difficulty())


@pytest.mark.parametrize(
    ("density", "low", "high"), [("sparse", 6.0, 15.0), ("default", 18.0, 34.0), ("dense", 45.0, 90.0)]
)
@pytest.mark.parametrize("split", ["train", "test"])
def test_density_is_what_its_name_promises(density: str, low: float, high: float, split: str) -> None:
    d = Difficulty(density=density)
    counts = []
    for k in range(8):
        scene = SceneModel(draw_scene(0, split, k, d), None, (-AREA_M, -AREA_M, AREA_M, AREA_M))
        captures = draw_captures(0, split, k, 0, d)
        cars = scene.cars_at(captures[0].t_s)
        counts += [inside(c, cars, 102.4).sum() for c in captures]
    assert low < np.mean(counts) < high


def test_the_fleet_flies_as_the_parameters_say() -> None:
    d = Difficulty()
    frames = [draw_captures(0, "train", k, f, d) for k in range(60) for f in range(6)]
    at = np.array([[c.position_m for c in f] for f in frames])
    est = np.array([[c.est_position_m for c in f] for f in frames])
    yaw = np.array([[c.true_yaw_rad for c in f] for f in frames])
    est_yaw = np.array([[c.est_yaw_rad for c in f] for f in frames])
    n = at.size / 3
    spread = 4 / math.sqrt(2 * n)  # four standard errors of a standard deviation, relative
    assert (est - at).std(axis=(0, 1)) == pytest.approx([d.position_error_sigma_m] * 3, rel=spread)
    off = np.angle(np.exp(1j * (est_yaw - yaw)))
    assert np.degrees(off.std()) == pytest.approx(d.heading_error_sigma_deg, rel=2 * spread)  # tilt mixes a little in
    assert [len(f) for f in frames] == [DRONES] * len(frames)
    assert all(len({c.t_s for c in f}) == 1 for f in frames)
    arms = np.hypot(*(at[:, 1:, :2] - at[:, :1, :2]).transpose(2, 0, 1))
    assert arms.mean() == pytest.approx(20.0, abs=0.2)
    assert ((arms > d.spacing_m[0] - 4) & (arms < d.spacing_m[1] + 4)).all()
    assert at[..., 2].mean() == pytest.approx(60.0, abs=0.6)
    # the arms stand a quarter turn apart, and the first points where the fleet heads
    bearing = np.arctan2(*(at[:, 1:, 1::-1] - at[:, :1, 1::-1]).transpose(2, 0, 1))
    assert np.abs(np.angle(np.exp(1j * (bearing - np.arange(4) * np.pi / 2 - yaw[:, :1])))).max() < 0.45


def fixed(style: str) -> Counts:
    """Means over scenes that differ from another style's in nothing but their style."""
    d = Difficulty(unseen=Layout((style,), (110.0, 110.0)), building_density=(0.7, 0.7), building_height_m=(10.0, 10.0))
    return by_style([survey(Benchmark(0, d), "test", k) for k in range(3)])[0][2]


def test_styles_differ_in_what_matters() -> None:
    town, old, suburb, yard = (fixed(style) for style in ("town", "old_town", "suburb", "yard"))
    assert old.lot_m < town.lot_m < suburb.lot_m < yard.lot_m
    assert suburb.built < town.built < old.built
    assert yard.built > 2 * suburb.built
    assert suburb.height_m < yard.height_m < old.height_m
    assert old.alone < town.alone < suburb.alone  # what houses hide
    for counts in (town, old, suburb, yard):
        assert counts.alone < counts.fleet <= 1.0


def test_higher_houses_hide_more_and_light_hides_nothing() -> None:
    def counts(**moved: tuple[float, float]) -> Counts:
        return survey(Benchmark(0, Difficulty(**moved)), "test", 2)

    plain, low, high = counts(), counts(building_height_m=(5.0, 5.0)), counts(building_height_m=(15.0, 15.0))
    assert high.alone < low.alone
    assert high.cars == low.cars == plain.cars
    assert counts(sun_elevation_deg=(25.0, 25.0), overcast=(0.0, 0.0), brightness=(0.7, 0.7)) == plain


def test_an_open_field_hides_nothing_but_what_no_camera_looks_at() -> None:
    eye = capture(z_m=60.0)
    for x, y, seen in ((10.0, 5.0, True), (70.0, 0.0, True), (0.0, -80.0, True), (80.0, 80.0, False)):
        scene = only_target(x, y)
        part = visible(scene, eye, scene.cars_at(5.0))
        assert part.tolist() == [float(seen)]
        assert in_a_camera(eye, np.array([(x, y, 0.0)])).tolist() == [seen]


def test_a_house_hides_a_car_from_one_side_only() -> None:
    town = Scene(tree_density=0, parked_density=0, moving_cars_per_km=0, building_density=1, building_height_m=16)
    buildings = SceneModel(town, None, (0, 0, 0, 0)).town.block(0, 0).buildings
    _, y0, x1, y1, _, _ = max(buildings[buildings[:, 2] > 66.0], key=lambda b: b[4])
    kerb, middle = 80.0 - 4.35, (y0 + y1) / 2
    scene = only_target(kerb, middle, town)
    for x, seen in ((x1 - 60.0, 0.0), (kerb + 10.0, 1.0)):
        eye = capture(x, middle)
        assert visible(scene, eye, scene.cars_at(5.0)).tolist() == [seen]


def test_inside_is_the_drones_own_square() -> None:
    cars = only_target(100.0, 0.0, EMPTY).cars_at(0.0)
    assert inside(capture(yaw=0.0), cars, 102.4).tolist() == [True]
    assert inside(capture(yaw=0.0), cars, 51.2).tolist() == [False]
    far = only_target(110.0, 0.0, EMPTY).cars_at(0.0)
    assert inside(capture(yaw=0.0), far, 102.4).tolist() == [False]
    assert inside(capture(yaw=math.pi / 4), far, 102.4).tolist() == [True]  # towards the square's corner


near = st.floats(-9.0, 9.0)
EYE = np.array([3.0, -4.0, 60.0])


def walk(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """A point on a roof [1, 3], and the way from it to the eye in small steps [k, 3]."""
    at = np.array([[x, y, 1.5]])
    return at, at + np.linspace(0.0, 1.0, 4001)[:, None] * (EYE - at)


@given(near, near, st.floats(-60, 60), st.floats(-60, 60), st.floats(2.0, 30.0))
@settings(max_examples=80, deadline=None)
def test_a_line_meets_a_house_where_walking_it_does(dx: float, dy: float, x: float, y: float, height: float) -> None:
    at, way = walk(x, y)
    house = np.array([x + dx - 3.0, y + dy - 4.0, x + dx + 3.0, y + dy + 4.0, height, 0.0])
    over = (way[:, :2] > house[:2]).all(axis=1) & (way[:, :2] < house[2:4]).all(axis=1)
    deep = np.where(over, height - way[:, 2], -1.0).max()
    # steps miss a corner: what walking meets, a slightly larger house meets; what a slightly smaller one meets, walking does
    larger, smaller = (house + grown * np.array([-1, -1, 1, 1, 1, 0]) for grown in (0.1, -0.1))
    assert past_houses(at, EYE, larger[None])[0] or not deep > 0
    assert not past_houses(at, EYE, smaller[None])[0] or deep > 0


@given(near, near, st.floats(-60, 60), st.floats(-60, 60), st.floats(1.3, 4.0), st.floats(3.5, 9.0))
@settings(max_examples=80, deadline=None)
def test_a_line_meets_a_crown_where_walking_it_does(
    dx: float, dy: float, x: float, y: float, radius: float, top: float
) -> None:
    at, way = walk(x, y)
    part = ((way[:, :2] - (x + dx, y + dy)) ** 2).sum(axis=1) / radius**2
    deep = np.where(part < 1.0, top * (1 - 0.35 * part) - way[:, 2], -1.0).max()
    found = past_trees(at, EYE, np.array([[x + dx, y + dy, radius, top, 0.5]]))[0]
    assert found == (deep > 0) or -1.0 < deep < 0.05 or radius * radius * (1 - part.min()) < 0.05
