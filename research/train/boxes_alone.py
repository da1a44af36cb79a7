"""The boxes of drones alone on the benchmark's frames, and their errors."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from research.benchmark.dataset import Frames
from research.train.box_errors import Moment, errors_of
from sortie.perception.joining import Pose
from sortie.perception.network.decode import placed_boxes
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.perception.types import Boxes


def boxes_alone(net: CarNet, frames: Frames, threshold: float) -> list[list[Boxes]]:
    """What each drone of each frame finds by its own images, in the world by its estimated pose, best first."""
    net, geometry, out = folded(net), net.config.geometry, []
    with torch.inference_mode():
        for images, poses in zip(frames.images, frames.est_pose, strict=True):
            heads = net.head(net.spread(net.encoder(torch.from_numpy(images))))
            out.append(
                [placed_boxes(h, _pose(p), threshold, geometry) for h, p in zip(heads, poses.tolist(), strict=True)]
            )
    return out


def moments_of(frames: Frames, boxes: Sequence[Sequence[Boxes]]) -> list[Moment]:
    """The localisation errors of those boxes, frame by frame and drone by drone."""
    return [
        [errors_of(one, _pose(pose), cars) for one, pose in zip(several, poses.tolist(), strict=True)]
        for several, poses, cars in zip(boxes, frames.est_pose, frames.cars, strict=True)
    ]


def _pose(values: Sequence[float]) -> Pose:
    x, y, yaw = values
    return x, y, yaw
