"""Context traces: what a real or a simulated drone did, flown again in place of the models.

One row a drone and time, CSV or Parquet. Names, units and frames are those of the record's
`states` table, so that any run's `states.parquet` is a trace:

    t_s                       seconds since the sortie's begin, increasing for each drone        must be there
    drone                     whose row; left out, everything is drone 0's
    x_m, y_m, z_m             pose, ENU                                        } one of the two, all three of it,
    lat_deg, lon_deg, alt_m   the same as WGS-84 degrees and altitude          } or no pose
    qx, qy, qz, qw            attitude, FLU in ENU (all four)                  } one of the three, or level and heading
    yaw_deg                   heading, counter-clockwise from east             } along the track; without roll_deg and
    heading_deg               compass heading, with roll_deg and pitch_deg     } pitch_deg level: nose up, right side down
    vx_mps, vy_mps, vz_mps    velocity, ENU; left out, the slope of the positions                  all three, or none
    soc                       state of charge by charge, 0 … 1; it never rises
    voltage_v, current_a      at the terminals
    rssi_dbm, rssi_percent    what the drone's radio heard; kept for people, nothing reads it

Latitudes and longitudes become ENU on the plane that touches the ellipsoid at `fleet.origin`, and altitudes heights above
it. They have the bounds of `x_m`, `y_m` and `z_m`. A ground station may be among the drones: one row with its place is
enough (`fleet.ground`).

Time and gaps follow the rules of all traces (scenarios/traces.py); attitudes run on the shorter arc. Before the first and
after the last place a drone stands there, without velocity. A drone without a pose or a charge keeps its model there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from sortie.fleet.energy.cell import energy_fraction
from sortie.fleet.energy.recorded import BatteryTrace
from sortie.fleet.flight.frames import swap_attitude, tangent_plane_m, wrapped, yaw_rad
from sortie.fleet.flight.motion import OF_A_DRONE, Trajectories, body_rates, continuous, fly
from sortie.scenarios import scratch
from sortie.scenarios.schema import Fleet, Origin
from sortie.scenarios.traces import DRONE, TIME_S, TraceError, check_drones, check_increasing, first_row, read_columns

Array = npt.NDArray[np.float64]

POSITION = ("x_m", "y_m", "z_m")
ATTITUDE = ("qx", "qy", "qz", "qw")
VELOCITY = ("vx_mps", "vy_mps", "vz_mps")
GLOBE = ("lat_deg", "lon_deg", "alt_m")
COMPASS = ("roll_deg", "pitch_deg", "heading_deg")
BATTERY = ("soc", "voltage_v", "current_a")
ROUNDING = 1e-5
"""A charge that rises by less is rounding, and held."""
ROUNDING_S = 1e-6
"""A frame so little beyond a trace's end is at its end."""
COLUMNS = ("t_s", "drone", *POSITION, *ATTITUDE, "yaw_deg", *VELOCITY, *BATTERY, "rssi_dbm", "rssi_percent")
BOUNDS: Mapping[str, tuple[float, float]] = {
    "t_s": TIME_S,
    "drone": DRONE,
    **dict.fromkeys(POSITION, (-20_000.0, 20_000.0)),
    **dict.fromkeys(ATTITUDE, (-1.000001, 1.000001)),
    **dict.fromkeys(VELOCITY, (-200.0, 200.0)),
    "lat_deg": (-85.0, 85.0),
    "lon_deg": (-180.0, 180.0),
    "alt_m": (-1_000.0, 20_000.0),
    "yaw_deg": (-360.0, 360.0),
    **dict.fromkeys(COMPASS, (-360.0, 360.0)),
    "soc": (0.0, 1.0),
    "voltage_v": (0.0, 200.0),
    "current_a": (-1000.0, 2000.0),
    "rssi_dbm": (-200.0, 50.0),
    "rssi_percent": (0.0, 100.0),
}


@dataclass(frozen=True, slots=True)
class PoseTrace:
    """One drone's motion over time; arrays over the rows that have a position."""

    time_s: Array  # [K]
    position_m: Array  # [K, 3] ENU
    orientation_xyzw: Array | None  # [K, 4]
    velocity_mps: Array | None  # [K, 3]


@dataclass(frozen=True, slots=True)
class DroneTrace:
    """What a trace says of one drone; None where the model keeps."""

    pose: PoseTrace | None
    battery: BatteryTrace | None


