"""A block of frames of a large fleet: the links within earshot and what is drawn for them, in single precision.

The work grows with drones × neighbours; links out of earshot cost nothing. Links between the first drones keep the
numbers that they have in a small fleet, so that one more drone changes none of the others'.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.radio.channel.antenna import Antennas
from sortie.radio.channel.draws import StreamShadowing, drone_keys, link_keys, normal_table
from sortie.radio.channel.earshot import IntArray, LinkList, both_ways, near_pairs
from sortie.radio.channel.pathloss import path_loss_db
from sortie.radio.channel.shadowing import ShadowField, keep
from sortie.radio.settings import AirSettings

Array = NDArray[np.floating[Any]]

EPOCH = 32
"""Frames for which the list of links stands."""


class BlockStart(NamedTuple):
    """What a block of frames begins with."""

    links: LinkList
    gain_db: Array
    """[frames, P] of pairs: path, antennas and shadowing; a link is the same in both directions."""
    shadow_db: Array
    """[frames, P]."""


class Crowd:
    """Blocks of `EPOCH` frames, one after another; arguments as for `Channel`; `always` as in `near_pairs`."""

    def __init__(
        self,
        settings: AirSettings,
        n: int,
        early: StreamShadowing,
        field: ShadowField | None,
        *,
        n_early: int,
        earshot_m: float,
        always: Sequence[tuple[int, int]],
        seed: int,
        replication: int,
        frame_s: float,
    ) -> None:
        self._settings, self._n, self._n_early = settings, n, n_early
        self._antennas = Antennas(settings.antennas(n))
        self._early, self._field, self._earshot_m, self._always = early, field, earshot_m, always
        self._keys = drone_keys(seed, replication, n)
        self._frame_s = frame_s
        self._keep = keep(frame_s, settings.shadowing_time_s)
        # where the shadowing stood at the end of the one before
        self._last_pairs: IntArray = np.empty(0, np.int64)
        self._last_db: Array = np.empty(0, np.float32)

    def block(self, frame: int, positions_m: Array, up: Array | None) -> BlockStart:
        """The frames from `frame` on, of [frames, N, 3] positions (and vectors along the airframes' z axes)."""
        p = positions_m.astype(np.float32)
        low, high, distance = near_pairs(p, self._earshot_m, self._always)
        loss_db = path_loss_db(self._settings, distance, p[:, low, 2], p[:, high, 2])
        if not self._antennas.lossless:
            loss_db = loss_db + self._antennas_db(p, low, high, distance, up)
        shadow_db: Array
        if self._field is not None:
            at = (self._field.between(q, (frame + t) * self._frame_s) for t, q in enumerate(positions_m))
            shadow_db = np.stack([square[low, high] for square in at])
        else:
            shadow_db = self._shadowing(low, high, frame, len(p))
            early = int(np.searchsorted(high, self._n_early))  # pairs are by higher id
            shadow_db[:, :early] = self._early.block(len(p))[:, low[:early], high[:early]]
        return BlockStart(both_ways(self._n, low, high), shadow_db - loss_db, shadow_db)

    def _antennas_db(self, p: Array, low: IntArray, high: IntArray, distance: Array, up: Array | None) -> Array:
        along = (p[:, low] - p[:, high]) / np.maximum(distance, 1e-6)[..., None]
        ends = (low, high)
        cosines = (along[..., 2] if up is None else np.einsum("tpk,tpk->tp", along, up[:, end]) for end in ends)
        return np.asarray(sum(self._antennas.loss_db(end, cosine) for end, cosine in zip(ends, cosines, strict=True)))

    def _shadowing(self, low: IntArray, high: IntArray, frame: int, flown: int) -> Array:
        """[flown, P] dB; a pair that has come into earshot begins anew."""
        pairs = (high << 32) + low  # rising, and independent of how many drones there are
        begin_db = np.full(len(pairs), np.nan, np.float32)
        if len(self._last_pairs):
            where = np.minimum(np.searchsorted(self._last_pairs, pairs), len(self._last_pairs) - 1)
            known = self._last_pairs[where] == pairs
            begin_db[known] = self._last_db[where[known]]
        from sortie.radio.channel import crowd_loops

        sigma_db, kept = self._settings.shadowing_sigma_db, self._keep
        single = map(np.float32, (sigma_db, sqrt(1.0 - kept**2) * sigma_db, kept))
        shadow_db = np.empty((flown, len(pairs)), np.float32)
        crowd_loops.shadowing(link_keys(self._keys, low, high), frame, normal_table(), *single, begin_db, shadow_db)
        self._last_pairs, self._last_db = pairs, shadow_db[-1].copy()
        return shadow_db
