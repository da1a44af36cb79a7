"""The torch detector's runs for a calibration: its boxes for every job of a moment, one npz file each, kept for reuse."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from research.calibrate.plan import (
    THRESHOLD,
    DetectorJob,
    Split,
    draw_scene,
    draw_target,
    moment,
    scene_model,
    scene_seed,
)
from sortie.perception.code_digest import boxes_digest
from sortie.perception.errors import InputError
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.replacing import replacing
from sortie.scenarios.schema import Perception

FLOOR = 0.02
"""The lowest score of a box that is kept."""


class Probe(TorchDetector):
    """The torch detector, run job by job under that job's settings; it also gives the ranks of its cells."""

    def __init__(self, scene: SceneModel, seed: int, weights: Path | None) -> None:
        super().__init__(scene, Perception(score_threshold=FLOOR), seed, weights)

    def detect_job(self, job: DetectorJob) -> Boxes:
        """Its boxes, best first; without weak ones where boxes are averaged, as they would move those that count."""
        least = FLOOR if job.join == "nms" else THRESHOLD
        if least != self._config.score_threshold:
            for known in self._kept.values():
                known.boxes = None
        self._config = Perception(score_threshold=least, unsent_cells=job.unsent, join=job.join)
        return self.detect([(job.ego, job.shares)])[0]

    def ranks(self, capture: Capture) -> NDArray[np.float32]:
        """What ranks its cells, [64, 64]: the logit of their confidence."""
        self._encode([capture])
        with torch.inference_mode():
            confidence: NDArray[np.float32] = F.max_pool2d(self._head_alone(capture).result()[:1], 2)[0].numpy()
        return confidence


@dataclass(frozen=True, slots=True)
class DetectorRuns:
    """One moment's runs.

    `jobs` and the `boxes` of each; `ranks` of every capture in them, [64, 64].
    """

    split: Split
    scene: int
    """Its index in the split."""
    jobs: list[DetectorJob]
    boxes: list[Boxes]
    ranks: dict[Capture, NDArray[np.float32]]


def captures_of(jobs: Sequence[DetectorJob]) -> list[Capture]:
    """Every capture in the jobs, once, in order."""
    return list(dict.fromkeys(c for job in jobs for c in (job.ego, *(s.capture for s in job.shares))))


def collect(folder: Path, seed: int, split: Split, scene: int, index: int, weights: Path | None, key: str) -> Path:
    """Run the detector for moment `index` of a scene and keep the results, unless they are there already.

    Args:
        key: names the weights; other weights, other jobs and other code have other files.
    """
    jobs = moment(seed, split, scene, index)
    setup = repr((boxes_digest(), jobs, draw_scene(seed, split, scene), draw_target(seed, split, scene)))
    digest = hashlib.blake2b(setup.encode(), digest_size=4).hexdigest()
    path = folder / f"{key}-{split}-{scene_seed(seed, split, scene)}-{index}-{digest}.npz"
    if path.exists():
        return path
    probe = Probe(scene_model(seed, split, scene), scene_seed(seed, split, scene), weights)
    boxes = [probe.detect_job(job) for job in jobs]
    joined = Boxes.join(boxes)
    arrays = {
        "of": np.array([seed, scene, index]),
        "count": np.array([len(b) for b in boxes]),
        "boxes": np.concatenate([joined.table().astype(np.float32), joined.score[:, None]], axis=1),
        "ranks": np.stack([probe.ranks(c) for c in captures_of(jobs)]),
    }
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return path


def read(path: Path, split: Split) -> DetectorRuns:
    """The runs in a file, with the jobs drawn again."""
    with np.load(path, allow_pickle=False) as file:
        seed, scene, index = (int(v) for v in file["of"])
        count, table, ranks = file["count"], file["boxes"], file["ranks"]
    jobs = moment(seed, split, scene, index)
    captures = captures_of(jobs)
    if len(jobs) != len(count) or len(captures) != len(ranks):
        raise InputError(f"{path}: holds {len(count)} results, the plan has {len(jobs)} jobs; remove it")
    parts = np.split(table, np.cumsum(count)[:-1])
    boxes = [Boxes(p[:, :2], p[:, 2:4], p[:, 4], p[:, 5]) for p in parts]
    return DetectorRuns(split, scene, jobs, boxes, dict(zip(captures, ranks, strict=True)))
