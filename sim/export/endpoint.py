"""Where MAVLink goes, and the key that signs it, as users write them."""

from __future__ import annotations

import socket
from pathlib import Path

from sortie.fleet.logs.telemetry import KEY_BYTES
from sortie.scenarios.regular import regular
from sortie.sim.folders import RunError


def parse_address(address: str) -> tuple[bool, str, int]:
    """Whether to wait for a peer, and host and port."""
    kind, _, rest = address.partition(":")
    host, _, port = rest.rpartition(":")
    least = int(kind == "udpout")  # any free port may be waited at, none sent to
    if kind not in ("udpout", "udpin") or not host or not port.isdecimal() or not least <= int(port) <= 65_535:
        raise RunError(f"{address!r} is no MAVLink address, must be as udpout:127.0.0.1:14550 or udpin:127.0.0.1:14550")
    return kind == "udpin", host, int(port)


def open_address(address: str) -> tuple[socket.socket, tuple[str, int] | None]:
    """A UDP socket for a MAVLink address, and the peer to send to: None with `udpin`, which waits for one.

    With `udpin` it is bound to HOST. With `udpout` it is bound to the address of this host from which HOST is reached,
    so that 127.0.0.1 opens no port to other hosts.

    Raises:
        RunError: an address that is none, is taken, or is not reached.
    """
    waits, host, port = parse_address(address)
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        # a name is looked up once, not for every frame
        where: tuple[str, int] = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4][:2]  # type: ignore[assignment]
        if waits:
            opened.bind(where)
            return opened, None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect(where)  # sends nothing
            opened.bind((probe.getsockname()[0], 0))
        return opened, where
    except (OSError, UnicodeError) as error:  # the latter of a name that none can be, as a..b
        opened.close()
        why = error.strerror if isinstance(error, OSError) else "no name of a host"
        raise RunError(f"{address}: {why}") from error


def read_key(path: Path) -> bytes:
    """A signing key out of a file: 64 hexadecimal digits, or 32 B as they are. It is told to nobody.

    Raises:
        RunError: the file cannot be read or holds neither.
    """
    try:
        content = regular(path).read_bytes()
    except OSError as error:
        raise RunError(f"{path}: {error.strerror}") from error
    if len(content) == KEY_BYTES:
        return content
    try:
        key = bytes.fromhex(content.decode("ascii"))
    except ValueError:  # includes what is no ASCII
        key = b""
    if len(key) != KEY_BYTES:
        raise RunError(f"{path}: no signing key, must hold {2 * KEY_BYTES} hexadecimal digits or {KEY_BYTES} bytes")
    return key
