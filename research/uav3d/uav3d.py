"""UAV3D's files: nuScenes-style JSON tables, `uav3d_infos_{train,val}.pkl`, 25 cameras, and a split as a recording.

Facts of the format (UAV3D's converter and the nuScenes schema; this folder's README names the sources):

- a camera's pose stands in `calibrated_sensor`, in world coordinates; in the pickles relative to UAV 0's position on
  the ground, (x, y, 0) of its bottom camera, which `ego2global_translation` holds. Axes are the world's: the
  bird's-eye view is not turned with the drone.
- the world is CARLA's, x forward, y right, z up: left-handed. Here it is mirrored (y → −y) into ENU's handedness.
- `gt_boxes` are (x, y, z, w, l, h, −yaw − π/2) about UAV 0, only those within ±102.4 m of it; annotations are sized
  (w, l, h) with rotations w, x, y, z, and all of them are there.
- stamps are nanoseconds (nuScenes has microseconds).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from research.uav3d.unpickle import UnpickleError, load_data
from sortie.perception.errors import InputError
from sortie.perception.geometry import FULL
from sortie.perception.recordings.recording import Floats
from sortie.perception.recordings.writing import write_recording
from sortie.scenarios.regular import regular

UAVS = 5
SIDES = ("FRONT", "BACK", "LEFT", "RIGHT", "BOTTOM")
CAMERAS = tuple(f"CAMERA_{side}_id_{uav}" for uav in range(UAVS) for side in SIDES)
VERSIONS = ("v1.0-trainval", "v1.0-mini", "v1.0-test", "v1.0")
REACH_Z_M = 10.0
"""UAV3D leaves out annotations higher or lower than this."""
_SIDE = re.compile(r"CAM(?:ERA)?_(FRONT|BACK|LEFT|RIGHT|BOTTOM)_id_([0-4])")


class Uav3dError(InputError):
    """Files that are missing or broken; the message names file, record, field, value and bound."""


@dataclass(frozen=True, slots=True)
class Camera:
    """One camera of one sample, in UAV3D's own axes."""

    file: str
    """Path of the image, as the data set has it."""
    position_m: tuple[float, float, float]
    """In the world."""
    rotation_wxyz: tuple[float, float, float, float]
    intrinsic: Floats
    """[3, 3]"""


@dataclass(frozen=True, slots=True)
class Uav3dSample:
    """One sample of a split."""

    token: str
    stamp: int
    cameras: Mapping[str, Camera]
    """By `CAMERAS`."""
    boxes: Floats
    """[n, 7] as in the pickle, about UAV 0."""

    def uav_m(self, uav: int) -> tuple[float, float, float]:
        """Where a UAV was: its bottom camera."""
        return self.cameras[f"CAMERA_BOTTOM_id_{uav}"].position_m


def read_infos(path: Path | str) -> list[Uav3dSample]:
    """The samples of `uav3d_infos_{train,val}.pkl`, in its order. The pickle is read as data (`unpickle`).

    Raises:
        Uav3dError: a file that is missing, broken, of another shape, or names what is not data.
    """
    path = Path(path)
    try:
        data = load_data(path)
    except UnpickleError as error:
        raise Uav3dError(str(error)) from None
    if not isinstance(data, dict) or not isinstance(data.get("infos"), list):
        raise Uav3dError(f"{path}: infos is missing, must be a list in a dict of infos and metadata")
    return [_info(_Record(f"{path}: infos[{k}]", info)) for k, info in enumerate(data["infos"])]


def _info(r: _Record) -> Uav3dSample:
    origin = r.vector("ego2global_translation", 3)
    cams = r.record("cams")
    cameras = {}
    for name in CAMERAS:
        c = cams.record(name)
        x, y, z = c.vector("sensor2ego_translation", 3)
        w, i, j, k = c.vector("sensor2ego_rotation", 4)
        place = (x + origin[0], y + origin[1], z + origin[2])
        cameras[name] = Camera(c.text("data_path"), place, (w, i, j, k), c.array("cam_intrinsic", (3, 3)))
    boxes = r.array("gt_boxes", (None, 7))
    if len(boxes) and (boxes[:, 3:6] <= 0).any():
        raise Uav3dError(
            f"{r.where}.gt_boxes row {int(np.argmax((boxes[:, 3:6] <= 0).any(axis=1)))} has a size ≤ 0, must be above 0 m"
        )
    return Uav3dSample(r.text("token"), r.whole("timestamp"), cameras, boxes)


