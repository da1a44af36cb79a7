"""UAV3D's format on made data: tables, pickles and images as its converter writes them, and broken ones."""

from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from research.uav3d.uav3d import (
    CAMERAS,
    UAVS,
    Uav3dError,
    boxes_enu,
    convert,
    read_image,
    read_infos,
    read_tables,
)
from sortie.perception.evaluation.recorded import frames_of
from sortie.perception.recordings.recording import open_recording

SCENES = ("scene_0001", "scene_0861")
STAMP = 1701498620885503488
ORIGIN = np.array([-68.5, -159.25, 60.0])
SLOTS = 20.0 * np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)])


def about_z(yaw: float) -> list[float]:
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def cars(k: int) -> list[tuple[list[float], list[float], float]]:
    """World place, size (w, l, h) and yaw of each car of sample k: near, off UAV 0's square but in UAV 1's, and too high."""
    x, y, _ = ORIGIN
    return [
        ([x + 10.0 + k, y + 5.0, 0.8], [1.9, 4.5, 1.5], 0.3),
        ([x + 110.0, y, 0.8], [2.0, 5.0, 1.6], -1.2),
        ([x, y + 8.0, 30.0], [2.0, 5.0, 1.6], 0.0),
    ]


def make(root: Path, samples: int = 2) -> Path:
    """Two scenes of `samples` samples each: `v1.0-trainval`, `uav3d_infos_val.pkl` and the first image."""
    from PIL import Image

    tables: dict[str, list[dict[str, Any]]] = {
        n: []
        for n in ("scene", "sample", "sample_data", "sensor", "calibrated_sensor", "sample_annotation", "ego_pose")
    }
    tables["sensor"] = [{"token": c, "channel": c, "modality": "camera"} for c in CAMERAS]
    infos = []
    for s, scene in enumerate(SCENES):
        tables["scene"].append({"token": f"s{s}", "name": scene, "nbr_samples": samples})
        for k in range(samples):
            token, stamp, place = f"{scene}-{k}", STAMP + 10**12 * s + k * 500_000_000, ORIGIN + np.array([k, 0, 0])
            ego = [place[0], place[1], 0]
            tables["sample"].append(
                {"token": token, "timestamp": stamp, "scene_token": f"s{s}", "prev": "", "next": ""}
            )
            cams = {}
            for c in CAMERAS:
                name, uav = f"sweeps/town03_row1/{c}/{stamp}.png", int(c[-1])
                at = (place + SLOTS[uav]).tolist()
                pose = {
                    "token": f"{token}{c}",
                    "sensor_token": c,
                    "translation": at,
                    "rotation": about_z(0.5),
                    "camera_intrinsic": np.eye(3).tolist(),
                }
                tables["calibrated_sensor"].append(pose)
                tables["sample_data"].append(
                    {
                        "token": f"d{token}{c}",
                        "sample_token": token,
                        "calibrated_sensor_token": pose["token"],
                        "filename": name,
                        "fileformat": ".png",
                        "is_key_frame": True,
                        "height": 450,
                        "width": 800,
                        "timestamp": stamp,
                    }
                )
                cams[c] = {
                    "data_path": name,
                    "type": c,
                    "sample_data_token": f"d{token}{c}",
                    "sensor2ego_translation": [a - b for a, b in zip(at, ego, strict=True)],
                    "sensor2ego_rotation": about_z(0.5),
                    "ego2global_translation": ego,
                    "ego2global_rotation": [1.0, 0, 0, 0],
                    "timestamp": stamp,
                    "cam_intrinsic": np.eye(3),
                    "sensor2lidar_rotation": np.eye(3),
                    "sensor2lidar_translation": np.zeros(3),
                }
            rows = []
            for i, (where, size, yaw) in enumerate(cars(k)):
                tables["sample_annotation"].append(
                    {
                        "token": f"a{token}{i}",
                        "sample_token": token,
                        "instance_token": "i",
                        "translation": where,
                        "size": size,
                        "rotation": about_z(yaw),
                        "num_lidar_pts": -1,
                        "num_radar_pts": -1,
                    }
                )
                own = np.array(where) - ego
                if abs(own[0]) < 102.4 and abs(own[1]) < 102.4 and abs(own[2]) < 10:
                    rows.append([*own, *size, -yaw - np.pi / 2])
            boxes = np.array(rows).reshape(-1, 7)
            n = len(boxes)
            infos.append(
                {
                    "lidar_path": "",
                    "token": token,
                    "sweeps": [],
                    "cams": cams,
                    "lidar2ego_translation": [0.0, 0, 0],
                    "lidar2ego_rotation": [1.0, 0, 0, 0],
                    "ego2global_translation": ego,
                    "ego2global_rotation": [1.0, 0, 0, 0],
                    "timestamp": stamp,
                    "gt_boxes": boxes,
                    "gt_names": np.array(["car"] * n),
                    "gt_velocity": np.full((n, 2), np.nan),
                    "num_lidar_pts": np.full(n, -1),
                    "num_radar_pts": np.full(n, -1),
                    "valid_flag": np.full(n, True),
                    "location": "Atlanta",
                }
            )
    folder = root / "v1.0-trainval"
    folder.mkdir(parents=True)
    for name, rows_of in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows_of))
    infos = infos[::-1]  # the pickle's order is not the scenes'
    (root / "uav3d_infos_val.pkl").write_bytes(
        pickle.dumps({"infos": infos, "metadata": {"version": "v1.0-trainval"}}, 2)
    )
    first = root / infos[-1]["cams"][CAMERAS[0]]["data_path"]
    first.parent.mkdir(parents=True)
    Image.fromarray(np.arange(9 * 16 * 3, dtype=np.uint8).reshape(9, 16, 3)).save(first)
    return root


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("uav3d"))


