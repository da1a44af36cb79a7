"""Several lines about several links: a shield keeps them together, or names those that it cannot keep."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from random import Random

from hypothesis import example, given, settings
from hypothesis import strategies as st
from policies_examples import changed, fleet_of

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.verification.invariants.language import parse, violations
from sortie.policies.verification.shield import MARK, enforce

RUNGS, RATES_HZ, WEIGHTS = (0, 1, 2), (0.0, 2.0, 5.0, 10.0), (0.2, 1.0)
CANNOT = f"{MARK}cannot keep "
BOUNDED: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("representation", RUNGS),
    ("rate_hz", RATES_HZ),
    ("fusion_weight", WEIGHTS),
)
ONE_TIRED = changed(fleet_of(3), 1, battery_soc=0.1)


def link(peer: int, rung: int, rate_hz: float, weight: float = 1.0) -> Directive:
    return Directive(0, peer, Representation(rung), 0.0, None, rate_hz, 0.1, weight, reason="decided")


def a_bound(draw: Random) -> str:
    word, values = draw.choice(BOUNDED)
    return f"{word} {draw.choice(('<=', '>=', '=='))} {draw.choice(values):g}"


def a_condition(draw: Random) -> str:
    return draw.choice((a_bound(draw), f"{a_bound(draw)} and {a_bound(draw)}", f"({a_bound(draw)} or {a_bound(draw)})"))


def plain_lines(draw: Random) -> list[str]:
    """Lines that one link each can keep."""
    kinds = (
        lambda: f"any_link({a_condition(draw)})",
        lambda: f"any_link({a_bound(draw)}) or any_link({a_bound(draw)})",
        lambda: f"{a_bound(draw)} or {a_bound(draw)}",
    )
    return [draw.choice(kinds)() for _ in range(draw.randint(2, 4))]


def mixed_lines(draw: Random) -> list[str]:
    """Lines in which one link counts for another one, too."""
    kinds = (
        lambda: f"any_link({a_condition(draw)})",
        lambda: a_bound(draw),
        lambda: f"{a_bound(draw)} or any_link({a_condition(draw)})",
        lambda: f"not any_link({a_condition(draw)})",
        lambda: f"when any_link({a_bound(draw)}): {a_bound(draw)}",
        lambda: f"when not any_link({a_bound(draw)}): any_link({a_bound(draw)})",
    )
    return [draw.choice(kinds)() for _ in range(draw.randint(2, 4))]


def some_links(draw: Random) -> list[Directive]:
    peers = range(1, draw.choice((3, 3, 4)))
    return [link(peer, draw.choice(RUNGS), draw.choice(RATES_HZ), draw.choice(WEIGHTS)) for peer in peers]


def shielded(lines: Sequence[str], decided: Sequence[Directive], view: FleetView | None = None) -> list[Directive]:
    return enforce(parse("\n".join(lines)), view or fleet_of(len(decided) + 1), decided)


def keeps_all(lines: Sequence[str], directives: Sequence[Directive]) -> bool:
    view = fleet_of(len(directives) + 1)
    return not any(violations(rule, view, directives) for rule in parse("\n".join(lines)))


@settings(max_examples=100)
@given(st.integers(0, 2**32), st.sampled_from([plain_lines, mixed_lines]))
def test_after_the_shield_every_line_holds_or_is_named(seed: int, some_lines) -> None:  # type: ignore[no-untyped-def]
    draw = Random(seed)
    lines, decided = some_lines(draw), some_links(draw)
    outcomes, view = set(), fleet_of(len(decided) + 1)
    for order in itertools.permutations(lines):
        directives = shielded(order, decided)
        for rule in parse("\n".join(order)):
            for breaks in violations(rule, view, directives):
                for d in directives if breaks is None else [breaks]:
                    assert d.reason.startswith(CANNOT), (order, decided)
                    assert rule.text in d.reason, (order, decided)
        kept = keeps_all(order, directives)
        assert not kept or not any(d.reason.startswith(CANNOT) for d in directives), (order, decided)
        again = shielded(order, directives)
        assert [tuple(d) for d in again] == [tuple(d) for d in directives], (order, decided)
        outcomes.add(kept)
    assert len(outcomes) == 1, f"the order decides: {lines}, {decided}"


@settings(max_examples=80)
@given(st.integers(0, 2**32))
@example(3082)  # the nearest way to keep the last line alone bars the second one
def test_lines_that_some_directives_keep_are_all_kept(seed: int) -> None:
    """Compared with every combination of the values that the lines name, for two links."""
    draw = Random(seed)
    lines, decided = plain_lines(draw), some_links(draw)[:2]
    if keeps_all(lines, shielded(lines, decided)):
        return
    each = [[link(d.destination, *v) for v in itertools.product(RUNGS, RATES_HZ, WEIGHTS)] for d in decided]
    assert not any(keeps_all(lines, links) for links in itertools.product(*each)), (lines, decided)


def test_a_link_that_keeps_one_line_is_not_taken_for_another_line() -> None:
    lines, decided = ["any_link(rate_hz >= 5)", "any_link(rate_hz == 4)"], [link(1, 2, 5.0), link(2, 2, 3.0)]
    for order in (lines, lines[::-1]):
        assert [d.rate_hz for d in shielded(order, decided)] == [5.0, 4.0]
    lines = ["any_link(rate_hz == 8)", "any_link(rate_hz == 9 and peer_battery < 0.5)"]
    view, decided = changed(fleet_of(4), 1, battery_soc=0.1), [link(1, 2, 10.0), link(2, 2, 2.0), link(3, 2, 2.0)]
    for order in (lines, lines[::-1]):  # a link passes a line on to another one that can keep it
        assert [d.rate_hz for d in shielded(order, decided, view)] == [9.0, 8.0, 2.0]


def test_a_line_is_judged_again_after_other_links_have_changed() -> None:
    lines = ["representation >= detections or any_link(rate_hz >= 5)", "rate_hz <= 4"]
    first, second = shielded(lines, [link(1, 1, 2.0), link(2, 2, 10.0)])
    assert (first.representation, first.rate_hz, second.rate_hz) == (Representation.DETECTIONS, 2.0, 4.0)
    assert first.reason.startswith(f"{MARK}{lines[0]} (decided tracks at 2 Hz")


def test_a_reason_names_what_was_decided_and_all_lines_that_changed_it_or_cannot_be_kept() -> None:
    lines = ["rate_hz <= 4", "any_link(fusion_weight == 1)", "when any_link(rate_hz >= 2): representation == tracks"]
    (after,) = shielded(lines, [link(1, 2, 10.0, 0.2)])
    assert (after.representation, after.rate_hz, after.fusion_weight) == (Representation.TRACKS, 4.0, 1.0)
    assert after.reason == f"{MARK}{lines[0]}; {lines[1]}; {lines[2]} (decided detections at 10 Hz: decided)"
    directives = shielded(["battery > 2", "rate_hz <= 2", "rate_hz >= 5"], [link(1, 2, 3.0), link(2, 2, 6.0)])
    assert [d.reason for d in directives] == [
        f"{CANNOT}battery > 2; rate_hz <= 2; rate_hz >= 5 (decided)",
        f"{CANNOT}battery > 2; rate_hz <= 2 (decided)",
    ]


def test_alike_links_to_which_different_lines_apply_are_each_tried() -> None:
    """Both links have the same directive. Only that whose peer has charge left may be raised."""
    alike = [link(1, 2, 2.0), link(2, 2, 2.0)]
    for lines in (
        ["any_link(rate_hz >= 5)", "not any_link(rate_hz >= 5 and peer_battery < 0.5)"],
        ["when peer_battery < 0.5: rate_hz <= 2", "any_link(rate_hz >= 5)"],
    ):
        assert [d.rate_hz for d in shielded(lines, alike, ONE_TIRED)] == [2.0, 5.0]


def test_a_line_about_one_link_comes_before_a_line_about_several() -> None:
    lines = ["representation >= detections or any_link(representation >= detections)", "representation <= tracks"]
    for order in (lines, lines[::-1]):
        directives = shielded(order, [link(1, 2, 5.0), link(2, 0, 0.0)])
        assert [int(d.representation) for d in directives] == [1, 0]
        assert all(d.reason.startswith(f"{CANNOT}{lines[0]} (") for d in directives)
