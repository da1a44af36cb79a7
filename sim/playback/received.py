"""What peers sent to each drone, on the ground of the scene: the cells of feature maps, hatched in the sender's colour.

A payload's cells follow from its budget ρ, its region and its sender's pose. Where the budget ranks the cells by the
detector's own confidence, the record does not hold which ones won: all that stood to choice are hatched then. Of a
payload that arrived in part (tiles), neither is it held which cells are missing: its rows are as much shorter, its
square as much smaller, that the area shown is the share that came. The
pose is the true one of the capture's frame; the sender used its own estimate, a metre or so away.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr

from sortie.fleet.flight.frames import yaw_rad
from sortie.perception.budget import CELL_M, roi_mask
from sortie.perception.geometry import CELLS
from sortie.scenarios.disc import Disc
from sortie.scenarios.frames import instant
from sortie.scenarios.representation import CELL_NAMES
from sortie.sim.playback import canvas as c
from sortie.sim.playback.canvas import Canvas
from sortie.sim.results import palette
from sortie.sim.results.palette import Floats

STEP_S = 0.5
"""The hatching is drawn anew so often."""
HELD_S = 1.0
"""And shows what arrived at most this long before."""
LANES = 4
"""Hatches of so many senders lie side by side in one cell."""
MAX_DRONES = 12
"""Larger fleets have too many pairs to draw."""
HEIGHT_M = 0.5

Link = tuple[int, int]
Pose = tuple[float, float, float]
_COLUMNS = (
    "t_done_s",
    "t_sent_s",
    "captured_s",
    "drone",
    "peer",
    "representation",
    "status",
    "payload_bytes",
    "arrived_bytes",
)


@dataclass(frozen=True, slots=True)
class DrawnPayload:
    """A feature payload that reached its receiver."""

    t_s: float
    captured_s: float
    region: Disc | None
    share: float = 1.0
    """Of its bytes that arrived; below 1 where tiles were lost."""


class ReceivedCells:
    """Draws what was received in one sortie; `begin` once, then `add` with the tables in order of time."""

    def __init__(self, canvas: Canvas, n: int) -> None:
        self._canvas, self._n = canvas, n
        self._next_s = STEP_S
        self._regions: dict[Link, list[tuple[float, Disc | None]]] = defaultdict(list)
        self._arrivals: dict[Link, deque[DrawnPayload]] = defaultdict(deque)
        self._pose_t_s: Floats = np.zeros(0)
        self._poses: Floats = np.zeros((0, n, 3))
        self._shown: set[str] = set()

    def begin(self) -> None:
        """Say how each sender's cells look."""
        for ego, peer in self._links():
            colour, path = palette.drone_colour(peer), f"world/received/{ego}/{peer}"
            self._canvas.static(f"{path}/cells", rr.Boxes3D.from_fields(colors=[colour], fill_mode="solid"))
            self._canvas.static(f"{path}/whole_map", rr.LineStrips3D.from_fields(colors=[colour], radii=[-1.2]))

    def _links(self) -> list[Link]:
        drones = range(self._n) if self._n <= MAX_DRONES else range(0)
        return [(ego, peer) for ego in drones for peer in drones if ego != peer]

    def add(self, known_s: float, t_s: Floats, position: Floats, attitude: Floats, new: Mapping[str, pa.Table]) -> None:
        """Draw the half seconds up to `known_s`, by when all that arrived before is in `transmissions`."""
        poses = np.concatenate([position[..., :2], yaw_rad(attitude)[..., None]], axis=-1)
        self._pose_t_s = np.concatenate([self._pose_t_s, t_s])
        self._poses = np.concatenate([self._poses, poses])
        self._note_regions(new["directives"])
        self._note_arrivals(new["transmissions"])
        steps = []
        while instant(self._next_s) <= instant(known_s):
            steps.append(self._next_s)
            self._next_s += STEP_S
        for ego, peer in self._links():
            self._draw(ego, peer, steps)
        keep = self._pose_t_s > known_s - 5.0
        self._pose_t_s, self._poses = self._pose_t_s[keep], self._poses[keep]

    def _note_regions(self, directives: pa.Table) -> None:
        names = ("t_s", "drone", "peer", "roi_x_m", "roi_y_m", "roi_radius_m")
        for t_s, drone, peer, x, y, radius in zip(*(directives[k].to_pylist() for k in names), strict=True):
            self._regions[drone, peer].append((t_s, None if radius != radius else Disc(x, y, radius)))

    def _note_arrivals(self, transmissions: pa.Table) -> None:
        for done, sent, captured, sender, receiver, what, fate, size, arrived in zip(
            *(transmissions[k].to_pylist() for k in _COLUMNS), strict=True
        ):
            if what in CELL_NAMES and fate in ("delivered", "partial"):
                region = self._region(sender, receiver, sent)
                share = arrived / size if fate == "partial" else 1.0
                self._arrivals[receiver, sender].append(DrawnPayload(done, captured, region, share))

    def _region(self, sender: int, receiver: int, t_s: float) -> Disc | None:
        """The region of the directive in force when a payload was handed to the radio."""
        known = self._regions[sender, receiver]
        k = bisect_right(known, instant(t_s), key=lambda row: instant(row[0]))
        return known[k - 1][1] if k else None

    def _draw(self, ego: int, peer: int, steps: list[float]) -> None:
        waiting, path = self._arrivals[ego, peer], f"world/received/{ego}/{peer}"
        regions: list[Floats] = []
        squares: list[Floats] = []
        latest: DrawnPayload | None = None
        for step_s in steps:
            while waiting and waiting[0].t_s < step_s:
                latest = waiting.popleft()
            if latest is not None and latest.t_s < step_s - HELD_S:
                latest = None
            runs, square = np.zeros((0, 5)), np.zeros((0, 5, 3))
            if latest is not None:
                x, y, yaw = self._pose(peer, latest.captured_s)
                if latest.region is None:
                    square = _square(x, y, yaw, peer, latest.share)[None]
                else:
                    runs = hatch(latest.region, (x, y, yaw), peer % LANES)
                    runs[:, 2] *= latest.share
            regions.append(runs)
            squares.append(square)
        if latest is not None:
            waiting.appendleft(latest)
        t_s, rows, counts = self._news(f"{path}/cells", steps, regions)
        half = [np.full(len(rows), CELL_M / 2 / LANES * 0.8), rows[:, 2], np.full(len(rows), 0.05)]
        boxes = rr.Boxes3D.columns(
            centers=np.column_stack([rows[:, :2], np.full(len(rows), HEIGHT_M)]),
            half_sizes=np.column_stack(half),
            quaternions=c.about_z(rows[:, 3]),
        )
        self._canvas.columns(f"{path}/cells", t_s, boxes.partition(counts))
        t_s, strips, counts = self._news(f"{path}/whole_map", steps, squares)
        self._canvas.columns(f"{path}/whole_map", t_s, rr.LineStrips3D.columns(strips=list(strips)).partition(counts))

    def _news(self, path: str, steps: list[float], shapes: list[Floats]) -> tuple[Floats, Floats, list[int]]:
        """The steps at which there is something to show or something to wipe out, all shapes, and how many each has."""
        t_s, told, counts = [], [], []
        for step_s, several in zip(steps, shapes, strict=True):
            if len(several) or path in self._shown:
                t_s.append(step_s)
                told.append(several)
                counts.append(len(several))
            (self._shown.add if len(several) else self._shown.discard)(path)
        return np.array(t_s), np.concatenate(told or [np.zeros((0, 5))]), counts

    def _pose(self, drone: int, t_s: float) -> Pose:
        k = bisect_right(self._pose_t_s, instant(t_s), key=instant) - 1
        x, y, yaw = self._poses[max(k, 0), drone].tolist()
        return x, y, yaw


