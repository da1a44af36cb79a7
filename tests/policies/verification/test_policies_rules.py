"""The rules of the plane: a test tries to break each of them; policies/README.md says where each is enforced."""

from __future__ import annotations

import gc
import re
import sys
from collections.abc import Callable, Sequence
from enum import Enum

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies_examples import fleet_of

from sortie.fleet.gate import Gate
from sortie.fleet.messages.auth import Dropped, Sealer, open_datagram
from sortie.fleet.messages.extensions import MAX_DESCRIPTOR_BYTES
from sortie.fleet.messages.wire import decode_directive, encode_descriptor, encode_directive
from sortie.policies.checks import check_directives
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, PolicyError, Representation
from sortie.policies.damping import DampedLink, damp
from sortie.policies.registry import POLICIES
from sortie.policies.staleness import cap_by_age, health
from sortie.policies.verification.kit.age_rule import raised_part, without_detached
from sortie.policies.verification.kit.conformance import RULES, full_view
from sortie.policies.verification.kit.views import draw_view
from sortie.scenarios.reading.load import ScenarioError, loads

FLEET = fleet_of(5)
MINE = FLEET.descriptors[0]
FEATURE_CELLS = np.ones((64, 64, 80), np.float32)


def share(view: FleetView, rate_hz: float = 10.0) -> list[Directive]:
    return [Directive(view.ego, p, Representation.FEATURES, 0.5, None, rate_hz, reason="share") for p in view.peers]


# --- what a decision costs -----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["worked", "all-4", "best-2-receivers", "silence"])
def test_cost_grows_no_faster_than_the_fleet(name: str) -> None:
    """Calls, not time: a crowded host counts the same."""

    def calls(drones: int) -> int:
        view, counted = full_view(drones), 0

        def count(frame: object, event: str, argument: object) -> None:
            nonlocal counted
            counted += event in ("call", "c_call")

        POLICIES[name](view)
        sys.setprofile(count)
        try:
            POLICIES[name](view)
        finally:
            sys.setprofile(None)
        return counted

    at_25, at_100 = calls(25), calls(100)
    assert 0 < at_100 <= 4.2 * at_25 + 10


# --- 1: bounded size and rate --------------------------------------------------------------------


@pytest.mark.parametrize("field", ["rho", "rate_hz", "deadline_s", "fusion_weight", "duty_percent", "representation"])
@pytest.mark.parametrize("value", [-1e-9, 1e6, float("nan"), float("inf")])
def test_no_directive_passes_its_bounds(field: str, value: float) -> None:
    directives = [d._replace(**{field: value}) for d in share(FLEET)]
    allowed = "a Representation" if field == "representation" else r"in \["
    with pytest.raises(PolicyError, match=rf"directive 0→1: {field} is {value!r}, must be {allowed}"):
        check_directives(directives, FLEET)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("source", 0.0, "source is 0.0, must be a drone's id, a whole number"),
        ("destination", 1.0, "destination is 1.0, must be a drone's id, a whole number"),
        ("destination", [1], "destination is [1], must be a drone's id, a whole number"),
        ("destination", "1", "destination is '1', must be a drone's id, a whole number"),
        (
            "representation",
            "features",
            "representation is 'features', must be a Representation, such as sortie.Representation.DETECTIONS",
        ),
        (
            "representation",
            2.0,
            "representation is 2.0, must be a Representation, such as sortie.Representation.DETECTIONS",
        ),
        ("rho", None, "rho is None, must be in [0, 1], a number"),
        ("rho", 0.5j, "rho is 0.5j, must be in [0, 1], a number"),
        ("rate_hz", "10", "rate_hz is '10', must be in [0, 30], a number"),
        ("deadline_s", "soon", "deadline_s is 'soon', must be in [0, 10], a number"),
        ("fusion_weight", [1.0], "fusion_weight is [1.0], must be in [0, 1], a number"),
        ("duty_percent", 50.0, "duty_percent is 50.0, must be in [0, 100], a whole number"),
        ("roi", (0.0, 0.0, 5.0), "roi is (0.0, 0.0, 5.0), must be a Disc or None"),
        ("roi", Disc(0.0, "0", 5.0), "roi.y_m is '0', must be a number"),
        ("roi", Disc(float("nan"), 0.0, 5.0), "roi.x_m is nan, must be finite in 32 bits"),
        ("roi", Disc(0.0, 0.0, 1e39), "roi.radius_m is 1e+39, must be finite in 32 bits"),
        ("roi", Disc(0.0, 0.0, 0.0), "roi.radius_m is 0.0, must be > 0"),
        ("reason", 5, "reason is 5, must be text"),
        ("reason", b"why", "reason is b'why', must be text"),
        ("reason", "x" * 1001, "reason has 1001 characters, must have at most 1000"),
    ],
)
def test_a_directive_of_other_types_is_named(field: str, value: object, message: str) -> None:
    first, *rest = share(FLEET)
    directives = [first._replace(**{field: value}), *rest]
    with pytest.raises(PolicyError, match=r"^directive ") as caught:
        check_directives(directives, FLEET)
    assert str(caught.value).endswith(": " + message)


