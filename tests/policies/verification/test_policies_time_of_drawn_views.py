"""Drawn views end: a policy that takes long in every decision is tried on fewer of them, and the verdicts say on how many."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import pytest

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.verification import search
from sortie.policies.verification.conformance import TIMED, conform
from sortie.policies.verification.invariants import parse
from sortie.policies.verification.policy_rules import RULES
from sortie.policies.verification.proof import prove
from sortie.policies.verification.search import Budget
from sortie.policies.verification.views import draw_views

pytestmark = pytest.mark.slow

LINES = parse("rate_hz <= 10\nrate_hz <= fresh.rate_hz")
Decide = Callable[[FleetView], Sequence[Directive]]


class Clock:
    """A clock that only slow policies move on."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.decisions = 0

    def slow(self, each_s: float, rate_hz: float = 2.0) -> Decide:
        def decide(view: FleetView) -> list[Directive]:
            self.now_s += each_s
            self.decisions += 1
            return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=rate_hz, reason="r") for p in view.peers]

        return decide


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(search, "process_time", lambda: made.now_s)
    return made


def test_the_kit_ends_with_its_time_and_says_how_many_views_it_tried(clock: Clock) -> None:
    checks = {c.name: c for c in conform(clock.slow(0.3), budget_s=60.0)}
    assert clock.now_s < 100  # each rule may decide on the view at which its time ends
    assert all(c.holds for c in checks.values())
    assert checks["returns directives"].what == "12 of 300 views"
    assert " of 100 views in two orders" in checks["no memory"].what
    assert checks["time per decision"].what.endswith(f"of {2 * TIMED} decisions")
    assert all(" of 300 views" in checks[name].what for name in RULES)


def test_a_rule_may_use_the_time_that_those_before_it_left(clock: Clock) -> None:
    checks = {c.name: c for c in conform(clock.slow(0.01), count=30, budget_s=60.0)}
    assert checks["returns directives"].what == checks["age-monotone"].what == "30 views"


def test_each_rule_gets_two_views_however_slow_the_policy_is(clock: Clock) -> None:
    checks = conform(clock.slow(1000.0), draw_views(3, 20), budget_s=1.0)
    assert {c.what for c in checks if c.name in RULES} == {"2 of 20 views"}


def test_drawn_views_of_proofs_end_with_their_time(clock: Clock) -> None:
    verdicts = prove(clock.slow(0.3), LINES, max_drones=1, budget_s=0.0)
    assert clock.now_s < 30 + 1  # it ends within a view, between two of its ages
    assert [v.outcome for v in verdicts] == ["searched"] * 4
    assert verdicts[0].what.endswith("; 26 of 1204 drawn views keep it")
    assert all(" of 1204 drawn views keep it" in v.what for v in verdicts)


def test_a_counterexample_of_a_slow_policy_is_made_smaller_as_far_as_the_time_allows(clock: Clock) -> None:
    verdict = prove(clock.slow(50.0, 20.0), LINES[:1], max_drones=1, budget_s=0.0)[-1]
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert len(verdict.counterexample.peers) == 2
    bounds = conform(clock.slow(50.0, -1.0), budget_s=0.0)[1]
    assert not bounds.holds
    assert bounds.counterexample is not None
    assert len(bounds.counterexample.peers) == 2


def test_verdicts_on_a_fast_policy_are_as_ever(clock: Clock) -> None:
    fast = clock.slow(0.0)
    assert {c.what for c in conform(fast, count=20) if c.name in RULES} == {"20 views"}
    for verdict in prove(fast, LINES, max_drones=1, views=20):
        assert "20 drawn views of up to 20 drones" in verdict.what
        assert verdict.what.endswith(", 2 of 200 drones and 2 of 5,000 keep it")


def test_a_budget_ends_where_a_policy_s_file_stops_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "process_time", lambda: 0.0)
    budget = Budget(1e-6)
    assert any(budget.is_spent for _ in range(100_000))
