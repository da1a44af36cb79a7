"""A recording: the detections of another model, frame by frame and drone by drone, on disk as npz or Zarr.

The layout is the table in this folder's README. Everything is checked when a recording is opened, but for features
and confidences, which may be larger than memory and are checked frame by frame as they are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.box_bounds import YAW_RAD, wrong_box, wrong_yaw
from sortie.perception.errors import InputError
from sortie.perception.files import read_npz
from sortie.perception.geometry import CELLS, CHANNELS, Geometry

FORMAT = 1
NEEDED = ("format", "cell_m", "t_s", "pose", "boxes", "boxes_offset", "truth", "truth_offset")
OPTIONAL = ("scene", "est_pose", "features", "confidence")
LARGE = ("features", "confidence")
"""Read a frame at a time."""
CELL_BOUNDS_M = (1e-3, 1e3)
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class RecordingError(InputError):
    """A recording that is missing, broken, or lacks what is needed; the message names file, array, value and bound."""


@dataclass(frozen=True, slots=True)
class Recording:
    """n frames of d drones. Frames of one scene follow each other; poses are ENU, boxes in the drone's own frame."""

    path: Path
    t_s: Floats
    """[n] ascending within a scene."""
    scene: Ints
    """[n]"""
    pose: Floats
    """[n, d, 3] x, y, yaw: where each drone was."""
    est_pose: Floats
    """[n, d, 3] where it believed it was."""
    cell_m: float
    """Side of a feature column (of an exchanged cell, where there are no features)."""
    large: Mapping[str, Any]
    """`features` [n, d, C, H, W] and `confidence` [n, d, H, W], each if recorded, sliced by frame."""
    _boxes: Floats
    _boxes_offset: Ints
    _truth: Floats
    _truth_offset: Ints

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def drones(self) -> int:
        """d."""
        return int(self.pose.shape[1])

    @property
    def grid(self) -> tuple[int, int, int]:
        """C, H, W of the features; 80, 64, 64, as the radio carries them, where none were recorded."""
        if "features" in self.large:
            c, h, w = self.large["features"].shape[2:]
            return c, h, w
        if "confidence" in self.large:
            h, w = self.large["confidence"].shape[2:]
            return CHANNELS, h, w
        return CHANNELS, CELLS, CELLS

    @property
    def columns_a_side(self) -> int:
        """Feature columns along the side of an exchanged cell.

        Raises:
            RecordingError: a grid that the 64 × 64 exchanged cells do not divide.
        """
        _, h, w = self.grid
        if h != w or h % CELLS:
            name = "features" if "features" in self.large else "confidence"
            raise self._error(name, f"has a grid of {h} × {w}", f"square and a multiple of {CELLS} to be exchanged")
        return h // CELLS

    @property
    def geometry(self) -> Geometry:
        """How far the grid reaches."""
        return Geometry(self.cell_m * self.columns_a_side * CELLS / 2)

    @property
    def cell_bytes(self) -> int:
        """One exchanged cell: C × 2 B for each of its columns."""
        return self.grid[0] * 2 * self.columns_a_side**2

    def boxes(self, frame: int, drone: int) -> Floats:
        """[m, 6] x forward, y left of the drone, length, width, yaw, score."""
        k = frame * self.drones + drone
        return self._boxes[self._boxes_offset[k] : self._boxes_offset[k + 1]]

    def truth(self, frame: int) -> Floats:
        """[k, 5] x, y, length, width, yaw of every car there was, ENU."""
        return self._truth[self._truth_offset[frame] : self._truth_offset[frame + 1]]

    def features(self, frame: int, drone: int) -> NDArray[np.float32]:
        """[C, H, W] of one drone.

        Raises:
            RecordingError: none were recorded, or this drone's are not finite.
        """
        if "features" not in self.large:
            raise RecordingError(f"{self.path}: features are missing, must be there to be fused or ranked by norm")
        return self._read("features", frame, drone).astype(np.float32)

    def rank(self, frame: int, drone: int) -> Floats:
        """[64, 64] what ranks the exchanged cells: their highest confidence.

        Where no confidence was recorded a cell's is the highest score of the boxes centred in it, 0 without one.
        """
        s = self.columns_a_side
        if "confidence" in self.large:
            plane = self._read("confidence", frame, drone).astype(np.float64)
            return np.asarray(plane.reshape(CELLS, s, CELLS, s).max(axis=(1, 3)))
        out = np.zeros((CELLS, CELLS))
        boxes = self.boxes(frame, drone)
        row, column, inside = cells_of(boxes, self.geometry)
        np.maximum.at(out, (row[inside], column[inside]), boxes[inside, 5])
        return out

    def _read(self, name: str, frame: int, drone: int) -> NDArray[Any]:
        values = np.asarray(self.large[name][frame, drone])
        if not np.isfinite(values).all():
            raise self._error(name, f"frame {frame}, drone {drone} is not finite", "finite everywhere")
        return values

    def _error(self, name: str, what: str, bound: str) -> RecordingError:
        return RecordingError(f"{self.path}: {name} {what}, must be {bound}")


