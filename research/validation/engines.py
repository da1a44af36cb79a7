"""Does another engine fly as this one did? Drawn scenarios must give equal records, the library equal statistics.

    python -m research.validation.engines keep FOLDER       fly all with the engine that is here, and keep what came of it
    python -m research.validation.engines compare FOLDER    fly all again, and say what differs from what was kept

`engines.json` beside this file was kept by the engine with an object for each drone, link and packet, before it became
arrays. Written down before anything was measured:

* **Records.** `DRAWN` scenarios, `track_target` with fields drawn from `FIELDS` and events from `EVENTS` by `SEED`. The first
  `SHARING` of them have a policy that sends payloads. Their fingerprints must be equal.
* **Statistics**, for an engine whose records cannot be equal, because its radio draws in another order: each library scenario
  with the surrogate, flown with each of `SEEDS`. The unit is a flight. A figure of `FIGURES` has moved if Welch's t-test
  between the two engines has p < `ALPHA` divided by the number of comparisons, and its mean by more than `LEAST` of itself.
"""

from __future__ import annotations

import argparse
import json
import os
import random
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import load
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, run_sortie
from sortie.sim.results.outcome import outcome

DRAWN, SHARING, SEED = 40, 30, 61_000
SEEDS = tuple(range(1, 9))
ALPHA, LEAST = 0.05, 0.005
LIBRARY = ("track_target", "search_grid", "two_groups", "two_makes", "person_crossing", "paper_context", "paper_replay")
FIGURES = (
    "bytes.context_sent",
    "bytes.data_sent",
    "bytes.data_delivered",
    "context.lost",
    "deadline_miss_rate",
    "medium_busy_fraction",
    "age_s.p50",
    "age_s.p99",
    "data_age_mean_s",
    "switches",
    "energy_j.total",
    "ap50.full_scene",
    "ap50.mission",
)
SHARES = (
    "worked",
    "all-4",
    "best-2",
    "deputies",
    "adaptive",
    "learned",
    "vantage",
    "boxes",
    "uncertain-boxes",
    "where2comm-style",
    "hydracollab-style",
)
SILENT = ("silence",)
FIELDS: dict[str, tuple[str, ...]] = {
    "fleet.drones": ("3", "5", "8", "16"),
    "fleet.formation": (
        "{shape: line, spacing_m: 15}",
        "{shape: circle, altitude_m: 40}",
        "{shape: grid, spacing_m: 40}",
    ),
    "fleet.battery.initial_soc": ("0.3", "0.13"),
    "fleet.clock": ("{gnss: false, offset_s: 0.05, drift_ppm: 500}", "{offset_s: 0.3}"),
    "fleet.mobility": ("random_waypoint", "gauss_markov"),
    "fleet.ground": ("[{drone: 2, position_m: [0, -30, 4]}]", "[{drone: 1, mains: false, camera: true}]"),
    "fleet.makes": ("[{name: weak, drones: [1], tx_power_dbm: 12}]", "[{name: blind, drones: [0], detector: none}]"),
    "context.rate_hz": ("7.5", "5", "3"),
    "context.form": ("small", "no_grid", "numbers_12_bit"),
    "context.publish_every": ("2", "3"),
    "context.authentication": ("false",),
    "context.roster": ("true",),
    "policy.dwell_s": ("0", "2.5"),
    "policy.hysteresis": ("0", "0.3"),
    "radio.standard": ("ac", "ax"),
    "radio.tx_power_dbm": ("5", "12"),
    "radio.path_loss": ("two_ray", "free_space"),
    "radio.antenna": ("dipole",),
    "radio.fading": ("frame",),
    "radio.rate_control": ("minstrel",),
    "radio.rts": ("true",),
    "radio.framing": ("tiles",),
    "radio.relay_max_hops": ("3",),
    "radio.bursts": ("{}",),
    "radio.payload_class": ("video", "background"),
    "perception.compute_delay_s": ("0", "0.2"),
    "perception.egos": ("2",),
    "perception.thermal": ("{}",),
    "record": ("{views: true, beliefs: true}",),
}
WAYS = (
    "fleet.route={waypoints_m: [[-60, 0], [80, 0]]}",
    "mission.target={waypoints_m: [[-60, -1.75], [200, -1.75]], speed_mps: 5}",
)
PHASES = "mission.phases=[{at_s: 0, phase: search}, {at_s: 2, phase: track, region: {radius_m: 40}}]"
EVENTS = (
    "{kind: link_drop, at_s: 1.5, until_s: 4, drone: 1, loss_db: 20}",
    "{kind: jam, at_s: 2, until_s: 5, position_m: [10, 5, 2], power_dbm: 15}",
    "{kind: drone_lost, at_s: 3.3, drone: 2}",
    "{kind: drone_joins, at_s: 2.7, drone: 0}",
    "{kind: drone_leaves, at_s: 2, drone: 1}",
    "{kind: battery_fault, at_s: 2.5, drone: 0, lost_fraction: 0.6}",
    "{kind: clock_skew, at_s: 1, drone: 1, skew_s: 0.4}",
    "{kind: clock_drift, at_s: 1, drone: 0, drift_ppm: -20000}",
    "{kind: gnss_loss, at_s: 1, until_s: 4, position_walk_m: 1}",
    "{kind: position_fault, at_s: 1, drone: 2, offset_m: [6, 0, 0]}",
    "{kind: camera_blocked, at_s: 2, until_s: 4, drone: 1}",
    "{kind: slow_perception, at_s: 1, drone: 0, extra_s: 0.3}",
    "{kind: spoof, at_s: 1, drone: 0, attack: forged}",
    "{kind: lie, at_s: 1, drone: 2, about: goodput, claim: much}",
)


