"""Positions to signal-to-noise ratios: path loss, shadowing, fading, noise and jammers.

Random numbers come from one stream per drone and purpose; the stream of drone h draws for its links
to the drones of *lower* id, so that each link has numbers of its own and one more drone changes none
of the others', with N streams and not N².
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, log10, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from radio.rates import REFERENCE_BYTES, S50_DB, SLOPE_PER_DB, group_mcs
from scenarios.schema import Radio
from scenarios.streams import stream

FloatArray = NDArray[np.float64]
Jammer = tuple[Sequence[float], float]
"""Position ENU in metres and power in the channel in dBm."""

_LIGHT_MPS = 299_792_458.0
_BLOCK_NUMBERS = 1 << 18


def free_space_loss_db(distance_m: ArrayLike, carrier_ghz: float) -> FloatArray:
    """Friis: 20 log10(4π d f / c), dB."""
    return np.asarray(20.0 * np.log10(4.0 * pi * np.asarray(distance_m, dtype=float) * carrier_ghz * 1e9 / _LIGHT_MPS))


def path_loss_db(distance_m: ArrayLike, carrier_ghz: float, exponent: float) -> FloatArray:
    """Log-distance loss: free space at 1 m, then 10 · exponent · log10(d); nearer than 1 m counts as 1 m."""
    d = np.maximum(np.asarray(distance_m, dtype=float), 1.0)
    return np.asarray(float(free_space_loss_db(1.0, carrier_ghz)) + 10.0 * exponent * np.log10(d))


def noise_dbm(bandwidth_mhz: float, noise_figure_db: float) -> float:
    """Thermal noise at 290 K and the receiver's figure: −174 + 10 log10 B + NF, dBm."""
    return -174.0 + 10.0 * log10(bandwidth_mhz * 1e6) + noise_figure_db


def rician_gain(x: FloatArray, y: FloatArray, k_db: float) -> FloatArray:
    """Power gain of mean 1 from two standard normals: a fixed path of K/(K + 1) and a scattered one of 1/(K + 1)."""
    k = 10.0 ** (k_db / 10.0)
    scatter = sqrt(0.5 / (k + 1.0))
    return np.asarray((sqrt(k / (k + 1.0)) + scatter * x) ** 2 + (scatter * y) ** 2)


def _reach_at_1(luck: FloatArray) -> FloatArray:
    """How long a frame may be, bytes, to arrive with this luck where −log s (see `Channel._reach`) is 1."""
    return np.asarray(-REFERENCE_BYTES * np.log1p(-luck))


