"""The language of invariants: what its lines mean, also about time, and what it refuses to read."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_examples import changed, fleet_of

from sortie.policies.catalogue.baselines import silence
from sortie.policies.contract import PERSON_FLAG, Directive, Disc, FleetView, Representation, TaskPhase
from sortie.policies.damping import DampedLink, damp
from sortie.policies.decision_loop import Steps
from sortie.policies.verification.enforced import judge
from sortie.policies.verification.invariants.language import InvariantError, Scope, just_heard, parse, violations
from sortie.policies.verification.invariants.past import Past
from sortie.policies.verification.invariants.words import TIME_WORDS, WORDS
from sortie.policies.verification.proof.proof import prove
from sortie.policies.verification.shield import check_shieldable, enforce

VIEW = fleet_of(3, soc=0.2, goodput=4.0)
SHARED = [
    Directive(0, 1, Representation.FEATURES, 0.25, Disc(0, 0, 5), 10.0, 0.2, 0.5, 40, "one"),
    Directive(0, 2, Representation.NONE, reason="two"),
]


def broken(line: str, view: FleetView = VIEW, directives: list[Directive] = SHARED) -> list[int | None]:
    (invariant,) = parse(line)
    return [None if d is None else d.destination for d in violations(invariant, view, directives, directives)]


MEANINGS: dict[str, list[int | None]] = {
    "rate_hz <= 5": [1],
    "rate_hz > 0": [2],
    "when battery < 0.2: rate_hz <= 5": [],
    "when battery <= 0.2: rate_hz <= 5": [1],
    "when goodput_mbps < 5 and not roi: representation >= detections": [2],
    "representation == features or representation == none": [],
    "0.3 < duty <= 0.5": [2],
    "rho * 4 - 1 != 0": [1],
    "-rho / 0 < 1": [1, 2],  # a division by zero is infinite
    "deadline_s <= 0.1 and fusion_weight == 1": [1],
    "any_link(representation >= detections)": [],
    "every_link(representation >= detections)": [None],
    "count_links(roi) == 1": [],
    "sum_links(rate_hz) < 10": [None],
    "when peers == 2: any_link(rate_hz > 20)": [None],
    "when age_periods > 3: rate_hz <= 2": [],
    "age_s == 0.1 and age_periods == 1 and peer_battery == 0.2": [],
    "rate_hz <= fresh.rate_hz": [],
    "rate_hz < fresh.rate_hz": [1, 2],
    "phase == track": [None],
    "phase == search and cpu == 1 and gpu == 1 and not region and not targets": [],
    "when not region: rate_hz == 10 and count_links(roi) == 1": [2],
    "when rate_hz > 5: battery > 0.3": [1],  # the condition alone is of a link
    "when goodput_mbps < 5: battery > 0.3": [1, 2],
    "when rate_hz > 5: peers == 2": [],
}
"""Which links break a line; None: all of them together."""


def test_what_a_line_means() -> None:
    assert {line: broken(line) for line in MEANINGS} == MEANINGS
    assert broken("phase == track", FleetView(0, 0.1, {}, {}), []) == [], "nothing is asked of an empty view"
    old = VIEW._replace(age_s={0: 0.0, 1: 0.31, 2: 0.3})
    assert broken("when age_periods > 3: rate_hz <= 2", old) == [1]
    assert set(just_heard(old).age_s.values()) == {0.0}


def test_a_target_in_the_region_needs_both() -> None:
    line = "when target_in_region: any_link(rate_hz > 20)"
    tracking = fleet_of(3, phase=TaskPhase.TRACK)
    assert broken(line, tracking) == []
    assert broken(line, changed(tracking, 0, priority_target_ids=(7,))) == [None]
    assert broken(line, changed(tracking, 0, priority_target_ids=(7,), region=None)) == []


def test_a_text_has_a_line_each_and_comments() -> None:
    text = "# first\n\nrate_hz <= 5  # not more\nwhen battery < 0.3: rho == 0\n"
    assert [i.text for i in parse(text)] == ["rate_hz <= 5", "when battery < 0.3: rho == 0"]
    assert parse(text) == parse(text)
    assert hash(parse(text))


def test_every_word_reads_whose_it_is() -> None:
    state = {"battery_soc": 0.1, "cpu_headroom": 0.2, "gpu_headroom": 0.3, "task_phase": TaskPhase.RETURN}
    more = {"novelty_flags": PERSON_FLAG | 1, "priority_target_ids": (5,), "codebook": "c", "feature_space": "a"}
    view = changed(fleet_of(3), 0, peer_goodput_mbps=(11.0, 12.0), region=None, **state, **more)
    other = {"battery_soc": 0.4, "cpu_headroom": 0.5, "gpu_headroom": 0.6, "task_phase": TaskPhase.LANDING}
    spaces = {"region": Disc(0, 0, 5), "novelty_flags": 3, "feature_space": "a", "codebook": "d"}
    view = changed(view, 1, peer_goodput_mbps=(21.0, 22.0), **other, **spaces)
    view = view._replace(period_s=0.2, age_s={0: 0.0, 1: 0.5, 2: 2.1})
    link = Directive(0, 1, Representation.CODES, 0.25, None, 7.0, 0.5, 0.75, 40)
    scope = Scope(view, view.descriptors[0], [link], {}, link)
    known = {name: word.value(scope) for name, word in WORDS.items()}
    own = {"battery": 0.1, "cpu": 0.2, "gpu": 0.3, "phase": TaskPhase.RETURN, "peers": 1, "region": False}
    own |= {"targets": True, "target_in_region": False, "human": True, "human_in_region": False}
    of_peer = {"goodput_mbps": 11.0, "age_s": 0.5, "age_periods": 2.5, "peer_battery": 0.4, "peer_human": False}
    of_peer |= {"peer_phase": TaskPhase.LANDING, "same_network": True, "same_codebook": False}
    of_link = {"rho": 0.25, "rate_hz": 7.0, "deadline_s": 0.5, "fusion_weight": 0.75, "duty": 0.4, "roi": False}
    assert known == {**own, **of_peer, **of_link, "representation": known["representation"]}


REFUSED = {
    "rate_hz": "'rate_hz' is a number, must be true or false",
    "when humans: roi": "unknown word 'humans', known: battery, cpu",
    "when battery < 0.3 rate_hz <= 2": "a condition ends with a colon",
    "rate_hz <=": "'rate_hz <=' is not an expression",
    "roi < 3": "'roi' must be a number",
    "not rate_hz": "'rate_hz' must be true or false",
    "rate_hz ** 2 > 1": "'rate_hz ** 2' is not allowed in an invariant",
    "any_link(any_link(roi))": "any_link(…) has another function over links inside",
    "sum_links(roi) > 1": "'roi' must be a number",
    "fresh.battery > 1": "'fresh.battery' is not allowed",
    "rate_hz <= previous.rate_hz": "'previous.rate_hz' is not allowed",
    "__import__('os').remove('x')": "is not allowed in an invariant",
    "(lambda: 1)() > 0": "is not allowed in an invariant",
    "battery.__class__ == 1": "is not allowed in an invariant",
    "[r for r in rho] == 1": "is not allowed in an invariant",
    "True": "'True' is not allowed",
    "'a' == 'b'": "is not allowed",
    "(" * 500 + "roi" + ")" * 500: "is not an expression",
    "rate_hz <= " + "9" * 400: "a number is too large for a float",
    "rate_hz <= 1e999": "a number is too large for a float",
    "within 0.5: rate_hz > 0": "a time ends with `s` and a colon",
    "within 0.5 s rate_hz > 0": "a time ends with `s` and a colon",
    "within 0 s: rate_hz > 0": "the time '0' must be in [0.001, 3600] s, or dwell",
    "within -1 s: rate_hz > 0": "the time '-1' must be in",
    "within nan s: rate_hz > 0": "the time 'nan' must be in",
    "climbs_in(battery) <= 1": "the time 'battery' must be in",
    "climbs_in() <= 1": "'climbs_in()' is not allowed",
    "climbs_in(1)": "is a number, must be true or false",
    "climbs_in <= 1": "unknown word 'climbs_in'",
    "when truck: rate_hz > 0": "unknown word 'truck' (no descriptor says whether a truck was seen), known:",
    "when car: rate_hz > 0": "unknown word 'car' (`targets` are cars), known:",
    "when person: rate_hz > 0": "unknown word 'person' (a person is `human`), known:",
}


def test_what_is_refused() -> None:
    wrong = {}
    for line, message in REFUSED.items():
        with pytest.raises(InvariantError) as caught:
            parse(f"\n{line}")
        if message not in str(caught.value) or not str(caught.value).startswith("line 2, "):
            wrong[line] = str(caught.value)
    assert wrong == {}


def test_every_word_is_explained_and_its_example_uses_it() -> None:
    for name, word in WORDS.items():
        (rule,) = parse(word.example)
        assert word.about, name
        assert any(getattr(node, "word", "") == name for node in rule.nodes), word.example
    for name, (_, example, *_) in TIME_WORDS.items():
        (rule,) = parse(example)
        assert rule.over_time, name
        assert name.partition(" ")[0].partition("(")[0] in rule.text


# --- lines about time -----------------------------------------------------------------------------


def link(rate_hz: float, peer: int = 1) -> Directive:
    rung = Representation.DETECTIONS if rate_hz else Representation.NONE
    return Directive(0, peer, rung, rate_hz=rate_hz, reason="r")


def broken_at(lines: str, course: Sequence[Sequence[Directive]], dwell_s: float = 1.0) -> list[tuple[str, int, int]]:
    """Which line, at which decisions, by which peer (−1: all together) is broken by what is enforced."""
    rules = parse(lines)
    past, found = Past(rules, dwell_s), []
    for k, enforced in enumerate(course):
        past.note(k * 0.1, enforced)
        steps = [Steps(d, d, d) for d in enforced]
        found += [(v.line, k, v.peer) for v in judge(rules, VIEW, steps, enforced, (), past)]
    return found


TIMES: list[tuple[str, str, list[int]]] = [
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
]
"""A line, the rates of one link every 0.1 s, and at which decisions it is broken."""


def test_what_a_line_about_time_means() -> None:
    wrong = {}
    for line, rates, when in TIMES:
        found = broken_at(line, [[link(float(r)), link(5, 2)] for r in rates.split()])
        if found != [(line, k, 1) for k in when]:
            wrong[line, rates] = found
    assert wrong == {}
    course = [[link(0), link(5, 2)]] * 2 + [[link(0), link(0, 2)]] * 5
    together = "within 0.2 s: any_link(rate_hz > 0)"
    assert broken_at(together, course) == [(together, 5, -1), (together, 6, -1)]


def test_lines_about_time_count_the_same_in_any_order() -> None:
    """A short time does not make a longer one forget."""
    lines = ["climbs_in(0.3) <= 1", "climbs_in(1) <= 2", "switches_in(0.2) <= 1"]
    course = [[link(float(rate_hz))] for rate_hz in (1, 2, 1, 2, 1, 2, 2, 2, 2, 5)]
    alone = {line: broken_at(line, course) for line in lines}
    for order in (lines, lines[::-1], lines[1:] + lines[:1]):
        found = broken_at("\n".join(order), course)
        assert {line: [f for f in found if f[0] == line] for line in lines} == alone
    assert any(alone.values())


def test_each_break_names_the_step_that_caused_it() -> None:
    rules = parse("within 0.1 s: rate_hz >= 5")
    past, causes = Past(rules, 1.0), []
    for k, (asked, by_age, damped) in enumerate([(2, 2, 2), (2, 2, 2), (2, 2, 2), (5, 2, 2), (5, 5, 2), (5, 5, 5)]):
        past.note(k * 0.1, [link(damped)])
        steps = [Steps(link(asked), link(by_age), link(damped))]
        causes.append([v.cause for v in judge(rules, VIEW, steps, [link(damped)], (), past)])
    assert causes == [[], [], ["policy"], ["staleness"], ["damping"], ["damping"]]


@given(st.lists(st.sampled_from([0.0, 2.0, 5.0, 10.0]), min_size=1, max_size=60), st.sampled_from([0.3, 1.0]))
@settings(max_examples=60)
def test_damping_lets_a_link_climb_once_in_a_dwell_time(rates: list[float], dwell_s: float) -> None:
    state, course = DampedLink(link(0)), []
    for k, rate_hz in enumerate(rates):
        state = damp(state, link(rate_hz), k * 0.1, dwell_s)
        course.append([state.enforced])
    assert broken_at("climbs_in(dwell) <= 1", course, dwell_s) == []


def test_a_line_about_time_is_not_judged_on_one_view_and_a_shield_keeps_a_time_at_once() -> None:
    (rule,) = parse("climbs_in(1) <= 1")
    with pytest.raises(InvariantError, match=r"climbs_in\(…\) is about time: a single view does not decide it"):
        violations(rule, VIEW, [link(2)])
    with pytest.raises(InvariantError, match=r"a shield cannot keep climbs_in\(…\)"):
        check_shieldable([rule])
    for line in ("within 0.5 s: rate_hz > 0", "climbs_in(1) <= 1"):
        with pytest.raises(InvariantError, match="is about time: a single view does not decide it"):
            prove(silence, parse(line), max_drones=1, views=0)
    rules = check_shieldable(parse("within 0.5 s: rate_hz >= 5"))
    assert [d.rate_hz for d in enforce(rules, VIEW, [link(2)])] == [5.0]
