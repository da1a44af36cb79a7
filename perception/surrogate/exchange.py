"""What an exchange brings for each car of an ego: who sent its cell, with which confidence, and how misplaced. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sortie.perception import budget
from sortie.perception.geometry import CELLS, FULL, in_square
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.features import LOOK_COVARIATES, CaptureColumns, Ints, Looks, beside, square
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Scene

_ALL = slice(None)
NO_PEER = -8.0
"""Stands for the confidence of a peer that sent nothing (a logit)."""
OF_THE_LOOK = (
    "range",
    "visible",
    "margin",
    "nadir",
    "moving",
    "length",
    "across",
    "crowd",
    "altitude",
    "strange",
    "square",
    "next",
    "next_along",
    "next_across",
)
"""What fusion takes over from the ego's own look."""
FUSED_COVARIATES = (
    "own",
    "first",
    "second",
    "mean",
    "many",
    "senders",
    "silent",
    "weight",
    "shift_first",
    "shift_mean",
    "spread",
    "density",
    "part",
    "margin",
    *(f"own_{name}" for name in OF_THE_LOOK),
)
_OWN = [LOOK_COVARIATES.index(name) for name in OF_THE_LOOK]
_MOVING = LOOK_COVARIATES.index("moving")
_STYLES = ("old_town", "suburb", "yard")
ALARM_COVARIATES = (
    "cars",
    "brightness",
    "shade",
    "received",
    "silent",
    "seams",
    "sharing",
    "plenty",
    "buildings",
    "trees",
    *_STYLES,
    "square",
    "aimed",
    "moving",
    "late",
    "gone",
)