def cells_of(boxes: Floats, geometry: Geometry) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """Row and column of the exchanged cell that holds each box's centre, and whether the grid reaches it."""
    places = np.floor((boxes[:, :2] + geometry.half_extent_m) / geometry.cell_m)
    row, column = np.clip(places, -1, CELLS).astype(np.int64).T  # a box may be anywhere
    return row, column, (row >= 0) & (row < CELLS) & (column >= 0) & (column < CELLS)


# --- reading ---------------------------------------------------------------------------------------


def open_recording(path: Path | str) -> Recording:
    """A recording on disk: a folder is Zarr (read as it is needed), a file npz (in memory).

    Raises:
        RecordingError: naming the file, the array, its value and the bound; also where Zarr is not installed.
    """
    path = Path(path)
    if path.is_dir():
        return checked(path, *from_zarr(path))
    try:
        arrays = read_npz(path)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such recording, must be an npz file or a Zarr folder") from None
    except Exception as error:
        raise RecordingError(f"{path}: cannot be read as npz ({error or type(error).__name__})") from error
    return checked(
        path,
        {k: v for k, v in arrays.items() if k not in LARGE},
        {k: arrays[k] for k in LARGE if k in arrays},
    )


def from_zarr(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A Zarr folder's arrays in memory, and the large ones, unread."""
    try:
        import zarr
    except ImportError:
        raise RecordingError(f"{path}: a folder is Zarr, which needs pip install 'sortie-sim[zarr]'") from None
    try:
        group = zarr.open_group(path, mode="r")
        arrays = dict(group.arrays())
        small = {name: np.asarray(array[...]) for name, array in arrays.items() if name not in LARGE}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: cannot be read as a Zarr group ({error})") from error
    return small, {name: arrays[name] for name in LARGE if name in arrays}


def checked(path: Path, small: Mapping[str, NDArray[Any]], large: Mapping[str, Any]) -> Recording:
    """Arrays as a recording.

    Raises:
        RecordingError: the first thing that is wrong.
    """
    for name in NEEDED:
        if name not in small:
            raise RecordingError(f"{path}: {name} is missing, a recording must hold {', '.join(NEEDED)}")
    for name in sorted({*small, *large} - {*NEEDED, *OPTIONAL}):
        raise RecordingError(
            f"{path}: {name} is unknown, beside what it must hold a recording may hold {', '.join(OPTIONAL)}"
        )
    checks = _Checks(path, small)
    version = int(checks.numbers("format", ()))
    if version != FORMAT:
        raise RecordingError(f"{path}: format is {version}, must be {FORMAT}")
    cell_m = float(checks.numbers("cell_m", ()))
    low, high = CELL_BOUNDS_M
    checks.require("cell_m", low <= cell_m <= high, f"is {cell_m:g}", f"{low:g} to {high:g} m")
    t_s = checks.numbers("t_s", (None,))
    n = len(t_s)
    checks.require("t_s", n > 0, "is empty", "at least one frame")
    scene = checks.whole("scene", (n,)) if "scene" in small else np.zeros(n, np.int64)
    begins = np.flatnonzero(np.append(True, scene[1:] != scene[:-1]))
    checks.require(
        "scene", len(begins) == len(set(scene.tolist())), "comes back to a scene it left", "one run of frames a scene"
    )
    back = np.flatnonzero((np.diff(t_s) <= 0) & (scene[1:] == scene[:-1]))
    if len(back):
        at = int(back[0]) + 1
        checks.require("t_s", False, f"is {t_s[at]:g} in frame {at}", f"above {t_s[at - 1]:g}, the frame before")
    pose = checks.numbers("pose", (n, None, 3))
    d = pose.shape[1]
    checks.require("pose", d > 0, "has no drones", "at least one")
    est_pose = checks.numbers("est_pose", (n, d, 3)) if "est_pose" in small else pose
    for name, poses in (("pose", pose), ("est_pose", est_pose)):
        if len(turned := np.argwhere(wrong_yaw(poses[..., 2]))):
            frame, drone = turned[0].tolist()
            what = f"[{frame}, {drone}, 2] is {poses[frame, drone, 2]:g}"
            checks.require(name, False, what, f"within ±{YAW_RAD:.2f} rad, not degrees")
    parts = []
    for name, width, count in (("boxes", 6, n * d), ("truth", 5, n)):
        table = checks.numbers(name, (None, width))
        offset = checks.whole(f"{name}_offset", (count + 1,))
        ends = (int(offset[0]), int(offset[-1]))
        checks.require(
            f"{name}_offset",
            ends == (0, len(table)),
            f"runs from {ends[0]} to {ends[1]}",
            f"0 to {len(table)}, the rows of {name}",
        )
        checks.require(f"{name}_offset", bool((np.diff(offset) >= 0).all()), "falls", "ascending")
        if wrong := wrong_box(table):
            raise RecordingError(f"{path}: {name}: {wrong}")
        parts += [table, offset]
    _check_large(path, large, n, d)
    return Recording(path, t_s, scene, pose, est_pose, cell_m, dict(large), *parts)


def _check_large(path: Path, large: Mapping[str, Any], n: int, d: int) -> None:
    for name, kind, rank in (("features", "float16", 5), ("confidence", "floating", 4)):
        if name not in large:
            continue
        shape, dtype = tuple(large[name].shape), np.dtype(large[name].dtype)
        names = "n, drones, C, H, W" if rank == 5 else "n, drones, H, W"
        if len(shape) != rank or shape[:2] != (n, d) or 0 in shape:
            raise RecordingError(
                f"{path}: {name} has shape {list(shape)}, must be [{names}] with n = {n}, drones = {d}"
            )
        if (dtype != np.float16) if kind == "float16" else dtype.kind != "f":
            raise RecordingError(f"{path}: {name} is {dtype}, must be {kind}")
    if len(large) == 2 and large["features"].shape[3:] != large["confidence"].shape[2:]:
        h, w = large["features"].shape[3:]
        found = " × ".join(map(str, large["confidence"].shape[2:]))
        raise RecordingError(f"{path}: confidence has a grid of {found}, must be the features' {h} × {w}")


@dataclass(frozen=True, slots=True)
class _Checks:
    """Checks arrays of a file."""

    path: Path
    arrays: Mapping[str, NDArray[Any]]

    def require(self, name: str, good: bool, what: str, bound: str) -> None:
        if not good:
            raise RecordingError(f"{self.path}: {name} {what}, must be {bound}")

    def numbers(self, name: str, shape: tuple[int | None, ...]) -> Any:
        """As float64 of a shape; None is any length."""
        array = np.asarray(self.arrays[name])
        self.require(name, array.dtype.kind in "iuf", f"is {array.dtype}", "numbers")
        fits = array.ndim == len(shape) and all(w is None or h == w for h, w in zip(array.shape, shape, strict=True))
        expected = ", ".join("any" if w is None else str(w) for w in shape)
        self.require(name, fits, f"has shape {list(array.shape)}", f"[{expected}]")
        good = np.isfinite(array)
        if not good.all():
            at = [int(i[0]) for i in np.nonzero(~good)]
            self.require(name, False, f"{at} is {array[tuple(at)]}", "finite")
        return array.astype(np.float64)

    def whole(self, name: str, shape: tuple[int | None, ...]) -> Any:
        """As int64 of a shape."""
        self.require(
            name, np.asarray(self.arrays[name]).dtype.kind in "iu", f"is {self.arrays[name].dtype}", "whole numbers"
        )
        return self.numbers(name, shape).astype(np.int64)
