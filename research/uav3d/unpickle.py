"""Pickles of plain data: numbers, text, builtin containers and numpy arrays. Whatever else a file names is refused.

A pickle is a program: it may name any function and call it. Here a name is looked up in a short table of stand-ins,
never imported, and the stand-ins build arrays of numbers and text only, with sizes that their bytes confirm. It is
the one file of the project that imports `pickle`; a test refuses it in every room.

A few bytes can still ask for gigabytes, or for nesting that no stack holds. So a file is first read in a process of its
own, with limits of memory, time and depth. It is read here only if that went well.
"""

from __future__ import annotations

import io
import pickle
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sortie.scenarios.errors import SortieError
from sortie.scenarios.regular import regular

_NOW = {
    "numpy._core.multiarray": "numpy.core.multiarray",  # numpy 2
    "numpy._core.numeric": "numpy.core.numeric",
    "__builtin__": "builtins",  # protocols 0 to 2 name Python 2's
}
_KINDS = re.compile(r"b1|[iu][1248]|f[248]|[US][1-9]\d{0,5}")
MAX_DEPTH = 100
"""The deepest nesting of containers."""
MEMORY_BYTES, MEMORY_A_BYTE = 512 * 2**20, 40
"""Memory for a file's objects: a part of its own, and a share of the file's size."""
TIME_S, TIME_A_MEGABYTE_S = 30, 1
"""Processor time for a file, in the same way."""


class UnpickleError(SortieError):
    """A pickle that is broken or holds more than data; the message names the file and what was refused."""


def load_data(path: Path | str) -> Any:
    """The object in a pickle file, of any protocol, written under numpy 1 or 2.

    Raises:
        UnpickleError: a name beyond the table, a dtype that is not numbers or text, a broken file, or one that takes too
            much memory or time.
    """
    try:
        data = regular(Path(path)).read_bytes()
        _ensure_within_limits(data)
        return loads_data(data)
    except (UnpickleError, OSError) as error:
        reason = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
        raise UnpickleError(f"{path}: {reason}") from None


def loads_data(data: bytes) -> Any:
    """The same from bytes."""
    try:
        return _Data(io.BytesIO(data)).load()
    except UnpickleError:
        raise
    except Exception as error:  # a broken pickle can raise nearly anything
        raise UnpickleError(f"cannot be unpickled, {type(error).__name__}: {error}") from None


def try_out() -> None:
    """In a process of its own: read the pickle on the standard input within limits, and write what is wrong with it."""
    data = sys.stdin.buffer.read()
    seconds = _seconds_for(data)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most = now + _memory_for(data)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    try:
        fault = _nesting_fault(loads_data(data))
    except UnpickleError as error:
        fault = _too_big(data) if isinstance(error.__context__, MemoryError) else str(error)
    sys.stdout.write(fault.encode(errors="backslashreplace").decode())


def _ensure_within_limits(data: bytes) -> None:
    """Refuse a pickle that takes too much memory, time or depth, before it is read in this process."""
    done = subprocess.run([sys.executable, "-P", __file__], input=data, capture_output=True, check=False)
    if done.returncode == -signal.SIGXCPU:
        raise UnpickleError(f"takes more than {_seconds_for(data)} s to read, is damaged or no recording")
    if done.returncode < 0:  # a stack that is too small, or memory
        raise UnpickleError(f"ends the process that reads it ({signal.Signals(-done.returncode).name}), is damaged")
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise UnpickleError(_too_big(data) if "MemoryError" in last else f"cannot be read: {last}")
    if done.stdout:
        raise UnpickleError(done.stdout.decode())


def _too_big(data: bytes) -> str:
    return f"takes more than {_memory_for(data) // 2**20} MB of memory, is damaged or no recording"


def _memory_for(data: bytes) -> int:
    return MEMORY_BYTES + MEMORY_A_BYTE * len(data)


def _seconds_for(data: bytes) -> int:
    return TIME_S + TIME_A_MEGABYTE_S * len(data) // 10**6


def _nesting_fault(data: Any) -> str:
    """What is wrong with the nesting of containers; empty where nothing is."""
    depths: dict[int, int] = {}  # by object, 0 while its items are looked at
    waiting = [data]
    while waiting:
        one = waiting[-1]
        if depths.get(id(one), 0):
            waiting.pop()
            continue
        items = [item for item in _items(one) if isinstance(item, (dict, list, tuple, set, frozenset))]
        deeper = [item for item in items if id(item) not in depths]
        if deeper and id(one) not in depths:
            depths[id(one)] = 0
            waiting += deeper
            continue
        waiting.pop()
        inside = [depths.get(id(item), 0) for item in items]
        if 0 in inside:
            return "holds a container that holds itself, must be data"
        depths[id(one)] = 1 + max(inside, default=0)
        if depths[id(one)] > MAX_DEPTH:
            return f"is nested more than {MAX_DEPTH} deep, must be data"
    return ""


def _items(one: Any) -> list[Any]:
    if isinstance(one, dict):
        return [*one.keys(), *one.values()]
    return list(one) if isinstance(one, (list, tuple, set, frozenset)) else []


