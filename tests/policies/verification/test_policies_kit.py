"""The conformance kit catches what it is for: one planted fault a rule, each with a view that shows it."""

from __future__ import annotations

import itertools
import json
import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Descriptor, Directive, FleetView, Representation, TaskPhase, boxes_across_networks
from sortie.policies.verification.kit import conformance
from sortie.policies.verification.kit.conformance import RULES, Check, conform, failing
from sortie.policies.verification.kit.tried import shrink
from sortie.policies.verification.kit.views import ViewError, draw_view, draw_views, from_json, to_json

FEATURES, DETECTIONS = Representation.FEATURES, Representation.DETECTIONS
calls = itertools.count()


@boxes_across_networks
def share(view: FleetView, **fields: object) -> list[Directive]:
    return [Directive(view.ego, p, FEATURES, 0.5, None, 5.0, reason="shares")._replace(**fields) for p in view.peers]


def forgets_networks(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, p, FEATURES, 0.5, None, 5.0, reason="shares") for p in view.peers]


def mutates(view: FleetView) -> list[Directive]:
    directives = share(view)
    view.age_s.pop(view.ego, None)  # type: ignore[attr-defined]
    return directives


def depends_on_order(view: FleetView) -> list[Directive]:
    last = list(view.descriptors)[-1:]
    return [d if d.destination in last else d._replace(rate_hz=1.0) for d in share(view)]


def rises_with_age(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=min(30.0, 1.0 + view.age_s[d.destination])) for d in share(view)]


def rises_for_another(view: FleetView) -> list[Directive]:
    """Gives the features to the peer heard last: who ages hands them to somebody else."""
    youngest = min(view.peers, key=lambda p: (view.age_s[p], p), default=None)
    return [d if d.destination == youngest else d._replace(representation=DETECTIONS, rho=0.0) for d in share(view)]


