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

In large fleets that list would not fit, nor an id into its byte. If a roster names an id of `WIDE_FROM` or more, the field `wide`
stands in place of the roster: the drone's id, the roster's epoch, and the members' ids, 2 B each. The descriptor's list
then holds goodput to the members alone, and its id is `WIDE_ID`, so that a reader that does not know the field refuses it.

To add a field: a field with a default in `sortie.policies.contract.Descriptor`, and a line in `FIELDS`.
"""

from __future__ import annotations

import re
import reprlib
import struct
from collections.abc import Callable
from functools import lru_cache
from operator import ge
from typing import Any, NamedTuple

from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.perception.budget import CODEBOOK_BYTES
from sortie.policies.contract import Descriptor, Roster, TaskPhase
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.errors import SortieError

MAX_DESCRIPTOR_BYTES = 1024
MAX_AGENT_ID = 254
"""In a byte."""
WIDE_ID = 255
"""Stands in that byte for an id that follows in two bytes."""
MAX_WIDE_ID = (1 << 16) - 2
WIDE_FROM = LISTED_IDS
"""A roster with this id or a higher one is written by its members' ids."""
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


def is_wide(d: Descriptor) -> bool:
    """Whether a descriptor names ids in two bytes: its own does not fit into one, or its roster reaches `WIDE_FROM`."""
    return d.agent_id > MAX_AGENT_ID or (d.roster is not None and d.roster.members[-1:] >= (WIDE_FROM,))


def _encode_roster(roster: Roster) -> bytes:
    """Epoch, 4 B, and a bit for each id, lowest first, up to the highest member's byte."""
    epoch, members = roster
    return epoch.to_bytes(4, "little") + sum(1 << i for i in members).to_bytes(members[-1] // 8 + 1, "little")


def _encode_wide(drone: int, roster: Roster) -> bytes:
    """The drone's id, 2 B, the epoch, 4 B, and the members' ids, 2 B each."""
    return struct.pack(f"<HI{len(roster.members)}H", drone, *roster[:1], *roster.members)


@lru_cache(maxsize=1 << 13)  # of each drone of a large fleet; it changes seldom
def _decode_wide(value: bytes) -> tuple[int, Roster]:
    count, odd = divmod(len(value) - 6, 2)
    if count < 1 or odd:
        raise MalformedDatagram(f"wide has {len(value)} B, must have 6 and 2 for each member, one at least")
    drone, epoch, *members = struct.unpack(f"<HI{count}H", value)
    if any(map(ge, members, members[1:])) or members[-1] > MAX_WIDE_ID or drone not in members:
        raise MalformedDatagram(
            f"wide names drone {drone} and members {reprlib.repr(tuple(members))}, must be ascending ids up to {MAX_WIDE_ID}, "
            "the drone among them"
        )
    return drone, Roster(epoch, tuple(members))


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
"""Every optional field that is one of `Descriptor`, by ascending type."""
WIDE_FIELD = 4
"""Type of the field `wide`, which is no field of `Descriptor`: it is read as the drone's id and its roster."""
_DECODERS = {field.number: (field.name, field.decode) for field in FIELDS} | {WIDE_FIELD: ("wide", _decode_wide)}
_WITH_DEFAULTS = tuple((field, Descriptor._field_defaults[field.name]) for field in FIELDS)


def listed_goodput(d: Descriptor) -> tuple[float, ...]:
    """The goodputs as they are listed on the wire: by ascending id; to the members alone where ids are wide.

    Raises:
        ValueError: no roster though the drone's id needs two bytes; a roster that no wire can hold, without the drone itself,
            or with another number of other members than there are goodputs.
    """
    if d.roster is None:
        if d.agent_id > MAX_AGENT_ID:
            raise ValueError(f"agent_id is {d.agent_id}, must be at most {MAX_AGENT_ID} without a roster")
        return d.peer_goodput_mbps
    epoch, members = d.roster
    if not 0 <= epoch < 2**32:
        raise ValueError(f"roster.epoch is {epoch}, must be in [0, 2³²)")
    if not members or not 0 <= members[0] <= members[-1] <= MAX_WIDE_ID or any(map(ge, members, members[1:])):
        raise ValueError(
            f"roster.members is {reprlib.repr(members)}, must be ascending ids in [0, {MAX_WIDE_ID}], one at least"
        )
    if d.roster.slot(d.agent_id) is None or len(d.peer_goodput_mbps) != len(members) - 1:
        raise ValueError(
            f"roster.members is {reprlib.repr(members)}, must hold agent_id = {d.agent_id} and as many others as "
            f"peer_goodput has entries, {len(d.peer_goodput_mbps)}"
        )
    return d.peer_goodput_mbps if is_wide(d) else d.goodput_by_id(members[-1] + 1)


def with_extensions(d: Descriptor, block: bytes) -> Descriptor:
    """A descriptor that was read up to its block, with the block's fields.

    Raises:
        MalformedDatagram: as `read_extensions`, an id that needs the field `wide` without it, or a roster that does not fit the
            goodputs.
    """
    if not block and d.agent_id <= MAX_AGENT_ID:
        return d
    found = read_extensions(block)
    roster, wide = found.pop("roster", None), found.pop("wide", None)
    if found:
        d = d._replace(**found)
    if wide is not None:
        drone, members = wide
        return _widened(d, drone, members, roster)
    if d.agent_id > MAX_AGENT_ID:
        raise MalformedDatagram(f"agent_id is {d.agent_id}, must be at most {MAX_AGENT_ID} without the field wide")
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


def _widened(d: Descriptor, drone: int, roster: Roster, narrow: Roster | None) -> Descriptor:
    if d.agent_id != WIDE_ID or narrow is not None:
        raise MalformedDatagram(f"wide stands beside agent_id {d.agent_id} or a roster, must be beside {WIDE_ID} alone")
    others = len(roster.members) - 1
    if len(d.peer_goodput_mbps) != others:
        raise MalformedDatagram(
            f"wide names {others} other members, peer_goodput has {len(d.peer_goodput_mbps)} entries"
        )
    return d._replace(agent_id=drone, roster=roster)


def append_extensions(body: bytes, d: Descriptor) -> bytes:
    """A descriptor's bytes with its optional fields behind them; `body` itself where all have their defaults.

    Raises:
        DescriptorTooLarge: more than 1,024 B, naming the part that is too long.
        ValueError: a value that its field cannot hold.
    """
    block, wide = b"", is_wide(d)
    for field, default in _WITH_DEFAULTS:
        value = getattr(d, field.name)
        if value != default and not (wide and field.name == "roster"):
            encoded = field.encode(value)
            block += _HEAD.pack(field.number, len(encoded)) + encoded
    if wide and d.roster is not None:
        encoded = _encode_wide(d.agent_id, d.roster)
        block += _HEAD.pack(WIDE_FIELD, len(encoded)) + encoded
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
        known = _DECODERS.get(number)
        if known is not None:
            name, decode = known
            try:
                found[name] = decode(block[at : at + length])
            except MalformedDatagram:
                if block[0] <= VERSION:
                    raise
        at, last = at + length, number
    return found