class _Data(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        found = _TABLE.get((_NOW.get(module, module), name))
        if found is None:
            raise UnpickleError(
                f"global {module}.{name} is refused, must be data: numbers, text, containers and numpy arrays"
            )
        return found

    def persistent_load(self, pid: Any, /) -> Any:
        raise UnpickleError("a persistent id is refused, must be data")


class _StandIn:
    """Calls one function of ours, and takes no state: a pickle cannot change it."""

    __slots__ = ("_call",)
    _call: Callable[..., Any]

    def __init__(self, call: Callable[..., Any]) -> None:
        object.__setattr__(self, "_call", call)

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)

    def __setattr__(self, name: str, value: Any) -> None:
        raise UnpickleError(f"state for a function is refused ({name})")

    def __setstate__(self, state: Any) -> None:
        raise UnpickleError("state for a function is refused")


class _Dtype:
    """A dtype as a pickle gives it: its code, then its byte order."""

    __slots__ = ("_code", "_order")

    def __init__(self, code: Any, align: Any = False, copy: Any = True) -> None:
        if not isinstance(code, str) or not _KINDS.fullmatch(code):
            raise UnpickleError(f"dtype {code!r} is refused, must be numbers or text")
        self._code, self._order = code, "="

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "=") or any(state[2:5]):
            raise UnpickleError("a dtype with fields is refused, must be numbers or text")
        self._order = state[1]

    def plain(self) -> np.dtype[Any]:
        return np.dtype(self._order + self._code)


class _Array(np.ndarray[Any, Any]):
    """An array while its state is still to come."""

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise UnpickleError("an array's state is refused, must be version, shape, dtype, order and bytes")
        _, shape, dtype, fortran, raw = state
        values = _values(raw, dtype, shape, "F" if fortran is True else "C")
        checked: Any = (1, values.shape, values.dtype, bool(fortran), values.tobytes("F" if fortran else "C"))
        super().__setstate__(checked)


def _values(raw: Any, dtype: Any, shape: Any, order: str) -> np.ndarray[Any, Any]:
    """Bytes as an array; every claim of the pickle is checked against their number."""
    if not isinstance(dtype, _Dtype) or not isinstance(raw, (bytes, bytearray)):
        raise UnpickleError("an array without plain bytes is refused, must be numbers or text")
    if not isinstance(shape, tuple) or len(shape) > 32 or any(type(n) is not int or n < 0 for n in shape):
        raise UnpickleError(f"an array of shape {shape!r} is refused")
    plain, many = dtype.plain(), 1
    for n in shape:
        many *= n
    if many * plain.itemsize != len(raw):
        raise UnpickleError(
            f"an array of shape {list(shape)} and dtype {plain} has {len(raw)} B, must be {many * plain.itemsize}"
        )
    flat = np.frombuffer(raw, plain) if many and plain.itemsize else np.zeros(many, plain)
    return flat.reshape(shape, order="F" if order == "F" else "C").copy(order="K")


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    if kind is not _NDARRAY:
        raise UnpickleError("an array of another class is refused, must be numpy.ndarray")
    return np.ndarray.__new__(_Array, (0,), np.int8)


def _from_buffer(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    return _values(raw, dtype, shape, order)


def _scalar(dtype: Any, raw: Any = None) -> Any:
    return _values(raw, dtype, (), "C")[()]


def _encode(text: Any, codec: Any) -> bytes:
    """How protocols 0 to 2 write bytes."""
    if not isinstance(text, str) or codec != "latin1":
        raise UnpickleError(f"_codecs.encode to {codec!r} is refused, must be bytes as latin1 text")
    return text.encode("latin1")


def _no_bytes(*args: Any) -> bytes:
    if args:
        raise UnpickleError("bytes with arguments are refused, must be empty")
    return b""


def _ndarray(*args: Any) -> Any:
    raise UnpickleError("a call of numpy.ndarray is refused, arrays are given by their bytes")


def _listed(make: Callable[..., Any]) -> _StandIn:
    def of(items: Any = ()) -> Any:
        if not isinstance(items, (list, tuple)):
            raise UnpickleError(f"a {make.__name__} of {type(items).__name__} is refused, must be of a list")
        return make(items)

    return _StandIn(of)


_NDARRAY = _StandIn(_ndarray)
_TABLE: dict[tuple[str, str], _StandIn] = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _StandIn(_Dtype),
    ("numpy.core.multiarray", "_reconstruct"): _StandIn(_reconstruct),
    ("numpy.core.multiarray", "scalar"): _StandIn(_scalar),
    ("numpy.core.numeric", "_frombuffer"): _StandIn(_from_buffer),
    ("_codecs", "encode"): _StandIn(_encode),
    ("builtins", "bytes"): _StandIn(_no_bytes),
    ("builtins", "set"): _listed(set),
    ("builtins", "frozenset"): _listed(frozenset),
    ("collections", "OrderedDict"): _listed(dict),
}


if __name__ == "__main__":
    try_out()
