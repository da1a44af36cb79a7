"""The torch detector of a sortie: it renders on demand, encodes once, fuses what was delivered, and detects the cars.

A capture costs nothing until a job needs it. Features, confidences and single-drone boxes of a capture are
kept for the latest 64 captures, so a frame that is shared to four peers is rendered and encoded once. Every
network call has the same shapes whatever else is computed, so the same pictures give the same boxes. Pictures of a
capture depend slightly on which captures are rendered in the same call or were rendered before (perception/README.md).
The same calls in the same order give the same boxes.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception import budget
from sortie.perception.errors import InputError
from sortie.perception.geometry import CELLS, FULL
from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import EgoSources, Pose, SourceBoxes, boxes_at_fusion, joined_many, sendable, source_of
from sortie.perception.lateness import weighed
from sortie.perception.network.bev import lift
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.codebook import Codebook, load_codebook
from sortie.perception.network.decode import placed_boxes
from sortie.perception.network.fused import Peer, fused_map
from sortie.perception.network.fusion.base import Shares
from sortie.perception.network.fusion.own import OwnFusion
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.perception.network.inference import folded
from sortie.perception.network.memory import keep_freed
from sortie.perception.pose_matching import matched_poses, sure
from sortie.perception.scene.render import Renderer, views_shape
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Bytes
from sortie.perception.types import Boxes, Capture, Share
from sortie.perception.uncertainty import BoxErrors, load_errors
from sortie.scenarios.disc import Disc
from sortie.scenarios.representation import CELL_NAMES
from sortie.scenarios.schema import Perception
from sortie.scenarios.shipped import CODEBOOK, ERRORS, NETWORKS, SHIPPED_WEIGHTS, beside, located

KEPT_CAPTURES = 64
ALL_CELLS = torch.ones(1, CELLS, CELLS, dtype=torch.bool)
Jobs = Sequence[tuple[Capture, Sequence[Share]]]
R = TypeVar("R")

__all__ = ["SHIPPED_WEIGHTS", "Boxes", "Capture", "Share", "TorchDetector", "named_weights", "shipped"]


def shipped(fusion: str) -> Path:
    """The weights that a fusion flies with when the scenario names none: the default network's unless others are shipped for it."""
    others = fusion in FUSIONS and FUSIONS[fusion].shares == "features" and fusion != "disconet"
    return NETWORKS / f"{fusion}.safetensors" if others else SHIPPED_WEIGHTS


def named_weights(weights: Path | None) -> Path:
    """The file of a network: the default one for None; a shipped one may be named without its folder.

    Example:
        >>> named_weights(None).name, named_weights(Path("fine.safetensors")).parent == NETWORKS
        ('fine.safetensors', True)
    """
    return SHIPPED_WEIGHTS if weights is None else located(weights)


Part = tuple[float, Disc | None, tuple[int, ...], bool]
"""Which cells a share holds: ρ, region and ranks that are missing, and whether they are codes."""


@dataclass(slots=True)
class _Encoded:
    """The results for one capture, computed or under way: its features [80, 64, 64], and on demand its boxes without peers."""

    features: Future[Tensor]
    maps: Future[Tensor]
    """The features as they are fused (`CarNet.spread`)."""
    out: Future[Tensor] | None = None
    """The head's output [planes, 128, 128] without peers."""
    boxes: Future[Boxes] | None = None
    in_part: dict[Part, Future[Tensor]] = field(default_factory=dict)
    """The head's output from the cells that a budget lets through alone, for late fusion of shared maps."""
    coded: dict[Part, Future[Tensor]] = field(default_factory=dict)
    """The features as receivers read them from the codes of those cells, as they are fused."""


Known = Mapping[Capture, _Encoded]


