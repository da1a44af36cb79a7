"""The jobs that the torch detector runs for a calibration: scenes, fleets and shares, from seeded draws. Free of torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from research.benchmark.scenes import AREA_M, DRONES, model_of
from sortie.perception.joining import Rule
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.traffic import TargetPath
from sortie.perception.types import Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.formation import slots
from sortie.scenarios.schema import Scene, Target
from sortie.scenarios.streams import stream

Split = Literal["fit", "held-out"]
SPLITS: dict[Split, int] = {"fit": 1, "held-out": 2}
Manner = Literal["anywhere", "street"]
MANNERS: tuple[Manner, ...] = ("anywhere", "street")
"""How a scene's first moment is flown, and its second: anywhere and turned anyhow, or along the street through the origin as
sorties are, with a mission's target below, and cars that stand square on every drone's map."""
LANE_M = 1.75
"""From a street's middle to the target's path. The town's lanes are 1.6 m away (`town.LANE_CENTRE_M`); the shipped calibration
was drawn with this value."""
FIRST_S, LAST_S = 5.0, 300.0
"""Moments lie between these times."""
THRESHOLD = 0.1
"""Boxes count from this score on."""
BUDGETS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0)
DRAWN, PLAIN = 4, 3
"""Exchanges per drone for the fit: drawn in every respect, and plain."""
AGES_S = (0.1, 0.2, 0.4)
"""How much older than the ego's a share may be."""
STYLES = ("town", "old_town", "suburb", "yard")
_SHAPES = {
    "cross": slots("cross", DRONES, 1.0),
    "line": np.array([(0, 0), (0, 1), (0, 2), (0, -1), (0, -2)], dtype=np.float64),
    "wedge": slots("wedge", DRONES, 1.0),
    "circle": np.array([(np.cos(a), np.sin(a)) for a in np.arange(5) * 2 * np.pi / 5]) / (2 * np.sin(np.pi / 5)),
}
"""The shipped calibration was drawn with these. Line and circle are not the fleet's (`scenarios.formation.slots`): its line
counts left and right in turn, and its circle is a little smaller, as it measures spacing along the arc."""
Fleets = tuple[list[Capture], dict[float, list[Capture]]]
"""A fleet's captures now, and a little earlier by how much."""


@dataclass(frozen=True, slots=True)
class DetectorJob:
    """One ego's detection, and the condition under which it is run."""

    ego: Capture
    shares: tuple[Share, ...]
    unsent: Literal["masked", "zero"]
    condition: str
    """Jobs of one condition are judged together; empty where they are only fitted."""
    join: Rule = "nms"
    disc: Disc | None = None
    """A mission's disc in which the condition is judged as well."""


def scene_seed(seed: int, split: Split, index: int) -> int:
    """The town's seed: other towns for every calibration seed, split and index, far from those of people and of training."""
    return 50_000_000 + (seed * len(SPLITS) + SPLITS[split] - 1) * 100_000 + index


def draw_scene(seed: int, split: Split, index: int) -> Scene:
    """A town about the schema's defaults; every other one in the defaults' light."""
    name = scene_seed(seed, split, index)
    u = stream(name, 0, (), "calibrate.scene").random(11)
    light = (
        {}
        if u[0] < 0.5
        else dict(
            sun_azimuth_deg=360 * u[1], sun_elevation_deg=25 + 50 * u[2], overcast=u[3], brightness=0.7 + 0.4 * u[4]
        )
    )
    return Scene(
        seed=name,
        style=STYLES[index % len(STYLES)],
        block_m=60 + 60 * u[5],
        building_density=0.3 + 0.6 * u[6],
        building_height_m=5 + 10 * u[7],
        tree_density=0.2 + 0.6 * u[8],
        parked_density=0.05 + 0.45 * u[9],
        moving_cars_per_km=3 + 11 * u[10],
        moving_speed_mps=4 + 8 * stream(name, 0, (), "calibrate.speed").random(),
        **light,
    )


