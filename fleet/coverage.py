"""The coverage grid: which ground a drone's cameras saw, how well, and what of it nobody had seen before.

The grid is 16 × 16 cells of 12.8 m, north-aligned and snapped to the world's 12.8 m lattice, so that two drones'
grids can be compared cell by cell. It covers the ±102.4 m that the perception covers.

A cell is seen where a camera's picture shows its middle, and at least half of its open ground has a free line of sight.
It is seen well where the picture is as fine there as the network's map. Roofs hold no cars, so they are no open ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple, overload

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sortie.perception.geometry import FULL, USUAL, Cameras
from sortie.perception.scene.height_field import HeightField
from sortie.policies.contract import COVERAGE_BYTES, COVERAGE_CELLS
from sortie.policies.contract import COVERAGE_CELL_M as CELL_M
from sortie.scenarios.schema import Fleet

Array = npt.NDArray[np.float64]
States = npt.NDArray[np.uint8]

RANGE_M = FULL.half_extent_m
"""From the drone to each edge of the square that perception covers."""
WELL_PIXEL_M2 = FULL.image_m**2
"""A cell is seen well where a camera pixel covers at most this much ground: a pixel of the map that the network reads."""
LOOK_STANDS_S = 1.0
"""A look older than this says nothing of what a drone sees."""
NOVEL_FLAG, TARGET_FLAG = 1, 2
NOTHING_SEEN = bytes(COVERAGE_BYTES)
SAMPLES = 2
"""Lines of sight to a cell: so many a side."""
SIGHT_MOVES_M = CELL_M / 4
"""Lines of sight are followed again when the drone has flown so far. Over this way a roof 10 m high moves its shadow,
seen from 60 m, by half a metre."""
_HALF = COVERAGE_CELLS // 2
_MIDDLES_M = ((np.arange(COVERAGE_CELLS) - _HALF + 0.5) * CELL_M).astype(np.float32)
_BYTE_PLACES = np.array([1, 4, 16, 64], np.uint8)


def cameras_of(fleet: Fleet) -> list[Cameras]:
    """Each drone's cameras."""
    return [Cameras(**camera.model_dump()) for camera in fleet.cameras]


@overload
def footprint_radius_m(height_m: float, cameras: Cameras = USUAL) -> float: ...
@overload
def footprint_radius_m(height_m: Array, cameras: Cameras = USUAL) -> Array: ...
def footprint_radius_m(height_m: float | Array, cameras: Cameras = USUAL) -> float | Array:
    """Radius of the nadir camera's footprint at a height above ground, any shape: with the usual 70° at 60 m it is 42 m."""
    radius_m: Array = np.maximum(0.0, height_m) * math.tan(math.radians(cameras.field_of_view_deg / 2))
    return radius_m


def pack_grid(states: States) -> bytes:
    """16 × 16 coverage states (rows from south, columns from west) to 64 B, lowest bits first."""
    return (states.astype(np.uint8).reshape(-1, 4) @ _BYTE_PLACES).tobytes()


def unpack_grid(grid: bytes) -> States:
    """The inverse of `pack_grid`: uint8 [16, 16]."""
    packed = np.frombuffer(grid, np.uint8)[:, None]
    states: States = (packed >> np.array([0, 2, 4, 6], np.uint8)) & np.uint8(3)
    return states.reshape(COVERAGE_CELLS, COVERAGE_CELLS)


@cache
def loops() -> Any:
    """The compiled loops, imported and made ready at their first use: before a flight, whose drones may be real ones."""
    from sortie.fleet import coverage_loops

    f, states, single = np.float32, np.zeros((0, COVERAGE_CELLS, COVERAGE_CELLS), np.uint8), np.zeros(0, np.float32)
    coverage_loops.camera_states(
        single, single, single, np.zeros((0, 3, 3), f), single, 1.0, 1.0, 1.0, 1.0, f(0), f(0), states
    )
    coverage_loops.count(np.frombuffer(b"", np.uint8).reshape(0, COVERAGE_BYTES), states)
    return coverage_loops


class View(NamedTuple):
    """What a drone's cameras see at one moment: states unseen, poor and well, placed where it believes to be."""

    row: int
    """Row and column, in the world's lattice, of the grid's south-west cell."""
    column: int
    grid: bytes


class Poses(NamedTuple):
    """Where drones are, and where they believe they are; arrays [frames, drones, ...]."""

    position_m: Array
    orientation_xyzw: Array
    yaw_rad: Array
    est_position_m: Array
    est_yaw_rad: Array


def camera_states(x_m: Array, y_m: Array, height_m: Array, body: Array, cameras: Cameras = USUAL) -> States:
    """How well cameras see the cells around them where nothing stands in between: uint8 [..., 16, 16].

    The ground that a pixel covers is depth³ ÷ (focal length² · height), with the depth along the camera's axis: the
    projection of a pinhole camera onto level ground, at any attitude.

    Args:
        x_m, y_m: [...] from the corner between the grid's four middle cells to the drone, east and north.
        height_m: [...] above the ground.
        body: [..., 3, 3] the attitude, body (FLU) to ENU.
        cameras: of all these drones.
    """
    lens = cameras.lens
    states = np.empty((*body.shape[:-2], COVERAGE_CELLS, COVERAGE_CELLS), np.uint8)
    x, y, height = (np.ascontiguousarray(v, np.float32).reshape(-1) for v in (x_m, y_m, height_m))
    turn = np.ascontiguousarray(body, np.float32).reshape(-1, 3, 3)
    near_m2, well_m2 = np.float32(RANGE_M**2), np.float32(WELL_PIXEL_M2 * cameras.focal_px**2)
    loops().camera_states(
        x, y, height, turn, _MIDDLES_M, *lens, near_m2, well_m2, states.reshape(-1, COVERAGE_CELLS, COVERAGE_CELLS)
    )
    return states


