"""What the torch detector is asked for a calibration: scenes, fleets and shares by draws that anyone can make again. Free of torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from perception.joining import Rule
from perception.scene import SceneModel
from perception.types import Capture, Share
from scenarios.schema import Scene
from scenarios.streams import stream

Split = Literal["fit", "held-out"]
SPLITS: dict[Split, int] = {"fit": 1, "held-out": 2}
AREA_M = 60.0
"""The fleet's middle lies within ± this of the scene's origin."""
DRONES = 5
THRESHOLD = 0.1
"""Boxes count from this score on."""
BUDGETS = (0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0)
AGES_S = (0.1, 0.2, 0.4)
"""How much older than the ego's a share may be."""
STYLES = ("town", "old_town", "suburb", "yard")
_SHAPES = {
    "cross": np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)], dtype=np.float64),
    "line": np.array([(0, 0), (0, 1), (0, 2), (0, -1), (0, -2)], dtype=np.float64),
    "wedge": np.array([(0, 0), (-1, 1), (-1, -1), (-2, 2), (-2, -2)], dtype=np.float64) / np.sqrt(2),
}


@dataclass(frozen=True, slots=True)
class Job:
    """One question to the detector, and the condition under which it is asked."""

    ego: Capture
    shares: tuple[Share, ...]
    unsent: Literal["masked", "zero"]
    cells_by: Literal["confidence", "norm"]
    condition: str
    """Jobs of one condition are judged together; empty where they are only fitted."""
    join: Rule = "nms"


@dataclass(frozen=True, slots=True)
class Moment:
    """One fleet in one scene at one time, and what is asked of it."""

    index: int
    jobs: tuple[Job, ...]


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


def scene_model(config: Scene) -> SceneModel:
    """The scene as every moment of it is asked for."""
    return SceneModel(config, None, (-AREA_M, -AREA_M, AREA_M, AREA_M))


def moment(seed: int, split: Split, scene: int, index: int, condition_egos: int = 2) -> Moment:
    """What is asked at moment `index` of a scene.

    For the fit, every drone is asked alone and under two drawn exchanges. Held out, the first `condition_egos` drones are
    asked under every one of `conditions`.
    """
    rng = stream(scene_seed(seed, split, scene), 0, index, "calibrate.fleet")
    now, old = _fleet(rng, split)
    if split == "held-out":
        egos = rng.permutation(DRONES)[:condition_egos]
        return Moment(index, tuple(job for ego in egos for job in conditions(int(ego), now, old)))
    jobs = [Job(ego, (), "masked", "confidence", "") for ego in now]
    jobs += [_exchange(rng, ego, now, old) for ego in now for _ in range(2)]
    return Moment(index, tuple(jobs))


def conditions(ego: int, now: list[Capture], old: dict[float, list[Capture]]) -> Iterator[Job]:
    """One drone under the exchanges that calibrations are judged by."""
    peers = [i for i in range(len(now)) if i != ego]
    near = sorted(peers, key=lambda i: np.hypot(*np.subtract(now[i].position_m, now[ego].position_m)[:2]))
    x, y, _ = now[ego].position_m
    turn = now[ego].true_yaw_rad
    disc = (x + 20 * float(np.cos(turn)), y + 20 * float(np.sin(turn)), 32.0)

    def job(
        name: str,
        rho: float,
        who: list[int] = peers,
        unsent: Literal["masked", "zero"] = "masked",
        *,
        cells_by: Literal["confidence", "norm"] = "confidence",
        roi: tuple[float, float, float] | None = None,
        age_s: float = 0.0,
        representation: str = "features",
        weight: float = 1.0,
        boxes_of: list[int] | None = None,
        join: Rule = "nms",
    ) -> Job:
        of = old[age_s] if age_s else now
        shares = tuple(Share(of[i], representation, rho, roi, weight) for i in who)
        shares += tuple(Share(of[i], "detections", 0.0, None, 1.0) for i in boxes_of or [])
        return Job(now[ego], shares, unsent, cells_by, name, join)

    yield job("alone", 0.0, [])
    for rho in BUDGETS:
        yield job(f"all-4, ρ = {rho:g}", rho)
    for rho in (0.01, 0.05, 0.25):
        yield job(f"all-4, ρ = {rho:g}, zeros", rho, unsent="zero")
    yield job("all-4, ρ = 0.1, norm", 0.1, cells_by="norm")
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