@dataclass(frozen=True, slots=True)
class Tables:
    """What the JSON tables hold beyond the pickles: each sample's scene, and every annotation."""

    scene_of: Mapping[str, str]
    """Scene name by sample token."""
    cars: Mapping[str, Floats]
    """[n, 7] by sample token: x, y, z, w, l, h, yaw (about z, from x towards y), in UAV3D's world."""
    cameras: Mapping[str, Mapping[str, Camera]]
    """Cameras by sample token and name."""


def read_tables(folder: Path | str) -> Tables:
    """The JSON tables of a version's folder, such as `v1.0-trainval`.

    Raises:
        Uav3dError: a table that is missing, no JSON list, or a record that points nowhere.
    """
    folder = Path(folder)
    tables = {
        name: _table(folder / f"{name}.json")
        for name in ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "sample_annotation")
    }

    def at(name: str, key: str, by: _Record) -> _Record:
        if key not in tables[name]:
            raise Uav3dError(f"{by.where} points to {name} {key!r}, must be in {name}.json")
        return tables[name][key]

    scene_of = {t: at("scene", r.text("scene_token"), r).text("name") for t, r in tables["sample"].items()}
    channels: dict[str, dict[str, Camera]] = {token: {} for token in scene_of}
    for r in tables["sample_data"].values():
        pose = at("calibrated_sensor", r.text("calibrated_sensor_token"), r)
        found = _SIDE.fullmatch(at("sensor", pose.text("sensor_token"), pose).text("channel"))
        if found is None:
            continue  # another sensor
        at("sample", r.text("sample_token"), r)
        x, y, z = pose.vector("translation", 3)
        w, i, j, k = pose.vector("rotation", 4)
        camera = Camera(r.text("filename"), (x, y, z), (w, i, j, k), pose.array("camera_intrinsic", (3, 3)))
        channels[r.text("sample_token")][f"CAMERA_{found[1]}_id_{found[2]}"] = camera
    rows: dict[str, list[list[float]]] = {token: [] for token in scene_of}
    for r in tables["sample_annotation"].values():
        at("sample", r.text("sample_token"), r)
        size = r.vector("size", 3)
        if min(size) <= 0:
            raise Uav3dError(f"{r.where}.size is {size}, must be above 0 m")
        rows[r.text("sample_token")].append([*r.vector("translation", 3), *size, yaw_of(r.vector("rotation", 4))])
    return Tables(scene_of, {t: np.array(v, np.float64).reshape(-1, 7) for t, v in rows.items()}, channels)


def yaw_of(rotation_wxyz: Sequence[float]) -> float:
    """The angle about z of a quaternion w, x, y, z."""
    w, x, y, z = rotation_wxyz
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def cars_enu(world: Floats) -> Floats:
    """Annotations [n, 7] (x, y, z, w, l, h, yaw) as cars [n, 5] (x, y, length, width, yaw) in ENU's handedness."""
    return np.stack([world[:, 0], -world[:, 1], world[:, 4], world[:, 3], -world[:, 6]], axis=1)


def boxes_enu(boxes: Floats, score: ArrayLike) -> Floats:
    """Boxes [n, 7] of UAV3D's pickles and models, with scores [n], as rows [n, 6] of a recording, about the same UAV."""
    boxes = np.asarray(boxes, np.float64)
    own = np.concatenate([boxes[:, :6], -boxes[:, 6:7] - np.pi / 2], axis=1)
    return np.concatenate([cars_enu(own), np.asarray(score, np.float64)[:, None]], axis=1)


