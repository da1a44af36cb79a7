"""A flight log as a context trace: the flight on a regular clock, gaps left empty."""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from sortie.fleet.logs.flightlog import GAP_S, FlightLog, LogError, Series
from sortie.fleet.traces import ATTITUDE, BOUNDS, POSITION, VELOCITY

Array = npt.NDArray[np.float64]

_ROUNDING_S = 1e-6
MIN_S = 1.0
"""A shorter stretch is nothing to fly."""


def context_trace(
    log: FlightLog, rate_hz: float = 10.0, from_s: float = 0.0, until_s: float = math.inf
) -> dict[str, Array]:
    """The columns of a context trace (fleet/traces.py), t_s from 0; what the log does not have is no column.

    Values run linearly between the log's samples, attitudes on the shorter arc. Within a pause of more than a second
    and three samples a cell is NaN, and so it is before the first and after the last sample.

    Args:
        log: the flight.
        rate_hz: rows a second.
        from_s, until_s: the stretch of the log that is taken; its begin becomes 0.

    Raises:
        LogError: less than a second or two rows are left, or nothing in them.
    """
    end_s = min(until_s, log.duration_s)
    if end_s - from_s < MIN_S:
        raise LogError(f"{end_s - from_s:.1f} s from {from_s:g} s on, must be {MIN_S:g} s at least")
    steps = math.floor((end_s - from_s) * rate_hz + 1e-9)
    if steps < 1:
        raise LogError(f"{end_s - from_s:.1f} s at {rate_hz:g} rows a second are one row, must be two at least")
    t_s = np.arange(steps + 1) / rate_hz
    at = t_s + from_s
    columns: dict[str, Array] = {"t_s": t_s, "drone": np.zeros_like(t_s)}
    if log.position is not None:
        columns |= dict(zip(POSITION, _resampled(log.position, at).T, strict=True))
    if log.attitude is not None:
        columns |= dict(zip(ATTITUDE, _turned(log.attitude, at).T, strict=True))
    if log.velocity is not None:
        columns |= dict(zip(VELOCITY, _resampled(log.velocity, at).T, strict=True))
    if log.charge is not None:
        columns["soc"] = _resampled(log.charge, at)[:, 0]
    if log.battery is not None:
        columns |= dict(zip(("voltage_v", "current_a"), _resampled(log.battery, at).T, strict=True))
    if log.rssi is not None:
        columns["rssi_dbm" if log.rssi_unit == "dBm" else "rssi_percent"] = _resampled(log.rssi, at)[:, 0]
    for name, (low, high) in BOUNDS.items():
        if name in columns:
            columns[name][(columns[name] < low) | (columns[name] > high)] = np.nan
    found = {name: column for name, column in columns.items() if not np.isnan(column).all()}
    if len(found) <= 2:
        raise LogError(f"nothing between {from_s:g} and {end_s:g} s")
    return found


def write_trace(path: Path, columns: dict[str, Array]) -> None:
    """Write a trace as Parquet, NaN as an empty cell; under a temporary name first."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table(
        {
            name: pa.array(column.astype(np.int32)) if name == "drone" else pa.array(column, from_pandas=True)
            for name, column in columns.items()
        }
    )
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        pq.write_table(table, temporary)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise


def _resampled(series: Series, at_s: Array) -> Array:
    """[T, C], NaN in gaps and outside. A value that is NaN in the log is a gap of its own column."""
    columns = []
    for values in series.values.T:
        known = np.isfinite(values)
        if not known.any():
            columns.append(np.full(len(at_s), np.nan))
            continue
        time_s = series.time_s[known]
        columns.append(np.where(_covered(time_s, at_s), np.interp(at_s, time_s, values[known]), np.nan))
    return np.stack(columns, axis=-1)


def _turned(series: Series, at_s: Array) -> Array:
    """Attitudes [T, 4], NaN in gaps and outside."""
    if len(series.time_s) == 1:
        turned = np.repeat(series.values, len(at_s), axis=0)
    else:
        within = np.clip(at_s, series.time_s[0], series.time_s[-1])
        turned = Slerp(series.time_s, Rotation.from_quat(series.values))(within).as_quat()
    out: Array = np.where(_covered(series.time_s, at_s)[:, None], turned, np.nan)
    return out


def _covered(time_s: Array, at_s: Array) -> npt.NDArray[np.bool_]:
    """Whether each time lies within the samples and in none of their gaps."""
    inside: npt.NDArray[np.bool_] = (at_s >= time_s[0] - _ROUNDING_S) & (at_s <= time_s[-1] + _ROUNDING_S)
    if len(time_s) < 2:
        return inside
    after = np.clip(np.searchsorted(time_s, at_s), 1, len(time_s) - 1)
    steps = np.diff(time_s)
    longest = max(GAP_S, 3 * float(np.median(steps)))
    nearest_s = np.minimum(np.abs(at_s - time_s[after - 1]), np.abs(at_s - time_s[after]))
    covered: npt.NDArray[np.bool_] = inside & ((steps[after - 1] <= longest) | (nearest_s < _ROUNDING_S))
    return covered
