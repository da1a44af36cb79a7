"""What a drone's telemetry tells, and how long the key is that signs it; free of pymavlink."""

from __future__ import annotations

from dataclasses import dataclass

from sortie.fleet.logs.geodesy import Vector

KEY_BYTES = 32
"""Of a MAVLink 2 signing key."""


@dataclass(frozen=True, slots=True)
class Telemetry:
    """One drone at one time; ENU, FLU, x y z w."""

    time_s: float
    """Since the sortie's begin."""
    position_m: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]
    velocity_mps: tuple[float, float, float]
    body_rates_radps: tuple[float, float, float]
    soc: float
    voltage_v: float
    current_a: float
    energy_used_j: float
    cpu_load: float
    """0 … 1."""
    landed: bool
    ground_station: bool = False
    """Whether it is no vehicle."""
    home_m: Vector = (0.0, 0.0, 0.0)
    """Where on the ground it took off."""
    fixed: bool = True
    """Whether it has GNSS."""