def convert(
    root: Path | str,
    split: str,
    out: Path | str,
    *,
    version: str | None = None,
    boxes: Callable[[str, int], ArrayLike] | None = None,
) -> Path:
    """A split as a recording: scenes, times, where the UAVs were, and every car there was.

    Args:
        root: the folder with `uav3d_infos_{split}.pkl` and the tables' folder in it.
        split: train or val. The test split has no truth.
        out: as for `write_recording`.
        version: the tables' folder; None takes the first of `VERSIONS` that is there.
        boxes: your detections: boxes(sample token, uav) → [m, 6] about that UAV (`boxes_enu`); None leaves them empty.

    Yaws are 0: UAV3D's bird's-eye view has the world's axes.

    Raises:
        Uav3dError: as `read_infos` and `read_tables`, or the two do not belong together.
    """
    root = Path(root)
    samples = read_infos(root / f"uav3d_infos_{split}.pkl")
    folder = (
        root / version if version else next((root / v for v in VERSIONS if (root / v / "sample.json").is_file()), None)
    )
    if folder is None:
        raise Uav3dError(f"{root}: no tables, must hold one of {', '.join(VERSIONS)} with sample.json in it")
    tables = read_tables(folder)
    for s in samples:
        if s.token not in tables.scene_of:
            raise Uav3dError(f"{root}: sample {s.token!r} of split {split} is not in {folder.name}/sample.json")
    order = sorted(samples, key=lambda s: (tables.scene_of[s.token], s.stamp))
    names = sorted({tables.scene_of[s.token] for s in order})
    begins = {name: min(s.stamp for s in order if tables.scene_of[s.token] == name) for name in names}
    places = np.array([[s.uav_m(u) for u in range(UAVS)] for s in order]).reshape(-1, UAVS, 3)
    world = [tables.cars[s.token] for s in order]
    none = np.zeros((0, 6))
    return write_recording(
        out,
        t_s=[seconds(s.stamp - begins[tables.scene_of[s.token]], s.stamp) for s in order],
        scene=[names.index(tables.scene_of[s.token]) for s in order],
        pose=np.stack([places[..., 0], -places[..., 1], np.zeros(places.shape[:2])], axis=-1),
        boxes=[[none if boxes is None else boxes(s.token, u) for u in range(UAVS)] for s in order],
        truth=[cars_enu(w[np.abs(w[:, 2]) < REACH_Z_M]) for w in world],
        cell_m=FULL.cell_m,
    )


def seconds(span: int, stamp: int) -> float:
    """A span of stamps in seconds: nanoseconds as UAV3D writes them, or microseconds as nuScenes, by the stamp's size."""
    return span / (1e9 if stamp >= 10**17 else 1e6)


def read_image(root: Path | str, camera: Camera) -> NDArray[np.uint8]:
    """[h, w, 3] uint8, 450 × 800 in UAV3D; needs Pillow, which the extra `report` brings.

    Raises:
        Uav3dError: no such file, or no image.
    """
    from PIL import Image

    path = Path(root) / camera.file
    try:
        with Image.open(regular(path)) as image:
            return np.asarray(image.convert("RGB"), np.uint8)
    except OSError as error:
        raise Uav3dError(f"{path}: cannot be read as an image ({error.strerror or error})") from None


# --- records ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Record:
    """A dict of a file, with checked access to its fields."""

    where: str
    data: Any

    def get(self, name: str) -> Any:
        if not isinstance(self.data, dict) or name not in self.data:
            raise Uav3dError(f"{self.where}.{name} is missing")
        return self.data[name]

    def record(self, name: str) -> _Record:
        return _Record(f"{self.where}.{name}", self.get(name))

    def text(self, name: str) -> str:
        value = self.get(name)
        if not isinstance(value, str):
            raise Uav3dError(f"{self.where}.{name} is {value!r}, must be text")
        return value

    def whole(self, name: str) -> int:
        value = self.get(name)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
            raise Uav3dError(f"{self.where}.{name} is {value!r}, must be a whole number")
        return int(value)

    def vector(self, name: str, length: int) -> tuple[float, ...]:
        return tuple(self.array(name, (length,)).tolist())

    def array(self, name: str, shape: tuple[int | None, ...]) -> Floats:
        """Finite numbers of a shape; None is any length."""
        found = self.get(name)
        try:
            value = np.array(found, np.float64)
        except (TypeError, ValueError):
            raise Uav3dError(f"{self.where}.{name} is not numbers, must be") from None
        if value.size == 0 and shape[0] is None:
            value = value.reshape(0, *(w or 0 for w in shape[1:]))
        if value.ndim != len(shape) or any(w is not None and h != w for h, w in zip(value.shape, shape, strict=True)):
            expected = ", ".join("any" if w is None else str(w) for w in shape)
            raise Uav3dError(f"{self.where}.{name} has shape {list(value.shape)}, must be [{expected}]")
        if not np.isfinite(value).all():
            raise Uav3dError(f"{self.where}.{name} is not finite, must be finite everywhere")
        return value


def _table(path: Path) -> dict[str, _Record]:
    """A JSON table by token."""
    try:
        rows = json.loads(regular(path).read_bytes())
    except OSError as error:
        raise Uav3dError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise Uav3dError(f"{path}: is no JSON ({error})") from None
    if not isinstance(rows, list):
        raise Uav3dError(f"{path}: is a {type(rows).__name__}, must be a list of records")
    records = [_Record(f"{path}[{k}]", row) for k, row in enumerate(rows)]
    return {r.text("token"): r for r in records}