class Channel:
    """The SNR of every link, frame by frame.

    `snr_db[i, j]` is the mean (over small-scale fading) SNR at receiver j of sender i in the whole channel,
    NaN on the diagonal. `group_reach_bytes[i, j]` is the longest group-addressed frame of i that j receives
    in this frame, its fade and its luck drawn; NaN on the diagonal, so that no drone hears itself.

    What follows from the flight alone is worked out for a block of frames in one pass; a frame in which nothing
    else interferes is only looked up.

    Args:
        config: the scenario's radio section.
        positions_m: [T, N, 3], ENU: where each drone will be in each frame; ids are 0 … N − 1.
        seed, replication: as in `scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.

    Raises:
        ValueError: if the shape is wrong or a position is not finite.
    """

    def __init__(self, config: Radio, positions_m: ArrayLike, seed: int, replication: int, frame_s: float) -> None:
        self._positions_m = p = np.asarray(positions_m, dtype=float)
        if p.ndim != 3 or p.shape[1] < 1 or p.shape[2] != 3:
            raise ValueError(f"positions_m has shape {p.shape}, must be (frames, drones, 3)")
        if not np.isfinite(p).all():
            raise ValueError("positions_m holds a value that is not finite")
        if not frame_s > 0:
            raise ValueError(f"frame_s is {frame_s!r}, must be > 0")
        self.config = config
        self.n = n_drones = p.shape[1]
        self.frame = -1
        self.snr_db: FloatArray = np.full((n_drones, n_drones), np.nan)
        self.fade_db: FloatArray = np.zeros((n_drones, n_drones))
        self.group_reach_bytes: FloatArray = np.full((n_drones, n_drones), np.nan)
        self.shadow_db: FloatArray = np.zeros((n_drones, n_drones))
        self.noise_dbm = noise_dbm(config.bandwidth_mhz, config.noise_figure_db)
        # group frames go out in the primary 20 MHz with the whole power, so over less noise
        self._group_gain_db = 10.0 * log10(config.bandwidth_mhz / 20.0)
        mcs = group_mcs(config.group_rate_mbps)
        self._group_s50_db, self._group_slope = S50_DB[mcs], SLOPE_PER_DB[mcs]
        self._loss_1m_db = float(free_space_loss_db(1.0, config.carrier_ghz))
        self._keep = exp(-frame_s / config.shadowing_time_s)
        self._renew = sqrt(1.0 - self._keep**2)
        ids = range(n_drones)
        self._shadow_streams = [stream(seed, replication, h, "shadowing") for h in ids]
        self._fade_streams = [stream(seed, replication, h, "fading") for h in ids]
        self._luck_streams = [stream(seed, replication, h, "group loss") for h in ids]
        self._block = max(1, min(1024, _BLOCK_NUMBERS // (n_drones * n_drones)))
        # the block, [frames, N, N] each
        self._snr_db: FloatArray
        self._shadow_db: FloatArray = np.zeros((1, n_drones, n_drones))
        self._fades: FloatArray
        self._luck: FloatArray
        self._reach_at_1: FloatArray
        self._reach_bytes: FloatArray

    def advance(self, extra_loss_db: ArrayLike | None = None, jammers: Sequence[Jammer] = ()) -> FloatArray:
        """Move on by one frame.

        Args:
            extra_loss_db: [N, N], sender by receiver, added to the path loss; None is none.
            jammers: position (ENU, m) and power (dBm) of each; what a receiver gets of it adds to its noise.

        Returns:
            `snr_db`, [N, N].

        Raises:
            IndexError: the flight is over.
            ValueError: if a shape is wrong.
        """
        if self.frame + 1 >= len(self._positions_m):
            raise IndexError(f"the flight has {len(self._positions_m)} frames")
        self.frame += 1
        row = self.frame % self._block
        if row == 0:
            self._refill()
        self.shadow_db = self._shadow_db[row]
        self.fade_db = self._fades[row]
        self.snr_db, self.group_reach_bytes = self._snr_db[row], self._reach_bytes[row]
        if extra_loss_db is None and not jammers:
            return self.snr_db
        snr: FloatArray = self.snr_db.copy()
        if extra_loss_db is not None:
            extra = np.asarray(extra_loss_db, dtype=float)
            if extra.shape != snr.shape:
                raise ValueError(f"extra_loss_db has shape {extra.shape}, must be {snr.shape}")
            snr -= extra
        if jammers:
            snr -= self._noise_rise_db(self._positions_m[self.frame], jammers)
        faded_db = snr + self.fade_db
        np.fill_diagonal(faded_db, 0.0)  # whose reach is not a number anyway
        self.snr_db, self.group_reach_bytes = snr, self._reach(faded_db, self._reach_at_1[row])
        return snr

    def reach_again(self, sender: int, times: int) -> FloatArray:
        """`group_reach_bytes[sender]` for a further frame of the same sender within the frame: same fade, new luck.

        The luck is the frame's own shifted by multiples of the golden ratio, modulo 1.
        """
        luck = (self._luck[self.frame % self._block, sender] + times * 0.6180339887498949) % 1.0
        faded_db = self.snr_db[sender] + self.fade_db[sender]
        faded_db[sender] = 0.0
        luck[sender] = np.nan
        return self._reach(faded_db, _reach_at_1(luck))

    def _reach(self, faded_db: FloatArray, reach_at_1: FloatArray) -> FloatArray:
        # a frame of L bytes arrives with probability s^(L / 1458), s for the reference length: so while u < s^(L / 1458)
        margin = faded_db + (self._group_gain_db - self._group_s50_db)
        minus_log_s = np.logaddexp(0.0, -self._group_slope * margin)
        return np.asarray(reach_at_1 / np.maximum(minus_log_s, 1e-300))

    def _noise_rise_db(self, positions_m: FloatArray, jammers: Sequence[Jammer]) -> FloatArray:
        """[N]: how far the jammers lift each receiver's noise."""
        c = self.config
        total_mw = np.full(self.n, 10.0 ** (self.noise_dbm / 10.0))
        for where, power_dbm in jammers:
            d = np.sqrt(((positions_m - np.asarray(where, dtype=float)) ** 2).sum(axis=1))
            total_mw += 10.0 ** ((power_dbm - path_loss_db(d, c.carrier_ghz, c.path_loss_exponent)) / 10.0)
        return np.asarray(10.0 * np.log10(total_mw) - self.noise_dbm)

    def _refill(self) -> None:
        b, n = self._block, self.n
        shadow_z, x, y = (np.zeros((b, n, n)) for _ in range(3))
        self._luck = np.zeros((b, n, n))
        for h in range(1, n):
            z = self._shadow_streams[h].standard_normal((b, h))
            shadow_z[:, h, :h] = z
            shadow_z[:, :h, h] = z
            self._scatter(x, h, f := self._fade_streams[h].standard_normal((b, 2, 2, h)), 0)
            self._scatter(y, h, f, 1)
            self._scatter(self._luck, h, self._luck_streams[h].random((b, 1, 2, h)), 0)
        self._luck[:, range(n), range(n)] = np.nan  # no drone hears itself
        self._reach_at_1 = _reach_at_1(self._luck)
        self._fades = 10.0 * np.log10(np.maximum(rician_gain(x, y, self.config.rician_k_db), 1e-12))
        self._shadow_db = self._shadowing(shadow_z)
        c, p = self.config, self._positions_m[self.frame : self.frame + b]
        delta = p[:, :, None, :] - p[:, None, :, :]
        distance = np.sqrt(np.einsum("tijk,tijk->tij", delta, delta))
        loss_db = self._loss_1m_db + 10.0 * c.path_loss_exponent * np.log10(np.maximum(distance, 1.0))
        flown = len(p)
        self._snr_db = c.tx_power_dbm - self.noise_dbm - loss_db + self._shadow_db[:flown]
        self._reach_bytes = self._reach(self._snr_db + self._fades[:flown], self._reach_at_1[:flown])
        self._snr_db[:, range(n), range(n)] = np.nan

    def _shadowing(self, z: FloatArray) -> FloatArray:
        """[frames, N, N] dB: the Gauss–Markov process goes on from the block before."""
        sigma_db = self.config.shadowing_sigma_db
        shadow_db, before = np.empty_like(z), self._shadow_db[-1]
        for t, normals in enumerate(z):
            if self.frame + t == 0:
                before = sigma_db * normals
            else:
                before = self._keep * before + self._renew * sigma_db * normals
            shadow_db[t] = before
        return shadow_db

    @staticmethod
    def _scatter(into: FloatArray, h: int, drawn: FloatArray, part: int) -> None:
        into[:, h, :h] = drawn[:, part, 0]  # h sends
        into[:, :h, h] = drawn[:, part, 1]  # h receives


class SampleLuck:
    """Uniform draws for unicast samples, keyed per ordered link and taken by the link's own sample number.

    Each sample gets `ROUNDS` numbers whether it needs them or not, so that what one sample needed (its repair
    rounds) never moves the next one's.
    """

    ROUNDS = 4
    _BLOCK = 64

    def __init__(self, seed: int, replication: int) -> None:
        self._key = (seed, replication)
        self._streams: dict[tuple[int, int], np.random.Generator] = {}
        self._ready: dict[tuple[int, int], list[list[float]]] = {}

    def next(self, sender: int, receiver: int) -> list[float]:
        """The numbers of the link's next sample."""
        link = (sender, receiver)
        ready = self._ready.get(link)
        if ready is None:
            ready = self._ready[link] = []
            self._streams[link] = stream(*self._key, link, "fragment loss")
        if not ready:
            ready.extend(self._streams[link].random((self._BLOCK, self.ROUNDS)).tolist()[::-1])
        return ready.pop()
