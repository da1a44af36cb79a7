"""What is forged, replayed, malformed, cut or too large is dropped with its reason, and changes nothing."""

from __future__ import annotations

import hashlib

import pytest
from agent_rig import memory
from fleet_examples import DESCRIPTOR
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.auth import MAX_COUNTER, Dropped, DropReason, Opened, Sealer, open_datagram, tag
from sortie.fleet.messages.wire import encode_descriptor

KEY, OTHER = bytes(range(32)), bytes(range(1, 33))
KEYS = {7: KEY}
PAYLOAD = encode_descriptor(DESCRIPTOR)


def sealed(payload: bytes = PAYLOAD, key: bytes = KEY, key_id: int = 7, counter: int = 1) -> bytes:
    return Sealer(key, key_id, counter - 1).seal(payload)


def reason(data: bytes, keys: dict[int, bytes] | None = KEYS) -> str:
    result = open_datagram(data, keys)
    return result.reason.value if isinstance(result, Dropped) else "taken"


def test_tag_is_rfc_4231s_hmac_sha256_cut_to_16_bytes() -> None:
    """RFC 4231, test case 2."""
    assert tag(b"Jefe", b"what do ya want for nothing?").hex() == "5bdcc146bf60754e6a042426089575c7"


def test_a_sealed_descriptor_by_hand() -> None:
    """28 B more, 208 B at five drones; HMAC written out with its two pads."""
    data = sealed(counter=258)
    assert len(data) == 208
    assert data[:180] == PAYLOAD
    assert data[180:192] == bytes([7, 0, 0, 0, 2, 1, 0, 0, 0, 0, 0, 0])
    inner, outer = (bytes(b ^ pad for b in KEY.ljust(64, b"\0")) for pad in (0x36, 0x5C))
    digest = hashlib.sha256(outer + hashlib.sha256(inner + data[:192]).digest()).digest()
    assert data[192:] == digest[:16]


def test_it_opens_for_who_has_the_key_and_counts_up() -> None:
    sealer = Sealer(KEY, 7)
    opened = [open_datagram(sealer.seal(PAYLOAD), KEYS) for _ in range(3)]
    assert opened == [Opened(DESCRIPTOR, 7, counter) for counter in (1, 2, 3)]
    with pytest.raises(OverflowError, match="take a new key"):
        Sealer(KEY, 7, MAX_COUNTER).seal(PAYLOAD)


def test_what_does_not_open_has_its_reason() -> None:
    for data, expected in (
        (sealed(key=OTHER), "forged"),
        (sealed(key_id=8), "unknown_key"),
        (PAYLOAD + bytes(28), "unknown_key"),
        (sealed()[:-1], "unknown_key"),  # the trailer's fields stand elsewhere then
        (sealed()[:191], "truncated"),
        (b"", "truncated"),
        (sealed(bytes(1025)), "oversized"),  # even with a good tag
        (bytes(100_000), "oversized"),
        (sealed(bytes(1024)), "malformed"),
        (sealed(b"\x01" + PAYLOAD[1:]), "malformed"),
        (sealed(), "taken"),
    ):
        assert reason(data) == expected


