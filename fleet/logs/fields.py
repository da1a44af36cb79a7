"""What each kind of flight log calls its things: its messages' fields as a flight's, in ENU and FLU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import swap_attitude, swap_enu_ned, to_xyzw
from sortie.fleet.logs.clocks import longest_stretch
from sortie.fleet.logs.dataflash import Column, RawLog, is_numbers
from sortie.fleet.logs.sources import Source

Array = npt.NDArray[np.float64]
Table = Mapping[str, Column]

_NED_FIELDS = ("VN", "VE", "VD", "PN", "PE", "PD")
_GNSS_FIELDS = ("fix_type", "vel_n_m_s", "vel_e_m_s", "vel_d_m_s")
_LOCAL_FIELDS = ("x", "y", "z", "vx", "vy", "vz", "xy_valid", "z_valid", "v_xy_valid", "v_z_valid")
_FIELDS = {
    **dict.fromkeys(("GPS", "GPS2"), ("Status", "Lat", "Lng", "Alt")),
    **dict.fromkeys(("XKF1", "XKF6", "NKF1", "NKF6", "EKF1"), _NED_FIELDS),
    "ATT": ("Roll", "Pitch", "Yaw"),
    **dict.fromkeys(("BAT", "BAT2", "CURR", "CURR2"), ("Volt", "Curr")),
    "RAD": ("RSSI",),
    **dict.fromkeys(("vehicle_gps_position", "sensor_gps"), _GNSS_FIELDS),
    **dict.fromkeys(("vehicle_local_position", "estimator_local_position"), _LOCAL_FIELDS),
    **dict.fromkeys(("vehicle_attitude", "estimator_attitude"), ("q",)),
    "battery_status": ("voltage_v", "current_a", "remaining"),
    "radio_status": ("rssi",),
    "input_rc": ("rssi",),
}
"""What is read of the messages of logs that describe themselves, and may be damaged where they do; MAVLink's are known."""
_HELPS = {
    "POS": ("Lat", "Lng", "Alt"),
    "AHR2": ("Roll", "Pitch", "Yaw"),
    "BCL": ("V1",),
    **dict.fromkeys(("XKF4", "NKF4"), ("PI",)),
    "estimator_selector_status": ("primary_instance",),
    **dict.fromkeys(("vehicle_global_position", "estimator_global_position"), ("lat", "lon", "alt")),
}
"""The same of messages that are read where others say nothing, or say which of them counts: not missed where damaged."""
_MAVLINK = frozenset(
    [
        "LOCAL_POSITION_NED",
        "GLOBAL_POSITION_INT",
        "GPS_RAW_INT",
        "GPS2_RAW",
        "ATTITUDE_QUATERNION",
        "ATTITUDE",
        "SYS_STATUS",
        "BATTERY_STATUS",
        "RADIO_STATUS",
        "RADIO",
    ]
)
_WIDTHS = {"q": 4}
"""Fields with several numbers in each row."""
_FIX_FIELDS = ("latitude_deg", "longitude_deg", "altitude_msl_m")
"""PX4's from 1.14 on."""
_MOST_DEVICES, _MOST_CELLS = 16, 24
CELL_V = 2.0, 5.0
"""A cell has no less and no more."""
_NUMBER = re.compile("[0-9]{0,3}")
_TIMES = ("TimeUS", "TimeMS", "timestamp")

_GPS_EPOCH_S = 315_964_800.0
"""1980-01-06 in seconds since 1970."""
_LEAP_WEEKS, _LEAP_S = (1695, 1851, 1930), 15
"""GPS weeks from which one leap second more counts, and how many there were before."""

_NO_FIX, _NOWHERE = "are without a fix", "are from before the fix (0° N, 0° E)"
_UNKNOWN, _UNPLUGGED = "are unknown", "are of a battery that is not connected"


@dataclass(frozen=True, slots=True)
class Pack:
    """What a log says of a battery; None where it does not."""

    cells: int | None = None
    capacity_mah: float | None = None


