"""The nominal flight: where every drone is, how it is tilted and what it believes, as long as nothing moves it elsewhere.

The formation is a rigid virtual structure that moves along the route and turns with it. A drone holds its slot
up to a smooth random offset, in a mean wind with gusts of its own. Its attitude follows from its acceleration by
differential flatness; no controller is simulated. Nothing here needs the clock, so the whole flight is computed
as arrays [T frames, N drones, ...] before it begins. It is computed in blocks of frames, and long flights lie on disk
(`sortie.scenarios.scratch`). Manoeuvres change it in flight (`sortie.fleet.flight.manoeuvres`). Frames as in
`sortie.fleet.flight.frames`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import wrapped, yaw_rad
from sortie.fleet.flight.noise import LAGS, GaussMarkov, Smooth
from sortie.fleet.flight.ways import raised, route_path, ways_of
from sortie.scenarios import schema, scratch
from sortie.scenarios.errors import SortieError
from sortie.scenarios.streams import stream

Array = npt.NDArray[np.float64]

GRAVITY_MPS2 = 9.81
DRAG_PER_S = 0.2
"""Rotor and body drag over mass, linear in air speed (the form of Faessler, Franchi & Scaramuzza 2018). The value is
chosen, not measured: 10 m/s of air tilts the airframe by 11.5°. The rotor-power formula has its own drag."""
ESTIMATE_TIME_S = 10.0
"""Correlation time of the errors of the position and heading estimates."""


class MotionError(SortieError):
    """The motion asked for cannot be flown; the message names the drone, the time and the settings."""


@dataclass(frozen=True, slots=True)
class Trajectories:
    """A flight, or some frames of one. Every array is read-only."""

    time_s: Array  # [T]
    position_m: Array  # [T, N, 3] ENU
    orientation_xyzw: Array  # [T, N, 4] FLU in ENU, unit, without sign jumps in time
    velocity_mps: Array  # [T, N, 3] ENU
    acceleration_mps2: Array  # [T, N, 3] ENU, gravity not included
    body_rates_radps: Array  # [T, N, 3] FLU; constant from one frame to the next, the last frame repeats
    wind_mps: Array  # [T, N, 3] ENU, velocity of the air, gusts included
    yaw_rad: Array  # [T, N] true yaw of the body
    est_position_m: Array  # [T, N, 3] what the drone believes; height is taken to be known
    est_yaw_rad: Array  # [T, N]
    frame_position_m: Array  # [T, 3] the formation's reference point
    frame_yaw_rad: Array  # [T] the formation's heading

    def __post_init__(self) -> None:
        for each in fields(self):
            getattr(self, each.name).setflags(write=False)

    def __getitem__(self, frames: slice) -> Trajectories:
        """Some frames."""
        return Trajectories(**{each.name: getattr(self, each.name)[frames] for each in fields(self)})

    def bounds_m(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of everything flown, ENU."""
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for rows in scratch.blocks(len(self.position_m), self.position_m[0].nbytes):
            xy_m = self.position_m[rows, :, :2]
            low, high = np.minimum(low, xy_m.min(axis=(0, 1))), np.maximum(high, xy_m.max(axis=(0, 1)))
            scratch.release()
        if not np.isfinite([low, high]).all():
            raise ValueError("the motion is not finite")
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])


OF_ALL = ("time_s", "frame_position_m", "frame_yaw_rad")
"""What `Trajectories` has of the whole fleet; all else it has of each drone."""
OF_A_DRONE = tuple(each.name for each in fields(Trajectories) if each.name not in (*OF_ALL, "wind_mps"))
"""What changes where a drone flies another way."""


def frame_floats(drones: int) -> int:
    """How many numbers `Trajectories` has of a frame."""
    return 24 * drones + 5


def air_speed_mps(velocity_mps: Array, wind_mps: Array) -> Array:
    """Horizontal speed through the air [...] of velocities and winds [..., 3]."""
    air = velocity_mps[..., :2] - wind_mps[..., :2]
    return np.hypot(air[..., 0], air[..., 1])


def thrust_mps2(velocity_mps: Array, acceleration_mps2: Array, wind_mps: Array) -> Array:
    """The thrust over mass [..., 3], ENU, that a motion needs in its wind."""
    thrust = acceleration_mps2 + DRAG_PER_S * (velocity_mps - wind_mps)
    thrust[..., 2] += GRAVITY_MPS2
    return thrust


