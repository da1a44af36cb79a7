"""How long a shield takes for one decision: ten lines, five fields, 20 drones.

`make bench-all` prints it. With `ten lines and a choice` two ways to keep a line change equally many fields.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.registry import POLICIES
from sortie.policies.staleness import CEILING, LinkHealth, cap_by_age
from sortie.policies.verification.enforced import put_right
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.conformance import full_view
from sortie.policies.verification.shield import enforce

pytestmark = pytest.mark.slow

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

CHOICE = (
    LINES["ten lines about peers"]
    .replace("when human: duty >= 0.8", "duty <= 1")
    .replace("(fusion_weight >= 0.2 or representation == none)", "(fusion_weight >= 0.8 or duty >= 0.9)")
)
"""The last line is kept by the smaller of two changes."""

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


def new_messes(view: FleetView) -> Iterator[Sequence[Directive]]:
    """The mess with slightly other numbers each time."""
    for k in itertools.count(1):
        more = 1e-7 * k
        yield [
            d._replace(
                rho=d.rho + more, rate_hz=d.rate_hz + more, deadline_s=d.deadline_s + more,
                fusion_weight=d.fusion_weight + more,
            )
            for d in a_mess(view)
        ]  # fmt: skip


@pytest.mark.parametrize("lines", [*LINES, "ten lines and a choice"])
def test_a_shielded_decision_that_is_another_one_each_time(benchmark: BenchmarkFixture, lines: str) -> None:
    benchmark.group = f"a shield with {lines} at 20 drones"
    view, rules = a_view(), parse(LINES.get(lines, CHOICE))
    messes = new_messes(view)
    directives = benchmark.pedantic(enforce, setup=lambda: ((rules, view, next(messes)), {}), rounds=500)
    assert all(d.reason.startswith("shield: ") for d in directives)


HEALTH = {peer: LinkHealth.FRESH if peer % 3 else LinkHealth.DEGRADED for peer in range(20)}
CEILINGS = {peer: CEILING[health] for peer, health in HEALTH.items()}


def capped(directives: Sequence[Directive]) -> Sequence[Directive]:
    return [cap_by_age(d, HEALTH[d.destination], 0.4) for d in directives]


@pytest.mark.parametrize("policy", ["keeps all lines", "a mess", "a new mess"])
@pytest.mark.parametrize("lines", LINES)
def test_a_decision_shielded_at_the_gate(benchmark: BenchmarkFixture, lines: str, policy: str) -> None:
    benchmark.group = f"a shield at the gate with {lines} at 20 drones"
    view, rules = a_view(), parse(LINES[lines])
    if policy == "a new mess":
        messes = new_messes(view)
        setup = lambda: ((rules, view, capped(next(messes)), (), CEILINGS), {})  # noqa: E731
        directives = benchmark.pedantic(put_right, setup=setup, rounds=500)
    else:
        damped = capped(decided_by(policy, lines, view))
        directives = benchmark(put_right, rules, view, damped, (), CEILINGS)
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
