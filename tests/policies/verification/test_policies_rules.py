"""The rules of the plane: a test tries to break each of them; policies/README.md says where each is enforced."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from enum import Enum
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from policies_examples import fleet_of

from sortie.fleet.gate import Gate
from sortie.fleet.messages.auth import Dropped, Sealer, open_datagram
from sortie.fleet.messages.extensions import MAX_DESCRIPTOR_BYTES
from sortie.fleet.messages.wire import encode_descriptor
from sortie.policies.contract import Descriptor, Directive, FleetView, Representation
from sortie.policies.damping import DampedLink, damp
from sortie.policies.registry import POLICIES
from sortie.policies.staleness import cap_by_age, health
from sortie.policies.verification.kit.age_rule import raised_part, without_detached
from sortie.policies.verification.kit.conformance import full_view
from sortie.policies.verification.kit.views import draw_view
from sortie.scenarios.reading.load import ScenarioError, loads

FLEET = fleet_of(5)
MINE = FLEET.descriptors[0]
FEATURE_CELLS = np.ones((64, 64, 80), np.float32)


def calls_of_a_decision(name: str, drones: int) -> int:
    """Calls, not time: a crowded host counts the same."""
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


def test_the_cost_of_a_decision_grows_no_faster_than_the_fleet() -> None:
    for name in ("worked", "all-4", "best-2-receivers", "silence"):
        assert 0 < calls_of_a_decision(name, 100) <= 4.2 * calls_of_a_decision(name, 25) + 10, name


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


@given(st.integers(0, 10**6), st.data())
def test_age_never_raises_what_the_plane_enforces(number: int, data: st.DataObject) -> None:
    """Through each policy and the staleness rules: for any view, whoever's descriptor ages, and however much."""
    view = draw_view(11, number)
    who = data.draw(st.sampled_from(sorted(view.age_s)))
    older_s = data.draw(st.floats(0, 100) | st.sampled_from([0.1, 0.30001, 1.0, 1.00001]))
    older = view._replace(age_s={**view.age_s, who: view.age_s[who] + older_s})
    others = without_detached(view, older)

    def enforced(name: str, v: FleetView) -> list[Directive]:
        links = {p: health(v.age_s[p], v.period_s, 3.0, v.detached_after_periods) for p in v.peers}
        return [cap_by_age(d, links[d.destination], v.age_s[d.destination]) for d in POLICIES[name](v)]

    for name, policy in POLICIES.items():
        assert raised_part(policy(view), policy(older), policy(others)) is None, name
        assert raised_part(*(enforced(name, v) for v in (view, older, others))) is None, name


def test_a_payload_does_not_fit_into_any_field_of_a_descriptor_nor_beside_them() -> None:
    payloads = (FEATURE_CELLS, FEATURE_CELLS.tobytes(), FEATURE_CELLS.tolist())
    for field, payload in product(Descriptor._fields, payloads):
        with pytest.raises((ValueError, TypeError, AttributeError)):
            encode_descriptor(MINE._replace(**{field: payload}))
    with pytest.raises((ValueError, TypeError), match="unexpected field names"):  # which one is the Python version's
        MINE._replace(features=FEATURE_CELLS)
    with pytest.raises(AttributeError):
        MINE.features = FEATURE_CELLS  # type: ignore[attr-defined]
    received = encode_descriptor(MINE)
    assert isinstance(open_datagram(received + FEATURE_CELLS.tobytes(), None), Dropped), "nor behind it on the wire"


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
    assert any(isinstance(p, Gate) for p in parts(leaky)), "the search of parts is not blind"


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
    assert raised_s == pytest.approx(3.0), "asked for at 2 s, repeated ten times, made at 3 s"
    assert sent == 6 + 35, "2 Hz for 3 s, then 5 Hz for 7 s"


KEYS = {1: bytes(32)}
SPOILT: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "changed": (lambda data: data[:40] + bytes([data[40] ^ 1]) + data[41:], "forged"),
    "unsigned": (lambda data: data[:-28], "truncated"),
    "another key": (lambda data: Sealer(bytes(31) + b"x", 1).seal(data[:-28]), "forged"),
    "a key nobody has": (lambda data: Sealer(bytes(32), 2).seal(data[:-28]), "unknown_key"),
}


def test_what_is_not_the_fleets_is_dropped() -> None:
    for name, (spoil, reason) in SPOILT.items():
        opened = open_datagram(spoil(Sealer(KEYS[1], 1).seal(encode_descriptor(MINE))), KEYS)
        assert isinstance(opened, Dropped), name
        assert opened.reason.value == reason, name
