"""What choosing viewpoints gains and costs (`make figures FIGURE=viewpoints`).

`vantage` flies against `all-4`, which shares the very same and holds its slots: same seeds, same town, same draws. The
mission is given by where its target drives; AP is by the surrogate detector, energy by the rotor model that charges
accelerations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from research.validation.pairs_of_records import pair_up
from research.validation.stored import Column, Table, points
from sortie.fleet.coverage import footprint_radius_m
from sortie.perception.metrics.ap import average_precision
from sortie.perception.metrics.bootstrap import Difference
from sortie.policies.registry import resolve, within_budget
from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.manoeuvres import VIEWPOINT
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SCENARIO, BUDGET, RADIUS_M = "track_target", 0.1, 32.0
STAYS, MOVES = "all-4", "vantage"
TRACKING_FROM_S = 5.0
MISSIONS: dict[str, tuple[str, ...]] = {
    "the target drives below the fleet": ("mission.target.waypoints_m=[[-150, -1.75], [400, -1.75]]",),
    "the target drives one street beside it, 80 m": ("mission.target.waypoints_m=[[-150, 81.75], [400, 81.75]]",),
    "the same, and the fleet may come 50 m near": (
        "mission.target.waypoints_m=[[-150, 81.75], [400, 81.75]]", "fleet.viewpoints.reach_m=50",
    ),
    "the target fell 60 m behind": ("mission.target.waypoints_m=[[-210, -1.75], [400, -1.75]]",),
}  # fmt: skip
"""By name, and what it sets."""

Interval = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class RepositionRow:
    """One mission: slots held (a) against viewpoints chosen (b)."""

    mission: str
    mission_ap: Difference
    """AP@0.5 in the mission disc; the interval is over sorties."""
    full_ap: Difference
    covered: tuple[float, float]
    """Mean share of the mission disc within some drone's footprint, a and b."""
    covered_gain: Interval
    energy_j: tuple[float, float]
    """Fleet and sortie, a and b."""
    energy_gain_j: Interval
    nearest_m: float
    """The closest that two drones came, in b."""
    moves: float
    """A sortie."""


def measure(
    seeds: Sequence[int], duration_s: float, missions: Sequence[str] = tuple(MISSIONS)
) -> Iterator[RepositionRow]:
    """One row a mission. Every seed has a town of its own.

    Raises:
        ValueError: one sortie, which has no interval, or one that ends before it tracks, which has no accuracy.
    """
    if len(seeds) < 2:
        raise ValueError(f"{len(seeds)} seeds, must be at least 2")
    if not duration_s > TRACKING_FROM_S:
        raise ValueError(f"duration_s is {duration_s:g}, must be above {TRACKING_FROM_S:g}, when tracking begins")
    for mission in missions:
        stays, moves = ([_flown(policy, seed, duration_s, mission) for seed in seeds] for policy in (STAYS, MOVES))
        covered = np.array([[covered_share(r) for r in arm] for arm in (stays, moves)])
        energy_j = np.array([[outcome(r)["energy_j"]["total"] for r in arm] for arm in (stays, moves)])
        yield RepositionRow(
            mission,
            _difference(stays, moves, mission=True),
            _difference(stays, moves, mission=False),
            (float(covered[0].mean()), float(covered[1].mean())),
            _gain(covered),
            (float(energy_j[0].mean()), float(energy_j[1].mean())),
            _gain(energy_j),
            min(nearest_m(r) for r in moves),
            float(np.mean([_moves(r) for r in moves])),
        )


def covered_share(record: SortieRecord) -> float:
    """Mean over the tracking frames of the share of the mission disc that lies within some drone's footprint."""
    position = positions_m(record)
    mission = record.tables["mission"]
    centre = np.stack([mission["region_x_m"].to_numpy(), mission["region_y_m"].to_numpy()], axis=-1)
    radius_m = mission["region_radius_m"].to_numpy()
    side = (np.arange(20) + 0.5) / 10 - 1
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) <= 1]
    shares = []
    for frame in np.flatnonzero(np.isfinite(radius_m)):
        points = centre[frame] + radius_m[frame] * grid
        away = np.linalg.norm(points[:, None] - position[frame, None, :, :2], axis=-1)
        shares.append((away <= footprint_radius_m(position[frame, :, 2])).any(axis=1).mean())
    return float(np.mean(shares))


