"""What flight, compute and radio draw, and what the pack still gives.

Pure functions of power and voltage first, then `FleetBatteries`, which drains every pack once a frame.
The pack's state is the energy left in it, in joules at open circuit; charge and voltage are read off it. So the
ledger's sum and what left the pack are one number, up to rounding.

Proportion, wherever energy is claimed: hovering draws some 210 W electric, a Wi-Fi radio 2 to 6 W. Hover outweighs
the radio about a hundredfold, so what is shared moves flight time mainly through compute duty cycling, hardly
through airtime.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from scenarios.schema import Battery, DroneOverride

Array = npt.NDArray[np.float64]

MASS_KG = 2.04
"""The machine that the rotor-power constants describe."""
GRAVITY_MPS2 = 9.81
CAUSES = ("rotor", "avionics", "compute", "radio", "ohmic", "fault")
"""Ledger of energy: climb is part of rotor, ohmic is lost in the pack's resistance, fault is lost at once."""

_SOC = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
_CELL_V = (3.2, 3.68, 3.74, 3.79, 3.87, 3.98, 4.20)
_CELL_SLOPE_V = (
    6.9, 1.0666666666666673, 0.36986301369862934, 0.30769230769230715, 0.46315789473684216, 0.733333333333333,
    1.3750000000000022,
)  # fmt: skip
"""Slopes of the monotone cubic through the points (PCHIP: Fritsch & Butland 1984), as scipy.interpolate has them;
importing that for seven numbers would take longer than a sortie's batteries do."""


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
_MEAN_CELL_V = float(_at_soc(_CELL_ENERGY, 1.0))


def rotor_power_w(air_speed_mps: npt.ArrayLike) -> Array:
    """Power at the rotors of a 2.04 kg quadrotor in level flight, W, any shape.

    P0·(1 + 3V²/Utip²) + Pi·√(√(1 + V⁴/4v0⁴) − V²/2v0²) + ½·d0·ρ·s·A·V³: blade profile, induced and parasite
    power (Zeng, Xu & Zhang 2019, eq. 12). Hover 168.5 W, least 126.0 W at 10.2 m/s.

    Args:
        air_speed_mps: horizontal speed through the air (ground velocity minus wind).
    """
    v2 = np.square(np.asarray(air_speed_mps, dtype=float))
    profile = 79.8563 * (1 + 3 * v2 / 120.0**2)
    x = v2 / (2 * 4.03**2)
    induced = 88.6279 / np.sqrt(np.sqrt(1 + x * x) + x)  # √(√(1 + x²) − x) without its cancellation
    parasite = 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * v2 * np.sqrt(v2)
    power: Array = profile + induced + parasite
    return power


def climb_power_w(climb_mps: npt.ArrayLike) -> Array:
    """Power to gain height, m·g·v_z, W, any shape; descending gives nothing back."""
    power: Array = MASS_KG * GRAVITY_MPS2 * np.maximum(np.asarray(climb_mps, dtype=float), 0.0)
    return power


def open_circuit_cell_v(soc: npt.ArrayLike) -> Array:
    """Voltage of a LiPo cell at rest by state of charge 0 … 1 (monotone cubic through seven points)."""
    return _at_soc(_CELL_CURVE, soc)


def energy_fraction(soc: npt.ArrayLike) -> Array:
    """Share of a full pack's energy that is left at a state of charge (by charge) of 0 … 1."""
    return _at_soc(_CELL_ENERGY, soc) / _MEAN_CELL_V


def current_a(power_w: float, open_circuit_v: float, resistance_ohm: float) -> float | None:
    """Current at which a pack delivers a power at its terminals.

    The lower root of R·I² − U·I + P = 0, in the form that also holds for R = 0.

    Returns:
        Amperes, or None where the pack cannot deliver it (P > U²/4R).
    """
    root = open_circuit_v * open_circuit_v - 4 * resistance_ohm * power_w
    if root < 0:
        return None
    return 2 * power_w / (open_circuit_v + math.sqrt(root))


# Charge and cell voltage by energy fraction, on a grid even in energy, so that a look-up is one multiplication.
_STEPS = 2048
_grid_soc = np.linspace(0.0, 1.0, 8 * _STEPS + 1)
_soc_by_energy = np.interp(np.linspace(0.0, 1.0, _STEPS + 1), energy_fraction(_grid_soc), _grid_soc)
_SOC_TABLE: list[float] = [*_soc_by_energy.tolist(), 1.0]  # one more, so that a full pack needs no special case
_CELL_TABLE: list[float] = [*open_circuit_cell_v(_soc_by_energy).tolist(), _CELL_V[-1]]