def overspends(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    return share(view, rho=min(1.0, 1.5 * rho))


def oversends(view: FleetView, *, sent_budget: float = 1.0) -> list[Directive]:
    return share(view, rho=min(1.0, 1.5 * sent_budget))


def all_to_the_first(view: FleetView, *, received_budget: float = 1.0) -> list[Directive]:
    """Keeps each sender's total, but one receiver gets it all."""
    first = min(view.peers, default=None)
    total = received_budget * view.full_sharing_maps
    return [d._replace(rho=min(1.0, total) if d.destination == first else 0.0) for d in share(view)]


def remembers(view: FleetView) -> list[Directive]:
    return share(view, rate_hz=float(next(calls) % 30))


def reads_the_clock(view: FleetView) -> list[Directive]:
    late = view.me is not None and view.me.stamp_ns > 10**12
    return share(view, rate_hz=2.0 if late else 5.0)


def lottery(view: FleetView) -> list[Directive]:
    return share(view, rate_hz=random.uniform(0, 30))


def too_fast(view: FleetView) -> list[Directive]:
    return share(view, rate_hz=31.0)


def not_a_number(view: FleetView) -> list[Directive]:
    return share(view, rho=math.nan)


def forgets_a_link(view: FleetView) -> list[Directive]:
    return share(view)[:1]


def silent(view: FleetView) -> list[Directive]:
    return share(view, reason="")


def needs_a_peer(view: FleetView) -> list[Directive]:
    max(view.peers)
    return share(view)


def needs_youth(view: FleetView) -> list[Directive]:
    if view.peers and min(view.age_s.values()) > 19 * view.period_s:
        raise RuntimeError("nobody there")
    return share(view)


def gives_a_generator(view: FleetView) -> Sequence[Directive]:
    return (d for d in share(view))  # type: ignore[return-value]


def gives_nothing(view: FleetView) -> Sequence[Directive]:
    return None  # type: ignore[return-value]


def gives_text(view: FleetView) -> Sequence[Directive]:
    return "hello" if view.peers else []  # type: ignore[return-value]


def rate_as_text(view: FleetView) -> list[Directive]:
    return share(view, rate_hz="10")


def rung_as_text(view: FleetView) -> list[Directive]:
    return share(view, representation="features")


def weighs_by_none(view: FleetView) -> list[Directive]:
    return share(view, fusion_weight=None)


def links_in_lists(view: FleetView) -> list[Directive]:
    return [d._replace(destination=[d.destination]) for d in share(view)]


def gives_reasons_as_numbers(view: FleetView) -> list[Directive]:
    return share(view, reason=5)


def dawdles(view: FleetView) -> list[Directive]:
    end_ns = time.thread_time_ns() + 300_000
    while len(view.descriptors) == 20 and time.thread_time_ns() < end_ns:
        pass
    return share(view)


PLANTED: list[tuple[Callable[[FleetView], Sequence[Directive]], str, str]] = [
    (mutates, "input unchanged", "the policy changed its input: age_s"),
    (depends_on_order, "order of drones irrelevant", "get other directives"),
    (rises_with_age, "age-monotone", "rate_hz rises"),
    (rises_for_another, "age-monotone", "representation rises from 2 to 3"),
    (overspends, "budget kept", " carries 0.03 maps, at most 0.02 is allowed"),
    (oversends, "budget kept", "sent_budget=0.02: drone "),
    (all_to_the_first, "budget kept", "received_budget=0.02: drone "),
    (remembers, "deterministic", "two calls with the same view differ"),
    (lottery, "deterministic", "two calls with the same view differ"),
    (too_fast, "bounds kept", "rate_hz is 31.0, must be in [0, 30]"),
    (not_a_number, "bounds kept", "rho is nan, must be in [0, 1]"),
    (forgets_a_link, "one directive per link", "must be for each of"),
    (silent, "gives reasons", "no reason given for"),
    (needs_a_peer, "one drone and empty views", "raises ValueError"),
    (needs_youth, "stale views", "every descriptor 20 periods old: RuntimeError: nobody there"),
    (gives_a_generator, "returns directives", "returns generator, must be a list or a tuple of directives"),
    (gives_nothing, "returns directives", "returns NoneType, must be a list or a tuple of directives"),
    (gives_text, "bounds kept", "a policy returns a list or a tuple of directives, got str"),
    (rate_as_text, "bounds kept", "rate_hz is '10', must be in [0, 30], a number"),
    (
        rung_as_text,
        "bounds kept",
        "representation is 'features', must be a Representation, such as sortie.Representation.DETECTIONS",
    ),
    (weighs_by_none, "bounds kept", "fusion_weight is None, must be in [0, 1], a number"),
    (links_in_lists, "bounds kept", "must be a drone's id, a whole number"),
    (
        forgets_networks,
        "maps within one network",
        "another network; put @sortie.boxes_across_networks above the policy",
    ),
    (gives_reasons_as_numbers, "bounds kept", "reason is 5, must be text"),
]


def verdicts(policy: Callable[..., Sequence[Directive]]) -> dict[str, Check]:
    return {c.name: c for c in conform(policy, count=25)}


@pytest.mark.parametrize(("policy", "rule", "complaint"), PLANTED, ids=lambda x: getattr(x, "__name__", ""))
def test_a_planted_fault_is_caught_and_its_view_shows_it(
    policy: Callable[[FleetView], Sequence[Directive]], rule: str, complaint: str
) -> None:
    check = verdicts(policy)[rule]
    assert not check.holds
    assert complaint in check.what
    assert check.counterexample is not None
    again = from_json(to_json(check.counterexample))
    assert RULES[rule].complaint(policy, again) is not None
    assert len(again.descriptors) <= 3  # as small as its fault allows


def test_a_slow_policy_is_unusual(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is told as a warning: no verdict depends on the machine's speed."""
    monkeypatch.setattr(conformance, "DECISION_LIMIT_S", 0.0002)
    check = verdicts(dawdles)["time per decision"]
    assert (check.verdict, check.holds) == ("unusual", True)
    assert "at 20 drones, more than 0.2 ms" in check.what


@pytest.mark.parametrize(("least_ms", "verdict"), [(2, "holds"), (11, "unusual")])
def test_a_busy_machine_makes_no_policy_slow(least_ms: int, verdict: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other programs take the processor's caches, so that most decisions take ten times as long as the policy needs."""
    now_ns = itertools.accumulate(itertools.cycle([10, 10, 1]), lambda t, factor: t + factor * least_ms * 1_000_000)
    monkeypatch.setattr(conformance, "time", SimpleNamespace(thread_time_ns=now_ns.__next__))
    assert conformance._decides_in_time(share).verdict == verdict


def test_a_policy_that_reads_the_time_is_unusual_and_fails_no_rule() -> None:
    check = verdicts(reads_the_clock)["clock irrelevant"]
    assert (check.verdict, check.holds) == ("unusual", True)
    assert check.what == "decides otherwise when the sortie is 1000 s older and nothing else differs"
    assert check.counterexample is not None
    assert failing(conform(reads_the_clock, count=25)) == []


def test_a_rule_that_was_tried_on_fewer_views_than_promised_does_not_hold() -> None:
    def sometimes(view: FleetView) -> list[Directive]:
        if len(view.descriptors) > 12:
            raise KeyError("battery")
        return share(view)

    checks = {c.name: c for c in conform(sometimes, count=25)}
    assert checks["returns directives"].verdict == "fails"
    assert checks["gives reasons"].verdict == "not tried enough"
    assert " of 25 views could be checked" in checks["gives reasons"].what
    assert checks["gives reasons"] in failing(list(checks.values()))


def test_a_sound_policy_passes_with_every_rule_named_once() -> None:
    checks = conform(share, count=25)
    assert failing(checks) == []
    assert [c.name for c in checks] == [*RULES, "time per decision"]


def test_a_policy_that_always_raises_holds_no_rule() -> None:
    def broken(view: FleetView) -> list[Directive]:
        raise KeyError("battery")

    checks = conform(broken, count=5)
    assert [c.name for c in checks if c.holds] == ["input unchanged"]
    assert checks[0].what == "raises KeyError: 'battery'"
    assert checks[1].what == "0 of 5 views could be checked: see returns directives, bounds kept"


def test_views_of_the_users_choice() -> None:
    only = fleet_of(5)._replace(ego=4)
    checks = {c.name: c for c in conform(too_fast, [only])}
    assert checks["bounds kept"].counterexample is not None
    assert len(checks["bounds kept"].counterexample.descriptors) == 2
    assert checks["gives reasons"].what == "1 views: each directive has a reason"


def test_drawn_views_repeat_and_cover_what_a_plane_may_hand_over() -> None:
    views = list(draw_views(0, 600))
    assert views == list(draw_views(0, 600))
    assert views[7] == draw_view(0, 7) != draw_view(1, 7)
    drones: list[tuple[FleetView, Descriptor]] = [(v, d) for v in views for d in v.descriptors.values()]
    assert {len(v.descriptors) for v in views} == set(range(1, 21))
    assert {d.task_phase for _, d in drones} == set(TaskPhase)
    assert any(len(d.peer_goodput_mbps) + 1 > len(v.descriptors) for v, d in drones), "peers never heard"
    assert any(v.age_s[d.agent_id] > 100 * v.period_s for v, d in drones), "stale"
    assert any(v.age_s[d.agent_id] == 0 for v, d in drones), "fresh"
    assert {0.0, 0.3, 0.6, 1.0} <= {d.battery_soc for _, d in drones}
    assert {0.0, 5.0, 1e5} <= {g for _, d in drones for g in d.peer_goodput_mbps}
    assert any(d.region is None for _, d in drones)
    assert any(d.region and math.dist(d.region[:2], d.position_m[:2]) > 2000 for _, d in drones), "region far off"
    assert any(d.region and math.dist(d.region[:2], d.position_m[:2]) < d.region.radius_m for _, d in drones)
    assert any(d.priority_target_ids for _, d in drones)
    assert any(list(v.descriptors) != sorted(v.descriptors) for v in views), "any order"
    assert {v.detached_after_periods for v in views} == {4.0, 10.0, 20.0, 1000.0}


@pytest.mark.parametrize("number", range(30))
def test_a_view_survives_json_exactly(number: int) -> None:
    view = draw_view(3, number)
    again = from_json(to_json(view))
    assert again == view
    assert list(again.descriptors) == list(view.descriptors)


def test_an_empty_view_survives_json() -> None:
    assert from_json(to_json(FleetView(2, 0.1, {}, {}))) == FleetView(2, 0.1, {}, {})


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("period_s",), 0, "view.period_s is 0, must be above 0"),
        (("ego",), "x", "view.ego is 'x', must be a number"),
        (("drones", 0, "battery_soc"), 1.5, "drones[0].battery_soc is 1.5, must be in [0, 1]"),
        (("drones", 0, "task_phase"), "idle", "drones[0].task_phase is 'idle', must be one of transit, search"),
        (("drones", 0, "coverage_grid"), "00", "drones[0].coverage_grid has 1 bytes, must have 64"),
        (("drones", 0, "coverage_grid"), "zz", "drones[0].coverage_grid must be hexadecimal"),
        (("drones", 0, "position_m"), [1, 2], "drones[0].position_m is [1, 2], must be a list of 3 numbers"),
        (("drones", 1, "agent_id"), 0, "drones[1].agent_id is 0, which another drone has already"),
        (("drones", 0, "age_s"), -1, "drones[0].age_s is -1, must be in [0, inf]"),
        (("drones", 0), 3, "drones[0] must be an object"),
        (("drones",), 3, "a view is an object with ego, period_s and a list of drones"),
    ],
)
def test_a_broken_view_names_its_field(path: tuple[str | int, ...], value: object, message: str) -> None:
    data = json.loads(to_json(fleet_of(2)))
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    with pytest.raises(ViewError) as caught:
        from_json(json.dumps(data))
    assert message in str(caught.value)


def test_smaller_keeps_failing_and_drops_what_does_not_matter() -> None:
    def fails(view: FleetView) -> bool:
        return 3 in view.descriptors and view.descriptors[3].battery_soc < 0.3

    view = next(v for v in draw_views(5, 1000) if fails(v) and v.ego != 3 and len(v.descriptors) > 6)
    small = shrink(view, fails)
    assert fails(small)
    assert len(small.descriptors) == 2
    assert small.descriptors[small.ego].battery_soc == 1.0
    assert small.descriptors[3].battery_soc in {d.battery_soc for d in view.descriptors.values()}


def test_a_check_is_a_value() -> None:
    check = conform(worked, count=1)[0]
    assert replace(check, what="x") != check
