"""The compiled loops against plain ones: every ray walked step by step, every ground point projected and interpolated."""

from __future__ import annotations

import numpy as np
import pytest
from perception_examples import capture
from scipy.ndimage import map_coordinates

from sortie.perception.compiled import compiled
from sortie.perception.geometry import FULL, Cameras
from sortie.perception.network.bev import ground_points, lift
from sortie.perception.scene.rays import COARSE, FAR, FAR_REACH, HAZE, REACH, see
from sortie.perception.scene.render import camera_axes, tilt, views_shape

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


def town(rng: np.random.Generator, tallest_m: float) -> np.ndarray:
    height = np.zeros((SIDE, SIDE), np.float32)
    for _ in range(60):
        x, y = rng.integers(0, SIDE - 40, 2)
        w, d = rng.integers(4, 40, 2)
        height[y : y + d, x : x + w] = rng.uniform(0.5, tallest_m)
    return height


@pytest.mark.parametrize(("tallest_m", "gain"), [(1.4, 1.0), (9.0, 0.6), (31.0, 1.3)])
def test_a_ray_shows_the_first_thing_on_its_way_down(tallest_m: float, gain: float) -> None:
    rng = np.random.default_rng(round(tallest_m))
    height = town(rng, tallest_m)
    colour = rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    slope = rng.uniform(-1.7, 1.7, (20_000, 2))
    slope[::50] *= 3.0  # flatter than 1:3 some of them
    rays = np.column_stack([slope, -np.ones(len(slope))]).astype(np.float32)
    noise = rng.integers(0, 16, rays.shape, dtype=np.uint8)
    eye = (np.float32(SIDE / 2), np.float32(SIDE / 2), np.float32(40.0))
    out = np.empty(rays.shape, np.uint8)
    coarse = blocks(height, COARSE, 1)
    far = blocks(coarse, FAR // COARSE, FAR_REACH)
    see(
        rays, np.eye(3, dtype=np.float32), eye, np.float32(RES_M), height.max(), height, coarse, far, colour,
        np.float32(gain), noise, out,
    )  # fmt: skip

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