def nearest_m(record: SortieRecord) -> float:
    """The least distance of any two drones in any frame."""
    position = positions_m(record)
    first, second = np.triu_indices(position.shape[1], k=1)
    return float(np.linalg.norm(position[:, first] - position[:, second], axis=-1).min())


def positions_m(record: SortieRecord) -> np.ndarray:
    """[T, N, 3] true positions, ENU."""
    states = record.tables["states"]
    xyz = np.stack([states[name].to_numpy() for name in ("x_m", "y_m", "z_m")], axis=-1)
    return xyz.reshape(-1, record.scenario.fleet.drones, 3)


def scenario_of(policy: str, seed: int, duration_s: float, mission: str) -> Scenario:
    """The sortie of one arm."""
    half_m = 2.5 * duration_s
    return load(
        SCENARIO,
        [
            "expect=[]", "expect_decisions=[]", "perception.detector=surrogate", f"duration_s={duration_s:g}",
            "fleet.airframe.power_model=momentum", f"perception.scene.seed={1000 + seed}",
            f"fleet.route.waypoints_m=[[-150, 0], [{2 * half_m - 150:g}, 0]]",
            f"mission.phases=[{{at_s: 0, phase: search}}, {{at_s: {TRACKING_FROM_S:g}, phase: track, region: {{radius_m: {RADIUS_M:g}}}}}]",
            f"policy.name={policy}", f"policy.params={within_budget(resolve(policy), BUDGET)}", *MISSIONS[mission],
        ],
    )  # fmt: skip


def _flown(policy: str, seed: int, duration_s: float, mission: str) -> SortieRecord:
    return run_sortie(scenario_of(policy, seed, duration_s, mission), None, seed)


def _moves(record: SortieRecord) -> int:
    return sum(e["kind"] == VIEWPOINT and e["text"].startswith("moves") for e in record.tables["events"].to_pylist())


def _gain(arms: np.ndarray) -> Interval:
    """Mean of b less a over [2, sorties], with its 95 % interval."""
    gain = mean_interval(arms[1] - arms[0])
    return gain.mean, gain.low, gain.high


def _difference(a: Sequence[SortieRecord], b: Sequence[SortieRecord], *, mission: bool) -> Difference:
    """AP while tracking: means over sorties of each sortie's own AP and difference."""
    pairs = [pair_up([one], [other], mission=mission, begin_s=TRACKING_FROM_S) for one, other in zip(a, b, strict=True)]
    arms = np.array([[average_precision(pair[arm]) for pair in pairs] for arm in (0, 1)])
    return Difference(*np.nanmean(arms, axis=1).tolist(), *_gain(arms))


def table(rows: Sequence[RepositionRow], about: str = "") -> Table:
    """A row a mission: what `all-4` has, and what `vantage` changes."""
    return Table(
        [
            Column("mission"),
            Column("mission AP", ".3f"),
            Column("gain", "+.1f", factor=100),
            Column("full AP", ".3f"),
            Column("gain", "+.1f", factor=100),
            Column("disc covered", ".0f", " %", 100),
            Column("gain", "+.1f", factor=100),
            Column("energy", ".1f", " kJ", 1e-3),
            Column("change", "+.1f", factor=1e-3),
            Column("nearest pair", ".1f", " m"),
            Column("moves", ".1f"),
        ],
        [
            [
                r.mission, r.mission_ap.ap_a, points(r.mission_ap), r.full_ap.ap_a, points(r.full_ap), r.covered[0],
                r.covered_gain, r.energy_j[0], r.energy_gain_j, r.nearest_m, r.moves,
            ]
            for r in rows
        ],
        about,
    )  # fmt: skip