@dataclass(slots=True)
class Found:
    """What the senders of a log say."""

    sources: dict[str, list[Source]] = field(default_factory=dict)
    """Field of a `FlightLog` → its sources, the first one first."""
    packs: dict[int, Pack] = field(default_factory=dict)
    """Batteries by number."""
    rssi_unit: str = "dBm"

    def add(self, what: str, source: Source) -> None:
        """A further source of a field."""
        self.sources.setdefault(what, []).append(source)


def from_dataflash(raw: RawLog) -> Found:
    tables, found = raw.tables, Found()
    for name, number, gps in _devices(tables, "GPS", "GPS2"):
        refused = {_NO_FIX: gps["Status"] < 3, _NOWHERE: (gps["Lat"] == 0) & (gps["Lng"] == 0)}
        values = _stacked(*(gps[c] for c in ("Lat", "Lng", "Alt")))
        found.add("fix", Source(name, seconds("GPS", gps), values, refused, number))
    if place := tables.get("POS"):
        values = _stacked(*(place[c] for c in ("Lat", "Lng", "Alt")))
        nowhere = (place["Lat"] == 0) & (place["Lng"] == 0)
        found.add("fix", Source("POS", seconds("POS", place), values, {_NOWHERE: nowhere}))
    for what, columns in (("position", ("PN", "PE", "PD")), ("velocity", ("VN", "VE", "VD"))):
        for family in (("XKF1", "XKF6"), ("NKF1", "NKF6"), ("EKF1",)):
            cores = [
                Source(name, seconds(name, core), swap_enu_ned(_stacked(*(core[c] for c in columns))), {}, number)
                for name, number, core in _devices(tables, *family)
            ]
            leader = tables.get(family[0].replace("1", "4"), {})
            for core in _led(cores, leader, "PI"):
                found.add(what, core)
    for name in ("ATT", "AHR2"):
        if table := tables.get(name):
            values = _from_euler(table["Roll"], table["Pitch"], table["Yaw"], degrees=True)
            found.add("attitude", Source(name, seconds(name, table), values))
    parameters = raw.parameters()
    cells = {number: _cell_count(table) for _, number, table in _devices(tables, "BCL")}
    for name, number, table in _devices(tables, "BAT", "BAT2") or _devices(tables, "CURR", "CURR2"):
        t_s = seconds(name, table)
        unit = 0.01 if np.issubdtype(table["Volt"].dtype, np.integer) else 1.0
        measured = _stacked(table["Volt"] * unit, table["Curr"] * unit)
        found.add("battery", Source(name, t_s, measured, {_UNKNOWN: table["Volt"] <= 0}, number))
        pack = found.packs[number] = _pack(parameters, number, cells.get(number))
        used, left = table.get("CurrTot"), table.get("RemPct")
        # a count that stands at nothing is that of a pack whose current is not measured
        if used is not None and pack.capacity_mah and (used > 0).any():
            counted = np.maximum(1.0 - used / pack.capacity_mah, 0.0)
            found.add("charge", Source(name, t_s, _stacked(counted), {}, number))
        elif left is not None and (left > 0).any():
            found.add("charge", Source(name, t_s, _stacked(left / 100), {}, number))
    if radio := tables.get("RAD"):
        found.add("rssi", Source("RAD", seconds("RAD", radio), _stacked(_sik_dbm(radio["RSSI"]))))
    return found


