"""What each kind of flight log calls its things: its messages' fields as a flight's, in ENU and FLU."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import swap_attitude, swap_enu_ned, to_xyzw
from sortie.fleet.logs.dataflash import Column, RawLog, is_numbers

Array = npt.NDArray[np.float64]
Table = Mapping[str, Column]

_NED_FIELDS = ("VN", "VE", "VD", "PN", "PE", "PD")
_FIELDS = {
    "GPS": ("Status", "Lat", "Lng", "Alt"),
    **dict.fromkeys(("XKF1", "NKF1", "EKF1"), _NED_FIELDS),
    "ATT": ("Roll", "Pitch", "Yaw"),
    **dict.fromkeys(("BAT", "CURR"), ("Volt", "Curr")),
    "RAD": ("RSSI",),
    "vehicle_gps_position": ("fix_type", "vel_n_m_s", "vel_e_m_s", "vel_d_m_s"),
    "vehicle_local_position": ("x", "y", "z", "vx", "vy", "vz", "xy_valid", "z_valid", "v_xy_valid", "v_z_valid"),
    "vehicle_attitude": ("q",),
    "battery_status": ("voltage_v", "current_a", "remaining"),
    "radio_status": ("rssi",),
    "input_rc": ("rssi",),
}
"""What is read of the messages of logs that describe themselves, and may be damaged where they do; MAVLink's are known."""
_WIDTHS = {"q": 4}
"""Fields with several numbers in each row."""
_FIX_FIELDS = ("latitude_deg", "longitude_deg", "altitude_msl_m")
"""PX4's from 1.14 on."""
_TIMES = ("TimeUS", "TimeMS", "timestamp")

_GPS_EPOCH_S = 315_964_800.0
"""1980-01-06 in seconds since 1970."""
_LEAP_WEEKS, _LEAP_S = (1695, 1851, 1930), 15
"""GPS weeks from which one leap second more counts, and how many there were before."""

Found = dict[str, tuple[Array, Array]]
"""Name of a FlightLog field → times, s by the log's clock, and values [K, C]; `fix` holds degrees and metres."""


def from_dataflash(raw: RawLog) -> tuple[Found, str]:
    tables, found = raw.tables, Found()
    if gps := _first_of(tables.get("GPS", {})):
        fixed = gps["Status"] >= 3
        found["fix"] = _stacked(_seconds(gps, "T")[fixed], *(gps[c][fixed] for c in ("Lat", "Lng", "Alt")))
    for name in ("XKF1", "NKF1", "EKF1"):
        if name in tables:
            table = _rows(tables[name], tables[name]["C"] == 0) if "C" in tables[name] else tables[name]
            ned = [np.stack([table[c] for c in columns], -1) for columns in (("PN", "PE", "PD"), ("VN", "VE", "VD"))]
            found["position"], found["velocity"] = ((_seconds(table), swap_enu_ned(each)) for each in ned)
            break
    if att := tables.get("ATT"):
        found["attitude"] = _seconds(att), _from_euler(att["Roll"], att["Pitch"], att["Yaw"], degrees=True)
    for name in ("BAT", "CURR"):
        if name in tables:
            table = _first_of(tables[name])
            unit = 0.01 if np.issubdtype(table["Volt"].dtype, np.integer) else 1.0
            known = _rows(table, table["Volt"] > 0)  # 0 V: nothing was measured yet
            found["battery"] = _stacked(_seconds(known), known["Volt"] * unit, known["Curr"] * unit)
            capacity = raw.parameters().get("BATT_CAPACITY", 0.0)
            # a count that stands at nothing is that of a pack whose current is not measured
            if "CurrTot" in table and capacity > 0 and (table["CurrTot"] > 0).any():
                found["charge"] = _stacked(_seconds(table), 1.0 - table["CurrTot"] / capacity)
            break
    if radio := tables.get("RAD"):
        found["rssi"] = _stacked(_seconds(radio), _sik_dbm(radio["RSSI"]))
    return found, "dBm"


