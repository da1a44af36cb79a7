"""Who may speak on the context plane: a keyed tag and a counter on every descriptor, and what is dropped.

    descriptor (CDR) | key id, u32 | counter, u64 | HMAC-SHA256 over all before, first 16 B      little endian

28 B more, so 208 B at five drones. The counter rises with every datagram of a sender; a receiver takes only
counters above the highest it has taken from that sender, so a recorded datagram is worth nothing later (nor is one
that was overtaken on the way: keep-last-1 has no use for it).

The order of the checks is part of the design: size first, which bounds the work that junk can cause; the key and
the tag before the parser, so that no unauthenticated byte reaches it; the counter last and only if everything else
holds, so that no failed datagram ever moves it, else a forger could lock an honest sender out by one huge counter.

Limit: the key is the group's. It keeps strangers out; it cannot stop a member from impersonating another, which
takes a signature per member (Ed25519: 64 B instead of 16 B).
"""

from __future__ import annotations

import hmac
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

from sortie.fleet.messages.cdr import MalformedDatagram
from sortie.fleet.messages.compact import MARK, MIN_COMPACT_BYTES
from sortie.fleet.messages.extensions import MAX_DESCRIPTOR_BYTES
from sortie.fleet.messages.wire import MIN_DESCRIPTOR_BYTES, decode_descriptor
from sortie.policies.contract import Descriptor

TAG_BYTES = 16
MIN_KEY_BYTES = 16
_STAMP = struct.Struct("<IQ")  # key id, counter
TRAILER_BYTES = _STAMP.size + TAG_BYTES
MAX_COUNTER = 2**64 - 1


class DropReason(StrEnum):
    """Why a datagram was dropped."""

    OVERSIZED = "oversized"
    TRUNCATED = "truncated"
    UNKNOWN_KEY = "unknown_key"
    FORGED = "forged"
    MALFORMED = "malformed"
    REPLAYED = "replayed"


class Opened(NamedTuple):
    """A datagram that is what it claims to be; whether it is fresh is each receiver's own question."""

    descriptor: Descriptor
    key_id: int | None
    """None: authentication is off."""
    counter: int


@dataclass(frozen=True, slots=True)
class Dropped:
    """A datagram that is not."""

    reason: DropReason
    detail: str


class Unsealed(NamedTuple):
    """The content of a datagram with a valid tag."""

    content: bytes
    key_id: int
    counter: int


@lru_cache(maxsize=256)  # its sender and whoever hears it compute the same one
def tag(key: bytes, stamped: bytes) -> bytes:
    """HMAC-SHA256 (RFC 2104), truncated to its first 16 B (RFC 2104 §5 allows half the hash)."""
    return _tag(key, stamped)


def _tag(key: bytes, stamped: bytes) -> bytes:
    """`tag`, computed anew."""
    mac = _keyed(key).copy()
    mac.update(stamped)
    return mac.digest()[:TAG_BYTES]


@lru_cache(maxsize=256)
def _keyed(key: bytes) -> hmac.HMAC:
    """The key hashed in already: a copy of this and the message take half the time of both together."""
    return hmac.new(key, digestmod="sha256")


class Sealer:
    """A sender's side: stamps and tags, counting up."""

    def __init__(self, key: bytes, key_id: int, counter: int = 0) -> None:
        """
        Args:
            key: at least 16 B.
            key_id: 0 … 2³² − 1, which of the receivers' keys it is.
            counter: the last one used; a sender that restarts has to go on above it.

        Raises:
            ValueError: a short key, or a key id that is out of range.
        """
        if len(key) < MIN_KEY_BYTES:
            raise ValueError(f"key has {len(key)} B, must have at least {MIN_KEY_BYTES}")
        if not 0 <= key_id < 2**32:
            raise ValueError(f"key_id is {key_id}, must be in [0, 2³²)")
        self._key = key
        self.key_id = key_id
        self.counter = counter

    def seal(self, payload: bytes) -> bytes:
        """The payload with its trailer; 28 B longer.

        Raises:
            OverflowError: all 2⁶⁴ counters are used.
        """
        if self.counter >= MAX_COUNTER:
            raise OverflowError("the counter is used up: take a new key")
        self.counter += 1
        stamped = payload + _STAMP.pack(self.key_id, self.counter)
        return stamped + _tag_of(self._key, stamped)


def _tag_of(key: bytes, stamped: bytes) -> bytes:
    """The tag, from the cache if others may compute the same: payloads have one receiver and would fill the memory."""
    return tag(key, stamped) if len(stamped) <= MAX_DESCRIPTOR_BYTES + _STAMP.size else _tag(key, stamped)


def unseal(data: bytes, keys: Mapping[int, bytes]) -> Unsealed | Dropped:
    """Check the tag of a sealed datagram. Whether its counter is new is the receiver's own question."""
    size = len(data) - TRAILER_BYTES
    if size < 0:
        return Dropped(DropReason.TRUNCATED, f"{len(data)} B, must be at least {TRAILER_BYTES}")
    key_id, counter = _STAMP.unpack_from(data, size)
    key = keys.get(key_id)
    if key is None:
        return Dropped(DropReason.UNKNOWN_KEY, f"key id {key_id}")
    if not hmac.compare_digest(_tag_of(key, data[:-TAG_BYTES]), data[-TAG_BYTES:]):
        return Dropped(DropReason.FORGED, f"the tag does not fit key {key_id}")
    return Unsealed(data[:size], key_id, counter)


def open_datagram(data: bytes, keys: Mapping[int, bytes] | None) -> Opened | Dropped:
    """Check everything about a datagram that is the same for every receiver; changes nothing.

    A broadcast is the same bytes for all, so one result serves every drone that holds the same keys (`sortie.fleet.memory.hear`).

    Args:
        data: as received.
        keys: key id → key; None where authentication is off and descriptors come bare.
    """
    trailer = TRAILER_BYTES if keys is not None else 0
    size = len(data) - trailer
    if size > MAX_DESCRIPTOR_BYTES:
        return Dropped(DropReason.OVERSIZED, f"payload of {size} B, must be at most {MAX_DESCRIPTOR_BYTES}")
    least = MIN_COMPACT_BYTES if data[:1] == MARK else MIN_DESCRIPTOR_BYTES
    if size < least:
        return Dropped(DropReason.TRUNCATED, f"{len(data)} B, must be at least {least + trailer}")
    key_id, counter, payload = None, 0, data
    if keys is not None:
        unsealed = unseal(data, keys)
        if isinstance(unsealed, Dropped):
            return unsealed
        payload, key_id, counter = unsealed
    try:
        return Opened(decode_descriptor(payload), key_id, counter)
    except MalformedDatagram as error:
        return Dropped(DropReason.MALFORMED, error.reason)
