"""The suites of conditions on which policies are ranked, drawn at random from a seed that is fixed for each version.

A suite crosses ten troubles with three missions, one condition each. Budgets are spread evenly over two orders of
magnitude, sizes of fleet, formations and towns over what there is; which condition gets which is drawn. Each condition has a
town and a seed of its own, so that conditions are independent draws. `scenarios/library/ranking_v1.yaml` is the text that
`suite_text(1)` returns; a version that was released is never drawn anew.

    python -m research.ranking.suite        writes the newest version into the library, and its further draws beside it
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from sortie.scenarios.reading.load import condition_sets
from sortie.scenarios.schema.conditions import Condition
from sortie.scenarios.streams import stream
from sortie.sim.folders import write_text

SEEDS = {1: 211070638063016}
"""By version: drawn by the operating system's random numbers when the version was made, before any policy flew in it."""
NEWEST = max(SEEDS)
FURTHER = 10
"""Further draws that come with a suite: `sortie rank --by-torch` has the surrogate fly some of them as well."""
SECONDS = 20
MISSIONS = ("search", "track", "handover")
"""`handover` searches first, and tracks from a third of the flight on."""
TROUBLES = (
    "clear",
    "weak",
    "jammed",
    "cut_off",
    "tired",
    "battery_fault",
    "lie",
    "spoof",
    "sensor_fault",
    "drone_lost",
)
BUDGETS = (0.005, 0.5)
CHARGED, TIRED = (0.5, 1.0), (0.15, 0.29)
"""State of charge at take-off, by and large and where the trouble is that batteries are tired."""
SIZES = (4, 5, 6)
SHAPES = ("cross", "line", "wedge", "circle", "grid")
STYLES = ("town", "old_town", "suburb", "yard")
SAFETY = (
    "when battery < 0.3: representation <= detections",
    "when target_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)",
)
"""What gates of every policy are checked for in flight: low batteries send no maps, and whoever has the target in its
region tells a peer."""


def name_of(version: int) -> str:
    """A suite's name in the library."""
    return f"ranking_v{version}"


def suite_text(version: int) -> str:
    """A suite's file, drawn from its version's seed.

    Example:
        >>> suite_text(1).count("{name: ")
        30
    """
    head = _HEAD.format(version=version, seed=SEEDS[version], seconds=SECONDS, safety=r"\n".join(SAFETY))
    return "".join([head, *map(_line, draw_conditions(version))])


def further_text(version: int) -> str:
    """The file of a suite's further draws, each with the number of its draw behind its conditions' names."""
    head = _HEAD.format(version=version, seed=SEEDS[version], seconds=SECONDS, safety=r"\n".join(SAFETY))
    told = (
        f"# {FURTHER} further draws of the suite ranking_v{version}: the surrogate alone flies them, with `sortie rank --by-torch`.\n"
        f"# Drawn by research/ranking/suite.py from the seed {SEEDS[version]}; the number of the draw is behind each name.\n\n"
        f"description: Further draws of ranking_v{version}, of thirty conditions each.\n"
    )
    head = told + head[head.index("base: ") :]
    return "".join([head, *(_line(c, f"_{k}") for k in range(1, FURTHER + 1) for c in draw_conditions(version, k))])


def _line(condition: Condition, draw: str = "") -> str:
    told = ", ".join(f'"{one}"' if set(one) & set("[{") else one for one in condition.set)
    budget = f"{condition.budget:.3g}"
    return f"  - {{name: {condition.name}{draw}, budget: {budget}, metric: {condition.metric}, set: [{told}]}}\n"


def draw_conditions(version: int, draw: int = 0) -> list[Condition]:
    """Draw a suite's conditions.

    Args:
        version: of the suite.
        draw: 0 is the suite itself; another number draws others in the same way.
    """
    rng = stream(SEEDS[version], draw, (), "ranking.suite")
    kinds = [(mission, trouble) for mission in MISSIONS for trouble in TROUBLES]
    count = len(kinds)
    budgets = _spread(rng, count, *np.log(BUDGETS))
    charges, radii, spacings = (_spread(rng, count, *ends) for ends in (CHARGED, (20, 50), (15, 25)))
    sizes, shapes, styles = (_shared_out(rng, count, values) for values in (SIZES, SHAPES, STYLES))
    towns = rng.choice(10**6, count, replace=False) + 2 * 10**6  # beyond what `python -m research learn` draws
    found = []
    for k, (mission, trouble) in enumerate(kinds):
        changed = [
            f"seed={int(rng.integers(1, 10**6))}",
            f"fleet.drones={sizes[k]}",
            f"fleet.formation.shape={shapes[k]}",
            f"fleet.formation.spacing_m={spacings[k]:.0f}",
            f"perception.scene.style={styles[k]}",
            f"perception.scene.seed={towns[k]}",
            f"fleet.battery.initial_soc={rng.uniform(*TIRED) if trouble == 'tired' else charges[k]:.2f}",
            *_mission(mission, radii[k]),
            *_trouble(rng, trouble, int(sizes[k])),
        ]
        metric: Literal["full_scene", "mission"] = "full_scene" if mission == "search" else "mission"
        budget = float(f"{np.exp(budgets[k]):.3g}")
        found.append(Condition(name=f"{mission}_{trouble}", budget=budget, metric=metric, set=tuple(changed)))
    return found


