"""The checks of what a policy or a viewpoint returns: each field, type and link; a repeated answer as strictly."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies_examples import changed, fleet_of, without

from sortie.fleet.messages.wire import decode_directive, encode_directive
from sortie.policies.checks import check_directives, check_reposition, differing
from sortie.policies.contract import Directive, Disc, PolicyError, Reposition, Representation

VIEW = fleet_of(5)
BEFORE = {p: Directive(VIEW.ego, p, Representation.FEATURES, 0.5, rate_hz=10.0, reason="share") for p in VIEW.peers}
FIRST, SECOND, *REST = ANSWER = tuple(BEFORE.values())
NAN, ONE = float("nan"), np.array([1.0])
RUNG = "must be a Representation, such as sortie.Representation.DETECTIONS"
PEERS_OF_0 = "is not a peer in the view [1, 2, 3, 4]"

WRONG: list[tuple[dict[str, Any], str]] = [
    ({"source": 0.0}, "0.0→1: source is 0.0, must be a drone's id, a whole number"),
    ({"source": False}, "False→1: source is False, must be a drone's id, a whole number"),
    ({"source": 2}, "2→1: source is 2, must be the ego 0"),
    ({"destination": 1.0}, "0→1.0: destination is 1.0, must be a drone's id, a whole number"),
    ({"destination": [1]}, "0→[1]: destination is [1], must be a drone's id, a whole number"),
    ({"destination": True}, "0→True: destination is True, must be a drone's id, a whole number"),
    ({"destination": 0}, f"0→0: destination 0 {PEERS_OF_0}"),
    ({"destination": 7}, f"0→7: destination 7 {PEERS_OF_0}"),
    ({"destination": 3}, "0→3: second directive for the same link"),
    ({"destination": np.int64(3)}, "0→3: second directive for the same link"),
    ({"representation": "features"}, f"0→1: representation is 'features', {RUNG}"),
    ({"representation": 2.0}, f"0→1: representation is 2.0, {RUNG}"),
    ({"rho": None}, "0→1: rho is None, must be in [0, 1], a number"),
    ({"rho": 0.5j}, "0→1: rho is 0.5j, must be in [0, 1], a number"),
    ({"rho": ONE}, "0→1: rho is array([1.]), must be in [0, 1], a number"),
    ({"rate_hz": "10"}, "0→1: rate_hz is '10', must be in [0, 30], a number"),
    ({"rate_hz": np.array(2.0)}, "0→1: rate_hz is array(2.), must be in [0, 30], a number"),
    ({"rate_hz": np.complex64(1)}, f"0→1: rate_hz is {np.complex64(1)!r}, must be in [0, 30], a number"),
    ({"deadline_s": "soon"}, "0→1: deadline_s is 'soon', must be in [0, 10], a number"),
    ({"fusion_weight": [1.0]}, "0→1: fusion_weight is [1.0], must be in [0, 1], a number"),
    ({"fusion_weight": np.array([True])}, "0→1: fusion_weight is array([ True]), must be in [0, 1], a number"),
    ({"duty_percent": 50.0}, "0→1: duty_percent is 50.0, must be in [0, 100], a whole number"),
    ({"duty_percent": 101}, "0→1: duty_percent is 101, must be in [0, 100]"),
    ({"roi": (0.0, 0.0, 5.0)}, "0→1: roi is (0.0, 0.0, 5.0), must be a Disc or None"),
    ({"roi": Disc(0.0, "0", 5.0)}, "0→1: roi.y_m is '0', must be a number"),
    ({"roi": Disc(0.0, ONE, 5.0)}, "0→1: roi.y_m is array([1.]), must be a number"),
    ({"roi": Disc(NAN, 0.0, 5.0)}, "0→1: roi.x_m is nan, must be finite in 32 bits"),
    ({"roi": Disc(0.0, 0.0, 1e39)}, "0→1: roi.radius_m is 1e+39, must be finite in 32 bits"),
    ({"roi": Disc(0.0, 0.0, 0.0)}, "0→1: roi.radius_m is 0.0, must be > 0"),
    ({"reason": 5}, "0→1: reason is 5, must be text"),
    ({"reason": b"why"}, "0→1: reason is b'why', must be text"),
    ({"reason": "x" * 1001}, "0→1: reason has 1001 characters, must have at most 1000"),
]
BOUNDED = ("rho", "rate_hz", "deadline_s", "fusion_weight", "duty_percent", "representation")
WRONG_ANSWERS: list[tuple[Any, str]] = [
    ([None], "a policy returns Directive, got NoneType"),
    ([(0, 1)], "a policy returns Directive, got tuple"),
    ([tuple(FIRST)], "a policy returns Directive, got tuple"),
    ("hello", "a policy returns a list or a tuple of directives, got str"),
    (None, "a policy returns a list or a tuple of directives, got NoneType"),
    (iter(ANSWER), "a policy returns a list or a tuple of directives, got tuple_iterator"),
    (FIRST, "a policy returns a list or a tuple of directives, got Directive"),
    ({1: FIRST}, "a policy returns a list or a tuple of directives, got dict"),
]


def complaint(answer: Any) -> str:
    """What the check says of an answer; empty if it accepts it."""
    try:
        check_directives(answer, VIEW)
    except PolicyError as error:
        return str(error)
    return ""


def test_a_directive_with_a_wrong_field_is_named_with_its_link_its_field_and_its_value() -> None:
    found = {}
    for kind, (fields, message) in product((list, tuple), WRONG):
        said = complaint(kind([SECOND, *REST, FIRST._replace(**fields)]))
        if said != f"directive {message}":
            found[kind.__name__, message] = said
    assert found == {}


def test_no_directive_passes_its_bounds() -> None:
    found = {}
    for field, value in product(BOUNDED, (-1e-9, 1e6, NAN, math.inf)):
        allowed = "a Representation" if field == "representation" else "in ["
        said = complaint([d._replace(**{field: value}) for d in ANSWER])
        if not said.startswith(f"directive 0→1: {field} is {value!r}, must be {allowed}"):
            found[field, value] = said
    assert found == {}


def test_what_is_no_list_or_tuple_of_directives_is_named() -> None:
    assert {message: complaint(answer) for answer, message in WRONG_ANSWERS} == {m: m for _, m in WRONG_ANSWERS}


def test_numpys_numbers_and_plain_rungs_are_a_directives_too() -> None:
    """They fly: the wire takes each."""
    for d in ANSWER:
        plain = d._replace(representation=3, rho=1, rate_hz=10, fusion_weight=True, roi=Disc(0, 0, 5))
        numbers = {"representation": np.uint8(3), "rho": np.float32(0.5), "rate_hz": np.int64(10)}
        more = {"deadline_s": np.float64(0.1), "duty_percent": np.int16(50), "reason": np.str_("why")}
        disc = Disc(np.float32(1), np.float64(2), np.int64(3))
        for directive in (plain, plain._replace(destination=np.int64(d.destination), roi=disc, **numbers, **more)):
            check_directives([directive], VIEW)
            assert decode_directive(encode_directive(directive)).destination == d.destination


# --- an answer that repeats most of the one before -----------------------------------------------

PEERS = st.sets(st.sampled_from(list(BEFORE)))


@given(st.permutations(list(BEFORE)), PEERS, PEERS, st.booleans())
def test_what_is_new_is_found_in_any_order(order: list[int], new: set[int], met: set[int], is_tuple: bool) -> None:
    before = {p: d for p, d in BEFORE.items() if p not in met}  # the others were heard since
    answer = [BEFORE[p]._replace(rate_hz=2.0) if p in new else BEFORE[p] for p in order]
    found = differing(tuple(before.values()), tuple(answer) if is_tuple else answer, VIEW, before)
    assert found == [d for d in answer if d.destination in new | met]


def test_what_a_whole_check_refuses_or_what_is_not_plainly_the_same_links_goes_to_a_whole_check() -> None:
    slow = FIRST._replace(rate_hz=2.0)
    twice: list[Sequence[Any]] = [
        [FIRST, FIRST, *REST],
        [FIRST, slow, *REST],
        [slow, FIRST._replace(rate_hz=5.0), *REST],
    ]
    other = {"destination": VIEW.ego}, {"destination": 99}, {"destination": [1]}, {"source": 99}, {"rho": 1.5}
    fields = [[FIRST, SECOND._replace(**change), *REST] for change in (*other, {"rate_hz": NAN})]
    for answer in (*twice, *fields, [FIRST, tuple(SECOND), *REST], [FIRST, None, *REST], iter(ANSWER), None):
        assert differing(ANSWER, answer, VIEW, BEFORE) is None  # type: ignore[arg-type]
        assert complaint(answer), answer
    rarer = [FIRST, SECOND._replace(rho=np.float32(0.1)), *REST]
    for answer in ([FIRST, SECOND], [*ANSWER, FIRST], rarer):
        assert differing(ANSWER, answer, VIEW, BEFORE) is None


# --- viewpoints -----------------------------------------------------------------------------------

WRONG_PLACES: list[tuple[Any, str]] = [
    (Reposition(500.0, 0.0), "reposition of drone 0: 500.0 m from the drone, must be at most 200 m"),
    (Reposition(NAN, 0.0), "reposition of drone 0: nan m from the drone, must be at most 200 m"),
    (Reposition(0.0, math.inf), "reposition of drone 0: inf m from the drone, must be at most 200 m"),
    ((3.0, 4.0), "a viewpoint returns Reposition or None, got tuple"),
    (Reposition("a", 0.0, "x"), "reposition of drone 0: x_m is 'a', must be a number"),  # type: ignore[arg-type]
    (Reposition(0.0, None), "reposition of drone 0: y_m is None, must be a number"),  # type: ignore[arg-type]
    (Reposition(0.0, 1j), "reposition of drone 0: y_m is 1j, must be a number"),  # type: ignore[arg-type]
    (Reposition(0.0, 0.0, 5), "reposition of drone 0: reason is 5, must be text"),  # type: ignore[arg-type]
]


def test_a_wish_out_of_bounds_is_named() -> None:
    view = changed(VIEW, position_m=(0.0, 0.0, 60.0))
    for asked, message in WRONG_PLACES:
        with pytest.raises(PolicyError, match=f"^{re.escape(message)}$"):
            check_reposition(asked, view)
    check_reposition(None, view)
    check_reposition(Reposition(200.0, 0.0), view)
    check_reposition(Reposition(np.float32(100), np.int64(5)), view)  # type: ignore[arg-type]
    check_reposition(None, without(view, 0))
    with pytest.raises(PolicyError, match="the view has no descriptor of it, must be None"):
        check_reposition(Reposition(0.0, 0.0), without(view, 0))


def test_a_request_is_as_far_as_both_axes_together_from_the_drone_itself() -> None:
    view = changed(VIEW, 0, position_m=(300.0, -500.0, 60.0))
    for x_m, y_m in ((120.0, 160.0), (-200.0, 0.0), (0.0, -200.0)):  # 200 m each
        check_reposition(Reposition(300.0 + x_m, -500.0 + y_m), view)
    for x_m, y_m in ((150.0, 150.0), (0.0, 201.0), (-201.0, 0.0), (0.0, 800.0)):
        with pytest.raises(PolicyError, match="must be at most 200 m"):
            check_reposition(Reposition(300.0 + x_m, -500.0 + y_m), view)