def read_traces(path: str | Path, drones: int, origin: Origin | None = None) -> dict[int, DroneTrace]:
    """Read a trace.

    Args:
        path: as `sortie.scenarios.tables.read_table`.
        drones: drones of the fleet; a trace of another is refused.
        origin: where on the globe ENU (0, 0, 0) lies; None: at the first place, at the lowest altitude.

    Raises:
        TraceError: no such file, no table, a column missing or unknown, a value out of bounds, time that does not
            increase, a charge that rises, a place too far from the others; or nothing would be flown.
    """
    path = Path(path)
    columns = read_columns(path, BOUNDS)
    for what, names in (
        ("a pose", POSITION),
        ("a place on the globe", GLOBE),
        ("an attitude", ATTITUDE),
        ("a velocity", VELOCITY),
    ):
        if 0 < sum(name in columns for name in names) < len(names):
            raise TraceError(f"{path}: {what} needs all of {', '.join(names)}")
    for some, others in (((POSITION[0],), (GLOBE[0],)), (("yaw_deg", ATTITUDE[0]), COMPASS)):
        both = [name for name in (*some, *others) if name in columns]
        if set(both) & set(some) and set(both) & set(others):
            raise TraceError(f"{path}: columns {' and '.join(both)} say the same, must be one of them")
    columns = _placed(path, columns, origin)
    who = columns.get("drone", np.zeros(len(columns["t_s"])))
    check_drones(path, "drone", who, drones)
    traces = {}
    for drone in np.unique(who).astype(int).tolist():
        rows = np.flatnonzero(who == drone)
        check_increasing(path, columns["t_s"], rows, f"drone {drone}")
        own = {name: values[rows] for name, values in columns.items()}
        _check_charge(path, drone, rows, columns)
        traces[drone] = DroneTrace(_pose(own), _battery(own))
    if all(trace.pose is None and trace.battery is None for trace in traces.values()):
        place = f"{', '.join(POSITION)} or {', '.join(GLOBE)}"
        raise TraceError(
            f"{path}: no row has a place ({place}) or a charge (soc), so nothing of the trace would be flown"
        )
    return traces


def flown_at(fleet: Fleet) -> Origin | None:
    """Where on the globe ENU (0, 0, 0) lies: `fleet.origin`, or else what a trace in latitude and longitude begins at.

    Raises:
        TraceError: the trace cannot be read.
    """
    if fleet.origin is not None or fleet.trace is None:
        return fleet.origin
    columns = read_columns(Path(fleet.trace), BOUNDS)
    zero = _zero(_stack(columns, GLOBE)) if set(GLOBE) <= set(columns) else None
    return None if zero is None else Origin(**dict(zip(Origin.model_fields, zero, strict=True)))


def flown_motion(
    fleet: Fleet, duration_s: float, frame_s: float, seed: int, replication: int = 0
) -> tuple[Trajectories, dict[int, DroneTrace]]:
    """The motion of a fleet whose traces, if it has any, replace its model; and these traces by drone.

    Raises:
        TraceError: a trace that cannot be read or does not fit.
        MotionError: a way that cannot be flown.
    """
    traces = {} if fleet.trace is None else read_traces(fleet.trace, fleet.drones, fleet.origin)
    return follow(fly(fleet, duration_s, frame_s, seed, replication), traces, frame_s), traces


