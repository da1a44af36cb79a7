"""Rays, cameras and the lift: compiled loops against plain ones, pinholes of the tests' own, what hides what."""

from __future__ import annotations

import numpy as np
import pytest
from perception_examples import EMPTY, capture, cross, only_target
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from wrong_rows import wrong_rows

from sortie.perception.compiled import compiled
from sortie.perception.geometry import FULL, HALF_H, HALF_V, HEIGHT_PX, USUAL, WIDTH_PX, Cameras, camera_margins
from sortie.perception.geometry import IMAGE_PX as BEV_PX
from sortie.perception.network.bev import ground_points, lift
from sortie.perception.scene.rays import COARSE, FAR, FAR_REACH, HAZE, REACH, see
from sortie.perception.scene.render import AXES, CAMERAS, Renderer, camera_axes, rotation, tilt, views_shape
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import TILE_M
from sortie.perception.surrogate.features import LOOK_COVARIATES, CaptureColumns, Eyes
from sortie.perception.types import Capture
from sortie.scenarios.schema import Scene

SIDE = 640
RES_M = 0.32


def blocks(height: np.ndarray, side: int, reach: int) -> np.ndarray:
    """The highest of each block and of those so many around it."""
    rows, columns = (n // side for n in height.shape)
    out = np.zeros((rows, columns), np.float32)
    for r in range(rows):
        for c in range(columns):
            some = height[
                max(r - reach, 0) * side : (r + reach + 1) * side, max(c - reach, 0) * side : (c + reach + 1) * side
            ]
            out[r, c] = some.max()
    return out


def made_town(rng: np.random.Generator, tallest_m: float) -> np.ndarray:
    height = np.zeros((SIDE, SIDE), np.float32)
    for _ in range(60):
        x, y = rng.integers(0, SIDE - 40, 2)
        w, d = rng.integers(4, 40, 2)
        height[y : y + d, x : x + w] = rng.uniform(0.5, tallest_m)
    return height


@pytest.mark.parametrize(("tallest_m", "gain"), [(1.4, 1.0), (9.0, 0.6), (31.0, 1.3)])
def test_a_ray_shows_the_first_thing_on_its_way_down(tallest_m: float, gain: float) -> None:
    rng = np.random.default_rng(round(tallest_m))
    height = made_town(rng, tallest_m)
    colour = rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    slope = rng.uniform(-1.7, 1.7, (20_000, 2))
    slope[::50] *= 3.0  # flatter than 1:3 some of them
    rays = np.column_stack([slope, -np.ones(len(slope))]).astype(np.float32)
    noise = rng.integers(0, 16, rays.shape, dtype=np.uint8)
    eye = (np.float32(SIDE / 2), np.float32(SIDE / 2), np.float32(40.0))
    out = np.empty(rays.shape, np.uint8)
    coarse = blocks(height, COARSE, 1)
    far = blocks(coarse, FAR // COARSE, FAR_REACH)
    level = np.eye(3, dtype=np.float32)
    see(rays, level, eye, np.float32(RES_M), height.max(), height, coarse, far, colour, np.float32(gain), noise, out)

    per_m = slope / RES_M
    pixel, hit_m = np.zeros((len(rays), 2), int), np.full(len(rays), -1.0)
    fine = [0.0, *np.arange(0.25, 2.0, 0.25), *np.arange(2.0, np.ceil(height.max() / 2) * 2, 0.5)]
    for z in reversed(fine):
        at = np.clip(SIDE / 2 + per_m * (40.0 - z), 0, SIDE - 1).astype(int)
        found = (hit_m < 0) & ((height[at[:, 1], at[:, 0]] >= z) | (z == 0.0))
        pixel[found], hit_m[found] = at[found], z
    wall = height[pixel[:, 1], pixel[:, 0]] - hit_m > 0.8
    light = np.where(wall, np.where(np.abs(slope[:, 0]) > np.abs(slope[:, 1]), 0.55, 0.75), 1.0).astype(np.float32)
    level = (colour[pixel[:, 1], pixel[:, 0]] * light[:, None]).astype(int).astype(np.float32)
    hazy = np.hypot(*slope.T) > REACH
    level[hazy] = HAZE
    plain = np.clip((level * np.float32(gain)).astype(int) + noise - 8, 0, 255)
    same = (out == plain).all(axis=1)
    assert 0.004 < hazy.mean() < 0.03
    assert (wall.mean() > 0.02) == (tallest_m > 2.0)
    assert same[hazy].all()
    assert same.mean() > 0.9998, "but for a ray on the edge of a pixel, in float32"


@pytest.mark.parametrize(("pitch", "roll"), [(0.02, 0.01), (0.15, -0.2)])
@pytest.mark.parametrize("cameras", [Cameras(), Cameras(90.0, 30.0, 64), Cameras(50.0, 60.0, 320)])
def test_the_lift_reads_each_ground_point_where_a_pinhole_puts_it(pitch: float, roll: float, cameras: Cameras) -> None:
    rng = np.random.default_rng(1)
    square = cameras.width_px // 16
    views = np.kron(rng.integers(0, 256, (5, 9, 16, 3)), np.ones((1, square, square, 1))).astype(np.uint8)
    c = capture(yaw=0.7, pitch=pitch, roll=roll)._replace(cameras=cameras)
    assert views.shape == views_shape(cameras)
    half_h = np.tan(np.radians(cameras.field_of_view_deg) / 2)
    half_v = half_h * 9 / 16
    image = lift(views[None], [c])[0].numpy().transpose(1, 2, 0)
    points = np.dstack([ground_points(FULL).double().numpy(), np.full((256, 256), -c.est_position_m[2])])
    body = points @ tilt(c.orientation_xyzw)
    expected, where = np.zeros((256, 256, 3)), np.full((256, 256), -1)
    front, left, right, back, nadir = range(5)
    lengthwise = np.abs(body[..., 0]) >= np.abs(body[..., 1])
    quadrant = np.where(lengthwise, np.where(body[..., 0] >= 0, front, back), np.where(body[..., 1] >= 0, left, right))
    for camera in (front, left, right, back, nadir):  # straight down wins
        across, down, ahead = np.moveaxis(body @ camera_axes(cameras)[camera].T, -1, 0)
        u, v = across / ahead / half_h, down / ahead / half_v
        seen = (np.abs(u) < 1) & (np.abs(v) < 1) & (ahead > (0.1 if camera == nadir else 1.0))
        seen &= (quadrant == camera) | (camera == nadir)
        column, row = (u + 1) / 2 * cameras.width_px - 0.5, (v + 1) / 2 * cameras.height_px - 0.5
        for k in range(3):
            level = map_coordinates(views[camera, ..., k].astype(float), [row, column], order=1, mode="nearest")
            expected[seen, k] = level[seen]
        where[seen] = camera
    assert {*np.unique(where)} >= {front, left, right, back, nadir}
    np.testing.assert_array_equal(image[..., 3] > 0, where >= 0)
    off = np.abs(image[..., :3] - expected)[where >= 0]
    assert (off <= 0.51).mean() > 0.9999
    assert off.max() < 2.0, "single precision on the edge of a square"


def test_loops_are_compiled_also_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*_: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr("numba.core.dispatcher.Dispatcher.enable_caching", nowhere)
    twice = compiled(lambda x: 2.0 / x)
    assert (twice(4.0), twice(0.0)) == (0.5, np.inf)


KINDS = [USUAL, Cameras(50.0), Cameras(90.0), Cameras(pitch_deg=30.0), Cameras(60.0, 60.0, 320), Cameras(width_px=64)]
RNG = np.random.default_rng(3)


def axes_by_hand(pitch_deg: float) -> np.ndarray:
    """[5, 3, 3] right, down and forward of the front, left, right, back and nadir camera."""
    out = []
    p = np.radians(pitch_deg)
    for turn in np.radians([0.0, 90.0, -90.0, 180.0]):
        forward = [np.cos(p) * np.cos(turn), np.cos(p) * np.sin(turn), -np.sin(p)]
        right = [np.sin(turn), -np.cos(turn), 0.0]
        out.append([right, np.cross(forward, right), forward])
    return np.array([*out, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]])


def test_what_is_in_a_picture_is_what_a_pinhole_shows() -> None:
    def check(cameras: Cameras) -> None:
        np.testing.assert_allclose(camera_axes(cameras), axes_by_hand(cameras.pitch_deg), atol=1e-9)
        body = np.concatenate([RNG.uniform(-90.0, 90.0, (4000, 2)), np.full((4000, 1), -60.0)], axis=1)
        half_h = np.tan(np.radians(cameras.field_of_view_deg / 2))
        x, y, _ = body.T
        facing = np.where(np.abs(x) >= np.abs(y), np.where(x >= 0, 0, 3), np.where(y >= 0, 1, 2))
        margin = np.empty((5, len(body)))
        for k, axes in enumerate(axes_by_hand(cameras.pitch_deg)):
            right, down, ahead = axes @ body.T
            margin[k] = 1 - np.maximum(np.abs(right / ahead) / half_h, np.abs(down / ahead) / (half_h * 9 / 16))
            margin[k, ahead <= 0.1] = -np.inf
        down, side = camera_margins(*body.T, cameras.lens)
        np.testing.assert_allclose(down, margin[4], atol=1e-9)
        np.testing.assert_array_equal(side > 0, margin[facing, np.arange(len(body))] > 0)

    assert wrong_rows(KINDS, check) == {}


def test_captures_of_several_kinds_are_rendered_together_as_alone() -> None:
    scene = only_target(10.0, 5.0)
    kinds = [capture(drone=i)._replace(cameras=k) for i, k in enumerate(KINDS)]
    into = [np.empty((5, c.cameras.height_px, c.cameras.width_px, 3), np.uint8) for c in kinds]
    Renderer(scene, 1).render_into(kinds, into)
    for c, views in zip(kinds, into, strict=True):
        np.testing.assert_array_equal(views, Renderer(scene, 1).render([c])[0])


def test_the_surrogate_sees_what_is_in_each_drone_s_own_pictures() -> None:
    scene, away_m = only_target(95.0, 0.0), 95.0
    narrow, wider, widest = (
        capture(drone=i)._replace(cameras=Cameras(fov)) for i, fov in enumerate((40.0, 60.0, 100.0))
    )
    together = Eyes(scene).look(CaptureColumns.of([narrow, wider, widest]))
    alone = [Eyes(scene).look(CaptureColumns.of([c])) for c in (narrow, wider, widest)]
    np.testing.assert_array_equal(together.covariates, np.concatenate([a.covariates for a in alone]))
    margins = together.covariates[:, LOOK_COVARIATES.index("margin")]
    above = (away_m - 59.2) / (away_m + 59.2)  # tangent of a car's middle above the axis of the front camera
    expected = 1 - above / (np.tan(np.radians([20.0, 30.0, 50.0])) * 9 / 16)
    np.testing.assert_allclose(margins, np.clip(expected, -0.4, 0.4), atol=1e-3)
    assert margins[0] < 0.0 < margins[1] < margins[2]


def red(image: np.ndarray) -> np.ndarray:
    """Mask of pixels of the target's colour."""
    r, g, b = (image[..., c].astype(int) for c in range(3))
    return (r - g > 85) & (r - b > 85)


def project(c: Capture, point: tuple[float, float, float]) -> dict[str, tuple[float, float]]:
    """Column and row of a world point in each camera that has it in view, by scipy's rotation."""
    body = Rotation.from_quat(c.orientation_xyzw).inv().apply(np.subtract(point, c.position_m))
    out = {}
    for name, axes in zip(CAMERAS, AXES, strict=True):
        right, down, ahead = axes @ body
        u, v = right / ahead / HALF_H, down / ahead / HALF_V
        if ahead > 0 and abs(u) < 1 and abs(v) < 1:
            out[name] = ((u + 1) / 2 * WIDTH_PX - 0.5, (v + 1) / 2 * HEIGHT_PX - 0.5)
    return out


def test_attitudes_agree_with_scipy_and_one_without_a_length_is_refused() -> None:
    q = Rotation.from_euler("ZYX", [2.0, -0.2, 0.3]).as_quat()
    assert rotation(q) == pytest.approx(Rotation.from_quat(q).as_matrix())
    assert tilt(q) == pytest.approx(Rotation.from_euler("ZYX", [0.0, -0.2, 0.3]).as_matrix())
    for broken in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, float("nan"), 1.0), (0.0, float("inf"), 0.0, 1.0)):
        with pytest.raises(ValueError, match=r"orientation_xyzw is .*, must have a finite length above 0"):
            Renderer(only_target(10.0, 5.0), 1).render([capture()._replace(orientation_xyzw=broken)])


