"""Representations: their order, their numbers in messages, who reads them, and how invariants use the order."""

from __future__ import annotations

import pytest
from fleet_examples import DESCRIPTOR

from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.wire import (
    decode_directive,
    encode_directive,
)
from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, FleetView, PolicyError, Representation, boxes_across_networks
from sortie.policies.damping import DampedLink, damp, lower_of
from sortie.policies.verification.invariants.language import parse, violations
from sortie.policies.verification.shield import shield
from sortie.scenarios.representation import MAPS, NAME_OF, REPRESENTATION_OF

R = Representation
CODES = Directive(0, 1, R.CODES, 0.05, None, 10.0)
BOXES = Directive(0, 1, R.UNCERTAIN_BOXES, 0.0, None, 10.0)


def test_the_order_is_by_fidelity_and_older_numbers_stay() -> None:
    order = [R.NONE, R.TRACKS, R.DETECTIONS, R.UNCERTAIN_BOXES, R.CODES, R.FEATURES, R.RAW]
    assert sorted(R, key=lambda r: r.level) == sorted(R) == list(R) == order == list(REPRESENTATION_OF.values())
    assert [int(r) for r in order] == [0, 1, 2, 5, 6, 3, 4]
    for i, a in enumerate(order):
        for j, b in enumerate(order):
            assert (a < b, a <= b, a > b, a >= b, a == b) == (i < j, i <= j, i > j, i >= j, i == j)
    assert min(R.CODES, R.DETECTIONS) is R.DETECTIONS
    assert max(R) is R.RAW
    # a plain number is a level: of the first five it is the number on the wire, as before there were others
    assert 2 < R.UNCERTAIN_BOXES < R.CODES < 3
    assert R.FEATURES == 3 <= R.FEATURES
    assert R.CODES in MAPS
    assert R.UNCERTAIN_BOXES not in MAPS
    with pytest.raises(TypeError):
        R.CODES < "features"  # type: ignore[operator]  # noqa: B015


def test_directives_carry_their_number() -> None:
    for rung, number in ((R.UNCERTAIN_BOXES, 5), (R.CODES, 6), (R.FEATURES, 3)):
        data = encode_directive(CODES._replace(representation=rung))
        assert data[6] == number
        assert decode_directive(data).representation is rung
    with pytest.raises(MalformedDatagram, match=r"representation is 7, must be in \[0, 6\]"):
        decode_directive(data[:6] + b"\7" + data[7:])


def view(**of_peer: str) -> FleetView:
    heard = {0: DESCRIPTOR._replace(agent_id=0), 1: DESCRIPTOR._replace(agent_id=1, **of_peer)}
    return FleetView(0, 0.1, heard, {0: 0.0, 1: 0.0})


def test_a_policy_can_ask_who_reads_its_codes_and_have_boxes_sent_to_others() -> None:
    other = view(codebook="0" * 14)
    assert view().shares_codes_with(1)
    assert not other.shares_codes_with(1)
    assert other.shares_features_with(1)
    assert not view(feature_space="net-b").shares_codes_with(1)
    policy = boxes_across_networks(lambda _: [CODES])
    assert policy(view())[0] is CODES
    assert policy(other)[0].representation is R.DETECTIONS
    assert policy(other)[0].rho == 0.0
    features = boxes_across_networks(lambda _: [CODES._replace(representation=R.FEATURES)])
    assert features(other)[0].representation is R.FEATURES


def test_damping_takes_steps_down_at_once_and_lets_steps_up_wait() -> None:
    features = CODES._replace(representation=R.FEATURES, rho=0.02)
    assert lower_of(features, CODES) == CODES  # another rung's share of cells does not bound this one's
    assert lower_of(CODES, features) == CODES
    assert lower_of(CODES, BOXES) == BOXES
    detections = BOXES._replace(representation=R.DETECTIONS)
    assert damp(DampedLink(BOXES), detections, 0.0, 1.0).enforced == detections
    waiting = damp(DampedLink(detections), BOXES, 0.0, 1.0)
    assert waiting.enforced == detections
    assert damp(waiting, BOXES, 1.0, 1.0).enforced == BOXES


INVARIANTS: list[tuple[str, set[Representation]]] = [
    ("representation >= detections", {R.DETECTIONS, R.UNCERTAIN_BOXES, R.CODES, R.FEATURES, R.RAW}),
    ("representation <= detections", {R.NONE, R.TRACKS, R.DETECTIONS}),
    ("representation < features", {R.NONE, R.TRACKS, R.DETECTIONS, R.UNCERTAIN_BOXES, R.CODES}),
    ("representation == codes", {R.CODES}),
    ("representation >= uncertain_boxes", {R.UNCERTAIN_BOXES, R.CODES, R.FEATURES, R.RAW}),
    ("representation != features", set(R) - {R.FEATURES}),
]


def test_invariants_read_the_order_and_a_shield_moves_to_the_nearest_that_holds() -> None:
    """To the nearest of the first five, or of those that the rule names."""
    for line, holds in INVARIANTS:
        (rule,) = parse(line)
        asked = {r: CODES._replace(representation=r) for r in R}
        assert {r for r, d in asked.items() if not violations(rule, view(), [d], [d])} == holds, line
        named = {R.NONE, R.TRACKS, R.DETECTIONS, R.FEATURES, R.RAW} | {r for r in R if NAME_OF[r] in line.split()}
        for r in R:
            (after,) = shield(lambda _, d=asked[r]: [d], [rule])(view())  # type: ignore[misc]
            best = min(sorted(holds & named), key=lambda h, r=r: abs(h.level - r.level))  # type: ignore[misc]
            assert after.representation in holds & {*named, r}
            assert abs(after.representation.level - r.level) == (0.0 if r in holds else abs(best.level - r.level))


def test_only_the_first_five_may_be_given_as_plain_numbers() -> None:
    check_directives([CODES._replace(representation=3)], view())  # type: ignore[arg-type]
    check_directives([CODES], view())
    with pytest.raises(PolicyError, match=r"representation is 6, must be in \[0, 4\]"):
        check_directives([CODES._replace(representation=6)], view())  # type: ignore[arg-type]
