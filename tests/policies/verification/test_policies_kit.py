"""The conformance kit: each rule finds the fault that it is for, with a small view that shows it, and nothing else."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from policies_examples import aged, fleet_of, without

from sortie.policies.contract import (
    Directive,
    FleetView,
    Reposition,
    Representation,
    boxes_across_networks,
    looks_from,
)
from sortie.policies.verification.kit import conformance
from sortie.policies.verification.kit.age_rule import older_views, raised_part, without_detached
from sortie.policies.verification.kit.conformance import RULES, Check, conform, failing
from sortie.policies.verification.kit.single_view import RepeatableView
from sortie.policies.verification.kit.views import from_json, to_json

NONE, DETECTIONS, FEATURES = Representation.NONE, Representation.DETECTIONS, Representation.FEATURES
Decide = Callable[..., Any]
calls = itertools.count()
FIVE = fleet_of(5)


@boxes_across_networks
def share(view: FleetView, **fields: Any) -> list[Directive]:
    return [Directive(view.ego, p, FEATURES, 0.5, None, 5.0, reason="shares")._replace(**fields) for p in view.peers]


def boxes(view: FleetView, **fields: Any) -> list[Directive]:
    return [Directive(view.ego, p, DETECTIONS, rate_hz=2.0, reason="r")._replace(**fields) for p in view.peers]


def mutates(view: FleetView) -> list[Directive]:
    decided = boxes(view)
    view.age_s.pop(view.ego, None)  # type: ignore[attr-defined]
    return decided


def reorders(view: FleetView) -> list[Directive]:
    first = next(iter(view.descriptors), None)
    if first is not None and isinstance(view.descriptors, dict):
        view.descriptors[first] = view.descriptors.pop(first)
    return boxes(view)


def prefers_the_last(view: FleetView) -> list[Directive]:
    last = list(view.descriptors)[-1:]
    return [d if d.destination in last else d._replace(rate_hz=1.0) for d in boxes(view)]


def rises_with_age(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=2.0 + (view.age_s[d.destination] > 0.5)) for d in boxes(view)]


def rises_for_another(view: FleetView) -> list[Directive]:
    """Gives the features to the peer heard last: who ages hands them to somebody else."""
    youngest = min(view.peers, key=lambda p: (view.age_s[p], p), default=None)
    return [d if d.destination == youngest else d._replace(representation=DETECTIONS, rho=0.0) for d in share(view)]


def overspends(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    return share(view, rho=min(1.0, 1.5 * rho))


def oversends(view: FleetView, *, sent_budget: float = 1.0) -> list[Directive]:
    return share(view, rho=min(1.0, 1.5 * sent_budget))


def all_to_the_first(view: FleetView, *, received_budget: float = 1.0) -> list[Directive]:
    """Keeps each sender's total, but one receiver gets it from all."""
    rho, first = min(1.0, received_budget * view.full_sharing_maps), min(view.descriptors, default=None)
    return [d._replace(rho=rho if d.destination == first else 0.0) for d in share(view)]


def needs_youth(view: FleetView) -> list[Directive]:
    if view.peers and min(view.age_s.values()) > 19 * view.period_s:
        raise RuntimeError("nobody there")
    return boxes(view)


@looks_from(lambda view: Reposition(*view.descriptors[view.ego].position_m[:2]))
def looks_where_nobody_is(view: FleetView) -> list[Directive]:
    return boxes(view)


@looks_from(lambda view: None if view.me is None else Reposition(1e4, 0.0))
def looks_too_far(view: FleetView) -> list[Directive]:
    return boxes(view)


