"""The detector as a sortie uses it: render when asked, encode once, fuse what was delivered, find the cars.

A capture costs nothing until a job needs it. Features, confidences and single-drone boxes of a capture are
kept for the latest 64 captures, so a frame that is shared to four peers is rendered and encoded once. Every
network call has the same shapes whatever else is asked for, so the same capture gives the same numbers.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from perception import budget
from perception.ap import suppress
from perception.bev import lift
from perception.checkpoint import load_weights
from perception.decode import decode
from perception.fusion.base import takes_part
from perception.geometry import CELLS, FULL
from perception.model import folded
from perception.render import Renderer
from perception.scene import SceneModel
from perception.town import Bytes
from perception.types import Boxes, Capture, Share
from perception.warp import warp
from scenarios.schema import Perception

SHIPPED_WEIGHTS = Path(__file__).parent / "weights" / "disconet.safetensors"
NMS_IOU = 0.15
KEPT_CAPTURES = 64
MAPS, LATE = ("features", "raw"), ("detections", "tracks")
R = TypeVar("R")

__all__ = ["SHIPPED_WEIGHTS", "Boxes", "Capture", "Share", "TorchDetector", "ground_truth"]


def ground_truth(
    scene: SceneModel,
    t_s: float,
    centre_xy: tuple[float, float],
    half_extent: float = FULL.half_extent_m,
    yaw_rad: float = 0.0,
) -> Boxes:
    """The cars at `t_s` whose centres lie in the square about `centre_xy` (ENU, m) that is turned by `yaw_rad`.

    Every such car counts, also one that no drone could see. Scores are 1.
    """
    cars = scene.cars_at(t_s)
    dx, dy = cars.x_m - centre_xy[0], cars.y_m - centre_xy[1]
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    cars = cars.where((np.abs(c * dx + s * dy) < half_extent) & (np.abs(c * dy - s * dx) < half_extent))
    columns = (
        np.stack([cars.x_m, cars.y_m], 1),
        np.stack([cars.length_m, cars.width_m], 1),
        cars.yaw_rad,
        np.ones(len(cars)),
    )
    return Boxes(*(column.astype(np.float32) for column in columns))


@dataclass(slots=True)
class _Encoded:
    """What is known of one capture: its features [80, 64, 64], and, when asked for, what it finds alone."""

    features: Tensor
    out: Tensor | None = None
    boxes: Boxes | None = None


class TorchDetector:
    """The network over one scene.

    Args:
        scene: what there is to see.
        config: the scenario's `perception` section.
        seed: the sortie's seed (sensor noise follows from it).
        weights: a safetensors file; None takes the shipped one.

    Raises:
        ValueError: weights that are missing or do not fit, naming file and tensor.

    One capture's rendering and encoding, and one ego's fusion, are tasks of one thread each; as many run side by
    side as torch has threads when the detector is made (`torch.set_num_threads`). The numbers do not depend on it.
    """

    def __init__(self, scene: SceneModel, config: Perception, seed: int, weights: Path | None = None) -> None:
        self._scene, self._config = scene, config
        path = SHIPPED_WEIGHTS if weights is None else weights
        net = load_weights(path)
        if net.config.geometry != FULL:
            raise ValueError(
                f"{path}: made for ±{net.config.half_extent_m:g} m, a sortie flies ±{FULL.half_extent_m:g} m"
            )
        self._net = folded(net)
        self._renderer = Renderer(scene, seed)
        self._kept: OrderedDict[Capture, _Encoded] = OrderedDict()
        self._pool = ThreadPoolExecutor(
            torch.get_num_threads(), "detector", initializer=torch.set_num_threads, initargs=(1,)
        )

    def detect(self, jobs: Sequence[tuple[Capture, Sequence[Share]]]) -> list[Boxes]:
        """Each ego's boxes from its own features and what it was sent, ENU, best first.

        A late share is used as it is: the sender's pose at its capture places it, what has moved since lags.
        """
        self._encode([c for ego, shares in jobs for c in (ego, *(s.capture for s in shares))])
        shared = [s for _, shares in jobs for s in shares]
        alone = [s.capture for s in shared if s.representation in LATE]
        alone += [ego for ego, shares in jobs if not any(s.representation in MAPS for s in shares)]
        self._each(self._look_alone, dict.fromkeys(alone))
        self._each(self._head_alone, dict.fromkeys(s.capture for s in shared if self._must_rank(s)))
        return self._each(lambda job: self._fuse(*job), jobs)

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The cars inside the ego's square at `t_s`: `ground_truth` about its true position and heading at capture."""
        return ground_truth(self._scene, t_s, ego.position_m[:2], FULL.half_extent_m, ego.true_yaw_rad)

    def count_boxes(self, capture: Capture, roi: tuple[float, float, float] | None) -> int:
        """How many detections the drone would send for this capture (it renders and encodes: tens of milliseconds)."""
        self._encode([capture])
        self._each(self._look_alone, [capture])
        return len(self._alone(capture).inside(roi))

    def camera_views(self, capture: Capture) -> Bytes:
        """The five camera images, uint8 [5, 90, 160, 3]: front, left, right, back, nadir."""
        views: Bytes = self._renderer.render([capture])[0]
        return views

    def _each(self, do: Callable[[Any], R], over: Iterable[Any]) -> list[R]:
        """Run a task over its arguments side by side, each in one thread; results in order."""

        def task(what: Any) -> R:
            with torch.inference_mode():
                return do(what)

        return list(self._pool.map(task, over))

    def _encode(self, captures: Iterable[Capture]) -> None:
        """Render and encode what is not kept yet; then drop the oldest beyond the limit."""
        wanted = list(dict.fromkeys(captures))
        missing = [c for c in wanted if c not in self._kept]
        views = self._renderer.render(missing, self._pool.map)

        def one(i: int) -> Tensor:
            features: Tensor = self._net.encoder(lift(views[i : i + 1], missing[i : i + 1]))[0]
            return features

        for capture, features in zip(missing, self._each(one, range(len(missing))), strict=True):
            self._kept[capture] = _Encoded(features)
        for capture in wanted:
            self._kept.move_to_end(capture)
        while len(self._kept) > max(KEPT_CAPTURES, len(wanted)):
            self._kept.popitem(last=False)

    def _must_rank(self, share: Share) -> bool:
        """Whether the sender's own head is needed to say which cells it sent."""
        if share.representation != "features" or self._config.cells_by != "confidence":
            return False
        return budget.must_choose(share.rho, share.roi, *share.capture.est_pose)

    def _head_alone(self, capture: Capture) -> Tensor:
        """The head's output [7, 128, 128] without peers, worked out once."""
        kept = self._kept[capture]
        if kept.out is None:
            kept.out = self._net.head(kept.features[None])[0]
        return kept.out

    def _look_alone(self, capture: Capture) -> None:
        """Work out what the capture shows without peers, once."""
        kept = self._kept[capture]
        if kept.boxes is None:
            kept.boxes = self._place(self._head_alone(capture), capture)

    def _alone(self, capture: Capture) -> Boxes:
        boxes = self._kept[capture].boxes
        assert boxes is not None  # noqa: S101 (looked at before)
        return boxes

    def _place(self, out: Tensor, capture: Capture) -> Boxes:
        local = decode(out, self._config.score_threshold).numpy()
        return suppress(Boxes.placed(local, capture.est_pose), NMS_IOU)

    def _sent(self, share: Share) -> Tensor:
        """[1, 64, 64] bool: the cells of the share's capture that its budget let through."""
        if share.representation == "raw":
            return torch.ones(1, CELLS, CELLS, dtype=torch.bool)
        kept = self._kept[share.capture]
        if not budget.must_choose(share.rho, share.roi, *share.capture.est_pose):
            rank = np.zeros((CELLS, CELLS))
        elif self._config.cells_by == "norm":
            rank = kept.features.norm(dim=0).numpy()
        else:
            rank = F.max_pool2d(self._head_alone(share.capture)[:1], 2)[0].numpy()
        return torch.from_numpy(budget.select(rank, share.rho, share.roi, *share.capture.est_pose))[None]

    def _fuse(self, ego: Capture, shares: Sequence[Share]) -> Boxes:
        maps = [s for s in shares if s.representation in MAPS]
        if not maps:
            own = self._alone(ego)
        else:
            features = torch.stack([self._kept[s.capture].features for s in maps])
            # relative to the ego, so that float32 keeps millimetres kilometres from the origin
            x, y, yaw = ego.est_pose
            poses = [(s.capture.est_pose[0] - x, s.capture.est_pose[1] - y, s.capture.est_pose[2]) for s in maps]
            sent = torch.stack([self._sent(s) for s in maps])
            here = torch.tensor((0.0, 0.0, yaw))
            warped, arrived, inside = warp(features, sent, here, torch.tensor(poses), FULL.cell_m)
            weight = torch.tensor([[s.weight for s in maps]])
            part = takes_part(arrived[None, :, 0], inside[None, :, 0], weight, self._config.unsent_cells)
            agents = torch.cat([self._kept[ego].features[None], warped])[None]
            fused = self._net.fusion(agents, part, F.pad(weight, (1, 0), value=1.0))
            own = self._place(self._net.head(fused)[0], ego)
        late = [self._sent_boxes(s) for s in shares if s.representation in LATE]
        return suppress(Boxes.join([own, *late]), NMS_IOU) if late else own

    def _sent_boxes(self, share: Share) -> Boxes:
        boxes = self._alone(share.capture).inside(share.roi)
        if share.representation == "tracks":
            boxes = boxes.take(np.arange(min(len(boxes), budget.MAX_TRACKS)))  # they are best first
        if share.weight <= 0.0:
            return Boxes.empty()
        return boxes
