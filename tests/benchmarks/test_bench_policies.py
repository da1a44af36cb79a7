"""How long a decision takes: every registered policy at 5, 25 and 100 drones.

`make bench-all` prints them; the worked policy should decide in at most 0.010 ms at the median at five drones, and the
cost should grow no faster than the fleet. `python -m research overhead` measures the same on flown views, beside the bytes.
"""

from __future__ import annotations

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sortie.policies.registry import POLICIES
from sortie.policies.verification.kit.conformance import full_view

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("drones", [5, 25, 100])
@pytest.mark.parametrize("name", POLICIES)
def test_a_decision(benchmark: BenchmarkFixture, name: str, drones: int) -> None:
    benchmark.group = f"a decision at {drones} drones"
    directives = benchmark(POLICIES[name], full_view(drones))
    assert len(directives) == drones - 1