def from_tlog(raw: RawLog) -> tuple[Found, str]:
    tables, found = raw.tables, Found()
    if fix := tables.get("GLOBAL_POSITION_INT"):
        fixed = (fix["lat"] != 0) | (fix["lon"] != 0)
        t_s = _seconds(fix)
        found["fix"] = _stacked(
            t_s[fixed], fix["lat"][fixed] * 1e-7, fix["lon"][fixed] * 1e-7, fix["alt"][fixed] * 1e-3
        )
        if fixed.any():
            ned = np.stack([fix[c][fixed] * 0.01 for c in ("vx", "vy", "vz")], -1)
            found["velocity"] = t_s[fixed], swap_enu_ned(ned)
    if local := tables.get("LOCAL_POSITION_NED"):
        t_s = _seconds(local)
        found["position"] = t_s, swap_enu_ned(np.stack([local[c] for c in "xyz"], -1))
        found["velocity"] = t_s, swap_enu_ned(np.stack([local[c] for c in ("vx", "vy", "vz")], -1))
    if exact := tables.get("ATTITUDE_QUATERNION"):
        wxyz = np.stack([exact[c] for c in ("q1", "q2", "q3", "q4")], -1)
        found["attitude"] = _seconds(exact), _from_quaternion(wxyz)
    elif euler := tables.get("ATTITUDE"):
        found["attitude"] = _seconds(euler), _from_euler(euler["roll"], euler["pitch"], euler["yaw"])
    if status := tables.get("SYS_STATUS"):
        known = (status["voltage_battery"] > 0) & (status["voltage_battery"] < 65535)
        t_s, current = _seconds(status), status["current_battery"] * 0.01
        current = np.where(status["current_battery"] < 0, np.nan, current)
        found["battery"] = _stacked(t_s[known], status["voltage_battery"][known] * 1e-3, current[known])
        counted = status["battery_remaining"] >= 0
        found["charge"] = _stacked(t_s[counted], status["battery_remaining"][counted] / 100)
    for name in ("RADIO_STATUS", "RADIO"):
        if name in tables:
            found["rssi"] = _stacked(_seconds(tables[name]), _sik_dbm(tables[name]["rssi"]))
            break
    return found, "dBm"