def test_cameras_are_right_handed_and_look_where_they_should() -> None:
    for axes in AXES:
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert axes @ axes.T == pytest.approx(np.eye(3))
    ahead = {name: axes[2] for name, axes in zip(CAMERAS, AXES, strict=True)}
    half = 0.5**0.5
    assert ahead["front"] == pytest.approx([half, 0, -half])
    assert ahead["left"] == pytest.approx([0, half, -half])
    assert ahead["right"] == pytest.approx([0, -half, -half])
    assert ahead["nadir"] == pytest.approx([0, 0, -1])


@pytest.mark.parametrize(
    ("x", "y", "yaw", "pitch", "roll"),
    [
        (10.0, 5.0, 0.0, 0.0, 0.0),
        (10.0, 5.0, 0.0, 0.0, 0.2),
        (60.0, -12.0, 0.0, 0.0, 0.0),
        (60.0, -20.0, 0.0, 0.1, -0.1),  # aside: from right behind it the bonnet hides behind the cabin
        (-15.0, 70.0, 0.4, -0.1, 0.05),
        (-70.0, 20.0, 2.4, 0.0, 0.1),
    ],
)
def test_a_car_appears_where_the_pinhole_puts_it(x: float, y: float, yaw: float, pitch: float, roll: float) -> None:
    c = capture(yaw=yaw, pitch=pitch, roll=roll)
    views = Renderer(only_target(x, y), 1).render([c])[0]
    expected = project(c, (x, y, 0.9))
    assert expected
    for name, image in zip(CAMERAS, views, strict=True):
        rows, columns = np.nonzero(red(image))
        if name in expected:
            column, row = expected[name]
            if 4 < column < WIDTH_PX - 4 and 4 < row < HEIGHT_PX - 4:
                assert columns.mean() == pytest.approx(column, abs=1.2), name
                assert rows.mean() == pytest.approx(row, abs=1.2), name
        else:
            assert len(rows) < 4, name


