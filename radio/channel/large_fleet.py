"""A block of frames of a large fleet: the links within earshot and what is drawn for them, in single precision.

The work grows with drones × neighbours; links out of earshot cost nothing, and fades and losses are drawn for those
links alone whose frames may be lost. Links between the first drones keep the
numbers that they have in a small fleet, so that one more drone changes none of the others'.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.radio.channel.antenna import Antennas
from sortie.radio.channel.draws import (
    StreamDraws,
    drone_keys,
    fade_table_db,
    levels,
    link_keys,
    normal_table,
    numbers,
    uniforms,
)
from sortie.radio.channel.earshot import IntArray, LinkList, both_ways, near_pairs
from sortie.radio.channel.pathloss import path_loss_db
from sortie.radio.channel.shadowing import ShadowField, gauss_markov, keep
from sortie.radio.settings import AirSettings

Array = NDArray[np.floating[Any]]

EPOCH = 32
"""Frames for which the list of links stands."""


class BlockStart(NamedTuple):
    """What a block of frames begins with."""

    links: LinkList
    gain_db: Array
    """[frames, L]: path, antennas and shadowing."""
    shadow_db: Array
    """[frames, L]."""


class Crowd:
    """Blocks of `EPOCH` frames, one after another; arguments as for `Channel`."""

    def __init__(
        self,
        settings: AirSettings,
        n: int,
        early: StreamDraws,
        field: ShadowField | None,
        *,
        n_early: int,
        earshot_m: float,
        seed: int,
        replication: int,
        frame_s: float,
    ) -> None:
        self._settings, self._n, self._n_early = settings, n, n_early
        self._antennas = Antennas(settings.antennas(n))
        self._early, self._field, self._earshot_m = early, field, earshot_m
        self._keys = drone_keys(seed, replication, n)
        self._fades = fade_table_db(settings.rician_k_db)
        self._frame_s = frame_s
        self._keep = keep(frame_s, settings.shadowing_time_s)
        # the block
        self._frame = self._pairs = self._early_count = 0
        self._link_keys = self._keys[:0]
        self._early_fades_db: Array
        self._early_draws: Array
        # where the shadowing stood at the end of the one before
        self._last_pairs: IntArray = np.empty(0, np.int64)
        self._last_db: Array = np.empty(0, np.float32)

    def block(self, frame: int, positions_m: Array, up: Array | None) -> BlockStart:
        """The frames from `frame` on, of [frames, N, 3] positions (and vectors along the airframes' z axes)."""
        p = positions_m.astype(np.float32)
        low, high, distance = near_pairs(p, self._earshot_m)
        loss_db = path_loss_db(self._settings, distance, p[:, low, 2], p[:, high, 2])
        if not self._antennas.lossless:
            loss_db = loss_db + self._antennas_db(p, low, high, distance, up)
        links = both_ways(self._n, low, high)
        self._frame, self._pairs = frame, len(low)
        self._link_keys = link_keys(self._keys, links.sender, links.receiver)
        self._early_count = early = int(np.searchsorted(high, self._n_early))
        n = self._n_early
        places = np.concatenate([low[:early] * n + high[:early], high[:early] * n + low[:early]])
        early_shadow_db, *chance = (x.reshape(len(p), -1) for x in self._early.block(EPOCH, len(p)))
        self._early_fades_db, self._early_draws = (np.take(x, places, axis=1, mode="clip") for x in chance)
        shadow_db: Array
        if self._field is not None:
            at = (self._field.between(q, (frame + t) * self._frame_s) for t, q in enumerate(positions_m))
            shadow_db = np.stack([square[low, high] for square in at])
        else:
            shadow_db = self._shadowing(low, high, len(p))
            shadow_db[:, :early] = np.take(early_shadow_db, places[:early], axis=1, mode="clip")
        gain_db = shadow_db - loss_db
        return BlockStart(links, np.concatenate([gain_db, gain_db], axis=1), np.tile(shadow_db, 2))

    def chance(self, first: int, frames: int, links: IntArray) -> tuple[Array, Array]:
        """Fades in dB and draws, [frames, L'], of some links in the block's frames from `first` on."""
        bits = numbers(self._link_keys[links], self._frame + first, frames)
        fades_db, draws = np.take(self._fades, levels(bits, 0), mode="clip"), uniforms(bits)
        # the first drones' own numbers in their places; their pairs are the first ones
        back = links >= self._pairs
        pair = np.where(back, links - self._pairs, links)
        early = np.flatnonzero(pair < self._early_count)
        if len(early):
            there = pair[early] + self._early_count * back[early]
            rows = slice(first, first + frames)
            fades_db[:, early] = np.take(self._early_fades_db[rows], there, axis=1)
            draws[:, early] = np.take(self._early_draws[rows], there, axis=1)
        return fades_db, draws

    def _antennas_db(self, p: Array, low: IntArray, high: IntArray, distance: Array, up: Array | None) -> Array:
        along = (p[:, low] - p[:, high]) / np.maximum(distance, 1e-6)[..., None]
        ends = (low, high)
        cosines = (along[..., 2] if up is None else np.einsum("tpk,tpk->tp", along, up[:, end]) for end in ends)
        return np.asarray(sum(self._antennas.loss_db(end, cosine) for end, cosine in zip(ends, cosines, strict=True)))

    def _shadowing(self, low: IntArray, high: IntArray, flown: int) -> Array:
        """[flown, P] dB; a pair that has come into earshot begins anew."""
        pairs = (high << 32) + low  # rising, and independent of how many drones there are
        begin_db = np.full(len(pairs), np.nan, np.float32)
        if len(self._last_pairs):
            where = np.minimum(np.searchsorted(self._last_pairs, pairs), len(self._last_pairs) - 1)
            known = self._last_pairs[where] == pairs
            begin_db[known] = self._last_db[where[known]]
        z = np.take(normal_table(), levels(numbers(self._link_keys[: len(low)], self._frame, flown), 1), mode="clip")
        shadow_db = gauss_markov(z, self._settings.shadowing_sigma_db, self._keep, begin_db)
        self._last_pairs, self._last_db = pairs, shadow_db[-1].copy()
        return shadow_db
