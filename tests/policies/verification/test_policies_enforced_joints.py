"""The shield at the gate and the causes of a break: what a gate acts on, what a limit allows, whose directive broke a line.

1. A gate at 0 Hz sends nothing, whatever its representation: it is judged and put right as that.
2. Nothing is put right that keeps the lines, not even by another way to write the same.
3. A limit holds for each link by itself, and detached peers have links too.
4. A cause is the first step that broke the line; what was asked for detached peers was never sent.
5. Lines of one drone do not end each other's breaks, and the longest time of a word about time is kept.
"""

from __future__ import annotations

from policies_examples import fleet_of

from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.policies.decision_loop import Steps
from sortie.policies.staleness import Ceilings
from sortie.policies.verification.enforced import (
    DAMPING,
    NO_PEER,
    POLICY,
    STALENESS,
    effective,
    judge,
    put_right,
)
from sortie.policies.verification.invariants.language import parse, violations
from sortie.policies.verification.invariants.past import Past
from sortie.policies.verification.shield import enforce, shield

NONE, DETECTIONS, FEATURES = Representation.NONE, Representation.DETECTIONS, Representation.FEATURES
VIEW = fleet_of(4)
GONE = VIEW._replace(age_s={**VIEW.age_s, 3: 30.0})


def link(peer: int, rung: Representation = FEATURES, rate_hz: float = 5.0, rho: float = 0.5) -> Directive:
    return Directive(0, peer, rung, rho if rung == FEATURES else 0.0, rate_hz=rate_hz, reason="r")


def test_a_gate_at_0_hz_acts_as_one_that_sends_nothing() -> None:
    resting = link(1, rate_hz=0.0)
    assert effective(resting) == resting._replace(representation=NONE, rho=0.0)
    for as_it_is in (link(1), link(1, NONE, 0.0), link(1, NONE, 5.0)):
        assert effective(as_it_is) is as_it_is


def test_what_keeps_the_lines_stays_as_it_is_written() -> None:
    damped = [link(1, rate_hz=0.0), link(2), link(3, NONE, 0.0)]
    kept = put_right(parse("representation <= features"), VIEW, damped, (), None)
    assert all(a is b for a, b in zip(kept, damped, strict=True))


def test_a_link_that_rests_is_put_right_as_one_that_carries_nothing() -> None:
    damped = [link(1, rate_hz=0.0), link(2), link(3)]
    first, *rest = put_right(parse("representation >= detections"), VIEW, damped, (), None)
    assert (first.representation, first.rho, first.rate_hz) == (DETECTIONS, 0.0, 2.0)
    assert rest == damped[1:]


def test_a_limit_is_each_links_own() -> None:
    ceilings: Ceilings = {1: (("representation", "<=", 0.0),), 2: (("rate_hz", "<=", 4.0),), 3: ()}
    damped = [link(peer, NONE, 0.0) for peer in (1, 2, 3)]
    first, second, third = put_right(parse("rate_hz >= 3 and representation >= features"), VIEW, damped, (), ceilings)
    assert first is damped[0]  # nothing that is allowed mends it
    assert [(d.representation, d.rate_hz) for d in (second, third)] == [(FEATURES, 3.0)] * 2
    slow = put_right(parse("rate_hz >= 5"), VIEW, [link(2, rate_hz=1.0), link(3, rate_hz=1.0)], (), ceilings)
    assert [d.rate_hz for d in slow] == [1.0, 5.0]


def test_at_the_gate_a_line_compares_with_what_the_policy_decides_at_age_0() -> None:
    damped = [link(peer, rate_hz=10.0) for peer in (1, 2, 3)]
    fresh = [link(1, rate_hz=2.0), link(2, rate_hz=10.0), link(3, rate_hz=5.0)]
    found = put_right(parse("rate_hz <= fresh.rate_hz"), VIEW, damped, fresh, None)
    assert [d.rate_hz for d in found] == [2.0, 10.0, 5.0]


def test_a_line_about_age_is_kept_on_links_to_who_is_gone() -> None:
    damped = [link(peer) for peer in (1, 2, 3)]
    found = put_right(parse("when age_s > 1: rate_hz <= 2"), GONE, damped, (), None)
    assert [d.rate_hz for d in found] == [5.0, 5.0, 2.0]
    both = put_right(parse("when age_s > 1: rate_hz <= 2\nwhen age_s <= 1: rate_hz >= 7"), GONE, damped, (), None)
    assert [d.rate_hz for d in both] == [7.0, 7.0, 2.0]


