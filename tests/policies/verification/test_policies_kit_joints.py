"""The kit's rules one by one, and what its drawn views have.

1. A rule of the kit fails alone where a policy breaks it alone.
2. Drawn views have every state on which a rule may decide.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import Directive, FleetView, Reposition, Representation, looks_from
from sortie.policies.verification.kit.conformance import RULES, conform
from sortie.policies.verification.kit.tried import shrink
from sortie.policies.verification.kit.views import draw_view, draw_views

VIEW = fleet_of(5)


def _boxes(view: FleetView, **fields: Any) -> list[Directive]:
    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=2.0, reason="r", **fields) for p in view.peers]


def _reorders(view: FleetView) -> list[Directive]:
    first = next(iter(view.descriptors), None)
    if first is not None and isinstance(view.descriptors, dict):
        view.descriptors[first] = view.descriptors.pop(first)
    return _boxes(view)


def _reorders_ages(view: FleetView) -> list[Directive]:
    first = next(iter(view.age_s), None)
    if first is not None and isinstance(view.age_s, dict):
        view.age_s[first] = view.age_s.pop(first)
    return _boxes(view)


def _explains_the_first_alone(view: FleetView) -> list[Directive]:
    return [d._replace(reason="") if k else d for k, d in enumerate(_boxes(view))]


def _sends_codes(view: FleetView) -> list[Directive]:
    return [d._replace(representation=Representation.CODES, rho=0.5) for d in _boxes(view)]


def _fills_one_receiver(view: FleetView, *, received_budget: float = 1.0) -> list[Directive]:
    """Each sender stays within the budget; the drone of the lowest id gets it from all of them."""
    rho = min(1.0, received_budget * view.full_sharing_maps)
    return [
        Directive(
            view.ego, p, Representation.FEATURES, rho if p == min(view.descriptors) else 0.0, None, 2.0, reason="r"
        )
        for p in view.peers
    ]


def _spends_by_link(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    share = min(1.0, rho * 1.5)
    return [Directive(view.ego, p, Representation.FEATURES, share, None, 2.0, reason="r") for p in view.peers]


def _fails_where_nobody_is_heard(view: FleetView) -> list[Directive]:
    return _boxes(view._replace(ego=view.descriptors[view.ego].agent_id))


def _needs_somebody(view: FleetView) -> Reposition | None:
    x_m, y_m, _ = view.descriptors[view.ego].position_m
    return Reposition(x_m, y_m, "r")


@looks_from(_needs_somebody)
def _looks_where_nobody_is(view: FleetView) -> list[Directive]:
    return _boxes(view)


def _jumps(view: FleetView) -> Reposition | None:
    return None if view.me is None else Reposition(1e4, 0.0)


@looks_from(_jumps)
def _looks_too_far(view: FleetView) -> list[Directive]:
    return _boxes(view)


def _first_seen(view: FleetView) -> list[Directive]:
    first = next((i for i in view.descriptors if i != view.ego), -1)
    return [d._replace(rate_hz=4.0) if d.destination == first else d for d in _boxes(view)]


def _rises_with_age(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=2.0 + (view.age_s[d.destination] > 0.5)) for d in _boxes(view)]


TWO_CODEBOOKS = VIEW._replace(
    descriptors={i: d._replace(codebook="0" * 14 if i == 2 else "") for i, d in VIEW.descriptors.items()}
)


@pytest.mark.parametrize(
    ("policy", "rule", "view"),
    [
        (_reorders, "input unchanged", VIEW),
        (_reorders_ages, "input unchanged", VIEW),
        (_explains_the_first_alone, "gives reasons", VIEW),
        (_sends_codes, "maps within one network", TWO_CODEBOOKS),
        (_fills_one_receiver, "budget kept", VIEW),
        (_spends_by_link, "budget kept", VIEW),
        (_fails_where_nobody_is_heard, "one drone and empty views", VIEW),
        (_looks_where_nobody_is, "viewpoint kept", VIEW),
        (_looks_too_far, "viewpoint kept", VIEW),
        (_first_seen, "order of drones irrelevant", VIEW),
        (_rises_with_age, "age-monotone", VIEW),
    ],
)
def test_a_rule_finds_what_breaks_it_and_nothing_else_does(policy: Any, rule: str, view: FleetView) -> None:
    copied = view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))
    broken = [name for name, rule in RULES.items() if rule.complaint(policy, _anew(copied)) is not None]
    assert broken == [rule]
    assert [c.name for c in conform(policy, [_anew(view)]) if not c.holds and c.name in RULES] == [rule]


def _anew(view: FleetView) -> FleetView:
    return view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))


@pytest.mark.parametrize("policy", [_boxes, lambda view: _sends_codes(view)])
def test_a_policy_that_breaks_nothing_keeps_every_rule(policy: Callable[[FleetView], list[Directive]]) -> None:
    assert [name for name, rule in RULES.items() if rule.complaint(policy, _anew(VIEW)) is not None] == []


def test_a_rule_that_no_view_could_check_does_not_hold() -> None:
    def broken(view: FleetView) -> list[Directive]:
        raise ValueError

    held = {c.name: c.holds for c in conform(broken, [VIEW])}
    assert not any(held[name] for name in RULES if name not in ("input unchanged", "viewpoint kept"))
    assert not held["no memory"]


# --- drawn views --------------------------------------------------------------------------------------


def test_drawn_views_have_every_state_on_which_a_rule_may_decide() -> None:
    views = list(draw_views(11, 110))
    drones = [d for v in views for d in v.descriptors.values()]
    away_m = [abs(d.region.x_m - d.position_m[0]) for d in drones if d.region is not None]
    assert min(away_m) < 100 < 2900 < max(away_m)
    assert {d.novelty_flags for d in drones} == set(range(8))
    assert any(set(v.me.roster.members) - v.descriptors.keys() for v in views if v.me is not None and v.me.roster)
    assert any(len(v.peers) < len(v.me.peer_goodput_mbps) for v in views if v.me is not None and v.me.roster is None)
    assert any(list(v.descriptors) != sorted(v.descriptors) for v in views)
    assert {v.period_s for v in views} == {0.1, 0.2, 1.0}
    for periods in (1.0, 3.0, 3.1, 10.0, 10.1):
        for period_s in (0.1, 0.2, 1.0):
            assert any(v.period_s == period_s and v.period_s * periods in v.age_s.values() for v in views)
    assert {0.3, 0.6, 0.2999} <= {d.battery_soc for d in drones}
    assert {0.0, 5.0, 4.99} <= {x for d in drones for x in d.peer_goodput_mbps}
    assert all(a != b for k, a in enumerate(views) for b in views[:k])
    assert len(draw_view(11, 0, 40).descriptors) > 20


def test_shrinking_keeps_a_view_whole_and_makes_it_plain() -> None:
    view = next(v for v in draw_views(11, 500) if v.me is not None and v.me.roster is not None and len(v.peers) > 4)

    def fails(candidate: FleetView) -> bool:
        assert candidate.age_s.keys() == candidate.descriptors.keys()
        return len(candidate.peers) >= 2

    small = shrink(view, fails)
    assert len(small.peers) == 2
    assert set(small.age_s.values()) == {0.0}
    for d in small.descriptors.values():
        assert (d.roster, d.battery_soc, d.region, d.novelty_flags) == (None, 1.0, None, 0)
        assert set(d.peer_goodput_mbps) == {100.0}
