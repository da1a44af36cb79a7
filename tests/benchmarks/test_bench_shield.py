"""How long a shield takes for one decision: ten lines, five fields, 20 drones.

`make bench-all` prints it. A decision takes at most 0.3 ms, with one exception: `a mess` with ten lines about peers takes
0.4 ms, and 0.5 ms at the gate. There every link has another directive that breaks several lines, so links can share
nothing, and for each link three boxes are tried. The same ten lines written out by hand as Python, without a language and
without a search, take 0.06 ms. At the gate a shield also asks how much the age of each peer's descriptor allows. Lines about
several links that exclude each other on one link may take a few milliseconds: the links that keep them are searched.
"""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sortie.fleet.staleness import LinkHealth, cap_by_age
from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.registry import POLICIES
from sortie.policies.verification.conformance import full_view
from sortie.policies.verification.enforced import put_right
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
    "ten lines about peers": """
        when battery < 0.9: rate_hz <= 5 and rho <= 0.3 and representation <= features
        when goodput_mbps < 500: rate_hz <= 2.5 and deadline_s <= 0.4
        when age_periods > 0.5: rho <= 0.2 and fusion_weight <= 0.9
        when peer_battery < 0.95: representation <= detections
        when phase == track and region and representation > none: roi
        when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)
        when human: duty >= 0.8
        when peer_human and peers >= 4: rate_hz >= 1 and representation >= detections
        when not same_network: representation != features
        rate_hz * deadline_s <= 2 and (fusion_weight >= 0.2 or representation == none)
    """,
    "five fields": """
        rate_hz <= 2
        rho <= 0.1
        representation <= detections
        fusion_weight <= 0.5
        deadline_s <= 0.05
    """,
}

EXCLUSIVE = {
    "six exclusive lines": "\n".join(f"any_link(rate_hz == {hz})" for hz in range(1, 7)),
    "six lines, four of which contradict another one": "\n".join(
        ["rate_hz >= 5", *[f"any_link(rate_hz == {hz})" for hz in range(1, 7)]]
    ),
}


def a_view() -> FleetView:
    view = full_view(20)
    heard = {i: d._replace(battery_soc=0.3 + 0.03 * i, novelty_flags=4 * (i % 2)) for i, d in view.descriptors.items()}
    heard[view.ego] = view.descriptors[view.ego]._replace(battery_soc=0.5, novelty_flags=4)
    return view._replace(descriptors=heard, age_s={i: 0.01 * i for i in heard})


def a_mess(view: FleetView) -> Sequence[Directive]:
    return [
        Directive(
            view.ego, peer, Representation.RAW if peer % 2 else Representation.FEATURES, rho=0.5 + 0.02 * peer,
            rate_hz=10 + 0.5 * peer, deadline_s=0.5 + 0.01 * peer, fusion_weight=0.01 * peer, duty_percent=30 + peer,
        )
        for peer in view.peers
    ]  # fmt: skip


def kept(lines: str, view: FleetView) -> Sequence[Directive]:
    """What a shield makes of the mess: it keeps all lines."""
    return [d._replace(reason="") for d in enforce(parse(LINES[lines]), view, a_mess(view))]


def decided_by(policy: str, lines: str, view: FleetView) -> Sequence[Directive]:
    if policy == "keeps all lines":
        return kept(lines, view)
    return a_mess(view) if policy == "a mess" else tuple(POLICIES[policy](view))


@pytest.mark.parametrize("policy", ["keeps all lines", "all-4", "silence", "worked", "a mess"])
@pytest.mark.parametrize("lines", LINES)
def test_a_shielded_decision(benchmark: BenchmarkFixture, lines: str, policy: str) -> None:
    benchmark.group = f"a shield with {lines} at 20 drones"
    view = a_view()
    decided = decided_by(policy, lines, view)
    directives = benchmark(enforce, parse(LINES[lines]), view, decided)
    assert [d.reason for d in directives] == [""] * 19 or policy != "keeps all lines"
    assert all(d.reason.startswith("shield: ") for d in directives) or policy != "a mess"


@pytest.mark.parametrize("policy", ["keeps all lines", "a mess"])
@pytest.mark.parametrize("lines", LINES)
def test_a_decision_shielded_at_the_gate(benchmark: BenchmarkFixture, lines: str, policy: str) -> None:
    benchmark.group = f"a shield at the gate with {lines} at 20 drones"
    view = a_view()

    def cap(d: Directive) -> Directive:
        return cap_by_age(d, LinkHealth.FRESH if d.destination % 3 else LinkHealth.DEGRADED, 0.4)

    damped = [cap(d) for d in decided_by(policy, lines, view)]
    directives = benchmark(put_right, parse(LINES[lines]), view, damped, (), cap)
    assert len(directives) == 19


@pytest.mark.parametrize("policy", ["all-4", "a mess"])
@pytest.mark.parametrize("lines", EXCLUSIVE)
def test_a_decision_shielded_by_lines_of_which_one_link_keeps_one(
    benchmark: BenchmarkFixture, lines: str, policy: str
) -> None:
    benchmark.group = f"a shield with {lines} at 20 drones"
    view, rules = a_view(), parse(EXCLUSIVE[lines])
    directives = benchmark(enforce, rules, view, decided_by(policy, lines, view))
    kept = {hz for hz in range(1, 7) if any(d.rate_hz == hz for d in directives)}
    assert kept == ({5, 6} if "contradict" in lines else {1, 2, 3, 4, 5, 6})
