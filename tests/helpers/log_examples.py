"""Small flight logs of every kind, made by hand: a square flown level, its battery draining, with a radio."""

from __future__ import annotations

import struct

import numpy as np

from sortie.fleet.logs.geodesy import Origin, geodetic
from sortie.fleet.logs.mavlink import Transmitter, messages
from sortie.fleet.logs.telemetry import Telemetry

ORIGIN = Origin(47.0, 8.0, 400.0)
STEPS = 100
PERIOD_S = 0.1
BEGIN_UTC_S = 1_700_000_000.0
"""When logs that know the time begin."""


def state(k: int) -> Telemetry:
    """At step k: 3 m/s east and 4 m/s north, climbing 1 m/s, heading 90° (north)."""
    t_s = k * PERIOD_S
    return Telemetry(
        time_s=t_s,
        position_m=(3 * t_s, 4 * t_s, t_s),
        orientation_xyzw=(0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)),
        velocity_mps=(3.0, 4.0, 1.0),
        body_rates_radps=(0.0, 0.0, 0.0),
        soc=0.9 - 0.001 * k,
        voltage_v=16.0 - 0.01 * k,
        current_a=15.0,
        energy_used_j=0.0,
        cpu_load=0.5,
        landed=False,
    )


def tlog(steps: int = STEPS) -> bytes:
    """The flight as this project's own telemetry."""
    transmitter = Transmitter(0)
    out = b""
    for k in range(steps):
        for message in messages(state(k), ORIGIN):
            out += stamped(k, transmitter.pack(message))
    return out


def stamped(k: int, frame: bytes) -> bytes:
    """A frame of step k as a telemetry log has it."""
    return struct.pack(">Q", 1_700_000_000_000_000 + k * 100_000) + frame


_DATAFLASH = {
    "FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"),
    "PARM": (129, "QNf", "TimeUS,Name,Value"),
    "GPS": (130, "QBIHLLe", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt"),
    "XKF1": (131, "QBfffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD,Roll"),
    "ATT": (132, "Qccc", "TimeUS,Roll,Pitch,Yaw"),
    "BAT": (133, "QBfff", "TimeUS,Instance,Volt,Curr,CurrTot"),
    "RAD": (134, "QBB", "TimeUS,RSSI,RemRSSI"),
}
_STRUCT = {
    "Q": "Q",
    "B": "B",
    "n": "4s",
    "N": "16s",
    "Z": "64s",
    "f": "f",
    "I": "I",
    "H": "H",
    "L": "i",
    "e": "i",
    "c": "h",
}


def dataflash_message(name: str, *values: object) -> bytes:
    number, form, _ = _DATAFLASH[name]
    return b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(_STRUCT[c] for c in form), *values)


def dataflash_begin() -> bytes:
    """Formats and parameters, which come before the flight."""
    out = b""
    for name, (number, form, columns) in _DATAFLASH.items():
        length = 3 + struct.calcsize("<" + "".join(_STRUCT[c] for c in form))
        out += dataflash_message("FMT", number, length, name.encode(), form.encode(), columns.encode())
    return out + dataflash_message("PARM", 5_000_000, b"BATT_CAPACITY", 5000.0)


def dataflash(steps: int = STEPS, late_s: float = 0.0) -> bytes:
    """The flight as ArduPilot would log it, begun 5 s after boot, and so late after `BEGIN_UTC_S`."""
    return dataflash_begin() + b"".join(dataflash_step(k, late_s) for k in range(steps))


def gps_time(utc_s: float) -> tuple[int, int]:
    """Milliseconds of the week and the week of GPS time, which is 18 s ahead of UTC since 2017."""
    ms = round((utc_s + 18 - 315_964_800) * 1000)
    return ms % 604_800_000, ms // 604_800_000


def dataflash_step(k: int, late_s: float = 0.0) -> bytes:
    """What is logged at step k."""
    s, us = state(k), 5_000_000 + k * 100_000
    (east, north, up), (ve, vn, vu) = s.position_m, s.velocity_mps
    lat, lon, alt = geodetic(s.position_m, ORIGIN)
    return (
        dataflash_message(
            "GPS",
            us,
            3,
            *gps_time(BEGIN_UTC_S + late_s + k * PERIOD_S),
            round(lat * 1e7),
            round(lon * 1e7),
            round(alt * 100),
        )
        + dataflash_message("XKF1", us, 0, vn, ve, -vu, north, east, -up, 0.0)
        + dataflash_message("XKF1", us, 1, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0)  # another core
        + dataflash_message("ATT", us, 0, 0, 0)
        + dataflash_message("BAT", us, 0, s.voltage_v, s.current_a, 5000 * (1 - s.soc))
        + dataflash_message("RAD", us, 190, 150)
    )


_TOPICS = {
    "vehicle_local_position": "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;bool xy_valid;"
    "bool z_valid;bool v_xy_valid;bool v_z_valid;uint8_t[4] _padding0;",
    "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    "battery_status": "uint64_t timestamp;float voltage_v;float current_a;float remaining;",
    "input_rc": "uint64_t timestamp;int32_t rssi;",
}


_GNSS = (
    "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;float vel_n_m_s;float vel_e_m_s;"
    "float vel_d_m_s;uint8_t fix_type;uint8_t[3] _padding0;"
)


def ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(steps: int = STEPS, late_s: float | None = None) -> bytes:
    """The flight as PX4 would log it; with GNSS so late after `BEGIN_UTC_S`, or without."""
    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 5_000_000)
    out += ulog_message("P", b"\x14float BAT_CAPACITY__" + struct.pack("<f", 5000.0))
    topics = _TOPICS if late_s is None else {**_TOPICS, "vehicle_gps_position": _GNSS}
    for name, fields in topics.items():
        out += ulog_message("F", f"{name}:{fields}".encode())
    for number, name in enumerate(topics):
        out += ulog_message("A", struct.pack("<BH", 0, number) + name.encode())
    for k in range(steps):
        s, us = state(k), 5_000_000 + k * 100_000
        (east, north, up), (ve, vn, vu) = s.position_m, s.velocity_mps
        rows = (
            struct.pack("<Q6f4?", us, north, east, -up, vn, ve, -vu, True, True, True, True),
            struct.pack("<Q4f", us, 1.0, 0.0, 0.0, 0.0),
            struct.pack("<Q3f", us, s.voltage_v, s.current_a, s.soc),
            struct.pack("<Qi", us, 80),
        )
        if late_s is not None:
            lat, lon, alt = geodetic(s.position_m, ORIGIN)
            place = (round(lat * 1e7), round(lon * 1e7), round(alt * 1e3))
            utc_us = round((BEGIN_UTC_S + late_s + k * PERIOD_S) * 1e6)
            rows = (*rows, struct.pack("<2Q3i3fB", us, utc_us, *place, vn, ve, -vu, 3))
        for number, row in enumerate(rows):
            out += ulog_message("D", struct.pack("<H", number) + row)
    return out


KINDS = {"tlog": tlog, "bin": dataflash, "ulg": ulog}
