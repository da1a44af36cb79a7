"""What flying draws at the rotors: level flight, climb, payload, wind and thin air.

The formula and the constants are those of Zeng, Xu & Zhang (2019, eq. 12) for their 2.04 kg machine; any other
airframe is that one, scaled: at a fixed pitch the blades turn faster under more thrust, so that hover's profile and
induced power both go with T^1.5/√(ρA), and tip and induced speed with √(T/ρA). With the schema's defaults every
factor is exactly 1.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.manoeuvres import BLOCK, Motion
from sortie.fleet.flight.motion import Trajectories, air_speed_mps
from sortie.scenarios.plugins.reference import PluginError, checked_array, name_of, resolve
from sortie.scenarios.schema import Airframe, Fleet

Array = npt.NDArray[np.float64]

GRAVITY_MPS2 = 9.81
DEFAULT = Airframe()
"""The machine that the constants below describe."""
PROFILE_W, INDUCED_W, INDUCED_MPS = 79.8563, 88.6279, 4.03
INDUCED_FACTOR = 1.1
"""Induced power over that of an ideal disc, which INDUCED_W has in it."""
_ROUNDS = 40


def rotor_power_w(air_speed_mps: npt.ArrayLike, airframe: Airframe = DEFAULT, mass_kg: npt.ArrayLike = 0.0) -> Array:
    """Power at the rotors in level flight, W, any shape.

    P0·(1 + 3V²/Utip²) + Pi·√(√(1 + V⁴/4v0⁴) − V²/2v0²) + ½·d0·ρ·s·A·V³: blade profile, induced and parasite
    power (Zeng, Xu & Zhang 2019, eq. 12). The default airframe: hover 168.5 W, least 126.0 W at 10.2 m/s.

    Args:
        air_speed_mps: horizontal speed through the air (ground velocity minus wind).
        airframe: what flies.
        mass_kg: all-up mass, an array that broadcasts with the speeds; 0 takes the airframe's with its payload.
    """
    v2 = np.square(np.asarray(air_speed_mps, dtype=float))
    load, thin = _load(airframe, mass_kg), _thinness(airframe)
    profile_w, induced_w, v02, tip2 = _hover(airframe, load, thin)
    profile = profile_w * (1 + 3 * v2 / tip2)
    x = v2 / (2 * v02)
    induced = induced_w / np.sqrt(np.sqrt(1 + x * x) + x)  # √(√(1 + x²) − x) without its cancellation
    power: Array = profile + induced + _parasite_w(airframe, v2)
    return power


def climb_power_w(climb_mps: npt.ArrayLike, airframe: Airframe = DEFAULT, mass_kg: npt.ArrayLike = 0.0) -> Array:
    """Power to gain height, m·g·v_z, W, any shape; descending gives nothing back. `mass_kg` as in rotor_power_w."""
    mass = _mass_kg(airframe, mass_kg)
    power: Array = mass * GRAVITY_MPS2 * np.maximum(np.asarray(climb_mps, dtype=float), 0.0)
    return power


def momentum_power_w(
    air_velocity_mps: Array, acceleration_mps2: Array, airframe: Airframe = DEFAULT, mass_kg: npt.ArrayLike = 0.0
) -> Array:
    """Power at the rotors in any flight by momentum theory, W [...].

    Thrust T = m·‖a + g·e3‖. The induced speed solves Glauert's v_i = v_h²/√(V² + (w + v_i)²), V the horizontal and
    w the vertical speed through the air, v_h² = T/2ρA: the inflow of a climb pays for part of m·g·w. Work done on the machine, m·(a + g·e3)·v, and parasite power at the whole speed come on top. In steady
    level flight this is `rotor_power_w`.

    In descent the theory fails (vortex ring): w counts as 0, the induced speed is that of level flight and nothing
    comes back. By Leishman's fit to measured rotors that asks 3 % of the induced power too much in a descent of v_h/4
    without forward speed, and 22 % at v_h.

    Args:
        air_velocity_mps: [..., 3] velocity through the air, ENU.
        acceleration_mps2: [..., 3] of the machine, ENU, gravity not included.
        airframe, mass_kg: as in rotor_power_w.
    """
    mass, thin = _mass_kg(airframe, mass_kg), _thinness(airframe)
    pull = acceleration_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])
    load = mass * np.linalg.norm(pull, axis=-1) / (DEFAULT.mass_kg * GRAVITY_MPS2)
    profile_w, induced_w, v02, tip2 = _hover(airframe, load, thin)
    v2 = np.square(air_velocity_mps[..., :2]).sum(axis=-1)
    climb = np.maximum(air_velocity_mps[..., 2], 0.0)
    relief = induced_speed(np.sqrt(v2 / v02), climb / np.sqrt(v02))
    profile = profile_w * (1 + 3 * v2 / tip2)
    work = mass * ((pull[..., :2] * air_velocity_mps[..., :2]).sum(axis=-1) + pull[..., 2] * climb)
    power: Array = profile + np.maximum(induced_w * relief + work + _parasite_w(airframe, v2 + climb**2), 0.0)
    return power


def induced_speed(forward: npt.ArrayLike, climb: npt.ArrayLike) -> Array:
    """Glauert's induced speed over that of hover, for speeds over that of hover, climb ≥ 0; any shape.

    The root of x·√(V² + (w + x)²) = 1, by bisection in [0, 1]: the left side rises with x from 0 to ≥ 1.
    """
    v2, w = np.square(np.asarray(forward, dtype=float)), np.asarray(climb, dtype=float)
    low = np.zeros(np.broadcast_shapes(v2.shape, w.shape))
    high = np.ones_like(low)
    for _ in range(_ROUNDS):
        x = 0.5 * (low + high)
        above = x * np.sqrt(v2 + np.square(w + x)) > 1.0
        low, high = np.where(above, low, x), np.where(above, x, high)
    root: Array = 0.5 * (low + high)
    return root


class PowerModel(Protocol):
    """A power model of one's own, `fleet.airframe.power_model`. Keyword-only arguments are its parameters.

    Example, a machine that needs 100 W for each kilogram:

    >>> def heavy(air_velocity_mps, acceleration_mps2, climb_mps, mass_kg, *, w_per_kg=100.0):
    ...     return np.full_like(climb_mps, w_per_kg) * mass_kg
    """

    def __call__(
        self, air_velocity_mps: Array, acceleration_mps2: Array, climb_mps: Array, mass_kg: Array
    ) -> npt.ArrayLike:
        """Power at the rotors, W [T, n], before the drivetrain's losses.

        Args:
            air_velocity_mps: [T, n, 3], the velocity through the air, ENU.
            acceleration_mps2: [T, n, 3], ENU, gravity not included.
            climb_mps: [T, n], the vertical speed over ground.
            mass_kg: [n], all-up mass with payload.
        """


def fleet_power_w(fleet: Fleet, flown: Trajectories) -> Array:
    """Power at the rotors of every drone in some frames, W [F, N], by the airframes' models and payloads; a ground
    station has none.

    Raises:
        PluginError: a power model of the user's own that is not there, fails, or returns something else.
    """
    standing = [station.drone for station in fleet.ground]
    machines = [(a.model_copy(update={"payload_kg": 0.0}), a.payload_kg) for a in fleet.airframes]
    power_w = np.zeros(flown.position_m.shape[:2])
    distinct: list[Airframe] = []
    for i, (airframe, _) in enumerate(machines):
        if airframe not in distinct and i not in standing:
            distinct.append(airframe)
    for airframe in distinct:
        of = [i for i, (a, _) in enumerate(machines) if a == airframe and i not in standing]
        mass_kg = airframe.mass_kg + np.array([machines[i][1] for i in of])
        velocity_mps, wind_mps = flown.velocity_mps[:, of], flown.wind_mps[:, of]
        acceleration_mps2, climb_mps = flown.acceleration_mps2[:, of], velocity_mps[..., 2]
        if airframe.power_model == "momentum":
            power_w[:, of] = momentum_power_w(velocity_mps - wind_mps, acceleration_mps2, airframe, mass_kg)
        elif airframe.power_model == "level":
            level_w = rotor_power_w(air_speed_mps(velocity_mps, wind_mps), airframe, mass_kg)
            power_w[:, of] = level_w + climb_power_w(climb_mps, airframe, mass_kg)
        else:
            model = resolve("power", airframe.power_model, airframe.power_params)
            power_w[:, of] = own_power_w(model, velocity_mps - wind_mps, acceleration_mps2, climb_mps, mass_kg)
    return power_w


class RotorPower:
    """Power at the rotors of every drone, frame by frame. A model of the user's own is asked for the whole flight."""

    def __init__(self, fleet: Fleet, motion: Motion) -> None:
        """Raises:
        PluginError: as `fleet_power_w`.
        """
        self._fleet, self._motion = fleet, motion
        own = any(airframe.power_model not in ("level", "momentum") for airframe in fleet.airframes)
        self._at_once = motion.frames if own else BLOCK
        self.forget()
        self.at(0)

    def forget(self) -> None:
        """The motion has changed."""
        self._block, self._power_w = -1, np.empty((0, 0))

    def at(self, frame: int) -> Array:
        """Every drone's power in a frame, W [N]."""
        block, row = divmod(frame, self._at_once)
        if block != self._block:
            frames = slice(frame - row, frame - row + self._at_once)
            self._block, self._power_w = block, fleet_power_w(self._fleet, self._motion[frames])
        power_w: Array = self._power_w[row]
        return power_w


