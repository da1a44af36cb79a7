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

from sortie.fleet.logs.dataflash import RawLog, is_dataflash, read_dataflash
from sortie.fleet.logs.fields import Found, from_dataflash, from_tlog, from_ulog, utc_at_zero_s, with_fields
from sortie.fleet.logs.geodesy import metres_per_radian
from sortie.fleet.logs.ulog import is_ulog, read_ulog
from sortie.scenarios.errors import SortieError
from sortie.scenarios.regular import regular

Array = npt.NDArray[np.float64]

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

    path: Path
    system: int | None
    """The vehicle's MAVLink system id; None where the log is of one vehicle by its kind."""
    kind: str
    """DataFlash, MAVLink telemetry or ULog."""
    begin_s: float
    """By the log's own clock; a log's vehicles have one clock."""
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
    fix: Series | None
    """Latitude and longitude in degrees, and metres above mean sea level."""
    parameters: Mapping[str, float]
    problems: tuple[str, ...]
    utc_s: float | None = None
    """Seconds since 1970 at its begin; None where the log does not say."""

    @property
    def name(self) -> str:
        """The file, and the system where it is one of several."""
        return self.path.name if self.system is None else f"{self.path.name} system {self.system}"

    @property
    def origin_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of the first fix."""
        return None if self.fix is None else (float(self.fix.values[0, 0]), float(self.fix.values[0, 1]))


def read_log(path: str | Path) -> FlightLog:
    """Read a flight log of any kind, of one vehicle.

    Raises:
        LogError: as `read_logs`, or several vehicles; the message names them.
    """
    logs = read_logs(path)
    if len(logs) > 1:
        systems = ", ".join(str(log.system) for log in logs)
        raise LogError(f"{path}: is of {len(logs)} vehicles, systems {systems}; must be of one")
    return logs[0]


def read_logs(path: str | Path) -> tuple[FlightLog, ...]:
    """Read a flight log of any kind: a flight for each vehicle, by ascending system id.

    Raises:
        LogError: no such file, none of the three kinds, or nothing in it that moves or drains.
    """
    path = Path(path)
    try:
        if regular(path).stat().st_size > MAX_BYTES:
            raise LogError(f"{path}: {path.stat().st_size} bytes, must be at most {MAX_BYTES}")
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
        raise LogError(f"{path}: cannot be read, {getattr(error, 'strerror', None) or error}") from None
    if is_dataflash(data):
        logs = [_assemble(path, "DataFlash", read_dataflash(data), from_dataflash)]
    elif is_ulog(data):
        logs = [_assemble(path, "ULog", read_ulog(data), from_ulog)]
    else:
        from sortie.fleet.logs.tlog import is_tlog, read_tlog  # pymavlink is loaded for such a log alone

        if not is_tlog(data):
            raise LogError(f"{path}: is no DataFlash log (.bin), MAVLink telemetry (.tlog) or ULog (.ulg)")
        each = read_tlog(data).items()
        logs = [_assemble(path, "MAVLink telemetry", raw, from_tlog, system) for system, raw in each]
    flown = tuple(log for log in logs if log.position or log.attitude or log.battery)
    if not flown:
        told = "; ".join(logs[0].problems)
        raise LogError(f"{path}: holds no position, attitude or battery" + (f" ({told})" if told else ""))
    return flown


def _assemble(
    path: Path, kind: str, raw: RawLog, translate: Callable[[RawLog], tuple[Found, str]], system: int | None = None
) -> FlightLog:
    """One clock from zero, sound values, and a list of what was not."""
    with np.errstate(all="ignore"):  # damaged numbers overflow; what is not finite is left out below
        return _assembled(path, kind, raw, translate, system)


def _assembled(
    path: Path, kind: str, raw: RawLog, translate: Callable[[RawLog], tuple[Found, str]], system: int | None
) -> FlightLog:
    problems = list(raw.problems)
    several = sorted(name for name in raw.tables if name.startswith("battery_status."))
    if several:
        problems.append(f"{len(several) + 1} batteries, the first is taken")
    whole = RawLog(with_fields(raw.tables, problems), raw.problems, raw.utc_s)
    found, unit = translate(whole)
    found = {name: _sound(name, *each, problems) for name, each in found.items() if len(each[0])}
    found = {name: each for name, each in found.items() if len(each[0])}
    fix = None
    if (fixes := found.pop("fix", None)) is not None:
        near = _near(
            local_m(fixes[1]), [] if "position" in found else problems
        )  # before one of them becomes the origin
        if near.any():
            fix = fixes[0][near], fixes[1][near]
            found.setdefault("position", (fix[0], local_m(fix[1])))
    begin_s = min((t_s[0] for t_s, _ in found.values()), default=0.0)
    end_s = max((t_s[-1] for t_s, _ in found.values()), default=0.0)
    utc_s = utc_at_zero_s(whole)
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
        path=path,
        system=system,
        kind=kind,
        begin_s=begin_s,
        duration_s=end_s - begin_s,
        position=series.get("position"),
        velocity=series.get("velocity"),
        attitude=series.get("attitude"),
        battery=series.get("battery"),
        charge=series.get("charge"),
        rssi=series.get("rssi"),
        rssi_unit=unit,
        fix=None if fix is None else Series(fix[0] - begin_s, fix[1]),
        parameters=raw.parameters(),
        problems=tuple(problems),
        utc_s=None if utc_s is None or not math.isfinite(utc_s) else utc_s + begin_s,
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
    `sortie.fleet.logs.geodesy.geodetic`.
    """
    lat, lon, alt = fixes[0].tolist()
    east_m, north_m = metres_per_radian(lat, alt)  # not by an `Origin`: a damaged first fix may lie anywhere
    east = np.radians((fixes[:, 1] - lon + 180) % 360 - 180) * east_m
    north = np.radians(fixes[:, 0] - lat) * north_m
    return np.stack([east, north, fixes[:, 2] - alt], axis=-1)
