"""Twelve flights that many tests read: each is flown once for all workers, and kept until the code changes.

`recorded("base")` gives the record of a flight. The first worker that asks flies it and saves the run's folder; all
others read that. A folder is named by the flight, the scenario's text and the code, so that no record of older code is read.
A test that patches the code, passes a policy as a function or needs other settings flies by itself, and says why.
"""

from __future__ import annotations

import functools
import hashlib
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock
from places import ROOT
from sim_examples import example

from sortie.scenarios.reading.load import dump, load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.identity import code_version
from sortie.sim.results import run_folder
from sortie.sim.results.record import SortieRecord

SURROGATE = "perception.detector=surrogate"
FLIGHTS: dict[str, Callable[[], Scenario]] = {
    # five drones for six seconds, with traffic alone: quarter maps to two peers each, a region from 3 s on
    "base": lambda: example(),
    # whole maps of everyone to everyone, which is more than the channel carries: queues, replaced and late payloads
    "whole_maps": lambda: example("policy={name: all-4}"),
    # small maps of everyone to everyone, and drone 2 is lost at 3 s
    "lost_drone": lambda: example(
        "policy={name: all-4, params: {received_budget: 0.02}}", "events=[{kind: drone_lost, drone: 2, at_s: 3.0}]"
    ),
    # the base flight with boxes
    "surrogate": lambda: example(SURROGATE),
    # eight seconds with boxes: drone 2 loses its links at 4 s, and drone 3 is lost at 6 s
    "broken_link": lambda: example(
        "duration_s=8",
        SURROGATE,
        "events=[{kind: link_drop, at_s: 4, drone: 2, loss_db: 60}, {kind: drone_lost, at_s: 6, drone: 3}]",
    ),
    # faults that end before the flight does, one after another, and a pack that is empty at once
    "faults": lambda: example(
        "duration_s=8",
        "events=["
        "{kind: spoof, drone: 0, at_s: 0.5, until_s: 1.5, attack: replayed, rate_hz: 20},"
        "{kind: link_drop, drone: 2, peer: 4, at_s: 1, until_s: 2, loss_db: 15},"
        "{kind: jam, at_s: 2.5, until_s: 3.5, position_m: [-60, 0, 60], power_dbm: 0},"
        "{kind: gnss_loss, drone: 1, at_s: 2, until_s: 4},"
        "{kind: camera_blocked, drone: 0, at_s: 4, until_s: 5},"
        "{kind: clock_skew, drone: 4, at_s: 5.5, skew_s: -0.5},"
        "{kind: battery_fault, drone: 1, at_s: 5, lost_fraction: 0.5},"
        "{kind: cell_failure, drone: 0, at_s: 6},"
        "{kind: battery_fault, drone: 3, at_s: 6, lost_fraction: 1}]",
    ),
    # drone 3 joins at 2 s, drone 2 goes home at 1 s, drone 1 is away from 1 s to 4 s; all that can be kept is
    "members": lambda: example(
        "context.roster=true",
        "fleet.formation.altitude_m=30",
        "mission.descent_mps=10",
        "record={views: true, beliefs: true, disagreement: true}",
        "events=["
        "{kind: drone_joins, at_s: 2, drone: 3}, {kind: drone_leaves, at_s: 1, drone: 2},"
        "{kind: drone_lost, at_s: 1, drone: 1}, {kind: drone_joins, at_s: 4, drone: 1}]",
    ),
    # the library's person_crossing: three drones with thermal cameras, a person in the region from about 6 s on
    "person": lambda: load("person_crossing", ["duration_s=12"]),
    # two groups with missions of their own: drones 3 and 4 search, and follow the second of two targets from 3 s on
    "mission_groups": lambda: example(
        SURROGATE,
        "mission.target={waypoints_m: [[-20, -1.75], [200, -1.75]], speed_mps: 4}",
        "mission.more_targets=[{waypoints_m: [[0, 30], [0, 200]], speed_mps: 3}]",
        "mission.phases=[{phase: track, region: {radius_m: 30}}]",
        "mission.groups=[{drones: [3, 4], phases: [{phase: search, region: {centre_m: [50, 60], radius_m: 20}},"
        "{at_s: 3, phase: track, target: 1, region: {radius_m: 25}}]}]",
    ),
    # the library's two_makes: drones 3 and 4 are of another make, with a network that the others cannot read
    "makes": lambda: load("two_makes", ["duration_s=6", "mission.phases=[{at_s: 0}]", "expect_decisions=[]"]),
    # the library's two_groups: two pairs that are far apart, and a ground station that relays between them
    "relay": lambda: load("two_groups", ["duration_s=8"]),
    # cars and trucks, and a fleet of which three drones at a time are scored
    "trucks": lambda: example(
        "duration_s=5",
        SURROGATE,
        "perception.egos=3",
        "perception.scene.trucks=0.4",
        "perception.scene.moving_cars_per_km=30",
    ),
}
KEPT_IN = ROOT / ".pytest_cache" / "recorded"
MOST_CODES = 4
"""Of so many versions of the code flights are kept."""


@functools.cache
def recorded(name: str) -> SortieRecord:
    """The record of one of `FLIGHTS`; read only."""
    return kept(name, FLIGHTS[name](), folder_of_code())


def kept(
    name: str, scenario: Scenario, folder: Path, fly: Callable[[Scenario], SortieRecord] = run_sortie
) -> SortieRecord:
    """The record of a flight from its run's folder, which is made by the first that asks."""
    run = folder / f"{name}-{hashlib.sha256(dump(scenario).encode()).hexdigest()[:16]}"
    with FileLock(f"{run}.lock"):
        if not run.exists():
            run_folder.save(fly(scenario), run)
    return run_folder.load(run)


@functools.cache
def folder_of_code(inside: Path = KEPT_IN, code: str | None = None) -> Path:
    """The folder of this code's flights, made if need be; those of the oldest codes are removed.

    Args:
        inside: the folder of all codes' flights.
        code: names the code; None takes the digest of everything in `sortie/`, of the libraries and of Python.
    """
    own = inside / hashlib.sha256(f"{code or code_version()} {sys.version}".encode()).hexdigest()[:16]
    own.mkdir(parents=True, exist_ok=True)
    with FileLock(inside / "folders.lock"):
        own.touch()
        others = [path for path in inside.iterdir() if path.is_dir() and path != own]
        for old in sorted(others, key=lambda path: path.stat().st_mtime_ns)[: 1 - MOST_CODES]:
            shutil.rmtree(old, ignore_errors=True)
    return own
