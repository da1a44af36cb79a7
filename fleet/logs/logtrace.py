"""Flight logs as a context trace: the flights on one regular clock, gaps left empty."""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from sortie.fleet.logs.flightlog import FlightLog, LogError, Series
from sortie.fleet.logs.sources import FAR_M, GAP_S, local_m
from sortie.fleet.traces import ATTITUDE, BOUNDS, COLUMNS, POSITION, VELOCITY
from sortie.scenarios.traces import MAX_ROWS

Array = npt.NDArray[np.float64]

_ROUNDING_S = 1e-6
MIN_S = 1.0
"""A shorter stretch is nothing to fly."""


def context_trace(
    logs: FlightLog | Sequence[FlightLog], rate_hz: float = 10.0, from_s: float = 0.0, until_s: float = math.inf
) -> dict[str, Array]:
    """The columns of a context trace (fleet/traces.py), t_s from 0; what no log has is no column.

    Values run linearly between the log's samples, attitudes on the shorter arc. Within a pause of more than a second
    and three samples a cell is NaN, and so it is before the first and after the last sample.

    Args:
        logs: the flight, or those of several vehicles of one log (`read_logs`); the first becomes drone 0.
        rate_hz: rows a second.
        from_s, until_s: the stretch of the log that is taken; its begin becomes 0.

    Raises:
        LogError: less than a second or two rows are left, too many rows, or nothing in them.
    """
    flights = beside([logs] if isinstance(logs, FlightLog) else logs)
    path, end_s = flights[0].path, min(until_s, flights[0].duration_s)
    if end_s - from_s < MIN_S:
        raise LogError(f"{path}: {end_s - from_s:.1f} s from {from_s:g} s on, must be {MIN_S:g} s at least")
    steps = math.floor((end_s - from_s) * rate_hz + 1e-9)
    if steps < 1:
        raise LogError(f"{path}: {end_s - from_s:.1f} s at {rate_hz:g} rows a second are one row, must be two at least")
    if (steps + 1) * len(flights) > MAX_ROWS:
        rows = f"{end_s - from_s:.1f} s at {rate_hz:g} rows a second" + f" of {len(flights)} vehicles" * (
            len(flights) > 1
        )
        raise LogError(f"{path}: {rows} are {(steps + 1) * len(flights)} rows, must be at most {MAX_ROWS}")
    t_s = np.arange(steps + 1) / rate_hz
    each = []
    for drone, log in enumerate(flights):
        found = _columns(log, t_s + from_s)
        if not found:
            whose = "" if log.system is None else f" of system {log.system}"
            raise LogError(f"{path}: nothing{whose} between {from_s:g} and {end_s:g} s")
        each.append({"t_s": t_s, "drone": np.full_like(t_s, drone), **found})
    names = [name for name in COLUMNS if any(name in columns for columns in each)]
    nothing = np.full_like(t_s, np.nan)
    return {name: np.concatenate([columns.get(name, nothing) for columns in each]) for name in names}


def _columns(log: FlightLog, at_s: Array) -> dict[str, Array]:
    """What a log has at these times, each cell within its bounds."""
    columns: dict[str, Array] = {}
    if log.position is not None:
        columns |= dict(zip(POSITION, _resampled(log.position, at_s).T, strict=True))
    if log.attitude is not None:
        columns |= dict(zip(ATTITUDE, _turned(log.attitude, at_s).T, strict=True))
    if log.velocity is not None:
        columns |= dict(zip(VELOCITY, _resampled(log.velocity, at_s).T, strict=True))
    if log.charge is not None:
        columns["soc"] = _resampled(log.charge, at_s)[:, 0]
    if log.battery is not None:
        columns |= dict(zip(("voltage_v", "current_a"), _resampled(log.battery, at_s).T, strict=True))
    if log.rssi is not None:
        columns["rssi_dbm" if log.rssi_unit == "dBm" else "rssi_percent"] = _resampled(log.rssi, at_s)[:, 0]
    for name, column in columns.items():
        low, high = BOUNDS[name]
        column[(column < low) | (column > high)] = np.nan
    return {name: column for name, column in columns.items() if not np.isnan(column).all()}


