"""What a Where2comm request is worth: cells ranked by the sender's confidence, or by what the receiver lacks of it as well.

Every drone sends the same share of its cells to every peer. The maps are fused by `perception.fusion: where2comm`. In the
first round a sender ranks its cells by its own confidence C_i. In the second round the receiver has sent its request
R_j = 1 − C_j, and the sender ranks by C_i ⊙ R_j on its own grid. Cells beyond the receiver's grid come last.

Set down before it was measured: on the frames of the test split, at 2, 5 and 25 % of the cells a link, is AP@0.5 with
requests higher than without? The claim stands where the 95 % interval of the difference, over scenes, lies above 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from research.paper.instrument import CarNetInstrument, CarNetView
from research.paper.ways import SINGLE, CellsBy, Sharing, evaluate
from research.validation.stored import Column, Table, points
from sortie.perception.evaluation.harness import FleetFrames
from sortie.perception.evaluation.sharing import Exchange, Floats, sending_order
from sortie.perception.geometry import CELLS
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.network.fusion.where2comm import Where2comm, confidence_map, requested_rank
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import rows, support
from sortie.scenarios.streams import stream

TAU = 0.1
SHARES = (0.02, 0.05, 0.25)
"""Of a sender's cells, on each link."""

Order = Literal["at random", "confidence", "confidence × request"]


class Requesting:
    """An instrument whose senders rank their cells anew for each receiver.

    Raises:
        ValueError: a network of another fusion.
    """

    def __init__(self, net: CarNet, order: Order) -> None:
        if not isinstance(net.fusion, Where2comm):
            raise ValueError(f"weights are made for fusion {net.config.fusion!r}, must be 'where2comm'")
        self._instrument, self._net, self._order = CarNetInstrument(net), net, order
        self.start_worker = self._instrument.start_worker
        self.fingerprint = f"{order}:{self._instrument.fingerprint}"
        self.geometry = self._instrument.geometry

    def look(self, frames: FleetFrames, frame: int) -> RequestingView:
        """One fleet-frame, with every drone's order of cells for every other."""
        view = self._instrument.look(frames, frame)
        if self._order == "at random":
            drones = len(view.features)
            rng = stream(0, 0, (int(frames.scene[frame]), frame), "requests.random")
            rank = rng.random((drones, drones, CELLS, CELLS))
        else:
            rank = ranks(self._net, view, frames.est_pose[frame], requested=self._order != "confidence")
        return RequestingView(view, np.stack([sending_order(each) for each in rank]))


@dataclass(frozen=True, slots=True)
class RequestingView:
    """One fleet-frame; `place` [receiver, sender, 64, 64] is each cell's place in the order of sending."""

    view: CarNetView
    place: NDArray[np.int16]

    def rank(self, by: CellsBy = "confidence") -> NDArray[np.floating]:
        """As the network ranks; how many cells are sent follows from it, and not which."""
        return self.view.rank(by)

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """As many cells of each peer as the exchange has, in this order."""
        given = []
        for e in exchanges:
            count = e.sent.sum(axis=(1, 2))[:, None, None]
            given.append(e._replace(sent=self.place[e.ego, list(e.peers)] < count))
        return self.view.detect(given, floor)


@torch.inference_mode()
def ranks(net: CarNet, view: CarNetView, est_pose: Floats, *, requested: bool) -> Floats:
    """[receiver, sender, 64, 64], higher first, on the sender's grid.

    Args:
        est_pose: [d, 3] x, y, yaw as the drones believe.
        requested: whether receivers send requests.
    """
    sure = confidence_map(net.head(view.features)[:, 0])
    drones = len(sure)
    if not requested:
        return np.broadcast_to(sure.double().numpy(), (drones, drones, CELLS, CELLS))
    near = torch.from_numpy(est_pose - np.array([*est_pose.mean(axis=0)[:2], 0.0])).float()
    out = np.empty((drones, drones, CELLS, CELLS))
    for sender in range(drones):
        under = support(near[sender], near, net.config.geometry.cell_m)
        for receiver in range(drones):
            theirs = rows(
                sure[receiver].reshape(-1, 1), under.cells[receiver].view(-1, 4), under.weights[receiver].view(-1, 4)
            )
            rank = requested_rank(sure[sender], theirs.view(CELLS, CELLS))
            out[receiver, sender] = torch.where(under.inside[receiver], rank, -1.0).double().numpy()
    return out


@dataclass(frozen=True, slots=True)
class RequestRow:
    """One order of cells at one share."""

    share: float
    order: Order
    against_alone: Difference
    against_confidence: Difference | None
    bytes_per_frame: float


def measure(net: CarNet, frames: FleetFrames, workers: int = 1) -> list[RequestRow]:
    """Every order at every share; scenes are the bootstrap's units."""
    drones = frames.est_pose.shape[1]
    scene = np.repeat(np.asarray(frames.scene), drones)
    conditions = [replace(Sharing(share), unsent="masked") for share in SHARES]
    seen = {
        order: evaluate(Requesting(net, order), frames, (SINGLE, *conditions), regions=("full",), workers=workers).at(
            TAU
        )
        for order in get_args(Order)
    }
    out = []
    for share, condition in zip(SHARES, conditions, strict=True):
        for order, found in seen.items():
            sent = Where2comm.link_bytes(round(share * CELLS**2), rounds=2 if "request" in order else 1)
            plain = seen["confidence"].matched(condition)
            out.append(
                RequestRow(
                    share,
                    order,
                    compare(found.matched(SINGLE), found.matched(condition), scene),
                    None if order == "confidence" else compare(plain, found.matched(condition), scene),
                    float(sent.total) * drones * (drones - 1),
                )
            )
    return out


def table(found: Sequence[RequestRow], about: str = "") -> Table:
    """A row an order of cells at a share."""
    columns = [
        Column("cells a link", ".0f", " %", 100),
        Column("sent first"),
        Column("a fleet-frame", ".2f", " MB", 1e-6),
        Column("AP@0.5", ".3f"),
        Column("over a drone alone", "+.1f", factor=100),
        Column("over confidence", "+.1f", factor=100),
    ]
    return Table(
        columns,
        [
            [
                r.share, r.order, r.bytes_per_frame, r.against_alone.ap_b, points(r.against_alone),
                None if r.against_confidence is None else points(r.against_confidence),
            ]
            for r in found
        ],
        about,
    )  # fmt: skip