def test_pickle_tables_and_images_say_the_same(data: Path) -> None:
    samples, tables = read_infos(data / "uav3d_infos_val.pkl"), read_tables(data / "v1.0-trainval")
    assert len(samples) == 4
    assert sorted({tables.scene_of[s.token] for s in samples}) == list(SCENES)
    for sample in samples:
        assert tuple(sample.cameras) == CAMERAS
        for name, camera in sample.cameras.items():
            there = tables.cameras[sample.token][name]
            np.testing.assert_allclose(camera.position_m, there.position_m, atol=1e-9)
            assert (camera.file, camera.rotation_wxyz) == (there.file, there.rotation_wxyz)
        k = int(sample.token[-1])
        for uav in range(UAVS):
            np.testing.assert_allclose(sample.uav_m(uav), ORIGIN + np.array([k, 0, 0]) + SLOTS[uav], atol=1e-9)
        assert len(sample.boxes) == 1
    first = next(s for s in samples if s.token == "scene_0001-0")
    image = read_image(data, first.cameras[CAMERAS[0]])
    assert (image.shape, image.dtype) == ((9, 16, 3), np.uint8)
    with pytest.raises(Uav3dError, match=r"CAMERA_BACK_id_0/\d+\.png: cannot be read as an image \(No such file"):
        read_image(data, first.cameras["CAMERA_BACK_id_0"])


def test_a_split_becomes_a_recording(data: Path, tmp_path: Path) -> None:
    """Scenes in order, seconds from their begin, UAVs and cars mirrored into ENU; every annotation, not UAV 0's alone."""
    rec = open_recording(convert(data, "val", tmp_path / "val.npz"))
    assert (rec.t_s.tolist(), rec.scene.tolist(), rec.drones) == ([0.0, 0.5] * 2, [0, 0, 1, 1], 5)
    np.testing.assert_allclose(rec.pose[1, :, 0], ORIGIN[0] + 1 + SLOTS[:, 0])
    np.testing.assert_allclose(rec.pose[1, :, 1], -ORIGIN[1] - SLOTS[:, 1])
    assert not rec.pose[..., 2].any()
    x, y, _ = ORIGIN
    expected = [(x + 11, -y - 5, 4.5, 1.9, -0.3), (x + 110, -y, 5.0, 2.0, 1.2)]
    np.testing.assert_allclose(rec.truth(1), expected)
    assert len(frames_of(rec).cars) == 4


def test_boxes_of_a_pickle_lie_where_the_annotations_do(data: Path, tmp_path: Path) -> None:
    """Two ways to the same car: (w, l, h, −yaw − π/2) about UAV 0, and the annotation in the world."""
    samples = {s.token: s for s in read_infos(data / "uav3d_infos_val.pkl")}

    def perfect(token: str, uav: int) -> np.ndarray:
        own = boxes_enu(samples[token].boxes, np.ones(1))
        step = np.subtract(samples[token].uav_m(0), samples[token].uav_m(uav))
        own[:, :2] += step[0], -step[1]
        return own

    rec = open_recording(convert(data, "val", tmp_path / "val.npz", boxes=perfect))
    for f in range(len(rec)):
        for uav in range(UAVS):
            own = rec.boxes(f, uav)[0]
            place = np.append(own[:2] + rec.pose[f, uav, :2], own[2:4])
            np.testing.assert_allclose(place, rec.truth(f)[0, :4], atol=1e-9)
            assert abs(math.remainder(own[4] - rec.truth(f)[0, 4], math.pi)) < 1e-9


