"""Links in a playback: arrows as wide as their traffic and as green as their goodput, broken ones crossed; and a matrix.

As in `sortie.sim.playback.scene`: tables come whole or by whole seconds, and a row at time t shows what was known before t.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.link_state import is_tried
from sortie.sim.playback import canvas as c
from sortie.sim.playback.canvas import SPAN_M, Canvas
from sortie.sim.results import palette
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.palette import Floats

MANY_DRONES = 8
"""In fleets above this, links that carry nothing are left out."""
BROKEN_MBPS = 1.0
"""A link that was measured or is silent, and is below this now, is crossed out, also while nothing is sent on it."""
CROSS_M = 1.3
_DIAGONALS = [np.array(d) * CROSS_M for d in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1))]
_CROSS = np.stack([[-d, d] for d in _DIAGONALS])
"""The four diagonals of a cube [strip, end, 3]: a cross from wherever one looks."""


class LinkArrows:
    """Draws the links of one sortie; `begin` once, then `add` with the tables in order of time."""

    def __init__(self, canvas: Canvas, n: int, rate_hz: float) -> None:
        self._canvas, self._n = canvas, n
        pairs = np.argwhere(~np.eye(n, dtype=bool))
        self._senders, self._receivers = pairs[:, 0], pairs[:, 1]
        self._traffic = LinkTraffic(n, rate_hz)
        self._crossed: list[tuple[int, int]] = []

    def begin(self) -> None:
        """Say how crosses look."""
        if self._n > 1:
            self._canvas.static("world/broken", rr.LineStrips3D.from_fields(colors=[palette.BROKEN], radii=[-2.2]))

    def add(self, t_s: Floats, position: Floats, airborne: NDArray[np.bool_], new: Mapping[str, pa.Table]) -> None:
        """Draw the frames at `t_s` [T] from positions [T, N, 3], `descriptors` and `transmissions`."""
        if not 2 <= self._n <= LISTED_IDS:  # of larger fleets nobody could read the links, nor hold them
            return
        goodput, mbps = self._traffic.add(t_s, new["descriptors"], new["transmissions"])
        self._broken(t_s, position, airborne, goodput)
        i, j = self._senders, self._receivers
        begin, end = position[:, i], position[:, j]
        way = end - begin
        length = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-6)
        ahead = way / length
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        # Both directions of a link side by side, as lanes, and clear of the drones.
        begin = begin + 0.9 * right + np.minimum(SPAN_M * 0.7, 0.2 * length) * ahead
        end = end + 0.9 * right - np.minimum(SPAN_M * 0.7, 0.2 * length) * ahead
        busy = mbps[:, i, j] > 0
        shown = airborne[:, i] & airborne[:, j]
        if self._n > MANY_DRONES:
            shown = shown & busy
        colours = np.where(busy[..., None], palette.goodput_colours(goodput[:, i, j]), np.array(palette.IDLE, np.uint8))
        width = np.where(busy, 1.5 + 1.0 * np.log2(1.0 + mbps[:, i, j]), 0.75)
        links = rr.Arrows3D.columns(
            origins=begin[shown], vectors=(end - begin)[shown], colors=c.packed(colours[shown]), radii=-width[shown]
        )
        self._canvas.columns("world/links", t_s, links.partition(shown.sum(axis=1)))

    def _broken(self, t_s: Floats, position: Floats, airborne: NDArray[np.bool_], goodput: Floats) -> None:
        """Cross out each pair of drones between which a link was measured and is all but gone."""
        broken = is_tried(goodput) & (goodput < BROKEN_MBPS)
        i, j = np.triu_indices(self._n, 1)
        crossed = (broken | broken.swapaxes(1, 2))[:, i, j] & airborne[:, i] & airborne[:, j]
        middle = (position[:, i] + position[:, j]) / 2
        for k, frame in enumerate(crossed):
            now = list(zip(i[frame].tolist(), j[frame].tolist(), strict=True))
            if now or self._crossed:  # nothing is told while nothing is broken
                strips = (middle[k, frame][:, None, None, :] + _CROSS).reshape(-1, 2, 3)
                columns = rr.LineStrips3D.columns(strips=strips).partition([len(strips)])
                self._canvas.columns("world/broken", t_s[k : k + 1], columns)
            self._crossed = now


class LinkMatrix:
    """Which share of each drone's descriptors each other heard lately, as a picture: senders down, receivers across."""

    def __init__(self, canvas: Canvas, n: int) -> None:
        self._canvas, self._n = canvas, n
        self._shown = 2 <= n <= LISTED_IDS

    def begin(self) -> None:
        """Number the rows and columns."""
        if not self._shown:
            return
        size = rr.encodings.ImageFormat(self._n, self._n, color_model="RGBA", channel_datatype="U8")
        self._canvas.static("links/heard", rr.Image.from_fields(format=size))
        middle, edge = np.arange(self._n) + 0.5, np.full(self._n, -0.6)
        drones = range(self._n)
        numbers = rr.Points2D(
            np.concatenate([np.column_stack([edge, middle]), np.column_stack([middle, edge])]),
            labels=[str(i) for i in drones] * 2,
            colors=[palette.drone_colour(i) for i in drones] * 2,
            radii=-3.0,
            show_labels=True,
        )
        self._canvas.static("links/numbers", numbers)

    def add(self, links: pa.Table) -> None:
        """Draw the moments of new rows of the table `links`."""
        if not self._shown or not links.num_rows:
            return
        t_s, sender, receiver, delivered = (
            links[name].to_numpy() for name in ("t_s", "sender", "receiver", "delivered")
        )
        moments, which = np.unique(t_s, return_inverse=True)
        share = np.full((len(moments), self._n, self._n), np.nan)
        share[which, sender, receiver] = delivered
        pictures = [picture.tobytes() for picture in palette.share_colours(share)]
        self._canvas.columns("links/heard", moments, rr.Image.columns(buffer=pictures))