def from_ulog(raw: RawLog) -> tuple[Found, str]:
    tables, found, unit = raw.tables, Found(), "dBm"
    gps = tables.get("vehicle_gps_position", {})
    for names, degree, metre in ((("lat", "lon", "alt"), 1e-7, 1e-3), (_FIX_FIELDS, 1.0, 1.0)):
        if all(name in gps for name in names):
            fixed = gps["fix_type"] >= 3
            lat, lon, height = (gps[name][fixed] for name in names)
            t_s = _seconds(gps)[fixed]
            found["fix"] = _stacked(t_s, lat * degree, lon * degree, height * metre)
            ned = np.stack([gps[c][fixed] for c in ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")], -1)
            found["velocity"] = t_s, swap_enu_ned(ned)
    if local := tables.get("vehicle_local_position"):
        for name, columns, valid in (
            ("position", ("x", "y", "z"), ("xy_valid", "z_valid")),
            ("velocity", ("vx", "vy", "vz"), ("v_xy_valid", "v_z_valid")),
        ):
            sound = (local[valid[0]] != 0) & (local[valid[1]] != 0)
            if sound.any():
                found[name] = _seconds(local)[sound], swap_enu_ned(np.stack([local[c][sound] for c in columns], -1))
    if attitude := tables.get("vehicle_attitude"):
        found["attitude"] = _seconds(attitude), _from_quaternion(attitude["q"])
    if battery := tables.get("battery_status"):
        # PX4's unknowns: 0 V, −1 A, −1 of the charge
        known, counted, t_s = battery["voltage_v"] > 0, battery["remaining"] >= 0, _seconds(battery)
        current = np.where(battery["current_a"] == -1, np.nan, battery["current_a"])
        found["battery"] = _stacked(t_s[known], battery["voltage_v"][known], current[known])
        found["charge"] = _stacked(t_s[counted], battery["remaining"][counted])
    if radio := tables.get("radio_status"):
        found["rssi"] = _stacked(_seconds(radio), _sik_dbm(radio["rssi"]))
    elif remote := tables.get("input_rc"):
        unit, heard = "percent", remote["rssi"] >= 0
        found["rssi"] = _stacked(_seconds(remote)[heard], remote["rssi"][heard])
    return found, unit


def utc_at_zero_s(raw: RawLog) -> float | None:
    """Seconds since 1970 at which the log's clock is 0, by its GNSS or its own stamps; None where it does not say.

    The median over all fixes: a receiver's first times may be wrong.
    """
    if gps := _first_of(raw.tables.get("GPS", {})):
        for week, milliseconds in (("GWk", "GMS"), ("Week", "TimeMS")):
            if week in gps and milliseconds in gps and "Status" in gps and (fixed := gps["Status"] >= 3).any():
                weeks = gps[week][fixed].astype(np.float64)
                leap_s = np.searchsorted(_LEAP_WEEKS, weeks, side="right") + _LEAP_S
                utc_s = _GPS_EPOCH_S + weeks * 604_800 + gps[milliseconds][fixed] * 1e-3 - leap_s
                return float(np.median(utc_s - _seconds(gps, "T")[fixed]))
    gps = raw.tables.get("vehicle_gps_position", {})
    if "time_utc_usec" in gps and (known := gps["time_utc_usec"] > 0).any():
        return float(np.median(gps["time_utc_usec"][known] * 1e-6 - _seconds(gps)[known]))
    return raw.utc_s


def with_fields(tables: Mapping[str, Table], problems: list[str]) -> dict[str, Table]:
    """The tables that have a time and what is read of them, as numbers; the others are told."""
    whole = {}
    for name, columns in tables.items():
        table = columns
        if name in _FIELDS:
            table = {field: of for field, of in columns.items() if is_numbers(of, _WIDTHS.get(field))}
        lacks = [field for field in _FIELDS.get(name, ()) if field not in table]
        if name in _FIELDS and not any(time in table for time in _TIMES):
            lacks.append("time")
        if lacks:
            problems.append(f"{name} has no {', '.join(lacks)} and is left out")
        else:
            whole[name] = table
    return whole


def _seconds(table: Table, *others: str) -> Array:
    """A table's time by the log's own clock, s."""
    for name, unit in (*((other, 1e-3) for other in others), ("TimeUS", 1e-6), ("TimeMS", 1e-3), ("timestamp", 1e-6)):
        if name in table:
            return table[name].astype(np.float64) * unit
    raise KeyError("a message without a time, which `with_fields` leaves out")


def _rows(table: Table, rows: Column) -> Table:
    return {name: values[rows] for name, values in table.items()}


def _first_of(table: Table) -> Table:
    """The rows of the first of several devices, which ArduPilot's versions number under different names."""
    number = next((name for name in ("Instance", "Inst", "I") if name in table), None)
    return table if number is None else _rows(table, table[number] == 0)


def _stacked(t_s: Array, *columns: Column) -> tuple[Array, Array]:
    return t_s, np.stack([np.asarray(c, dtype=np.float64) for c in columns], axis=-1)


def _from_quaternion(wxyz: Column) -> Array:
    """w, x, y, z of FRD in NED to x, y, z, w of FLU in ENU; NaN where it is no rotation."""
    wxyz = np.asarray(wxyz, dtype=np.float64)
    norm = np.linalg.norm(wxyz, axis=-1, keepdims=True)
    sound = (norm > 0.5) & (norm < 2.0)
    unit = np.where(sound, wxyz, [1.0, 0.0, 0.0, 0.0])
    return np.where(sound, swap_attitude(to_xyzw(unit)), np.nan)


def _from_euler(roll: Column, pitch: Column, yaw: Column, degrees: bool = False) -> Array:
    """Roll, pitch, yaw of FRD in NED to x, y, z, w of FLU in ENU."""
    angles = np.stack([yaw, pitch, roll], axis=-1).astype(np.float64)
    sound = np.isfinite(angles.sum(axis=-1, keepdims=True))
    turned = Rotation.from_euler("ZYX", np.where(sound, angles, 0.0), degrees=degrees)
    return np.where(sound, swap_attitude(turned.as_quat()), np.nan)


def _sik_dbm(units: Column) -> Array:
    """SiK telemetry radios give 1.9 units a dB above −127 dBm; NaN for 255, MAVLink's unknown."""
    return np.where(np.asarray(units) == 255, np.nan, np.asarray(units, dtype=np.float64) / 1.9 - 127.0)
