"""A real flight, whatever wrote it down: pose, velocity, battery and RSSI over time in the simulator's frames.

Reads ArduPilot's DataFlash (*.bin), MAVLink telemetry (*.tlog) and PX4's ULog (*.ulg), told apart by their first
bytes. Nothing is invented: what a log does not have is None, gaps stay gaps, and damage, restarts, gaps and what was
left out are told in `problems`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import swap_attitude, swap_enu_ned, to_xyzw
from sortie.fleet.logs.dataflash import Column, RawLog, is_dataflash, read_dataflash
from sortie.fleet.logs.ulog import is_ulog, read_ulog
from sortie.scenarios.errors import SortieError

Array = npt.NDArray[np.float64]
Table = Mapping[str, Column]

MAX_BYTES = 2_000_000_000
FAR_M = 20_000.0
"""Positions further from the flight's median are taken for errors."""
FAST_MPS = 200.0
GAP_S = 1.0
BACK_S = 0.5
"""A clock that steps back by more has been restarted."""


class LogError(SortieError):
    """A file is no flight log, or holds nothing to fly; the message names it."""


@dataclass(frozen=True, slots=True)
class Series:
    """Samples over time: time_s [K] increasing from the log's begin, values [K, C]."""

    time_s: Array
    values: Array


@dataclass(frozen=True, slots=True)
class FlightLog:
    """One vehicle's flight; ENU, FLU, x y z w; None is what the log does not have."""

    kind: str
    """DataFlash, MAVLink telemetry or ULog."""
    duration_s: float
    position: Series | None
    """x_m, y_m, z_m from the first position."""
    velocity: Series | None
    """vx_mps, vy_mps, vz_mps."""
    attitude: Series | None
    """qx, qy, qz, qw."""
    battery: Series | None
    """voltage_v, current_a; a current that is not measured is NaN."""
    charge: Series | None
    """State of charge, 0 … 1, that never rises."""
    rssi: Series | None
    """Of the vehicle's radio: dBm, or percent where rssi_unit says so."""
    rssi_unit: str
    origin_deg: tuple[float, float] | None
    """Latitude and longitude of the first fix."""
    parameters: Mapping[str, float]
    problems: tuple[str, ...]


def read_log(path: str | Path) -> FlightLog:
    """Read a flight log of any kind.

    Raises:
        LogError: no such file, none of the three kinds, or nothing in it that moves or drains.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise LogError(f"{path}: {path.stat().st_size} bytes, must be at most {MAX_BYTES}")
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read, {error.strerror or error}") from None
    if is_dataflash(data):
        log = _assemble("DataFlash", read_dataflash(data), _from_dataflash)
    elif is_ulog(data):
        log = _assemble("ULog", read_ulog(data), _from_ulog)
    else:
        from sortie.fleet.logs.mavlink import is_tlog, read_tlog  # pymavlink is loaded for such a log alone

        if not is_tlog(data):
            raise LogError(f"{path}: is no DataFlash log (.bin), MAVLink telemetry (.tlog) or ULog (.ulg)")
        log = _assemble("MAVLink telemetry", read_tlog(data), _from_tlog)
    if log.position is None and log.attitude is None and log.battery is None:
        told = "; ".join(log.problems)
        raise LogError(f"{path}: holds no position, attitude or battery" + (f" ({told})" if told else ""))
    return log


# --- what each kind calls its things ---------------------------------------------------------------

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
_FIX_FIELDS = ("latitude_deg", "longitude_deg", "altitude_msl_m")
"""PX4's from 1.14 on."""
_TIMES = ("TimeUS", "TimeMS", "timestamp")

_Found = dict[str, tuple[Array, Array]]
"""Name of a FlightLog field → times, s by the log's clock, and values [K, C]; `fix` holds degrees and metres."""


