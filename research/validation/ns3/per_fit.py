"""Fits the curves of `sortie.radio.rates` to the packet error rates of ns-3's tables, and stores points to test them by.

    python -m research.validation.ns3.per_fit            print CURVES and LEGACY_CURVES, and the largest error of each
    python -m research.validation.ns3.per_fit --points   write per_points.csv as well

The driver `per_table` prints the tables. The fit makes the largest difference in PER as small as it gets.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize

from research.validation.ns3.wifi_ns3 import driver
from sortie.radio.rates import LEGACY_CURVES, REFERENCE_BYTES, PerCurve

POINTS = Path(__file__).with_name("per_points.csv")
HE_BYTES = (1458, 1494)
LEGACY_BYTES = (200, 334, 399)
"""Descriptors. ns-3 has two tables for 802.11a, for short and long frames, which meet at 400 B with a step."""
FloatArray = NDArray[np.float64]


def tables() -> pd.DataFrame:
    """What ns-3's tables hold: kind (he, legacy), mcs, bytes, snr_db, per."""
    done = subprocess.run([str(driver("per_table"))], capture_output=True, text=True, check=True, timeout=120.0)
    rows = [line.split() for line in done.stdout.splitlines()]
    found = pd.DataFrame(rows, columns=["kind", "mcs", "bytes", "snr_db", "per"])
    return found.astype({"mcs": int, "bytes": int, "snr_db": float, "per": float})


def fitted(rows: pd.DataFrame) -> tuple[PerCurve, float]:
    """The best curve for the rows of one MCS, and its largest difference in PER."""
    snr_db, per, length = (rows[name].to_numpy(float) for name in ("snr_db", "per", "bytes"))

    def errors(p: FloatArray) -> FloatArray:
        centre_db, slope, weight = p[0], *np.exp(p[1:])
        return -np.expm1(-weight * np.logaddexp(0.0, -slope * (snr_db - centre_db)) * length / REFERENCE_BYTES) - per

    half_db = float(snr_db[np.abs(per - 0.5).argmin()])
    best = None
    for weight in (1.0, 3.0, 10.0, 30.0):
        start = least_squares(errors, (half_db, np.log(4.0), np.log(weight))).x
        found = minimize(
            lambda p: float(np.abs(errors(p)).max()),
            start,
            method="Nelder-Mead",
            options={"maxiter": 4000, "xatol": 1e-6, "fatol": 1e-7},
        )
        if best is None or found.fun < best.fun:
            best = found
    assert best is not None
    curve = PerCurve(round(best.x[0], 3), round(np.exp(best.x[1]), 3), round(np.exp(best.x[2]), 3))
    return curve, float(np.abs(errors(np.array([curve[0], np.log(curve[1]), np.log(curve[2])]))).max())


def points(found: pd.DataFrame) -> pd.DataFrame:
    """Every fifth of a decibel where a frame may fail or not."""
    of_one_length = found[found["bytes"].isin((1494, 334))]
    on_grid = np.round(of_one_length["snr_db"] * 10) % 2 == 0
    at_edge = (of_one_length["per"] > 1e-3) & (of_one_length["per"] < 1 - 1e-3)
    return of_one_length[on_grid & at_edge].round({"snr_db": 2, "per": 5})


def main() -> None:
    """The command."""
    found = tables()
    print("CURVES = (")  # noqa: T201
    for _, rows in found[(found["kind"] == "he") & found["bytes"].isin(HE_BYTES)].groupby("mcs"):
        curve, error = fitted(rows)
        print(f"    PerCurve({curve[0]:g}, {curve[1]:g}, {curve[2]:g}),  # {error:.3f}")  # noqa: T201
    print(")\nLEGACY_CURVES = {")  # noqa: T201
    for rate, (_, rows) in zip(
        LEGACY_CURVES,
        found[(found["kind"] == "legacy") & found["bytes"].isin(LEGACY_BYTES)].groupby("mcs"),
        strict=True,
    ):
        curve, error = fitted(rows)
        print(f"    {rate}: PerCurve({curve[0]:g}, {curve[1]:g}, {curve[2]:g}),  # {error:.3f}")  # noqa: T201
    print("}")  # noqa: T201
    if "--points" in sys.argv:
        points(found).to_csv(POINTS, index=False)


if __name__ == "__main__":
    main()
