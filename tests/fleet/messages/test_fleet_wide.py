"""Ids of two bytes: descriptors and directives of fleets of more than 200 drones."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from itertools import product

import pytest
from fleet_examples import DESCRIPTOR, DIRECTIVE
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.gate import HEADER_BYTES, make_payload
from sortie.fleet.messages import extensions
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.compact import FULL, Form, encode_compact
from sortie.fleet.messages.extensions import MAX_DESCRIPTOR_BYTES, MAX_WIDE_ID, WIDE_FIELD, WIDE_FROM, WIDE_ID
from sortie.fleet.messages.wire import (
    DIRECTIVE_BYTES,
    decode_descriptor,
    decode_directive,
    directive_bytes,
    encode_descriptor,
    encode_directive,
)
from sortie.policies.contract import Descriptor, Representation, Roster
from sortie.scenarios.disc import LISTED_MEMBERS

Encode = Callable[[Descriptor], bytes]
SMALL = Form(8, 1, 16)
ENCODERS: list[Encode] = [encode_descriptor, partial(encode_compact, form=FULL), partial(encode_compact, form=SMALL)]
WIDE = DESCRIPTOR._replace(agent_id=300, roster=Roster(7, (3, 300, 4999)), peer_goodput_mbps=(80.0, 12.5))
"""Drone 300: 80 Mb/s to drone 3, 12.5 Mb/s to drone 4999."""
AGENT_AT = 12
"""Of the id's byte in CDR: after the encapsulation and the stamp."""


@st.composite
def wide_descriptors(draw: st.DrawFn) -> Descriptor:
    ids = st.sets(st.integers(0, MAX_WIDE_ID), min_size=1, max_size=LISTED_MEMBERS)
    members = tuple(sorted(draw(ids.filter(lambda m: max(m) >= WIDE_FROM))))
    links = len(members) - 1
    goodput = draw(st.lists(st.floats(0, 1000, width=32), min_size=links, max_size=links))
    of = {"roster": Roster(draw(st.integers(0, 2**32 - 1)), members), "peer_goodput_mbps": tuple(goodput)}
    of["feature_space"] = draw(st.sampled_from(["", "net-b"]))
    return DESCRIPTOR._replace(agent_id=draw(st.sampled_from(members)), **of)


def test_the_bytes_by_hand() -> None:
    """Goodput to the two members alone, id 255, and a field with the id, the epoch and the members, two bytes an id."""
    plain = bytearray(encode_descriptor(DESCRIPTOR._replace(peer_goodput_mbps=(80.0, 12.5))))
    assert plain[AGENT_AT] == DESCRIPTOR.agent_id
    plain[AGENT_AT] = WIDE_ID
    expected = bytes([2, 4, 12, 0]) + struct.pack("<HI3H", 300, 7, 3, 300, 4999)
    assert encode_descriptor(WIDE) == bytes(plain) + expected


@given(wide_descriptors())
def test_what_is_sent_is_what_is_read(d: Descriptor) -> None:
    assert decode_descriptor(encode_descriptor(d)) == d
    back = decode_descriptor(encode_compact(d, FULL))
    assert (back.agent_id, back.roster, back.peer_goodput_mbps) == (d.agent_id, d.roster, d.peer_goodput_mbps)


def test_a_reader_that_does_not_know_the_field_takes_the_drone_for_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(extensions._DECODERS, WIDE_FIELD)
    for encode in ENCODERS:
        with pytest.raises(MalformedDatagram, match="agent_id is 255, must be at most 254"):
            decode_descriptor.__wrapped__(encode(WIDE))


def test_the_largest_list_leaves_room_for_the_other_fields() -> None:
    roster = Roster(2**32 - 1, tuple(range(1000, 1000 + LISTED_MEMBERS)))
    names = {"feature_space": "n" * 32, "codebook": "ab" * extensions._DIGEST_BYTES}
    links = (1.0,) * (LISTED_MEMBERS - 1)
    d = WIDE._replace(agent_id=1000, roster=roster, peer_goodput_mbps=links, priority_target_ids=(1, 2, 3), **names)
    data = encode_descriptor(d)
    assert len(data) <= MAX_DESCRIPTOR_BYTES
    assert decode_descriptor(data) == d


