"""Sockets on loopback alone. Cyclone binds those on which it receives to all interfaces, and has no setting for it."""

from __future__ import annotations

import ctypes
import mmap
import os
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from typing import TypeVar

from cyclonedds.internal import load_cyclonedds

from sortie.sim.folders import RunError

_T = TypeVar("_T")
_ANY, _LOOPBACK = bytes(4), socket.inet_aton("127.0.0.1")
_LIBC = ctypes.CDLL(None, use_errno=True)
_LOCK = threading.Lock()
# tags of an ELF file's dynamic section
_STRINGS, _SYMBOLS, _DATA, _DATA_BYTES, _CALLS, _CALLS_BYTES = 5, 6, 7, 8, 23, 2


def _bind(number: int, address: int, length: int) -> int:
    """Bind a socket as the system does, and to 127.0.0.1 instead of all interfaces."""
    family, ip = ctypes.c_ushort.from_address(address), (ctypes.c_char * 4).from_address(address + 4)
    if family.value == socket.AF_INET and ip.raw == _ANY:
        ip.raw = _LOOPBACK
    return int(_LIBC.bind(number, ctypes.c_void_p(address), ctypes.c_uint32(length)))


_BIND = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_void_p, ctypes.c_uint32, use_errno=True)(_bind)


def on_loopback(create: Callable[[], _T]) -> _T:
    """Create a DDS domain that receives at 127.0.0.1 alone: `create` calls `_bind` where Cyclone calls `bind`. On Linux only.

    Raises:
        RunError: a socket is bound to all interfaces all the same.
    """
    if sys.platform != "linux":  # where neither the library's format nor the sockets are read like this
        return create()
    with _LOCK:
        before, called = _open_files(), _pointer_to(b"bind")
        original = called.value
        called.value = ctypes.cast(_BIND, ctypes.c_void_p).value
        try:
            created = create()
        finally:
            called.value = original
        for port in _on_all_interfaces(before):
            raise RunError(f"Cyclone DDS receives on all interfaces at UDP port {port}, must be on loopback alone")
        return created


def _pointer_to(function: bytes) -> ctypes.c_void_p:
    """Where Cyclone's library keeps the address of a function of the system, as memory that can be written."""
    base, _, entry = (ctypes.c_size_t * 3).from_address(load_cyclonedds()._handle)  # glibc's `link_map`
    tables: dict[int, int] = {}
    while ctypes.c_size_t.from_address(entry).value:
        tag, tables[tag] = (ctypes.c_size_t * 2).from_address(entry)
        entry += 16
    for first, size in ((_CALLS, _CALLS_BYTES), (_DATA, _DATA_BYTES)):
        for entry in range(tables[first], tables[first] + tables[size], 24):
            offset, info = (ctypes.c_size_t * 2).from_address(entry)
            name = ctypes.c_uint32.from_address(tables[_SYMBOLS] + 24 * (info >> 32)).value
            if ctypes.string_at(tables[_STRINGS] + name) == function:
                page = (base + offset) & -mmap.PAGESIZE
                _LIBC.mprotect(ctypes.c_void_p(page), ctypes.c_size_t(mmap.PAGESIZE), mmap.PROT_READ | mmap.PROT_WRITE)
                return ctypes.c_void_p.from_address(base + offset)
    raise RunError(f"Cyclone DDS calls no {function.decode()}: set CYCLONEDDS_URI to fly with this build of it")


def _open_files() -> frozenset[int]:
    return frozenset(int(name) for name in os.listdir("/proc/self/fd"))


def _on_all_interfaces(before: frozenset[int]) -> Iterator[int]:
    """The ports of UDP sockets that were opened since and receive from other hosts."""
    for number in _open_files() - before:
        try:
            with socket.socket(fileno=os.dup(number)) as found:
                address, is_udp = found.getsockname(), found.type == socket.SOCK_DGRAM
        except OSError:  # a file, or closed again
            continue
        if is_udp and address[0] in ("0.0.0.0", "::"):  # noqa: S104
            yield address[1]