def test_five_drones_agree_on_the_ground() -> None:
    captures, found = cross(0.0, 0.0, 0.3), []
    images = lift(Renderer(only_target(25.0, 30.0), 1).render(captures), captures).numpy()
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    for c, image in zip(captures, images, strict=True):
        pixels = np.argwhere(red(np.moveaxis(image[:3], 0, -1)))
        local = (pixels.mean(axis=0) + 0.5) * FULL.image_m - FULL.half_extent_m
        found.append(c.position_m[:2] + local @ turn)
    assert np.ptp(found, axis=0).max() < 2.4  # they see different sides of it
    assert np.mean(found, axis=0) == pytest.approx([25.0, 30.0], abs=1.0)


def test_a_building_hides_the_car_behind_it_from_one_side_only() -> None:
    town = Scene(tree_density=0, parked_density=0, moving_cars_per_km=0, building_density=1, building_height_m=16)
    buildings = SceneModel(town, None, (0, 0, 0, 0)).town.block(0, 0).buildings
    _, y0, x1, y1, height, _ = max(buildings[buildings[:, 2] > 66.0], key=lambda b: b[4])
    assert height > 14
    kerb, middle = 80.0 - 4.35, (y0 + y1) / 2
    behind, in_front = capture(x1 - 60.0, middle), capture(kerb + 25.0, middle)
    views = Renderer(only_target(kerb, middle, town), 1).render([behind, in_front])
    assert red(views[0]).sum() == 0
    assert red(views[1]).sum() > 10