def drawn() -> Iterator[tuple[str, tuple[str, ...]]]:
    """The drawn scenarios: a name, and what each sets of `track_target`. What is refused before it flies is drawn again."""
    for k in range(DRAWN):
        draw = random.Random(SEED + k)
        while True:
            policy = draw.choice(SHARES if k < SHARING else SILENT)
            detector = draw.choice(("surrogate", "none"))
            sets = [
                *WAYS,
                PHASES,
                f"seed={SEED + k}",
                f"duration_s={draw.choice((6, 8))}",
                f"policy={{name: {policy}}}",
            ]
            sets.append(f"perception.detector={detector}")
            sets += [
                f"{field}={draw.choice(FIELDS[field])}" for field in draw.sample(sorted(FIELDS), draw.randint(3, 9))
            ]
            sets.append(f"events=[{', '.join(draw.sample(EVENTS, draw.randint(0, 4)))}]")
            try:
                scenario = load("track_target", sets)
                build(scenario, plan_for(scenario), scenario.seed)
            except SortieError:
                continue
            yield f"drawn_{k}", tuple(sets)
            break


def flown(what: tuple[str, str, tuple[str, ...], int | None]) -> dict[str, Any]:
    """What came of a flight: its fingerprint and its figures."""
    name, scenario, sets, seed = what
    os.environ["OMP_NUM_THREADS"] = "1"
    record = run_sortie(load(scenario, list(sets)), seed=seed)
    result = outcome(record)
    return {"name": name, "fingerprint": record.fingerprint} | {figure: result.number(figure) for figure in FIGURES}


def all_flown() -> list[dict[str, Any]]:
    """Every flight, on two cores; a line tells of each."""
    flights: list[tuple[str, str, tuple[str, ...], int | None]] = [(n, "track_target", s, None) for n, s in drawn()]
    flights += [
        (f"{name} {seed}", name, ("perception.detector=surrogate",), seed) for name in LIBRARY for seed in SEEDS
    ]
    rows = []
    with ProcessPoolExecutor(2) as pool:
        for k, row in enumerate(pool.map(flown, flights), start=1):
            rows.append(row)
            print(f"{k} of {len(flights)}: {row['name']}", flush=True)  # noqa: T201
    return rows


def moved(before: list[float | None], after: list[float | None], comparisons: int) -> str:
    """How a figure moved between two engines, in words; empty where it did not.

    Example:
        >>> moved([1.0, 1.1, 0.9, 1.0], [1.0, 1.1, 0.9, 1.0], 91)
        ''
        >>> moved([1.0, 1.01, 0.99, 1.0], [2.0, 2.01, 1.99, 2.0], 91)
        '1 → 2, p = 2e-12'
    """
    a, b = (np.array([v for v in values if v is not None]) for values in (before, after))
    if len(a) != len(b):
        return f"{len(a)} values → {len(b)}"
    if not len(a) or np.array_equal(a, b):
        return ""
    p = float(stats.ttest_ind(a, b, equal_var=False).pvalue) if np.ptp(a) or np.ptp(b) else 0.0
    if p >= ALPHA / comparisons or abs(b.mean() - a.mean()) <= LEAST * abs(a.mean()):
        return ""
    return f"{a.mean():.4g} → {b.mean():.4g}, p = {p:.0e}"


def differences(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> list[str]:
    """A line for each drawn scenario whose record differs, and for each figure of the library that moved."""
    then, now = ({row["name"]: row for row in rows} for rows in (before, after))
    lines = [
        f"{name}: another record"
        for name in then
        if name.startswith("drawn_") and then[name]["fingerprint"] != now[name]["fingerprint"]
    ]
    for name in LIBRARY:
        for figure in FIGURES:
            values = ([rows[f"{name} {seed}"][figure] for seed in SEEDS] for rows in (then, now))
            if how := moved(*values, comparisons=len(LIBRARY) * len(FIGURES)):
                lines.append(f"{name}: {figure} {how}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("keep", "compare"))
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    kept, rows = given.folder / "engines.json", all_flown()
    if given.what == "keep":
        given.folder.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
        return
    lines = differences(json.loads(kept.read_text("utf-8")), rows)
    print("\n".join(lines) or "nothing differs")  # noqa: T201


if __name__ == "__main__":
    main()