def follow(motion: Trajectories, traces: Mapping[int, DroneTrace], frame_s: float) -> Trajectories:
    """The motion with every drone that has a pose trace flying it: what it believes keeps the errors of its model."""
    posed = {drone: trace.pose for drone, trace in traces.items() if trace.pose is not None}
    if not posed:
        return motion
    new: dict[str, Array] = {name: scratch.copied(getattr(motion, name)) for name in OF_A_DRONE}
    for drone, pose in posed.items():
        t_s = np.clip(motion.time_s, pose.time_s[0], pose.time_s[-1])
        beyond = np.abs(motion.time_s - t_s) > ROUNDING_S
        within = np.flatnonzero(~beyond)
        position = _sample(t_s, pose.time_s, pose.position_m)
        if pose.velocity_mps is not None:
            velocity = _sample(t_s, pose.time_s, pose.velocity_mps)
        else:
            velocity = _slope(position, within, frame_s)
        if pose.orientation_xyzw is None:
            orientation = _level(velocity)
        elif len(pose.time_s) == 1:
            orientation = np.repeat(pose.orientation_xyzw, len(t_s), axis=0)
        else:
            orientation = Slerp(pose.time_s, Rotation.from_quat(pose.orientation_xyzw))(t_s).as_quat()
        acceleration = _slope(velocity, within, frame_s)  # a trace's begin and end are no manoeuvres
        velocity[beyond] = acceleration[beyond] = 0.0  # there it stands, headed as it will or did
        orientation = continuous(orientation[:, None], orientation[:1])[:, 0]
        yaw = yaw_rad(orientation)
        new["est_position_m"][:, drone] += position - motion.position_m[:, drone]
        new["est_yaw_rad"][:, drone] = wrapped(yaw + motion.est_yaw_rad[:, drone] - motion.yaw_rad[:, drone])
        new["position_m"][:, drone], new["velocity_mps"][:, drone] = position, velocity
        new["orientation_xyzw"][:, drone], new["yaw_rad"][:, drone] = orientation, yaw
        new["acceleration_mps2"][:, drone] = acceleration
        new["body_rates_radps"][:, drone] = body_rates(orientation[:, None], frame_s)[:, 0]
    return replace(motion, **new)


# --- reading -------------------------------------------------------------------------------------


def _placed(path: Path, columns: Mapping[str, Array], origin: Origin | None) -> dict[str, Array]:
    """The columns with places on the globe and compass headings as ENU and as attitudes.

    Raises:
        TraceError: a place that in ENU is out of the bounds of `POSITION`.
    """
    placed = dict(columns)
    if GLOBE[0] in columns:
        fixes = _stack(columns, GLOBE)
        zero = _zero(fixes) if origin is None else tuple(origin.model_dump().values())
        if zero is not None and not np.isnan(fixes).any(axis=-1).all():
            metres = tangent_plane_m(fixes, zero)
            _check_near(path, fixes, metres, origin)
            metres[:, 2] = fixes[:, 2] - zero[2]  # the ground is level in the simulator
            placed |= dict(zip(POSITION, metres.T, strict=True))
    if "heading_deg" in columns:
        level = np.zeros_like(columns["heading_deg"])
        roll, pitch = (np.nan_to_num(columns.get(name, level)) for name in COMPASS[:2])
        known = ~np.isnan(columns["heading_deg"])
        turns = np.stack([columns["heading_deg"], pitch, roll], axis=-1)[known]
        attitude = np.full((len(level), 4), np.nan)
        if known.any():
            attitude[known] = swap_attitude(Rotation.from_euler("ZYX", turns, degrees=True).as_quat())
        placed |= dict(zip(ATTITUDE, attitude.T, strict=True))
    return placed


def _check_near(path: Path, fixes: Array, metres: Array, origin: Origin | None) -> None:
    """Refuse places on the globe beyond the bounds of `POSITION`; `metres` is ENU with the earth's curvature."""
    most_m = BOUNDS[POSITION[0]][1]
    far = np.asarray((np.abs(metres) > most_m).any(axis=-1))
    if not far.any():
        return
    unset = np.asarray((fixes[:, :2] == 0.0).all(axis=-1))  # what receivers report before they have a fix
    if origin is None:
        off_m: Array = np.asarray(np.linalg.norm(metres - np.nanmedian(metres, axis=0), axis=-1))
        far = unset if unset.any() else off_m >= float(np.nanmax(off_m))
    row = first_row(far)
    others = np.zeros(3) if origin is not None else metres
    away_km = np.nanmax(np.linalg.norm(metres[row - 1] - others, axis=-1)) / 1e3
    raise TraceError(
        f"{path}: lat_deg and lon_deg in row {row} are {fixes[row - 1, 0]:g} and {fixes[row - 1, 1]:g}, {away_km:,.0f} km "
        f"from {'another place' if origin is None else 'fleet.origin'}, must be within {most_m / 1e3:g} km"
        + ("; leave cells empty where a receiver had no fix" if unset[row - 1] else "")
    )


def _zero(fixes: Array) -> tuple[float, ...] | None:
    """The first place on the globe, at the lowest altitude; None where there is none."""
    known = fixes[~np.isnan(fixes).any(axis=-1)]
    return (float(known[0, 0]), float(known[0, 1]), float(known[:, 2].min())) if len(known) else None