def draw_target(seed: int, split: Split, index: int) -> Target:
    """A mission's target: it keeps to the right of the street that the scene's fleet flies along, as fast as the fleet or not,
    and is near the fleet at the fleet's moment."""
    name = scene_seed(seed, split, index)
    flown = _Street.draw(stream(name, 0, MANNERS.index("street"), "calibrate.fleet"))
    u = stream(name, 0, (), "calibrate.target").random(3)
    speed = max(flown.speed_mps if u[0] < 0.7 else 12 * u[1], 0.5)
    way = np.array([np.cos(flown.heading), np.sin(flown.heading)])
    right = LANE_M * np.array([way[1], -way[0]])
    here = flown.along_m + 10 * (2 * u[2] - 1)
    ends = (right + (here + speed * (t_s - flown.t_s)) * way for t_s in (0.0, LAST_S))
    return Target(waypoints_m=tuple((float(x), float(y)) for x, y in ends), speed_mps=speed)


def scene_model(seed: int, split: Split, index: int) -> SceneModel:
    """The scene model of a drawn scene, with its target."""
    return model_of(draw_scene(seed, split, index), draw_target(seed, split, index))


def moment(seed: int, split: Split, scene: int, index: int, condition_egos: int = 2) -> list[DetectorJob]:
    """The jobs of moment `index` of a scene.

    For the fit, every drone runs alone, under some exchanges that are drawn in every respect, and under some plain ones: all
    others, one budget, everywhere and at once. Held out, some drones run under every condition of the moment's manner.
    """
    rng = stream(scene_seed(seed, split, scene), 0, index, "calibrate.fleet")
    manner = MANNERS[index]
    now, old = _on_street(rng) if manner == "street" else _anywhere(rng, split)
    if split == "held-out":
        egos = [int(ego) for ego in rng.permutation(DRONES)[:condition_egos]]
        if manner == "anywhere":
            return [job for ego in egos for job in conditions(ego, now, old)]
        x, y, _ = TargetPath.of(draw_target(seed, split, scene)).pose(now[0].t_s)
        return [job for ego in egos for job in street_conditions(ego, now, old, Disc(x, y, 32.0))]
    jobs = [DetectorJob(ego, (), "masked", "") for ego in now]
    jobs += [_exchange(rng, ego, now, old) for ego in now for _ in range(DRAWN)]
    return jobs + [_plain(rng, ego, now) for ego in now for _ in range(PLAIN)]


def conditions(ego: int, now: list[Capture], old: dict[float, list[Capture]]) -> Iterator[DetectorJob]:
    """One drone under the exchanges that calibrations are judged by."""
    peers = [i for i in range(len(now)) if i != ego]
    near = sorted(peers, key=lambda i: np.hypot(*np.subtract(now[i].position_m, now[ego].position_m)[:2]))
    x, y, _ = now[ego].position_m
    turn = now[ego].true_yaw_rad
    disc = Disc(x + 20 * float(np.cos(turn)), y + 20 * float(np.sin(turn)), 32.0)

    def job(
        name: str,
        rho: float,
        who: list[int] = peers,
        unsent: Literal["masked", "zero"] = "masked",
        *,
        roi: Disc | None = None,
        age_s: float = 0.0,
        representation: str = "features",
        weight: float = 1.0,
        boxes_of: list[int] | None = None,
        join: Rule = "nms",
    ) -> DetectorJob:
        of = old[age_s] if age_s else now
        shares = tuple(Share(of[i], representation, rho, roi, weight) for i in who)
        shares += tuple(Share(of[i], "detections", 0.0, None, 1.0) for i in boxes_of or [])
        return DetectorJob(now[ego], shares, unsent, name, join)

    yield job("alone", 0.0, [])
    for rho in BUDGETS:
        yield job(f"all-4, ρ = {rho:g}", rho)
    for rho in (0.01, 0.05, 0.25):
        yield job(f"all-4, ρ = {rho:g}, zeros", rho, unsent="zero")
    yield job("all-4, ρ = 0.25, weight ½", 0.25, weight=0.5)
    yield job("all-4, ρ = 0.25, 0.2 s older", 0.25, age_s=0.2)
    yield job("all-4, ρ = 0.25, 0.4 s older", 0.25, age_s=0.4)
    yield job("all-4, ρ = 0.02, 32 m", 0.02, roi=disc)
    yield job("all-4, ρ = 0.25, 32 m", 0.25, roi=disc)
    for rho in (0.1, 0.5):
        yield job(f"nearest 2, ρ = {rho:g}", rho, near[:2])
    yield job("farthest 2, ρ = 0.5", 0.5, near[-2:])
    yield job("detections", 1.0, representation="detections")
    yield job("detections, averaged", 1.0, representation="detections", join="average")
    yield job("tracks", 1.0, representation="tracks")
    for rule in ("nms", "average"):
        yield job(f"nearest 2, ρ = 0.1, boxes of the others, {rule}", 0.1, near[:2], boxes_of=near[2:], join=rule)


