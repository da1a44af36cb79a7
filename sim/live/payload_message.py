"""The bytes of a payload as CDR of `std_msgs/msg/UInt8MultiArray`."""

from __future__ import annotations

import struct

from sortie.fleet.messages.cdr import ENCAPSULATION, MalformedDatagram

_BYTES = struct.Struct("<4s3I")  # an empty layout (no dimensions, offset 0), then the count of bytes
BYTES_OVERHEAD = _BYTES.size
"""What a `UInt8MultiArray` puts in front of its bytes, encapsulation included."""


def pack_bytes(content: bytes) -> bytes:
    """Bytes as CDR of `std_msgs/msg/UInt8MultiArray`."""
    return _BYTES.pack(ENCAPSULATION, 0, 0, len(content)) + content


def unpack_bytes(cdr: bytes) -> bytes:
    """The bytes of a `UInt8MultiArray` with an empty layout.

    Raises:
        MalformedDatagram: for anything else.
    """
    if len(cdr) < BYTES_OVERHEAD:
        raise MalformedDatagram(f"{len(cdr)} B, must be at least {BYTES_OVERHEAD}")
    header, dimensions, offset, count = _BYTES.unpack_from(cdr)
    if header != ENCAPSULATION or dimensions or offset or not 0 <= len(cdr) - BYTES_OVERHEAD - count < 4:
        raise MalformedDatagram("no UInt8MultiArray with an empty layout")
    return cdr[BYTES_OVERHEAD : BYTES_OVERHEAD + count]
