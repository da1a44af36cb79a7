"""Coverage: what cameras show, what the scene hides, where a drone believes it is, and what is new to the fleet."""

from __future__ import annotations

import math

import numpy as np
import pytest
from agent_rig import descriptor
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sortie.fleet import coverage_loops
from sortie.fleet.chart import Chart
from sortie.fleet.coverage import (
    CELL_M,
    RANGE_M,
    Poses,
    View,
    attitude,
    camera_states,
    footprint_radius_m,
    pack_grid,
    placed,
    unpack_grid,
    views,
)
from sortie.perception.geometry import FULL, USUAL, Cameras
from sortie.perception.scene import height_field, sight_loops
from sortie.perception.scene.height_field import CAR_TOP_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.policies.catalogue.coverage_cells import Cells, seen_well, well_cells
from sortie.policies.contract import COVERAGE_CELLS, Coverage, Descriptor
from sortie.scenarios.schema import Scene

BOUNDS = (-100.0, -100.0, 100.0, 100.0)


PLAIN = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, BOUNDS)
DENSE = SceneModel(Scene(style="old_town", building_density=1.0, building_height_m=18.0), None, BOUNDS)
RNG = np.random.default_rng(21)


def poses(position_m: np.ndarray, tilt_deg: float = 0.0, heading_deg: float = 0.0) -> Poses:
    """One drone that knows where it is, tilted forwards."""
    turn = Rotation.from_euler("zy", [heading_deg, tilt_deg], degrees=True).as_quat()
    at = np.atleast_2d(position_m).astype(float)[:, None]
    heading = np.full(at.shape[:2], math.radians(heading_deg))
    return Poses(at, np.broadcast_to(turn, (*at.shape[:2], 4)), heading, at, heading)


# --- what cameras show ------------------------------------------------------------------------------------


def depth_in_cameras(body: np.ndarray, cameras: Cameras) -> np.ndarray:
    """How far along the axis of a camera a point [..., 3] of the body's frame lies: the nearest of five pinholes."""
    pitch, half = np.radians(cameras.pitch_deg), np.tan(np.radians(cameras.field_of_view_deg / 2))
    axes = [(np.cos(a) * np.cos(pitch), np.sin(a) * np.cos(pitch), -np.sin(pitch)) for a in np.arange(4) * np.pi / 2]
    sides = [(0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0)]
    depth = np.full(body.shape[:-1], np.inf)
    for ahead, side in zip([*axes, (0, 0, -1)], sides, strict=True):
        away, right, up = body @ ahead, body @ side, body @ np.cross(ahead, side)
        shown = (away > 0.1) & (np.abs(right) < half * away) & (np.abs(up) < half * 9 / 16 * away)
        depth = np.where(shown, np.minimum(depth, away), depth)
    return depth


def test_cells_are_as_five_pinholes_show_them() -> None:
    for cameras in (USUAL, Cameras(50.0), Cameras(pitch_deg=30.0), Cameras(60.0, 60.0, 320)):
        at = RNG.uniform((-6.0, -6.0, 20.0), (6.0, 6.0, 60.0), (50, 3))
        turn = Rotation.from_euler("zyx", RNG.uniform(-1.0, 1.0, (50, 3)) * (180.0, 20.0, 20.0), degrees=True)
        middle = (np.arange(16) - 7.5) * CELL_M
        off = np.stack(np.broadcast_arrays(middle, middle[:, None], 0.0), axis=-1) - at[:, None, None]
        depth = depth_in_cameras(off @ turn.as_matrix()[:, None], cameras)
        focal_px = cameras.width_px / 2 / np.tan(np.radians(cameras.field_of_view_deg / 2))
        pixel_m2 = depth**3 / focal_px**2 / at[:, 2, None, None]
        near = np.hypot(off[..., 0], off[..., 1]) <= RANGE_M
        expected = near * (np.isfinite(depth).astype(int) + (pixel_m2 <= FULL.image_m**2))
        found = camera_states(*at.T, attitude(turn.as_quat()), cameras)
        assert (found == expected).mean() > 0.995, cameras
        assert 0.05 < (expected > 0).mean() < 0.95
        assert (expected == Coverage.WELL).any()


def test_footprint_of_the_paper() -> None:
    assert footprint_radius_m(60.0) == pytest.approx(42.0, abs=0.02)
    assert footprint_radius_m(-1.0) == 0.0


@given(st.lists(st.integers(0, 3), min_size=256, max_size=256))
def test_grid_packs_into_64_bytes_and_back(states: list[int]) -> None:
    grid = np.array(states, np.uint8).reshape(16, 16)
    packed = pack_grid(grid)
    assert len(packed) == 64
    assert np.array_equal(unpack_grid(packed), grid)


# --- what the scene hides ---------------------------------------------------------------------------------


