"""Optional fields behind a descriptor. They let the plane grow, and older drones pass over the ones that they do not know.

    version, 1 B | field | field | …        field: type, 1 B · length, 2 B little endian · value

The block follows the last byte of a descriptor, in CDR or in a compact form. Without optional fields there is no block,
and the bytes are the paper's. Types ascend, so that one content has one form. A reader does four things:

- It passes over a type that it does not know, and keeps nothing of it. Nobody forwards descriptors, and kept bytes
  would be a place beside the context.
- It passes over a type that it knows, in a form that it cannot read, where the sender's version is newer than its own.
- It refuses the same from its own version or an older one.
- It refuses a length that passes the end.

The whole descriptor has at most 1,024 B, block included, and authentication covers all of it. A reader from before
version 2 knows no block, and refuses descriptors that have one.

To add a field: a field with a default in `sortie.policies.contract.Descriptor`, and a line in `FIELDS`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.policies.contract import Descriptor, TaskPhase
from sortie.scenarios.errors import SortieError

MAX_DESCRIPTOR_BYTES = 1024
VERSION = 2
"""Of the descriptors that this code writes with a block. Descriptors without one are version 1, the paper's."""
_HEAD = struct.Struct("<BH")
_FEATURE_SPACE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,31}", re.ASCII)


_PHASES = {int(phase): phase for phase in TaskPhase}


def read_phase(number: int) -> TaskPhase:
    """A task phase from the wire. One that this version does not know is read as transit.

    Transit claims nothing: no policy takes such a drone for one that searches, tracks a target or leaves the fleet.
    """
    return _PHASES.get(number, TaskPhase.TRANSIT)


class DescriptorTooLarge(SortieError):
    """A descriptor that would pass 1 KB; the message names the field."""


class ExtensionField(NamedTuple):
    """An optional field of a descriptor. It is left out where it has its default."""

    name: str
    """The field of `Descriptor`."""
    number: int
    """Its type on the wire, 1 … 255; never used again for anything else."""
    encode: Callable[[Any], bytes]
    """From the field's value; ValueError where the wire cannot hold it."""
    decode: Callable[[bytes], Any]
    """From the bytes of the value; MalformedDatagram, with the reason, where they are none."""


def _encode_feature_space(name: str) -> bytes:
    if not _FEATURE_SPACE.fullmatch(name):
        raise ValueError(f"feature_space is {name!r}, must be 1 to 32 letters, digits or any of _ . + -")
    return name.encode("ascii")


def _decode_feature_space(value: bytes) -> str:
    name = value.decode("ascii", "replace")
    if not _FEATURE_SPACE.fullmatch(name):
        raise MalformedDatagram(f"feature_space is {name!r}, must be 1 to 32 letters, digits or any of _ . + -")
    return name


FIELDS: tuple[ExtensionField, ...] = (ExtensionField("feature_space", 1, _encode_feature_space, _decode_feature_space),)
"""Every optional field that this version knows, by ascending type."""
_BY_NUMBER = {field.number: field for field in FIELDS}
_WITH_DEFAULTS = tuple((field, Descriptor._field_defaults[field.name]) for field in FIELDS)


def append_extensions(body: bytes, d: Descriptor) -> bytes:
    """A descriptor's bytes with its optional fields behind them; `body` itself where all have their defaults.

    Raises:
        DescriptorTooLarge: more than 1,024 B, naming the part that is too long.
        ValueError: a value that its field cannot hold.
    """
    block = b""
    for field, default in _WITH_DEFAULTS:
        value = getattr(d, field.name)
        if value != default:
            encoded = field.encode(value)
            block += _HEAD.pack(field.number, len(encoded)) + encoded
    whole = body + bytes([VERSION]) + block if block else body
    if len(whole) > MAX_DESCRIPTOR_BYTES:
        peers, targets = len(d.peer_goodput_mbps), len(d.priority_target_ids)
        _, longest = max(
            (len(block), f"the extensions have {len(block)} B"),
            (2 * targets, f"priority_target_ids has {targets} entries"),
            (4 * peers, f"peer_goodput has {peers} entries"),
        )
        raise DescriptorTooLarge(
            f"{longest}: the descriptor would be {len(whole)} B, must be at most {MAX_DESCRIPTOR_BYTES} B"
        )
    return whole


def read_extensions(block: bytes) -> dict[str, Any]:
    """The optional fields that follow a descriptor, by name; empty for an empty block.

    Raises:
        MalformedDatagram: a length that passes the end, types that do not ascend, or a value that is none.
    """
    found: dict[str, Any] = {}
    at, last, size = 1, 0, len(block)
    while at < size:
        if size - at < _HEAD.size:
            raise MalformedDatagram(f"extensions end in {size - at} B, a field has at least {_HEAD.size}")
        number, length = _HEAD.unpack_from(block, at)
        at += _HEAD.size
        if number <= last:
            raise MalformedDatagram(f"extension {number} follows {last}, must be above it")
        if length > size - at:
            raise MalformedDatagram(f"extension {number} claims {length} B, {size - at} B are left")
        field = _BY_NUMBER.get(number)
        if field is not None:
            try:
                found[field.name] = field.decode(block[at : at + length])
            except MalformedDatagram:
                if block[0] <= VERSION:
                    raise
        at, last = at + length, number
    return found