class TorchDetector:
    """The network over one scene.

    Args:
        scene: what there is to see.
        config: the scenario's `perception` section.
        seed, replication: the sortie's (sensor noise follows from them).
        weights: a safetensors file; None takes the one shipped for `perception.fusion`.

    Raises:
        InputError: weights that are missing or do not fit, naming file and tensor, or that learned another fusion.

    One capture's rendering and encoding, and one ego's fusion, are tasks of one thread each; as many run side by
    side as torch has threads when the detector is made (`torch.set_num_threads`). Tasks begin in the order in which they
    are handed in, and what a task waits for is settled, and handed in, before it is. The numbers do not depend on it.
    """

    name = "torch"
    """As `perception.detector` names it."""

    def __init__(
        self, scene: SceneModel, config: Perception, seed: int, weights: Path | None = None, replication: int = 0
    ) -> None:
        self._scene, self._config = scene, config
        own = None if config.fusion in FUSIONS else OwnFusion(config.fusion, config.fusion_params)
        self._shares: Shares = "features" if own else FUSIONS[config.fusion].shares
        path = shipped(config.fusion) if weights is None else named_weights(weights)
        net = load_weights(path, own)
        if own is None and self._shares == "features" and net.config.fusion != config.fusion:
            raise InputError(
                f"{path}: made for fusion {net.config.fusion!r}, perception.fusion is {config.fusion!r}, must be the same"
            )
        if net.config.half_extent_m != FULL.half_extent_m:
            raise InputError(
                f"{path}: made for ±{net.config.half_extent_m:g} m, a sortie flies ±{FULL.half_extent_m:g} m"
            )
        keep_freed()
        self._weights, self._loaded = path, net
        self._net = folded(net)
        self._renderer = Renderer(scene, seed, replication)
        self._kept: OrderedDict[Capture, _Encoded] = OrderedDict()
        self.kept_captures = KEPT_CAPTURES
        """Encoded captures that are kept: 1.5 MB each or so, and 5 MB of a fine network."""
        self._pool = ThreadPoolExecutor(
            torch.get_num_threads(), "detector", initializer=torch.set_num_threads, initargs=(1,)
        )

    def detect(self, jobs: Jobs) -> list[Boxes]:
        """Each ego's boxes from its own features and the shares it received, ENU, best first.

        A late share's map lies where its sender was at the capture, both poses being known: what has moved since
        lags, what stands still fits. Without `motion_compensation` it lies where its sender is now, if that is among
        the egos. Boxes travel in world coordinates and need none.
        """
        return self.begin(jobs)()

    def begin(self, jobs: Jobs) -> Callable[[], list[Boxes]]:
        """Render what the jobs need and compute the rest in the background; calling the result waits for the boxes."""
        if self._shares == "nothing":
            jobs = [(ego, ()) for ego, _ in jobs]
        elif self._shares == "features":
            jobs = [(ego, weighed(ego, shares)) for ego, shares in jobs]
        seen = [c for ego, shares in jobs for c in (ego, *(s.capture for s in shares if s.is_map or s.is_detected))]
        known = self._encode([c for c in seen if c.looked])
        shared = [s for _, shares in jobs for s in shares if s.weight > 0.0]
        match = self._config.match_poses
        look = {s.capture for s in shared if s.is_detected or (match and self._is_fused(s))}
        alone = [e for e, shares in jobs if match or not any(self._is_fused(s) and s.weight > 0.0 for s in shares)]
        look |= {ego for ego in alone if ego.looked}
        for capture in dict.fromkeys([*look, *(s.capture for s in shared if _must_rank(s))]):
            if capture in look:
                self._look_alone(capture)
            else:
                self._head_alone(capture)
        for share in shared:
            if share.representation == "codes":
                self._read_codes(share, known)
        for share in shared:
            if share.is_map and self._shares == "boxes":
                self._head_in_part(share, known)
        now = {ego.drone: ego for ego, _ in jobs}
        # a copy: later requests queue behind these tasks, and no task may wait for them
        known = {capture: replace(kept) for capture, kept in known.items()}
        detected = [self._task(self._detect_ego, ego, shares, now, known) for ego, shares in jobs]
        return lambda: [f.result() for f in detected]

    def truth(self, t_s: float, ego: Capture) -> Boxes:
        """The cars inside the ego's square at `t_s`, about its true position and heading at capture."""
        cars = self._scene.cars_at(t_s)
        return ground_truth(cars.table(), ego.true_pose, identity=cars.ids).single()

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """The number of detections that the drone would send (renders and encodes: tens of milliseconds)."""
        self._encode([capture])
        return len(self._sendable(self._look_alone(capture).result()).inside(roi))

    def camera_views(self, capture: Capture) -> Bytes:
        """The five camera images, uint8 [5, height, width, 3]: front, left, right, back, nadir."""
        views: Bytes = self._renderer.render([capture])[0]
        return views

    def _task(self, do: Callable[..., R], *what: Any) -> Future[R]:
        """Run it in one thread of the pool."""

        def task() -> R:
            with torch.inference_mode():
                return do(*what)

        return self._pool.submit(task)

    def _encode(self, captures: Iterable[Capture]) -> Known:
        """Render what is not kept yet, encode it in the background, and drop the oldest beyond the limit."""
        wanted = list(dict.fromkeys(captures))
        missing = [c for c in wanted if c not in self._kept]
        views = [np.empty(views_shape(c.cameras), np.uint8) for c in missing]
        encoded: dict[Capture, _Encoded] = {}

        def encode(i: int, seen: Future[None]) -> Tensor:
            seen.result()
            image = lift(views[i : i + 1], missing[i : i + 1], self._net.config.geometry)
            with self._autocast():
                features: Tensor = self._net.encoder(image)[0]
            return features

        def side_by_side(see: Callable[[int], None], over: Iterable[int]) -> list[None]:
            """Render, and encode what is rendered while the last views are on their way."""
            sights = {i: self._task(see, i) for i in over}
            for i, seen in sights.items():
                features = self._task(encode, i, seen)
                encoded[missing[i]] = _Encoded(features, self._spread(features))
            try:
                return [seen.result() for seen in sights.values()]
            finally:  # the moment's cars leave the scenery when nobody looks any more
                wait(sights.values())

        self._renderer.render_into(missing, views, side_by_side)
        self._kept.update(encoded)
        for capture in wanted:
            self._kept.move_to_end(capture)
        while len(self._kept) > max(self.kept_captures, len(wanted)):
            self._kept.popitem(last=False)
        return {capture: self._kept[capture] for capture in wanted}

    def _spread(self, features: Future[Tensor]) -> Future[Tensor]:
        """The maps that are fused, [channels, cells, cells]."""
        if self._net.config.grid == "coarse":
            return features

        def spread() -> Tensor:
            with self._autocast():
                maps: Tensor = self._net.spread(features.result()[None])[0]
            return maps.float().permute(1, 2, 0).contiguous().permute(2, 0, 1)  # as they are read: cell by cell

        return self._task(spread)

    def _autocast(self) -> torch.autocast:
        return torch.autocast("cpu", torch.bfloat16, enabled=self._config.precision == "bfloat16")

    def _head(self, maps: Tensor) -> Tensor:
        """Maps as they are fused [1, channels, cells, cells] → [planes, 128, 128]."""
        with self._autocast():
            out: Tensor = self._net.head(maps)[0]
        return out.float()

    def _head_alone(self, capture: Capture) -> Future[Tensor]:
        """The head's output without peers, computed once."""
        kept = self._kept[capture]
        if kept.out is None:
            maps = kept.maps
            kept.out = self._task(lambda: self._head(maps.result()[None]))
        return kept.out

    def _look_alone(self, capture: Capture) -> Future[Boxes]:
        """The capture's boxes without peers, computed once."""
        kept = self._kept[capture]
        if kept.boxes is None:
            out = self._head_alone(capture)
            kept.boxes = self._task(lambda: self._place(out.result(), capture.est_pose))
        return kept.boxes

    def _place(self, out: Tensor, pose: Pose) -> Boxes:
        """The boxes of a head's output [planes, 128, 128] in the world, suppressed."""
        return placed_boxes(out, pose, self._config.score_threshold)

    def _sent(self, share: Share, known: Known) -> Tensor:
        """[1, 64, 64] bool: the cells of the share's capture that its budget let through."""
        if share.representation == "raw":
            return ALL_CELLS
        kept = known[share.capture]
        if not _is_ranked(share):
            rank = np.zeros((CELLS, CELLS))
        else:
            assert kept.out is not None  # noqa: S101 (`_must_rank`)
            rank = F.max_pool2d(kept.out.result()[:1], 2)[0].numpy()
        return torch.from_numpy(budget.select(rank, share.rho, share.roi, *share.capture.est_pose, share.missing))[None]

    def _is_fused(self, share: Share) -> bool:
        return self._shares == "features" and share.is_map

    def _detect_ego(self, ego: Capture, shares: Sequence[Share], now: Mapping[int, Capture], known: Known) -> Boxes:
        """One ego's boxes: its own after fusion, and its peers' where boxes came or late fusion is flown."""
        maps = [s for s in shares if self._is_fused(s) and s.weight > 0.0]
        boxed = [s for s in shares if not self._is_fused(s) and s.weight > 0.0]
        late = [self._source(s, self._map_pose(s, now), known) for s in boxed]
        place, places = ego.est_pose, [self._map_pose(s, now) for s in maps]
        if self._config.match_poses:
            place, places, late = self._matched(ego, maps, places, late, known)
        peers = [*map(partial(self._peer, known), maps, places)]
        out = self._fuse(ego, place, peers, known) if peers else None
        if out is not None:
            own = self._place(out, place)
        elif not ego.looked:
            own = Boxes.empty()
        elif (alone := known[ego].boxes) is not None:
            own = alone.result().moved(ego.est_pose, place)
        else:
            own = self._place(self._head(known[ego].maps.result()[None]), place)
        sources = EgoSources.of(ego, shares, own, bool(maps) and out is not None, late)
        if any(s.covariance_m2 is not None for s in late):
            sources = sources._replace(errors=self._own_errors)
        return joined_many([sources], self._config.join)[0]

    def _matched(
        self, ego: Capture, maps: Sequence[Share], places: Sequence[Pose], late: Sequence[SourceBoxes], known: Known
    ) -> tuple[Pose, list[Pose], list[SourceBoxes]]:
        """The poses of an ego and of the maps that came, and the boxes that came, where all fit together.

        With a map came the boxes of the same look (`FleetRules.maps_bring_looks`); of pictures the receiver finds them.
        """

        def look(capture: Capture) -> Boxes:
            alone = known[capture].boxes if capture.looked else None
            return Boxes.empty() if alone is None else alone.result()

        seen = [
            look(s.capture).inside(_part(s)[1]).moved(s.capture.est_pose, at)
            for s, at in zip(maps, places, strict=True)
        ]
        seen += [*map(boxes_at_fusion, late), look(ego)]
        believed = [*places, *(source.pose for source in late), ego.est_pose]
        fitted: list[Pose] = [
            tuple(row) for row in matched_poses(believed, [sure(boxes).xy_m for boxes in seen]).tolist()
        ]
        moved = [
            replace(source, boxes=source.boxes.moved(source.pose, pose), pose=pose)
            for source, pose in zip(late, fitted[len(maps) : -1], strict=True)
        ]
        return fitted[-1], fitted[: len(maps)], moved

    def _peer(self, known: Known, share: Share, pose: Pose) -> Peer:
        """A share's map, placed by a pose."""
        whole = known[share.capture].maps.result()
        return Peer(pose, share.weight, self._map(share, known).result(), self._sent(share, known), whole)

    def _fuse(self, ego: Capture, pose: Pose, peers: Sequence[Peer], known: Known) -> Tensor | None:
        """The head's output after fusion; None where no peer takes part in any cell."""
        own = known[ego].maps.result() if ego.looked else None
        fused = fused_map(self._net, pose, own, peers, self._config.unsent_cells)
        return None if fused is None else self._head(fused)

    def _map(self, share: Share, known: Known) -> Future[Tensor]:
        """The map of a share as it is fused."""
        kept = known[share.capture]
        return kept.coded[_part(share)] if share.representation == "codes" else kept.maps

    def _read_codes(self, share: Share, known: Known) -> None:
        """What receivers read from the codes of a share, computed once per capture and budget."""
        kept, part = known[share.capture], _part(share)
        if part in kept.coded:
            return
        codebook, length = self._codebook, self._config.code_bytes

        def read() -> Tensor:
            return codebook.read(kept.features.result(), length, self._sent(share, known)[0])

        kept.coded[part] = self._spread(self._task(read))

    @cached_property
    def _codebook(self) -> Codebook:
        """The codebook of the network's features.

        Raises:
            InputError: a codebook that is missing, or of another network, or that has no codes of this length.
        """
        named = self._config.codebook
        path = beside(self._weights, CODEBOOK) if named is None else located(Path(named))
        found = load_codebook(path, self._loaded)
        if self._config.code_bytes > found.longest:
            raise InputError(
                f"perception.code_bytes is {self._config.code_bytes}, must be at most {found.longest}, the stages of {path}"
            )
        return found

    @cached_property
    def box_errors(self) -> BoxErrors:
        """How uncertain the boxes of a drone alone are.

        Raises:
            InputError: nobody fitted it for these weights.
        """
        return load_errors(beside(self._weights, ERRORS), self._weights.name)

    @cached_property
    def _own_errors(self) -> BoxErrors | None:
        """How uncertain an ego's own boxes are; None where nobody fitted it: they count with the usual one of their class."""
        return self.box_errors if beside(self._weights, ERRORS).is_file() else None

    def _map_pose(self, share: Share, now: Mapping[int, Capture]) -> Pose:
        """The pose that places a share's map in the world."""
        capture = share.capture if self._config.motion_compensation else now.get(share.capture.drone, share.capture)
        return capture.est_pose

    def _source(self, share: Share, lies: Pose, known: Known) -> SourceBoxes:
        """The boxes that a share adds: those that were sent, or those detected in the cells that were sent, of a map that lies
        there."""
        if share.is_map:
            part = _part(share)
            out = known[share.capture].in_part[part].result()
            cut = share.representation != "raw" and _is_ranked(share)
            boxes = self._sendable(self._place(out, lies))
            return SourceBoxes(boxes, share.weight, lies, part[1], cut, share.age_s)
        errors = self.box_errors if share.representation == "uncertain_boxes" and share.errors is None else None
        if not share.is_detected:
            return source_of(share, None, errors)
        alone = known[share.capture].boxes
        assert alone is not None  # noqa: S101 (requested with the job)
        return source_of(share, self._sendable(alone.result()), errors)

    def _sendable(self, boxes: Boxes) -> Boxes:
        """Those of a drone's boxes that it sends: in late fusion only confident ones."""
        return sendable(boxes) if self._shares == "boxes" else boxes

    def _head_in_part(self, share: Share, known: Known) -> None:
        """The head's output from the cells that were sent, computed once per capture and budget."""
        kept, part = known[share.capture], _part(share)
        if part in kept.in_part:
            return

        out = kept.out  # as it stands: a task waits for none behind it

        def head() -> Tensor:
            if share.representation == "codes":
                return self._head(kept.coded[part].result()[None])
            sent = self._sent(share, known)
            if out is not None and bool(sent.all()):
                return out.result()
            with self._autocast():
                maps: Tensor = self._net.spread((kept.features.result() * sent)[None]).float()
            return self._head(maps)

        kept.in_part[part] = self._task(head)


def _part(share: Share) -> Part:
    if share.representation == "raw":
        return 1.0, None, (), False
    return share.rho, share.roi, share.missing, share.representation == "codes"


def _must_rank(share: Share) -> bool:
    """Whether the sender's own head is needed to choose the cells it sent."""
    return share.representation in CELL_NAMES and _is_ranked(share)


def _is_ranked(share: Share) -> bool:
    """Whether cells have to be ranked: some did not fit the budget or did not arrive (the best are sent first)."""
    return bool(share.missing) or budget.must_choose(share.rho, share.roi, *share.capture.est_pose)
