"""A pack's data from a flight log, and the voltage that they predict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from research.validation.identify import hovering, predicted_voltage, voltage_error
from sortie.fleet.energy.cell import terminal_voltage_v
from sortie.fleet.logs.dataflash import RawLog
from sortie.fleet.logs.fields import from_dataflash, from_tlog, from_ulog
from sortie.fleet.logs.flightlog import FlightLog, LogError, Series, _assemble
from sortie.scenarios.schema import Battery


def assembled(kind: str, **tables: dict[str, list[object]]) -> FlightLog:
    """A log of some tables, a row every tenth of a second."""
    stamp, translate = {
        "ULog": ("timestamp", from_ulog),
        "DataFlash": ("TimeUS", from_dataflash),
        "MAVLink telemetry": ("timestamp", from_tlog),
    }[kind]
    columns = {name: {k: np.array(v) for k, v in table.items()} for name, table in tables.items()}
    for name, table in columns.items():
        if name != "PARM":
            table[stamp] = np.arange(len(next(iter(table.values())))) * 100_000
    return _assemble(Path("a.log"), kind, RawLog(columns, ()), translate)


def test_a_pack_is_not_identified_without_a_current() -> None:
    unmeasured = {"voltage_v": [16.0] * 3, "current_a": [-1.0] * 3, "remaining": [0.9, 0.8, 0.7]}
    with pytest.raises(LogError, match=r"^a\.log: its current was not measured$"):
        predicted_voltage(assembled("ULog", battery_status=unmeasured), Battery())  # type: ignore[arg-type]


def series(time_s: Any, *columns: Any) -> Series:
    return Series(np.asarray(time_s, float), np.stack([np.asarray(c, float) for c in columns], axis=-1))


def flight(name: str = "a.log", system: int | None = None, begin_s: float = 0.0, **changes: Any) -> FlightLog:
    """A flight of ten seconds of which nothing is known but what is given."""
    nothing: dict[str, Any] = dict.fromkeys(("position", "velocity", "attitude", "battery", "charge", "rssi", "fix"))
    return FlightLog(
        **{"path": Path(name), "system": system, "kind": "ULog", "begin_s": begin_s, "duration_s": 10.0,
           "rssi_unit": "dBm", "parameters": {}, "problems": (), **nothing} | changes
    )  # fmt: skip


# --- stretches -----------------------------------------------------------------------------------------


MEASURED = flight(
    battery=series(np.arange(0.0, 10.0), [16.0, 15.8, 15.6, 15.5, 15.4, 15.3, 15.2, 15.1, 15.0, 14.9], [np.nan, *[10.0] * 9]),
    charge=series([0.0, 10.0], [0.9, 0.7]),
    velocity=series(np.arange(0.0, 10.0), [0, 0, 0, 3, 0, 0, 0, 0, 0, 0], [0.0] * 10, [0, 0, 0, 0, 0, -2, 0, 2, 0, 0]),
)  # fmt: skip


def test_a_drone_hovers_where_it_neither_moves_nor_climbs_nor_descends() -> None:
    """Of the rows with a current, from the first time on and before the last."""
    assert np.flatnonzero(hovering(MEASURED, 0.0, 9.0)).tolist() == [k - 1 for k in (1, 2, 4, 6, 8)]
    assert np.flatnonzero(hovering(MEASURED, 2.0, 6.0)).tolist() == [1, 3]


def test_a_voltage_is_predicted_from_the_charge_at_its_first_row() -> None:
    """That is the first with a current, one second in: a tenth of the fall from 0.9 to 0.7 is over by then."""
    pack = Battery(cells=4, capacity_wh=60)
    predicted = predicted_voltage(MEASURED, pack)
    time_s = np.arange(1.0, 10.0)
    np.testing.assert_array_equal(predicted.time_s, time_s)
    np.testing.assert_allclose(predicted.values, terminal_voltage_v(time_s, np.full(9, 10.0), pack, 0.88))
    volts = np.array([15.6, 15.5, 15.4])
    wanted = np.sqrt(np.mean(((predicted.values[1:4] - volts) / volts) ** 2))
    assert voltage_error(MEASURED, pack, 2.0, 5.0) == pytest.approx(float(wanted))