def from_tlog(raw: RawLog) -> Found:
    tables, found = raw.tables, Found()
    for name in ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"):
        if table := tables.get(name):
            t_s, local = seconds(name, table), name == "LOCAL_POSITION_NED"
            refused = {} if local else {_NOWHERE: (table["lat"] == 0) & (table["lon"] == 0)}
            velocity = swap_enu_ned(_stacked(*(table[c] * (1.0 if local else 0.01) for c in ("vx", "vy", "vz"))))
            found.add("velocity", Source(name, t_s, velocity, refused, fills=True))
            if local:
                found.add("position", Source(name, t_s, swap_enu_ned(_stacked(*(table[c] for c in "xyz")))))
            else:
                found.add("fix", Source(name, t_s, _fixes(table), refused, fills=True))
    for name in ("GPS_RAW_INT", "GPS2_RAW"):
        if table := tables.get(name):
            refused = {_NO_FIX: table["fix_type"] < 3, _NOWHERE: (table["lat"] == 0) & (table["lon"] == 0)}
            found.add("fix", Source(name, seconds(name, table), _fixes(table), refused))
    if exact := tables.get("ATTITUDE_QUATERNION"):
        wxyz = _stacked(*(exact[c] for c in ("q1", "q2", "q3", "q4")))
        found.add("attitude", Source("ATTITUDE_QUATERNION", seconds("", exact), _from_quaternion(wxyz), fills=True))
    if euler := tables.get("ATTITUDE"):
        values = _from_euler(euler["roll"], euler["pitch"], euler["yaw"])
        found.add("attitude", Source("ATTITUDE", seconds("", euler), values, fills=True))
    if status := tables.get("SYS_STATUS"):
        volts = status["voltage_battery"]
        _add_mavlink_battery(found, "SYS_STATUS", 0, status, volts * 1e-3, (volts <= 0) | (volts >= 65535))
    found.packs[0] = _pack(raw.parameters(), 0)
    for name, number, status in _devices(tables, "BATTERY_STATUS"):
        cells = status["voltages"].astype(np.float64)
        more = status["voltages_ext"].astype(np.float64) if "voltages_ext" in status else cells[:, :0]
        cells = np.concatenate([np.where(cells < 65535, cells, 0.0), np.where(more < 65535, more, 0.0)], axis=-1)
        volts = cells.sum(axis=-1) * 1e-3
        _add_mavlink_battery(found, name, number, status, volts, volts <= 0)
        found.packs[number] = _pack(raw.parameters(), number, _cell_count({f"V{k}": c for k, c in enumerate(cells.T)}))
    for name in ("RADIO_STATUS", "RADIO"):
        if name in tables:
            found.add("rssi", Source(name, seconds(name, tables[name]), _stacked(_sik_dbm(tables[name]["rssi"]))))
            break
    return found


def _add_mavlink_battery(found: Found, name: str, number: int, table: Table, volts: Array, unknown: Column) -> None:
    """A battery by SYS_STATUS or BATTERY_STATUS: current in cA and charge in percent, −1 where it is not known."""
    t_s, left = seconds(name, table), table["battery_remaining"]
    current = np.where(table["current_battery"] < 0, np.nan, table["current_battery"] * 0.01)
    found.add("battery", Source(name, t_s, _stacked(volts, current), {_UNKNOWN: unknown}, number))
    found.add("charge", Source(name, t_s, _stacked(left / 100), {_UNKNOWN: left < 0}, number))


