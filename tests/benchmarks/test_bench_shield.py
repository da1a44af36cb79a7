"""How long a shield takes for one decision: ten lines, five fields, 20 drones.

`make bench` prints it; a decision should take less than 0.3 ms, whatever the policy decides.
"""

from __future__ import annotations

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sortie.policies.registry import POLICIES
from sortie.policies.verification.conformance import full_view
from sortie.policies.verification.invariants import parse
from sortie.policies.verification.shield import enforce

LINES = {
    "ten lines": """
        when battery < 0.9: rate_hz <= 5
        when battery < 0.95: representation <= detections
        when goodput_mbps < 500: rate_hz <= 2
        when phase == track and region and representation > none: roi
        when target_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)
        when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)
        rho <= 0.5
        duty >= 0.5
        fusion_weight >= 0.2
        deadline_s <= 0.5 and representation <= features
    """,
    "five fields": """
        rate_hz <= 2
        rho <= 0.1
        representation <= detections
        fusion_weight <= 0.5
        deadline_s <= 0.05
    """,
}


@pytest.mark.parametrize("policy", ["all-4", "silence", "worked"])
@pytest.mark.parametrize("lines", LINES)
def test_a_shielded_decision(benchmark: BenchmarkFixture, lines: str, policy: str) -> None:
    benchmark.group = f"a shield with {lines} at 20 drones"
    view = full_view(20)
    me = view.descriptors[view.ego]._replace(battery_soc=0.5, novelty_flags=4)
    view = view._replace(descriptors={**view.descriptors, view.ego: me})
    decided = tuple(POLICIES[policy](view))
    directives = benchmark(enforce, parse(LINES[lines]), view, decided)
    assert len(directives) == 19