def test_a_fleet_of_two_hundred_is_written_as_before() -> None:
    """By id, with a bit for each member: the highest id is 199."""
    d = DESCRIPTOR._replace(agent_id=0, roster=Roster(1, (0, WIDE_FROM - 1)), peer_goodput_mbps=(5.0,))
    assert encode_descriptor(d)[AGENT_AT] == 0
    assert encode_descriptor(d._replace(roster=Roster(1, (0, WIDE_FROM))))[AGENT_AT] == WIDE_ID


MALFORMED = [
    (struct.pack("<HI", 300, 7), "wide has 6 B, must have 6 and 2 for each member, one at least"),
    (struct.pack("<HI2HB", 300, 7, 3, 300, 0), "wide has 11 B"),
    (struct.pack("<HI3H", 300, 7, 300, 3, 4999), r"names drone 300 and members \(300, 3, 4999\), must be ascending"),
    (struct.pack("<HI3H", 300, 7, 3, 300, 65535), "must be ascending ids up to 65534"),
    (struct.pack("<HI3H", 301, 7, 3, 300, 4999), "wide names drone 301 and members .* the drone among them"),
    (struct.pack("<HI2H", 300, 7, 3, 300), "wide names 1 other members, peer_goodput has 2 entries"),
]


def test_what_the_field_may_not_say() -> None:
    for encode, (value, reason) in product(ENCODERS, MALFORMED):
        field = struct.pack("<BH", WIDE_FIELD, len(value)) + value
        with pytest.raises(MalformedDatagram, match=reason):
            decode_descriptor(encode(WIDE)[:-15] + field)


def test_the_field_stands_beside_no_other_id_and_no_roster() -> None:
    data = bytearray(encode_descriptor(WIDE))
    data[AGENT_AT] = 3
    with pytest.raises(MalformedDatagram, match="wide stands beside agent_id 3 or a roster, must be beside 255 alone"):
        decode_descriptor(bytes(data))
    data[AGENT_AT] = WIDE_ID
    block = len(data) - 16
    narrow = bytes([2, 2, 5, 0, 7, 0, 0, 0, 8])
    with pytest.raises(MalformedDatagram, match="wide stands beside agent_id 255 or a roster"):
        decode_descriptor(bytes(data[:block]) + narrow + bytes(data[block + 1 :]))


# --- directives -------------------------------------------------------------------------------------------


@given(st.integers(0, MAX_WIDE_ID), st.integers(0, MAX_WIDE_ID))
def test_directives_between_any_two_drones(source: int, destination: int) -> None:
    d = DIRECTIVE._replace(source=source, destination=destination, reason="")
    if source == destination:
        with pytest.raises(MalformedDatagram, match="is none"):
            decode_directive(encode_directive(d))
        return
    data = encode_directive(d)
    assert len(data) == directive_bytes(d) == DIRECTIVE_BYTES + 4 * (max(source, destination) > 254)
    assert decode_directive(data) == d


def test_a_long_directive_by_hand() -> None:
    short = encode_directive(DIRECTIVE)
    assert encode_directive(DIRECTIVE._replace(source=300, destination=2)) == (
        short[:4] + b"\xff\xff" + short[6:] + struct.pack("<HH", 300, 2)
    )
    with pytest.raises(MalformedDatagram, match="40 B, must be 36 for link 3→4"):
        decode_directive(encode_directive(DIRECTIVE._replace(source=3, destination=4)) + bytes(4))


def test_a_payload_carries_the_directive_as_long_as_it_is() -> None:
    def size(source: int) -> int:
        boxes = DIRECTIVE._replace(source=source, representation=Representation.DETECTIONS, roi=None)
        payload = make_payload(boxes, 0.0, 0.0, 0.0, lambda _: 2)
        assert payload is not None
        return payload.size_bytes - HEADER_BYTES

    assert size(300) - size(3) == 4
