"""The shield keeps what it is given, changes as little as can be, and says where it stepped in."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_examples import aged, changed, fleet_of, written

from sortie.policies.catalogue.baselines import everyone, silence
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, Disc, FleetView, Policy, Representation, TaskPhase
from sortie.policies.verification.invariants.language import InvariantError, just_heard, parse, violations
from sortie.policies.verification.invariants.words import DECISIONS
from sortie.policies.verification.kit.views import draw_views
from sortie.policies.verification.proof.proof import prove
from sortie.policies.verification.shield import HIGHEST, MARK, enforce, interventions, shield

NONE, TRACKS, DETECTIONS, FEATURES = (Representation(k) for k in range(4))
HUMANE = "when target_in_region and peers >= 1: any_link(representation >= detections)"
SPARING = """
    when battery < 0.5: rate_hz <= 2 and representation <= detections
    when goodput_mbps < 5: representation == none
"""
RULES = {
    "sparing": SPARING,
    "humane": HUMANE,
    "both": SPARING.replace("representation == none", "rate_hz < 2") + HUMANE,
    "confined": "when region and representation > none: roi\nrho <= 0.1\nduty >= 0.5",
    "strict": "when battery < 0.9: rate_hz < 3\nfusion_weight > 0.2",
    "aged": "when age_periods > 2: representation <= tracks\nrate_hz <= fresh.rate_hz",
}
DROPS = """
from sortie import Representation
from sortie.policies.catalogue.worked import worked
def decide(view):
    tired = view.me is not None and 0.4 < view.me.battery_soc < 0.5
    return [d._replace(representation=Representation.NONE) if tired else d for d in worked(view)]