PLANTED: list[tuple[Decide, str, str]] = [
    (mutates, "input unchanged", "the policy changed its input: age_s"),
    (reorders, "input unchanged", "the policy changed its input: the order of drones"),
    (prefers_the_last, "order of drones irrelevant", "get other directives"),
    (rises_with_age, "age-monotone", "rate_hz rises"),
    (rises_for_another, "age-monotone", "representation rises from 2 to 3"),
    (overspends, "budget kept", " carries 0.03 maps, at most 0.02 is allowed"),
    (oversends, "budget kept", "sent_budget=0.02: drone "),
    (all_to_the_first, "budget kept", "received_budget=0.02: drone "),
    (lambda v: boxes(v, rate_hz=float(next(calls) % 30)), "deterministic", "two calls with the same view differ"),
    (lambda v: boxes(v, rate_hz=random.uniform(0, 30)), "deterministic", "two calls with the same view differ"),
    (lambda v: boxes(v, rate_hz=31.0), "bounds kept", "rate_hz is 31.0, must be in [0, 30]"),
    (lambda v: share(v, rho=math.nan), "bounds kept", "rho is nan, must be in [0, 1]"),
    (lambda v: boxes(v)[:1], "one directive per link", "must be for each of"),
    (lambda v: boxes(v, reason=""), "gives reasons", "no reason given for"),
    (lambda v: boxes(v)[:1] + [d._replace(reason="") for d in boxes(v)[1:]], "gives reasons", "no reason given"),
    (lambda v: boxes(v) if max(v.peers) else [], "one drone and empty views", "raises ValueError"),
    (needs_youth, "stale views", "every descriptor 20 periods old: RuntimeError: nobody there"),
    (lambda v: (d for d in boxes(v)), "returns directives", "returns generator, must be a list or a tuple"),
    (lambda v: None, "returns directives", "returns NoneType, must be a list or a tuple"),
    (lambda v: "hello" if v.peers else [], "bounds kept", "a policy returns a list or a tuple of directives, got str"),
    (lambda v: boxes(v, rate_hz="10"), "bounds kept", "rate_hz is '10', must be in [0, 30], a number"),
    (lambda v: boxes(v, representation="features"), "bounds kept", "representation is 'features', must be a"),
    (lambda v: [d._replace(destination=[d.destination]) for d in boxes(v)], "bounds kept", "must be a drone's id"),
    (lambda v: boxes(v, representation=FEATURES), "maps within one network", "another network; put"),
    (lambda v: boxes(v, representation=Representation.CODES), "maps within one network", "another"),
    (looks_where_nobody_is, "viewpoint kept", "its viewpoint raises KeyError"),
    (looks_too_far, "viewpoint kept", "reposition of drone"),
]
"""A policy, the rule that it breaks, and words of the complaint."""
ALONE = ("input unchanged", "order of drones irrelevant", "gives reasons", "maps within one network", "viewpoint kept")
"""Rules that are broken without another one."""


def verdicts(policy: Decide) -> dict[str, Check]:
    return {c.name: c for c in conform(policy, count=25)}


def test_a_planted_fault_is_caught_and_its_view_shows_it() -> None:
    """The view is as small as the fault allows, also when it was read from JSON again."""
    wrong = {}
    for k, (policy, rule, complaint) in enumerate(PLANTED):
        checks = verdicts(policy)
        check = checks[rule]
        shown = from_json(to_json(check.counterexample)) if check.counterexample is not None else None
        small = shown is not None and len(shown.descriptors) <= 3 and RULES[rule].complaint(policy, shown) is not None
        others = [c.name for c in checks.values() if not c.holds and c.name != rule]
        if (
            check.holds
            or complaint not in check.what
            or not small
            or (rule in ALONE and policy is not mutates and others)
        ):
            wrong[k, rule] = (check.what, others)
    assert wrong == {}


def test_a_sound_policy_passes_with_every_rule_named_once() -> None:
    for policy in (share, boxes):
        checks = conform(policy, count=25)
        assert failing(checks) == []
        assert [c.name for c in checks] == [*RULES, "time per decision"]