@given(st.integers(0, 8 * 208 - 1))
def test_no_flipped_bit_gets_through(bit: int) -> None:
    data = bytearray(sealed())
    data[bit // 8] ^= 1 << bit % 8
    assert reason(bytes(data)) == ("unknown_key" if 180 <= bit // 8 < 184 else "forged")


@given(st.binary(max_size=1500), st.booleans())
def test_random_bytes_never_raise_and_never_pass(data: bytes, authentication: bool) -> None:
    assert reason(data, KEYS if authentication else None) != "taken"


def test_the_parser_sees_no_unauthenticated_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bytes] = []
    monkeypatch.setattr(
        "sortie.fleet.messages.auth.decode_descriptor", lambda payload: seen.append(payload) or DESCRIPTOR
    )
    for data in (sealed(key=OTHER), sealed(key_id=8), sealed()[:-1], sealed(bytes(1025)), PAYLOAD):
        open_datagram(data, KEYS)
    assert seen == []
    open_datagram(sealed(), KEYS)
    assert seen == [PAYLOAD]


def take(mine: PeerMemory, data: bytes, keys: dict[int, bytes] | None = KEYS) -> DropReason | None:
    return mine.hear(open_datagram(data, keys), 0.0)


def highest(mine: PeerMemory, sender: int, key_id: int = 7) -> int:
    return int(mine.table.counters(key_id)[mine.row, sender])


def test_each_receiver_takes_a_datagram_once() -> None:
    one, two = memory(), memory(1)
    assert take(one, sealed(counter=5)) is None
    assert take(one, sealed(counter=5)) is DropReason.REPLAYED
    assert take(two, sealed(counter=5)) is None
    assert one.view(0.0).descriptors == two.view(0.0).descriptors == {DESCRIPTOR.agent_id: DESCRIPTOR}


def test_older_than_the_newest_is_a_replay_and_every_sender_and_key_counts_alone() -> None:
    mine, keys = memory(), {7: KEY, 8: OTHER}
    assert take(mine, sealed(counter=9)) is None
    assert take(mine, sealed(counter=8)) is DropReason.REPLAYED
    assert take(mine, sealed(encode_descriptor(DESCRIPTOR._replace(agent_id=4)), counter=1)) is None
    assert (highest(mine, 3), highest(mine, 4), highest(mine, 5)) == (9, 1, 0)
    assert take(mine, sealed(key=OTHER, key_id=8, counter=1), keys) is None
    assert take(mine, sealed(counter=9), keys) is DropReason.REPLAYED


def test_a_counter_may_take_all_its_bits() -> None:
    mine = memory()
    assert take(mine, sealed(counter=MAX_COUNTER - 1)) is None
    assert take(mine, sealed(counter=MAX_COUNTER)) is None
    assert take(mine, sealed(counter=MAX_COUNTER)) is DropReason.REPLAYED


def test_what_is_dropped_changes_nothing() -> None:
    """Above all: a forged datagram with a huge counter does not lock the honest sender out."""
    mine = memory()
    take(mine, sealed(counter=1))
    attacks = {
        DropReason.FORGED: sealed(key=OTHER, counter=MAX_COUNTER),
        DropReason.UNKNOWN_KEY: sealed(key_id=9, counter=MAX_COUNTER),
        DropReason.MALFORMED: sealed(b"\x01" + PAYLOAD[1:], counter=MAX_COUNTER),
        DropReason.OVERSIZED: sealed(bytes(2000), counter=MAX_COUNTER),
        DropReason.TRUNCATED: sealed()[:50],
        DropReason.REPLAYED: sealed(counter=1),
    }
    assert set(attacks) == set(DropReason)
    for expected, data in attacks.items():
        assert take(mine, data) is expected
        assert highest(mine, DESCRIPTOR.agent_id) == 1
    assert take(mine, sealed(counter=2)) is None


def test_without_authentication_descriptors_come_bare() -> None:
    mine = memory()
    assert take(mine, PAYLOAD, None) is None
    assert take(mine, PAYLOAD, None) is None  # nothing tells a replay from an original
    assert take(mine, b"\x01" + PAYLOAD[1:], None) is DropReason.MALFORMED
    assert take(mine, bytes(1025), None) is DropReason.OVERSIZED
    assert take(mine, PAYLOAD[:100], None) is DropReason.TRUNCATED
    assert take(mine, sealed(), None) is DropReason.MALFORMED  # a sealed one is no bare one


def test_sealer_refuses_bad_keys() -> None:
    with pytest.raises(ValueError, match="key has 5 B, must have at least 16"):
        Sealer(b"short", 1)
    with pytest.raises(ValueError, match="key_id is -1, must be in"):
        Sealer(KEY, -1)
