"""Positions to signal-to-noise ratios: path loss, antennas, shadowing, fading, noise and jammers.

Small fleets work out every link, with the random numbers of `sortie.radio.channel.draws.StreamDraws`; large ones the links within
earshot (`sortie.radio.channel.large_fleet`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log10
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.radio.channel.antenna import Antennas
from sortie.radio.channel.draws import StreamDraws, fade_table_db
from sortie.radio.channel.earshot import IntArray, LinkList, all_links
from sortie.radio.channel.large_fleet import EPOCH, Crowd
from sortie.radio.channel.pathloss import path_loss_db, range_m
from sortie.radio.channel.shadowing import ShadowField
from sortie.radio.rates import CURVES, REFERENCE_BYTES, PerCurve, group_curve
from sortie.radio.settings import AirSettings
from sortie.scenarios.streams import stream

FloatArray = NDArray[np.float64]
AnyFloats = NDArray[np.floating[Any]]
"""Large fleets are worked out in single precision."""
Jammer = tuple[Sequence[float], float]
"""Position ENU in metres and power in the channel in dBm."""

SQUARE = 32
"""Fleets of up to so many drones work out every link; larger ones those within earshot."""
OUT_OF_RANGE_DB = -100.0
"""SNR that is reported for a link out of earshot."""
_SURE_PER = 1e-12
"""In large fleets a link on which fewer group frames than this are lost loses none."""
_EARSHOT_SIGMA = 5.0
_BLOCK_NUMBERS = 1 << 18


def noise_dbm(bandwidth_mhz: float, noise_figure_db: float) -> float:
    """Thermal noise at 290 K and the receiver's figure: −174 + 10 log10 B + NF, dBm."""
    return -174.0 + 10.0 * log10(bandwidth_mhz * 1e6) + noise_figure_db


def earshot_m(settings: AirSettings) -> float:
    """The distance beyond which no frame is heard.

    There a link with 5 σ of shadowing (one in 3.5 million) and the highest of 65,536 fades is still 2 dB short of
    half the group frames.
    """
    gain_db = _EARSHOT_SIGMA * settings.shadowing_sigma_db + float(fade_table_db(settings.rician_k_db)[-1])
    group_db = group_curve(settings.group_rate_mbps).snr_db(0.5) - 10.0 * log10(settings.bandwidth_mhz / 20.0)
    needed_db = min(CURVES[0].snr_db(0.5), group_db)
    noise = noise_dbm(settings.bandwidth_mhz, settings.noise_figure_db)
    return range_m(settings, settings.tx_power_dbm - noise + gain_db - needed_db + 2.0)


def _reach_at_1(draws: AnyFloats, curve: PerCurve) -> AnyFloats:
    """How long a frame may be, bytes, to arrive with these draws where −log s (see `Channel._reach`) is the weight."""
    scale = -REFERENCE_BYTES / curve.weight
    if draws.dtype == np.float32:  # in steps of 2⁻²⁴, whose difference from 1 is exact
        return np.asarray(scale * np.log(1.0 - draws))
    return np.asarray(scale * np.log1p(-draws))


class FrameLinks:
    """The mean SNR of the links in one frame; squares and rows are made at their first use."""

    __slots__ = ("_rows", "_square", "links", "snr_db")

    def __init__(self, links: LinkList, snr_db: AnyFloats, rows_db: list[list[float]] | None = None) -> None:
        self.links, self.snr_db = links, snr_db
        self._square: FloatArray | None = None
        self._rows = rows_db

    @property
    def square_db(self) -> FloatArray:
        """[N, N], sender by receiver; NaN on the diagonal."""
        if self._square is None:
            self._square = self.links.square(self.snr_db, OUT_OF_RANGE_DB)
        return self._square

    @property
    def rows_db(self) -> list[list[float]]:
        """The same as lists."""
        if self._rows is None:
            self._rows = self.square_db.tolist()
        return self._rows


