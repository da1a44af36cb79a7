"""Bytes on the wire: equal to an independent CDR implementation's, and nothing that is not valid gets in."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import numpy as np
import pytest
from fleet_examples import DESCRIPTOR, DIRECTIVE, descriptors, directives
from hypothesis import example, given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sortie.fleet.messages.cdr import ENCAPSULATION, MalformedDatagram
from sortie.fleet.messages.extensions import DescriptorTooLarge
from sortie.fleet.messages.wire import (
    DESCRIPTOR_MSG,
    DESCRIPTOR_NAME,
    DIRECTIVE_BYTES,
    DIRECTIVE_MSG,
    DIRECTIVE_NAME,
    decode_descriptor,
    decode_directive,
    descriptor_bytes,
    encode_descriptor,
    encode_directive,
)
from sortie.policies.contract import Descriptor, Directive

ROS = get_typestore(Stores.ROS2_HUMBLE)
ROS.register(get_types_from_msg(DESCRIPTOR_MSG, DESCRIPTOR_NAME))
ROS.register(get_types_from_msg(DIRECTIVE_MSG, DIRECTIVE_NAME))


def f32(*values: float) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


def as_ros_descriptor(d: Descriptor) -> object:
    seconds = d.stamp_ns // 10**9
    region = (0, 0, 0, 0) if d.region is None else (d.region.x_m, d.region.y_m, d.region.radius_m, 1)
    return ROS.types[DESCRIPTOR_NAME](
        stamp=ROS.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=d.stamp_ns - seconds * 10**9),
        agent_id=d.agent_id,
        position=f32(*d.position_m),
        orientation=f32(*d.orientation_xyzw),
        velocity=f32(*d.velocity_mps),
        footprint_radius=d.footprint_radius_m,
        battery=d.battery_soc,
        cpu_headroom=d.cpu_headroom,
        gpu_headroom=d.gpu_headroom,
        peer_goodput=f32(*d.peer_goodput_mbps),
        coverage_grid=np.frombuffer(d.coverage_grid, dtype=np.uint8),
        novelty_flags=d.novelty_flags,
        task_phase=int(d.task_phase),
        region=f32(*region),
        priority_target_ids=np.asarray(d.priority_target_ids, dtype=np.uint16),
    )


def as_ros_directive(d: Directive) -> object:
    return ROS.types[DIRECTIVE_NAME](
        source=d.source,
        destination=d.destination,
        representation=int(d.representation),
        duty_percent=d.duty_percent,
        roi=f32(0, 0, 0) if d.roi is None else f32(d.roi.x_m, d.roi.y_m, d.roi.radius_m),
        rho=d.rho,
        rate=d.rate_hz,
        deadline=d.deadline_s,
        fusion_weight=d.fusion_weight,
    )


@given(descriptors)
@example(DESCRIPTOR)
def test_descriptor_bytes_equal_an_independent_cdr(d: Descriptor) -> None:
    ours = encode_descriptor(d)
    assert ours == bytes(ROS.serialize_cdr(as_ros_descriptor(d), DESCRIPTOR_NAME))
    theirs = ROS.deserialize_cdr(ours, DESCRIPTOR_NAME)
    assert theirs.stamp.sec * 10**9 + theirs.stamp.nanosec == d.stamp_ns
    assert tuple(theirs.peer_goodput.tolist()) == d.peer_goodput_mbps
    assert tuple(theirs.priority_target_ids.tolist()) == d.priority_target_ids
    assert tuple(theirs.velocity.tolist()) == d.velocity_mps


@given(directives)
@example(DIRECTIVE)
def test_directive_bytes_equal_an_independent_cdr(d: Directive) -> None:
    ours = encode_directive(d)
    assert ours == bytes(ROS.serialize_cdr(as_ros_directive(d), DIRECTIVE_NAME))
    assert ROS.deserialize_cdr(ours, DIRECTIVE_NAME).duty_percent == d.duty_percent


@given(directives)
def test_directive_survives_the_wire(d: Directive) -> None:
    assert decode_directive(encode_directive(d)) == d


def test_sizes_of_the_paper() -> None:
    assert len(encode_descriptor(DESCRIPTOR)) == descriptor_bytes(5) == 180
    assert len(encode_descriptor(DESCRIPTOR._replace(priority_target_ids=(7,)))) == descriptor_bytes(5, 1) == 182
    assert descriptor_bytes(100) == 560
    assert len(encode_directive(DIRECTIVE)) == DIRECTIVE_BYTES == 36


def test_floats_are_rounded_to_32_bits_and_the_reason_stays_at_home() -> None:
    back = decode_directive(encode_directive(DIRECTIVE._replace(rho=0.1, reason="because")))
    assert back.rho == float(np.float32(0.1)) != 0.1
    assert back.reason == ""


def test_the_largest_fleet_that_fits_and_the_field_that_does_not() -> None:
    largest = DESCRIPTOR._replace(peer_goodput_mbps=(1.0,) * 215)
    assert len(encode_descriptor(largest)) == 1024
    assert decode_descriptor(encode_descriptor(largest)) == largest
    limit = "must be at most 1024 B"
    for d, message in (
        (largest._replace(priority_target_ids=(1,)), f"the descriptor would be 1026 B, {limit}"),
        (largest._replace(feature_space="b"), "peer_goodput has 215 entries: the descriptor would be 1029 B"),
        (largest._replace(peer_goodput_mbps=(1.0,) * 230), f"has 230 entries: the descriptor would be 1084 B, {limit}"),
        (
            DESCRIPTOR._replace(priority_target_ids=(1,) * 500),
            f"ids has 500 entries: the descriptor would be 1180 B, {limit}",
        ),
    ):
        with pytest.raises(DescriptorTooLarge, match=message):
            encode_descriptor(d)


def test_what_the_wire_cannot_hold_is_refused() -> None:
    no_fit = "descriptor of agent 3 does not fit its wire types"
    for changes, message in (
        ({"agent_id": 256}, "agent_id is 256, must be at most 254 without a roster"),
        ({"stamp_ns": 2**31 * 10**9}, no_fit),
        ({"footprint_radius_m": 1e39}, no_fit),
        ({"position_m": (1.0, 2.0)}, no_fit),
        ({"coverage_grid": b"short"}, "coverage_grid has 5 bytes, must have 64"),
    ):
        with pytest.raises(ValueError, match=message):
            encode_descriptor(DESCRIPTOR._replace(**changes))
    with pytest.raises(ValueError, match="directive 1→70000 does not fit"):
        encode_directive(DIRECTIVE._replace(destination=70000))


GOOD = encode_descriptor(DESCRIPTOR)
NONE = encode_descriptor(DESCRIPTOR._replace(region=None))
SENT = encode_directive(DIRECTIVE)
NAN = struct.pack("<f", math.nan)


def patch(data: bytes, at: int, new: bytes | float) -> bytes:
    """Overwrite at an offset counted, as CDR does, from after the header; a number is written as a float."""
    written = new if isinstance(new, bytes) else struct.pack("<f", new)
    return data[: 4 + at] + written + data[4 + at + len(written) :]


def refusal(decode: Callable[[bytes], object], data: bytes) -> str:
    with pytest.raises(MalformedDatagram) as caught:
        decode(data)
    return caught.value.reason


NO_FLOAT, LARGE = "a float is not finite", struct.pack("<I", 2**32 - 1)
MALFORMED: list[tuple[bytes, str]] = [
    (b"", "0 B, must be at least 164"),
    (GOOD[:150], "150 B, must be at least 164"),
    (bytes(2000), "2000 B, must be at most 1024"),
    (b"\x00\x00" + GOOD[2:], "encapsulation is 00000000, must be 00010000"),
    (patch(GOOD, 68, LARGE), "peer_goodput claims 4294967295 entries in 180 B"),
    (patch(GOOD, 68, struct.pack("<I", 5)), "peer_goodput claims 5 entries in 180 B"),
    (patch(GOOD, 172, struct.pack("<I", 1)), "priority_target_ids claims 1 entries in 180 B"),
    (GOOD[:-1], "peer_goodput claims 4 entries in 179 B"),
    (patch(GOOD, 4, struct.pack("<I", 10**9)), "stamp.nanosec is 1000000000, must be below 10⁹"),
    (patch(GOOD, 8, b"\xff"), "agent_id is 255, must be at most 254 without the field wide"),
    (patch(GOOD, 12, NAN), NO_FLOAT),
    (patch(GOOD, 16, struct.pack("<2f", math.inf, -math.inf)), NO_FLOAT),
    (patch(GOOD, 84, NAN), NO_FLOAT),
    (patch(GOOD, 164, NAN), NO_FLOAT),
    (patch(GOOD, 24, 0.75), "orientation is not a unit quaternion"),
    (patch(GOOD, 52, -1.0), "footprint_radius is -1, must be ≥ 0"),
    (patch(GOOD, 56, 1.5), "battery, cpu, gpu are 1.5, 0.5, 0.25, must be in [0, 1]"),
    (patch(GOOD, 64, -0.5), "battery, cpu, gpu are 0.75, 0.5, -0.5, must be in [0, 1]"),
    (patch(GOOD, 76, -2.0), "peer_goodput holds -2, must be ≥ 0"),
    (patch(GOOD, 168, 2.0), "region is (10, -20, 32, 2), neither a disc nor none"),
    (patch(GOOD, 164, 0.0), "region is (10, -20, 0, 1), neither a disc nor none"),
    (patch(NONE, 156, 1.0), "region is (1, 0, 0, 0), neither a disc nor none"),
]
MALFORMED_DIRECTIVES: list[tuple[bytes, str]] = [
    (SENT[:-1], "35 B, must be 36"),
    (SENT + b"\0", "37 B, must be 36"),
    (b"\x01" + SENT[1:], "encapsulation is 01010000, must be 00010000"),
    (patch(SENT, 1, b"\x01"), "link 1→1 is none"),
    (patch(SENT, 0, b"\xff"), "link 255→4 is none"),
    (patch(SENT, 2, b"\x07"), "representation is 7, must be in [0, 6]"),
    (patch(SENT, 3, b"\x65"), "duty_percent is 101, must be in [0, 100]"),
    (patch(SENT, 4, NAN), NO_FLOAT),
    (patch(SENT, 12, -1.0), "roi is (10, -20, -1), neither a disc nor none"),
    (patch(SENT, 12, 0.0), "roi is (10, -20, 0), neither a disc nor none"),
    (patch(SENT, 16, 1.5), "rho is 1.5, must be in [0, 1]"),
    (patch(SENT, 20, 31.0), "rate_hz is 31.0, must be in [0, 30]"),
    (patch(SENT, 24, -1.0), "deadline_s is -1.0, must be in [0, 10]"),
    (patch(SENT, 28, 2.0), "fusion_weight is 2.0, must be in [0, 1]"),
]


def test_what_is_malformed_is_refused_with_the_field_and_its_value() -> None:
    for decode, table in ((decode_descriptor, MALFORMED), (decode_directive, MALFORMED_DIRECTIVES)):
        assert [refusal(decode, data) for data, _ in table] == [reason for _, reason in table]


def decodes_or_is_malformed(data: bytes) -> None:
    """Whatever comes in: a valid value that encodes back to the same meaning, or MalformedDatagram; nothing else."""
    for decode, encode in ((decode_descriptor, encode_descriptor), (decode_directive, encode_directive)):
        try:
            value = decode(data)
        except MalformedDatagram:
            continue
        assert decode(encode(value)) == value


@given(st.binary(max_size=1200) | st.binary(min_size=160, max_size=300).map(lambda b: ENCAPSULATION + b))
def test_random_bytes(data: bytes) -> None:
    decodes_or_is_malformed(data)


@given(descriptors.map(encode_descriptor) | directives.map(encode_directive), st.data())
def test_truncations(data: bytes, draw: st.DataObject) -> None:
    short = data[: draw.draw(st.integers(0, len(data) - 1))]
    with pytest.raises(MalformedDatagram):
        decode_descriptor(short)
    with pytest.raises(MalformedDatagram):
        decode_directive(short)


@given(descriptors.map(encode_descriptor) | directives.map(encode_directive), st.data())
def test_bit_flips(data: bytes, draw: st.DataObject) -> None:
    flipped = bytearray(data)
    for bit in draw.draw(st.lists(st.integers(0, 8 * len(data) - 1), min_size=1, max_size=8)):
        flipped[bit // 8] ^= 1 << bit % 8
    decodes_or_is_malformed(bytes(flipped))
