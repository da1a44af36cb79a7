"""A real flight, whatever wrote it down: pose, velocity, battery and RSSI over time in the simulator's frames.

Reads ArduPilot's DataFlash (*.bin), MAVLink telemetry (*.tlog) and PX4's ULog (*.ulg), told apart by their first
bytes. Nothing is invented: what a log does not have is None, gaps stay gaps, and damage, restarts, gaps and what was
left out are told in `problems`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sortie.fleet.logs.dataflash import RawLog, is_dataflash, read_dataflash
from sortie.fleet.logs.fields import (
    CELL_V,
    Found,
    from_dataflash,
    from_tlog,
    from_ulog,
    in_time,
    utc_at_zero_s,
    with_fields,
)
from sortie.fleet.logs.sources import GAP_S, Samples, judged, local_m, taken
from sortie.fleet.logs.ulog import is_ulog, read_ulog
from sortie.scenarios.errors import SortieError
from sortie.scenarios.regular import regular

Array = npt.NDArray[np.float64]

MAX_BYTES = 2_000_000_000
FULL_CELL_V = 4.25


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
    cells: int | None = None
    """In series: as the log says, or by the voltage; None without a voltage."""
    capacity_ah: float | None = None
    """Of the full pack; None where the log does not say."""

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
    path: Path, kind: str, raw: RawLog, translate: Callable[[RawLog], Found], system: int | None = None
) -> FlightLog:
    """One clock from zero, sound values, and a list of what was not."""
    with np.errstate(all="ignore"):  # damaged numbers overflow; what is not finite is left out below
        return _assembled(path, kind, raw, translate, system)


def _assembled(
    path: Path, kind: str, raw: RawLog, translate: Callable[[RawLog], Found], system: int | None
) -> FlightLog:
    problems = list(raw.problems)
    whole = in_time(RawLog(with_fields(raw.tables, problems), (), raw.utc_s, raw.orders), problems)
    found = translate(whole)
    each = {what: [judged(what, source) for source in of] for what, of in found.sources.items()}
    if fixes := each.get("fix"):
        each.setdefault("position", []).extend(_as_position(samples) for samples in fixes)
    chosen: dict[str, Samples] = {}
    number = 0
    for what in ("fix", "position", "velocity", "attitude", "battery", "charge", "rssi"):
        of = each.get(what, [])
        if what == "charge":  # of the same battery, if it says
            of = sorted(of, key=lambda samples: samples.source.number != number)
        samples = taken(what, of)
        problems += [line for line in (samples or of[0]).told if line not in problems] if of else []
        if samples is None:
            continue
        if what == "battery":
            number = samples.source.number
            if (several := len({other.source.number for other in of if len(other.time_s)})) > 1:
                called = "the first" if samples.source is of[0].source else samples.source.name
                problems.append(f"{several} batteries, {called} is taken")
        chosen[what] = samples
    begin_s = min((samples.time_s[0] for samples in chosen.values()), default=0.0)
    end_s = max((samples.time_s[-1] for samples in chosen.values()), default=0.0)
    utc_s = utc_at_zero_s(whole)
    series = {}
    for what, samples in chosen.items():
        values = samples.values
        if what == "position":
            values = values - values[:1]
        if what == "charge":
            values = _falling(values, problems)
        if what != "fix":
            problems += _gaps(what, samples.time_s - begin_s)
        series[what] = Series(samples.time_s - begin_s, values)
    pack = found.packs.get(number)
    cells = _cells(series.get("battery"), pack.cells if pack else None, problems)
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
        rssi_unit=found.rssi_unit,
        fix=series.get("fix"),
        parameters=raw.parameters(),
        problems=tuple(problems),
        utc_s=None if utc_s is None or not math.isfinite(utc_s) else utc_s + begin_s,
        cells=cells,
        capacity_ah=pack.capacity_mah / 1000 if pack and pack.capacity_mah else None,
    )


def _as_position(fixes: Samples) -> Samples:
    """Fixes as metres from the first."""
    return replace(fixes, values=local_m(fixes.values) if len(fixes.values) else fixes.values)


def _cells(battery: Series | None, told: int | None, problems: list[str]) -> int | None:
    """A pack's cells, as the log says, or as many as its highest voltages need: a single sample decides nothing."""
    if battery is None:
        return None
    volts = np.sort(battery.values[:, 0])
    high_v = float(volts[-min(len(volts), max(3, len(volts) // 100))])
    by_voltage = min(max(math.ceil(high_v / FULL_CELL_V), 1), 24)
    if told is None or CELL_V[0] <= high_v / told <= CELL_V[1]:
        return told or by_voltage
    problems.append(f"{told} cells would have {high_v / told:.1f} V each; {by_voltage} are taken")
    return by_voltage


def _falling(values: Array, problems: list[str]) -> Array:
    """A charge that never rises."""
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
