"""The language of invariants: what its lines mean, and what it refuses to read."""

from __future__ import annotations

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import Directive, Disc, FleetView, Representation, TaskPhase
from sortie.policies.verification.invariants.language import InvariantError, just_heard, parse, violations
from sortie.policies.verification.invariants.words import WORDS

VIEW = fleet_of(3, soc=0.2, goodput=4.0)
SHARED = [
    Directive(0, 1, Representation.FEATURES, 0.25, Disc(0, 0, 5), 10.0, 0.2, 0.5, 40, "one"),
    Directive(0, 2, Representation.NONE, reason="two"),
]


def broken(line: str, view: FleetView = VIEW, directives: list[Directive] = SHARED) -> list[int | None]:
    (invariant,) = parse(line)
    return [None if d is None else d.destination for d in violations(invariant, view, directives, directives)]


@pytest.mark.parametrize(
    ("line", "links"),
    [
        ("rate_hz <= 5", [1]),
        ("rate_hz > 0", [2]),
        ("when battery < 0.2: rate_hz <= 5", []),
        ("when battery <= 0.2: rate_hz <= 5", [1]),
        ("when goodput_mbps < 5 and not roi: representation >= detections", [2]),
        ("representation == features or representation == none", []),
        ("0.3 < duty <= 0.5", [2]),
        ("rho * 4 - 1 != 0", [1]),
        ("-rho / 0 < 1", [1, 2]),  # a division by zero is infinite
        ("deadline_s <= 0.1 and fusion_weight == 1", [1]),
        ("any_link(representation >= detections)", []),
        ("every_link(representation >= detections)", [None]),
        ("count_links(roi) == 1", []),
        ("sum_links(rate_hz) < 10", [None]),
        ("when peers == 2: any_link(rate_hz > 20)", [None]),
        ("when age_periods > 3: rate_hz <= 2", []),
        ("age_s == 0.1 and age_periods == 1 and peer_battery == 0.2", []),
        ("rate_hz <= fresh.rate_hz", []),
        ("rate_hz < fresh.rate_hz", [1, 2]),
        ("phase == track", [None]),
        ("phase == search and cpu == 1 and gpu == 1 and not region and not targets", []),
        ("when not region: rate_hz == 10 and count_links(roi) == 1", [2]),
        ("when rate_hz > 5: battery > 0.3", [1]),  # the condition alone is of a link
        ("when goodput_mbps < 5: battery > 0.3", [1, 2]),
        ("when rate_hz > 5: peers == 2", []),
    ],
)
def test_what_a_line_means(line: str, links: list[int | None]) -> None:
    assert broken(line) == links


def test_a_target_in_the_region_needs_both() -> None:
    line = "when target_in_region: any_link(rate_hz > 20)"
    tracking = fleet_of(3, phase=TaskPhase.TRACK)
    assert broken(line, tracking) == []
    mine = tracking.descriptors[0]._replace(priority_target_ids=(7,))
    assert broken(line, tracking._replace(descriptors={**tracking.descriptors, 0: mine})) == [None]
    mine = mine._replace(region=None)
    assert broken(line, tracking._replace(descriptors={**tracking.descriptors, 0: mine})) == []


def test_old_descriptors_by_periods() -> None:
    old = VIEW._replace(age_s={0: 0.0, 1: 0.31, 2: 0.3})
    assert broken("when age_periods > 3: rate_hz <= 2", old) == [1]
    assert set(just_heard(old).age_s.values()) == {0.0}


def test_nothing_is_asked_of_an_empty_view() -> None:
    assert broken("phase == track", FleetView(0, 0.1, {}, {}), []) == []


def test_a_text_has_a_line_each_and_comments() -> None:
    text = "# first\n\nrate_hz <= 5  # not more\nwhen battery < 0.3: rho == 0\n"
    assert [i.text for i in parse(text)] == ["rate_hz <= 5", "when battery < 0.3: rho == 0"]
    assert parse(text) == parse(text)
    assert hash(parse(text))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("rate_hz", "'rate_hz' is a number, must be true or false"),
        ("when humans: roi", "unknown word 'humans', known: battery, cpu"),
        ("when battery < 0.3 rate_hz <= 2", "a condition ends with a colon"),
        ("rate_hz <=", "'rate_hz <=' is not an expression"),
        ("roi < 3", "'roi' must be a number"),
        ("not rate_hz", "'rate_hz' must be true or false"),
        ("rate_hz ** 2 > 1", "'rate_hz ** 2' is not allowed in an invariant"),
        ("any_link(any_link(roi))", "any_link(…) has another function over links inside"),
        ("sum_links(roi) > 1", "'roi' must be a number"),
        ("fresh.battery > 1", "'fresh.battery' is not allowed"),
        ("rate_hz <= previous.rate_hz", "'previous.rate_hz' is not allowed"),
        ("__import__('os').remove('x')", "is not allowed in an invariant"),
        ("(lambda: 1)() > 0", "is not allowed in an invariant"),
        ("battery.__class__ == 1", "is not allowed in an invariant"),
        ("[r for r in rho] == 1", "is not allowed in an invariant"),
        ("True", "'True' is not allowed"),
        ("'a' == 'b'", "is not allowed"),
        ("(" * 500 + "roi" + ")" * 500, "is not an expression"),
        ("rate_hz <= " + "9" * 400, "a number is too large for a float"),
        ("rate_hz <= 1e999", "a number is too large for a float"),
    ],
)
def test_what_is_refused(line: str, message: str) -> None:
    with pytest.raises(InvariantError) as caught:
        parse(f"\n{line}")
    assert message in str(caught.value)
    assert str(caught.value).startswith("line 2, ")


def test_every_word_is_explained() -> None:
    assert all(word.about for word in WORDS.values())
