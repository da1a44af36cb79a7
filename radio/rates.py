"""802.11n, ac and ax rates, packet error rates and the rate that an ideal sender picks.

One spatial stream. The packet error rate (PER) of a 1458 B LDPC frame over white noise is a logistic
in dB, 1 / (1 + e^{a (SNR − s50)}), fitted per MCS (error ≤ 0.036); a frame of L bytes fails with
1 − (1 − PER)^{L/1458}. On a fading link the *mean* PER is the average of that over the Rician power gain.
The fits were made for 802.11ax; n and ac use the same modulations and codes, and are given the same curves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import exp, expm1, log1p
from typing import Literal

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
        "n", 36e-6, 4e-6, 65_535, 64,
        {
            20: (6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0),
            40: (13.5, 27.0, 40.5, 54.0, 81.0, 108.0, 121.5, 135.0),
        },
    ),
    "ac": Standard(
        "ac", 40e-6, 4e-6, 1_048_575, 64,
        {
            20: (6.5, 13.0, 19.5, 26.0, 39.0, 52.0, 58.5, 65.0, 78.0),
            40: (13.5, 27.0, 40.5, 54.0, 81.0, 108.0, 121.5, 135.0, 162.0, 180.0),
            80: (29.3, 58.5, 87.8, 117.0, 175.5, 234.0, 263.3, 292.5, 351.0, 390.0),
        },
    ),
    "ax": Standard(
        "ax", 44e-6, 13.6e-6, 6_500_631, 256,
        {
            20: (8.6, 17.2, 25.8, 34.4, 51.6, 68.8, 77.4, 86.0, 103.2, 114.7, 129.0, 143.4),
            40: (17.2, 34.4, 51.6, 68.8, 103.2, 137.6, 154.9, 172.1, 206.5, 229.4, 258.1, 286.8),
            80: (36.0, 72.1, 108.1, 144.1, 216.2, 288.2, 324.3, 360.3, 432.4, 480.4, 540.4, 600.5),
        },
    ),
}  # fmt: skip
"""One spatial stream, guard interval 0.8 µs. 802.11n has no 80 MHz, 802.11ac no MCS 9 at 20 MHz."""

S50_DB = (-0.94, 2.07, 4.56, 7.55, 10.61, 14.78, 16.15, 17.66, 21.29, 23.10, 26.39, 28.45)
SLOPE_PER_DB = (9.3, 9.1, 10.1, 7.8, 9.1, 7.9, 7.9, 7.4, 7.0, 6.8, 6.4, 5.8)
REFERENCE_BYTES = 1458
NO_LINK_PER = 0.9
"""Above this mean PER at MCS 0 there is no link."""

_STEP_DB = 0.05
_LOW_DB, _HIGH_DB = -20.0, 60.0
_FADE_LOW_DB, _FADE_HIGH_DB = -40.0, 15.0

LEGACY_RATES_MBPS = (6.0, 12.0, 18.0, 24.0, 36.0, 48.0, 54.0)
"""802.11a rates whose modulation and code rate are those of HE MCS 0 … 6 (9 Mb/s has no such twin)."""


def per(snr_db: float, mcs: int, length_bytes: float = REFERENCE_BYTES) -> float:
    """PER of one frame at a fixed SNR (no fading), 0 … 1."""
    x = SLOPE_PER_DB[mcs] * (snr_db - S50_DB[mcs])
    # log of the success probability of the reference frame, −log(1 + e^{−x}), without overflow
    log_success = -log1p(exp(-x)) if x > 0 else x - log1p(exp(x))
    return -expm1(log_success * length_bytes / REFERENCE_BYTES)


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

    def index(self, mean_snr_db: float) -> int:
        """Where a mean SNR (dB) stands on the grid; beyond its ends, the end."""
        i = int((mean_snr_db - _LOW_DB) / _STEP_DB + 0.5) if mean_snr_db > _LOW_DB else 0
        return i if i < len(self.mcs) else len(self.mcs) - 1

    def at(self, mean_snr_db: float) -> tuple[int, float, float]:
        """(MCS, rate in Mb/s, mean PER) at a mean SNR in dB; MCS −1 is no link."""
        i = self.index(mean_snr_db)
        return self.mcs[i], self.rate_mbps[i], self.mean_per[i]


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
    _, weights = fading_weights(k_db)
    grid = np.arange(_LOW_DB, _HIGH_DB + _STEP_DB / 2, _STEP_DB)
    wide = np.arange(_LOW_DB + _FADE_LOW_DB, _HIGH_DB + _FADE_HIGH_DB + _STEP_DB / 2, _STEP_DB)
    s50, slope = np.array(S50_DB)[: len(rates), None], np.array(SLOPE_PER_DB)[: len(rates), None]
    log_success = -np.logaddexp(0.0, -slope * (wide - s50))
    awgn = -np.expm1(log_success * (frame_bytes / REFERENCE_BYTES))
    # mean over the gain g of PER(snr + g): a correlation of the PER curve with the bins' probabilities; einsum adds in the
    # same order on every machine, np.correlate does not
    windows = np.lib.stride_tricks.sliding_window_view(awgn, len(weights), axis=1)[:, : len(grid)]
    mean = np.einsum("mgw,w->mg", windows, weights).clip(0.0, 1.0)
    best = (rates[:, None] * (1.0 - mean)).argmax(axis=0)
    dead = mean[0] > NO_LINK_PER
    columns = np.arange(len(grid))
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


def group_mcs(rate_mbps: float) -> int:
    """The MCS whose PER curve stands for a legacy basic rate (same modulation and code rate, or the next above)."""
    return next((i for i, r in enumerate(LEGACY_RATES_MBPS) if r >= rate_mbps - 1e-9), len(LEGACY_RATES_MBPS) - 1)
