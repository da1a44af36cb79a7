"""Positions to mean signal-to-noise ratios: path loss, antennas, shadowing, noise and jammers.

Small fleets work out every link, with the random numbers of `sortie.radio.channel.draws.StreamShadowing`; large ones the
links within earshot (`sortie.radio.channel.large_fleet`). What fades is each frame on the air (`sortie.radio.mac.edca`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, log10
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.radio.channel.antenna import Antennas
from sortie.radio.channel.draws import StreamShadowing, fade_table_db
from sortie.radio.channel.earshot import LinkList, all_links
from sortie.radio.channel.flight import Flight, flight_of
from sortie.radio.channel.large_fleet import EPOCH, Crowd
from sortie.radio.channel.pathloss import path_loss_db, range_m
from sortie.radio.channel.shadowing import ShadowField
from sortie.radio.own_links import changed_snr, own_link
from sortie.radio.rates import CURVES, group_curve
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
_EARSHOT_SIGMA = 5.0
_BLOCK_NUMBERS = 1 << 18


def noise_dbm(bandwidth_mhz: float, noise_figure_db: float) -> float:
    """Thermal noise at 290 K and the receiver's figure: −174 + 10 log10 B + NF, dBm."""
    return -174.0 + 10.0 * log10(bandwidth_mhz * 1e6) + noise_figure_db


def earshot_m(settings: AirSettings) -> float:
    """The distance beyond which no frame is heard.

    There a link with 5 σ of shadowing (one in 3.5 million) and the highest of 65,536 fades is still 2 dB short of
    half the group frames. A link model of one's own may make any link a good one: there is no such distance then.
    """
    if settings.link is not None:
        return inf
    gain_db = _EARSHOT_SIGMA * settings.shadowing_sigma_db + float(fade_table_db(settings.rician_k_db)[-1])
    group_db = group_curve(settings.group_rate_mbps).snr_db(0.5) - 10.0 * log10(settings.bandwidth_mhz / 20.0)
    needed_db = min(CURVES[0].snr_db(0.5), group_db)
    noise = noise_dbm(settings.bandwidth_mhz, settings.noise_figure_db)
    return range_m(settings, settings.tx_power_dbm - noise + gain_db - needed_db + 2.0)


def linear(snr_db: AnyFloats) -> FloatArray:
    """A ratio in dB as a factor; NaN is 0."""
    factor = np.array(snr_db, float)
    factor /= 10.0  # in place: a large fleet's links are a million
    np.power(10.0, factor, out=factor)
    return np.asarray(np.nan_to_num(factor, copy=False))


class FrameLinks:
    """The mean SNR of the links in one frame, or of their pairs; all other forms of it are made at their first use."""

    __slots__ = ("_gain", "_of_pairs", "_rows", "_snr_db", "_square", "links")

    def __init__(
        self, links: LinkList, snr_db: AnyFloats, gain: FloatArray | None = None, *, of_pairs: bool = False
    ) -> None:
        self.links, self._snr_db, self._of_pairs = links, snr_db, of_pairs
        self._square: FloatArray | None = None
        self._rows: list[list[float]] | None = None
        self._gain = gain

    @property
    def snr_db(self) -> AnyFloats:
        """[L]."""
        if self._of_pairs:
            self._snr_db, self._of_pairs = self.links.of_pairs(self._snr_db), False
        return self._snr_db

    @property
    def gain(self) -> FloatArray:
        """[L]: the same as a factor, 0 for NaN."""
        if self._gain is None:
            gain = linear(self._snr_db)
            self._gain = self.links.of_pairs(gain) if self._of_pairs else gain
        return self._gain

    @property
    def square_db(self) -> FloatArray:
        """[N, N], sender by receiver; NaN on the diagonal."""
        if self._square is None:
            self._square = self.links.square(self.snr_db, OUT_OF_RANGE_DB)
        return self._square

    @property
    def rows_db(self) -> list[list[float]]:
        """The same as lists; what stands on the diagonal means nothing."""
        if self._rows is None:
            square_db = self.snr_db.reshape(self.links.n, -1) if self.links.is_square else self.square_db
            self._rows = square_db.tolist()
        return self._rows


