"""Seals on the bus: which key a message is sealed with, who can make it, and which messages are refused.

    secret of the fleet     HMAC(master key, "fleet")      every member has it: descriptors and payloads
    secret of drone 0       HMAC(master key, "drone 0")    only drone 0 has it: directives to its own gate
    key of a topic          HMAC(secret, topic's name)

The threat model in three sentences. A stranger may read, record, repeat and write messages; without a key nothing that
he writes is accepted, and nothing that he repeats is accepted twice. A member of the fleet that was captured has the
fleet's secret, so it can publish false descriptors and payloads; trust judges them, and no member can command the gate
of another drone. Who has the master key, or may read the memory of a drone's processes, can do all that this drone can.

A sealed message is the message as it is, then 28 B as `sortie.fleet.messages.auth` writes them. The counter is the time in
nanoseconds since 1970, and rises with every message of a sender. A node that was restarted therefore goes on above its
old counters, and a node that starts late refuses what was recorded before it started. A counter that is ahead of the
receiver's clock is refused too: one such message would otherwise refuse all later ones of its sender.
"""

from __future__ import annotations

import hmac
import os
import secrets
import stat
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sortie.fleet.messages.auth import Dropped, DropReason, Opened, Sealer, open_datagram, unseal
from sortie.scenarios.regular import regular
from sortie.sim.export.endpoint import read_key
from sortie.sim.export.topics import CONTEXT, Topic, TopicKind
from sortie.sim.folders import RunError

KEY_VARIABLE = "SORTIE_KEY"
"""The environment variable with the master key as 64 hexadecimal digits."""
KEY_ID = 1
CLOCKS_AGREE_S = 2.0
"""Clocks of drones differ by so much at most. A node accepts messages that were sealed this long before it started, and
messages from this far in the future."""
_MOST_PADDING = 3
"""DDS fills a sample to a multiple of 4 B."""
_OWN_COUNTERS = 64


class Secrets(NamedTuple):
    """What one drone has of the master key."""

    fleet: bytes
    own: bytes


def secrets_of(master: bytes, drone: int) -> Secrets:
    """The secrets of a drone; the master key cannot be computed from them."""
    return Secrets(_derive(master, "fleet"), _derive(master, f"drone {drone}"))


def find_key(path: Path | None) -> bytes:
    """The master key: from a file that only its owner may read, else from `SORTIE_KEY`, else a new random one.

    Raises:
        RunError: a file that others may read, or a key that is none.
    """
    if path is not None:
        return read_own_key(path)
    text = os.environ.get(KEY_VARIABLE)
    if text is None:
        return secrets.token_bytes(32)
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != 32:
        raise RunError(f"{KEY_VARIABLE} has {len(text)} characters, must be 64 hexadecimal digits")
    return key


def read_own_key(path: Path) -> bytes:
    """A key of 32 B from a file that only its owner may read.

    Raises:
        RunError: a file that others may read, or one that holds no key.
    """
    _check_mode(path)
    return read_key(path)


def _check_mode(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}") from error
    if stat.S_IMODE(mode) & 0o077:
        raise RunError(f"{path}: its mode is {stat.S_IMODE(mode):o}, must be 600: others may read or write the key")


def read_secrets(path: Path) -> Secrets:
    """A drone's secrets from a file that only its owner may read: 128 hexadecimal digits, as `write_secrets` writes.

    Raises:
        RunError: a file that others may read, or one that holds no secrets.
    """
    _check_mode(path)
    try:
        both = bytes.fromhex(regular(path).read_text("ascii"))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}") from error
    except ValueError:
        both = b""
    if len(both) != 64:
        raise RunError(f"{path}: no secrets of a drone, must hold 128 hexadecimal digits")
    return Secrets(both[:32], both[32:])


def write_secrets(path: Path, held: Secrets) -> None:
    """Write a drone's secrets to a new file that only its owner may read.

    Raises:
        RunError: the file exists or cannot be written.
    """
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write((held.fleet + held.own).hex())
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}") from error


