"""What each link was measured to carry, and what it carried lately, frame by frame, for everything that draws links."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sortie.scenarios.frames import frames_at
from sortie.scenarios.link_state import is_tried

Floats = NDArray[np.float64]

RECENT_S = 1.0


def mean_goodput(descriptors: pa.Table) -> Floats:
    """[row]: the mean over a descriptor's links that were measured or are silent, Mb/s; NaN where there are none.

    A probed link is left out: its value says that its peer's descriptors arrive, and is no rate.
    """
    lists = descriptors["goodput_mbps"].combine_chunks()
    rows, values = lists.value_parent_indices().to_numpy(), lists.flatten().to_numpy()
    tried = is_tried(values)
    total = np.bincount(rows[tried], values[tried], minlength=len(lists))
    count = np.bincount(rows[tried], minlength=len(lists))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


class LinkTraffic:
    """Takes the tables of a sortie whole, or by whole seconds in order; what a slice needs from before it is kept.

    A frame at time t has what was known before t.
    """

    def __init__(self, n: int, rate_hz: float) -> None:
        """Args: `n` drones, 2 to `LISTED_IDS`, whose descriptors list goodput to all; `rate_hz` frames a second."""
        self._n, self._rate_hz = n, rate_hz
        self._frames = 0
        self._goodput: Floats = np.zeros((n, n))
        self._recent: Floats = np.zeros((0, 4))

    def add(self, t_s: Floats, descriptors: pa.Table, transmissions: pa.Table) -> tuple[Floats, Floats]:
        """Goodput and recent traffic [frame, sender, receiver] of the frames at `t_s`, Mb/s.

        Goodput is that in the sender's latest descriptor (0: never measured). Traffic is what was handed to the radio and
        settled in the second before the frame; the second is as many whole frames as come nearest to it, one at least.
        """
        self._frames += len(t_s)
        return self._goodput_at(t_s, descriptors), self._recent_mbps(t_s, transmissions)

    def _goodput_at(self, t_s: Floats, descriptors: pa.Table) -> Floats:
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
        frame = frames_at(rows[:, 0], 1.0 / self._rate_hz) - first
        bins = np.zeros((len(t_s) + window, n, n))
        now = (frame >= 0) & (frame < len(bins))
        np.add.at(bins, (frame[now], rows[now, 1].astype(int), rows[now, 2].astype(int)), rows[now, 3])
        total = np.cumsum(np.concatenate([np.zeros((1, n, n)), bins]), axis=0)
        self._recent = rows[frame >= len(t_s)]
        return np.asarray((total[window:-1] - total[: len(t_s)]) * 8e-6 * self._rate_hz / window)