_HEAD = """\
# The suite on which `sortie rank` ranks policies, version {version}. Drawn by sim/ranking/suite.py from the seed {seed}.
#
# Fixed: results are cited by this version and the digest of this file. A new suite gets a new version.

description: >-
  Thirty conditions: ten troubles (links, batteries, lies, faults) in each of three missions, with budgets from 0.005 to 0.5,
  fleets of four to six drones, and a town and a seed each.
base: track_target
set:
  - perception.detector=surrogate
  - perception.join=average
  - radio.preamble_detection_dbm=-95
  - duration_s={seconds}
  - fleet.route.waypoints_m=[[-60, 0], [60, 0]]
  - mission.target.waypoints_m=[[-60, -1.75], [200, -1.75]]
  - 'policy.invariants="{safety}"'
seeds: []
conditions:
"""


def _spread(rng: np.random.Generator, count: int, low: float, high: float) -> Any:
    """[count] one number from each of as many equal parts of a range, in random order."""
    return rng.permutation(low + (high - low) * (np.arange(count) + rng.random(count)) / count)


def _shared_out(rng: np.random.Generator, count: int, values: Sequence[Any]) -> Any:
    """[count] each value equally often, as far as that goes, in random order."""
    return rng.permutation(np.resize(np.array(values), count))


def _mission(mission: str, radius_m: float) -> list[str]:
    track = f"phase: track, region: {{radius_m: {radius_m:.0f}}}"
    phases = {
        "search": "{at_s: 0, phase: search}",
        "track": f"{{at_s: 0, {track}}}",
        "handover": f"{{at_s: 0, phase: search}}, {{at_s: {SECONDS // 3}, {track}}}",
    }
    return [f"mission.phases=[{phases[mission]}]"]


def _trouble(rng: np.random.Generator, trouble: str, drones: int) -> list[str]:
    drone, at_s = int(rng.integers(drones)), round(float(rng.uniform(2, 8)), 1)

    def event(kind: str, rest: str) -> list[str]:
        return [f"events=[{{kind: {kind}, at_s: {at_s}, {rest}}}]"]

    match trouble:
        case "clear" | "tired":
            return []
        case "weak":
            return [
                f"radio.tx_power_dbm={rng.uniform(1, 4):.1f}",
                f"radio.path_loss_exponent={rng.uniform(2.4, 2.6):.2f}",
            ]
        case "jammed":
            place = [int(rng.integers(-40, 40)), int(rng.choice([-1, 1]) * rng.integers(35, 60)), 60]
            return event("jam", f"position_m: {place}, power_dbm: {rng.uniform(0, 6):.1f}")
        case "cut_off":
            return event("link_drop", f"drone: {drone}, loss_db: {rng.uniform(30, 40):.0f}")
        case "battery_fault":
            return event("battery_fault", f"drone: {drone}, lost_fraction: {rng.uniform(0.4, 0.8):.2f}")
        case "lie":
            about, claim = rng.choice(["coverage", "goodput", "battery"]), rng.choice(["much", "little"])
            return event("lie", f"drone: {drone}, about: {about}, claim: {claim}")
        case "spoof":
            return event(
                "spoof", f"drone: {drone}, attack: {rng.choice(['forged', 'replayed', 'malformed', 'oversized'])}"
            )
        case "sensor_fault":
            return event(*_sensor_fault(rng, drone))
        case _:
            return event("drone_lost", f"drone: {drone}")


def _sensor_fault(rng: np.random.Generator, drone: int) -> tuple[str, str]:
    faults = {
        "position_fault": f"drone: {drone}, offset_m: [{rng.uniform(2, 8):.1f}, {rng.uniform(-8, -2):.1f}, 0]",
        "heading_fault": f"drone: {drone}, offset_deg: {rng.uniform(5, 20):.0f}",
        "camera_blocked": f"drone: {drone}",
        "slow_perception": f"drone: {drone}, extra_s: {rng.uniform(0.1, 0.4):.2f}",
        "clock_skew": f"drone: {drone}, skew_s: {rng.choice([-1, 1]) * rng.uniform(0.1, 0.4):.2f}",
    }
    kind = str(rng.choice(list(faults)))
    return kind, faults[kind]


if __name__ == "__main__":
    library = next(iter(condition_sets().values())).parent
    write_text(library / f"{name_of(NEWEST)}.yaml", suite_text(NEWEST))
    write_text(library / f"{name_of(NEWEST)}_further.yaml", further_text(NEWEST))
