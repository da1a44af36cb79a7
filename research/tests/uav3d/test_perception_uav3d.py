"""UAV3D's format on made data: tables, pickles and images as its converter writes them, and broken ones."""

from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from uav3d_examples import ORIGIN, SCENES, SLOTS, make

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