def test_a_car_stands_up_where_nothing_else_does() -> None:
    """Its roof is lit, not the side of something; and things that are higher, anywhere, do not change how it looks."""
    renderer, c = Renderer(only_target(8.0, 3.0), 1), capture()
    bare = renderer.render([c])[0]
    assert bare[..., 0][red(bare)].max() > 200
    assert renderer._window is not None
    renderer._window.top_m = 20.0
    assert np.array_equal(renderer.render([c])[0], bare)


def test_rendering_leaves_the_scenery_as_it_was_and_repeats_itself_whatever_else_is_rendered() -> None:
    scene = SceneModel(Scene(), None, (-50, -50, 50, 50))
    renderer, fleet = Renderer(scene, 1), cross(0, 0, 0.0, t_s=1.0)
    first, window = renderer.render(fleet), renderer._window
    assert window is not None
    before = [layer.copy() for layer in (window.height, window.colour, window.coarse)]
    other = renderer.render(cross(0, 0, 0.0, t_s=9.0))
    for layer, was in zip((window.height, window.colour, window.coarse), before, strict=True):
        assert np.array_equal(layer, was)
    assert not np.array_equal(first, other)
    assert np.array_equal(first, Renderer(scene, 1).render(fleet))
    assert np.array_equal(first[3:4], Renderer(scene, 1).render(fleet[3:4]))
    assert not np.array_equal(first, Renderer(scene, 2).render(fleet))
    assert renderer.render([]).shape == (0, 5, HEIGHT_PX, WIDTH_PX, 3)
    assert lift(renderer.render([]), []).shape == (0, 4, BEV_PX, BEV_PX)


BOUNDS = (-20.0, -20.0, 20.0, 20.0)


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
