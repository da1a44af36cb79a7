"""How long a whole sortie takes: with the detector, without it, and what each part of that is.

`make bench` prints them; a 120 s, five-drone sortie should take less than 120 s with the detector at 2 Hz, and
less than 2 s without, on two cores.
"""

from __future__ import annotations

import subprocess
import sys

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie

JAMMED = "events=[{kind: jam, at_s: 0, position_m: [0, 0, 2000], power_dbm: 0}]"


@pytest.mark.benchmark(group="sortie of 120 s, five drones, no detector")
@pytest.mark.parametrize("policy", ["worked", "all-4", "silence"])
def test_traffic_alone(benchmark: BenchmarkFixture, policy: str) -> None:
    scenario = load("track_target", ["perception.detector=none"])
    record = benchmark.pedantic(run_sortie, (scenario, policy), rounds=3, warmup_rounds=1)
    assert record.tables["descriptors"].num_rows == 6000


@pytest.mark.benchmark(group="sortie of 12 s, no detector, by the fleet and by what disturbs it")
@pytest.mark.parametrize(
    ("drones", "extra"),
    [(5, ()), (25, ()), (5, ("context.authentication=false",)), (5, (JAMMED,))],
    ids=["5 drones", "25 drones", "without authentication", "with links new in every frame"],
)
def test_what_a_fleet_costs(benchmark: BenchmarkFixture, drones: int, extra: tuple[str, ...]) -> None:
    search = "mission.phases=[{at_s: 0, phase: search}]"
    sets = ["perception.detector=none", f"fleet.drones={drones}", "duration_s=12", search, *extra]
    record = benchmark.pedantic(run_sortie, (load("track_target", sets),), rounds=3, warmup_rounds=1)
    assert record.tables["descriptors"].num_rows == 120 * drones


@pytest.mark.benchmark(group="starting Python")
@pytest.mark.parametrize("what", ["numpy", "sortie.sim.engine.sortie"])
def test_importing(benchmark: BenchmarkFixture, what: str) -> None:
    done = benchmark.pedantic(subprocess.run, ([sys.executable, "-c", f"import {what}"],), rounds=5, warmup_rounds=1)
    assert done.returncode == 0


@pytest.mark.slow
@pytest.mark.benchmark(group="sortie of 120 s, five drones, torch detector at 2 Hz")
@pytest.mark.parametrize("policy", ["worked", "silence"])
def test_with_the_detector(benchmark: BenchmarkFixture, policy: str, request: pytest.FixtureRequest) -> None:
    seconds = 120 if request.config.getoption("--benchmark-enable") else 5  # a benchmark that is off is a smoke test
    scenario = load("track_target", [f"duration_s={seconds}", "mission.phases=[{at_s: 0, phase: search}]"])
    record = benchmark.pedantic(run_sortie, (scenario, policy), rounds=1)
    assert record.tables["fusions"].num_rows == seconds * 2 * 5