def attitude(thrust_mps2: Array, heading_rad: Array) -> Array:
    """Attitude by differential flatness (Mellinger & Kumar 2011, §III).

    z_B points along the thrust, x_C = (cos ψ, sin ψ, 0), y_B = z_B × x_C normalised, x_B = y_B × z_B.

    Args:
        thrust_mps2: [..., 3] thrust over mass, ENU: acceleration + gravity·(0, 0, 1) + drag.
        heading_rad: [...] ψ, ENU.

    Returns:
        [..., 4] unit quaternions x, y, z, w of FLU in ENU.

    Raises:
        MotionError: no thrust (free fall), or thrust along x_C: the attitude is not determined.
    """
    norm = np.linalg.norm(thrust_mps2, axis=-1, keepdims=True)
    if not np.all(norm > 1e-6):
        raise MotionError("attitude is not determined: the thrust is zero (free fall)")
    z_b = thrust_mps2 / norm
    x_c = np.stack([np.cos(heading_rad), np.sin(heading_rad), np.zeros_like(heading_rad)], axis=-1)
    y_b = np.cross(z_b, x_c)
    norm = np.linalg.norm(y_b, axis=-1, keepdims=True)
    if not np.all(norm > 1e-6):
        raise MotionError("attitude is not determined: the thrust points along the heading")
    y_b /= norm
    matrix = np.stack([np.cross(y_b, z_b), y_b, z_b], axis=-1)
    quaternion: Array = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat().reshape(*thrust_mps2.shape[:-1], 4)
    return quaternion


def fly(fleet: schema.Fleet, duration_s: float, frame_s: float, seed: int, replication: int = 0) -> Trajectories:
    """Fly the formation along its route.

    Every random number comes from a stream of its drone, so that the first n drones fly the same whatever n is
    (circle apart, whose slots depend on n), and a longer sortie begins as a shorter one.

    Args:
        fleet: drones, formation, route and motion sections are read.
        duration_s: the frames that begin before it are flown (end exclusive).
        frame_s: time between frames, > 0.
        seed, replication: as in `sortie.scenarios.streams.stream`.

    Raises:
        MotionError: the asked motion needs thrust that points downwards.
        PluginError: a mobility model that is not there, fails, or cannot be flown.
    """
    frames = max(1, math.ceil(round(duration_s / frame_s, 9)))
    flight = _Flight(fleet, frames, frame_s, seed, replication)
    whole: dict[str, Array] = {}
    for rows in scratch.blocks(frames, 8 * frame_floats(fleet.drones)):
        block = flight.block(np.arange(rows.start, rows.stop, dtype=np.float64) * frame_s)
        block["body_rates_radps"] = np.empty_like(block["velocity_mps"])
        whole = whole or {name: scratch.empty((frames, *values.shape[1:])) for name, values in block.items()}
        for name, values in block.items():
            whole[name][rows] = values
        turned = whole["orientation_xyzw"][max(0, rows.start - 1) : rows.stop]
        whole["body_rates_radps"][max(0, rows.start - 1) : rows.stop] = body_rates(turned, frame_s)
        scratch.release()
    return Trajectories(**whole)


