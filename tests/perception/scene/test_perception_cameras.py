"""Other cameras than the usual ones: what is in their pictures, by pinholes of the tests' own, and what that does."""

from __future__ import annotations

import numpy as np
import pytest
from perception_examples import capture, only_target

from sortie.perception.geometry import USUAL, Cameras, camera_margins
from sortie.perception.network.bev import lift
from sortie.perception.scene.render import Renderer, camera_axes
from sortie.perception.surrogate.features import LOOK_COVARIATES, CaptureColumns, Eyes

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


@pytest.mark.parametrize("cameras", KINDS)
def test_what_is_in_a_picture_is_what_a_pinhole_shows(cameras: Cameras) -> None:
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


def test_all_fields_of_view_cover_more_and_less_ground() -> None:
    def seen(cameras: Cameras) -> float:
        c = capture()._replace(cameras=cameras)
        views = Renderer(only_target(10.0, 5.0), 1).render([c])
        return float((lift(views, [c])[0, 3] > 0).float().mean())

    assert seen(Cameras(50.0)) < seen(USUAL) < seen(Cameras(90.0))
    assert seen(Cameras(pitch_deg=65.0)) < seen(USUAL), "steeper, they show what lies nearer"


def test_more_pixels_show_more_of_a_car() -> None:
    scene, red = only_target(10.0, 5.0), []
    for width_px in (64, 160, 320):
        c = capture()._replace(cameras=Cameras(width_px=width_px))
        (views,) = Renderer(scene, 1).render([c])
        r, g, b = np.moveaxis(views.astype(int), -1, 0)
        red.append(int(((r - g > 85) & (r - b > 85)).sum()))
        assert views.shape == (5, width_px * 9 // 16, width_px, 3)
    assert red[0] > 0
    assert red[1] / red[0] == pytest.approx((160 / 64) ** 2, rel=0.3)
    assert red[2] / red[1] == pytest.approx(4.0, rel=0.15)


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