def _causes(line: str, steps: list[Steps], view: FleetView = GONE) -> list[tuple[int, str]]:
    return [(v.peer, v.cause) for v in judge(parse(line), view, steps, [s.damped for s in steps])]


def test_a_cause_is_the_first_step_that_broke_the_line_on_that_link() -> None:
    good, bad = {p: link(p, rate_hz=2.0) for p in (1, 2, 3)}, {p: link(p, rate_hz=9.0) for p in (1, 2, 3)}
    line = "rate_hz <= 5"
    steps = [Steps(good[1], good[1], bad[1]), Steps(good[2], bad[2], bad[2]), Steps(bad[3], bad[3], bad[3])]
    assert _causes(line, steps, VIEW) == [(1, DAMPING), (2, STALENESS), (3, POLICY)]
    # the same of a detached peer: what was asked for it never counts
    assert _causes(line, [Steps(bad[3], bad[3], bad[3])]) == [(3, STALENESS)]
    assert _causes(line, [Steps(bad[3], good[3], bad[3])]) == [(3, DAMPING)]
    assert _causes(line, [Steps(bad[1], good[1], good[1])]) == []


def test_a_line_over_all_links_does_not_count_what_was_asked_for_who_is_gone() -> None:
    line = "any_link(representation >= detections)"
    silent = {p: link(p, NONE, 0.0) for p in (1, 2, 3)}
    asked_of_gone = [Steps(silent[1], silent[1], silent[1]), Steps(link(3), silent[3], silent[3])]
    assert _causes(line, asked_of_gone) == [(-1, POLICY)]
    by_age = [Steps(link(1), silent[1], silent[1]), Steps(silent[3], silent[3], silent[3])]
    assert _causes(line, by_age) == [(-1, STALENESS)]
    resting = [Steps(link(1), link(1), link(1, rate_hz=0.0))]
    assert _causes(line, resting) == [(-1, DAMPING)]
    alone = VIEW._replace(age_s={0: 0.0, 1: 30.0, 2: 30.0, 3: 30.0})
    assert _causes(line, by_age, alone) == [(-1, NO_PEER)]
    assert _causes("rate_hz >= 1", [by_age[0]], alone) == [(1, STALENESS)]  # a line of each link names its step


def test_breaks_of_two_lines_last_by_themselves() -> None:
    rules = parse("within 0.2 s: rate_hz >= 5\nwithin 0.4 s: rate_hz >= 3")
    past, found = Past(rules, 1.0), []
    for k, rates in enumerate([(0, 9), (0, 9), (0, 0), (0, 0), (4, 0), (9, 0), (9, 9)]):
        acting = [link(peer, rate_hz=float(rate)) for peer, rate in zip((1, 2), rates, strict=True)]
        past.note(0.1 * k, acting)
        steps = [Steps(d, d, d) for d in acting]
        found += [(k, v.line[7:10], v.peer) for v in judge(rules, VIEW, steps, acting, (), past)]
    # the first line: peer 1 broken from 0 to 0.5 s, peer 2 from 0.2 to 0.6 s; the second: peer 1 to 0.4 s, peer 2 to 0.6 s
    assert found == [(3, "0.2", 1), (4, "0.2", 1), (5, "0.2", 1), (5, "0.2", 2), (6, "0.2", 2)]


def test_two_lines_that_count_changes_each_reach_back_as_far_as_they_say() -> None:
    for text in ("climbs_in(1) <= 1\nclimbs_in(0.2) <= 0", "climbs_in(0.2) <= 0\nclimbs_in(1) <= 1"):
        past = Past(parse(text), 5.0)
        for k, rate_hz in enumerate([2.0, 5.0, 5.0, 5.0, 5.0]):
            past.note(0.1 * k, [link(1, rate_hz=rate_hz), link(2, rate_hz=5.0)])
        assert [past.count("climbs_in", peer, 1.0) for peer in (1, 2, 3)] == [2, 1, 0]
        assert [past.count("climbs_in", peer, 0.2) for peer in (1, 2, 3)] == [0, 0, 0]
        assert past.count("climbs_in", 1, "dwell") == 2


# --- the shield's joints ---------------------------------------------------------------------------


