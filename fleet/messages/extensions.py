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

Goodput stays in the descriptor's own list, where every version reads it: by ascending id, 0 for drones off the roster, up
to the roster's highest id. A reader that knows the roster keeps the members' entries; an older one passes over the
roster and reads the same goodputs, with the others as unknown.

To add a field: a field with a default in `sortie.policies.contract.Descriptor`, and a line in `FIELDS`.
"""

from __future__ import annotations

import re
import reprlib
import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.perception.budget import CODEBOOK_BYTES
from sortie.policies.contract import Descriptor, Roster, TaskPhase
from sortie.scenarios.errors import SortieError

MAX_DESCRIPTOR_BYTES = 1024
MAX_AGENT_ID = 254
VERSION = 2
"""Of the descriptors that this code writes with a block. Descriptors without one are version 1, the paper's."""
_HEAD = struct.Struct("<BH")
_DIGEST_BYTES = CODEBOOK_BYTES - 1
"""Of a codebook: what a payload of codes begins with as well."""
_CODEBOOK = re.compile(f"[0-9a-f]{{{2 * _DIGEST_BYTES}}}", re.ASCII)
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
        raise ValueError(_not_a_feature_space(name))
    return name.encode("ascii")


def _decode_feature_space(value: bytes) -> str:
    name = value.decode("ascii", "replace")
    if not _FEATURE_SPACE.fullmatch(name):
        raise MalformedDatagram(_not_a_feature_space(name))
    return name


def _not_a_feature_space(name: str) -> str:
    return f"feature_space is {reprlib.repr(name)}, must be 1 to 32 letters, digits or any of _ . + -"


def _encode_roster(roster: Roster) -> bytes:
    """Epoch, 4 B, and a bit for each id, lowest first, up to the highest member's byte."""
    epoch, members = roster
    if not 0 <= epoch < 2**32:
        raise ValueError(f"roster.epoch is {epoch}, must be in [0, 2³²)")
    if not members or members != tuple(sorted(set(members))) or not 0 <= members[0] <= members[-1] <= MAX_AGENT_ID:
        raise ValueError(f"roster.members is {members}, must be ascending ids in [0, {MAX_AGENT_ID}], one at least")
    return epoch.to_bytes(4, "little") + sum(1 << i for i in members).to_bytes(members[-1] // 8 + 1, "little")


def _encode_codebook(digest: str) -> bytes:
    if not _CODEBOOK.fullmatch(digest):
        raise ValueError(
            f"codebook is {reprlib.repr(digest)}, must be {2 * _DIGEST_BYTES} digits of a hexadecimal number"
        )
    return bytes.fromhex(digest)


def _decode_codebook(value: bytes) -> str:
    if len(value) != _DIGEST_BYTES:
        raise MalformedDatagram(f"codebook has {len(value)} B, must have {_DIGEST_BYTES}")
    return value.hex()


@lru_cache(maxsize=1024)  # it changes seldom
def _decode_roster(value: bytes) -> Roster:
    bits = int.from_bytes(value[4:], "little")
    if len(value) < 5 or not value[-1] or bits >> MAX_AGENT_ID + 1:
        wanted = f"an epoch of 4 B and the bits of ids up to {MAX_AGENT_ID}, the last byte not 0"
        has = value.hex() if len(value) <= 5 + MAX_AGENT_ID // 8 else f"{len(value)} B"
        raise MalformedDatagram(f"roster is {has}, must be {wanted}")
    return Roster(int.from_bytes(value[:4], "little"), tuple(i for i in range(bits.bit_length()) if bits >> i & 1))


FIELDS: tuple[ExtensionField, ...] = (
    ExtensionField("feature_space", 1, _encode_feature_space, _decode_feature_space),
    ExtensionField("roster", 2, _encode_roster, _decode_roster),
    ExtensionField("codebook", 3, _encode_codebook, _decode_codebook),
)
"""Every optional field that this version knows, by ascending type."""
_BY_NUMBER = {field.number: field for field in FIELDS}
_WITH_DEFAULTS = tuple((field, Descriptor._field_defaults[field.name]) for field in FIELDS)


def listed_goodput(d: Descriptor) -> tuple[float, ...]:
    """The goodputs as they are listed on the wire: by ascending id.

    Raises:
        ValueError: a roster without the drone itself, or another number of goodputs than of other members.
    """
    if d.roster is None:
        return d.peer_goodput_mbps
    if d.agent_id not in d.roster.members or len(d.peer_goodput_mbps) != len(d.roster.members) - 1:
        raise ValueError(
            f"roster.members is {d.roster.members}, must hold agent_id = {d.agent_id} and as many others as "
            f"peer_goodput has entries, {len(d.peer_goodput_mbps)}"
        )
    return d.goodput_by_id(d.roster.members[-1] + 1)


def with_extensions(d: Descriptor, block: bytes) -> Descriptor:
    """A descriptor that was read up to its block, with the block's fields.

    Raises:
        MalformedDatagram: as `read_extensions`, or a roster that does not fit the goodputs.
    """
    if not block:
        return d
    found = read_extensions(block)
    roster = found.pop("roster", None)
    d = d._replace(**found)
    if roster is None:
        return d
    grown = d.with_roster(roster)
    if d.agent_id in roster.members and listed_goodput(grown) == d.peer_goodput_mbps:
        return grown
    if block[0] > VERSION:
        return d
    raise MalformedDatagram(
        f"roster {roster.members} of drone {d.agent_id} does not fit its peer_goodput of {len(d.peer_goodput_mbps)} entries: "
        "it must hold the drone, and goodput must end with the highest member and be 0 to others"
    )


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
        peers, targets = len(listed_goodput(d)), len(d.priority_target_ids)
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