class Channel:
    """The SNR of every link, frame by frame.

    `now` is the mean (over small-scale fading) SNR of the links in this frame, in the whole channel; `before` that of
    the frame before (the first frame's own, in the first). `reach_bytes` is the longest group-addressed frame that
    each link carries in this frame, its fade and its random draw. `snr_db`, `fade_db`, `shadow_db` and
    `group_reach_bytes` show the same as squares [N, N], sender by receiver, NaN on the diagonal.

    What follows from the flight alone is worked out for a block of frames in one pass; a frame in which nothing
    else interferes is only looked up.

    Args:
        settings: see `sortie.radio.settings.AirSettings`.
        positions_m: [T, N, 3], ENU: where each drone will be in each frame; ids are 0 … N − 1.
        seed, replication: as in `sortie.scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.
        up: [T, N, 3], ENU: the unit vector along each airframe's z axis; None is level flight.

    Raises:
        ValueError: if a shape is wrong or a number is not finite.
    """

    def __init__(
        self,
        settings: AirSettings,
        positions_m: ArrayLike,
        seed: int,
        replication: int,
        frame_s: float,
        up: ArrayLike | None = None,
    ) -> None:
        self._positions_m = p = np.asarray(positions_m, dtype=float)
        if p.ndim != 3 or p.shape[1] < 1 or p.shape[2] != 3:
            raise ValueError(f"positions_m has shape {p.shape}, must be (frames, drones, 3)")
        if not np.isfinite(p).all():
            raise ValueError("positions_m holds a value that is not finite")
        if not frame_s > 0:
            raise ValueError(f"frame_s is {frame_s!r}, must be > 0")
        self._up = u = None if up is None else np.asarray(up, dtype=float)
        if u is not None and u.shape != p.shape:
            raise ValueError(f"up has shape {u.shape}, must be {p.shape}, as positions_m")
        if u is not None and not np.isfinite(u).all():
            raise ValueError("up holds a value that is not finite")
        self.settings = settings
        self.n = n_drones = p.shape[1]
        self._antennas = Antennas(settings.antennas(n_drones))
        self.frame = -1
        self.noise_dbm = noise_dbm(settings.bandwidth_mhz, settings.noise_figure_db)
        # group frames go out in the primary 20 MHz with the whole power, so over less noise
        self._group_gain_db = 10.0 * log10(settings.bandwidth_mhz / 20.0)
        self._curve = group_curve(settings.group_rate_mbps)
        self._frame_s = frame_s
        self._field: ShadowField | None = None
        if settings.shadowing_distance_m is not None:
            self._field = ShadowField(
                settings.shadowing_sigma_db, settings.shadowing_distance_m, settings.shadowing_time_s, seed, replication
            )
        early = min(n_drones, SQUARE)
        self._draws = StreamDraws(settings, seed, replication, early, frame_s)
        self._crowd: Crowd | None = None
        if n_drones > SQUARE:
            self._crowd = Crowd(
                settings, n_drones, self._draws, self._field,
                n_early=early, earshot_m=earshot_m(settings), seed=seed, replication=replication, frame_s=frame_s,
            )  # fmt: skip
        self._block = EPOCH if self._crowd else max(1, min(1024, _BLOCK_NUMBERS // (n_drones * n_drones)))
        self.links = all_links(0 if self._crowd else n_drones)
        self.now = self.before = FrameLinks(self.links, np.empty(0))
        # the block, [frames, L] each
        self._snr_db: AnyFloats
        self._shadow_db: AnyFloats
        self._fades_db: AnyFloats
        self._losses: AnyFloats
        self._reach_bytes: AnyFloats
        self._snr_rows: list[list[list[float]]] = []  # of a small fleet: the block as lists, which one looks up faster
        self._reach_rows: list[list[list[float]]] = []
        self._reach_now: list[list[float]] = []
        # who hears whom in this frame, if every frame is of this length
        self._heard_bytes = -1
        self._all_ids: IntArray
        self._heard_ids: Sequence[int] = []
        self._heard_from: list[int] = []

    def advance(self, extra_loss_db: ArrayLike | None = None, jammers: Sequence[Jammer] = ()) -> None:
        """Move on by one frame.

        Args:
            extra_loss_db: [N, N], sender by receiver, added to the path loss; None is none.
            jammers: position (ENU, m) and power (dBm) of each; what a receiver gets of it adds to its noise.

        Raises:
            IndexError: the flight is over.
            ValueError: if a shape is wrong.
        """
        if self.frame + 1 >= len(self._positions_m):
            raise IndexError(f"the flight has {len(self._positions_m)} frames")
        self.frame += 1
        self._heard_bytes = -1
        row = self.frame % self._block
        if row == 0:
            self._refill()
        links, snr = self.links, self._snr_db[row]
        self.reach_bytes = self._reach_bytes[row]
        rows_db = None
        if self._crowd is None:
            rows_db, self._reach_now = self._snr_rows[row], self._reach_rows[row]
        if extra_loss_db is not None or jammers:
            snr = snr.copy()
            if extra_loss_db is not None:
                extra = np.asarray(extra_loss_db, dtype=float)
                if extra.shape != (self.n, self.n):
                    raise ValueError(f"extra_loss_db has shape {extra.shape}, must be {(self.n, self.n)}")
                snr -= extra[links.sender, links.receiver]
            if jammers:
                snr -= self.noise_rise_db(jammers)[links.receiver]
            fades_db, draws = self._chance(row)
            self.reach_bytes = self._reach(snr + fades_db, draws)
            rows_db = None
            if self._crowd is None:
                self._reach_now = self.reach_bytes.reshape(self.n, self.n).tolist()
        self.before = self.now if self.frame else FrameLinks(links, snr, rows_db)
        self.now = FrameLinks(links, snr, rows_db)

    def reroute(self, positions_m: ArrayLike, up: ArrayLike | None = None) -> None:
        """From the next frame on the fleet flies another way; what was drawn of shadowing, fades and losses stays.

        In fleets of more than `SQUARE` drones links follow it from the next block of `EPOCH` frames on.

        Args:
            positions_m, up: as for the channel, the same up to this frame.

        Raises:
            ValueError: if a shape is another one or a number is not finite.
        """
        p = np.asarray(positions_m, dtype=float)
        u = None if up is None else np.asarray(up, dtype=float)
        for name, new in (("positions_m", p), ("up", u)):
            if new is not None and (new.shape != self._positions_m.shape or not np.isfinite(new).all()):
                raise ValueError(f"{name} has shape {new.shape}, must be {self._positions_m.shape} and finite")
        self._positions_m, self._up = p, u
        if self._crowd is None and self.frame >= 0:
            self._work_out(self.frame // self._block * self._block)

    @property
    def snr_db(self) -> FloatArray:
        """[N, N] of this frame; `OUT_OF_RANGE_DB` where a large fleet's link is out of earshot."""
        return self.now.square_db

    @property
    def fade_db(self) -> FloatArray:
        """[N, N] of this frame."""
        return self.links.square(self._chance(self.frame % self._block)[0], np.nan)

    @property
    def shadow_db(self) -> FloatArray:
        """[N, N] of this frame."""
        return self.links.square(self._shadow_db[self.frame % self._block], np.nan)

    @property
    def group_reach_bytes(self) -> FloatArray:
        """[N, N] of this frame."""
        return self.links.square(self.reach_bytes, 0.0)

    def heard(self, sender: int, length_bytes: int, times: int = 0) -> Sequence[int]:
        """Who receives a group-addressed frame, ascending; an array of integers in large fleets, else a list.

        Args:
            sender: whose frame.
            length_bytes: its length.
            times: how many frames it has sent before in this frame of time: same fade, new draws. The draws are the
                first frame's shifted by multiples of the golden ratio, modulo 1.
        """
        links = self.links
        if times:
            mine = links.by_sender[links.begin[sender] : links.begin[sender + 1]]
            fades_db, draws = self._chance(self.frame % self._block, mine)
            draws = (draws + times * 0.6180339887498949) % 1.0
            reach = self._reach(self.now.snr_db[mine] + fades_db, draws)
            again = links.receiver[mine[reach >= length_bytes]]
            return cast(Sequence[int], again if self._crowd else again.tolist())
        if self._crowd is None:
            return [i for i, reach in enumerate(self._reach_now[sender]) if reach >= length_bytes]
        if self._heard_bytes != length_bytes:  # most frames of a moment have one length: look at all links together
            self._heard_bytes = length_bytes
            if self.reach_bytes.min(initial=np.inf) >= length_bytes:
                self._heard_ids, self._heard_from = cast(Sequence[int], self._all_ids), links.begin
            else:
                through = (self.reach_bytes >= length_bytes)[links.by_sender]
                self._heard_ids = cast(Sequence[int], links.receiver[links.by_sender[through]])
                self._heard_from = np.concatenate([[0], np.cumsum(through)])[links.begin].tolist()
        return self._heard_ids[self._heard_from[sender] : self._heard_from[sender + 1]]

    def _reach(self, faded_db: AnyFloats, draws: AnyFloats) -> AnyFloats:
        # a frame of L bytes arrives with probability s^(w L / 1458), w being the curve's weight: so while u is below that
        x = faded_db + (self._group_gain_db - self._curve.centre_db)
        x *= -self._curve.slope_per_db
        is_single = x.dtype == np.float32
        np.minimum(x, 80.0 if is_single else 700.0, out=x)  # keeps the exponential finite
        minus_log_s: AnyFloats = np.log1p(np.exp(x, out=x), out=x)
        np.maximum(minus_log_s, 1e-30 if is_single else 1e-300, out=minus_log_s)
        minus_log_s = np.divide(_reach_at_1(draws, self._curve), minus_log_s, out=minus_log_s)
        return minus_log_s

    def noise_rise_db(self, jammers: Sequence[Jammer]) -> FloatArray:
        """[N]: how far the jammers lift each receiver's noise."""
        p = self._positions_m[self.frame]
        total_mw = np.full(self.n, 10.0 ** (self.noise_dbm / 10.0))
        for place, power_dbm in jammers:
            where = np.asarray(place, dtype=float)
            toward = p - where
            d = np.sqrt((toward**2).sum(axis=1))
            loss_db = path_loss_db(self.settings, d, p[:, 2], np.full(self.n, where[2]))
            if not self._antennas.lossless:
                up = np.array([0.0, 0.0, 1.0]) if self._up is None else self._up[self.frame]
                cosine = (toward * up).sum(axis=1) / np.maximum(d, 1e-9)
                loss_db = loss_db + self._antennas.loss_db(slice(None), cosine)
            total_mw += 10.0 ** ((power_dbm - loss_db) / 10.0)
        return np.asarray(10.0 * np.log10(total_mw) - self.noise_dbm)

    # --- a block of frames ---------------------------------------------------------------------------

    def _refill(self) -> None:
        c, p = self.settings, self._positions_m[self.frame : self.frame + self._block]
        up = None if self._up is None else self._up[self.frame : self.frame + self._block]
        if self._crowd is not None:
            self.links, gain_db, self._shadow_db = self._crowd.block(self.frame, p, up)
            self._snr_db = gain_db + (c.tx_power_dbm - self.noise_dbm)
            sure_db = self._curve.snr_db(_SURE_PER) - self._group_gain_db
            safe_db = sure_db - float(fade_table_db(c.rician_k_db)[0])
            risky = np.flatnonzero(self._snr_db.min(axis=0) < safe_db)
            fades_db, draws = self._crowd.chance(0, len(p), risky)
            self._all_ids = self.links.receiver[self.links.by_sender]
            self._reach_bytes = np.full_like(self._snr_db, np.inf)
            self._reach_bytes[:, risky] = self._reach(self._snr_db[:, risky] + fades_db, draws)
            return
        drawn = self._draws.block(self._block, len(p))
        self._shadow_db, self._fades_db, self._losses = (x.reshape(len(p), -1) for x in drawn)
        self._work_out(self.frame)

    def _work_out(self, first: int) -> None:
        """The block that begins with a frame, from what was drawn for it and where the drones are."""
        c, p = self.settings, self._positions_m[first : first + self._block]
        up = None if self._up is None else self._up[first : first + self._block]
        loss_db = self._loss_db(p, up)
        if self._field is not None:
            at = [self._field.between(q, (first + t) * self._frame_s) for t, q in enumerate(p)]
            self._shadow_db = np.stack(at).reshape(len(p), -1)
        self._snr_db = c.tx_power_dbm - self.noise_dbm - loss_db + self._shadow_db
        self._reach_bytes = self._reach(self._snr_db + self._fades_db, self._losses)
        square = (len(p), self.n, self.n)
        self._snr_rows = self._snr_db.reshape(square).tolist()
        self._reach_rows = self._reach_bytes.reshape(square).tolist()

    def _chance(self, row: int, links: IntArray | None = None) -> tuple[AnyFloats, AnyFloats]:
        """Fades in dB and uniform draws of some links, or all, in a frame of the block."""
        if self._crowd is not None:
            which = np.arange(len(self.links.sender)) if links is None else links
            fades_db, draws = self._crowd.chance(row, 1, which)
            return fades_db[0], draws[0]
        if links is None:
            return self._fades_db[row], self._losses[row]
        return self._fades_db[row, links], self._losses[row, links]

    def _loss_db(self, p: FloatArray, up: FloatArray | None) -> FloatArray:
        """[frames, N²] of [frames, N, 3] positions: path and antennas."""
        links, c = self.links, self.settings
        delta = p[:, :, None, :] - p[:, None, :, :]
        distance = np.sqrt(np.einsum("tijk,tijk->tij", delta, delta)).reshape(len(p), -1)
        heights = p[:, :, 2]
        loss_db = path_loss_db(c, distance, heights[:, links.sender], heights[:, links.receiver])
        if not self._antennas.lossless:
            along = delta.reshape(len(p), -1, 3) / np.maximum(distance, 1e-9)[..., None]
            for end in (links.sender, links.receiver):
                cosine = along[..., 2] if up is None else np.einsum("tlk,tlk->tl", along, up[:, end])
                loss_db = loss_db + self._antennas.loss_db(end, cosine)
        return loss_db


class SampleDraws:
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