def from_ulog(raw: RawLog) -> Found:
    tables, found = raw.tables, Found()
    for what, columns, valid in (
        ("position", ("x", "y", "z"), ("xy_valid", "z_valid")),
        ("velocity", ("vx", "vy", "vz"), ("v_xy_valid", "v_z_valid")),
    ):
        for topic in ("vehicle_local_position", "estimator_local_position"):
            each = []
            for name, number, table in _instances(tables, topic):
                refused = {"are not valid": (table[valid[0]] == 0) | (table[valid[1]] == 0)}
                values = swap_enu_ned(_stacked(*(table[c] for c in columns)))
                each.append(Source(name, seconds(name, table), values, refused, number))
            if topic.startswith("estimator"):
                each = _led(each, tables.get("estimator_selector_status", {}), "primary_instance")
            for source in each:
                found.add(what, source)
    for topic in ("vehicle_gps_position", "sensor_gps"):
        for name, number, gps in _instances(tables, topic):
            t_s, refused = seconds(name, gps), {_NO_FIX: gps["fix_type"] < 3}
            for names, degree, metre in ((("lat", "lon", "alt"), 1e-7, 1e-3), (_FIX_FIELDS, 1.0, 1.0)):
                if all(column in gps for column in names):
                    lat, lon, height = (gps[column] for column in names)
                    refused[_NOWHERE] = (lat == 0) & (lon == 0)
                    values = _stacked(lat * degree, lon * degree, height * metre)
                    found.add("fix", Source(name, t_s, values, refused, number))
                    ned = _stacked(*(gps[c] for c in ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")))
                    found.add("velocity", Source(name, t_s, swap_enu_ned(ned), refused, number))
    for topic in ("vehicle_global_position", "estimator_global_position"):
        each = []
        for name, number, place in _instances(tables, topic):
            nowhere = (place["lat"] == 0) & (place["lon"] == 0)
            values = _stacked(place["lat"], place["lon"], place["alt"])
            each.append(Source(name, seconds(name, place), values, {_NOWHERE: nowhere}, number, fills=topic[0] == "v"))
        leader = tables.get("estimator_selector_status", {}) if topic.startswith("estimator") else {}
        for source in _led(each, leader, "primary_instance"):
            found.add("fix", source)
    for topic in ("vehicle_attitude", "estimator_attitude"):
        each = [
            Source(name, seconds(name, table), _from_quaternion(table["q"]), {}, number)
            for name, number, table in _instances(tables, topic)
        ]
        leader = tables.get("estimator_selector_status", {}) if topic.startswith("estimator") else {}
        for source in _led(each, leader, "primary_instance"):
            found.add("attitude", source)
    for name, number, battery in _instances(tables, "battery_status"):
        t_s = seconds(name, battery)
        unplugged = {_UNPLUGGED: battery["connected"] == 0} if "connected" in battery else {}
        # PX4's unknowns: 0 V, −1 A, −1 of the charge
        current = np.where(battery["current_a"] == -1, np.nan, battery["current_a"])
        refused = {**unplugged, _UNKNOWN: battery["voltage_v"] <= 0}
        found.add("battery", Source(name, t_s, _stacked(battery["voltage_v"], current), refused, number))
        refused = {**unplugged, _UNKNOWN: battery["remaining"] < 0}
        found.add("charge", Source(name, t_s, _stacked(battery["remaining"]), refused, number))
        found.packs[number] = _pack(
            raw.parameters(), number, _usual(battery.get("cell_count")), _usual(battery.get("capacity"))
        )
    for name, _, radio in _instances(tables, "radio_status"):
        found.add("rssi", Source(name, seconds(name, radio), _stacked(_sik_dbm(radio["rssi"]))))
    if "rssi" not in found.sources:
        for name, _, remote in _instances(tables, "input_rc"):
            found.rssi_unit = "percent"
            found.add(
                "rssi", Source(name, seconds(name, remote), _stacked(remote["rssi"]), {_UNKNOWN: remote["rssi"] < 0})
            )
    return found


def utc_at_zero_s(raw: RawLog) -> float | None:
    """Seconds since 1970 at which the log's clock is 0, by its GNSS or its own stamps; None where it does not say.

    The median over all fixes: a receiver's first times may be wrong.
    """
    gps = raw.tables.get("GPS", {})
    for week, milliseconds in (("GWk", "GMS"), ("Week", "TimeMS")):
        if week in gps and milliseconds in gps and (fixed := gps["Status"] >= 3).any():
            weeks = gps[week][fixed].astype(np.float64)
            leap_s = np.searchsorted(_LEAP_WEEKS, weeks, side="right") + _LEAP_S
            utc_s = _GPS_EPOCH_S + weeks * 604_800 + gps[milliseconds][fixed] * 1e-3 - leap_s
            return float(np.median(utc_s - seconds("GPS", gps)[fixed]))
    for topic in ("vehicle_gps_position", "sensor_gps"):
        for name, _, gps in _instances(raw.tables, topic):
            if "time_utc_usec" in gps and (known := gps["time_utc_usec"] > 0).any():
                return float(np.median(gps["time_utc_usec"][known] * 1e-6 - seconds(name, gps)[known]))
    return raw.utc_s


def with_fields(tables: Mapping[str, Table], problems: list[str]) -> dict[str, Table]:
    """The tables that have a time and what is read of them, as numbers; the others are told."""
    whole = {}
    for name, columns in tables.items():
        topic, table = _topic(name), columns
        needs = _FIELDS.get(topic, _HELPS.get(topic))
        if needs is not None:
            table = {field: of for field, of in columns.items() if is_numbers(of, _WIDTHS.get(field))}
            lacks = [field for field in needs if field not in table]
            if not any(time in table for time in _TIMES):
                lacks.append("time")
            if lacks:
                if topic in _FIELDS:
                    problems.append(f"{name} has no {', '.join(lacks)} and is left out")
                continue
        whole[name] = table
    return whole


def in_time(raw: RawLog, problems: list[str]) -> RawLog:
    """The rows of the longest stretch in which the clock runs forward, without those with an impossible time."""
    times = {
        name: seconds(name, table)
        for name, table in raw.tables.items()
        if _topic(name) in {*_FIELDS, *_HELPS, *_MAVLINK}
        if any(is_numbers(table[time]) for time in _TIMES if time in table)
    }
    if not times:
        return raw
    names = list(times)
    order = np.argsort(np.concatenate([raw.orders.get(n, np.arange(len(times[n]))) for n in names]), kind="stable")
    kind = np.repeat(np.arange(len(names)), [len(times[n]) for n in names])[order]
    found = longest_stretch(np.concatenate([times[n] for n in names])[order], kind)
    if found.odd.any():
        whose = ", ".join(f"{n} {count}" for k, n in enumerate(names) if (count := int((kind[found.odd] == k).sum())))
        problems.append(f"{found.odd.sum()} rows have an impossible time and are left out: {whose}")
    if found.restarts:
        rows = f"rows {found.begin + 1} to {found.end} of {len(kind)}"
        problems.append(f"the clock restarts {found.restarts} times; the longest stretch is taken, {rows}")
    kept = np.zeros(len(kind), dtype=bool)
    kept[order] = found.kept
    whose_rows = np.split(kept, np.cumsum([len(times[n]) for n in names])[:-1])
    cut = {name: _rows(raw.tables[name], rows) for name, rows in zip(names, whose_rows, strict=True) if rows.any()}
    return replace(raw, tables={**{n: t for n, t in raw.tables.items() if n not in times}, **cut})


def seconds(name: str, table: Table) -> Array:
    """A table's time by the log's own clock, s."""
    system = (("T", 1e-3),) if name.startswith("GPS") else ()  # beside it, old versions have the receiver's own TimeMS
    for column, unit in (*system, ("TimeUS", 1e-6), ("TimeMS", 1e-3), ("timestamp", 1e-6)):
        if column in table and is_numbers(table[column]):
            time_s: Array = table[column].astype(np.float64) * unit
            return time_s
    raise KeyError("a message without a time, which `with_fields` leaves out")


def _rows(table: Table, rows: Column) -> Table:
    return {name: values[rows] for name, values in table.items()}


def _devices(tables: Mapping[str, Table], *names: str) -> list[tuple[str, int, Table]]:
    """The devices of which messages tell, each with its name, its number and its rows.

    ArduPilot's versions number them in columns of different names, or in messages of their own: GPS2 and XKF6 are second.
    """
    devices = []
    for place, name in enumerate(names):
        table = tables.get(name)
        if not table:
            continue
        column = next((table[c] for c in ("Instance", "Inst", "I", "C", "id") if c in table), None)
        if column is None:
            devices.append((name, place, table))
        else:
            for number in np.unique(column[np.isfinite(column)])[:_MOST_DEVICES].tolist():
                called = f"{name} {number:g}" if number else name
                devices.append((called, int(number), _rows(table, column == number)))
    return devices


def _topic(name: str) -> str:
    """A table's topic without the number of its instance."""
    topic, _, number = name.partition(".")
    return topic if _NUMBER.fullmatch(number) else name


def _instances(tables: Mapping[str, Table], topic: str) -> list[tuple[str, int, Table]]:
    """The instances of a PX4 topic, each with its name, its number and its rows."""
    numbers = {name: int(name.partition(".")[2] or 0) for name in tables if _topic(name) == topic}
    return [(name, numbers[name], tables[name]) for name in sorted(numbers, key=lambda name: numbers[name])]


def _led(each: list[Source], leader: Table, column: str) -> list[Source]:
    """The estimators, and before them what those say that the vehicle flew by at each time."""
    if not each or column not in leader:
        return each
    changed_s, flown = seconds("", leader), leader[column]
    masks = []
    for source in each:
        at = np.clip(np.searchsorted(changed_s, source.time_s, side="right") - 1, 0, len(flown) - 1)
        masks.append(flown[at] == source.number)
    leading = [(source, mask) for source, mask in zip(each, masks, strict=True) if mask.any()]
    if not leading:
        return each
    name = leading[0][0].name if len(leading) == 1 else "the estimator in use"
    time_s = np.concatenate([source.time_s[mask] for source, mask in leading])
    order = np.argsort(time_s, kind="stable") if len(leading) > 1 else slice(None)
    values = np.concatenate([source.values[mask] for source, mask in leading])[order]
    refused = {
        reason: np.concatenate([source.refused[reason][mask] for source, mask in leading])[order]
        for reason in leading[0][0].refused
    }
    return [Source(name, time_s[order], values, refused), *each]


def _pack(parameters: Mapping[str, float], number: int, cells: float | None = None, mah: float | None = None) -> Pack:
    """A battery by its messages, or else by the parameters of PX4 or ArduPilot."""
    first = number == 0
    names = [f"BAT{number + 1}_N_CELLS", *["BAT_N_CELLS"] * first]
    cells = cells or next((parameters[name] for name in names if parameters.get(name, 0.0) > 0), 0.0)
    names = [f"BAT{number + 1}_CAPACITY", "BATT_CAPACITY" if first else f"BATT{number + 1}_CAPACITY"]
    names += ["BAT_CAPACITY"] if first else ["BATT_CAPACITY"]
    mah = mah or next((parameters[name] for name in names if parameters.get(name, 0.0) > 0), 0.0)
    return Pack(int(cells) if 1 <= cells <= _MOST_CELLS else None, mah if mah > 0 else None)


def _usual(column: Column | None) -> float | None:
    """The median of a column's positive numbers."""
    known = column[np.isfinite(column) & (column > 0)] if column is not None else ()
    return float(np.median(known)) if len(known) else None


def _cell_count(table: Table) -> float | None:
    """The number of cells by their voltages V1, V2, … in mV; a message may hold the whole pack's voltage in the first."""
    cells = np.stack([column for name, column in table.items() if name[:1] == "V" and name[1:].isdigit()], axis=-1)
    there = (cells > 0) & (cells < 65535)
    sound = there.any(axis=-1) & (~there | ((cells > 1000 * CELL_V[0]) & (cells < 1000 * CELL_V[1]))).all(axis=-1)
    return _usual(there.sum(axis=-1)[sound])


def _fixes(table: Table) -> Array:
    """A MAVLink message's place in degrees and metres."""
    return _stacked(table["lat"] * 1e-7, table["lon"] * 1e-7, table["alt"] * 1e-3)


def _stacked(*columns: Column) -> Array:
    return np.stack([np.asarray(c, dtype=np.float64) for c in columns], axis=-1)


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