def on_one_clock(logs: Sequence[FlightLog], *, together: bool = False) -> tuple[FlightLog, ...]:
    """The flights of several files, with every `begin_s` in seconds since 1970 by the file's own GNSS clock.

    Vehicles of one file keep the clock that they share. A file without such a clock begins at the same time as
    the first of the others, and its `problems` say so.

    Args:
        logs: the flights, those of one file one after another.
        together: let every file begin at the same time, whatever their clocks say.

    Raises:
        LogError: a file has no moment in common with the others; the message names it.
    """
    files = {log.path: [each for each in logs if each.path == log.path] for log in logs}
    known_s = {
        path: min(log.utc_s for log in of if log.utc_s is not None)
        for path, of in files.items()
        if not together and any(log.utc_s is not None for log in of)
    }
    first_s = min(known_s.values(), default=0.0)
    placed: list[FlightLog] = []
    for path, of in files.items():
        begin_s = known_s.get(path, first_s)
        unknown = path not in known_s and not together and len(files) > 1
        told = ("it does not say when it began: it begins with the first log",) * unknown
        own_s = min(log.begin_s for log in of)
        placed += [replace(log, begin_s=begin_s + log.begin_s - own_s, problems=(*log.problems, *told)) for log in of]
    for log in placed:
        others = [each for each in placed if each is not log]
        if others and not any(_overlap(log, each) for each in others):
            away_s = min(max(each.begin_s - log.begin_s, log.begin_s - each.begin_s) for each in others)
            raise LogError(
                f"{log.path}: has no moment in common with the other logs ({away_s:.0f} s away); --together lets all begin at once"
            )
    return tuple(placed)


def _overlap(a: FlightLog, b: FlightLog) -> bool:
    return a.begin_s < b.begin_s + b.duration_s and b.begin_s < a.begin_s + a.duration_s


def beside(logs: Sequence[FlightLog]) -> tuple[FlightLog, ...]:
    """The vehicles of one log on one clock, and in metres from the first place on the globe of the first that has one.

    Places of a vehicle are moved by one offset, the median between its fixes and what its estimator has at their times.
    A vehicle without a fix cannot be placed beside others that have one; its places are left out, and that is told.
    """
    if len(logs) == 1:
        return tuple(logs)
    begin_s = min(log.begin_s for log in logs)
    duration_s = max(log.begin_s + log.duration_s for log in logs) - begin_s
    anchor = next((log.fix.values[:1] for log in logs if log.fix is not None), None)
    return tuple(_moved(log, log.begin_s - begin_s, duration_s, anchor) for log in logs)


def _moved(log: FlightLog, late_s: float, duration_s: float, anchor: Array | None) -> FlightLog:
    position, told = log.position, ""
    if position is not None and anchor is None:
        told = "no vehicle has a place on the globe: its places count from where it began"
    elif position is not None and log.fix is None:
        position, told = None, "it has no place on the globe, and its places are left out"
    elif position is not None and log.fix is not None and anchor is not None:
        globe = local_m(np.concatenate([anchor, log.fix.values]))[1:]
        inside = (log.fix.time_s >= position.time_s[0]) & (log.fix.time_s <= position.time_s[-1])
        inside |= not inside.any()
        own = np.stack([np.interp(log.fix.time_s[inside], position.time_s, c) for c in position.values.T], axis=-1)
        offset_m = np.median(globe[inside] - own, axis=0)
        if float(np.linalg.norm(offset_m)) > FAR_M:
            position, told = None, f"it is over {FAR_M / 1000:g} km from the first, and its places are left out"
        else:
            position = Series(position.time_s, position.values + offset_m)

    def later(series: Series | None) -> Series | None:
        return None if series is None else Series(series.time_s + late_s, series.values)

    return replace(
        log,
        begin_s=log.begin_s - late_s,
        duration_s=duration_s,
        position=later(position),
        velocity=later(log.velocity),
        attitude=later(log.attitude),
        battery=later(log.battery),
        charge=later(log.charge),
        rssi=later(log.rssi),
        fix=later(log.fix),
        problems=(*log.problems, told) if told else log.problems,
    )


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
