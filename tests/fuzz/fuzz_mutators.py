"""Damage that a file may have, and values that no file should have: seeded, so that a case is its number.

A mutator takes the draws, the file and the corpus, and returns another file. The general ones know nothing of a format;
those of one format keep its frame whole (lengths, checksums, archives), so that the damage reaches what stands behind it.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from random import Random

Mutator = Callable[[Random, bytes, Sequence[bytes]], bytes]

MAX_BYTES = 400_000
"""A longer file is cut: what takes long should take long because of the reader."""
NUMBERS = (
    0,
    1,
    2,
    3,
    0x7F,
    0x80,
    0xFF,
    0x100,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
FLOATS = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-310,
    1e38,
    -1e38,
    3.5e38,
    1e308,
    float("inf"),
    float("-inf"),
    float("nan"),
    85.0,
    180.0,
)
WORDS = (
    "", "0", "-1", "1e999", "-1e308", "nan", "inf", "null", "~", "true", "{}", "[]", "[[[[]]]]", "''", "0x10", "1_0", "9" * 40,
    "\N{ARABIC-INDIC DIGIT THREE}", "\u2028", "é", "\N{GRINNING FACE}", "a" * 300, "../..", "a\tb", "- -", ": :", "*a", "&a 1",
)  # fmt: skip
_DIGITS = re.compile(rb"-?\d+(?:\.\d+)?")


def flip(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    out = bytearray(data)
    for _ in range(draw.randint(1, 8) if out else 0):
        out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    return bytes(out)


def number(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """Overwrite one, two, four or eight bytes with a number that means something: lengths, counts, offsets, floats."""
    size = draw.choice((1, 2, 4, 8))
    if len(data) < size:
        return data
    at = draw.randrange(len(data) - size + 1)
    value = draw.choice(NUMBERS) if draw.random() < 0.7 else draw.getrandbits(8 * size)
    new = (value % (1 << 8 * size)).to_bytes(size, draw.choice(("little", "big")))
    if size >= 4 and draw.random() < 0.3:
        new = special_float(draw, size)
    return data[:at] + new + data[at + size :]


def special_float(draw: Random, size: int) -> bytes:
    try:
        return struct.pack("<f" if size == 4 else "<d", draw.choice(FLOATS))
    except OverflowError:
        return struct.pack("<f", 3.4e38)


def cut(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    return data[: draw.randint(0, len(data))]


def drop(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    at, size = draw.randint(0, len(data)), _size(draw)
    return data[:at] + data[at + size :]


def repeat(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """A part again, once or hundreds of times: deep nesting, endless lists, records twice."""
    at, size = draw.randint(0, len(data)), _size(draw)
    return data[:at] + data[at : at + size] * draw.choice((2, 2, 2, 3, 10, 100, 1000)) + data[at + size :]


def insert(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    at = draw.randint(0, len(data))
    return data[:at] + draw.randbytes(_size(draw)) + data[at:]


def splice(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """The begin of this file and the end of another."""
    other = draw.choice(corpus)
    return data[: draw.randint(0, len(data))] + other[draw.randint(0, len(other)) :]


def swap(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    a, b, c, d = sorted(draw.randint(0, len(data)) for _ in range(4))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def digits(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """Another word where a number is written out."""
    found = list(_DIGITS.finditer(data))
    if not found:
        return data
    at = draw.choice(found)
    return data[: at.start()] + draw.choice(WORDS).encode() + data[at.end() :]


def encoding(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """The text in another encoding."""
    text = data.decode("utf-8", "replace")
    return text.encode(
        draw.choice(("utf-16", "utf-16-le", "utf-32", "latin-1", "cp500", "utf-8-sig", "utf-7")), "replace"
    )


def token(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """A word in place of, or beside, one that stands there."""
    found = list(re.finditer(rb"[A-Za-z_0-9.]+", data[:20_000]))
    if not found:
        return data
    at = draw.choice(found)
    new = draw.choice(WORDS).encode() if draw.random() < 0.5 else draw.choice(found).group()
    return data[: at.start()] + new + data[draw.choice((at.start(), at.end())) :]


def lines(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """Lines dropped, doubled, moved, indented, or taken from another file."""
    rows = data.split(b"\n")
    at = draw.randrange(len(rows))
    match draw.randrange(5):
        case 0:
            del rows[at]
        case 1:
            rows.insert(at, draw.choice(rows))
        case 2:
            rows[at : at + 1] = [b" " * draw.choice((1, 2, 4, 40)) + rows[at]]
        case 3:
            rows.insert(at, draw.choice(draw.choice(corpus).split(b"\n")))
        case 4:
            rows[at] = rows[at].partition(b":")[0] + b": " + draw.choice(WORDS).encode()
    return b"\n".join(rows)


def _size(draw: Random) -> int:
    return draw.choice((1, 2, 4, 8, 16, draw.randint(1, 64), draw.randint(1, 2000)))


BINARY: tuple[Mutator, ...] = (flip, flip, number, number, number, cut, drop, repeat, insert, splice, swap)
TEXT: tuple[Mutator, ...] = (lines, lines, lines, token, token, digits, digits, encoding, *BINARY)


def mutated(draw: Random, corpus: Sequence[bytes], mutators: Sequence[Mutator]) -> bytes:
    """One case: a file of the corpus, damaged once to four times."""
    data = draw.choice(corpus)
    for _ in range(draw.choice((1, 1, 1, 2, 2, 3, 4))):
        data = draw.choice(mutators)(draw, data, corpus)[:MAX_BYTES]
    return data


# --- formats ---------------------------------------------------------------------------------------


def in_messages(split: Callable[[bytes], list[bytes]], join: Callable[[bytes], bytes] = bytes) -> Mutator:
    """Messages of a log dropped, doubled, moved, or damaged inside; `join` mends a message's length or checksum."""

    def mutate(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
        messages = split(data)
        if len(messages) < 2:
            return data
        # the first ones describe the others
        at = draw.randrange(min(len(messages), 30) if draw.random() < 0.7 else len(messages))
        match draw.randrange(6):
            case 0:
                del messages[at]
            case 1:
                messages[at:at] = [draw.choice(messages)] * draw.choice((1, 1, 5, 300))
            case 2:
                messages.insert(at, draw.choice(split(draw.choice(corpus)) or messages))
            case _:
                inner = draw.choice((number, flip, drop, insert, repeat, digits, token, cut))
                messages[at] = join(inner(draw, messages[at], corpus))
        return b"".join(messages)

    return mutate


def ulog_messages(data: bytes) -> list[bytes]:
    """Header, then messages."""
    found, at = [data[:16]], 16
    while at + 3 <= len(data):
        after = at + 3 + int.from_bytes(data[at : at + 2], "little")
        found.append(data[at:after])
        at = after
    return found


def ulog_joined(message: bytes) -> bytes:
    """With the length that it has."""
    return min(len(message) - 3, 65535).to_bytes(2, "little") + message[2:65538] if len(message) > 3 else message


def dataflash_messages(data: bytes) -> list[bytes]:
    return [b"\xa3\x95" + part for part in data.split(b"\xa3\x95")[1:]]


def tlog_messages(data: bytes) -> list[bytes]:
    """Stamp and MAVLink 2 frame each."""
    found, at = [], 0
    while at + 10 <= len(data):
        after = at + 8 + 12 + data[at + 9]
        found.append(data[at:after])
        at = after
    return found


def tlog_joined(message: bytes) -> bytes:
    """With the length and the checksum that it has, where its kind is known."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    if len(message) < 21 or message[8] != 0xFD:
        return message
    known = dialect.mavlink_map.get(int.from_bytes(message[15:18], "little"))
    if known is None:
        return message
    body = bytearray(message[9:-2][:264])
    body[0] = len(body) - 9 if len(body) >= 9 else 0
    crc = dialect.x25crc(body)
    crc.accumulate(bytes([known.crc_extra]))
    return message[:9] + bytes(body) + struct.pack("<H", crc.crc)


def in_archive(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """A zip whose members are damaged inside and packed again, or whose flags, methods and streams are damaged outside."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except Exception:
        return number(draw, data, corpus)
    if not members:
        return data
    at = draw.randrange(len(members))
    name, content = members[at]
    match draw.randrange(5):
        case 0:
            del members[at]
        case 1:
            members.append((draw.choice((name, "other.npy", "/abs.npy", "t_s")), content))
        case 2:  # the header of the array
            end = content.find(b"\n")
            members[at] = (
                name,
                draw.choice((digits, token, repeat, flip))(draw, content[: end + 1], [content]) + content[end + 1 :],
            )
        case _:
            members[at] = name, draw.choice((flip, number, cut, repeat, insert))(draw, content, [content])
    out = io.BytesIO()
    kind = draw.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    with zipfile.ZipFile(out, "w", kind) as archive:
        for name, content in dict(members).items():
            archive.writestr(name, content)
    packed = out.getvalue()
    if draw.random() < 0.4:  # flags, method, sizes and offsets of one entry, here or in the directory
        heads = [m.start() for m in re.finditer(rb"PK(\x01\x02|\x03\x04|\x05\x06)", packed)]
        begin = draw.choice(heads) + draw.randint(4, 30)
        packed = packed[:begin] + number(draw, packed[begin : begin + 8], corpus) + packed[begin + 8 :]
    elif draw.random() < 0.3 and len(packed) > 200:  # the stream
        begin = draw.randrange(30, len(packed) - 60)
        packed = packed[:begin] + flip(draw, packed[begin : begin + 40], corpus) + packed[begin + 40 :]
    return packed


def in_json(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """A tree of plain values with one of them replaced, dropped, renamed, nested or doubled; JSON is YAML too."""
    try:
        tree = json.loads(data)
    except ValueError:
        return lines(draw, data, corpus)
    places = list(_places(tree))
    if not places:
        return data
    holder, key = draw.choice(places)
    match draw.randrange(6):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[draw.choice((draw.choice(WORDS), f"{key}x", draw.choice(places)[1].__str__()))] = holder.pop(key)
        case 2:
            deep: object = holder[key]
            for _ in range(draw.choice((1, 3, 15, 30, 2000))):
                deep = [deep] if draw.random() < 0.5 else {"a": deep}
                if draw.random() < 0.001:
                    break
            holder[key] = deep
        case 3:
            other, there = draw.choice(places)
            holder[key] = json.loads(json.dumps(other[there]))
        case 4 if isinstance(holder[key], (int, float)):
            value = holder[key]
            holder[key] = draw.choice(
                (-value, value * 1000, value / 1000, value + 1, int(value), 0, -1, 1e300, 10**18, 10**40)
            )
        case _:
            holder[key] = draw.choice(
                (None, True, -1, 0, 1.5, 1e308, 10**30, "", "x", [], {}, [1, 2, 3], {"a": 1}, *WORDS)
            )
    try:
        return json.dumps(tree, ensure_ascii=draw.random() < 0.5).encode("utf-8", "surrogatepass")
    except RecursionError:
        return data


def _places(tree: object) -> list[tuple[object, object]]:
    found: list[tuple[object, object]] = []
    waiting = [tree]
    while waiting:
        one = waiting.pop()
        keys = one.keys() if isinstance(one, dict) else range(len(one)) if isinstance(one, list) else ()
        found += [(one, key) for key in keys]
        waiting += [one[key] for key in keys]
    return found
