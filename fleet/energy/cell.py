"""A lithium-polymer cell: voltage by charge, what heat, cold and age do to it, and the current that a power asks for.

Pure functions of numbers; `fleet/energy/battery.py` keeps the state of the packs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from sortie.scenarios.plugins.reference import PluginError, checked_array, name_of, resolve
from sortie.scenarios.schema import Battery

Array = npt.NDArray[np.float64]

_SOC = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
_CELL_V = (3.2, 3.68, 3.74, 3.79, 3.87, 3.98, 4.20)
_CELL_SLOPE_V = (
    6.9,
    1.0666666666666673,
    0.36986301369862934,
    0.30769230769230715,
    0.46315789473684216,
    0.733333333333333,
    1.3750000000000022,
)
"""Slopes of the monotone cubic through the points (PCHIP: Fritsch & Butland 1984), as scipy.interpolate has them;
importing that for seven numbers would take longer than a sortie's batteries do."""

REFERENCE_C = 25.0
"""Where a cell's resistance is the one stated."""
ACTIVATION_JPMOL = 20_000.0
_GAS_JPMOLK = 8.314462618
_ZERO_K = 273.15
PACK_WH_PER_KG = 150.0
SPECIFIC_HEAT_JPKGK = 1000.0
COOLING_TIME_S = 900.0
"""A pack's temperature falls to 1/e of its excess over the air's in this time, with propwash over its case."""
END_OF_LIFE_CAPACITY, END_OF_LIFE_RESISTANCE = 0.8, 2.0
"""A pack is held to be worn out at four fifths of its capacity and twice its resistance."""


def _cell_curve() -> tuple[Array, Array]:
    """Each piece of the cell's curve and of its integral as a polynomial, [4, 6] and [5, 6], lowest power first."""
    x, y, slope = np.array(_SOC), np.array(_CELL_V), np.array(_CELL_SLOPE_V)
    width, rise = np.diff(x), np.diff(y) / np.diff(x)
    bend = (slope[:-1] + slope[1:] - 2 * rise) / width
    curve = np.stack([y[:-1], slope[:-1], (rise - slope[:-1]) / width - bend, bend / width])
    energy = np.concatenate([np.zeros((1, len(width))), curve / np.arange(1, 5)[:, None]])
    for piece in range(1, len(width)):
        energy[0, piece] = _polynomial(energy[:, piece - 1], width[piece - 1])
    return curve, energy


def _polynomial(coefficients: Array, x: Array) -> Array:
    """c0 + c1·x + c2·x² + …"""
    total, power = np.zeros_like(x), np.ones_like(x)
    for c in coefficients:
        total, power = total + c * power, power * x
    return total


def _at_soc(pieces: Array, soc: npt.ArrayLike) -> Array:
    """A piecewise polynomial over the state of charge, any shape."""
    soc = np.asarray(soc, dtype=float)
    piece = np.clip(np.searchsorted(_SOC, soc, side="right") - 1, 0, len(_SOC) - 2)
    return _polynomial(pieces[:, piece], soc - np.array(_SOC)[piece])


_CELL_CURVE, _CELL_ENERGY = _cell_curve()
MEAN_CELL_V = float(_at_soc(_CELL_ENERGY, 1.0))
"""Energy of a full cell over its charge."""


def open_circuit_cell_v(soc: npt.ArrayLike) -> Array:
    """Voltage of a LiPo cell at rest by state of charge 0 … 1 (monotone cubic through seven points)."""
    return _at_soc(_CELL_CURVE, soc)


def energy_fraction(soc: npt.ArrayLike) -> Array:
    """Share of a full pack's energy that is left at a state of charge (by charge) of 0 … 1."""
    return _at_soc(_CELL_ENERGY, soc) / MEAN_CELL_V


def current_a(power_w: float, open_circuit_v: float, resistance_ohm: float) -> float | None:
    """Current at which a pack delivers a power at its terminals.

    The lower root of R·I² − U·I + P = 0, in the form that also holds for R = 0.

    Args:
        power_w: at the terminals.
        open_circuit_v: at rest, less what is polarised.
        resistance_ohm: of the whole pack.

    Returns:
        Amperes, or None where the pack cannot deliver it (P > U²/4R).
    """
    root = open_circuit_v * open_circuit_v - 4 * resistance_ohm * power_w
    if root < 0 or open_circuit_v <= 0:
        return None
    return 2 * power_w / (open_circuit_v + math.sqrt(root))


def resistance_factor(temperature_c: float) -> float:
    """Resistance over that at 25 °C, by Arrhenius with 20 kJ/mol: 2.1 at 0 °C, 2.9 at −10 °C, 0.68 at 40 °C.

    The activation energy is an assumption, of the order that is published for lithium-ion cells.
    """
    inverse = 1.0 / (temperature_c + _ZERO_K) - 1.0 / (REFERENCE_C + _ZERO_K)
    return math.exp(ACTIVATION_JPMOL / _GAS_JPMOLK * inverse)


def heat_capacity_jpk(capacity_wh: float) -> float:
    """Heat that warms a pack by a kelvin: its mass at 150 Wh/kg times 1 kJ/(kg·K)."""
    return capacity_wh / PACK_WH_PER_KG * SPECIFIC_HEAT_JPKGK


