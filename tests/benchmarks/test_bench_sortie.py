"""How long a whole sortie takes: with the detector, without it, and what each part of that is.

`make bench-all` prints them; a 120 s, five-drone sortie should take less than 120 s with the detector at 2 Hz, and
less than 2 s without, on two cores.
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import nullcontext

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sortie.scenarios.reading.load import load
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, fly, run_sortie

pytestmark = pytest.mark.slow

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


ALL, SOME, WIDE = (f"{{shape: grid, spacing_m: {apart_m}, altitude_m: 60}}" for apart_m in (20, 60, 158))
SIZES = [5, 10, 25, 50, 100, 200]


@pytest.mark.benchmark(group="sortie of 2 s, no detector, at several sizes of the fleet")
@pytest.mark.parametrize(
    ("formation", "tx_dbm", "sizes"),
    [(ALL, 20, SIZES), (SOME, 5, SIZES), (WIDE, 20, [*SIZES, 1000])],
    ids=["all in earshot", "some in earshot", "1,000 drones over 5 by 5 km"],
)
def test_cost_over_the_number_of_drones(
    benchmark: BenchmarkFixture,
    formation: str,
    tx_dbm: float,
    sizes: list[int],
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """All sizes in one run, so that they can be compared; prints the processor time of a simulated second and its exponent."""
    is_on = request.config.getoption("--benchmark-enable")  # a benchmark that is off is a smoke test
    sizes, seconds = (sizes, 2.0) if is_on else ([2, 4], 0.3)
    each = {
        n: load(
            "track_target",
            ["perception.detector=none", "mission.phases=[{at_s: 0, phase: search}]", f"fleet.drones={n}",
             f"fleet.formation={formation}", f"radio.tx_power_dbm={tx_dbm}", f"duration_s={seconds}"],
        )
        for n in sizes
    }  # fmt: skip
    costs, known = dict.fromkeys(sizes, 0.0), dict.fromkeys(sizes, 0.0)

    def all_sizes() -> None:
        for n, scenario in each.items():
            parts = build(scenario, plan_for(scenario), 1)  # the town and the formation are no part of a tick
            begin_s = time.process_time()
            fly(parts)
            costs[n] = (time.process_time() - begin_s) / seconds
            known[n] = float(np.mean([len(agent.memory.ids) - 1 for agent in parts.agents]))

    benchmark.pedantic(all_sizes, rounds=1, warmup_rounds=1)
    exponent = np.polyfit(np.log(sizes), np.log([costs[n] for n in sizes]), 1)[0]
    lines = [f"{n} drones, {known[n]:.0f} peers known: {costs[n]:.3f} s for a simulated second" for n in sizes]
    with capsys.disabled() if is_on else nullcontext():
        sys.stdout.write("\n".join(["", *lines, f"cost grows with drones to the power of {exponent:.2f}", ""]))
    benchmark.extra_info |= {"exponent": round(float(exponent), 2), "peers_known": known, "cost_s": costs}
    assert all(known[n] < n for n in sizes)


@pytest.mark.benchmark(group="starting Python")
@pytest.mark.parametrize("what", ["numpy", "sortie.sim.engine.sortie"])
def test_importing(benchmark: BenchmarkFixture, what: str) -> None:
    done = benchmark.pedantic(subprocess.run, ([sys.executable, "-c", f"import {what}"],), rounds=5, warmup_rounds=1)
    assert done.returncode == 0


@pytest.mark.benchmark(group="sortie of 120 s, five drones, torch detector at 2 Hz")
@pytest.mark.parametrize("policy", ["worked", "silence"])
def test_with_the_detector(benchmark: BenchmarkFixture, policy: str, request: pytest.FixtureRequest) -> None:
    seconds = 120 if request.config.getoption("--benchmark-enable") else 5  # a benchmark that is off is a smoke test
    scenario = load("track_target", [f"duration_s={seconds}", "mission.phases=[{at_s: 0, phase: search}]"])
    record = benchmark.pedantic(run_sortie, (scenario, policy), rounds=1)
    assert record.tables["fusions"].num_rows == seconds * 2 * 5
