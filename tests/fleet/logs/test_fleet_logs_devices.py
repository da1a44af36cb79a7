"""Of several batteries, receivers and estimators: which one is taken; and what is known of live vehicles."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from log_tables import CHARGE, DEGREE_M, EAST_M, ROWS, T_S, Tables, assembled, at_rows, flies_east, known, ulog
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sortie.fleet.logs.fields import from_dataflash
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.vehicle import VehicleState, after


def gnss(status: float = 3, lon_deg: np.ndarray | float = 8 + EAST_M / DEGREE_M) -> dict[str, Any]:
    """A receiver's rows in PX4's fields."""
    of = {"latitude_deg": 0.0, "longitude_deg": lon_deg, "altitude_msl_m": 0.0, "fix_type": status}
    of |= {"vel_n_m_s": 0.0, "vel_e_m_s": 5.0, "vel_d_m_s": 0.0}
    return {name: np.full(ROWS, value, float) for name, value in of.items()} | {"timestamp": np.round((5 + T_S) * 1e6)}


def test_the_first_battery_that_is_connected_is_taken() -> None:
    """Noise of no pack is none; where two packs count, the longer one is."""
    real = ulog()["battery_status"] | {"cell_count": np.full(ROWS, 3), "capacity": np.full(ROWS, 4500.0)}
    noise = ulog()["battery_status"] | {"voltage_v": np.full(ROWS, 0.3), "remaining": np.zeros(ROWS)}
    short = ulog()["battery_status"] | {"voltage_v": np.r_[np.full(10, 24.0), np.zeros(90)]}
    none = "battery is read from battery_status.1: 0 of 100 rows of battery_status count"
    for first, said in (
        (None, None),
        (noise | {"connected": np.zeros(ROWS)}, none),
        (noise, none),
        (short, "2 batteries, battery_status.1 is taken"),
    ):
        tables = ulog() | {"battery_status.1": real}
        tables.pop("battery_status")
        log = assembled(tables if first is None else tables | {"battery_status": first})
        assert said is None or said in log.problems
        assert (log.cells, log.capacity_ah) == (3, 4.5)
        assert set(known(log.battery).values[:, 0]) == {12.3}
        assert at_rows(log.charge).tolist() == list(range(ROWS))


def test_the_first_receiver_with_a_fix_is_taken() -> None:
    for topic in ("vehicle_gps_position", "sensor_gps"):
        tables = {"battery_status": ulog()["battery_status"], f"{topic}.1": gnss()}
        assert assembled(tables).origin_deg == (0.0, 8.0)
        log = assembled(tables | {topic: gnss(status=1, lon_deg=9.0)})
        assert flies_east(log)
        assert f"position is read from {topic}.1: 0 of 100 rows of {topic} count" in log.problems


def test_the_estimator_that_flies_is_taken() -> None:
    """PX4 runs several, and switches from 0 to 1 after 4 s, where 0 begins to drift."""
    drift = np.where(T_S >= 4, 50.0, 0.0)
    local = ulog()["vehicle_local_position"]
    tables = {f"estimator_local_position.{k}": local | {"y": EAST_M + drift * (k == 0)} for k in (1, 2)}
    tables["estimator_local_position"] = local | {"y": EAST_M + drift}
    selected = {"timestamp": np.array([5e6, 9e6]), "primary_instance": np.array([0, 1])}
    assert flies_east(assembled(tables | {"estimator_selector_status": selected}))
    assert flies_east(assembled({"vehicle_local_position.1": local}))


# --- ArduPilot's ------------------------------------------------------------------------------------------


def dataflash() -> Tables:
    at = {"TimeUS": np.round((5 + T_S) * 1e6)}
    zero, one = np.zeros(ROWS), np.ones(ROWS)
    return {
        "GPS": at | {"I": zero, "Status": 3 * one, "Lat": zero, "Lng": EAST_M / DEGREE_M + 1e-9, "Alt": zero},
        "XKF1": at | {"C": zero, "PN": zero, "PE": EAST_M, "PD": -20 * one, "VN": zero, "VE": 5 * one, "VD": zero},
        "BAT": at | {"Inst": zero, "Volt": 12.3 * one, "Curr": 10 * one, "CurrTot": (1 - CHARGE) * 5000},
    }


def beside(table: dict[str, Any], column: str, **changes: Any) -> dict[str, Any]:
    """A device's rows and those of a second one, in turn."""
    second = table | {column: np.ones(ROWS), **{name: np.full(ROWS, value, float) for name, value in changes.items()}}
    return {name: np.stack([table[name], second[name]], axis=1).ravel() for name in table}


