"""Whom to ask for a map: learned handshakes against rules by geometry, on the same frames.

Every way asks its peers for whole maps, which are fused by the same network (`perception.fusion: when2com`). Positions are the
estimated ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
import torch
from numpy.typing import NDArray

from research.paper.instrument import CarNetInstrument, CarNetView
from research.paper.ways import FULL_SHARING, SINGLE, CellsBy, evaluate
from research.validation.stored import Column, Table, points
from sortie.perception.budget import payload_bytes
from sortie.perception.evaluation.harness import FleetFrames
from sortie.perception.evaluation.sharing import FOOTPRINT_M, Exchange, Floats, footprint_overlap
from sortie.perception.geometry import CELLS
from sortie.perception.metrics.ap import Matched
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.network.fusion.when2com import HANDSHAKE_BYTES, When2com, asked
from sortie.perception.network.model import CarNet
from sortie.scenarios.streams import stream

TAU = 0.1
KEPT_ABOVE = 0.2
"""When2com's threshold on attention: among five drones, more than an equal share."""

Choice = Callable[[Floats, Floats, np.random.Generator], NDArray[np.bool_]]
"""From attention [d, d], overlap of footprints [d, d] and random numbers: who (row) asks whom (column)."""


def learned(threshold: float | None) -> Choice:
    """By attention: When2com above a threshold, Who2com without one."""

    def choose(attention: Floats, overlap: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
        drones = len(attention)
        others = np.array([[e, *(i for i in range(drones) if i != e)] for e in range(drones)])
        rows = torch.from_numpy(np.take_along_axis(attention, others, axis=1))
        out = np.zeros((drones, drones), np.bool_)
        np.put_along_axis(out, others[:, 1:], asked(rows, threshold).numpy(), axis=1)
        return out

    return choose


def ranked(rank: Callable[[Floats, np.random.Generator], Floats], k: int = 1) -> Choice:
    """The `k` others that rank highest."""

    def choose(attention: Floats, overlap: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
        score = rank(overlap, rng).copy()
        np.fill_diagonal(score, -np.inf)
        out = np.zeros(score.shape, np.bool_)
        np.put_along_axis(out, np.argsort(-score, axis=1, kind="stable")[:, :k], True, axis=1)
        return out

    return choose


CHOICES: dict[str, Choice] = {
    "Who2com, learned": learned(None),
    "least overlap (the stand-in's rule on bare footprints)": ranked(lambda overlap, rng: -overlap),
    "most overlap": ranked(lambda overlap, rng: overlap),
    "one at random": ranked(lambda overlap, rng: rng.random(overlap.shape)),
    "When2com, learned": learned(KEPT_ABOVE),
    "two at random": ranked(lambda overlap, rng: rng.random(overlap.shape), 2),
}
"""Ways to choose, by name."""


class Chosen:
    """An instrument whose egos hear those alone whom they asked."""

    def __init__(self, net: CarNet, name: str) -> None:
        if not isinstance(net.fusion, When2com):
            raise ValueError(f"weights are made for fusion {net.config.fusion!r}, must be 'when2com'")
        self._instrument, self._net, self._choice = CarNetInstrument(net), net, CHOICES[name]
        self.start_worker = self._instrument.start_worker
        self.fingerprint = f"{name}:{self._instrument.fingerprint}"
        self.geometry = self._instrument.geometry
        self._counting = Lock()
        self.links = 0
        """Maps that went over the air in all frames."""

    def look(self, frames: FleetFrames, frame: int) -> ChosenView:
        """One fleet-frame, with who asks whom."""
        view = self._instrument.look(frames, frame)
        xy_m = frames.est_pose[frame][:, :2]
        overlap = footprint_overlap(xy_m, np.full(len(xy_m), FOOTPRINT_M))
        rng = stream(0, 0, (int(frames.scene[frame]), frame), "handshakes.random")
        asks = self._choice(attention_of(self._net, view), overlap, rng)
        with self._counting:
            self.links += int(asks.sum())
        return ChosenView(view, asks)


@dataclass(frozen=True, slots=True)
class ChosenView:
    """One fleet-frame."""

    view: CarNetView
    asks: NDArray[np.bool_]

    def rank(self, by: CellsBy = "confidence") -> NDArray[np.floating]:
        """As the network ranks."""
        return self.view.rank(by)

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """From the whole maps of those who were asked."""
        given = []
        for e in exchanges:
            peers = tuple(np.flatnonzero(self.asks[e.ego]).tolist())
            given.append(Exchange(e.ego, peers, np.ones((len(peers), CELLS, CELLS), np.bool_), "masked"))
        return self.view.detect(given, floor)


@torch.inference_mode()
def attention_of(net: CarNet, view: CarNetView) -> Floats:
    """[d, d]: row by row, a drone's attention on every drone, itself on the diagonal."""
    assert isinstance(net.fusion, When2com)
    maps = view.features
    drones = len(maps)
    out = np.empty((drones, drones))
    for ego in range(drones):
        others = [i for i in range(drones) if i != ego]
        out[ego, [ego, *others]] = net.fusion.attention(maps[[ego]], maps[others][None])[0].double().numpy()
    return out


@dataclass(frozen=True, slots=True)
class HandshakeRow:
    """One way to choose."""

    name: str
    against_alone: Difference
    against_first: Difference
    links_per_ego: float
    bytes_per_frame: float


def measure(net: CarNet, frames: FleetFrames, workers: int = 1) -> list[HandshakeRow]:
    """Every choice against a drone alone and against the learned one of as many peers; scenes are the bootstrap's units.

    Raises:
        ValueError: a network of another fusion.
    """
    drones = frames.est_pose.shape[1]
    scene = np.repeat(np.asarray(frames.scene), drones)
    count = len(frames.scene)
    plain = evaluate(CarNetInstrument(net), frames, (SINGLE, FULL_SHARING), regions=("full",), workers=workers).at(TAU)
    alone = plain.matched(SINGLE)
    found: dict[str, tuple[Sequence[Matched], int]] = {}
    for name in CHOICES:
        instrument = Chosen(net, name)
        seen = evaluate(instrument, frames, (FULL_SHARING,), regions=("full",), workers=workers).at(TAU)
        found[name] = seen.matched(FULL_SHARING), instrument.links
    found["everyone"] = plain.matched(FULL_SHARING), count * drones * (drones - 1)
    rows = []
    first = "Who2com, learned"
    for name, (matched, links) in found.items():
        first = name if name.endswith("learned") else first
        asking = HANDSHAKE_BYTES * drones * (drones - 1) if name.endswith("learned") else 0
        sent = links / count * payload_bytes(CELLS**2) + asking
        rows.append(
            HandshakeRow(
                name,
                compare(alone, matched, scene),
                compare(found[first][0], matched, scene),
                links / count / drones,
                sent,
            )
        )
    return rows


def table(rows: Sequence[HandshakeRow], about: str = "") -> Table:
    """A row a way to choose."""
    columns = [
        Column("asks for the maps of"),
        Column("maps an ego", ".2f"),
        Column("a fleet-frame", ".2f", " MB", 1e-6),
        Column("AP@0.5", ".3f"),
        Column("over a drone alone", "+.1f", factor=100),
        Column("over the learned choice above", "+.1f", factor=100),
    ]
    return Table(
        columns,
        [
            [
                r.name, r.links_per_ego, r.bytes_per_frame, r.against_alone.ap_b, points(r.against_alone),
                None if r.name.endswith("learned") else points(r.against_first),
            ]
            for r in rows
        ],
        about,
    )  # fmt: skip