def past_something(at: np.ndarray, eye: np.ndarray, houses: np.ndarray, trees: np.ndarray) -> np.ndarray:
    """[n]: whether the line from each point [n, 3] to the eye meets a house or a crown, by 400 points on each line."""
    low, high = np.minimum(at.min(0), eye), np.maximum(at.max(0), eye)
    houses = houses[(houses[:, :2] < high[:2]).all(1) & (houses[:, 2:4] > low[:2]).all(1)]
    trees = trees[(trees[:, :2] - trees[:, 2:3] < high[:2]).all(1) & (trees[:, :2] + trees[:, 2:3] > low[:2]).all(1)]
    line = at[:, None] + np.linspace(0.0, 1.0, 400)[None, :, None] * (eye - at)[:, None]
    x, y, z = (line[..., k, None] for k in range(3))
    x0, y0, x1, y1, height, _ = houses.T
    tx, ty, radius, top, _ = trees.T
    part = ((x - tx) ** 2 + (y - ty) ** 2) / radius**2
    in_house = (x > x0) & (x < x1) & (y > y0) & (y < y1) & (z < height)
    in_crown = (part < 1) & (z < top * (1 - 0.35 * part))
    hit: np.ndarray = in_house.any(axis=(1, 2)) | in_crown.any(axis=(1, 2))
    return hit


def quarters(corner: tuple[float, float], z_m: float) -> np.ndarray:
    """[4, 3]: the middles of a cell's quarters at this height."""
    east, north = corner
    return np.array([(east + a * CELL_M, north + b * CELL_M, z_m) for a in (0.25, 0.75) for b in (0.25, 0.75)])


def test_against_single_rays() -> None:
    """Each cell by points on lines: boxes and domes for the scene, pinholes for the cameras. No code is shared."""
    scene = SceneModel(Scene(), None, BOUNDS)
    blocks = scene.town.blocks(-260, -260, 260, 260)
    houses, trees = (np.concatenate([getattr(b, of) for b in blocks]) for of in ("buildings", "trees"))
    agree, cells = 0, 0
    for _ in range(4):
        x, y, tilt = *RNG.uniform(-80, 80, 2), RNG.uniform(0, 20)
        eye = np.array([x, y, 60.0])
        where = poses(eye, tilt, heading_deg=30.0)
        body = Rotation.from_quat(where.orientation_xyzw[0, 0]).inv()
        ((view,),) = views(where, scene.height_field)
        expected = np.zeros((16, 16), bool)
        for row, column in np.ndindex(16, 16):
            corner = (view.column + column) * CELL_M, (view.row + row) * CELL_M
            away = quarters(corner, 0.0).mean(axis=0) - eye
            if np.hypot(*away[:2]) > RANGE_M or not np.isfinite(depth_in_cameras(body.apply(away), USUAL)):
                continue
            at = quarters(corner, CAR_TOP_M)
            px, py = at[:, :1], at[:, 1:2]
            within = (px > houses[:, 0]) & (px < houses[:, 2]) & (py > houses[:, 1]) & (py < houses[:, 3])
            roofed = within.any(axis=1)
            free = ~roofed & ~past_something(at, eye, houses, trees)
            expected[row, column] = (~roofed).any() and 2 * free.sum() >= (~roofed).sum()
        agree += int(((unpack_grid(view.grid) > 0) == expected).sum())
        cells += 256
        assert 60 < expected.sum() < 230
    assert agree / cells > 0.96  # the field is a raster of 0.8 m


# --- where a drone believes it is -------------------------------------------------------------------------


def test_cells_are_those_of_the_believed_place_and_the_scene_is_that_of_the_true_one() -> None:
    true = poses(np.array([5.0, 3.0, 60.0]))
    off = true._replace(est_position_m=true.est_position_m + np.array([2 * CELL_M, -CELL_M, 0.0]))
    ((view,),), ((shifted,),) = (views(p, DENSE.height_field) for p in (true, off))
    assert shifted == View(view.row - 1, view.column + 2, view.grid)
    elsewhere = true._replace(position_m=true.position_m + np.array([3.0, -3.0, 0.0]))
    on_a_plain = [views(p, PLAIN.height_field) for p in (true, elsewhere)]
    assert on_a_plain[0] == on_a_plain[1], "where it truly is does not matter there"


def test_how_well_cells_are_seen_follows_from_the_true_height() -> None:
    def grid(true_z: float, believed_z: float) -> bytes:
        where = poses(np.array([3.0, 4.0, true_z]))
        ((view,),) = views(where._replace(est_position_m=np.array([[[3.0, 4.0, believed_z]]])), PLAIN.height_field)
        return view.grid

    assert grid(30.0, 30.0) == grid(30.0, 90.0) != grid(90.0, 90.0)


def test_a_wrong_heading_turns_what_is_seen_of_the_scene_with_it() -> None:
    """In the middle of a cell: what lies north of a drone that believes itself a quarter to the left lies west."""
    middle = CELL_M / 2
    true = poses(np.array([middle, middle, 60.0]))
    for off_deg in (90.0, -90.0, 180.0):
        wrong = true._replace(est_yaw_rad=true.yaw_rad + math.radians(off_deg))
        ((view,),), ((turned,),) = (views(p, DENSE.height_field) for p in (true, wrong))
        grid = unpack_grid(view.grid)[1:, 1:]  # 15 × 15 about the drone's own cell
        expected = np.rot90(grid, -round(off_deg / 90))
        assert (unpack_grid(turned.grid)[1:, 1:] == expected).mean() > 0.95
        assert (grid == expected).mean() < 0.9


