"""Descriptors that can grow: older readers pass over newer fields, and no lying length gets in."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from itertools import product

import pytest
from fleet_examples import DESCRIPTOR, extended_descriptors
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.messages.auth import Dropped, DropReason, Opened, Sealer, open_datagram
from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.compact import FULL, Form, encode_compact
from sortie.fleet.messages.extensions import (
    FIELDS,
    MAX_DESCRIPTOR_BYTES,
    VERSION,
    WIDE_FIELD,
    DescriptorTooLarge,
    read_extensions,
)
from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.policies.contract import Descriptor, TaskPhase
from sortie.policies.damping import apply_hysteresis

Encode = Callable[[Descriptor], bytes]
SMALL = Form(8, 1, 16)
ENCODERS: list[Encode] = [encode_descriptor, partial(encode_compact, form=FULL), partial(encode_compact, form=SMALL)]
KEY = bytes(range(32))


def field(number: int, value: bytes = b"", claims: int | None = None) -> bytes:
    return struct.pack("<BH", number, len(value) if claims is None else claims) + value


def block(*fields: bytes, version: int = VERSION) -> bytes:
    return bytes([version]) + b"".join(fields)


unknown_fields = st.dictionaries(st.integers(WIDE_FIELD + 1, 255), st.binary(max_size=60), max_size=6).map(
    lambda found: b"".join(field(number, value) for number, value in sorted(found.items()))
)


# --- what is left out, and what is not --------------------------------------------------------------------


def test_the_block_by_hand() -> None:
    """Version, type, length and text; a codebook is its digest."""
    for encode in ENCODERS:
        named = encode(DESCRIPTOR._replace(feature_space="net-b"))
        assert named == encode(DESCRIPTOR) + bytes([2, 1, 5, 0]) + b"net-b"
        own = encode(DESCRIPTOR._replace(codebook="0123456789abcd"))
        assert own == encode(DESCRIPTOR) + bytes([2, 3, 7, 0]) + bytes.fromhex("0123456789abcd")


@given(extended_descriptors)
def test_optional_fields_survive_the_wire(d: Descriptor) -> None:
    assert decode_descriptor(encode_descriptor(d)) == d


@given(extended_descriptors.filter(lambda d: d.novelty_flags < 128), st.sampled_from([FULL, SMALL]))
def test_optional_fields_survive_the_compact_forms(d: Descriptor, form: Form) -> None:
    back = decode_descriptor(encode_compact(d, form))
    assert [getattr(back, f.name) for f in FIELDS] == [getattr(d, f.name) for f in FIELDS]


def test_optional_fields_pass_the_hysteresis() -> None:
    """Its result is a descriptor of its own when a quantity rose."""
    before = DESCRIPTOR._replace(battery_soc=0.2, feature_space="a")
    assert apply_hysteresis(before, DESCRIPTOR._replace(battery_soc=0.9, feature_space="b"), 0.2).feature_space == "b"


# --- mixed versions ---------------------------------------------------------------------------------------


def test_one_appended_byte_is_a_version_and_no_fields() -> None:
    """Of whatever version: what follows from it is only which fields may come."""
    for encode in ENCODERS:
        plain = encode(DESCRIPTOR)
        assert {decode_descriptor(plain + bytes([byte])) for byte in range(256)} == {decode_descriptor(plain)}


@given(st.sampled_from(ENCODERS), extended_descriptors, unknown_fields, st.integers(0, 255))
def test_a_reader_passes_over_what_it_does_not_know(encode: Encode, d: Descriptor, more: bytes, version: int) -> None:
    """The same value as without it, and authentication covers it."""
    plain = encode(d)
    has_block = d.feature_space or d.roster or d.codebook
    grown = plain + more if has_block else plain + block(more, version=version)
    if len(grown) > MAX_DESCRIPTOR_BYTES:
        return
    assert decode_descriptor(grown) == decode_descriptor(plain)
    sealed = Sealer(KEY, 7).seal(grown)
    opened = open_datagram(sealed, {7: KEY})
    assert isinstance(opened, Opened)
    assert opened.descriptor == decode_descriptor(plain)
    flipped = bytearray(sealed)
    flipped[len(grown) - 1] ^= 1
    refused = open_datagram(bytes(flipped), {7: KEY})
    assert isinstance(refused, Dropped)
    assert refused.reason == "forged"


def test_an_unknown_phase_is_transit() -> None:
    for encode, phase in product(ENCODERS, (5, 77, 255)):
        newer = encode(DESCRIPTOR._replace(task_phase=phase))  # type: ignore[arg-type]
        assert decode_descriptor(newer) == decode_descriptor(encode(DESCRIPTOR))._replace(task_phase=TaskPhase.TRANSIT)


def test_a_known_field_in_an_unknown_form_is_the_newer_senders_right() -> None:
    strange = block(field(1, b"two words"), version=VERSION + 1)
    assert read_extensions(strange) == {}
    with pytest.raises(MalformedDatagram, match="feature_space is 'two words', must be 1 to 32 letters"):
        read_extensions(block(field(1, b"two words")))


# --- what is refused --------------------------------------------------------------------------------------


LETTERS = "must be 1 to 32 letters, digits or any of _ . + -"
BLOCKS = [
    (block(b"\x09"), "extensions end in 1 B, a field has at least 3"),
    (block(b"\x09\x00"), "extensions end in 2 B, a field has at least 3"),
    (block(field(9, b"abc", claims=4)), "extension 9 claims 4 B, 3 B are left"),
    (block(field(9, claims=65535)), "extension 9 claims 65535 B, 0 B are left"),
    (block(field(9, b"abc", claims=2)), "extensions end in 1 B, a field has at least 3"),
    (block(field(9), field(9)), "extension 9 follows 9, must be above it"),
    (block(field(9), field(8)), "extension 8 follows 9, must be above it"),
    (block(field(0)), "extension 0 follows 0, must be above it"),
    (block(field(1)), f"feature_space is '', {LETTERS}"),
    (block(field(1, b"x" * 33)), f"feature_space is 'xxxxxxxxxxxx...xxxxxxxxxxxxx', {LETTERS}"),
    (block(field(1, bytes(800))), rf"feature_space is '\x00\x00\x00...0\x00\x00\x00', {LETTERS}"),
    (
        block(field(2, bytes(600))),
        "roster is 600 B, must be an epoch of 4 B and the bits of ids up to 254, the last byte not 0",
    ),
    (block(field(3, bytes(6))), "codebook has 6 B, must have 7"),
]


def test_malformed_blocks() -> None:
    for encode, (behind, reason) in product(ENCODERS, BLOCKS):
        with pytest.raises(MalformedDatagram) as caught:
            decode_descriptor(encode(DESCRIPTOR) + behind)
        assert caught.value.reason == reason
        opened = open_datagram(Sealer(KEY, 7).seal(encode(DESCRIPTOR) + behind), {7: KEY})
        assert opened == Dropped(DropReason.MALFORMED, reason)


def test_a_cut_descriptor_is_refused_but_at_the_edge_of_a_field() -> None:
    """Those edges are valid by themselves; the tag refuses them all."""
    for encode in ENCODERS:
        named = DESCRIPTOR._replace(feature_space="net-b")
        whole, plain = encode(named) + field(9, b"abc"), len(encode(DESCRIPTOR))
        sealed = Sealer(KEY, 7).seal(whole)
        for end in range(len(whole)):
            assert isinstance(open_datagram(whole[:end] + sealed[len(whole) :], {7: KEY}), Dropped)
            if end in {plain, plain + 1, plain + 9}:
                decode_descriptor(whole[:end])
            else:
                with pytest.raises(MalformedDatagram):
                    decode_descriptor(whole[:end])


@given(extended_descriptors, st.sampled_from(ENCODERS), st.binary(max_size=40), st.data())
def test_whatever_follows_is_a_descriptor_or_malformed(
    d: Descriptor, encode: Encode, behind: bytes, draw: st.DataObject
) -> None:
    data = bytearray(encode(d) + behind)
    for at in draw.draw(st.lists(st.integers(0, len(data) - 1), max_size=4)):
        data[at] ^= draw.draw(st.integers(0, 255))
    try:
        value = decode_descriptor(bytes(data))
    except MalformedDatagram:
        return
    again = decode_descriptor(encode_descriptor(value))
    assert (again.feature_space, again.roster) == (value.feature_space, value.roster)


def test_names_that_the_wire_cannot_hold_are_refused() -> None:
    for name in ("two words", "x" * 33, "é", "-a", "a\n"):
        with pytest.raises(ValueError, match=r"feature_space is .*, must be 1 to 32 letters, digits"):
            encode_descriptor(DESCRIPTOR._replace(feature_space=name))
    with pytest.raises(ValueError, match="codebook is 'mine', must be 14 digits"):
        encode_descriptor(DESCRIPTOR._replace(codebook="mine"))
    large = DESCRIPTOR._replace(priority_target_ids=(1,) * 255, peer_goodput_mbps=(1.0,) * 120)
    with pytest.raises(DescriptorTooLarge, match="priority_target_ids has 255 entries: the descriptor would be 1"):
        encode_compact(large, FULL)