class _Flight:
    """A formation on its route, block after block."""

    def __init__(self, fleet: schema.Fleet, frames: int, frame_s: float, seed: int, replication: int) -> None:
        self._fleet, config, drones = fleet, fleet.motion, range(fleet.drones)
        self._ways = ways_of(fleet, frames, frame_s, seed, replication)
        self._standing = [station.drone for station in fleet.ground]
        self._streams = {
            purpose: [stream(seed, replication, i, purpose) for i in drones]
            for purpose in ("pose_jitter", "gust", "pose_error", "heading_error")
        }
        self._jitter = Smooth(config.pose_jitter_m, config.pose_jitter_time_s, frame_s)
        self._gusts = GaussMarkov(config.gust_sigma_mps, config.gust_time_s, frame_s)
        self._pose_error = GaussMarkov(config.pose_error_m, ESTIMATE_TIME_S, frame_s)
        self._heading_error = GaussMarkov(math.radians(config.heading_error_deg), ESTIMATE_TIME_S, frame_s)
        self._before: Array | None = None  # the attitudes of the frame before

    def _draws(self, purpose: str, frames: int, *shape: int) -> Array:  # [T, *shape, N]
        return np.stack([each.standard_normal((frames, *shape)) for each in self._streams[purpose]], axis=-1)

    def block(self, time_s: Array) -> dict[str, Array]:
        """The next frames, by the names of `Trajectories`; all but the body rates."""
        fleet, config, frames = self._fleet, self._fleet.motion, len(time_s)
        path = route_path(fleet.formation, fleet.route, time_s)
        position, velocity, acceleration = states = [np.empty((frames, fleet.drones, 3)) for _ in range(3)]
        heading = np.empty((frames, fleet.drones))
        jitter = [np.moveaxis(v, -1, 1) for v in self._jitter.block(self._draws("pose_jitter", frames, LAGS, 3))]
        for flown, way in self._ways:
            of, nominal = (slice(None), list(flown)), way.at(time_s)
            heading[of] = nominal.yaw_rad
            offsets = [v[of] for v in jitter]
            for state, held, offset in zip(states, nominal.states, _swaying(offsets, nominal.sway), strict=True):
                state[of] = held + offset

        gusts = self._gusts.block(self._draws("gust", frames, 3))
        wind = np.array([*config.wind_mps, 0.0]) + np.moveaxis(gusts, -1, 1)

        thrust = thrust_mps2(velocity, acceleration, wind)
        if thrust[..., 2].min() <= 0:
            frame, drone = np.unravel_index(np.argmin(thrust[..., 2]), thrust.shape[:2])
            raise MotionError(
                f"drone {drone} at {time_s[frame]:.1f} s would have to thrust downwards: fleet.motion.pose_jitter_m "
                f"{config.pose_jitter_m:g} within pose_jitter_time_s {config.pose_jitter_time_s:g} or gust_sigma_mps "
                f"{config.gust_sigma_mps:g} cannot be flown"
            )
        quaternion = attitude(thrust, heading)
        quaternion = continuous(quaternion, quaternion[0] if self._before is None else self._before)
        self._before = quaternion[-1].copy()
        yaw = yaw_rad(quaternion)

        est_position = position.copy()
        error = self._pose_error.block(self._draws("pose_error", frames, 2))
        est_position[..., :2] += np.moveaxis(error, -1, 1)
        est_yaw = yaw + self._heading_error.block(self._draws("heading_error", frames))
        for i in self._standing:  # level, whatever the wind, and surveyed
            quaternion[:, i], yaw[:, i], est_yaw[:, i] = (0.0, 0.0, 0.0, 1.0), 0.0, 0.0
            est_position[:, i] = position[:, i]
        return {
            "time_s": time_s,
            "position_m": position,
            "orientation_xyzw": quaternion,
            "velocity_mps": velocity,
            "acceleration_mps2": acceleration,
            "wind_mps": wind,
            "yaw_rad": yaw,
            "est_position_m": est_position,
            "est_yaw_rad": wrapped(est_yaw),
            "frame_position_m": raised(path.position_m, fleet.formation.altitude_m),
            "frame_yaw_rad": path.yaw_rad,
        }


def _swaying(jitter: list[Array], sway: tuple[Array, Array, Array] | None) -> list[Array]:
    """Offsets from the nominal place, and their two derivatives, of drones that have a share of their jitter."""
    if sway is None:
        return jitter
    (x, v, a), (f, rate, change) = jitter, (each[..., None] for each in sway)
    return [f * x, f * v + rate * x, f * a + 2 * rate * v + change * x]


def body_rates(quaternion_xyzw: Array, step_s: float) -> Array:
    """Rates ω [T, N, 3] in FLU with q[t+1] = q[t]·exp(ω[t]·step_s), by the logarithm on SO(3); the last repeats."""
    frames, n = quaternion_xyzw.shape[:2]
    if frames < 2:
        return np.zeros((frames, n, 3))
    now = Rotation.from_quat(quaternion_xyzw[:-1].reshape(-1, 4))
    then = Rotation.from_quat(quaternion_xyzw[1:].reshape(-1, 4))
    rates = ((now.inv() * then).as_rotvec() / step_s).reshape(frames - 1, n, 3)
    return np.concatenate([rates, rates[-1:]])


def continuous(quaternion: Array, before: Array) -> Array:
    """Attitudes [T, N, 4]: of the two quaternions of each the one nearer to the frame before. `before` is [N, 4], or one."""
    chain = np.concatenate([np.broadcast_to(before, quaternion[:1].shape), quaternion])
    flips = np.sign((chain[1:] * chain[:-1]).sum(axis=-1))
    flips[flips == 0] = 1.0
    return quaternion * np.cumprod(flips, axis=0)[..., None]
