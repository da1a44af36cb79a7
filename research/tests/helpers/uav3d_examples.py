"""UAV3D's format on made data: tables, pickles and images as its converter writes them."""

from __future__ import annotations

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from research.uav3d.uav3d import CAMERAS

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