@dataclass(frozen=True, slots=True)
class FeatureShares:
    """m egos' feature shares, padded to k slots.

    `ego` [m] and `sender` [m, k] are columns of the fleet (−1: no share); `cells` [m, k] how many cells go and `allowed`
    [m, k] of how many they are the best (4096, or those of the region); `roi` [m, k, 3] (radius inf: everywhere);
    `weight` [m, k]; `pose` [m, k, 3] what places the sender's map (x, y, yaw).
    """

    ego: Ints
    sender: Ints
    cells: Floats
    allowed: Floats
    roi: Floats
    weight: Floats
    pose: Floats
    missing: dict[tuple[int, int], NDArray[np.intp]] = field(default_factory=dict)
    """Ranks (0 the best) of the cells that did not arrive, by (row, slot), where any."""

    @property
    def arrived(self) -> Floats:
        """[m, k] how many cells came."""
        if not self.missing:
            return self.cells
        out = self.cells.copy()
        for at, ranks in self.missing.items():
            out[at] -= len(ranks)
        return out

    def sent(self, pairs: Pairs, rank: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[n, k] which senders' cells with the car arrived; `rank` [n, k] the fraction of cells that rank above it."""
        everything = self.cells >= self.allowed
        sent = pairs.aimed & ((rank < (self.cells / np.maximum(self.allowed, 1.0))[pairs.row]) | everything[pairs.row])
        self.drop_missing(sent, rank, pairs.row)
        return sent

    def drop_missing(self, sent: NDArray[np.bool_], rank: NDArray[np.float32], row: Ints) -> None:
        """Take back, of what was sent [n, k], what did not arrive; `rank` [n, k] and `row` [n] as in `covariates`."""
        for (m, slot), ranks in self.missing.items():
            here = np.flatnonzero((row == m) & sent[:, slot])
            number = (rank[here, slot] * self.allowed[m, slot]).astype(np.intp)
            sent[here, slot] = ~np.isin(number, ranks)

    @classmethod
    def of(
        cls,
        jobs: Sequence[tuple[Capture, Sequence[Share]]],
        column: dict[Capture, int],
        lies: Sequence[Sequence[tuple[float, float, float]]] | None = None,
    ) -> FeatureShares:
        """Of jobs whose captures stand in `column`; `lies` are other poses than the senders' own for their maps."""
        rows: list[tuple[int, int, int]] = []
        values: list[tuple[float, ...]] = []
        missing: dict[tuple[int, int], NDArray[np.intp]] = {}
        for m, (_, shares) in enumerate(jobs):
            slot = 0
            for i, s in enumerate(shares):
                if s.is_map and s.weight > 0.0:
                    x, y, yaw = s.capture.est_pose
                    rho, disc = (1.0, None) if s.representation == "raw" else (s.rho, s.roi)
                    pose = (x, y, yaw) if lies is None else lies[m][i]
                    rows.append((m, slot, column[s.capture]))
                    values.append((rho, s.weight, *(disc or (0.0, 0.0, np.inf)), *pose, x, y, yaw))
                    if s.missing:
                        missing[m, slot] = np.array(s.missing, np.intp)
                    slot += 1
        m = len(jobs)
        row, slots, sender_of = np.array(rows, np.intp).reshape(-1, 3).T
        k = int(slots.max(initial=-1)) + 1
        table = np.array(values).reshape(-1, 11)
        filled = np.zeros((m, k, 10))
        filled[row, slots, :8] = table[:, :8]
        allowed = _allowed(table[:, 2:5], table[:, 8:])
        filled[row, slots, 8], filled[row, slots, 9] = (
            np.minimum(np.floor(table[:, 0] * CELLS**2 + 1e-9), allowed),
            allowed,
        )
        sender = np.full((m, k), -1)
        sender[row, slots] = sender_of
        egos = np.array([column[ego] for ego, _ in jobs], np.intp)
        return cls(
            egos, sender, filled[..., 8], filled[..., 9], filled[..., 2:5], filled[..., 1], filled[..., 5:8], missing
        )


def _allowed(roi: Floats, pose: Floats) -> Floats:
    """How many cells [n] of a sender at an estimated pose lie in a disc (radius inf: all): by area, counted where it leaves the map."""
    radius = roi[:, 2]
    out = np.where(np.isinf(radius), float(CELLS**2), np.pi * (np.minimum(radius, 1e3) / FULL.cell_m) ** 2)
    off = np.hypot(roi[:, 0] - pose[:, 0], roi[:, 1] - pose[:, 1]) + radius
    for i in np.flatnonzero(np.isfinite(radius) & (off > FULL.half_extent_m)).tolist():
        x, y, yaw = pose[i].tolist()
        out[i] = budget.cells_sent(1.0, Disc(*roi[i].tolist()), x, y, yaw)
    return np.asarray(out)


@dataclass(frozen=True, slots=True)
class Pairs:
    """The cars of each ego: `look` [n] the ego's own, `row` [n] of the exchange, `peer` [n, k] the senders' looks (−1: outside
    their map, or no share), `shift_m` [n, k, 2] from where the ego puts the car to where the sender's map puts it, ego's frame;
    `aimed` [n, k] whether the sender's region holds it."""

    look: Ints
    row: Ints
    peer: NDArray[np.int32]
    shift_m: NDArray[np.float32]
    aimed: NDArray[np.bool_]


def pair(exchange: FeatureShares, looks: Looks, fleet: CaptureColumns) -> Pairs:
    """Every car that an ego's square holds, with what its peers' maps hold of it."""
    first, count = looks.first[exchange.ego], np.diff(looks.first)[exchange.ego]
    row = np.repeat(np.arange(len(count)), count)
    look = np.arange(len(row)) + np.repeat(first - (np.cumsum(count) - count), count)  # a capture's looks are a run
    car = looks.car[look]
    sender, k = exchange.sender, exchange.sender.shape[1]
    peer = np.full((len(row), k), -1, np.int32)
    shift = np.zeros((len(row), k, 2), np.float32)
    aimed = np.zeros((len(row), k), bool)
    # from each sender's frame to its ego's, and each disc in its sender's frame
    ego = fleet.est[exchange.ego]
    ex, ey, eyaw = (ego[:, i, None] for i in range(3))
    px, py, pyaw = (exchange.pose[..., i] for i in range(3))
    tx, ty = _into(px - ex, py - ey, eyaw)
    c, s = np.cos(pyaw - eyaw), np.sin(pyaw - eyaw)
    theirs = fleet.est[sender]
    dx, dy = _into(exchange.roi[..., 0] - theirs[..., 0], exchange.roi[..., 1] - theirs[..., 1], theirs[..., 2])
    radius = exchange.roi[..., 2]
    xy, mine = looks.xy_m.astype(np.float32), looks.xy_m[look].astype(np.float32)
    cos, sin, at_x, at_y, disc_x, disc_y = (v.astype(np.float32) for v in (c, s, tx, ty, dx, dy))
    for j in range(k):
        here = np.flatnonzero(sender[row, j] >= 0)
        of = looks.index[sender[row[here], j], car[here]]
        here, of = here[of >= 0], of[of >= 0]
        m = row[here]
        x, y = xy[of, 0], xy[of, 1]
        peer[here, j] = of
        shift[here, j, 0] = cos[m, j] * x - sin[m, j] * y + at_x[m, j] - mine[here, 0]
        shift[here, j, 1] = sin[m, j] * x + cos[m, j] * y + at_y[m, j] - mine[here, 1]
        aimed[here, j] = (x - disc_x[m, j]) ** 2 + (y - disc_y[m, j]) ** 2 <= radius[m, j] ** 2
    return Pairs(look, row, peer, shift, aimed)


def _into(x: Floats, y: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """A vector in the frame that is turned by `yaw`."""
    c, s = np.cos(yaw), np.sin(yaw)
    return c * x + s * y, c * y - s * x


def covariates(
    pairs: Pairs,
    exchange: FeatureShares,
    looks: Looks,
    confidence: NDArray[np.float32],
    sent: NDArray[np.bool_],
    rank: NDArray[np.float32],
    zeros: NDArray[np.bool_],
    own_confidence: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """What fusion makes of each pair depends on: [n, 28] float32, as `FUSED_COVARIATES`.

    Args:
        confidence: [looks] the logit that each drone gives each car on its own.
        sent: [n, k] whether the cell that holds the car was sent.
        rank: [n, k] the fraction of the sender's cells that rank above the car's: how much of what is about it was sent too.
        zeros: [n] whether cells that were not sent take part as zeros.
        own_confidence: [n] the ego's, where it is not what it gives the cars on its own.
    """
    n, k = pairs.peer.shape
    first, second = np.full((2, n), NO_PEER, np.float32)
    square, total, silent, sure, off, shift_first, middle_x, middle_y, deep = np.zeros((9, n), np.float32)
    allow = exchange.arrived / np.maximum(exchange.allowed, 1.0)
    for j in range(k):
        weight = exchange.weight[pairs.row, j].astype(np.float32)
        came = sent[:, j] * weight
        theirs = np.where(sent[:, j], confidence[pairs.peer[:, j]], np.float32(NO_PEER))
        x, y = pairs.shift_m[:, j, 0], pairs.shift_m[:, j, 1]
        away = np.sqrt(x * x + y * y)
        best = theirs > first
        shift_first = np.where(best, away, shift_first)
        second = np.maximum(second, np.minimum(theirs, first))
        first = np.maximum(first, theirs)
        square += came * came
        total += came
        sure += came * theirs
        off += came * away
        room = np.log(np.maximum(allow[pairs.row, j], 1e-4)) - np.log(np.maximum(rank[:, j], 1e-4))
        deep += came * np.clip(room, 0.0, 6.0).astype(np.float32)
        middle_x += came * x
        middle_y += came * y
        silent += np.where(zeros & (pairs.peer[:, j] >= 0), weight - came, np.float32(0.0))
    count = np.maximum(total, np.float32(1e-6))
    many = total * total / np.maximum(square, np.float32(1e-12))  # as many as so many of equal weight
    mean = np.where(total > 0, sure / count, np.float32(NO_PEER))
    spread = np.sqrt(middle_x * middle_x + middle_y * middle_y) / (1.0 + total)
    part = np.where(exchange.sender >= 0, allow, 0.0).max(axis=1, initial=0.0)
    # how closely cells lie about what was sent: of a region that came whole, as in a whole map
    most = np.log(np.maximum(part * CELLS**2, 1.0)) / 8.0
    own = looks.covariates[pairs.look]
    columns = (
        confidence[pairs.look] if own_confidence is None else own_confidence,
        first,
        second,
        mean,
        many,
        total,
        silent,
        total / (1.0 + total + silent),
        shift_first,
        off / count,
        spread,
        most[pairs.row],
        part[pairs.row],
        deep / count,
        *(own[:, c] for c in _OWN),
    )
    return beside(n, columns)


def lead_of(shares: Sequence[Share]) -> Share | None:
    """The map that takes the place of an ego's own where it has none: the one that counts most."""
    return max((s for s in shares if s.is_map and s.weight > 0.0), key=lambda s: s.weight, default=None)


@dataclass(frozen=True, slots=True)
class Led:
    """Egos without a look of their own: a peer's map takes its place, as far as it was sent."""

    rows: list[int]
    """Of the exchange."""
    maps: FeatureShares
    """Each row's leading map, as sent to the very drone that made it."""

    def came(self, pairs: Pairs, looks: Looks, fleet: CaptureColumns, ranks: NDArray[np.float32]) -> NDArray[np.bool_]:
        """[n] whether the ego's own cell with the car is there; in rows that are not led it is.

        Args:
            ranks: [looks] the fraction of the drone's cells that rank above each car's.
        """
        out = np.ones(len(pairs.row), bool)
        its = pair(self.maps, looks, fleet)
        sent = self.maps.sent(its, ranks[its.peer])[:, 0]
        for k, row in enumerate(self.rows):
            out[pairs.row == row] = sent[its.row == k]
        return out


def received_only(boxes: Boxes, ego: Capture, shares: Sequence[Share]) -> Boxes:
    """The boxes in an ego's square and in a disc that a map was requested of; those of a drone that has no look of its own."""
    asked = np.zeros(len(boxes), bool)
    for s in shares:
        if s.is_map and s.weight > 0.0:
            x, y, radius = (0.0, 0.0, np.inf) if s.roi is None or s.representation == "raw" else s.roi
            asked |= (boxes.xy_m[:, 0] - x) ** 2 + (boxes.xy_m[:, 1] - y) ** 2 <= radius**2
    return boxes.take(asked & in_square(boxes.xy_m, [ego.est_pose])[:, 0])


def mean_shift(
    pairs: Pairs, exchange: FeatureShares, sent: NDArray[np.bool_], here: Ints | slice = _ALL
) -> NDArray[np.float32]:
    """How far off what was sent of each car lies, [n, 2] m of the ego's frame, by the shares' weights; or of some cars alone."""
    weight = (exchange.weight[pairs.row[here]] * sent[here]).astype(np.float32)
    total = np.maximum(weight.sum(axis=1), 1e-6)
    off = np.zeros((len(weight), 2), np.float32)
    for j in range(weight.shape[1]):  # few slots: summing over so short an axis takes several times as long
        off += pairs.shift_m[here, j] * weight[:, j, None]
    return np.asarray(off / total[:, None], np.float32)


def alarm_covariates(
    exchange: FeatureShares, looks: Looks, fleet: CaptureColumns, zeros: NDArray[np.bool_], scene: Scene
) -> NDArray[np.float32]:
    """What the number of false alarms depends on, [m, 18] float32 as `ALARM_COVARIATES`: cars in the square, the town and its
    light, how much of how many maps was sent, whether the drone flies square to the streets, what part of the maps was requested,
     how many cars move, how old the maps are, and both multiplied: a moving car has a second box where an older map shows
    it."""
    m = len(exchange.ego)
    cars = np.diff(looks.first)[exchange.ego]
    shares = (exchange.sender >= 0).sum(axis=1)
    received = exchange.arrived.sum(axis=1) / CELLS**2
    silent = np.where(zeros, shares - received, 0.0)
    seams = np.where(zeros, 0.0, np.sqrt(np.clip(received, 0, 1) * np.clip(shares - received, 0, 4)))
    plenty = np.where(shares > 0, np.log10(np.maximum(received, 1e-3)), 0.0)
    shade = (1.0 - scene.overcast) / np.tan(np.radians(scene.sun_elevation_deg))
    some, there = np.maximum(shares, 1), exchange.sender >= 0
    aimed = np.where(shares > 0, np.where(there, exchange.allowed, 0.0).sum(axis=1) / (some * CELLS**2), 1.0)
    age_s = np.where(there, fleet.t_s[exchange.ego, None] - fleet.t_s[exchange.sender], 0.0).sum(axis=1) / some
    moves = np.concatenate([np.zeros(1), np.cumsum(looks.covariates[:, _MOVING], dtype=np.float64)])
    moving = np.diff(moves[looks.first])[exchange.ego] / 10.0
    columns = (
        np.log1p(cars) - 3.6,
        scene.brightness - 1.0,
        shade,
        received / 4.0,
        silent / 4.0,
        seams,
        shares / 4.0,
        plenty,
        scene.building_density - 0.6,
        scene.tree_density - 0.5,
        *(scene.style == name for name in _STYLES),
        square(fleet.yaw_rad[exchange.ego]),
        aimed,
        moving,
        age_s / 0.2,
        moving * age_s / 0.2,
    )
    return beside(m, columns)


def cell_of(xy_m: Floats) -> tuple[Ints, Ints]:
    """Row and column of the cells about a place of the sender's frame: the two by two that are nearest, [n, 4] each."""
    at = (xy_m + FULL.half_extent_m) / FULL.cell_m - 0.5
    low = np.floor(at).astype(np.intp)
    row = np.clip(low[:, 0, None] + np.array([0, 0, 1, 1]), 0, CELLS - 1)
    column = np.clip(low[:, 1, None] + np.array([0, 1, 0, 1]), 0, CELLS - 1)
    return row, column
