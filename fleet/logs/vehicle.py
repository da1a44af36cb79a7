"""A flying vehicle as its MAVLink messages describe it: pose, velocity, charge, and when each was last heard.

The vehicle is the first system with the heartbeat of an autopilot, PX4, ArduPilot or another. Only the component that
sends this heartbeat counts. Messages of other systems, and of the vehicle's gimbal, cameras and computers, are passed
over. MAVLink is NED, FRD and w-first quaternions; the state is ENU, FLU and x y z w.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import swap_attitude, swap_enu_ned, to_xyzw
from sortie.fleet.logs.geodesy import Origin, Vector, local_enu

WANTED_HZ = {30: 20.0, 31: 20.0, 32: 20.0, 33: 20.0, 1: 1.0, 147: 1.0, 245: 1.0}
"""Messages that a drone asks its vehicle for, by id: ATTITUDE, ATTITUDE_QUATERNION, LOCAL_POSITION_NED,
GLOBAL_POSITION_INT, SYS_STATUS, BATTERY_STATUS, EXTENDED_SYS_STATE; Hz."""
_NO_AUTOPILOT, _ON_GROUND, _ARMED = 8, 1, 128  # MAV_AUTOPILOT_INVALID, MAV_LANDED_STATE_ON_GROUND, ..._SAFETY_ARMED
_NO_VEHICLE = frozenset({6, 18, 26, 27, *range(30, 35), *range(36, 43), 44, 48})
"""MAV_TYPE of ground stations, companion computers, gimbals, cameras and other parts: some name an autopilot as theirs."""


def is_autopilot(autopilot: int, kind: int) -> bool:
    """Whether a heartbeat with this MAV_AUTOPILOT and MAV_TYPE is that of a vehicle's autopilot."""
    return autopilot != _NO_AUTOPILOT and kind not in _NO_VEHICLE


class VehicleState(NamedTuple):
    """What is known of the vehicle; times are those at which messages came in, s, −∞ before the first."""

    system: int | None = None
    """Its system id."""
    component: int | None = None
    """The autopilot's component id."""
    position_m: Vector = (0.0, 0.0, 0.0)
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    orientation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    soc: float | None = None
    """Charge, 0 … 1; None where the vehicle does not say."""
    battery: int = 0
    """Which battery's: the first one of which the vehicle says a charge."""
    armed: bool = False
    landed: bool = False
    heartbeat_s: float = -math.inf
    position_s: float = -math.inf
    attitude_s: float = -math.inf
    others: int = 0
    """Messages of other systems and components, which were passed over."""

    @property
    def pose_s(self) -> float:
        """When the older of position and attitude came in."""
        return min(self.position_s, self.attitude_s)


def after(state: VehicleState, message: Any, now_s: float, origin: Origin | None) -> VehicleState:
    """The state after one more message.

    Args:
        message: as pymavlink has it.
        now_s: when it came in.
        origin: where ENU (0, 0, 0) lies: positions are read from GLOBAL_POSITION_INT. None: from LOCAL_POSITION_NED, and
            (0, 0, 0) is the origin of the vehicle's own estimator.
    """
    name = message.get_type()
    autopilot = name == "HEARTBEAT" and is_autopilot(message.autopilot, message.type)
    if state.system is None:
        if not autopilot:
            return state
        state = state._replace(system=message.get_srcSystem(), component=message.get_srcComponent())
    if message.get_srcSystem() != state.system or state.component not in (None, message.get_srcComponent()):
        return state._replace(others=state.others + 1)
    if autopilot:
        return state._replace(heartbeat_s=now_s, armed=bool(message.base_mode & _ARMED))
    if name == "LOCAL_POSITION_NED" and origin is None:
        return _moved(
            state,
            _enu((message.x, message.y, message.z)),
            _enu((message.vx, message.vy, message.vz)),
            now_s,
        )
    if name == "GLOBAL_POSITION_INT" and origin is not None:
        if message.lat == message.lon == 0:  # it has no fix yet
            return state
        position_m = local_enu(message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3, origin)
        return _moved(state, position_m, _enu((message.vx * 0.01, message.vy * 0.01, message.vz * 0.01)), now_s)
    if name == "ATTITUDE":
        return _turned(
            state, Rotation.from_euler("ZYX", [message.yaw, message.pitch, message.roll]).as_quat().tolist(), now_s
        )
    if name == "ATTITUDE_QUATERNION":
        return _turned(state, to_xyzw([message.q1, message.q2, message.q3, message.q4]).tolist(), now_s)
    if name in ("SYS_STATUS", "BATTERY_STATUS") and 0 <= message.battery_remaining <= 100:  # −1: it does not know
        number = message.id if name == "BATTERY_STATUS" else 0
        if state.soc is None or number <= state.battery:
            return state._replace(soc=message.battery_remaining / 100.0, battery=number)
    if name == "EXTENDED_SYS_STATE":
        return state._replace(landed=message.landed_state == _ON_GROUND)
    return state


def _enu(ned: Vector) -> Vector:
    east, north, up = swap_enu_ned(ned).tolist()
    return east, north, up


def _moved(state: VehicleState, position_m: Vector, velocity_mps: Vector, now_s: float) -> VehicleState:
    if not np.isfinite([*position_m, *velocity_mps]).all():
        return state
    return state._replace(position_m=position_m, velocity_mps=velocity_mps, position_s=now_s)


def _turned(state: VehicleState, ned_xyzw: list[float], now_s: float) -> VehicleState:
    norm = math.hypot(*ned_xyzw)
    if not 0.99 < norm < 1.01:  # also what is no number
        return state
    x, y, z, w = swap_attitude(ned_xyzw).tolist()
    return state._replace(orientation_xyzw=(x, y, z, w), attitude_s=now_s)