def spoil_info(root: Path, change: Any) -> Path:
    path = root / "uav3d_infos_val.pkl"
    data = pickle.loads(path.read_bytes())  # noqa: S301 (our own)
    change(data)
    path.write_bytes(pickle.dumps(data))
    return root


def spoil_table(root: Path, name: str, change: Any) -> Path:
    path = root / "v1.0-trainval" / f"{name}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))
    return root


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("infos"), "uav3d_infos_val.pkl: infos is missing, must be a list in a dict of infos and metadata"),
        (lambda d: d["infos"][1].pop("gt_boxes"), "uav3d_infos_val.pkl: infos[1].gt_boxes is missing"),
        (lambda d: d["infos"][0]["cams"].pop("CAMERA_LEFT_id_3"), "infos[0].cams.CAMERA_LEFT_id_3 is missing"),
        (lambda d: d["infos"][0].update(gt_boxes=np.zeros((2, 9))), "infos[0].gt_boxes has shape [2, 9], must be [any, 7]"),
        (lambda d: d["infos"][0].update(gt_boxes=np.zeros((2, 7))), "infos[0].gt_boxes row 0 has a size ≤ 0, must be above 0 m"),
        (lambda d: d["infos"][0].update(gt_boxes=np.full((1, 7), np.nan)), "infos[0].gt_boxes is not finite, must be finite everywhere"),
        (lambda d: d["infos"][0].update(timestamp="noon"), "infos[0].timestamp is 'noon', must be a whole number"),
        (lambda d: d["infos"][0].update(token="other"), "sample 'other' of split val is not in v1.0-trainval/sample.json"),
        (lambda d: d["infos"][0].update(ego2global_translation=[0, 1]), "infos[0].ego2global_translation has shape [2], must be [3]"),
        (lambda d: d.update(metadata=Path), "uav3d_infos_val.pkl: global pathlib"),
    ],
)  # fmt: skip
def test_a_broken_pickle_is_told(change: Any, message: str, tmp_path: Path) -> None:
    root = spoil_info(make(tmp_path, 1), change)
    with pytest.raises(Uav3dError) as error:
        convert(root, "val", tmp_path / "out.npz")
    assert message in str(error.value)
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("sample", lambda r: r[0].pop("scene_token"), "sample.json[0].scene_token is missing"),
        ("sample", lambda r: r[0].update(scene_token="x"), "sample.json[0] points to scene 'x', must be in scene.json"),
        ("sample_annotation", lambda r: r[1].update(size=[1, 0, 1]), "sample_annotation.json[1].size is (1.0, 0.0, 1.0), must be above 0 m"),
        ("sample_annotation", lambda r: r[1].update(rotation=[1, 0, 0]), "sample_annotation.json[1].rotation has shape [3], must be [4]"),
        ("calibrated_sensor", lambda r: r.clear(), "must be in calibrated_sensor.json"),
    ],
)  # fmt: skip
def test_a_broken_table_is_told(name: str, change: Any, message: str, tmp_path: Path) -> None:
    root = spoil_table(make(tmp_path, 1), name, change)
    with pytest.raises(Uav3dError) as error:
        convert(root, "val", tmp_path / "out.npz")
    assert message in str(error.value)


def test_missing_files_are_told(data: Path, tmp_path: Path) -> None:
    with pytest.raises(Uav3dError, match=r"uav3d_infos_train\.pkl: No such file or directory"):
        convert(data, "train", tmp_path / "out.npz")
    with pytest.raises(Uav3dError, match=r"scene\.json: No such file or directory"):
        convert(data, "val", tmp_path / "out.npz", version="v1.0-mini")
    (tmp_path / "scene.json").write_text("{]")
    with pytest.raises(Uav3dError, match=r"scene\.json: is no JSON"):
        read_tables(tmp_path)
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(Uav3dError, match=r"scene\.json: is a dict, must be a list of records"):
        read_tables(tmp_path)
