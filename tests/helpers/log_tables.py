"""Flights as tables of a log's messages: straight, 5 m/s east for 10 s, at 10 rows a second.

The charge falls from 90 % by 0.1 % a row.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sortie.fleet.logs.dataflash import RawLog, parameter_table
from sortie.fleet.logs.fields import from_ulog
from sortie.fleet.logs.flightlog import FlightLog, Series, _assemble

ROWS = 100
T_S = np.arange(ROWS) / 10
EAST_M = 5.0 * T_S
CHARGE = 0.9 - 0.001 * np.arange(ROWS)
DEGREE_M = 111_319.49
"""Of longitude on the equator at sea level."""

Tables = dict[str, dict[str, Any]]


def ulog() -> Tables:
    """As PX4 logs it; 5 s after boot."""
    at = {"timestamp": np.round((5 + T_S) * 1e6)}
    zero, one = np.zeros(ROWS), np.ones(ROWS)
    flown = {"x": zero, "y": EAST_M, "z": -20 * one, "vx": zero, "vy": 5 * one, "vz": zero}
    valid = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), one)
    return {
        "vehicle_local_position": at | flown | valid,
        "vehicle_attitude": at | {"q": np.tile([1.0, 0, 0, 0], (ROWS, 1))},
        "battery_status": at | {"voltage_v": 12.3 * one, "current_a": 10 * one, "remaining": CHARGE},
    }


def assembled(tables: Tables, translate: Callable[..., Any] = from_ulog, **parameters: float) -> FlightLog:
    columns = {name: {c: np.asarray(v) for c, v in table.items()} for name, table in tables.items()}
    orders = {name: np.arange(len(next(iter(t.values())))) for name, t in columns.items()}  # written side by side
    orders = {name: order * (ROWS / len(order)) for name, order in orders.items()}
    raw = RawLog({**columns, "PARM": parameter_table(parameters)}, (), orders=orders)
    return _assemble(Path("a.log"), "ULog", raw, translate)


def at_rows(series: Series | None, begin_s: float = 0.0) -> np.ndarray:
    """Which of the flight's rows a series has."""
    assert series is not None
    rows = np.round((series.time_s + begin_s) * 10).astype(int)
    np.testing.assert_allclose(series.time_s + begin_s, rows / 10, atol=1e-6)
    return rows


def known(series: Series | None) -> Series:
    assert series is not None
    return series


def flies_east(log: FlightLog, within_m: float = 1e-3) -> bool:
    """Whether it has every row of the flight, where it was."""
    east_m = known(log.position).values[:, 0]
    return at_rows(log.position).tolist() == list(range(ROWS)) and bool(np.abs(east_m - EAST_M).max() < within_m)
