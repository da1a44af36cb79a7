"""Links in the scene of a playback: arrows as wide as their traffic and as green as their goodput, broken ones crossed.

As in `sortie.sim.playback.scene`: tables come whole or by whole seconds, and a row at time t shows what was known before t.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from sortie.scenarios.link_state import is_tried
from sortie.sim.playback import canvas as c
from sortie.sim.playback.canvas import SPAN_M, Canvas, Floats

RECENT_S = 1.0
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
        self._canvas, self._n, self._rate_hz = canvas, n, rate_hz
        pairs = np.argwhere(~np.eye(n, dtype=bool))
        self._senders, self._receivers = pairs[:, 0], pairs[:, 1]
        self._frames = 0
        self._goodput: Floats = np.zeros((n, n))
        self._crossed: list[tuple[int, int]] = []
        self._recent: Floats = np.zeros((0, 4))

    def begin(self) -> None:
        """Say how crosses look."""
        if self._n > 1:
            self._canvas.static("world/broken", rr.LineStrips3D.from_fields(colors=[c.BROKEN], radii=[-2.2]))

    def add(self, t_s: Floats, position: Floats, airborne: NDArray[np.bool_], new: Mapping[str, pa.Table]) -> None:
        """Draw the frames at `t_s` [T] from positions [T, N, 3], `descriptors` and `transmissions`."""
        self._frames += len(t_s)
        if self._n < 2:
            return
        goodput = self._goodput_at(t_s, new["descriptors"])
        mbps = self._recent_mbps(t_s, new["transmissions"])
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
        colours = np.where(busy[..., None], c.goodput_colours(goodput[:, i, j]), np.array(c.IDLE, np.uint8))
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

    def _goodput_at(self, t_s: Floats, descriptors: pa.Table) -> Floats:
        """Goodput [frame, sender, receiver] in each sender's latest descriptor before the frame, Mb/s."""
        n = self._n
        out = np.zeros((len(t_s), n, n))
        sent_s, sender = descriptors["t_s"].to_numpy(), descriptors["drone"].to_numpy()
        values = descriptors["goodput_mbps"].combine_chunks().flatten().to_numpy().reshape(-1, n - 1)
        for i in range(n):
            mine = sender == i
            peers = [k for k in range(n) if k != i]
            known = np.concatenate([self._goodput[i, peers][None], values[mine]])
            out[:, i, peers] = known[np.searchsorted(sent_s[mine], t_s, side="left")]
            self._goodput[i, peers] = known[-1]
        return out

    def _recent_mbps(self, t_s: Floats, transmissions: pa.Table) -> Floats:
        """Traffic [frame, sender, receiver] handed to the radio and settled in the second before the frame, Mb/s.

        The second is as many whole frames as come nearest to it, one at least.
        """
        n, window = self._n, max(1, round(RECENT_S * self._rate_hz))
        names = ("t_done_s", "drone", "peer", "payload_bytes")
        rows = np.column_stack([transmissions[k].to_numpy().astype(float) for k in names])
        rows = rows[~np.isnan(rows[:, 0])]
        rows = np.concatenate([self._recent, rows])
        out = np.zeros((len(t_s), n, n))
        if len(t_s) == 0:
            self._recent = rows
            return out
        first = self._frames - len(t_s) - window
        frame = np.floor(rows[:, 0] * self._rate_hz + 1e-6).astype(int) - first
        bins = np.zeros((len(t_s) + window, n, n))
        now = (frame >= 0) & (frame < len(bins))
        np.add.at(bins, (frame[now], rows[now, 1].astype(int), rows[now, 2].astype(int)), rows[now, 3])
        total = np.cumsum(np.concatenate([np.zeros((1, n, n)), bins]), axis=0)
        self._recent = rows[frame >= len(t_s)]
        return np.asarray((total[window:-1] - total[: len(t_s)]) * 8e-6 * self._rate_hz / window)