def _pose(own: Mapping[str, Array]) -> PoseTrace | None:
    if "x_m" not in own:
        return None
    position = _stack(own, POSITION)
    there = ~np.isnan(position).any(axis=-1)
    if not there.any():
        return None
    t_s = own["t_s"][there]
    orientation = velocity = None
    if all(name in own for name in VELOCITY):
        velocity = _filled(t_s, _stack(own, VELOCITY)[there])
    if all(name in own for name in ATTITUDE):
        quaternion = _stack(own, ATTITUDE)[there]
        norm = np.linalg.norm(quaternion, axis=-1)
        sound = norm > 0.5  # NaN compares false
        if sound.any():
            nearest = _nearest(t_s, t_s[sound])
            orientation = (quaternion[sound] / norm[sound, None])[nearest]
    elif "yaw_deg" in own:
        yaw = np.radians(own["yaw_deg"][there])
        sound = ~np.isnan(yaw)
        if sound.any():
            half = 0.5 * yaw[sound][_nearest(t_s, t_s[sound])]
            zero = np.zeros_like(half)
            orientation = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)
    return PoseTrace(t_s, position[there], orientation, velocity)


def _check_charge(path: Path, drone: int, rows: npt.NDArray[np.intp], columns: Mapping[str, Array]) -> None:
    """Refuse a charge of a drone that rises by more than rounding; `rows` are the drone's."""
    known = rows[~np.isnan(columns["soc"][rows])] if "soc" in columns else rows[:0]
    soc = columns.get("soc", np.zeros(0))[known]
    rises = np.diff(soc) > ROUNDING
    if rises.any():
        at = first_row(rises)
        raise TraceError(
            f"{path}: soc in row {known[at] + 1} of drone {drone} rises from {soc[at - 1]:g} to {soc[at]:g}, "
            "must not rise in flight"
        )


def _battery(own: Mapping[str, Array]) -> BatteryTrace | None:
    if "soc" not in own:
        return None
    there = ~np.isnan(own["soc"])
    if not there.any():
        return None
    t_s, soc = own["t_s"][there], np.minimum.accumulate(own["soc"][there])

    def some(name: str) -> tuple[list[float], list[float]]:
        values = own.get(name, np.full(len(there), np.nan))
        sound = ~np.isnan(values)
        return own["t_s"][sound].tolist(), values[sound].tolist()

    return BatteryTrace(
        t_s.tolist(), soc.tolist(), energy_fraction(soc).tolist(), *some("voltage_v"), *some("current_a")
    )


# --- arithmetic ----------------------------------------------------------------------------------


def _sample(t_s: Array, time_s: Array, values: Array) -> Array:
    return np.stack([np.interp(t_s, time_s, column) for column in values.T], axis=-1)


def _slope(values: Array, frames: npt.NDArray[np.intp], step_s: float) -> Array:
    """Central differences [T, 3] of the values in these frames, held beyond them; of a single one, zeros."""
    if len(frames) < 2:
        return np.zeros_like(values)
    at = np.clip(np.arange(len(values)), frames[0], frames[-1]) - frames[0]
    slope: Array = np.gradient(values[frames], step_s, axis=0)[at]
    return slope


def _level(velocity: Array) -> Array:
    """Upright, heading along the track; where it hardly moves, as before."""
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > 0.5
    heading = np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), 0.0)
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), 0))
    half = 0.5 * heading[last]
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def _filled(t_s: Array, values: Array) -> Array | None:
    """Gaps filled linearly; None where nothing is known."""
    sound = ~np.isnan(values).any(axis=-1)
    return _sample(t_s, t_s[sound], values[sound]) if sound.any() else None


def _nearest(t_s: Array, known_s: Array) -> npt.NDArray[np.intp]:
    """Index of the known time nearest to each."""
    after = np.clip(np.searchsorted(known_s, t_s), 0, len(known_s) - 1)
    before = np.maximum(after - 1, 0)
    nearer: npt.NDArray[np.intp] = np.where(t_s - known_s[before] < known_s[after] - t_s, before, after)
    return nearer


def _stack(own: Mapping[str, Array], names: Sequence[str]) -> Array:
    return np.stack([own[name] for name in names], axis=-1)