def test_a_drone_that_believes_to_fly_north_claims_what_one_that_flies_north_sees() -> None:
    def view(true_deg: float, believed_deg: float) -> View:
        where = poses(np.array([3.0, 4.0, 60.0]), heading_deg=true_deg)
        ((seen,),) = views(where._replace(est_yaw_rad=np.array([[math.radians(believed_deg)]])), PLAIN.height_field)
        return seen

    assert view(0.0, 57.0) == view(57.0, 57.0) != view(0.0, 0.0)


def test_frames_between_rays_keep_their_lines_of_sight() -> None:
    """Within the way after which rays are followed again, the grid is nearly the one of its own frame."""
    way = np.stack([np.linspace(-20, 20, 60), np.full(60, 3.0), np.full(60, 60.0)], axis=1)
    together = [view for (view,) in views(poses(way), DENSE.height_field)]
    alone = [views(poses(at), DENSE.height_field)[0][0] for at in way]
    assert [v[:2] for v in together] == [v[:2] for v in alone]
    differ = [np.mean(unpack_grid(a.grid) != unpack_grid(b.grid)) for a, b in zip(together, alone, strict=True)]
    assert np.mean(differ) < 0.02


@given(st.integers(-20, 20), st.integers(-20, 20))
def test_a_moved_grid_keeps_its_cells(north: int, east: int) -> None:
    view = View(3, -7, seen_grid := views(poses(np.array([5.0, 3.0, 60.0])), DENSE.height_field)[0][0].grid)
    row, column = 3 + north, -7 + east
    kept = well_cells(placed(view, row, column), row, column)
    assert kept == {c for c in well_cells(seen_grid, 3, -7) if 0 <= c[0] - row < 16 and 0 <= c[1] - column < 16}


# --- what is new ------------------------------------------------------------------------------------------


def claim(grid: bytes, x_m: float, y_m: float) -> Descriptor:
    return descriptor(1, position_m=(x_m, y_m, 60.0), coverage_grid=grid)


def moved(cells: Cells, columns: int) -> Cells:
    return frozenset((row, column + columns) for row, column in cells)


def test_new_is_what_neither_the_drone_nor_a_peer_saw() -> None:
    ((view,),) = views(poses(np.array([5.0, 3.0, 60.0])), PLAIN.height_field)
    cells = well_cells(view.grid, view.row, view.column)
    chart = Chart()

    def new(column: int, *heard: Descriptor, told: bool) -> Cells:
        grid, is_new = chart.mark(view.grid, view.row, column, lambda: heard, told)
        rows, columns = np.nonzero(unpack_grid(grid) == Coverage.NOVEL)
        found = frozenset(zip((rows + view.row).tolist(), (columns + column).tolist(), strict=True))
        assert is_new == bool(found)
        assert (unpack_grid(grid) >= Coverage.WELL).sum() == len(cells), "marks are on cells that are seen well"
        return found

    assert new(view.column, told=False) == cells, "not told, so that it stays new"
    assert new(view.column, told=True) == cells
    assert new(view.column, told=True) == set()
    assert new(view.column + 3, told=False) == moved(cells, 3) - cells
    assert new(view.column + 3, claim(view.grid, 5.0 + 3 * CELL_M, 3.0), told=False) == set()
    assert new(view.column + 3, claim(view.grid, 5.0 + 4 * CELL_M, 3.0), told=False) == moved(cells, 3) - cells - moved(
        cells, 4
    )


def test_a_chart_holds_whatever_is_claimed() -> None:
    """As a set of cells would: over several sizes of its table, south and west of the origin, and beyond all bounds."""
    rng, chart, known = np.random.default_rng(1), Chart(), set[tuple[int, int]]()
    for _ in range(60):
        states = rng.integers(0, 4, (16, 16)).astype(np.uint8)
        heard = claim(pack_grid(states), *np.float32(rng.normal(0, 400, 2)).tolist())
        row, column = heard.coverage_corner
        grid, _ = chart.mark(heard.coverage_grid, row, column, list, told=False)
        new = {(row + r, column + c) for r, c in np.argwhere(unpack_grid(grid) != states).tolist()}
        fresh = seen_well(heard) - known
        there = {(row + r, column + c) for r, c in np.argwhere(states == Coverage.WELL).tolist()}
        assert new == fresh & there, "cells that were marked already keep their mark"
        chart.fold([heard])
        known |= seen_well(heard)
    chart.fold([claim(bytes([255]) * 64, 3e38, -3e38)])


def test_the_compiled_loops_have_the_constants_of_the_raster() -> None:
    assert (coverage_loops._CELLS, coverage_loops._WELL) == (COVERAGE_CELLS, Coverage.WELL)
    assert (sight_loops._RES_M, sight_loops._STEP_M) == (height_field.RES_M, height_field.STEP_M)