def _from_dataflash(raw: RawLog) -> tuple[_Found, str]:
    tables, found = raw.tables, _Found()
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
            found["battery"] = _stacked(_seconds(table), table["Volt"] * unit, table["Curr"] * unit)
            capacity = raw.parameters().get("BATT_CAPACITY", 0.0)
            # a count that stands at nothing is that of a pack whose current is not measured
            if "CurrTot" in table and capacity > 0 and (table["CurrTot"] > 0).any():
                found["charge"] = _stacked(_seconds(table), 1.0 - table["CurrTot"] / capacity)
            break
    if radio := tables.get("RAD"):
        found["rssi"] = _stacked(_seconds(radio), _sik_dbm(radio["RSSI"]))
    return found, "dBm"


def _from_tlog(raw: RawLog) -> tuple[_Found, str]:
    tables, found = raw.tables, _Found()
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


def _from_ulog(raw: RawLog) -> tuple[_Found, str]:
    tables, found, unit = raw.tables, _Found(), "dBm"
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
            sound = local[valid[0]] & local[valid[1]]
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


# --- what all kinds have in common -----------------------------------------------------------------


def _assemble(kind: str, raw: RawLog, translate: Callable[[RawLog], tuple[_Found, str]]) -> FlightLog:
    """One clock from zero, sound values, and a list of what was not."""
    problems = list(raw.problems)
    several = sorted(name for name in raw.tables if name.startswith("battery_status."))
    if several:
        problems.append(f"{len(several) + 1} batteries, the first is taken")
    found, unit = translate(RawLog(_with_fields(raw.tables, problems), raw.problems))
    found = {name: _sound(name, *each, problems) for name, each in found.items() if len(each[0])}
    found = {name: each for name, each in found.items() if len(each[0])}
    origin = None
    if (fix := found.pop("fix", None)) is not None:
        near = _near(local_m(fix[1]), [] if "position" in found else problems)  # before one of them becomes the origin
        if near.any():
            degrees = fix[1][near]
            origin = float(degrees[0, 0]), float(degrees[0, 1])
            found.setdefault("position", (fix[0][near], local_m(degrees)))
    begin_s = min((t_s[0] for t_s, _ in found.values()), default=0.0)
    end_s = max((t_s[-1] for t_s, _ in found.values()), default=0.0)
    series = {}
    for name, (t_s, values) in found.items():
        if name == "position":
            near = _near(values, problems)
            t_s, values = t_s[near], values[near] - values[near][:1]
        if name == "velocity":
            slow = np.linalg.norm(values, axis=-1) <= FAST_MPS
            if not slow.all():
                problems.append(f"{(~slow).sum()} velocities above {FAST_MPS:g} m/s are left out")
            t_s, values = t_s[slow], values[slow]
        if name == "charge":
            values = _falling(values, problems)
        if len(t_s):
            problems.extend(_gaps(name, t_s - begin_s))
            series[name] = Series(t_s - begin_s, values)
    return FlightLog(
        kind=kind,
        duration_s=end_s - begin_s,
        position=series.get("position"),
        velocity=series.get("velocity"),
        attitude=series.get("attitude"),
        battery=series.get("battery"),
        charge=series.get("charge"),
        rssi=series.get("rssi"),
        rssi_unit=unit,
        origin_deg=origin,
        parameters=raw.parameters(),
        problems=tuple(problems),
    )


def _sound(name: str, t_s: Array, values: Array, problems: list[str]) -> tuple[Array, Array]:
    """Finite rows of the longest stretch in which the clock runs forward, a row at a time."""
    finite = np.isfinite(t_s) & np.isfinite(values[:, :1] if name == "battery" else values).all(axis=-1)
    if not finite.all():
        problems.append(f"{(~finite).sum()} rows of {name} are not finite and are left out")
    t_s, values = t_s[finite], values[finite]
    restarts = np.flatnonzero(np.diff(t_s) < -BACK_S) + 1
    if len(restarts):
        pieces = np.split(np.arange(len(t_s)), restarts)
        longest = max(pieces, key=len)
        problems.append(f"the clock of {name} restarts {len(restarts)} times; the longest stretch is taken")
        t_s, values = t_s[longest], values[longest]
    forward = np.concatenate([[True], t_s[1:] > np.maximum.accumulate(t_s)[:-1]]) if len(t_s) else np.zeros(0, bool)
    return t_s[forward], values[forward]