class Seals:
    """One node's seals: it seals what it sends, and opens what it receives. Without secrets, messages come bare."""

    def __init__(
        self, own: Secrets | None, drone: int | None = None, *, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        """
        Args:
            own: the drone's secrets; None where authentication is off.
            drone: its number; None for a node that belongs to no drone, as the bench.
            clock_ns: nanoseconds since 1970.
        """
        self._own, self._drone, self._clock_ns = own, drone, clock_ns
        self._floor = clock_ns() - round(CLOCKS_AGREE_S * 1e9)
        self._keys: dict[Topic, bytes] = {}
        self._sealers: dict[Topic, Sealer] = {}
        self._highest: dict[Topic, int] = {}
        self._sent: deque[int] = deque(maxlen=_OWN_COUNTERS)

    def seal(self, topic: Topic, content: bytes) -> bytes:
        """The content as it goes to a topic."""
        if self._own is None:
            return content
        sealer = self._sealers.get(topic)
        if sealer is None:
            sealer = self._sealers[topic] = Sealer(self._key(topic), KEY_ID)
        sealer.counter = max(sealer.counter, self._clock_ns())
        sealed = sealer.seal(content)
        if topic == CONTEXT:
            self._sent.append(sealer.counter)
        return sealed

    def open(self, topic: Topic, data: bytes) -> bytes | Dropped:
        """The content of a directive or payload; `Dropped` says why it is refused."""
        if self._own is None:
            return data
        opened = unseal(data, {KEY_ID: self._key(topic)})
        if isinstance(opened, Dropped):
            return opened
        fault = self._wrong_time(opened.counter, self._highest.get(topic, self._floor))
        if fault is not None:
            return fault
        self._highest[topic] = opened.counter
        return opened.content

    def open_descriptor(self, cdr: bytes) -> Opened | Dropped:
        """Check a descriptor as it came over the bus. Whether its counter was used is left to the inbox, which knows its sender."""
        whole = self._open_padded(cdr)
        if isinstance(whole, Opened) and whole.key_id is not None:
            return self._wrong_time(whole.counter, self._floor) or whole
        return whole

    def _open_padded(self, cdr: bytes) -> Opened | Dropped:
        keys = None if self._own is None else {KEY_ID: self._key(CONTEXT)}
        whole = open_datagram(cdr, keys)
        if isinstance(whole, Dropped):
            for padding in range(1, _MOST_PADDING + 1):
                if any(cdr[-padding:]):
                    break
                shorter = open_datagram(cdr[:-padding], keys)
                if isinstance(shorter, Opened):
                    return shorter
        return whole

    def _wrong_time(self, counter: int, above: int) -> Dropped | None:
        """Why a counter is refused: it was used, or no clock of the fleet shows it yet."""
        if counter <= above:
            return Dropped(DropReason.REPLAYED, f"counter {counter}, must be above {above}")
        ahead_s = (counter - self._clock_ns()) * 1e-9
        if ahead_s > CLOCKS_AGREE_S:
            detail = f"its counter is {ahead_s:.1f} s ahead of this clock, must be at most {CLOCKS_AGREE_S:g} s"
            return Dropped(DropReason.MALFORMED, detail)
        return None

    def is_forged_self(self, opened: Opened) -> bool:
        """Whether a sealed descriptor in this drone's own name was made by somebody else."""
        return opened.key_id is not None and opened.counter not in self._sent

    def _key(self, topic: Topic) -> bytes:
        if topic not in self._keys:
            assert self._own is not None  # noqa: S101 - callers have checked
            own = topic.kind == TopicKind.DIRECTIVE and topic.source == self._drone
            self._keys[topic] = _derive(self._own.own if own else self._own.fleet, topic.name)
        return self._keys[topic]


def _derive(key: bytes, name: str) -> bytes:
    return hmac.digest(key, name.encode(), "sha256")
