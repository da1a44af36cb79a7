"""The fusion methods beside each other on the same frames, with their bytes (`make figures FIGURE=fusion_methods`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray

from research.paper.instrument import CarNetInstrument
from research.paper.ways import FULL_SHARING, SINGLE, CellsBy, Sharing, evaluate
from research.validation.stored import Column, Table, points
from sortie.perception.evaluation.harness import FleetFrames
from sortie.perception.evaluation.sharing import Exchange, Floats, link_bytes
from sortie.perception.joining import Pose, Rule, SourceBoxes, joined, sendable
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.network.decode import placed_boxes
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.perception.network.fusion.traffic import boxes_of
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.perception.types import Boxes

TAU = 0.1
STARVED = Sharing(0.05, unsent="masked")
SHARING = (FULL_SHARING, STARVED)


@dataclass(frozen=True, slots=True)
class MethodRow:
    """One method under one budget."""

    method: str
    received_budget: float
    """Cells that an ego receives, as a share of full sharing; 0 where no cells are sent."""
    gain: Difference
    """The same network's drone alone (a) and with its peers (b), paired by scenes."""
    bytes_per_frame: float
    """Content of a whole fleet-frame, all links, index included; mean over the frames."""


class LateInstrument:
    """Late fusion in the harness: each drone's own boxes, and its peers' that are sure, whatever the budget of cells."""

    def __init__(self, net: CarNet, rule: Rule = "nms") -> None:
        self.fingerprint = f"late, {rule}:" + CarNetInstrument(net).fingerprint
        self.geometry = net.config.geometry
        self.sent: list[int] = []
        """Boxes that went over all links, frame by frame."""
        self._net, self._rule = folded(net), rule

    def look(self, frames: FleetFrames, frame: int) -> LateView:
        """Every drone's boxes of one fleet-frame."""
        with torch.inference_mode():
            images = torch.from_numpy(np.ascontiguousarray(frames.images[frame]))  # type: ignore[attr-defined]
            outs = self._net.head(self._net.encoder(images))
        poses = [(float(x), float(y), float(yaw)) for x, y, yaw in frames.est_pose[frame]]
        found = [placed_boxes(out, pose, 0.01, self.geometry) for out, pose in zip(outs, poses, strict=True)]
        self.sent.append(sum(len(sendable(boxes)) for boxes in found) * (len(found) - 1))
        return LateView(found, poses, self._rule)


class LateView:
    """One fleet-frame's boxes in the world."""

    def __init__(self, found: Sequence[Boxes], poses: Sequence[Pose], rule: Rule) -> None:
        self._found, self._poses, self._rule = found, poses, rule

    def rank(self, by: CellsBy = "confidence") -> NDArray[np.floating]:
        """Nothing is ranked: cells are not sent."""
        return np.zeros((len(self._found), 64, 64))

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """The ego's boxes and its peers' as one list, in the ego's frame."""
        out = []
        for e in exchanges:
            own, pose = self._found[e.ego], self._poses[e.ego]
            theirs = [SourceBoxes(sendable(self._found[p]), 1.0, self._poses[p]) for p in e.peers]
            boxes = joined(pose, own.take(own.score >= floor), False, theirs, self._rule)
            x, y, yaw = pose
            c, s = np.cos(yaw), np.sin(yaw)
            table = boxes.table()
            dx, dy = table[:, 0] - x, table[:, 1] - y
            table[:, 0], table[:, 1] = c * dx + s * dy, c * dy - s * dx
            table[:, 4] -= yaw
            out.append(np.concatenate([table, boxes.score[:, None].astype(np.float64)], axis=1))
        return out


def measure(weights: Mapping[str, CarNet], frames: FleetFrames) -> list[MethodRow]:
    """Each method's network alone and with its peers, at full sharing and starved (masked, cells by confidence).

    Args:
        weights: a network per method; "disconet" also stands for none and late.
        frames: with images; scenes are the bootstrap's units.

    Raises:
        ValueError: a network under another method's name.
    """
    scene = np.repeat(np.asarray(frames.scene), frames.est_pose.shape[1])
    drones = frames.est_pose.shape[1]
    rows = []
    for name, net in weights.items():
        if net.config.fusion != name:
            raise ValueError(f"weights of {name} are made for fusion {net.config.fusion!r}, must be {name!r}")
        found = evaluate(CarNetInstrument(net), frames, (SINGLE, *SHARING), regions=("full",)).at(TAU)
        alone = found.matched(SINGLE)
        for condition in SHARING:
            cells = round(condition.received_budget * 4096)
            sent = FUSIONS[name].link_bytes(cells=cells)
            assert sent.payload + sent.index == sum(link_bytes([cells]))
            gain = compare(alone, found.matched(condition), scene)
            rows.append(MethodRow(name, condition.received_budget, gain, float(sent.total * drones * (drones - 1))))
        if name == "disconet":
            rows.append(MethodRow("none", 0.0, compare(alone, alone, scene), 0.0))
            for rule in get_args(Rule):
                late = LateInstrument(net, rule)
                found = evaluate(late, frames, (FULL_SHARING,), regions=("full",)).at(TAU)
                mean = float(np.mean([boxes_of(boxes).total for boxes in late.sent]))
                rows.append(MethodRow(f"late, {rule}", 0.0, compare(alone, found.matched(FULL_SHARING), scene), mean))
    return rows


def table(rows: Sequence[MethodRow], about: str = "") -> Table:
    """A row a method and budget."""
    return Table(
        [
            Column("method"),
            Column("received budget", "g"),
            Column("AP@0.5 alone", ".3f"),
            Column("with peers", ".3f"),
            Column("gain", "+.1f", factor=100),
            Column("a fleet-frame", ",.1f", " kB", 1e-3),
        ],
        [
            [r.method, r.received_budget or None, r.gain.ap_a, r.gain.ap_b, points(r.gain), r.bytes_per_frame]
            for r in rows
        ],
        about,
    )
