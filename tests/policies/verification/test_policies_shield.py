"""The shield keeps what it is given, changes as little as can be, and says where it stepped in."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from random import Random

import pytest
from policies_examples import fleet_of, planted

from sortie.policies.catalogue.baselines import everyone, silence
from sortie.policies.catalogue.worked import worked
from sortie.policies.contract import Directive, Disc, FleetView, Policy, Representation, TaskPhase
from sortie.policies.verification.invariants.language import InvariantError, just_heard, parse, violations
from sortie.policies.verification.invariants.words import DECISIONS
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.kit.views import draw_views
from sortie.policies.verification.proof.proof import prove
from sortie.policies.verification.shield import HIGHEST, MARK, enforce, interventions, shield

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


def drops(view: FleetView) -> list[Directive]:
    """The worked policy with a fault: silent in a sliver of charge."""
    me = view.me
    tired = me is not None and 0.4 < me.battery_soc < 0.5
    return [d._replace(representation=Representation.NONE) if tired else d for d in worked(view)]


def rises_with_age(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=min(30.0, 1.0 + view.age_s[d.destination])) for d in everyone(view)]


POLICIES: dict[str, Policy] = {
    "worked": worked, "everyone": everyone, "silence": silence, "drops": drops, "rises": rises_with_age,
}  # fmt: skip


def broken(policy: Policy, text: str, view: FleetView) -> list[str]:
    directives, fresh = policy(view), policy(just_heard(view))
    return [rule.text for rule in parse(text) if violations(rule, view, directives, fresh)]


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("rules", RULES)
def test_whatever_the_policy_decides_the_shielded_one_keeps_the_rules(name: str, rules: str) -> None:
    policy, text = POLICIES[name], RULES[rules]
    shielded = shield(policy, parse(text))
    stepped_in = 0
    for view in draw_views(3, 60):
        decided = list(policy(view))
        directives = shielded(view)
        stepped_in += interventions(directives)
        kept = [d for d in directives if not d.reason.startswith(f"{MARK}cannot keep")]
        if len(kept) == len(directives):
            left = [r.text for r in parse(text) if violations(r, view, directives, policy(just_heard(view)))]
            assert not left, (left, view)
        for before, after in zip(decided, directives, strict=True):
            assert before == after or after.reason.startswith(MARK), "a change without its mark"
    assert stepped_in or not any(broken(policy, text, v) for v in draw_views(3, 60))


@pytest.mark.parametrize("rules", RULES)
def test_a_policy_that_keeps_the_rules_passes_untouched(rules: str) -> None:
    for view in draw_views(4, 60):
        if not broken(worked, RULES[rules], view):
            assert [tuple(d) for d in shield(worked, parse(RULES[rules]))(view)] == [tuple(d) for d in worked(view)]


@pytest.mark.parametrize("rules", RULES)
def test_shielding_twice_is_shielding_once(rules: str) -> None:
    once = shield(everyone, parse(RULES[rules]))
    twice = shield(once, parse(RULES[rules]))
    for view in draw_views(5, 40):
        assert [tuple(d) for d in twice(view)] == [tuple(d) for d in once(view)]


def test_the_least_is_changed() -> None:
    (one, *_) = shield(everyone, parse("rate_hz <= 2"))(fleet_of(3))
    (before, *_) = everyone(fleet_of(3))
    assert one == before._replace(rate_hz=2.0), "the rate alone, and to its bound"
    assert one.reason == f"{MARK}rate_hz <= 2 (decided features at 10 Hz: {before.reason})"
    # Either part mends it: a fraction of the rate's bounds is less than a rung's quarter.
    (either, *_) = shield(everyone, parse("representation < features or rate_hz <= 9"))(fleet_of(3))
    assert either == before._replace(rate_hz=9.0)


def test_a_rule_over_all_links_changes_one_of_them() -> None:
    view = fleet_of(4, phase=TaskPhase.TRACK)
    view = view._replace(descriptors={i: d._replace(priority_target_ids=(7,)) for i, d in view.descriptors.items()})
    directives = shield(silence, parse(HUMANE))(view)
    assert interventions(directives) == 1
    (raised,) = [d for d in directives if d.representation > Representation.NONE]
    assert raised.representation == Representation.DETECTIONS, "the lowest rung that keeps it"


def test_rules_that_contradict_each_other_leave_the_decision_and_say_so() -> None:
    directives = shield(everyone, parse("rate_hz <= 2\nrate_hz >= 5"))(fleet_of(3))
    assert all(d.rate_hz == 10 and d.reason.startswith(f"{MARK}cannot keep") for d in directives)
    of_view = shield(everyone, parse("battery > 2"))(fleet_of(3))
    assert [d.rate_hz for d in of_view] == [10, 10]
    assert all(d.reason.startswith(f"{MARK}cannot keep battery > 2") for d in of_view)


@pytest.mark.parametrize("function", ["sum_links(rate_hz) <= 5", "count_links(rate_hz > 1) <= 2", "every_link(roi)"])
def test_sums_and_counts_are_refused_where_the_shield_is_made(function: str) -> None:
    with pytest.raises(
        InvariantError, match=r"a shield cannot keep \w+_links?\(…\); `sortie verify` can only prove it"
    ):
        shield(worked, parse(function))


@pytest.mark.parametrize("rules", ["sparing", "humane", "strict"])
def test_a_shielded_policy_conforms(rules: str) -> None:
    assert not failing([c for c in conform(shield(worked, parse(RULES[rules])), count=60) if c.name != "budget kept"])


@pytest.mark.slow
def test_the_shielded_fault_is_proved_harmless() -> None:
    """The proof explores the shield together with the policy: it holds on every view, not on drawn ones alone."""
    faulty = planted("drops")
    bare = prove(faulty, parse(HUMANE), max_drones=2, views=0)[-1]
    assert bare.outcome == "refuted"
    verdicts = prove(shield(faulty, parse(HUMANE)), parse(HUMANE), max_drones=2, views=20)
    assert [v.outcome for v in verdicts] == ["proved", "proved", "proved"]


def test_no_shield_reaches_further_than_the_ladder() -> None:
    def always(view: FleetView) -> Sequence[Directive]:
        return silence(view)

    for view in draw_views(6, 60):
        for d in shield(always, parse("representation >= raw and rate_hz >= 30 and rho >= 1"))(view):
            assert (d.representation, d.rate_hz, d.rho) == (Representation.RAW, 30.0, 1.0)


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
    ]  # fmt: skip


@pytest.mark.parametrize("seed", range(20))
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


def test_lowering_a_link_does_not_make_it_send() -> None:
    (quiet,) = enforce(parse("representation <= tracks"), fleet_of(2), [Directive(0, 1, Representation.RAW)])
    assert (quiet.representation, quiet.rate_hz) == (Representation.TRACKS, 0.0)


def test_a_condition_on_the_directive_is_made_false_only_where_nothing_else_helps() -> None:
    view = fleet_of(2)
    sends = Directive(0, 1, Representation.TRACKS, rate_hz=9.0)
    (slower,) = enforce(parse("when representation > none: rate_hz <= 2"), view, [sends])
    assert (slower.representation, slower.rate_hz) == (Representation.TRACKS, 2.0)
    (silent,) = enforce(parse("when representation > none: rate_hz <= 2\nrate_hz >= 5"), view, [sends])
    assert (silent.representation, silent.rate_hz) == (Representation.NONE, 9.0)


def test_what_a_shield_keeps_between_decisions_does_not_change_its_answers() -> None:
    """The same lines, another charge, another peer that they are about, and back."""
    rules = parse("rate_hz <= 10 * battery\nwhen peer_battery < 0.5: rho <= 0.1")
    for own, low in [(0.5, 1), (0.3, 2), (0.5, 2), (0.5, 1)]:
        view = fleet_of(3)
        charge = {view.ego: own, low: 0.2, 3 - low: 0.9}
        view = view._replace(descriptors={i: d._replace(battery_soc=charge[i]) for i, d in view.descriptors.items()})
        decided = [Directive(view.ego, p, Representation.FEATURES, 0.4, rate_hz=9.0) for p in view.peers]
        after = {d.destination: d for d in enforce(rules, view, decided)}
        assert [after[p].rate_hz for p in (1, 2)] == [10 * own, 10 * own]
        assert (after[low].rho, after[3 - low].rho) == (0.1, 0.4)


def test_links_that_share_a_correction_keep_their_own_region_and_reason() -> None:
    view = fleet_of(3)
    discs = {p: Disc(1.0 * p, 0.0, 5.0) for p in view.peers}
    decided = [Directive(view.ego, p, Representation.RAW, 0.4, discs[p], 9.0, reason=f"for {p}") for p in view.peers]
    for d in enforce(parse("rate_hz <= 2"), view, decided):
        assert (d.roi, d.rate_hz) == (discs[d.destination], 2.0)
        assert d.reason.endswith(f"raw at 9 Hz: for {d.destination})")


def test_where_no_range_is_left_a_safe_directive_takes_the_place() -> None:
    sends = Directive(0, 1, Representation.TRACKS, rate_hz=5.0)
    (silent,) = enforce(parse("rate_hz * (10 - rate_hz) <= 0"), fleet_of(2), [sends])
    assert (silent.representation, silent.rate_hz) == (Representation.NONE, 0.0)
    line = "rate_hz * (2 - rate_hz) >= 0 and representation > none"
    (slow,) = enforce(parse(line), fleet_of(2), [sends])
    assert (slow.representation, slow.rate_hz) == (Representation.DETECTIONS, 2.0)
    assert slow.reason.startswith(f"{MARK}{line} (decided tracks at 5 Hz")