class Channel:
    """The SNR of every link, frame by frame.

    `now` is the mean (over small-scale fading) SNR of the links in this frame, in the whole channel; `before` that of
    the frame before (the first frame's own, in the first). `snr_db` and `shadow_db` are squares [N, N], sender by receiver,
    NaN on the diagonal.

    What follows from the flight alone is worked out for some frames in one pass; a frame in which nothing else
    interferes is only looked up.

    Args:
        settings: see `sortie.radio.settings.AirSettings`.
        positions_m: [T, N, 3], ENU: where each drone will be in each frame; ids are 0 … N − 1. Or a flight, which gives
            some frames at once.
        seed, replication: as in `sortie.scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.
        up: [T, N, 3], ENU: the unit vector along each airframe's z axis; None is level flight.
        always: pairs of drones, lower id first, that a large fleet has links between however far apart they are.

    Raises:
        ValueError: if a shape is wrong or a number is not finite.
    """

    def __init__(
        self,
        settings: AirSettings,
        positions_m: ArrayLike | Flight,
        seed: int,
        replication: int,
        frame_s: float,
        up: ArrayLike | None = None,
        always: Sequence[tuple[int, int]] = (),
    ) -> None:
        self._flight = flight_of(positions_m, up)
        if not frame_s > 0:
            raise ValueError(f"frame_s is {frame_s!r}, must be > 0")
        self.settings = settings
        self.n = n_drones = self._flight.drones
        self._antennas = Antennas(settings.antennas(n_drones))
        self.frame = -1
        self.noise_dbm = noise_dbm(settings.bandwidth_mhz, settings.noise_figure_db)
        self._frame_s = frame_s
        self._field: ShadowField | None = None
        if settings.shadowing_distance_m is not None:
            self._field = ShadowField(
                settings.shadowing_sigma_db, settings.shadowing_distance_m, settings.shadowing_time_s, seed, replication
            )
        early = min(n_drones, SQUARE)
        self._own = None
        if settings.link is not None:
            self._own = own_link(settings.link, n_drones, frame_s, stream(seed, replication, (), "link model"))
        self._drawn = StreamShadowing(settings, seed, replication, early, frame_s)
        self._crowd: Crowd | None = None
        if n_drones > SQUARE:
            self._crowd = Crowd(
                settings,
                n_drones,
                self._drawn,
                self._field,
                n_early=early,
                earshot_m=earshot_m(settings),
                always=always,
                seed=seed,
                replication=replication,
                frame_s=frame_s,
            )
        self._block = EPOCH if self._crowd else max(1, min(1024, _BLOCK_NUMBERS // (n_drones * n_drones)))
        self.links = all_links(0 if self._crowd else n_drones)
        self.now = self.before = FrameLinks(self.links, np.empty(0))
        # the block, [frames, L] each; of a large fleet [frames, P]
        self._snr_db: AnyFloats
        self._shadow_db: AnyFloats
        self._gain: FloatArray  # of a small fleet
        self._known = 0  # so many frames of a small fleet's block are worked out

    def advance(self, extra_loss_db: ArrayLike | None = None, jammers: Sequence[Jammer] = ()) -> None:
        """Move on by one frame.

        Args:
            extra_loss_db: [N, N], sender by receiver, added to the path loss; None is none.
            jammers: position (ENU, m) and power (dBm) of each; what a receiver gets of it adds to its noise.

        Raises:
            IndexError: the flight is over.
            ValueError: if a shape is wrong.
        """
        if self.frame + 1 >= self._flight.frames:
            raise IndexError(f"the flight has {self._flight.frames} frames")
        self.frame += 1
        row = self.frame % self._block
        if row == 0:
            self._refill()
        elif row >= self._known and self._crowd is None:
            self._work_out(row)
        links = self.links
        gain = None if self._crowd is not None else self._gain[row]
        now = FrameLinks(links, self._snr_db[row], gain, of_pairs=self._crowd is not None)
        if self._own is not None or extra_loss_db is not None or jammers:
            now = FrameLinks(links, self._changed(now.snr_db, extra_loss_db, jammers))
        self.before = self.now if self.frame else now
        self.now = now

    def _changed(self, snr_db: AnyFloats, extra_loss_db: ArrayLike | None, jammers: Sequence[Jammer]) -> AnyFloats:
        """[L]: what the scenario's own model, extra losses and jammers make of this frame's links."""
        links, snr = self.links, snr_db.copy()
        if self._own is not None:
            square_db = links.square(snr, OUT_OF_RANGE_DB)
            (at_m, _), t_s = self._pose(), self.frame * self._frame_s
            snr = changed_snr(self._own, t_s, at_m, square_db)[links.sender, links.receiver]
        if extra_loss_db is not None:
            extra = np.asarray(extra_loss_db, dtype=float)
            if extra.shape != (self.n, self.n):
                raise ValueError(f"extra_loss_db has shape {extra.shape}, must be {(self.n, self.n)}")
            snr -= extra[links.sender, links.receiver]
        if jammers:
            snr -= self.noise_rise_db(jammers)[links.receiver]
        return snr

    def reroute(self, positions_m: ArrayLike | Flight, up: ArrayLike | None = None) -> None:
        """From the next frame on the fleet flies another way; what was drawn of shadowing stays.

        In fleets of more than `SQUARE` drones links follow it from the next block of `EPOCH` frames on.

        Args:
            positions_m, up: as for the channel, the same up to this frame.

        Raises:
            ValueError: if a shape is another one or a number is not finite.
        """
        flight, planned = flight_of(positions_m, up), self._flight
        shape, must = ((each.frames, each.drones, 3) for each in (flight, planned))
        if shape != must:
            raise ValueError(f"positions_m has shape {shape}, must be {must} and finite")
        self._flight, self._known = flight, self.frame % self._block + 1

    def _pose(self) -> tuple[FloatArray, FloatArray | None]:
        """Positions and z axes [N, 3] in this frame."""
        p, up = self._flight.poses(slice(self.frame, self.frame + 1))
        return p[0], None if up is None else up[0]

    @property
    def snr_db(self) -> FloatArray:
        """[N, N] of this frame; `OUT_OF_RANGE_DB` where a large fleet's link is out of earshot."""
        return self.now.square_db

    @property
    def shadow_db(self) -> FloatArray:
        """[N, N] of this frame."""
        return self.links.square(self.links.of_pairs(self._shadow_db[self.frame % self._block]), np.nan)

    def noise_rise_db(self, jammers: Sequence[Jammer]) -> FloatArray:
        """[N]: how far the jammers lift each receiver's noise."""
        p, up = self._pose()
        total_mw = np.full(self.n, 10.0 ** (self.noise_dbm / 10.0))
        for place, power_dbm in jammers:
            where = np.asarray(place, dtype=float)
            toward = p - where
            d = np.sqrt((toward**2).sum(axis=1))
            loss_db = path_loss_db(self.settings, d, p[:, 2], np.full(self.n, where[2]))
            if not self._antennas.lossless:
                axis = np.array([0.0, 0.0, 1.0]) if up is None else up
                cosine = (toward * axis).sum(axis=1) / np.maximum(d, 1e-9)
                loss_db = loss_db + self._antennas.loss_db(slice(None), cosine)
            total_mw += 10.0 ** ((power_dbm - loss_db) / 10.0)
        return np.asarray(10.0 * np.log10(total_mw) - self.noise_dbm)

    # --- a block of frames ---------------------------------------------------------------------------

    def _refill(self) -> None:
        """Draw what a block needs that begins with this frame."""
        if self._crowd is not None:
            p, up = self._flight.poses(slice(self.frame, self.frame + self._block))
            self.links, gain_db, self._shadow_db = self._crowd.block(self.frame, p, up)
            self._snr_db = gain_db + (self.settings.tx_power_dbm - self.noise_dbm)
            return
        shape = min(self._block, self._flight.frames - self.frame), self.n * self.n
        self._snr_db, self._gain = np.empty(shape), np.empty(shape)
        self._shadow_db = self._drawn.block(shape[0]).reshape(shape) if self._field is None else np.empty(shape)
        self._work_out(0)

    def _work_out(self, row: int) -> None:
        """The next frames of the block from this one on, from what was drawn for them and where the drones are."""
        c, frame = self.settings, self.frame
        rows = slice(row, min(row + EPOCH, len(self._snr_db)))
        p, up = self._flight.poses(slice(frame, frame + rows.stop - row))
        if self._field is not None:
            at = [self._field.between(q, (frame + t) * self._frame_s) for t, q in enumerate(p)]
            self._shadow_db[rows] = np.stack(at).reshape(len(p), -1)
        snr_db = c.tx_power_dbm - self.noise_dbm - self._loss_db(p, up) + self._shadow_db[rows]
        self._snr_db[rows], self._gain[rows] = snr_db, linear(snr_db)
        self._known = rows.stop

    def _loss_db(self, p: FloatArray, up: FloatArray | None) -> FloatArray:
        """[frames, N²] of [frames, N, 3] positions: path and antennas."""
        links, c = self.links, self.settings
        delta = np.empty((len(p), self.n, self.n, 3))
        for axis in range(3):  # numpy is slow along an axis of three
            np.subtract(p[:, :, None, axis], p[:, None, :, axis], out=delta[..., axis])
        distance = np.sqrt(np.einsum("tijk,tijk->tij", delta, delta)).reshape(len(p), -1)
        heights = p[:, :, 2]
        loss_db = path_loss_db(c, distance, heights[:, links.sender], heights[:, links.receiver])
        if not self._antennas.lossless:
            along = delta.reshape(len(p), -1, 3) / np.maximum(distance, 1e-9)[..., None]
            for end in (links.sender, links.receiver):
                cosine = along[..., 2] if up is None else np.einsum("tlk,tlk->tl", along, up[:, end])
                loss_db = loss_db + self._antennas.loss_db(end, cosine)
        return loss_db