def _with_fields(tables: Mapping[str, Table], problems: list[str]) -> dict[str, Table]:
    """The tables that have a time and what is read of them; the others are told."""
    whole = {}
    for name, table in tables.items():
        lacks = [field for field in _FIELDS.get(name, ()) if field not in table]
        if name in _FIELDS and not any(time in table for time in _TIMES):
            lacks.append("time")
        if lacks:
            problems.append(f"{name} has no {', '.join(lacks)} and is left out")
        else:
            whole[name] = table
    return whole


def _near(metres: Array, problems: list[str]) -> npt.NDArray[np.bool_]:
    """Which places [K, 3] are no errors."""
    near: npt.NDArray[np.bool_] = np.linalg.norm(metres - np.median(metres, axis=0), axis=-1) <= FAR_M
    if not near.all():
        problems.append(f"{(~near).sum()} positions lie over {FAR_M / 1000:g} km off and are left out")
    return near


def _falling(values: Array, problems: list[str]) -> Array:
    """A charge within 0 … 1 that never rises."""
    values = np.clip(values, 0.0, 1.0)
    held = np.minimum.accumulate(values, axis=0)
    if (rise := float((values - held).max())) > 0.005:
        problems.append(f"the charge rises by up to {rise:.1%}; it is held")
    return held


def _gaps(name: str, t_s: Array) -> list[str]:
    """Pauses of more than a second and five usual intervals."""
    if len(t_s) < 3:
        return []
    steps = np.diff(t_s)
    long = np.flatnonzero(steps > max(GAP_S, 5 * float(np.median(steps))))
    if not len(long):
        return []
    worst = long[np.argmax(steps[long])]
    return [f"{name}: {len(long)} gaps, the longest {steps[worst]:.1f} s at {t_s[worst]:.1f} s"]


def local_m(fixes: Array) -> Array:
    """Latitudes and longitudes in degrees and altitudes in metres as ENU metres from the first, [K, 3].

    On the plane tangent to the WGS-84 ellipsoid at the first, with its two radii of curvature: the inverse of
    `sortie.fleet.logs.mavlink.geodetic`.
    """
    a, e2 = 6378137.0, 6.69437999014e-3
    lat, lon, alt = (math.radians(fixes[0, 0]), fixes[0, 1], fixes[0, 2])
    w = math.sqrt(1 - e2 * math.sin(lat) ** 2)
    north = np.radians(fixes[:, 0] - fixes[0, 0]) * (a * (1 - e2) / w**3 + alt)
    east = np.radians((fixes[:, 1] - lon + 180) % 360 - 180) * (a / w + alt) * math.cos(lat)
    return np.stack([east, north, fixes[:, 2] - alt], axis=-1)


def _seconds(table: Table, *others: str) -> Array:
    """A table's time by the log's own clock, s."""
    for name, unit in (*((other, 1e-3) for other in others), ("TimeUS", 1e-6), ("TimeMS", 1e-3), ("timestamp", 1e-6)):
        if name in table:
            return table[name].astype(np.float64) * unit
    raise LogError(f"a message without a time: {', '.join(table)}")


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
    sound = np.linalg.norm(wxyz, axis=-1, keepdims=True) > 0.5
    unit = np.where(sound, wxyz, [1.0, 0.0, 0.0, 0.0])
    return np.where(sound, swap_attitude(to_xyzw(unit)), np.nan)


def _from_euler(roll: Column, pitch: Column, yaw: Column, degrees: bool = False) -> Array:
    """Roll, pitch, yaw of FRD in NED to x, y, z, w of FLU in ENU."""
    angles = np.stack([yaw, pitch, roll], axis=-1).astype(np.float64)
    sound = np.isfinite(angles.sum(axis=-1, keepdims=True))
    turned = Rotation.from_euler("ZYX", np.where(sound, angles, 0.0), degrees=degrees)
    return np.where(sound, swap_attitude(turned.as_quat()), np.nan)


def _sik_dbm(units: Column) -> Array:
    """SiK telemetry radios give 1.9 units a dB above −127 dBm."""
    return np.asarray(units, dtype=np.float64) / 1.9 - 127.0
