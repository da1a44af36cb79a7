"""Lines about time: what is read, what a drone's past counts, and when a broken line is overdue."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_examples import fleet_of

from sortie.policies.catalogue.baselines import silence
from sortie.policies.contract import Directive, Representation
from sortie.policies.damping import DampedLink, damp, is_climb
from sortie.policies.decision_loop import Steps
from sortie.policies.verification.enforced import judge
from sortie.policies.verification.invariants.language import InvariantError, parse, violations
from sortie.policies.verification.invariants.past import Past
from sortie.policies.verification.invariants.words import TIME_WORDS, WORDS
from sortie.policies.verification.proof.proof import prove
from sortie.policies.verification.shield import check_shieldable, enforce

FRAME_S = 0.1
VIEW = fleet_of(3)


def link(rate_hz: float, peer: int = 1) -> Directive:
    rung = Representation.DETECTIONS if rate_hz else Representation.NONE
    return Directive(0, peer, rung, rate_hz=rate_hz, reason="r")


def broken_at(line: str, course: Sequence[Sequence[Directive]], dwell_s: float = 1.0) -> list[tuple[int, int]]:
    """At which decisions, by which peer (−1: all together), what is enforced breaks a line."""
    (rule,) = parse(line)
    past, found = Past([rule], dwell_s), []
    for k, enforced in enumerate(course):
        past.note(k * FRAME_S, enforced)
        links = [Steps(d, d, d) for d in enforced]
        found += [(k, v.peer) for v in judge([rule], VIEW, links, enforced, (), past)]
    return found


@pytest.mark.parametrize(
    ("line", "rates", "when"),
    [
        ("within 0.3 s: rate_hz >= 5", "5 0 0 0 5", []),  # broken from 0.1 s to 0.4 s: exactly 0.3 s
        ("within 0.3 s: rate_hz >= 5", "5 0 0 0 0 5", [5]),  # 0.4 s; known at the decision that ends it
        ("within 0.3 s: rate_hz >= 5", "5 0 0 0 0 0 0 5", [5, 6, 7]),
        ("within 0.3 s: rate_hz >= 5", "0 0 5 0 0 5 0 0", []),  # each break is short
        ("within 0.25 s: rate_hz >= 5", "0 0 0 5", [3]),
        ("within dwell: rate_hz >= 5", "0 " * 11, []),
        ("within dwell: rate_hz >= 5", "0 " * 12, [11]),
        ("when rate_hz != 2: within 0.2 s: rate_hz >= 5", "0 0 2 0 0 2", []),  # the condition ends
        ("climbs_in(0.3) <= 1", "0 2 5 5 5 10", [2, 3]),
        ("climbs_in(0.3) <= 1", "0 2 2 2 5", []),  # exactly 0.3 s apart
        ("climbs_in(0.3) <= 1", "2 0 5 0 5", [2, 4]),  # the first one is a climb from nothing
        ("climbs_in(1) <= 2", "2 1 2 1 2 1", [4, 5]),
        ("switches_in(1) <= 2", "2 1 2 2 2 2", [2, 3, 4, 5]),
    ],
)
def test_what_a_line_about_time_means(line: str, rates: str, when: list[int]) -> None:
    course = [[link(float(r)), link(5, 2)] for r in rates.split()]
    assert broken_at(line, course) == [(k, 1) for k in when]


def test_a_line_over_all_links_is_broken_by_them_together() -> None:
    course = [[link(0), link(5, 2)]] * 2 + [[link(0), link(0, 2)]] * 5
    assert broken_at("within 0.2 s: any_link(rate_hz > 0)", course) == [(5, -1), (6, -1)]


def test_each_break_names_the_step_that_caused_it() -> None:
    (rule,) = parse("within 0.1 s: rate_hz >= 5")
    past, causes = Past([rule], 1.0), []
    for k, (asked, by_age, damped) in enumerate([(2, 2, 2), (2, 2, 2), (2, 2, 2), (5, 2, 2), (5, 5, 2), (5, 5, 5)]):
        enforced = [link(damped)]
        past.note(k * FRAME_S, enforced)
        steps = [Steps(link(asked), link(by_age), enforced[0])]
        causes.append([v.cause for v in judge([rule], VIEW, steps, enforced, (), past)])
    assert causes == [[], [], ["policy"], ["staleness"], ["damping"], ["damping"]]


@given(st.lists(st.sampled_from([0.0, 2.0, 5.0, 10.0]), min_size=1, max_size=60), st.sampled_from([0.3, 1.0]))
@settings(max_examples=60, deadline=None)
def test_damping_lets_a_link_climb_once_in_a_dwell_time(rates: list[float], dwell_s: float) -> None:
    state, course = DampedLink(link(0)), []
    for k, rate_hz in enumerate(rates):
        state = damp(state, link(rate_hz), k * FRAME_S, dwell_s)
        course.append([state.enforced])
    assert broken_at("climbs_in(dwell) <= 1", course, dwell_s) == []


def test_what_is_a_climb() -> None:
    features = Directive(0, 1, Representation.FEATURES, 0.5, None, 5.0)
    assert is_climb(link(2), features)
    assert is_climb(features, features._replace(fusion_weight=1.0, rate_hz=6.0))
    assert not is_climb(features, link(2))
    assert is_climb(features, link(10)), "fewer bytes, but a higher rate"
    assert not is_climb(features, features._replace(deadline_s=5.0))
    assert not is_climb(link(0), link(0)._replace(rate_hz=3.0)), "nothing is sent"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("within 0.5: rate_hz > 0", "a time ends with `s` and a colon"),
        ("within 0.5 s rate_hz > 0", "a time ends with `s` and a colon"),
        ("within 0 s: rate_hz > 0", "the time '0' must be in [0.001, 3600] s, or dwell"),
        ("within -1 s: rate_hz > 0", "the time '-1' must be in"),
        ("within nan s: rate_hz > 0", "the time 'nan' must be in"),
        ("climbs_in(battery) <= 1", "the time 'battery' must be in"),
        ("climbs_in() <= 1", "'climbs_in()' is not allowed"),
        ("climbs_in(1)", "is a number, must be true or false"),
        ("climbs_in <= 1", "unknown word 'climbs_in'"),
        ("when truck: rate_hz > 0", "unknown word 'truck' (no descriptor says whether a truck was seen), known:"),
        ("when car: rate_hz > 0", "unknown word 'car' (`targets` are cars), known:"),
        ("when person: rate_hz > 0", "unknown word 'person' (a person is `human`), known:"),
    ],
)
def test_what_is_refused(line: str, message: str) -> None:
    with pytest.raises(InvariantError) as caught:
        parse(line)
    assert message in str(caught.value)


def test_a_count_cannot_be_judged_on_one_view_nor_shielded() -> None:
    (rule,) = parse("climbs_in(1) <= 1")
    with pytest.raises(InvariantError, match=r"climbs_in\(…\) is about time: a single view does not decide it"):
        violations(rule, VIEW, [link(2)])
    with pytest.raises(InvariantError, match=r"a shield cannot keep climbs_in\(…\)"):
        check_shieldable([rule])


def test_a_shield_keeps_a_time_at_once() -> None:
    rules = check_shieldable(parse("within 0.5 s: rate_hz >= 5"))
    assert [d.rate_hz for d in enforce(rules, VIEW, [link(2)])] == [5.0]


@pytest.mark.parametrize("word", WORDS)
def test_the_example_of_a_word_uses_it(word: str) -> None:
    example = WORDS[word].example
    (rule,) = parse(example)
    assert any(getattr(node, "word", "") == word for node in rule.nodes), example


@pytest.mark.parametrize("word", TIME_WORDS)
def test_the_example_of_a_word_about_time_uses_it(word: str) -> None:
    (rule,) = parse(TIME_WORDS[word][1])
    assert rule.over_time
    assert word.partition(" ")[0].partition("(")[0] in rule.text


@pytest.mark.parametrize("line", ["within 0.5 s: rate_hz > 0", "climbs_in(1) <= 1"])
def test_a_line_about_time_is_not_proved_from_views(line: str) -> None:
    with pytest.raises(InvariantError, match="is about time: a single view does not decide it"):
        prove(silence, parse(line), max_drones=1, views=0)
