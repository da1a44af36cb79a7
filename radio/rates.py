"""802.11n, ac and ax rates, packet error rates and the rate that an ideal sender picks.

One spatial stream. Over white noise a frame of L bytes fails with the packet error rate (PER)
1 − (1 + e^{−a (SNR − s)})^{−w L / 1458}: a, s and w were fitted for each MCS to the error tables of ns-3 3.44, which come
from link simulations (`research/validation/ns3/per_fit.py`; largest error 0.022, SNR in dB). On a fading link the *mean* PER
is the average of that over the Rician power gain. The fits were made for 802.11ax (LDPC); n and ac use the same modulations
and codes, and are given the same curves. Group-addressed frames go at the rates of 802.11a, whose convolutional code has
curves of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import exp, expm1, log, log1p
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr

FloatArray = NDArray[np.float64]

StandardName = Literal["n", "ac", "ax"]


@dataclass(frozen=True, slots=True)
class Standard:
    """What a sender of one 802.11 generation puts around its bits (IEEE 802.11-2020, 802.11ax-2021)."""

    name: StandardName
    preamble_s: float
    """Legacy, signal and training fields of a single-stream frame."""
    symbol_s: float
    """OFDM symbol with a guard interval of 0.8 µs."""
    max_ampdu_bytes: int
    """Longest A-MPDU by its length exponent."""
    max_ampdu_frames: int
    """Frames that one block ack answers."""
    rates_mbps: dict[int, tuple[float, ...]]
    """Data rate by channel width (MHz) and MCS."""


STANDARDS: dict[StandardName, Standard] = {
    "n": Standard(
        "n",
        36e-6,
        4e-6,
        65_535,
        64,
        {
            20: (6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0),
            40: (13.5, 27.0, 40.5, 54.0, 81.0, 108.0, 121.5, 135.0),
        },
    ),
    "ac": Standard(
        "ac",
        40e-6,
        4e-6,
        1_048_575,
        64,
        {
            20: (6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0, 78.0),
            40: (13.5, 27.0, 40.5, 54.0, 81.0, 108.0, 121.5, 135.0, 162.0, 180.0),
            80: (29.3, 58.5, 87.8, 117.0, 175.5, 234.0, 263.3, 292.5, 351.0, 390.0),
        },
    ),
    "ax": Standard(
        "ax",
        44e-6,
        13.6e-6,
        6_500_631,
        256,
        {
            20: (8.6, 17.2, 25.8, 34.4, 51.6, 68.8, 77.4, 86.0, 103.2, 114.7, 129.0, 143.4),
            40: (17.2, 34.4, 51.6, 68.8, 103.2, 137.6, 154.9, 172.1, 206.5, 229.4, 258.1, 286.8),
            80: (36.0, 72.1, 108.1, 144.1, 216.2, 288.2, 324.3, 360.3, 432.4, 480.4, 540.4, 600.5),
        },
    ),
}
"""One spatial stream, guard interval 0.8 µs. 802.11n has no 80 MHz, 802.11ac no MCS 9 at 20 MHz."""


class PerCurve(NamedTuple):
    """PER over SNR of one modulation and code over white noise."""

    centre_db: float
    slope_per_db: float
    weight: float
    """Exponent for a frame of 1458 B."""

    def per(self, snr_db: float, length_bytes: float = 1458) -> float:
        """PER of one frame, 0 … 1."""
        x = self.slope_per_db * (snr_db - self.centre_db)
        # log(1 + e^{−x}) without overflow
        softplus = log1p(exp(-x)) if x > 0 else log1p(exp(x)) - x
        return -expm1(-self.weight * softplus * length_bytes / REFERENCE_BYTES)

    def snr_db(self, per: float, length_bytes: float = 1458) -> float:
        """The SNR at which a frame has this PER, 0 < PER < 1."""
        softplus = -log1p(-per) / self.weight * REFERENCE_BYTES / length_bytes
        return self.centre_db - log(expm1(softplus)) / self.slope_per_db


CURVES = (
    PerCurve(-1.159, 6.018, 2.792),
    PerCurve(1.907, 6.2, 2.133),
    PerCurve(4.417, 6.657, 2.089),
    PerCurve(7.364, 5.554, 2.247),
    PerCurve(10.452, 6.269, 2.116),
    PerCurve(14.569, 5.748, 2.522),
    PerCurve(16.03, 5.87, 1.67),
    PerCurve(17.488, 5.473, 1.956),
    PerCurve(21.094, 5.21, 2.216),
    PerCurve(22.857, 4.914, 2.466),
    PerCurve(25.941, 4.325, 4.799),
    PerCurve(28.195, 4.441, 2.294),
)
"""HE MCS 0 … 11, LDPC."""
LEGACY_CURVES = {
    6.0: PerCurve(-0.61, 3.061, 12.283),
    12.0: PerCurve(2.266, 2.722, 14.485),
    18.0: PerCurve(4.74, 2.821, 15.656),
    24.0: PerCurve(7.791, 2.462, 11.744),
    36.0: PerCurve(10.684, 2.495, 22.048),
    48.0: PerCurve(14.854, 2.147, 14.348),
    54.0: PerCurve(16.132, 2.147, 15.536),
}
"""802.11a by rate in Mb/s, convolutional code, fitted for frames below 400 B. 9 Mb/s has no table."""
REFERENCE_BYTES = 1458
NO_LINK_PER = 0.9
"""Above this mean PER at MCS 0 there is no link."""

_STEP_DB: Final = 0.05
_LOW_DB: Final = -20.0
_HIGH_DB = 60.0
_GRID_DB = np.arange(_LOW_DB, _HIGH_DB + _STEP_DB / 2, _STEP_DB)
_FADE_LOW_DB, _FADE_HIGH_DB = -40.0, 15.0


def per(snr_db: float, mcs: int, length_bytes: float = REFERENCE_BYTES) -> float:
    """PER of one HE frame at a fixed SNR (no fading), 0 … 1."""
    return CURVES[mcs].per(snr_db, length_bytes)


def rescale(per_at: float, ratio: float) -> float:
    """PER of a frame `ratio` times as long: 1 − (1 − PER)^ratio."""
    return 1.0 if per_at >= 1.0 else -expm1(ratio * log1p(-per_at))


def fading_weights(k_db: float) -> tuple[FloatArray, FloatArray]:
    """The Rician power gain in dB, cut into bins.

    Args:
        k_db: Rician factor, dB; the mean gain is 1 (0 dB).

    Returns:
        Bin centres (dB, step 0.05) and their probabilities, which sum to 1; both of shape [bins].
    """
    k = 10.0 ** (k_db / 10.0)
    centres = np.arange(_FADE_LOW_DB, _FADE_HIGH_DB + _STEP_DB / 2, _STEP_DB)
    edges = 10.0 ** (np.append(centres - _STEP_DB / 2, centres[-1] + _STEP_DB / 2) / 10.0)
    cdf = chndtr(edges * 2.0 * (k + 1.0), 2, 2.0 * k)  # non-central χ² with two degrees of freedom
    cdf[0], cdf[-1] = 0.0, 1.0
    return centres, np.diff(cdf)


def snr_index(mean_snr_db: float) -> int:
    """Where a mean SNR (dB) stands on the grid of `RateTable`; beyond its ends, the end."""
    i = int((mean_snr_db - _LOW_DB) / _STEP_DB + 0.5) if mean_snr_db > _LOW_DB else 0
    return i if i < len(_GRID_DB) else len(_GRID_DB) - 1


@dataclass(frozen=True, slots=True)
class RateTable:
    """What an ideal rate control does at each mean SNR; lists over a 0.05 dB grid, for fast look-up."""

    bandwidth_mhz: int
    frame_bytes: int
    mcs: tuple[int, ...]
    """The best MCS, −1 where there is no link."""
    rate_mbps: tuple[float, ...]
    mean_per: tuple[float, ...]
    """Mean PER of a frame of `frame_bytes` at that MCS; 1 where there is no link."""
    all_per: tuple[tuple[float, ...], ...]
    """Mean PER of each MCS."""

    index = staticmethod(snr_index)

    def at(self, mean_snr_db: float) -> tuple[int, float, float]:
        """(MCS, rate in Mb/s, mean PER) at a mean SNR in dB; MCS −1 is no link."""
        i = self.index(mean_snr_db)
        return self.mcs[i], self.rate_mbps[i], self.mean_per[i]


def _mean_per(curves: Sequence[PerCurve], k_db: float, frame_bytes: int) -> FloatArray:
    """[curves, grid]: mean PER over Rician fading by quadrature, on the grid of `RateTable`."""
    _, weights = fading_weights(k_db)
    wide = np.arange(_LOW_DB + _FADE_LOW_DB, _HIGH_DB + _FADE_HIGH_DB + _STEP_DB / 2, _STEP_DB)
    centre, slope, weight = (column[:, None] for column in np.array(curves).T)
    log_success = -weight * np.logaddexp(0.0, -slope * (wide - centre))
    awgn = -np.expm1(log_success * (frame_bytes / REFERENCE_BYTES))
    # mean over the gain g of PER(snr + g): a correlation of the PER curve with the bins' probabilities; einsum adds in the
    # same order on every machine, np.correlate does not
    windows = np.lib.stride_tricks.sliding_window_view(awgn, len(weights), axis=1)[:, : len(_GRID_DB)]
    return np.asarray(np.einsum("mgw,w->mg", windows, weights).clip(0.0, 1.0))


@lru_cache(maxsize=64)
def rate_table(
    bandwidth_mhz: int, k_db: float, frame_bytes: int = REFERENCE_BYTES, standard: StandardName = "ax"
) -> RateTable:
    """Build the table of one channel: mean PER by quadrature, then the MCS of highest rate × (1 − mean PER).

    Args:
        bandwidth_mhz: 20, 40 or 80, as far as the standard has it.
        k_db: Rician factor of the fading.
        frame_bytes: length of the frames that rate control has in mind.
        standard: whose rates; its MCS are the first ones of 802.11ax.
    """
    rates = np.array(STANDARDS[standard].rates_mbps[bandwidth_mhz])
    mean = _mean_per(CURVES[: len(rates)], k_db, frame_bytes)
    best = (rates[:, None] * (1.0 - mean)).argmax(axis=0)
    dead = mean[0] > NO_LINK_PER
    columns = np.arange(len(_GRID_DB))
    return RateTable(
        bandwidth_mhz,
        frame_bytes,
        tuple(np.where(dead, -1, best).tolist()),
        tuple(np.where(dead, 0.0, rates[best]).tolist()),
        tuple(np.where(dead, 1.0, mean[best, columns]).tolist()),
        tuple(tuple(row) for row in mean.tolist()),
    )


def choose_mcs(
    mean_snr_db: float,
    bandwidth_mhz: int,
    k_db: float,
    frame_bytes: int = REFERENCE_BYTES,
    standard: StandardName = "ax",
) -> tuple[int, float, float]:
    """(MCS, rate in Mb/s, mean PER) of the ideal rate control; MCS −1 when even MCS 0 fails (mean PER > 0.9)."""
    return rate_table(bandwidth_mhz, k_db, frame_bytes, standard).at(mean_snr_db)


def group_curve(rate_mbps: float) -> PerCurve:
    """PER of group-addressed frames at a basic rate, or at the next 802.11a rate above it that has a curve."""
    return next((c for rate, c in LEGACY_CURVES.items() if rate >= rate_mbps - 1e-9), LEGACY_CURVES[54.0])
