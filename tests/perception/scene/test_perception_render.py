"""Cameras and the lift: a red car of known place is found where geometry says, and hidden where it must be."""

import numpy as np
import pytest
from perception_examples import EMPTY, capture, cross, only_target
from scipy.spatial.transform import Rotation

from sortie.perception.geometry import FULL, HALF_H, HALF_V, HEIGHT_PX, WIDTH_PX
from sortie.perception.geometry import IMAGE_PX as BEV_PX
from sortie.perception.network.bev import lift
from sortie.perception.scene.render import AXES, CAMERAS, Renderer, rotation, tilt
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture
from sortie.scenarios.schema import Scene


def red(image: np.ndarray) -> np.ndarray:
    """Mask of pixels of the target's colour."""
    r, g, b = (image[..., c].astype(int) for c in range(3))
    return (r - g > 85) & (r - b > 85)


def project(c: Capture, point: tuple[float, float, float]) -> dict[str, tuple[float, float]]:
    """Where a world point is in each camera that has it in view: column, row (an own pinhole, by scipy's rotation)."""
    body = Rotation.from_quat(c.orientation_xyzw).inv().apply(np.subtract(point, c.position_m))
    out = {}
    for name, axes in zip(CAMERAS, AXES, strict=True):
        right, down, ahead = axes @ body
        u, v = right / ahead / HALF_H, down / ahead / HALF_V
        if ahead > 0 and abs(u) < 1 and abs(v) < 1:
            out[name] = ((u + 1) / 2 * WIDTH_PX - 0.5, (v + 1) / 2 * HEIGHT_PX - 0.5)
    return out


def test_rotation_agrees_with_scipy() -> None:
    q = Rotation.from_euler("ZYX", [1.0, -0.2, 0.3]).as_quat()
    assert rotation(q) == pytest.approx(Rotation.from_quat(q).as_matrix())


@pytest.mark.parametrize("broken", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, float("nan"), 1.0), (0.0, float("inf"), 0.0, 1.0)])
def test_an_attitude_without_a_length_is_refused(broken: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match=r"orientation_xyzw is .*, must have a finite length above 0"):
        Renderer(only_target(10.0, 5.0), 1).render([capture()._replace(orientation_xyzw=broken)])


def test_tilt_is_the_attitude_without_heading() -> None:
    q = Rotation.from_euler("ZYX", [2.0, -0.2, 0.3]).as_quat()
    assert tilt(q) == pytest.approx(Rotation.from_euler("ZYX", [0.0, -0.2, 0.3]).as_matrix())


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


@pytest.mark.parametrize(("x", "y"), [(12.0, -20.0), (70.0, 10.0), (-30.0, 75.0), (-60.0, -20.0)])
@pytest.mark.parametrize(("yaw", "pitch", "roll"), [(0.0, 0.0, 0.0), (0.7, 0.08, -0.1), (-2.5, -0.1, 0.12)])
def test_the_lift_puts_what_is_flat_where_it_lies(
    monkeypatch: pytest.MonkeyPatch, x: float, y: float, yaw: float, pitch: float, roll: float
) -> None:
    monkeypatch.setattr(
        "sortie.perception.scene.scene_model.TARGET_SIZE_M", (4.6, 1.9, 0.01)
    )  # a car painted on the road
    c = capture(8.0, -4.0, yaw=yaw, pitch=pitch, roll=roll)
    bev = lift(Renderer(only_target(x, y), 1).render([c]), [c])[0].numpy()
    rows, columns = np.nonzero(red(np.moveaxis(bev[:3], 0, -1)))
    if len(rows) == 0:
        pytest.skip("in the gap between two cameras")
    forward, left = (
        (rows + 0.5) * FULL.image_m - FULL.half_extent_m,
        (columns + 0.5) * FULL.image_m - FULL.half_extent_m,
    )
    dx, dy = x - 8.0, y + 4.0
    true = np.array([np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx])
    assert np.array([forward.mean(), left.mean()]) == pytest.approx(true, abs=1.0)


def test_five_drones_agree_on_the_ground() -> None:
    scene = only_target(25.0, 30.0)
    captures = cross(0.0, 0.0, 0.3)
    found = []
    for c, bev in zip(captures, lift(Renderer(scene, 1).render(captures), captures).numpy(), strict=True):
        rows, columns = np.nonzero(red(np.moveaxis(bev[:3], 0, -1)))
        f, s = (
            (rows.mean() + 0.5) * FULL.image_m - FULL.half_extent_m,
            (columns.mean() + 0.5) * FULL.image_m - FULL.half_extent_m,
        )
        found.append(
            (
                c.position_m[0] + np.cos(0.3) * f - np.sin(0.3) * s,
                c.position_m[1] + np.sin(0.3) * f + np.cos(0.3) * s,
            )
        )
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


def test_rendering_leaves_the_scenery_as_it_was_and_repeats_itself() -> None:
    scene = SceneModel(Scene(), None, (-50, -50, 50, 50))
    renderer = Renderer(scene, 1)
    first = renderer.render(cross(0, 0, 0.0, t_s=1.0))
    window = renderer._window
    assert window is not None
    height, colour, coarse = window.height.copy(), window.colour.copy(), window.coarse.copy()
    other = renderer.render(cross(0, 0, 0.0, t_s=9.0))
    assert np.array_equal(window.height, height)
    assert np.array_equal(window.colour, colour)
    assert np.array_equal(window.coarse, coarse)
    assert not np.array_equal(first, other)
    assert np.array_equal(first, Renderer(scene, 1).render(cross(0, 0, 0.0, t_s=1.0)))
    assert not np.array_equal(first, Renderer(scene, 2).render(cross(0, 0, 0.0, t_s=1.0)))


def test_a_view_does_not_depend_on_what_else_is_rendered() -> None:
    scene = SceneModel(Scene(), None, (-50, -50, 50, 50))
    captures = cross(0, 0, 0.2)
    alone = Renderer(scene, 1).render([captures[3]])[0]
    assert np.array_equal(Renderer(scene, 1).render(captures)[3], alone)


def test_the_wide_side_of_the_nadir_view_is_left_to_right() -> None:
    c = capture()
    seen = lift(np.zeros((1, 5, HEIGHT_PX, WIDTH_PX, 3), np.uint8), [c])[0, 3].numpy() > 0
    middle = BEV_PX // 2
    assert seen[middle, middle]
    assert seen.mean() > 0.75
    assert not seen[2, 2]  # the corners lie between two cameras


def test_nothing_to_render_gives_nothing() -> None:
    renderer = Renderer(SceneModel(EMPTY, None, (0, 0, 0, 0)), 1)
    assert renderer.render([]).shape == (0, 5, HEIGHT_PX, WIDTH_PX, 3)
    assert lift(renderer.render([]), []).shape == (0, 4, BEV_PX, BEV_PX)