"""


def rises_with_age(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=min(30.0, 1.0 + view.age_s[d.destination])) for d in everyone(view)]


def broken(policy: Policy, text: str, view: FleetView) -> list[str]:
    directives, fresh = policy(view), policy(just_heard(view))
    return [rule.text for rule in parse(text) if violations(rule, view, directives, fresh)]


def link(peer: int, rung: Representation = FEATURES, rate_hz: float = 5.0, rho: float = 0.5) -> Directive:
    return Directive(0, peer, rung, rho if rung == FEATURES else 0.0, rate_hz=rate_hz, reason="r")


def test_whatever_the_policy_decides_the_shielded_one_keeps_the_rules() -> None:
    """A policy that keeps them passes untouched, every change has its mark, and shielding twice is shielding once."""
    for policy, text in itertools.product((worked, everyone, silence, rises_with_age), RULES.values()):
        shielded, stepped_in, needed = shield(policy, parse(text)), 0, False
        twice = shield(shielded, parse(text))
        for number, view in enumerate(draw_views(3, 40)):
            decided, directives = list(policy(view)), shielded(view)
            stepped_in += interventions(directives)
            breaks = broken(policy, text, view)
            needed = needed or bool(breaks)
            assert breaks or [tuple(d) for d in directives] == [tuple(d) for d in decided]
            if not any(d.reason.startswith(f"{MARK}cannot keep") for d in directives):
                fresh = policy(just_heard(view))
                assert not [r.text for r in parse(text) if violations(r, view, directives, fresh)], view
            for before, after in zip(decided, directives, strict=True):
                assert before == after or after.reason.startswith(MARK), "a change without its mark"
            assert policy is not everyone or number > 15 or [tuple(d) for d in twice(view)] == [*map(tuple, directives)]
        assert stepped_in or not needed


@pytest.mark.slow
def test_the_shielded_fault_is_proved_harmless(tmp_path: Path) -> None:
    """The proof explores the shield together with the policy: it holds on every view, not on drawn ones alone."""
    faulty = written(tmp_path, DROPS)
    assert prove(faulty, parse(HUMANE), max_drones=2, views=0)[-1].outcome == "refuted"
    verdicts = prove(shield(faulty, parse(HUMANE)), parse(HUMANE), max_drones=2, views=20)
    assert [v.outcome for v in verdicts] == ["proved", "proved", "proved"]


# --- the least change -----------------------------------------------------------------------------


def test_the_least_is_changed() -> None:
    (one, *_) = shield(everyone, parse("rate_hz <= 2"))(fleet_of(3))
    (before, *_) = everyone(fleet_of(3))
    assert one == before._replace(rate_hz=2.0), "the rate alone, and to its bound"
    assert one.reason == f"{MARK}rate_hz <= 2 (decided features at 10 Hz: {before.reason})"
    # Either part mends it: a fraction of the rate's bounds is less than a rung's quarter.
    (either, *_) = shield(everyone, parse("representation < features or rate_hz <= 9"))(fleet_of(3))
    assert either == before._replace(rate_hz=9.0)


def test_nearer_is_by_shares_of_each_fields_bounds() -> None:
    """9 Hz of 30 is nearer than 0.5 of 1; half of the duty is farther than a quarter of the weight."""
    view = fleet_of(2)
    (found,) = enforce(parse("rate_hz <= 1 or rho <= 0"), view, [link(1, rate_hz=10.0)])
    assert (found.rate_hz, found.rho) == (1.0, 0.5)
    (found,) = enforce(parse("duty <= 0.5 or fusion_weight <= 0.75"), view, [link(1)])
    assert (found.duty_percent, found.fusion_weight) == (100, 0.75)
    (found,) = enforce(parse("duty <= 0.75 or fusion_weight <= 0.5"), view, [link(1)])
    assert (found.duty_percent, found.fusion_weight) == (75, 1.0)


FIELDS = {
    "representation": [0.0, 1.0, 2.0, 3.0, 4.0],
    "rho": [0.0, 0.1, 0.4, 1.0],
    "rate_hz": [0.0, 2.0, 8.0, 30.0],
    "fusion_weight": [0.0, 0.2, 0.5, 1.0],
}


def a_bound(draw: Random) -> str:
    word = draw.choice(list(FIELDS))
    return f"{word} {draw.choice(['<=', '>=', '<=', '>=', '=='])} {draw.choice(FIELDS[word]):g}"


def distance(a: Directive, b: Directive) -> tuple[int, float]:
    """How many fields differ, and by how much in all."""
    away = [abs(word.raw(a) - word.raw(b)) / HIGHEST[name] for name, word in DECISIONS.items() if word.raw is not None]
    return sum(1 for x in away if x > 0), math.fsum(away)


def some_lines(draw: Random) -> str:
    """Lines that bound fields one by one, by alternatives, and by sums of two."""
    kinds = (
        lambda: a_bound(draw),
        lambda: f"{a_bound(draw)} or {a_bound(draw)}",
        lambda: f"{a_bound(draw)} or ({a_bound(draw)} and {a_bound(draw)})",
        lambda: f"not ({a_bound(draw)} and {a_bound(draw)})",
    )
    return "\n".join(draw.choice(kinds)() for _ in range(draw.randint(1, 4)))


def on_the_grid(before: Directive) -> list[Directive]:
    """Every directive with values that the lines name."""
    return [
        before._replace(representation=Representation(int(r)), rho=c, rate_hz=hz, fusion_weight=w)
        for r, c, hz, w in itertools.product(*FIELDS.values())
    ]


@settings(max_examples=25)
@given(st.integers(0, 2**32))
def test_no_directive_that_keeps_the_lines_is_nearer(seed: int) -> None:
    """Compared with every combination of the values that the lines name."""
    draw = Random(seed)
    text, view = some_lines(draw), fleet_of(2)
    before = draw.choice(on_the_grid(Directive(view.ego, view.peers[0])))
    (after,) = enforce(parse(text), view, [before])
    keep = [d for d in on_the_grid(before) if not any(violations(r, view, [d]) for r in parse(text))]
    assert after.reason.startswith(f"{MARK}cannot keep") == (not keep), text
    if keep:
        assert not any(violations(r, view, [after]) for r in parse(text)), text
        # A lower rung takes the cells with it, and a raised link gets a rate: these changes are not the lines'.
        follows = after._replace(rho=before.rho if after.rho == 0 else after.rho)
        follows = follows._replace(rate_hz=before.rate_hz if before.rate_hz == 0 else follows.rate_hz)
        away = [distance(before, d) for d in (follows, after, *keep)]
        assert min(away[:2]) <= min(away[2:]), text


def test_no_shield_reaches_further_than_the_ladder_nor_makes_a_lowered_link_send() -> None:
    for view in draw_views(6, 60):
        for d in shield(silence, parse("representation >= raw and rate_hz >= 30 and rho >= 1"))(view):
            assert (d.representation, d.rate_hz, d.rho) == (Representation.RAW, 30.0, 1.0)
    (quiet,) = enforce(parse("representation <= tracks"), fleet_of(2), [Directive(0, 1, Representation.RAW)])
    assert (quiet.representation, quiet.rate_hz) == (TRACKS, 0.0)


LINES: list[tuple[str, Directive, Directive]] = [
    # a condition on the directive is made false only where nothing else helps
    ("when representation > none: rate_hz <= 2", link(1, TRACKS, 9.0), link(1, TRACKS, 2.0)),
    ("when representation > none: rate_hz <= 2\nrate_hz >= 5", link(1, TRACKS, 9.0), link(1, NONE, 9.0)),
    # where no range is left a safe directive takes the place
    ("rate_hz * (10 - rate_hz) <= 0", link(1, TRACKS, 5.0), link(1, NONE, 0.0)),
    ("rate_hz * (2 - rate_hz) >= 0 and representation > none", link(1, TRACKS, 5.0), link(1, DETECTIONS, 2.0)),
    # what contradicts itself leaves the decision
    ("rate_hz <= 2\nrate_hz >= 5", link(1, rate_hz=9.0), link(1, rate_hz=9.0)),
    ("battery > 2", link(1, rate_hz=9.0), link(1, rate_hz=9.0)),
]
"""Lines, a decision, and what the shield makes of it."""


def test_what_a_shield_makes_of_a_decision() -> None:
    for lines, decided, wanted in LINES:
        (found,) = enforce(parse(lines), fleet_of(2), [decided])
        assert found == wanted, lines
        assert found.reason.startswith(MARK), lines
        assert found.reason.startswith(f"{MARK}cannot keep") == (found == decided), lines


@pytest.mark.parametrize("function", ["sum_links(rate_hz) <= 5", "count_links(rate_hz > 1) <= 2", "every_link(roi)"])
def test_sums_and_counts_are_refused_where_the_shield_is_made(function: str) -> None:
    words = r"a shield cannot keep \w+_links?\(…\); `sortie verify` can only prove it"
    with pytest.raises(InvariantError, match=words):
        shield(worked, parse(function))


# --- several links --------------------------------------------------------------------------------


def test_equal_links_are_corrected_alike_and_unequal_ones_each_by_itself() -> None:
    """Each keeps all other fields, its own region and its own reason."""
    lines, view = parse("rate_hz <= 4\nrho <= 0.25"), fleet_of(4)
    found = enforce(lines, view, [link(1), link(2, rate_hz=3.0), link(3, rho=0.125)])
    assert [(d.destination, d.rate_hz, d.rho) for d in found] == [(1, 4.0, 0.25), (2, 3.0, 0.25), (3, 4.0, 0.125)]
    own = [{"duty_percent": 10 * p, "fusion_weight": 0.1 * p, "deadline_s": 0.5 * p} for p in (1, 2, 3)]
    for fields in (own, [{"roi": disc} for disc in (Disc(1.0, 2.0, 3.0), None, Disc(4.0, 5.0, 6.0))]):
        decided = [link(p)._replace(reason=f"for {p}", **fields[p - 1]) for p in (1, 2, 3)]
        for before, after in zip(decided, enforce(lines, view, decided), strict=True):
            assert after == before._replace(rate_hz=4.0, rho=0.25)
            assert after.reason.endswith(f"features at 5 Hz: {before.reason})")


def test_a_line_about_a_peer_corrects_the_links_of_those_peers() -> None:
    view = changed(fleet_of(4), 2, battery_soc=0.05)
    lines = parse("when peer_battery < 0.1: rate_hz <= 1\nwhen battery < 0.1: rate_hz <= 0\nrate_hz <= 4")
    assert [d.rate_hz for d in enforce(lines, view, [link(p) for p in (1, 2, 3)])] == [4.0, 1.0, 4.0]
    own = parse("rate_hz <= 10 * peer_battery")
    assert [d.rate_hz for d in enforce(own, view, [link(p, rate_hz=20.0) for p in (1, 2, 3)])] == [9.0, 0.5, 9.0]


def test_what_a_shield_keeps_between_decisions_does_not_change_its_answers() -> None:
    """The same lines, another charge, another peer that they are about, and back."""
    rules = parse("rate_hz <= 10 * battery\nwhen peer_battery < 0.5: rho <= 0.1")
    for own, low in [(0.5, 1), (0.3, 2), (0.5, 2), (0.5, 1)]:
        view = changed(
            changed(changed(fleet_of(3), 0, battery_soc=own), low, battery_soc=0.2), 3 - low, battery_soc=0.9
        )
        after = {d.destination: d for d in enforce(rules, view, [link(p, rate_hz=9.0, rho=0.4) for p in (1, 2)])}
        assert [after[p].rate_hz for p in (1, 2)] == [10 * own, 10 * own]
        assert (after[low].rho, after[3 - low].rho) == (0.1, 0.4)


def test_a_line_over_all_links_changes_the_first_of_those_that_would_change_as_much() -> None:
    view, decided = fleet_of(4), [link(p, NONE, 0.0) for p in (1, 2, 3)]
    found = enforce(parse("any_link(representation >= detections)"), view, decided)
    assert [d.representation for d in found] == [DETECTIONS, NONE, NONE]
    conditional = enforce(parse("when battery > 0.5: any_link(rate_hz >= 2)"), view, decided)
    assert [d.rate_hz for d in conditional] == [2.0, 0.0, 0.0]
    weak = enforce(parse("any_link(peer_battery < 0.5 and rate_hz >= 2)"), changed(view, 3, battery_soc=0.4), decided)
    assert [d.rate_hz for d in weak] == [0.0, 0.0, 2.0]
    tracking = changed(fleet_of(4, phase=TaskPhase.TRACK), priority_target_ids=(7,))
    assert interventions(shield(silence, parse(HUMANE))(tracking)) == 1


def test_a_shield_asks_for_what_is_decided_at_age_0_of_all_even_of_who_is_gone() -> None:
    def hasty(view: FleetView) -> list[Directive]:
        return [link(p, rate_hz=2.0 if view.age_s[p] == 0 else 9.0) for p in view.peers]

    lines = parse("rate_hz <= fresh.rate_hz")
    assert [d.rate_hz for d in shield(hasty, lines)(aged(fleet_of(4), {3: 30.0}))] == [2.0, 2.0, 2.0]
    decided, fresh = [link(1), link(2)], [link(2)]  # a link that is not decided at age 0 carries nothing there
    assert violations(lines[0], fleet_of(4), decided, fresh) == [decided[0]]
    assert [d.rate_hz for d in enforce(lines, fleet_of(4), decided, fresh)] == [0.0, 5.0]