@pytest.mark.parametrize(("least_ms", "verdict"), [(2, "holds"), (11, "unusual")])
def test_a_busy_machine_makes_no_policy_slow(least_ms: int, verdict: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other programs take the processor's caches, so that most decisions take ten times as long as the policy needs."""
    now_ns = itertools.accumulate(itertools.cycle([10, 10, 1]), lambda t, factor: t + factor * least_ms * 1_000_000)
    monkeypatch.setattr(conformance, "time", SimpleNamespace(thread_time_ns=now_ns.__next__))
    check = conformance._decides_in_time(share)
    assert (check.verdict, check.holds) == (verdict, True), "a warning: no verdict depends on the machine's speed"
    assert verdict == "holds" or "more than 10 ms" in check.what


def test_a_policy_that_reads_the_time_is_unusual_and_fails_no_rule() -> None:
    def reads_the_clock(view: FleetView) -> list[Directive]:
        return boxes(view, rate_hz=2.0 if view.me is not None and view.me.stamp_ns > 10**12 else 5.0)

    check = verdicts(reads_the_clock)["clock irrelevant"]
    assert (check.verdict, check.holds) == ("unusual", True)
    assert check.what == "decides otherwise when the sortie is 1000 s older and nothing else differs"
    assert check.counterexample is not None
    assert failing(conform(reads_the_clock, count=25)) == []


def test_a_rule_that_was_tried_on_fewer_views_than_promised_does_not_hold() -> None:
    def sometimes(view: FleetView) -> list[Directive]:
        if len(view.descriptors) > 12:
            raise KeyError("battery")
        return boxes(view)

    checks = verdicts(sometimes)
    assert checks["returns directives"].verdict == "fails"
    assert checks["gives reasons"].verdict == "not tried enough"
    assert " of 25 views could be checked" in checks["gives reasons"].what
    assert checks["gives reasons"] in failing(list(checks.values()))


def test_a_policy_that_always_raises_holds_no_rule() -> None:
    def broken(view: FleetView) -> list[Directive]:
        raise KeyError("battery")

    checks = conform(broken, count=5)
    assert [c.name for c in checks if c.holds] == ["input unchanged"]
    assert checks[0].what == "raises KeyError: 'battery'"
    assert checks[1].what == "0 of 5 views could be checked: see returns directives, bounds kept"


# --- what is older, and what counts as a rise -----------------------------------------------------

VIEW = fleet_of(3)._replace(period_s=0.2, age_s={0: 0.0, 1: 0.5, 2: 1.5})


def test_ages_are_raised_one_by_one_and_all_together_beyond_both_thresholds() -> None:
    found = [{i: age_s - VIEW.age_s[i] for i, age_s in v.age_s.items()} for v in older_views(VIEW)]
    assert found == [
        pytest.approx({i: add_s * (i in who) for i in range(3)})
        for add_s in (0.2, 0.7, 2.1, 200.0)
        for who in ((0,), (1,), (2,), (0, 1, 2))
    ]
    assert len(list(RepeatableView(VIEW).older())) == 16
    ages_s = [set(v.age_s.values()) for v in RepeatableView(fleet_of(30)).older()]
    assert [len(of_all) for of_all in ages_s] == [1] * 4
    assert [min(of_all) for of_all in ages_s] == pytest.approx([0.2, 0.45, 1.15, 100.1])
    raised = {0: 0.0, 1: 9.0, 2: 1.5}
    assert next(RepeatableView(VIEW, raised).older()).age_s == raised


def test_without_the_detached_all_else_is_as_it_was() -> None:
    assert without_detached(VIEW, aged(VIEW, {1: 5.0, 2: 1.9})) == without(VIEW, 1)
    assert without_detached(VIEW, VIEW) is VIEW


def link(peer: int, rung: Representation, rho: float = 0.0, rate_hz: float = 2.0) -> Directive:
    return Directive(0, peer, rung, rho, rate_hz=rate_hz)


RISES: list[tuple[Sequence[Sequence[Directive]], str | None]] = [
    (([link(1, DETECTIONS)], [link(1, DETECTIONS)]), None),
    (([link(1, DETECTIONS)], [link(1, FEATURES)]), "representation rises"),
    (([link(1, FEATURES, 0.5)], [link(1, FEATURES, 0.51)]), "rho rises from 0.5 to 0.51"),
    (([link(1, FEATURES, 0.5)], [link(1, DETECTIONS, 0.9)]), None),  # the share of another rung
    (([link(1, FEATURES)], [link(1, DETECTIONS, rate_hz=2.1)]), "rate_hz rises"),
    (([], [link(1, DETECTIONS)]), "none before"),
    (([], [link(1, NONE)]), None),
    # higher than with the peer that is gone: a rise only if it is higher than without that peer too
    (([link(1, NONE)], [link(1, DETECTIONS)], [link(1, DETECTIONS)]), None),
    (([link(1, NONE)], [link(1, FEATURES)], [link(1, DETECTIONS)]), "0→1"),
    (([link(1, NONE)], [link(1, DETECTIONS)], [link(2, DETECTIONS)]), "0→1"),
]


def test_what_counts_as_a_rise() -> None:
    found = [raised_part(*decided) for decided, _ in RISES]
    wrong = [
        (k, said)
        for k, said in enumerate(found)
        if (RISES[k][1] or "") not in (said or "") or bool(said) != bool(RISES[k][1])
    ]
    assert wrong == []
