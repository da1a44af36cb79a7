"""Made scores for the paper's table: APs that a test writes down, and draws around them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from research.paper.measures import Region
from research.paper.verdict import MeasuredValue
from research.paper.ways import Sharing
from sortie.perception.evaluation.sharing import Exchange, Floats
from sortie.perception.geometry import CELLS, FULL

DRAWS = 400


@dataclass(frozen=True)
class Made:
    """Scores by label (`best-2@0.02`) and region; what is not written down is `default(condition, region)`."""

    known: Mapping[tuple[str, str], float]
    default: Callable[[Sharing, str], float] = lambda condition, region: 0.3
    noise: float = 0.005
    bytes_of: Callable[[Sharing], float] = lambda condition: 1e6 * condition.received_budget

    def ap(self, condition: Sharing, region: Region) -> float:
        return self.known.get((condition.label, region), self.default(condition, region))

    def draws(self, condition: Sharing, region: Region) -> NDArray[np.float64]:
        return self.ap(condition, region) + self.noise * self._rng(condition, region).standard_normal(DRAWS)

    def halves(self, condition: Sharing, region: Region, *, resampled: bool) -> NDArray[np.float64]:
        wide = 2.0 * self.noise if resampled else self.noise
        return self.ap(condition, region) + wide * self._rng(condition, region).standard_normal((DRAWS, 2))

    def fleet_frame_bytes(self, condition: Sharing) -> Sequence[float]:
        return [self.bytes_of(condition)] * 3

    def _rng(self, condition: Sharing, region: str) -> np.random.Generator:
        return np.random.default_rng(zlib.crc32(f"{replace(condition, unsent='zero').label}/{region}".encode()))


def papers_world(condition: Sharing, region: str) -> float:
    """APs as the paper prints them, the rest filled in by its sentences."""
    if region == "mission":
        special = {
            "best-2@0.02": 0.787,
            "worst-2@0.02": 0.728,
            "all-4@0.05": 0.773,
            "all-4@0.1": 0.784,
            "best-2@0.05": 0.742,
        }
        return special.get(condition.label, 0.763 if condition.label == "all-4@1" else 0.72)
    curve = {0.0: 0.185, 0.01: 0.131, 0.02: 0.180, 0.05: 0.293, 0.1: 0.351, 0.25: 0.361, 1.0: 0.371}
    two = {0.02: 0.257, 0.05: 0.307, 0.1: 0.311, 0.25: 0.313}
    return curve[condition.received_budget] if condition.rule in ("all", "none") else two[condition.received_budget]


ELSEWHERE = {
    "descriptor_bytes": MeasuredValue(180.0),
    "policy_ms_p50": MeasuredValue(0.08, note="a machine"),
    "x86_policy_ms_p50": MeasuredValue(0.08, note="a machine"),
}
FACTS = {
    "command": "python -m research paper", "frames": 3, "scenes": 3, "seed": 0, "weights": "made", "fingerprint": "0123456789abcdef",
    "cells_by": "confidence", "tau": 0.1, "draws": DRAWS, "version": "0", "cpu_s": 1.0, "machine": "a machine",
}  # fmt: skip


@dataclass
class MadeFrames:
    """Five drones in a cross, some cars, no images."""

    true_pose: Floats
    est_pose: Floats
    cars: Floats
    scene: NDArray[np.int64]


def made_frames(n: int) -> MadeFrames:
    """n frames with a car near the fleet, one at a distance and one out of everyone's range."""
    rng = np.random.default_rng(1)
    pose = np.tile([(0, 0, 0.3), (20, 0, 0.2), (0, 20, 0.4), (-20, 0, 1.9), (0, -20, -3.0)], (n, 1, 1)).astype(float)
    cars = np.tile(
        [(10, 5, 4.5, 1.8, 0.5), (60, -40, 4.5, 1.8, 1.5), (300, 0, 4.5, 1.8, 0.0), (np.nan,) * 5], (n, 1, 1)
    )
    cars[:, :2, :2] += rng.normal(0, 1.0, (n, 2, 2))
    return MadeFrames(pose, pose + rng.normal(0, 0.1, pose.shape), cars, 7 + np.arange(n))


@dataclass
class MadeView:
    """Ranks cells by their index. Finds both cars, the surer the more cells came, less sure by zeros of peers, and a false one."""

    cars: Floats
    pose: Floats

    def rank(self, by: str = "confidence") -> NDArray[np.floating]:
        return np.tile(-np.arange(CELLS * CELLS, dtype=float).reshape(1, CELLS, CELLS), (5, 1, 1))

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        out = []
        for e in exchanges:
            rng = np.random.default_rng([e.ego, int(self.cars[0, 0] * 1e6) & 0xFFFF])
            sure = 0.3 + 0.5 * e.sent.sum() / (4 * CELLS * CELLS)
            sure -= 0.04 * len(e.peers) if e.unsent == "zero" and not e.sent.all() else 0.0
            x, y, yaw = self.pose[e.ego]
            turn = np.exp(-1j * yaw) * (self.cars[:2, 0] - x + 1j * (self.cars[:2, 1] - y))
            boxes = [(t.real, t.imag, 4.5, 1.8, c - yaw) for t, c in zip(turn, self.cars[:2, 4], strict=True)]
            boxes.append((-50.0, 0.0, 4.5, 1.8, 0.0))
            scores = np.clip(np.array((sure, sure - 0.2, 0.25)) + rng.normal(0, 0.05, 3), 0, 1)
            out.append(np.array([(*b, s) for b, s in zip(boxes, scores, strict=True) if s >= floor]).reshape(-1, 6))
        return out


class MadeInstrument:
    """Looks at made frames; no network."""

    fingerprint, geometry = "made", FULL

    def look(self, frames: MadeFrames, frame: int) -> MadeView:
        return MadeView(frames.cars[frame], frames.est_pose[frame])
