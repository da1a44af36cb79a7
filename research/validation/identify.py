"""A pack's data out of a flight log, and how well a pack's data tell a log's voltage.

Identify on one stretch, judge on another: the error over the stretch that was fitted says little.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sortie.fleet.energy.cell import MEAN_CELL_V, terminal_voltage_v
from sortie.fleet.logs.flightlog import FlightLog, LogError, Series
from sortie.scenarios.schema import Battery, Polarisation

Array = npt.NDArray[np.float64]


def stated_pack(log: FlightLog, cells: int, capacity_ah: float | None = None) -> Battery:
    """The pack as its data say: cells, capacity, and this project's defaults for the rest.

    Args:
        log: gives the capacity where it is not given.
        cells: in series.
        capacity_ah: charge of a full pack.

    Raises:
        LogError: no capacity, neither given nor in the log.
    """
    capacity_ah = log.capacity_ah if capacity_ah is None else capacity_ah
    if capacity_ah is None or not capacity_ah > 0:
        raise LogError(f"{log.path}: does not say the pack's capacity: give it")
    return Battery(capacity_wh=capacity_ah * cells * MEAN_CELL_V, cells=cells)


def identify_pack(log: FlightLog, pack: Battery, until_s: float, polarisation_time_s: float = 20.0) -> Battery:
    """The pack with both resistances of its cells fitted, by least squares of the voltage, to the log before a time.

    Raises:
        LogError: no voltage and current, or no charge, before that time.
    """
    from scipy.optimize import least_squares

    battery, soc = _measured(log)
    first = battery.time_s < until_s
    if first.sum() < 3:
        raise LogError(
            f"{log.path}: {first.sum()} rows of voltage and current before {until_s:g} s, must be 3 at least"
        )
    time_s, (volts, current) = battery.time_s[first], battery.values[first].T

    def with_resistances(mohm: Array) -> Battery:
        slow = Polarisation(resistance_mohm=float(mohm[1]), time_s=polarisation_time_s)
        return pack.model_copy(update={"cell_resistance_mohm": float(mohm[0]), "polarisation": slow})

    found = least_squares(
        lambda mohm: terminal_voltage_v(time_s, current, with_resistances(mohm), soc) - volts,
        (10.0, 3.0),
        bounds=(0, 500),
    )
    return with_resistances(found.x)


def predicted_voltage(log: FlightLog, pack: Battery) -> Series:
    """What a pack's data make of the log's current: terminal voltage in V at the battery's times."""
    battery, soc = _measured(log)
    return Series(battery.time_s, terminal_voltage_v(battery.time_s, battery.values[:, 1], pack, soc))


def voltage_error(log: FlightLog, pack: Battery, from_s: float, until_s: float) -> float:
    """Root mean square of (predicted − measured)/measured voltage between two times of the log."""
    battery, _ = _measured(log)
    within = (battery.time_s >= from_s) & (battery.time_s < until_s)
    measured, predicted = battery.values[within, 0], predicted_voltage(log, pack).values[within]
    return float(np.sqrt(np.mean(np.square(predicted / measured - 1.0))))


def hovering(log: FlightLog, from_s: float, until_s: float) -> npt.NDArray[np.bool_]:
    """Rows of the battery between two times at which the vehicle neither moves nor climbs: below 0.5 and 0.3 m/s."""
    battery, _ = _measured(log)
    if log.velocity is None:
        raise LogError(f"{log.path}: has no velocity")
    east, north, up = (np.interp(battery.time_s, log.velocity.time_s, v) for v in log.velocity.values.T)
    still: npt.NDArray[np.bool_] = (np.hypot(east, north) < 0.5) & (np.abs(up) < 0.3)
    return still & (battery.time_s >= from_s) & (battery.time_s < until_s)


def electric_power_w(log: FlightLog) -> Array:
    """Voltage times current at the battery's times, W."""
    battery, _ = _measured(log)
    power: Array = battery.values.prod(axis=1)
    return power


def _measured(log: FlightLog) -> tuple[Series, float]:
    """Rows with voltage and current, and the charge when they begin."""
    if log.battery is None or log.charge is None:
        raise LogError(f"{log.path}: has no voltage, current and charge")
    known = np.isfinite(log.battery.values).all(axis=-1)
    if not known.any():
        raise LogError(f"{log.path}: its current was not measured")
    battery = Series(log.battery.time_s[known], log.battery.values[known])
    return battery, float(np.interp(battery.time_s[0], log.charge.time_s, log.charge.values[:, 0]))