class FleetBatteries:
    """Every drone's pack and its ledger.

    Plain floats in a loop, 1.8 µs a drone; the same step in numpy took 60 µs for any number, so that it would pay
    from about 33 drones on and save 0.1 ms a frame at 100.

    Attributes, one entry a drone:
        soc: state of charge by charge, 0 … 1.
        voltage_v, current_a: at the terminals during the last step.
        landed: on the ground, whether empty, at landing_soc, too weak for its load, or told to. It draws nothing.
        energy_left_j: energy left in the pack, at open circuit.
        energy_j: cause → joules spent so far, per drone.
    """

    def __init__(self, config: Battery, overrides: Sequence[DroneOverride], n: int) -> None:
        """Packs of `n` drones at take-off; `overrides` are `fleet.overrides` of the scenario."""
        packs = [config] * n
        for override in overrides:
            changes = {k: v for k, v in override.model_dump(exclude={"drone"}).items() if v is not None}
            packs[override.drone] = packs[override.drone].model_copy(update=changes)
        self._config = config
        self._full_j = [pack.capacity_wh * 3600.0 for pack in packs]
        self._resistance_ohm = [pack.cells * pack.cell_resistance_mohm / 1000.0 for pack in packs]
        self.energy_left_j = [
            full * float(energy_fraction(pack.initial_soc)) for full, pack in zip(self._full_j, packs, strict=True)
        ]
        self.energy_j: dict[str, list[float]] = {cause: [0.0] * n for cause in CAUSES}
        self.soc = [pack.initial_soc for pack in packs]
        self.voltage_v = [float(open_circuit_cell_v(pack.initial_soc)) * pack.cells for pack in packs]
        self.current_a = [0.0] * n
        self.landed = [pack.initial_soc <= config.landing_soc for pack in packs]

    def step(
        self, dt_s: float, rotor_w: Sequence[float], duty: Sequence[float], airtime_share: Sequence[float]
    ) -> None:
        """Drain every flying drone's pack for `dt_s`.

        Args:
            dt_s: length of the step, s.
            rotor_w: power at the rotors, climb included, before the drivetrain's losses.
            duty: share of the step in which perception runs, 0 … 1.
            airtime_share: share of the step in which the radio sends, 0 … 1.

        A drone whose pack cannot deliver the power lands at once and draws nothing in this step; one that reaches
        landing_soc, or empties, lands at the step's end.
        """
        config, left, soc, landed = self._config, self.energy_left_j, self.soc, self.landed
        rotor_j, avionics_j, compute_j = self.energy_j["rotor"], self.energy_j["avionics"], self.energy_j["compute"]
        radio_j, ohmic_j = self.energy_j["radio"], self.energy_j["ohmic"]
        efficiency, cells, avionics = config.drivetrain_efficiency, config.cells, config.avionics_w
        idle, active = config.compute_idle_w, config.compute_active_w - config.compute_idle_w
        listen, send = config.radio_idle_w, config.radio_tx_w - config.radio_idle_w
        for i, down in enumerate(landed):
            if down:
                continue
            at = left[i] / self._full_j[i] * _STEPS
            k = int(at)
            ocv = cells * (_CELL_TABLE[k] + (at - k) * (_CELL_TABLE[k + 1] - _CELL_TABLE[k]))
            rotor = rotor_w[i] / efficiency
            compute = idle + duty[i] * active
            radio = listen + airtime_share[i] * send
            power = rotor + avionics + compute + radio
            current = current_a(power, ocv, self._resistance_ohm[i])
            if current is None:
                self.land(i)
                continue
            ohmic = current * current * self._resistance_ohm[i]
            spent = (power + ohmic) * dt_s
            lasts_s = dt_s
            if spent >= left[i]:  # the pack is empty before the step is over
                lasts_s, spent = dt_s * left[i] / spent, left[i]
            rotor_j[i] += rotor * lasts_s
            avionics_j[i] += avionics * lasts_s
            compute_j[i] += compute * lasts_s
            radio_j[i] += radio * lasts_s
            ohmic_j[i] += ohmic * lasts_s
            left[i] -= spent
            self.current_a[i] = current
            self.voltage_v[i] = ocv - current * self._resistance_ohm[i]
            at = left[i] / self._full_j[i] * _STEPS
            k = int(at)
            soc[i] = _SOC_TABLE[k] + (at - k) * (_SOC_TABLE[k + 1] - _SOC_TABLE[k])
            if soc[i] <= config.landing_soc:
                self.land(i)

    def fault(self, drone: int, lost_fraction: float) -> None:
        """Lose a fraction of the remaining energy at once; the drone lands if too little is left.

        Raises:
            ValueError: lost_fraction outside 0 … 1.
        """
        if not 0 <= lost_fraction <= 1:
            raise ValueError(f"lost_fraction is {lost_fraction}, must be in [0, 1]")
        lost = self.energy_left_j[drone] * lost_fraction
        self.energy_left_j[drone] -= lost
        self.energy_j["fault"][drone] += lost
        self._read_off(drone)
        if self.soc[drone] <= self._config.landing_soc:
            self.land(drone)

    def land(self, drone: int) -> None:
        """Take a drone out of the air, for good; its pack is at rest."""
        self.landed[drone] = True
        self.current_a[drone] = 0.0
        self._read_off(drone)

    def _read_off(self, drone: int) -> None:
        """Charge, and the voltage at the present current, from the energy left."""
        at = self.energy_left_j[drone] / self._full_j[drone] * _STEPS
        k = int(at)
        self.soc[drone] = _SOC_TABLE[k] + (at - k) * (_SOC_TABLE[k + 1] - _SOC_TABLE[k])
        open_v = self._config.cells * (_CELL_TABLE[k] + (at - k) * (_CELL_TABLE[k + 1] - _CELL_TABLE[k]))
        self.voltage_v[drone] = open_v - self.current_a[drone] * self._resistance_ohm[drone]
