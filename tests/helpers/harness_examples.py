"""Made frames and a made instrument that the harness's tests share: no network, no images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sortie.perception.evaluation.harness import FleetFrames
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.geometry import FULL, Geometry

CROSS = 20.0 * np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)], float)


@dataclass(frozen=True)
class MadeFrames:
    """As `contract.FleetFrames` describes them."""

    true_pose: NDArray[np.float64]
    est_pose: NDArray[np.float64]
    cars: NDArray[np.float64]
    scene: NDArray[np.int64]


@dataclass(frozen=True)
class SeenFrames(MadeFrames):
    """With what four cameras of each drone saw."""

    images: NDArray[np.uint8]


def with_images(made: MadeFrames, images: NDArray[np.uint8]) -> SeenFrames:
    """Made frames and their images [n, d, cameras, height, width]."""
    return SeenFrames(made.true_pose, made.est_pose, made.cars, made.scene, images)


def made_frames(scenes: Sequence[int], seed: int = 0, cars: int = 40) -> MadeFrames:
    """A cross of five over cars that stand apart, headings and pose errors drawn; the last car of each frame is missing."""
    n = len(scenes)
    rng = np.random.Generator(np.random.PCG64(seed))
    yaw = rng.uniform(-3, 3, (n, 1))
    c, s = np.cos(yaw), np.sin(yaw)
    xy = np.stack([c * CROSS[:, 0] - s * CROSS[:, 1], s * CROSS[:, 0] + c * CROSS[:, 1]], axis=2) + rng.uniform(
        -40, 40, (n, 1, 2)
    )
    true = np.concatenate([xy, np.broadcast_to(yaw[:, :, None], (n, 5, 1))], axis=2)
    table = rng.uniform((-90, -90, 3.8, 1.7, -3), (90, 90, 5, 2, 3), (n, cars, 5))
    table[:, -1] = np.nan
    return MadeFrames(true, true + rng.normal(0, (0.2, 0.2, 0.003), true.shape), table, np.array(scenes, np.int64))


@dataclass
class MadeInstrument:
    """Finds each car of the ego's square with a draw of its own, and the better the more cells it was sent.

    Boxes are in the ego's estimated frame, with near doubles and inventions among them; `looked` counts frames.
    """

    fingerprint: str = "made"
    geometry: Geometry = FULL
    looked: list[int] = field(default_factory=list)
    computed: int = 0

    def look(self, frames: FleetFrames, frame: int) -> MadeView:
        self.looked.append(frame)
        return MadeView(self, frames, frame)


@dataclass
class MadeView:
    instrument: MadeInstrument
    frames: FleetFrames
    frame: int

    def rank(self, by: str = "confidence") -> NDArray[np.float64]:
        seed = int(abs(self.frames.cars[self.frame, 0, 0]) * 1e6) + (by == "norm")
        return np.random.Generator(np.random.PCG64(seed)).random((5, 64, 64))

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[NDArray[np.float64]]:
        self.instrument.computed += len(exchanges)
        return [self._boxes(e, floor) for e in exchanges]

    def _boxes(self, e: Exchange, floor: float) -> NDArray[np.float64]:
        cars = self.frames.cars[self.frame]
        cars = cars[~np.isnan(cars[:, 0])]
        rng = np.random.Generator(np.random.PCG64([e.ego, int(abs(cars[0, 0]) * 1e6)]))
        x, y, yaw = self.frames.est_pose[self.frame, e.ego]
        n = len(cars)
        near = np.concatenate([np.arange(n), np.arange(0, n, 3)])
        dx, dy = cars[near, 0] - x, cars[near, 1] - y
        c, s = np.cos(yaw), np.sin(yaw)
        local = np.stack([c * dx + s * dy, c * dy - s * dx, cars[near, 2], cars[near, 3], cars[near, 4] - yaw], axis=1)
        local += rng.normal(0, 0.3, local.shape) * (1, 1, 0.2, 0.1, 0.1)
        wrong = rng.uniform((-90, -90, 4, 1.8, -3), (90, 90, 5, 2, 3), (10, 5))
        score = rng.random(len(near)) * (0.4 + 0.6 * e.sent.mean() if len(e.peers) else 0.4)
        boxes = np.concatenate(
            [np.concatenate([local, wrong]), np.concatenate([score, rng.random(10) * 0.5])[:, None]], axis=1
        )
        return boxes[boxes[:, 5] >= floor]
