"""One way of sharing: how many cells an ego receives, from which peers, and which cells. Pure; free of torch."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, get_args

import numpy as np
from numpy.typing import NDArray

from sortie.perception.budget import CELLS, Bools, cells_in, index_bytes, payload_bytes, ranking, roi_mask
from sortie.perception.errors import InputError
from sortie.perception.geometry import FULL, Geometry
from sortie.scenarios.disc import Disc, disc_overlap, rank_by_overlap
from sortie.scenarios.streams import stream

Floats = NDArray[np.float64]
Allocation = Literal["uniform", "overlap"]
Unsent = Literal["zero", "masked"]
FOOTPRINT_M = 60.0 * math.tan(math.radians(35.0))
"""42 m: the radius that a 70° lens sees from 60 m."""
CELL_BYTES = payload_bytes(1)
_PEERS = re.compile(r"none|(all|best|worst|random)-([1-9]\d?)")


class Exchange(NamedTuple):
    """What one ego receives in one frame."""

    ego: int
    peers: tuple[int, ...]
    """Peers that take part, also those that sent no cell."""
    sent: NDArray[np.bool_]
    """[peers, 64, 64] on each sender's own grid."""
    unsent: Unsent = "zero"


class FrameView(Protocol):
    """One fleet-frame as a model sees it."""

    def rank(self) -> NDArray[np.floating]:
        """[d, 64, 64]: what ranks each drone's cells on its own grid, higher first."""

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """Each ego's boxes [m, 6] with scores ≥ `floor`, before suppression.

        The columns are x forward and y left of the estimated pose, length, width, yaw and score. The same exchange
        gives the same boxes (to rounding), whatever else is computed.
        """


Rank = Callable[[FrameView], NDArray[np.floating]]
"""From one frame: what ranks each drone's cells, [d, 64, 64], higher first."""


def confidence(view: FrameView) -> NDArray[np.floating]:
    """Cells in the order of the sender's own confidence."""
    return view.rank()


@dataclass(frozen=True, slots=True)
class Sharing:
    """What every ego of every frame receives.

    A subclass gives other ways to share: it overrides `cells_from` (who sends how many cells) or `rank` (which cells come
    first), and adds its own words to `ALLOWED`.

    Raises:
        InputError: naming the field, its value and what it must be.
    """

    received_budget: float
    """Cells sent to each ego, as a fraction of full sharing (4 peers × 4096 cells in a fleet of five), 0 … 1."""
    peers: str = "all-4"
    """all-k, best-k, worst-k, random-k, or none: a drone alone. All of them share the same total of cells."""
    allocation: Allocation = "uniform"
    """How the total is divided among the peers: equally, or in proportion to their overlap with the ego."""
    unsent: Unsent = "zero"
    """A cell that was not sent takes part in the fusion as zeros, or is left out (masked)."""
    roi: bool = False
    """Whether cells in the mission's disc come before all others."""

    ALLOWED: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "allocation": get_args(Allocation),
        "unsent": get_args(Unsent),
    }
    """The values of each field that is a word; no word stands in two fields."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.received_budget <= 1.0:
            raise InputError(f"received_budget is {self.received_budget}, must be 0 to 1")
        if not _PEERS.fullmatch(self.peers):
            raise InputError(
                f"peers is {self.peers!r}, must be none, or all-k, best-k, worst-k or random-k with k 1 to 99"
            )
        for name, allowed in self.ALLOWED.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"{name} is {getattr(self, name)!r}, must be {' or '.join(allowed)}")
        if self.peers == "none" and self.received_budget != 0.0:
            raise InputError(f"received_budget is {self.received_budget} with no peers, must be 0")

    @property
    def rule(self) -> str:
        """all, best, worst, random or none."""
        return self.peers.split("-")[0]

    @property
    def k(self) -> int:
        """How many peers share."""
        return 0 if self.peers == "none" else int(self.peers.split("-")[1])

    @property
    def label(self) -> str:
        """A short name, such as `best-2@0.02` or `all-4@0.1,overlap,masked,roi`; `parse` reads it."""
        if self.peers == "none":
            return "single"
        short = f"{self.received_budget:g}"
        budget = short if float(short) == self.received_budget else repr(self.received_budget)
        marks = [
            f.name if f.name == "roi" else str(getattr(self, f.name))
            for f in fields(self)[2:]
            if getattr(self, f.name) != f.default
        ]
        return ",".join([f"{self.peers}@{budget}", *marks])

    @classmethod
    def parse(cls, label: str) -> Self:
        """The condition with this label.

        Raises:
            InputError: no condition has this label.
        """
        if label == "single":
            return cls(0.0, "none")
        head, *marks = label.split(",")
        peers, at, budget = head.partition("@")
        field_of = {value: name for name, values in cls.ALLOWED.items() for value in values}
        try:
            if not at:
                raise InputError("no @ in it")
            words: dict[str, Any] = {field_of[m]: m for m in marks if m != "roi"}
            return cls(float(budget), peers, roi="roi" in marks, **words)
        except (ValueError, KeyError) as error:
            raise InputError(f"condition is {label!r}, must be like best-2@0.02,masked ({error})") from None

    @property
    def rank(self) -> Rank:
        """What ranks each sender's cells. Conditions with the same function are ranked once a frame."""
        return confidence

    def cells_from(self, ego: int, overlap: Floats, key: tuple[int, ...] = (), seed: int = 0) -> dict[int, int]:
        """How many cells each peer sends to an ego; the arguments are those of `choose`."""
        peers = choose(self, ego, overlap, key, seed)
        total = cells_in(self.received_budget, len(overlap) - 1)
        return dict(zip(peers, allocate(total, [float(overlap[p]) for p in peers], self.allocation), strict=True))