def renamed(tables: Tables, name: str, to: str, without: str) -> None:
    """A message under the name that versions give to a second device, without the device's number."""
    tables[to] = tables.pop(name)
    tables[to].pop(without)


def two_receivers(tables: Tables, first: float, **second: float) -> None:
    """Both in turn, with these states of their fixes, and no estimator."""
    del tables["XKF1"]
    tables["GPS"] = beside(tables["GPS"] | {"Status": np.full(ROWS, first)}, "I", Status=3, **second)


def two_cores(tables: Tables, *east_m: np.ndarray, flies_by: int | None = None) -> None:
    tables["XKF1"] = beside(tables["XKF1"], "C")
    tables["XKF1"]["PE"] = np.stack(east_m, axis=1).ravel()
    if flies_by is not None:
        tables["XKF4"] = {"TimeUS": tables["BAT"]["TimeUS"], "PI": np.full(ROWS, float(flies_by))}


def places_alone(tables: Tables) -> None:
    tables["POS"] = {c: tables["GPS"][c] for c in ("TimeUS", "Lat", "Lng", "Alt")}
    del tables["XKF1"], tables["GPS"]


def old_name(tables: Tables) -> None:
    """ArduPilot calls the column Instance up to 4.0 and Inst since."""
    tables["BAT"] = beside(tables["BAT"], "Inst", Volt=24.0, CurrTot=0.0)
    tables["BAT"]["Instance"] = tables["BAT"].pop("Inst")


DEVICES: dict[str, tuple[Callable[[Tables], object], float]] = {
    "battery 1": (lambda t: t["BAT"].update(Inst=np.ones(ROWS)), 5.0),
    "noise": (lambda t: t.update(BAT=beside(t["BAT"] | {"Volt": np.full(ROWS, 0.3)}, "Inst", Volt=12.3)), 5.0),
    "two batteries": (lambda t: t.update(BAT=beside(t["BAT"], "Inst", Volt=24.0, CurrTot=0.0)), 9.0),
    "two batteries of old": (old_name, 9.0),
    "BAT2": (lambda t: renamed(t, "BAT", "BAT2", "Inst"), 5.0),
    "CURR2": (lambda t: renamed(t, "BAT", "CURR2", "Inst"), 5.0),
    "GPS 1": (lambda t: t["GPS"].update(I=np.ones(ROWS)) or t.pop("XKF1"), 9.0),
    "no fix": (lambda t: two_receivers(t, 1), 9.0),
    "two fixes": (lambda t: two_receivers(t, 3, Lat=1e-3), 9.0),
    "GPS2": (lambda t: renamed(t, "GPS", "GPS2", "I") or t.pop("XKF1"), 9.0),
    "core 1": (lambda t: t["XKF1"].update(C=np.ones(ROWS)), 9.0),
    "two cores": (lambda t: two_cores(t, EAST_M, EAST_M * 2), 9.0),
    "lane switch": (lambda t: two_cores(t, EAST_M * 2, EAST_M, flies_by=1), 9.0),
    "POS": (places_alone, 9.0),
}
"""What is there, and the capacity that belongs to the battery: the second one has its own."""


def test_whichever_of_ardupilot_s_devices_is_there_is_taken() -> None:
    for name, (change, capacity_ah) in DEVICES.items():
        tables = dataflash()
        change(tables)
        log = assembled(tables, from_dataflash, BATT_CAPACITY=9000.0, BATT2_CAPACITY=5000.0)
        assert flies_east(log), name
        assert np.abs(known(log.position).values[:, 1]).max() < 1e-3, name
        assert set(known(log.battery).values[:, 0]) == {12.3}, name
        assert log.capacity_ah == capacity_ah, name
        used = 1 - known(log.charge).values[:, 0]
        np.testing.assert_allclose(used, (1 - CHARGE) * 5 / capacity_ah, atol=1e-9, err_msg=name)


