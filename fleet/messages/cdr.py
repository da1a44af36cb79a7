"""The little of CDR that the context plane needs: XCDR1, little endian, ROS 2's alignment.

A datagram is a 4-byte encapsulation header and the fields one after the other. A primitive of k bytes begins at a
multiple of k, counted from after the header; a sequence is a uint32 count and its elements. (OMG DDS-XTypes 1.3,
§7.4.1 and §7.6.3.1.2; DDSI-RTPS 2.5, §10.)
"""

from __future__ import annotations

import struct

ENCAPSULATION = b"\x00\x01\x00\x00"
"""CDR_LE, no options."""

_ALIGN = {"B": 1, "H": 2, "i": 4, "I": 4, "f": 4}


class MalformedDatagram(ValueError):
    """Bytes that are not what they claim to be; `reason` says why. The only error that decoding raises."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def layout(*fields: tuple[str, int]) -> tuple[struct.Struct, tuple[int, ...]]:
    """Compile fields with CDR padding between them, the encapsulation header in front as 4 bytes.

    Args:
        fields: (struct code, count) each; codes B H i I f, or s for an opaque byte array.

    Returns:
        The struct (its first value is the header) and every field's offset in the datagram.
    """
    format_, at, offsets = "<4s", 0, []
    for code, count in fields:
        size = _ALIGN.get(code, 1)
        pad = -at % size if count else 0
        format_ += ("x" * pad) + (f"{count}{code}" if count else "")
        offsets.append(4 + at + pad)
        at += pad + size * count
    return struct.Struct(format_), tuple(offsets)


def check_encapsulation(header: bytes) -> None:
    """Refuse everything but plain little-endian CDR.

    Raises:
        MalformedDatagram: with the header found.
    """
    if header != ENCAPSULATION:
        raise MalformedDatagram(f"encapsulation is {header.hex()}, must be {ENCAPSULATION.hex()}")