SINGLE = Sharing(0.0, "none")
"""A drone alone."""
FULL_SHARING = Sharing(1.0)
"""Every peer of five drones sends every cell."""


def footprint_overlap(xy_m: Floats, radius_m: Floats) -> Floats:
    """[d, d]: the share of drone i's footprint that drone j's covers, 0 … 1, from positions [d, 2] and radii [d]."""
    at = list(zip(xy_m.tolist(), radius_m.tolist(), strict=True))
    return np.array([[disc_overlap(math.dist(p, q), r, s) for q, s in at] for p, r in at])


def choose(condition: Sharing, ego: int, overlap: Floats, key: tuple[int, ...] = (), seed: int = 0) -> tuple[int, ...]:
    """The peers that share with `ego`: all of them by ascending id, or the chosen ones, most overlapping first.

    Args:
        condition: gives the rule for `peers`.
        ego: the receiver.
        overlap: [d] the share of the ego's footprint that each drone's covers.
        key: names the frame: its random peers do not depend on what else is evaluated.
        seed: of the random peers.

    Raises:
        InputError: more peers than there are, or all-k where the fleet has another number.
    """
    others = [i for i in range(len(overlap)) if i != ego]
    if condition.k > len(others) or (condition.rule == "all" and condition.k != len(others)):
        raise InputError(f"peers is {condition.peers!r}, must fit a fleet with {len(others)} peers")
    if condition.rule == "all":
        return tuple(others)
    ranked = rank_by_overlap(ego, {i: float(overlap[i]) for i in others})
    if condition.rule == "worst":
        ranked = ranked[len(ranked) - condition.k :]
    elif condition.rule == "random":
        drawn = stream(seed, 0, (*key, ego), "harness.random_peers").permutation(len(ranked))[: condition.k]
        ranked = [ranked[i] for i in sorted(drawn.tolist())]
    return tuple(ranked[: condition.k])


def allocate(total: int, overlap: Sequence[float], allocation: Allocation, most: int = CELLS) -> list[int]:
    """Divide `total` cells among the chosen peers. Their sum is `total`, unless every peer sends all it has.

    Quotas are equal or in proportion to `overlap`. A peer with a quota of `most` or more sends all its cells, and the
    rest is divided again among the others (equally, where none of those overlaps). Quotas are rounded down. Cells left
    over go one by one to the peers with the largest fractions, then to those that come first.
    """
    k = len(overlap)
    share = [Fraction(float(o)) if allocation == "overlap" else Fraction(1) for o in overlap]
    out = [0] * k
    open_, left = list(range(k)), total
    while open_:
        if not sum(share[i] for i in open_):
            share = [Fraction(1)] * k
        whole = sum(share[i] for i in open_)
        quota = {i: share[i] * left / whole for i in open_}
        full = [i for i in open_ if quota[i] >= most]
        if not full:
            for i in open_:
                out[i] = math.floor(quota[i])
            spare = left - sum(out[i] for i in open_)
            for i in sorted(open_, key=lambda i: (out[i] - quota[i], i))[:spare]:
                out[i] += 1
            return out
        for i in full:
            out[i] = most
            left -= most
            open_.remove(i)
    return out


def in_disc(pose: Floats, disc: Disc, geometry: Geometry = FULL) -> Bools:
    """[d, 64, 64]: the cells with their centres in the disc, on the grids of drones at `pose` [d, 3] (x, y, yaw)."""
    return np.stack([roi_mask(disc, x, y, yaw, geometry.cell_m) for x, y, yaw in pose.tolist()])


def sending_order(rank: NDArray[np.floating], first: Bools | None = None) -> NDArray[np.int16]:
    """[d, 64, 64]: each cell's place in its sender's order, 0 sent first; a budget of b cells sends `order < b`.

    The cells of `first` come before the rest. (In a sortie, cells outside the region of interest are not sent at all.)
    """
    place = np.empty((len(rank), CELLS), np.int16)
    np.put_along_axis(place, ranking(rank, first), np.arange(CELLS, dtype=np.int16)[None], axis=1)
    return place.reshape(rank.shape)


def link_bytes(cells: Sequence[int], cell_bytes: int = CELL_BYTES) -> tuple[int, int]:
    """Bytes to one ego: payload (cells × `cell_bytes`), and the index (512 B bitmap or 12 bits a cell, per link)."""
    return sum(cells) * cell_bytes, sum(index_bytes(c) for c in cells)