def _fleet(rng: np.random.Generator, split: Split) -> tuple[list[Capture], dict[float, list[Capture]]]:
    """A jittered formation of five, 60 m up or so, now and a little earlier, with attitude and pose errors."""
    u = rng.random(9)
    t_s = float(np.round(5 + 295 * u[0], 3))
    shape = "cross" if split == "held-out" or u[1] < 0.6 else "line" if u[1] < 0.8 else "wedge"
    spacing = 20.0 if split == "held-out" else 12 + 23 * u[2]
    altitude = 60.0 if split == "held-out" else 50 + 20 * u[3]
    position_error, heading_error = 0.2, np.radians(0.2)
    if split == "fit" and u[4] < 0.5:
        position_error, heading_error = 0.05 + 0.5 * u[5], np.radians(1.0 * u[6])
    heading, speed = 2 * np.pi * u[7], 8 * u[8]
    c, s = np.cos(heading), np.sin(heading)
    slots = rng.uniform(-AREA_M, AREA_M, 2) + spacing * _SHAPES[shape] @ np.array([[c, s], [-s, c]])
    now: list[Capture] = []
    old: dict[float, list[Capture]] = {age: [] for age in AGES_S}
    for drone, slot in enumerate(slots):
        x, y, z = np.array([*slot, altitude]) + 0.5 * rng.normal(size=3)
        yaw = heading + np.radians(1.0) * rng.normal()
        roll, pitch = np.radians(3.0) * rng.normal(size=2)
        error, turn = position_error * rng.normal(size=3), heading_error * rng.normal()
        for age in (0.0, *AGES_S):
            q = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
            place = np.array([x - c * speed * age, y - s * speed * age, z])
            capture = Capture(
                drone,
                float(np.round(t_s - age, 3)),
                (float(place[0]), float(place[1]), float(place[2])),
                (float(q[0]), float(q[1]), float(q[2]), float(q[3])),
                tuple(float(v) for v in place + error),  # type: ignore[arg-type]
                float(yaw + turn),
            )
            (old[age] if age else now).append(capture)
    return now, old


def _exchange(rng: np.random.Generator, ego: Capture, now: list[Capture], old: dict[float, list[Capture]]) -> Job:
    """A drawn exchange: who, how many cells, where, how old, what a cell that was not sent counts as."""
    u = rng.random(9)
    peers = rng.permutation([c.drone for c in now if c is not ego])[: 1 + int(4 * u[0])]
    if u[0] > 0.6:
        peers = np.array([c.drone for c in now if c is not ego])
    rho = 1.0 if u[1] < 0.3 else float(0.008 * 125.0 ** u[2])
    roi = None
    if u[3] < 0.25:
        x, y = np.array(ego.position_m[:2]) + rng.uniform(-45, 45, 2)
        roi = (float(x), float(y), float(20 + 30 * u[4]))
    ages = rng.choice((0.0, *AGES_S), size=len(peers)) if u[5] < 0.35 else np.zeros(len(peers))
    if u[5] < 0.2:
        ages[:] = ages[0]
    weights = rng.random(len(peers)) if u[6] < 0.15 else np.ones(len(peers))
    shares = tuple(
        Share((old[float(a)] if a else now)[p], "features", rho, roi, float(w))
        for p, a, w in zip(peers, ages, weights, strict=True)
    )
    return Job(ego, shares, "zero" if u[7] < 0.25 else "masked", "norm" if u[8] < 0.15 else "confidence", "")
