"""The decision loop: what a guard is shown, and that a guard that changes nothing changes nothing."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from policies_examples import fleet_of

from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, FleetView, Representation, nothing
from sortie.policies.damping import DampedLink, damp
from sortie.policies.decision_loop import DecisionLoop, Steps
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.staleness import LinkHealth, cap_by_age
from sortie.policies.verification.kit.courses import Course, draw_course, values_at

RULES = PlaneRules(0.1, 100, 3.0, 10.0, 0.4, 0.0)


def let_pass(view: FleetView, now_s: float, links: Sequence[Steps]) -> list[Directive]:
    return [link.damped for link in links]


@pytest.mark.parametrize("number", range(2))
def test_a_link_that_is_left_out_would_not_have_changed(number: int) -> None:
    """The loop steps only links that may change. Compared with staleness and damping of every link each time."""
    course = draw_course(number, Course(3, 60, 0.1, 0.1, 10.0, {}), values_at([0.3, 5.0]))
    plain, guarded, changes = DecisionLoop(0, RULES), DecisionLoop(0, RULES, let_pass), 0
    states = {peer: DampedLink(nothing(0, peer, "")) for peer in (1, 2)}
    for k, view in enumerate(course.views()):
        asked = {d.destination: d for d in worked(view)}
        of_plain, of_guarded = (loop.decide(view, asked, 0.1 * k).changes for loop in (plain, guarded))
        for peer in asked:
            capped = cap_by_age(asked[peer], RULES.health(view.age_s[peer]), view.age_s[peer])
            states[peer] = damp(states[peer], capped, 0.1 * k, RULES.dwell_s)
            assert plain.links[peer].enforced[:9] == states[peer].enforced[:9]
        assert [c.enforced for c in of_plain] == [c.enforced for c in of_guarded]
        changes += len(of_plain)
    assert changes


def test_a_guard_sees_each_step_of_every_link_and_has_the_last_word() -> None:
    shown = list[Steps]()

    def hush(view: FleetView, now_s: float, links: Sequence[Steps]) -> list[Directive]:
        shown.extend(links)
        return [link.damped._replace(rate_hz=0.5) for link in links]

    view = fleet_of(3)._replace(age_s={0: 0.0, 1: 0.0, 2: 0.5})
    asked = {p: Directive(0, p, Representation.RAW, rate_hz=9.0, reason="r") for p in (1, 2)}
    changes = DecisionLoop(0, PlaneRules(0.1, 100, 3.0, 10.0, 0.0, 0.0), hush).decide(view, asked, 0.0).changes
    assert [(s.asked, s.health) for s in shown] == [(asked[1], LinkHealth.FRESH), (asked[2], LinkHealth.DEGRADED)]
    assert [(s.by_age.representation, s.damped.rate_hz) for s in shown] == [(4, 9.0), (2, 2.0)]
    assert [(c.enforced.destination, c.enforced.rate_hz) for c in changes] == [(1, 0.5), (2, 0.5)]


def test_a_drone_that_comes_back_begins_every_link_with_nothing() -> None:
    loop, view = DecisionLoop(0, PlaneRules(0.1, 100, 3.0, 10.0, 0.2, 0.0)), fleet_of(3)
    asked = {1: Directive(0, 1, Representation.TRACKS, rate_hz=1.0, reason="r")}
    enforced = [[c.enforced.rate_hz for c in loop.decide(view, asked, 0.1 * k).changes] for k in range(4)]
    assert enforced == [[], [], [1.0], []], "an upgrade waits for its dwell time"
    assert [(c.enforced.destination, c.enforced.reason) for c in loop.come_back()] == [(1, "came back")]
    assert [len(loop.decide(view, asked, 9.0 + 0.1 * k).changes) for k in range(3)] == [0, 0, 1]