@pytest.mark.parametrize("answer", [[None], [(0, 1)], [tuple(share(FLEET)[0])]])
def test_what_is_no_directive_is_named(answer: Sequence[Directive]) -> None:
    with pytest.raises(PolicyError, match=rf"^a policy returns Directive, got {type(answer[0]).__name__}$"):
        check_directives(answer, FLEET)


@pytest.mark.parametrize("answer", ["hello", iter(share(FLEET)), share(FLEET)[0], {1: share(FLEET)[0]}])
def test_what_is_no_list_or_tuple_is_named(answer: Sequence[Directive]) -> None:
    said = f"^a policy returns a list or a tuple of directives, got {type(answer).__name__}$"
    with pytest.raises(PolicyError, match=said):
        check_directives(answer, FLEET)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"destination": True}, "directive 0→True: destination is True, must be a drone's id, a whole number"),
        ({"source": False}, "directive False→1: source is False, must be a drone's id, a whole number"),
        ({"source": 2}, "directive 2→1: source is 2, must be the ego 0"),
        ({"destination": 0}, "directive 0→0: destination 0 is not a peer in the view [1, 2, 3, 4]"),
        ({"destination": 7}, "directive 0→7: destination 7 is not a peer in the view [1, 2, 3, 4]"),
        ({"destination": 3}, "directive 0→3: second directive for the same link"),
    ],
)
@pytest.mark.parametrize("answer", [list, tuple])
def test_a_directive_for_no_link_of_its_own_is_named(
    answer: Callable[[list[Directive]], Sequence[Directive]], fields: dict[str, int], message: str
) -> None:
    first, *rest = share(FLEET)
    with pytest.raises(PolicyError, match=f"^{re.escape(message)}$"):
        check_directives(answer([*rest, first._replace(**fields)]), FLEET)


ONE = np.array([1.0])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rho": ONE}, "rho is array([1.]), must be in [0, 1], a number"),
        ({"rate_hz": np.array(2.0)}, "rate_hz is array(2.), must be in [0, 30], a number"),
        ({"deadline_s": ONE}, "deadline_s is array([1.]), must be in [0, 10], a number"),
        ({"fusion_weight": np.array([True])}, "fusion_weight is array([ True]), must be in [0, 1], a number"),
        ({"rate_hz": np.complex64(1)}, f"rate_hz is {np.complex64(1)!r}, must be in [0, 30], a number"),
        ({"roi": Disc(0.0, ONE, 5.0)}, "roi.y_m is array([1.]), must be a number"),  # type: ignore[arg-type]
    ],
)
def test_an_array_of_one_number_is_no_number(fields: dict[str, object], message: str) -> None:
    first, *rest = share(FLEET)
    with pytest.raises(PolicyError, match=f"^{re.escape(f'directive 0→1: {message}')}$"):
        check_directives([first._replace(**fields), *rest], FLEET)


def test_a_second_directive_for_a_link_is_named_whatever_its_id_is_made_of() -> None:
    again = share(FLEET)[0]._replace(destination=np.int64(1))
    with pytest.raises(PolicyError, match=r"^directive 0→1: second directive for the same link$"):
        check_directives([*share(FLEET), again], FLEET)


def test_numpys_numbers_and_plain_rungs_are_a_directives_too() -> None:
    """They fly: the wire takes each."""
    for d in share(FLEET):
        plain = d._replace(representation=3, rho=1, rate_hz=10, fusion_weight=True, roi=Disc(0, 0, 5))
        scalars = plain._replace(
            destination=np.int64(d.destination), representation=np.uint8(3), rho=np.float32(0.5), rate_hz=np.int64(10),
            deadline_s=np.float64(0.1), duty_percent=np.int16(50), roi=Disc(np.float32(1), np.float64(2), np.int64(3)),
            reason=np.str_("why"),
        )  # fmt: skip
        for directive in (plain, scalars):
            check_directives([directive], FLEET)
            assert decode_directive(encode_directive(directive)).destination == d.destination


@given(st.integers(0, 400), st.integers(0, 600))
def test_no_descriptor_is_larger_than_a_kilobyte(peers: int, targets: int) -> None:
    crowded = MINE._replace(peer_goodput_mbps=(1.0,) * peers, priority_target_ids=(1,) * targets)
    try:
        size = len(encode_descriptor(crowded))
    except ValueError:
        return
    assert size <= MAX_DESCRIPTOR_BYTES


def test_descriptors_come_at_most_ten_times_a_second() -> None:
    with pytest.raises(ScenarioError, match="rate_hz"):
        loads("name: fast\ncontext: {rate_hz: 10.1}")


# --- 2: best effort; age only reduces ------------------------------------------------------------