def own_power_w(model: PowerModel, air_mps: Array, acceleration_mps2: Array, climb_mps: Array, mass_kg: Array) -> Array:
    """What a power model of one's own returns, checked."""
    power_w = checked_array("power", model, climb_mps.shape, air_mps, acceleration_mps2, climb_mps, mass_kg)
    if (power_w < 0.0).any():
        raise PluginError(f"power {name_of(model)}: returns {power_w.min():g} W, must be ≥ 0")
    return power_w


def figure_of_merit(thrust_coefficient: float, power_coefficient: float) -> float:
    """A propeller's hover efficiency from its static coefficients (T = CT·ρn²D⁴, P = CP·ρn³D⁵).

    Ideal power T^1.5/√(2ρA) over P, which comes to √(2/π)·CT^1.5/CP.
    """
    return math.sqrt(2 / math.pi) * math.sqrt(thrust_coefficient**3) / power_coefficient


def _mass_kg(airframe: Airframe, mass_kg: npt.ArrayLike) -> Array:
    mass = np.asarray(mass_kg, dtype=float)
    return np.where(mass > 0, mass, airframe.mass_kg + airframe.payload_kg)


def _load(airframe: Airframe, mass_kg: npt.ArrayLike) -> Array:
    """Weight over the default machine's."""
    load: Array = _mass_kg(airframe, mass_kg) / DEFAULT.mass_kg
    return load


