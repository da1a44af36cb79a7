"""What a gate acts on, what it puts right within its limits, and which step caused a break."""

from __future__ import annotations

from policies_examples import aged, fleet_of

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.decision_loop import Steps
from sortie.policies.staleness import Ceilings
from sortie.policies.verification.enforced import DAMPING, NO_PEER, POLICY, STALENESS, effective, judge, put_right
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.invariants.past import Past

NONE, DETECTIONS, FEATURES = Representation.NONE, Representation.DETECTIONS, Representation.FEATURES
VIEW = fleet_of(4)
GONE = aged(VIEW, {3: 30.0})


def link(peer: int, rung: Representation = FEATURES, rate_hz: float = 5.0) -> Directive:
    return Directive(0, peer, rung, 0.5 if rung == FEATURES else 0.0, rate_hz=rate_hz, reason="r")


def test_a_gate_at_0_hz_acts_as_one_that_sends_nothing() -> None:
    """In every field that lines read; all others act as they are."""
    for rung in Representation:
        assert effective(link(1, rung, 0.0)) == link(1, rung, 0.0)._replace(representation=NONE, rho=0.0)
    for as_it_is in (link(1), link(1, NONE, 0.0), link(1, NONE, 5.0)):
        assert effective(as_it_is) is as_it_is
    resting = link(1, rate_hz=0.0)
    assert not judge(parse("rho <= 0.1"), VIEW, [Steps(resting, resting, resting)], [resting])


def test_what_keeps_the_lines_stays_as_it_is_and_a_link_that_rests_is_put_right_as_one_without_anything() -> None:
    damped = [link(1, rate_hz=0.0), link(2), link(3, NONE, 0.0)]
    kept = put_right(parse("representation <= features"), VIEW, damped, (), None)
    assert all(a is b for a, b in zip(kept, damped, strict=True))
    first, *rest = put_right(parse("representation >= detections"), VIEW, [damped[0], link(2), link(3)], (), None)
    assert (first.representation, first.rho, first.rate_hz) == (DETECTIONS, 0.0, 2.0)
    assert rest == [link(2), link(3)]


def test_a_limit_is_each_links_own() -> None:
    ceilings: Ceilings = {1: (("representation", "<=", 0.0),), 2: (("rate_hz", "<=", 4.0),), 3: ()}
    damped = [link(peer, NONE, 0.0) for peer in (1, 2, 3)]
    first, second, third = put_right(parse("rate_hz >= 3 and representation >= features"), VIEW, damped, (), ceilings)
    assert first is damped[0]  # nothing that is allowed mends it
    assert [(d.representation, d.rate_hz) for d in (second, third)] == [(FEATURES, 3.0)] * 2
    slow = put_right(parse("rate_hz >= 5"), VIEW, [link(2, rate_hz=1.0), link(3, rate_hz=1.0)], (), ceilings)
    assert [d.rate_hz for d in slow] == [1.0, 5.0]


def test_a_line_is_about_what_the_policy_decides_at_age_0_and_about_who_is_gone() -> None:
    damped = [link(peer, rate_hz=10.0) for peer in (1, 2, 3)]
    fresh = [link(1, rate_hz=2.0), link(2, rate_hz=10.0), link(3, rate_hz=5.0)]
    found = put_right(parse("rate_hz <= fresh.rate_hz"), VIEW, damped, fresh, None)
    assert [d.rate_hz for d in found] == [2.0, 10.0, 5.0]
    links = [link(peer) for peer in (1, 2, 3)]
    late = put_right(parse("when age_s > 1: rate_hz <= 2"), GONE, links, (), None)
    assert [d.rate_hz for d in late] == [5.0, 5.0, 2.0]
    both = put_right(parse("when age_s > 1: rate_hz <= 2\nwhen age_s <= 1: rate_hz >= 7"), GONE, links, (), None)
    assert [d.rate_hz for d in both] == [7.0, 7.0, 2.0]


def causes(line: str, steps: list[Steps], view: FleetView = GONE) -> list[tuple[int, str]]:
    return [(v.peer, v.cause) for v in judge(parse(line), view, steps, [s.damped for s in steps])]


def test_a_cause_is_the_first_step_that_broke_the_line_on_that_link() -> None:
    """What was asked for a detached peer never counts."""
    good, bad = {p: link(p, rate_hz=2.0) for p in (1, 2, 3)}, {p: link(p, rate_hz=9.0) for p in (1, 2, 3)}
    line = "rate_hz <= 5"
    steps = [Steps(good[1], good[1], bad[1]), Steps(good[2], bad[2], bad[2]), Steps(bad[3], bad[3], bad[3])]
    assert causes(line, steps, VIEW) == [(1, DAMPING), (2, STALENESS), (3, POLICY)]
    assert causes(line, [Steps(bad[3], bad[3], bad[3])]) == [(3, STALENESS)]
    assert causes(line, [Steps(bad[3], good[3], bad[3])]) == [(3, DAMPING)]
    assert causes(line, [Steps(bad[1], good[1], good[1])]) == []


def test_a_line_over_all_links_does_not_count_what_was_asked_for_who_is_gone() -> None:
    line = "any_link(representation >= detections)"
    silent = {p: link(p, NONE, 0.0) for p in (1, 2, 3)}
    asked_of_gone = [Steps(silent[1], silent[1], silent[1]), Steps(link(3), silent[3], silent[3])]
    assert causes(line, asked_of_gone) == [(-1, POLICY)]
    by_age = [Steps(link(1), silent[1], silent[1]), Steps(silent[3], silent[3], silent[3])]
    assert causes(line, by_age) == [(-1, STALENESS)]
    assert causes(line, [Steps(link(1), link(1), link(1, rate_hz=0.0))]) == [(-1, DAMPING)]
    alone = aged(VIEW, {1: 30.0, 2: 30.0, 3: 30.0})
    assert causes(line, by_age, alone) == [(-1, NO_PEER)]
    assert causes("rate_hz >= 1", [by_age[0]], alone) == [(1, STALENESS)]  # a line of each link names its step


def test_breaks_of_two_lines_last_by_themselves() -> None:
    rules = parse("within 0.2 s: rate_hz >= 5\nwithin 0.4 s: rate_hz >= 3")
    past, found = Past(rules, 1.0), []
    for k, rates in enumerate([(0, 9), (0, 9), (0, 0), (0, 0), (4, 0), (9, 0), (9, 9)]):
        acting = [link(peer, rate_hz=float(rate)) for peer, rate in zip((1, 2), rates, strict=True)]
        past.note(0.1 * k, acting)
        steps = [Steps(d, d, d) for d in acting]
        found += [(k, v.line[7:10], v.peer) for v in judge(rules, VIEW, steps, acting, (), past)]
    # the first line: peer 1 broken from 0 to 0.5 s, peer 2 from 0.2 to 0.6 s; the second: to 0.4 s and to 0.6 s
    assert found == [(3, "0.2", 1), (4, "0.2", 1), (5, "0.2", 1), (5, "0.2", 2), (6, "0.2", 2)]