def attitude(orientation_xyzw: Array, turn_rad: Array | float = 0.0) -> Array:
    """The matrices [..., 3, 3] that take the body's axes (FLU) to ENU, turned about the vertical."""
    flat = Rotation.from_quat(orientation_xyzw.reshape(-1, 4)).as_matrix().reshape(*orientation_xyzw.shape[:-1], 3, 3)
    c, s = np.cos(turn_rad)[..., None], np.sin(turn_rad)[..., None]
    east, north, up = flat[..., 0, :], flat[..., 1, :], flat[..., 2, :]
    return np.stack([c * east - s * north, s * east + c * north, up], axis=-2)


def views(poses: Poses, field: HeightField, cameras: Sequence[Cameras] | None = None) -> list[list[View]]:
    """What every drone's cameras see in every frame: views [frames][drones].

    What is hidden follows from where the drone is. The cells are those of where it believes to be.

    Args:
        poses: of all drones in some frames.
        field: what hides the ground.
        cameras: each drone's; None: the usual ones.
    """
    believed = poses.est_position_m[..., :2].astype(np.float32).astype(np.float64)  # as the wire rounds it
    middle = np.floor(believed / CELL_M)  # the cell below the drone: its south-west corner is the grid's middle
    corner = (middle - _HALF).astype(np.int64)
    away = believed - middle * CELL_M
    turn = poses.est_yaw_rad - poses.yaw_rad
    body, each = attitude(poses.orientation_xyzw, turn), cameras or [USUAL] * turn.shape[1]
    states = np.empty((*turn.shape, COVERAGE_CELLS, COVERAGE_CELLS), np.uint8)
    for kind in dict.fromkeys(each):
        of = [drone for drone, its in enumerate(each) if its == kind]
        x, y = away[:, of, 0], away[:, of, 1]
        states[:, of] = camera_states(x, y, poses.position_m[:, of, 2], body[:, of], kind)
    _hide(states, poses, corner, -turn, field)
    packed = states.reshape(*states.shape[:2], COVERAGE_BYTES, 4) @ _BYTE_PLACES
    return [
        [View(row, column, grid.tobytes()) for (column, row), grid in zip(at, grids, strict=True)]
        for at, grids in zip(corner.tolist(), packed, strict=True)
    ]


def _hide(states: States, poses: Poses, corner: npt.NDArray[np.int64], turn: Array, field: HeightField) -> None:
    """Set the states [frames, drones, 16, 16] of cells to unseen where less than half of their open ground is in sight.

    Lines of sight are followed where a drone has flown `SIGHT_MOVES_M` or its grid has moved; the frames in between keep them.
    """
    moved = np.zeros(turn.shape)
    moved[1:] = np.cumsum(np.linalg.norm(np.diff(poses.position_m, axis=0), axis=-1), axis=0)
    key = np.concatenate([corner, (moved // SIGHT_MOVES_M).astype(np.int64)[..., None]], axis=-1)
    renewed = np.ones(turn.shape, bool)
    renewed[1:] = (key[1:] != key[:-1]).any(axis=-1)
    frame, drone = np.nonzero(renewed)
    at = np.maximum.accumulate(np.where(renewed, np.cumsum(renewed.ravel()).reshape(renewed.shape) - 1, 0), axis=0)
    eye, believed = poses.position_m[frame, drone], poses.est_position_m[frame, drone, :2]
    steps = (np.arange(COVERAGE_CELLS * SAMPLES) + 0.5) * (CELL_M / SAMPLES)
    ends = corner[frame, drone] * CELL_M - believed
    east, north = ends[:, :1] + steps, ends[:, 1:] + steps
    turned = turn[frame, drone]
    field.hide(states, at, eye, east, north, np.cos(turned), np.sin(turned), (RANGE_M + CELL_M) ** 2)


def placed(view: View, row: int, column: int) -> bytes:
    """The grid of a view, on the cells of a grid whose south-west cell is (row, column)."""
    north, east = row - view.row, column - view.column
    return _moved(view.grid, north, east) if north or east else view.grid


@lru_cache(maxsize=256)
def _moved(grid: bytes, north: int, east: int) -> bytes:
    states = np.zeros((3 * COVERAGE_CELLS,) * 2, np.uint8)
    states[COVERAGE_CELLS:-COVERAGE_CELLS, COVERAGE_CELLS:-COVERAGE_CELLS] = unpack_grid(grid)
    north, east = (COVERAGE_CELLS + min(max(by, -COVERAGE_CELLS), COVERAGE_CELLS) for by in (north, east))
    return pack_grid(states[north : north + COVERAGE_CELLS, east : east + COVERAGE_CELLS])