def hatch(region: Disc, pose: Pose, lane: int) -> Floats:
    """Rows of a sender's cells in a region [rows, 5]: centre x, y, half length, yaw, and how many cells; ENU, metres.

    Args:
        region: x, y, radius of the disc.
        pose: the sender's x, y, yaw, rad.
        lane: which strip of its cells a sender hatches, 0 … `LANES` − 1.
    """
    mask = roi_mask(region, *pose)
    i = np.flatnonzero(mask.any(axis=1))
    first, last = mask[i].argmax(axis=1), CELLS - 1 - mask[i][:, ::-1].argmax(axis=1)
    forward = (i + (lane + 0.5) / LANES - CELLS / 2) * CELL_M
    left = ((first + last + 1) / 2 - CELLS / 2) * CELL_M
    x, y, yaw = pose
    count = last - first + 1
    return np.column_stack(
        [
            x + np.cos(yaw) * forward - np.sin(yaw) * left,
            y + np.sin(yaw) * forward + np.cos(yaw) * left,
            count * CELL_M / 2,
            np.full(len(i), yaw),
            count,
        ]
    )


def _square(x: float, y: float, yaw: float, lane: int, share: float) -> Floats:
    """The outline of a sender's whole map [5, 3], of a share of its area; several senders' lie inside one another."""
    half = CELLS * CELL_M / 2 * share**0.5 - 1.2 * lane
    corners = half * np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)], float)
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return np.column_stack([corners @ turn + (x, y), np.full(5, HEIGHT_M)])