def street_conditions(
    ego: int, now: list[Capture], old: dict[float, list[Capture]], disc: Disc
) -> Iterator[DetectorJob]:
    """One drone of a fleet that flies along a street, under exchanges as sorties have them, in the mission's disc too."""
    peers = [i for i in range(len(now)) if i != ego]

    def job(
        name: str,
        rho: float,
        of: list[Capture] = now,
        representation: str = "features",
        roi: Disc | None = None,
        join: Rule = "nms",
    ) -> DetectorJob:
        shares = tuple(Share(of[i], representation, rho, roi, 1.0) for i in peers if name != "alone")
        return DetectorJob(now[ego], shares, "masked", f"street: {name}", join, disc)

    yield job("alone", 0.0)
    for rho in (0.006, 0.025, 0.1, 0.35):
        yield job(f"all-4, ρ = {rho:g}", rho)
    yield job("all-4, ρ = 0.1, 32 m", 0.1, roi=disc)
    yield job("all-4, ρ = 0.1, 0.1 s older", 0.1, old[0.1])
    yield job("detections", 0.0, representation="detections")
    yield job("detections, averaged", 0.0, representation="detections", join="average")


def _anywhere(rng: np.random.Generator, split: Split) -> Fleets:
    """A jittered formation of five, 60 m up or so, now and a little earlier, with attitude and pose errors."""
    u = rng.random(9)
    t_s = _time_s(u[0])
    shape = "cross" if split == "held-out" or u[1] < 0.6 else "line" if u[1] < 0.8 else "wedge"
    spacing = 20.0 if split == "held-out" else 12 + 23 * u[2]
    altitude = 60.0 if split == "held-out" or u[3] < 0.5 else 30 + 40 * u[3]
    position_error, heading_error = 0.2, np.radians(0.2)
    if split == "fit" and u[4] < 0.5:
        position_error, heading_error = 0.05 + 0.5 * u[5], np.radians(1.0 * u[6])
    heading, speed = 2 * np.pi * u[7], 8 * u[8]
    c, s = np.cos(heading), np.sin(heading)
    places = rng.uniform(-AREA_M, AREA_M, 2) + spacing * _SHAPES[shape] @ np.array([[c, s], [-s, c]])
    poses = []
    for slot in places:
        place = np.array([*slot, altitude]) + 0.5 * rng.normal(size=3)
        yaw = heading + np.radians(1.0) * rng.normal()
        roll, pitch = np.radians(3.0) * rng.normal(size=2)
        poses.append((place, (yaw, pitch, roll), position_error * rng.normal(size=3), heading_error * rng.normal()))
    return _captures(t_s, heading, speed, poses)


def _on_street(rng: np.random.Generator) -> Fleets:
    """A formation of five along the street through the origin, one way or the other: nose down by half a degree for each metre
    a second, heights known, everything else as a sortie's defaults are."""
    flown = _Street.draw(rng)
    heading, speed = flown.heading, flown.speed_mps
    c, s = np.cos(heading), np.sin(heading)
    across_m = 2.0 * rng.normal()
    places = (np.array([flown.along_m, across_m]) + flown.spacing_m * _SHAPES[flown.shape]) @ np.array(
        [[c, s], [-s, c]]
    )
    poses = []
    for slot in places:
        place = np.array([*slot, 60.0]) + 0.5 * rng.normal(size=3)
        yaw = heading + np.radians(0.15) * rng.normal()
        pitch, roll = np.radians(0.5 * speed + 1.7 * rng.normal()), np.radians(2.0) * rng.normal()
        error = np.array([*(0.2 * rng.normal(size=2)), 0.0])
        poses.append((place, (yaw, pitch, roll), error, np.radians(0.2) * rng.normal()))
    return _captures(flown.t_s, heading, speed, poses)