def test_equal_links_are_corrected_alike_and_unequal_ones_each_by_itself() -> None:
    lines = parse("rate_hz <= 4\nrho <= 0.25")
    decided = [link(1), link(2, rate_hz=3.0), link(3, rho=0.125)]
    found = enforce(lines, VIEW, decided)
    assert [(d.destination, d.rate_hz, d.rho) for d in found] == [(1, 4.0, 0.25), (2, 3.0, 0.25), (3, 4.0, 0.125)]
    duties = [link(p)._replace(duty_percent=10 * p, fusion_weight=0.1 * p, deadline_s=0.5 * p) for p in (1, 2, 3)]
    for before, after in zip(duties, enforce(lines, VIEW, duties), strict=True):
        assert after == before._replace(rate_hz=4.0, rho=0.25)


def test_a_line_about_a_peer_corrects_the_links_of_those_peers() -> None:
    descriptors = {i: d._replace(battery_soc=0.05 if i == 2 else 0.9) for i, d in VIEW.descriptors.items()}
    view = VIEW._replace(descriptors=descriptors)
    lines = parse("when peer_battery < 0.1: rate_hz <= 1\nwhen battery < 0.1: rate_hz <= 0\nrate_hz <= 4")
    assert [d.rate_hz for d in enforce(lines, view, [link(p) for p in (1, 2, 3)])] == [4.0, 1.0, 4.0]
    own = parse("rate_hz <= 10 * peer_battery")
    assert [d.rate_hz for d in enforce(own, view, [link(p, rate_hz=20.0) for p in (1, 2, 3)])] == [9.0, 0.5, 9.0]


def test_a_shield_asks_for_what_is_decided_at_age_0_of_all_even_of_who_is_gone() -> None:
    def hasty(view: FleetView) -> list[Directive]:
        return [link(p, rate_hz=2.0 if view.age_s[p] == 0 else 9.0) for p in view.peers]

    found = shield(hasty, parse("rate_hz <= fresh.rate_hz"))(GONE)
    assert [d.rate_hz for d in found] == [2.0, 2.0, 2.0]


def test_of_links_that_would_change_as_much_the_first_one_does() -> None:
    decided = [link(p, NONE, 0.0) for p in (1, 2, 3)]
    found = enforce(parse("any_link(representation >= detections)"), VIEW, decided)
    assert [d.representation for d in found] == [DETECTIONS, NONE, NONE]
    conditional = enforce(parse("when battery > 0.5: any_link(rate_hz >= 2)"), VIEW, decided)
    assert [d.rate_hz for d in conditional] == [2.0, 0.0, 0.0]
    peers = parse("any_link(peer_battery < 0.5 and rate_hz >= 2)")
    weak = VIEW._replace(
        descriptors={i: d._replace(battery_soc=0.4 if i == 3 else 0.9) for i, d in VIEW.descriptors.items()}
    )
    assert [d.rate_hz for d in enforce(peers, weak, decided)] == [0.0, 0.0, 2.0]


def test_nearer_is_by_shares_of_each_fields_bounds() -> None:
    """9 Hz of 30 is nearer than 0.5 of 1; half of the duty is farther than a quarter of the weight."""
    (found,) = enforce(parse("rate_hz <= 1 or rho <= 0"), VIEW, [link(1, rate_hz=10.0)])
    assert (found.rate_hz, found.rho) == (1.0, 0.5)
    (found,) = enforce(parse("duty <= 0.5 or fusion_weight <= 0.75"), VIEW, [link(1)])
    assert (found.duty_percent, found.fusion_weight) == (100, 0.75)
    (found,) = enforce(parse("duty <= 0.75 or fusion_weight <= 0.5"), VIEW, [link(1)])
    assert (found.duty_percent, found.fusion_weight) == (75, 1.0)


def test_each_link_keeps_its_own_region() -> None:
    discs = [Disc(1.0, 2.0, 3.0), None, Disc(4.0, 5.0, 6.0)]
    decided = [link(p)._replace(roi=disc) for p, disc in zip((1, 2, 3), discs, strict=True)]
    found = enforce(parse("rate_hz <= 4"), VIEW, decided)
    assert [(d.destination, d.roi, d.rate_hz) for d in found] == [
        (p, disc, 4.0) for p, disc in zip((1, 2, 3), discs, strict=True)
    ]


def test_a_link_that_is_not_decided_at_age_0_counts_as_one_that_carries_nothing() -> None:
    lines, decided, fresh = parse("rate_hz <= fresh.rate_hz"), [link(1), link(2)], [link(2)]
    assert violations(lines[0], VIEW, decided, fresh) == [decided[0]]
    assert [d.rate_hz for d in enforce(lines, VIEW, decided, fresh)] == [0.0, 5.0]