@pytest.mark.parametrize("name", POLICIES)
@given(st.integers(0, 10**6), st.data())
def test_age_never_raises_what_the_plane_enforces(name: str, number: int, data: st.DataObject) -> None:
    """Through the policy and the staleness rules together: for any view, whoever's descriptor ages, and however much."""
    view = draw_view(11, number)
    who = data.draw(st.sampled_from(sorted(view.age_s)))
    older_s = data.draw(st.floats(0, 100) | st.sampled_from([0.1, 0.30001, 1.0, 1.00001]))
    older = view._replace(age_s={**view.age_s, who: view.age_s[who] + older_s})

    def enforced(v: FleetView) -> list[Directive]:
        links = {p: health(v.age_s[p], v.period_s, 3.0, v.detached_after_periods) for p in v.peers}
        return [cap_by_age(d, links[d.destination], v.age_s[d.destination]) for d in POLICIES[name](v)]

    without = without_detached(view, older)
    assert raised_part(POLICIES[name](view), POLICIES[name](older), POLICIES[name](without)) is None
    assert raised_part(enforced(view), enforced(older), enforced(without)) is None


# --- 3: context only -----------------------------------------------------------------------------


@pytest.mark.parametrize("field", Descriptor._fields)
@pytest.mark.parametrize("payload", [FEATURE_CELLS, FEATURE_CELLS.tobytes(), FEATURE_CELLS.tolist()], ids=type)
def test_a_payload_does_not_fit_into_any_field_of_a_descriptor(field: str, payload: object) -> None:
    with pytest.raises((ValueError, TypeError, AttributeError)):
        encode_descriptor(MINE._replace(**{field: payload}))


def test_a_descriptor_has_no_room_beside_its_fields() -> None:
    with pytest.raises(
        (ValueError, TypeError), match="unexpected field names"
    ):  # which of them is the Python version's
        MINE._replace(features=FEATURE_CELLS)
    with pytest.raises(AttributeError):
        MINE.features = FEATURE_CELLS  # type: ignore[attr-defined]
    received = encode_descriptor(MINE)
    assert isinstance(open_datagram(received + FEATURE_CELLS.tobytes(), None), Dropped), "nor behind it on the wire"


# --- 4: policies read only descriptors -----------------------------------------------------------

PLAIN = (int, float, str, bytes, type(None), Enum)


def parts(thing: object) -> list[object]:
    """All that can be reached from an object, but for classes and what belongs to them."""
    found, waiting = [], [thing]
    while waiting:
        one = waiting.pop()
        if isinstance(one, type) or any(one is f for f in found):
            continue
        found.append(one)
        if not isinstance(one, PLAIN):
            waiting += gc.get_referents(one)
    return found


def test_a_view_holds_descriptors_and_ages_and_nothing_else_can_be_reached_from_it() -> None:
    kinds = {type(p) for p in parts(FLEET) if not isinstance(p, PLAIN)}
    assert kinds <= {FleetView, Descriptor, dict, tuple}
    leaky = FLEET._replace(descriptors={0: MINE._replace(coverage_grid=Gate())})
    assert any(isinstance(p, Gate) for p in parts(leaky)), "the look itself is not blind"


HEARD: list[int] = []


def remembers(view: FleetView) -> list[Directive]:
    HEARD.append(1)
    return share(view, float(len(HEARD) % 30))


def test_memory_between_calls_is_caught() -> None:
    assert RULES["deterministic"].complaint(remembers, FLEET) is not None


# --- 5: damping and idempotence ------------------------------------------------------------------


def test_repeating_a_directive_restarts_no_timer_anywhere() -> None:
    """The bug that the paper names: a repeated directive restarted the publisher's timer, which then never fired."""
    gate, sent = Gate(), 0
    state = DampedLink(Directive(0, 1, Representation.FEATURES, 0.5, None, 2.0))
    more = state.enforced._replace(rate_hz=5.0)
    raised_s = None
    for frame in range(100):
        now_s = frame * 0.1
        asked = more if frame >= 20 else state.enforced._replace()  # equal, and another object each time
        state = damp(state, asked._replace(), now_s, dwell_s=1.0)
        gate.enforce(state.enforced)  # every frame anew
        sent += len(gate.due(now_s))
        if raised_s is None and state.enforced.rate_hz == 5.0:
            raised_s = now_s
    assert raised_s == pytest.approx(3.0), (
        "asked for at 2 s, repeated ten times, made at 3 s: no repeat restarts the dwell"
    )
    assert sent == 6 + 35, "2 Hz for 3 s, then 5 Hz for 7 s"


# --- 6: authentication ---------------------------------------------------------------------------

KEYS = {1: bytes(32)}


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda data: data[:40] + bytes([data[40] ^ 1]) + data[41:], "forged"),
        (lambda data: data[:-28], "truncated"),
        (lambda data: Sealer(bytes(31) + b"x", 1).seal(data[:-28]), "forged"),
        (lambda data: Sealer(bytes(32), 2).seal(data[:-28]), "unknown_key"),
    ],
    ids=["changed", "unsigned", "another key", "a key nobody has"],
)
def test_what_is_not_the_fleets_is_dropped(spoil: Callable[[bytes], bytes], reason: str) -> None:
    opened = open_datagram(spoil(Sealer(KEYS[1], 1).seal(encode_descriptor(MINE))), KEYS)
    assert isinstance(opened, Dropped)
    assert opened.reason.value == reason