def _thinness(airframe: Airframe) -> float:
    """The default machine's ρA over this one's."""
    dense = airframe.air_density_kgpm3 / DEFAULT.air_density_kgpm3 * (airframe.disc_area_m2 / DEFAULT.disc_area_m2)
    return 1.0 / dense


def _hover(airframe: Airframe, load: Array, thin: float) -> tuple[Array, Array, Array, Array]:
    """Profile and induced power in hover, squares of the induced and the tip speed, under thrust `load`."""
    scale = load * np.sqrt(load * thin)
    blades = (1 / airframe.figure_of_merit - INDUCED_FACTOR) / (1 / DEFAULT.figure_of_merit - INDUCED_FACTOR)
    speed = load * thin
    own = (airframe.mass_kg / DEFAULT.mass_kg) * thin  # tip speed is given for hover without payload
    return (
        PROFILE_W * blades * scale,
        INDUCED_W * scale,
        INDUCED_MPS**2 * speed,
        airframe.tip_speed_mps**2 * (speed / own),
    )


def _parasite_w(airframe: Airframe, v2: Array) -> Array:
    """½·ρ·f·V³, f the airframe's drag area; the default's is d0·s·A = 0.6 · 0.05 · 0.503 m²."""
    area = airframe.drag_area_m2 / DEFAULT.drag_area_m2 * (airframe.air_density_kgpm3 / DEFAULT.air_density_kgpm3)
    power: Array = 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * area * v2 * np.sqrt(v2)
    return power
