"""Rosters on the wire: goodput by id whoever is there, and the same goodput for readers that know no rosters."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product

import pytest
from fleet_examples import DESCRIPTOR, extended_descriptors
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.messages import extensions
from sortie.fleet.messages.auth import Opened, Sealer, open_datagram
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.compact import FULL, Form, encode_compact
from sortie.fleet.messages.extensions import MAX_DESCRIPTOR_BYTES
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.fleet.standings import UNJUDGED
from sortie.fleet.trust import Arrival, judge
from sortie.policies.contract import Descriptor, FleetView, LinkState, Roster
from sortie.policies.damping import apply_hysteresis

Encode = Callable[[Descriptor], bytes]
SMALL = Form(8, 1, 16)
ENCODERS: list[Encode] = [encode_descriptor, partial(encode_compact, form=FULL), partial(encode_compact, form=SMALL)]
MEMBER = DESCRIPTOR._replace(roster=Roster(7, (1, 3, 9)), peer_goodput_mbps=(80.0, 12.5))
"""Drone 3: 80 Mb/s to drone 1, 12.5 Mb/s to drone 9."""


def read_by_an_older_version(data: bytes) -> Descriptor:
    """As a version reads it that knows feature spaces and no rosters."""
    with pytest.MonkeyPatch.context() as then:
        then.setattr(extensions, "_DECODERS", {1: extensions._DECODERS[1]})
        return decode_descriptor.__wrapped__(data)


def test_the_roster_by_hand() -> None:
    """Goodput by ascending id up to drone 9, but for drone 3; epoch and a bit for each of 1, 3 and 9 in the block."""
    plain = DESCRIPTOR._replace(peer_goodput_mbps=(0.0, 80.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 12.5))
    expected = bytes([2, 2, 6, 0, 7, 0, 0, 0, 0b1010, 0b10])
    for encode in ENCODERS:
        assert encode(MEMBER) == encode(plain) + expected


def test_any_fleet_fits_a_kilobyte() -> None:
    for drones in (1, 2, 5, 64, 200):
        links = tuple(float(i) for i in range(1, drones))
        roster = Roster(2**32 - 1, tuple(range(drones)))
        d = DESCRIPTOR._replace(agent_id=0, roster=roster, peer_goodput_mbps=links, priority_target_ids=(1,))
        data = encode_descriptor(d)
        assert len(data) == 164 + 4 * (drones - 1) + 2 + 1 + 3 + 4 + -(-drones // 8) <= MAX_DESCRIPTOR_BYTES
        assert decode_descriptor(data) == d


@given(st.sampled_from(ENCODERS), extended_descriptors.filter(lambda d: d.roster is not None))
def test_goodput_is_read_by_id(encode: Encode, d: Descriptor) -> None:
    """Each member's own, unknown for all others; exact but for the small form's rounding."""
    assert d.roster is not None
    back = decode_descriptor(encode(d))
    assert back.roster == d.roster
    others = [i for i in d.roster.members if i != d.agent_id]
    step_mbps = 0.0 if encode is not ENCODERS[2] else SMALL.goodput_step_mbps
    for peer, mbps in zip(others, d.peer_goodput_mbps, strict=True):
        assert d.goodput_to(peer) == mbps
        assert back.goodput_to(peer) == pytest.approx(min(mbps, 1023.0) if step_mbps else mbps, abs=step_mbps, rel=0)
    for stranger in set(range(70)) - set(others):
        assert back.goodput_to(stranger) == d.goodput_to(stranger) == 0.0


@given(st.sampled_from(ENCODERS), extended_descriptors)
def test_an_older_reader_reads_the_same_goodputs(encode: Encode, d: Descriptor) -> None:
    """It takes no peer for another, and passes over the roster: what follows from ids is as in the newer reader."""
    data = encode(d)
    old, new = read_by_an_older_version(data), decode_descriptor(data)
    assert old.roster is None
    assert [old.goodput_to(i) for i in range(70)] == [new.goodput_to(i) for i in range(70)]
    assert old.feature_space == new.feature_space
    opened = open_datagram(Sealer(bytes(32), 7).seal(data), {7: bytes(32)})
    assert isinstance(opened, Opened)


FORM = "must be an epoch of 4 B and the bits of ids up to 254"
MALFORMED = {
    "no ids": (b"", f"roster is 07000000, {FORM}, the last byte not 0"),
    "zero at the end": (b"\x0a\x00", f"roster is 070000000a00, {FORM}"),
    "id 255": (bytes(31) + b"\x80", FORM),
    "id 256": (bytes(32) + b"\x01", FORM),
    "a list too long": (b"\x0a\x01", r"roster \(1, 3, 8\) of drone 3 does not fit its peer_goodput of 9 entries"),
    "too short": (b"\x0a\x04", r"roster \(1, 3, 10\) of drone 3 does not fit its peer_goodput of 9 entries"),
    "goodput of no member": (b"\x08\x02", r"roster \(3, 9\) of drone 3 does not fit"),
    "itself": (b"\x02\x02", r"roster \(1, 9\) of drone 3 does not fit .* it must hold the drone"),
}


def test_malformed_rosters() -> None:
    for encode, (bits, reason) in product(ENCODERS, MALFORMED.values()):
        body = encode(MEMBER)[:-10]
        with pytest.raises(MalformedDatagram, match=reason):
            decode_descriptor(body + bytes([2, 2, 4 + len(bits), 0, 7, 0, 0, 0]) + bits)


def test_a_roster_that_the_wire_cannot_hold_is_refused() -> None:
    for roster, links, reason in (
        (Roster(2**32, (3,)), 0, "roster.epoch is 4294967296, must be in"),
        (Roster(1, (3, 3)), 1, r"roster.members is \(3, 3\), must be ascending ids"),
        (Roster(1, (9, 3)), 1, r"roster.members is \(9, 3\), must"),
        (Roster(1, (3, 65535)), 1, r"must be ascending ids in \[0, 65534\]"),
        (Roster(1, ()), 0, "must be ascending ids in .*, one at least"),
        (Roster(1, (4,)), 0, "must hold agent_id = 3"),
        (Roster(1, (1, 3)), 2, "as many others as peer_goodput has entries, 2"),
    ):
        with pytest.raises(ValueError, match=reason):
            encode_descriptor(DESCRIPTOR._replace(roster=roster, peer_goodput_mbps=(1.0,) * links))


# --- in the contract --------------------------------------------------------------------------------------


def test_goodputs_are_of_the_members_and_links_to_others_are_unknown() -> None:
    assert [MEMBER.link_state(i) for i in (1, 9, 4)] == [LinkState.MEASURED] * 2 + [LinkState.UNKNOWN]
    assert [MEMBER.counts(i) for i in (1, 3, 9, 0, 4)] == [True, True, True, False, False]
    assert MEMBER.goodput_by_id(11) == (0.0, 80.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 12.5, 0.0)
    assert DESCRIPTOR.goodput_by_id(5) is DESCRIPTOR.peer_goodput_mbps


def test_the_views_roster() -> None:
    heard = {i: DESCRIPTOR._replace(agent_id=i) for i in (1, 3, 4)}
    view = FleetView(3, 0.1, heard, {1: 0.0, 3: 0.0, 4: 1.5})
    assert view.roster == Roster(0, (1, 3))
    assert view._replace(descriptors={**heard, 3: MEMBER}).roster == Roster(7, (1, 3, 9))
    assert FleetView(2, 0.1, {}, {}).roster == Roster(0, (2,))


def test_hysteresis_compares_goodputs_of_the_same_drone() -> None:
    """Drone 1 leaves and drone 5 joins: what was published of drone 1 says nothing of drone 5."""
    before = MEMBER._replace(peer_goodput_mbps=(80.0, 10.0))
    now = MEMBER._replace(roster=Roster(8, (3, 5, 9)), peer_goodput_mbps=(40.0, 11.0))
    published = apply_hysteresis(before, now, 0.2)
    assert published.roster == now.roster
    assert published.goodput_to(9) == 10.0
    assert published.goodput_to(5) == pytest.approx(40.0 / 1.2)


def test_who_leaves_a_drone_out_claims_no_goodput_to_it() -> None:
    """Payloads of half a second ago do not contradict it."""
    came = {3: [Arrival(1_000_000, 0.1, 100.0, 10.0)] * 3}
    own = DESCRIPTOR._replace(agent_id=4, coverage_grid=bytes(64))
    silent = own._replace(agent_id=3, roster=Roster(2, (3,)), peer_goodput_mbps=())
    for claim, strikes in ((silent, 0), (silent.with_roster(Roster(2, (3, 4))), 1)):
        after = judge({3: UNJUDGED, 4: UNJUDGED}, 4, {3: claim, 4: own}, came, FULL, set())
        assert after[3].strikes == strikes