def test_cells_and_capacity_are_the_log_s_own() -> None:
    """Where the log does not say, or says what no cell has, the voltage decides; a single sample does not."""
    once = np.r_[np.full(50, 12.5), 12.9, np.full(49, 12.5)]
    rows: list[tuple[int | None, Any, dict[str, float], tuple[int, float | None]]] = [
        (None, 12.3, {}, (3, None)),
        (None, 13.05, {"BAT1_N_CELLS": 3.0, "BAT1_CAPACITY": 4500.0}, (3, 4.5)),
        (6, 21.0, {"BAT1_CAPACITY": -1.0}, (6, None)),
        (0, 21.0, {"BAT_N_CELLS": 6.0, "BAT_CAPACITY": 4500.0}, (6, 4.5)),
        (3, 24.9, {}, (6, None)),
        (None, once, {}, (3, None)),
    ]
    for cells, volts, parameters, wanted in rows:
        tables = ulog()
        tables["battery_status"]["voltage_v"] = np.zeros(ROWS) + volts
        if cells is not None:
            tables["battery_status"]["cell_count"] = np.full(ROWS, cells)
        log = assembled(tables, **parameters)
        assert (log.cells, log.capacity_ah) == wanted, (cells, parameters)
        assert ("3 cells would have 8.3 V each; 6 are taken" in log.problems) == (cells == 3)


# --- live vehicles ----------------------------------------------------------------------------------------


def heard(*said: tuple[tuple[int, int], str, tuple[Any, ...]], origin: Origin | None = None) -> VehicleState:
    """After these messages of these senders, a second apart."""
    state = VehicleState()
    for second, (sender, name, values) in enumerate(said, 1):
        message = getattr(dialect, f"MAVLink_{name}_message")(*values)
        message._header.srcSystem, message._header.srcComponent = sender
        state = after(state, message, float(second), origin)
    return state


HEARTBEAT = ((1, 1), "heartbeat", (2, 3, 0, 0, 4, 3))


def test_a_live_vehicle_is_its_autopilot_alone() -> None:
    level, down = (0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0, 0.0, -1.3, 0.0, 0.0, 0.0, 0.0)
    computer = ((1, 191), "heartbeat", (18, 3, 0, 0, 4, 3))
    state = heard(computer, HEARTBEAT, computer, ((1, 1), "attitude", level), ((1, 154), "attitude", down))
    assert (state.system, state.component, state.others) == (1, 1, 2)
    assert state.orientation_xyzw == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))


def battery(number: int, left: int) -> tuple[tuple[int, int], str, tuple[Any, ...]]:
    return (1, 1), "battery_status", (number, 0, 1, 0, [65535] * 10, 100, 0, 0, left)


def system(left: int) -> tuple[tuple[int, int], str, tuple[Any, ...]]:
    return (1, 1), "sys_status", (0, 0, 0, 0, 0, 0, left, *[0] * 6)


def test_a_live_charge_is_that_of_the_first_battery_that_knows_it() -> None:
    """What is not known keeps the charge of before."""
    rows = [
        ((battery(1, 40),), 0.4),
        ((system(-1), battery(1, 40), battery(2, 30)), 0.4),
        ((battery(1, 40), battery(0, 60), battery(1, 39)), 0.6),
        ((battery(1, 40), system(50), battery(1, 39)), 0.5),
        ((system(50), system(-1)), 0.5),
        ((battery(0, 40), battery(0, -1), battery(0, 127), battery(0, 101)), 0.4),
    ]
    assert [heard(HEARTBEAT, *said).soc for said, _ in rows] == [soc for _, soc in rows]


def test_a_height_is_that_above_the_origin_and_not_above_home() -> None:
    """GLOBAL_POSITION_INT has both: a vehicle that took off from a hill is where it is. 0° and 0° is no place yet."""
    place = (0, 470_000_000, 80_000_000, 430_000, 5_000, 100, 200, -50, 0)
    nowhere = ((1, 1), "global_position_int", (0, 0, 0, 17_000, 0, 0, 0, 0, 0))
    at = Origin(47.0, 8.0, 400.0)
    state = heard(HEARTBEAT, ((1, 1), "global_position_int", place), origin=at)
    assert state.position_m == pytest.approx((0.0, 0.0, 30.0))
    assert state.velocity_mps == pytest.approx((2.0, 1.0, 0.5))
    assert (state.heartbeat_s, state.position_s, state.attitude_s) == (1.0, 2.0, -math.inf)
    assert state.pose_s == -math.inf
    assert heard(HEARTBEAT, nowhere, origin=at) == heard(HEARTBEAT, origin=at)


def test_a_local_place_counts_only_where_no_origin_is_given() -> None:
    local = ((1, 1), "local_position_ned", (0, 1.0, 2.0, -3.0, 4.0, 5.0, -6.0))
    assert heard(HEARTBEAT, local).position_m == (2.0, 1.0, 3.0)
    at = Origin(47.0, 8.0, 400.0)
    assert heard(HEARTBEAT, local, origin=at) == heard(HEARTBEAT, origin=at)
