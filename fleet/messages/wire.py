"""Descriptors and directives as bytes: encode what is ours, trust nothing that comes in.

A descriptor is 180 B at five drones and grows by 4 B a peer and 2 B a priority target; past 1 KB it is refused
where it is made. Optional fields follow it (`sortie.fleet.messages.extensions`). A directive is 36 B, and 40 B where an id
does not fit into a byte: both ids then are 255 and follow behind it, in two bytes each. Floats are rounded
to 32 bits on the way, and a directive's `reason` stays at home. Decoding holds every length, count, enumeration and
range to its bound before anything is believed. A task phase that this version does not know is read as transit.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from importlib.resources import files
from math import isfinite

from sortie.fleet.messages.cdr import ENCAPSULATION, MalformedDatagram, check_encapsulation, layout
from sortie.fleet.messages.compact import MARK, decode_compact
from sortie.fleet.messages.extensions import (
    MAX_AGENT_ID,
    MAX_DESCRIPTOR_BYTES,
    MAX_WIDE_ID,
    WIDE_ID,
    append_extensions,
    is_wide,
    listed_goodput,
    read_phase,
    with_extensions,
)
from sortie.policies.contract import (
    COVERAGE_BYTES,
    DIRECTIVE_BOUNDS,
    Descriptor,
    Directive,
    Disc,
    Representation,
)
from sortie.scenarios.representation import LEVELS

_MSGS = files("sortie.fleet") / "sortie_msgs" / "msg"
DESCRIPTOR_NAME, DIRECTIVE_NAME = "sortie_msgs/msg/ContextDescriptor", "sortie_msgs/msg/DataPlaneDirective"
DESCRIPTOR_MSG = (_MSGS / "ContextDescriptor.msg").read_text("utf-8")
"""The fields as ROS 2 defines them; `fleet/sortie_msgs` builds as a ROS 2 package."""
DIRECTIVE_MSG = (_MSGS / "DataPlaneDirective.msg").read_text("utf-8")

_TIME = [("i", 1), ("I", 1)]
_FRONT = [*_TIME, ("B", 1), ("f", 3), ("f", 4), ("f", 3), ("f", 1), ("f", 3)]
_BACK = [("s", COVERAGE_BYTES), ("B", 1), ("B", 1), ("f", 4), ("I", 1)]
_COUNT = struct.Struct("<I")
_GOODPUT_COUNT_AT = layout(*_FRONT, ("I", 1))[1][-1]
_TARGET_COUNT_AT = layout(*_FRONT, ("I", 1), *_BACK)[1][-1]  # without peers; each moves it by 4 B
_DIRECTIVE = layout(("B", 4), ("f", 3), ("f", 4))[0]


@lru_cache(maxsize=1024)
def _descriptor_layout(peers: int, targets: int) -> struct.Struct:
    """The struct of a descriptor with these sequence lengths."""
    return layout(*_FRONT, ("I", 1), ("f", peers), *_BACK, ("H", targets))[0]


MIN_DESCRIPTOR_BYTES = _descriptor_layout(0, 0).size
DIRECTIVE_BYTES = _DIRECTIVE.size
_WIDE_LINK = struct.Struct("<HH")
_WIDE_MARKS = (WIDE_ID, WIDE_ID)
_NUMBERS = {name: bound for name, bound in DIRECTIVE_BOUNDS.items() if name != "representation"}


def descriptor_bytes(drones: int, targets: int = 0) -> int:
    """Size of a descriptor in a fleet of `drones` with `targets` priority ids, without optional fields and authentication."""
    return _descriptor_layout(drones - 1, targets).size


def encode_descriptor(d: Descriptor) -> bytes:
    """Serialise a descriptor.

    Raises:
        DescriptorTooLarge: more than 1,024 B, naming the part that is too long.
        ValueError: a field that its wire type cannot hold.
    """
    goodput, targets = listed_goodput(d), d.priority_target_ids
    compiled = _descriptor_layout(len(goodput), len(targets))
    if len(d.coverage_grid) != COVERAGE_BYTES:
        raise ValueError(f"coverage_grid has {len(d.coverage_grid)} bytes, must have {COVERAGE_BYTES}")
    second, nanosecond = divmod(d.stamp_ns, 1_000_000_000)
    region = (0.0, 0.0, 0.0, 0.0) if d.region is None else (d.region.x_m, d.region.y_m, d.region.radius_m, 1.0)
    try:
        body = compiled.pack(
            ENCAPSULATION,
            second,
            nanosecond,
            WIDE_ID if is_wide(d) else d.agent_id,
            *d.position_m,
            *d.orientation_xyzw,
            *d.velocity_mps,
            d.footprint_radius_m,
            d.battery_soc,
            d.cpu_headroom,
            d.gpu_headroom,
            len(goodput),
            *goodput,
            d.coverage_grid,
            d.novelty_flags,
            d.task_phase,
            *region,
            len(targets),
            *targets,
        )
    except (struct.error, OverflowError) as error:
        raise ValueError(f"descriptor of agent {d.agent_id} does not fit its wire types: {error}") from None
    return append_extensions(body, d)


@lru_cache(maxsize=256)  # a broadcast is the same bytes for its sender and everyone who hears it
def decode_descriptor(data: bytes) -> Descriptor:
    """Parse and check a descriptor, in CDR or in a compact form (`sortie.fleet.messages.compact`).

    Raises:
        MalformedDatagram: for anything that is not one valid descriptor.
    """
    size = len(data)
    if size > MAX_DESCRIPTOR_BYTES:
        raise MalformedDatagram(f"{size} B, must be at most {MAX_DESCRIPTOR_BYTES}")
    if data[:1] == MARK:
        return decode_compact(data)
    if size < MIN_DESCRIPTOR_BYTES:
        raise MalformedDatagram(f"{size} B, must be at least {MIN_DESCRIPTOR_BYTES}")
    check_encapsulation(data[:4])
    (peers,) = _COUNT.unpack_from(data, _GOODPUT_COUNT_AT)
    if 4 * peers > size - MIN_DESCRIPTOR_BYTES:
        raise MalformedDatagram(f"peer_goodput claims {peers} entries in {size} B")
    (targets,) = _COUNT.unpack_from(data, _TARGET_COUNT_AT + 4 * peers)
    end = MIN_DESCRIPTOR_BYTES + 4 * peers + 2 * targets
    if end > size:
        raise MalformedDatagram(f"priority_target_ids claims {targets} entries in {size} B")

    values = _descriptor_layout(peers, targets).unpack_from(data)
    _, second, nanosecond, agent_id = values[:4]
    orientation, (footprint, soc, cpu, gpu) = values[7:11], values[14:18]
    after = 19 + peers
    goodput = values[19:after]
    grid, novelty, phase = values[after : after + 3]
    x, y, radius, flag = region = values[after + 3 : after + 7]
    # a sum of 32-bit floats in 64 bits cannot overflow: it is finite if and only if every one of them is
    if not isfinite(sum(values[4:18]) + sum(goodput) + sum(region)):
        raise MalformedDatagram("a float is not finite")
    if nanosecond >= 1_000_000_000:
        raise MalformedDatagram(f"stamp.nanosec is {nanosecond}, must be below 10⁹")
    qx, qy, qz, qw = orientation
    if not 0.999 < qx * qx + qy * qy + qz * qz + qw * qw < 1.001:
        raise MalformedDatagram("orientation is not a unit quaternion")
    if footprint < 0:
        raise MalformedDatagram(f"footprint_radius is {footprint:g}, must be ≥ 0")
    if not (0 <= soc <= 1 and 0 <= cpu <= 1 and 0 <= gpu <= 1):
        raise MalformedDatagram(f"battery, cpu, gpu are {soc:g}, {cpu:g}, {gpu:g}, must be in [0, 1]")
    if goodput and min(goodput) < 0:
        raise MalformedDatagram(f"peer_goodput holds {min(goodput):g}, must be ≥ 0")
    if flag == 1 and radius > 0:
        disc = Disc(x, y, radius)
    elif x == y == radius == flag == 0:
        disc = None
    else:
        raise MalformedDatagram(f"region is ({x:g}, {y:g}, {radius:g}, {flag:g}), neither a disc nor none")
    found = Descriptor(
        second * 1_000_000_000 + nanosecond,
        agent_id,
        values[4:7],
        orientation,
        values[11:14],
        footprint,
        soc,
        cpu,
        gpu,
        goodput,
        grid,
        novelty,
        read_phase(phase),
        disc,
        values[after + 8 :],
    )
    return with_extensions(found, data[end:])


def directive_bytes(d: Directive) -> int:
    """Size of a directive on the wire."""
    return DIRECTIVE_BYTES + (_WIDE_LINK.size if max(d.source, d.destination) > MAX_AGENT_ID else 0)


def encode_directive(d: Directive) -> bytes:
    """Serialise a directive, in `directive_bytes`.

    Raises:
        ValueError: a field that its wire type cannot hold.
    """
    link, behind = d[:2], b""
    roi = (0.0, 0.0, 0.0) if d.roi is None else (d.roi.x_m, d.roi.y_m, d.roi.radius_m)
    try:
        if max(link) > MAX_AGENT_ID:
            link, behind = _WIDE_MARKS, _WIDE_LINK.pack(*link)
        return (
            _DIRECTIVE.pack(
                ENCAPSULATION,
                *link,
                d.representation,
                d.duty_percent,
                *roi,
                d.rho,
                d.rate_hz,
                d.deadline_s,
                d.fusion_weight,
            )
            + behind
        )
    except (struct.error, OverflowError) as error:
        raise ValueError(f"directive {d.source}→{d.destination} does not fit its wire types: {error}") from None


def decode_directive(data: bytes) -> Directive:
    """Parse and check a directive; its bounds are the policy contract's.

    Raises:
        MalformedDatagram: for anything that is not exactly one valid directive.
    """
    is_long = len(data) == DIRECTIVE_BYTES + _WIDE_LINK.size
    if len(data) != DIRECTIVE_BYTES and not is_long:
        raise MalformedDatagram(f"{len(data)} B, must be {DIRECTIVE_BYTES}")
    header, source, destination, rung, duty, x, y, radius, rho, rate, deadline, weight = _DIRECTIVE.unpack_from(data)
    check_encapsulation(header)
    if not isfinite(x + y + radius + rho + rate + deadline + weight):
        raise MalformedDatagram("a float is not finite")
    highest = MAX_AGENT_ID
    if is_long and (source, destination) == _WIDE_MARKS:
        (source, destination), highest = _WIDE_LINK.unpack_from(data, DIRECTIVE_BYTES), MAX_WIDE_ID
    elif is_long:
        raise MalformedDatagram(f"{len(data)} B, must be {DIRECTIVE_BYTES} for link {source}→{destination}")
    if source > highest or destination > highest or source == destination:
        raise MalformedDatagram(f"link {source}→{destination} is none")
    if rung not in LEVELS:
        raise MalformedDatagram(f"representation is {rung}, must be in [0, {max(LEVELS)}]")
    for (name, bound), value in zip(_NUMBERS.items(), (rho, rate, deadline, weight, duty), strict=True):
        wrong = bound.breaks(name, value)
        if wrong is not None:
            raise MalformedDatagram(wrong)
    if radius < 0 or (radius == 0 and not x == y == 0):
        raise MalformedDatagram(f"roi is ({x:g}, {y:g}, {radius:g}), neither a disc nor none")
    roi = Disc(x, y, radius) if radius > 0 else None
    return Directive(source, destination, Representation(rung), rho, roi, rate, deadline, weight, duty)