@dataclass(frozen=True, slots=True)
class _Street:
    """How a fleet flies along a street through the origin: when, in which formation, which way, how fast, and how far along it."""

    t_s: float
    shape: str
    spacing_m: float
    heading: float
    speed_mps: float
    along_m: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> _Street:
        u = rng.random(6)
        shape, heading = list(_SHAPES)[int(4 * u[1])], np.pi / 2 * int(4 * u[3])
        return cls(_time_s(u[0]), shape, 14 + 12 * u[2], heading, 10 * u[4], AREA_M * (2 * u[5] - 1))


def _time_s(u: float) -> float:
    return float(np.round(FIRST_S + (LAST_S - FIRST_S) * u, 3))


def _captures(
    t_s: float,
    heading: float,
    speed_mps: float,
    poses: list[tuple[NDArray[np.float64], tuple[float, float, float], NDArray[np.float64], float]],
) -> Fleets:
    """Each drone's captures from its place, attitude (yaw, pitch, roll) and errors of position and heading."""
    now: list[Capture] = []
    old: dict[float, list[Capture]] = {age: [] for age in AGES_S}
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    for drone, (at, attitude, error, turn) in enumerate(poses):
        q = Rotation.from_euler("ZYX", attitude).as_quat()
        for age in (0.0, *AGES_S):
            place = at - ahead * speed_mps * age
            capture = Capture(
                drone,
                float(np.round(t_s - age, 3)),
                (float(place[0]), float(place[1]), float(place[2])),
                (float(q[0]), float(q[1]), float(q[2]), float(q[3])),
                tuple(float(v) for v in place + error),  # type: ignore[arg-type]
                float(attitude[0] + turn),
            )
            (old[age] if age else now).append(capture)
    return now, old


def _rho(everything: float, u: float) -> float:
    """A drawn budget: all of it with the given chance, else evenly spread in its logarithm from 0.4 % on."""
    return 1.0 if everything < 0.3 else float(0.004 * 250.0**u)


def _plain(rng: np.random.Generator, ego: Capture, now: list[Capture]) -> DetectorJob:
    """All others send a drawn part of their maps as they are now."""
    rho = _rho(*rng.random(2))
    shares = tuple(Share(c, "features", rho, None, 1.0) for c in now if c is not ego)
    return DetectorJob(ego, shares, "masked", "")


def _exchange(
    rng: np.random.Generator, ego: Capture, now: list[Capture], old: dict[float, list[Capture]]
) -> DetectorJob:
    """A drawn exchange: who, how many cells, where, how old, what a cell that was not sent counts as."""
    u = rng.random(8)
    peers = rng.permutation([c.drone for c in now if c is not ego])[: 1 + int(4 * u[0])]
    if u[0] > 0.6:
        peers = np.array([c.drone for c in now if c is not ego])
    rho = _rho(u[1], u[2])
    roi = None
    if u[3] < 0.25:
        x, y = np.array(ego.position_m[:2]) + rng.uniform(-45, 45, 2)
        roi = Disc(float(x), float(y), float(20 + 30 * u[4]))
    ages = rng.choice((0.0, *AGES_S), size=len(peers)) if u[5] < 0.35 else np.zeros(len(peers))
    if u[5] < 0.2:
        ages[:] = ages[0]
    weights = rng.random(len(peers)) if u[6] < 0.15 else np.ones(len(peers))
    if u[6] < 0.075:
        weights[:] = weights[0]
    shares = tuple(
        Share((old[float(a)] if a else now)[p], "features", rho, roi, float(w))
        for p, a, w in zip(peers, ages, weights, strict=True)
    )
    return DetectorJob(ego, shares, "zero" if u[7] < 0.25 else "masked", "")