def ageing(cycles: float, life_cycles: float) -> tuple[float, float]:
    """Share of its capacity that a pack still has, and its resistance over a new one's, after so many full cycles.

    Linear from new to the end of life (80 % of the capacity, twice the resistance) at `life_cycles`, and on.
    """
    worn = cycles / life_cycles
    return 1.0 - (1.0 - END_OF_LIFE_CAPACITY) * worn, 1.0 + (END_OF_LIFE_RESISTANCE - 1.0) * worn


# Charge and cell voltage by energy fraction, on a grid even in energy, so that a look-up is one multiplication.
STEPS = 2048
_grid_soc = np.linspace(0.0, 1.0, 8 * STEPS + 1)
_soc_by_energy = np.interp(np.linspace(0.0, 1.0, STEPS + 1), energy_fraction(_grid_soc), _grid_soc)
SOC_TABLE: list[float] = [*_soc_by_energy.tolist(), 1.0]  # one more, so that a full pack needs no special case
CELL_TABLE: list[float] = [*open_circuit_cell_v(_soc_by_energy).tolist(), _CELL_V[-1]]


class OwnCell(Protocol):
    """A cell of one's own, `fleet.battery.cell_model`. Keyword-only arguments are its parameters.

    Example, a cell whose voltage rises evenly:

    >>> def straight(soc, *, empty_v=3.0, full_v=4.2):
    ...     return empty_v + (full_v - empty_v) * soc
    """

    def __call__(self, soc: Array) -> npt.ArrayLike:
        """Voltage at rest by state of charge 0 … 1, [K] → [K] V, above 0 and nowhere falling."""


class CellCurve(NamedTuple):
    """A cell at rest."""

    soc: list[float]
    """By the share of the energy that is left, on a grid of `STEPS` even steps and one more."""
    volts: list[float]
    energy_fraction: Callable[[npt.ArrayLike], Array]
    """Share of a full cell's energy by state of charge."""
    open_circuit_v: Callable[[npt.ArrayLike], Array]


LIPO = CellCurve(SOC_TABLE, CELL_TABLE, energy_fraction, open_circuit_cell_v)


def own_cell_v(model: OwnCell, soc: Array) -> Array:
    """What a cell of one's own gives at charges [K] in ascending order, V, checked.

    Raises:
        PluginError: it fails, or returns another shape, no voltage or a falling one.
    """
    volts = checked_array("cell", model, soc.shape, soc)
    if volts.min() <= 0.0:
        k = int(volts.argmin())
        raise PluginError(f"cell {name_of(model)}: {volts[k]:g} V at a charge of {soc[k]:.3f}, must be above 0")
    steps = np.diff(volts)
    if (steps < 0.0).any():
        k = int(steps.argmin())
        fall = f"falls from {volts[k]:.6g} to {volts[k + 1]:.6g} V at a charge of {soc[k]:.3f}"
        raise PluginError(f"cell {name_of(model)}: {fall}, must not fall as the charge rises")
    return volts


def cell_curve(pack: Battery) -> CellCurve:
    """The cell that a pack names.

    Raises:
        PluginError: a cell of one's own that is not there, fails, or has no voltage or a falling one somewhere.
    """
    if pack.cell_model == "lipo":
        return LIPO
    soc = _grid_soc
    volts = own_cell_v(resolve("cell", pack.cell_model, pack.cell_params), soc)
    energy = np.concatenate([[0.0], np.cumsum((volts[1:] + volts[:-1]) / 2)])
    share = energy / energy[-1]
    by_energy = np.interp(np.linspace(0.0, 1.0, STEPS + 1), share, soc)
    return CellCurve(
        [*by_energy.tolist(), 1.0],
        [*np.interp(by_energy, soc, volts).tolist(), float(volts[-1])],
        lambda at: np.interp(np.asarray(at, dtype=float), soc, share),
        lambda at: np.interp(np.asarray(at, dtype=float), soc, volts),
    )


def terminal_voltage_v(time_s: Array, current_a: Array, pack: Battery, soc: float) -> Array:
    """Voltage of a pack under a given current, V [K]: what a log's current says of a pack's data, or the other way.

    The built-in cell as in `fleet/energy/battery.py`, driven by current instead of power and counted in charge: open circuit by
    charge, less the resistance's drop, less polarisation's (one RC element, exact for a current that holds from one
    sample to the next). Ages with `pack.cycles`; temperature is left out.

    Args:
        time_s: [K] increasing.
        current_a: [K] drawn from each time until the next.
        pack: its data; capacity in Wh is that of a full pack at open circuit.
        soc: at the first sample.
    """
    share, worse = ageing(pack.cycles, pack.life_cycles)
    full_c = pack.capacity_wh * 3600.0 * share / (pack.cells * MEAN_CELL_V)
    step_s = np.diff(time_s)
    drawn_c = np.concatenate([[0.0], np.cumsum(current_a[:-1] * step_s)])
    slow = pack.polarisation
    fades, towards_v = np.exp(-step_s / slow.time_s), current_a * slow.resistance_mohm / 1000.0 * worse
    lag_v = np.zeros(len(time_s))
    for k, fade in enumerate(fades.tolist()):
        lag_v[k + 1] = towards_v[k] + (lag_v[k] - towards_v[k]) * fade
    open_v = open_circuit_cell_v(np.clip(soc - drawn_c / full_c, 0.0, 1.0))
    voltage: Array = pack.cells * (open_v - lag_v - current_a * pack.cell_resistance_mohm / 1000.0 * worse)
    return voltage
