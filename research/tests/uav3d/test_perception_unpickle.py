"""Pickles are read as data: arrays of every protocol and numpy come through, programs do not."""

from __future__ import annotations

import collections
import functools
import os
import pickle
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from research.uav3d import unpickle
from research.uav3d.unpickle import UnpickleError, load_data, loads_data

DATA = {
    "infos": [{"token": "a", "n": 3, "x": [0.5, None, True], "t": (1, b"\x00\xff"), "none": b""}],
    "numbers": np.arange(12.0).reshape(3, 4),
    "columns": np.asfortranarray(np.arange(12, dtype=np.int32).reshape(3, 4)),
    "names": np.array(["car", "ca"]),
    "flags": np.array([True, False]),
    "half": np.float16([0.5, 2]),
    "big": np.array([1, 2], ">i4"),
    "empty": np.zeros((0, 7)),
    "scalar": np.float64(1.5),
    "stamp": np.int64(1701498620885503488),
    "set": {1, 2},
    "ordered": collections.OrderedDict(b=1, a=2),
}


def same(a: Any, b: Any) -> None:
    assert type(a) is type(b) or isinstance(a, np.ndarray) or isinstance(b, collections.OrderedDict)
    if isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif isinstance(a, np.ndarray):
        native = b.dtype.newbyteorder("=")  # as numpy's own reading of protocols below 5 has it
        assert (a.dtype.newbyteorder("="), a.shape) == (native, b.shape)
        assert a.flags.f_contiguous == b.flags.f_contiguous
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("numpy_2", [True, False])
def test_data_comes_back_as_it_was(protocol: int, numpy_2: bool, tmp_path: Path) -> None:
    """As numpy 2 writes it, and with the module path that numpy 1 has."""
    data = pickle.dumps(DATA, protocol)
    assert b"numpy._core" in data
    if not numpy_2:
        if protocol >= 4:  # names are preceded by their length, within framed bytes
            data = pickle.dumps(DATA, 3)
        data = data.replace(b"numpy._core", b"numpy.core")
    path = tmp_path / "data.pkl"
    path.write_bytes(data)
    same(load_data(path), DATA)


class Call:
    """Pickles as a call."""

    def __init__(self, function: Any, *args: Any, state: Any = None) -> None:
        self.call = (function, args) if state is None else (function, args, state)

    def __reduce__(self) -> Any:
        return self.call


def array(state: Any) -> Call:
    return Call(np.ndarray.__reduce__(np.zeros(1))[0], np.ndarray, (0,), b"b", state=state)


F8 = np.dtype("f8")


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (Call(os.system, "touch owned"), f"global {os.name}.system is refused"),
        (Call(eval, "open('owned', 'w')"), "global (builtins|__builtin__).eval is refused"),
        (Call(exec, "open('owned', 'w')"), "global (builtins|__builtin__).exec is refused"),
        (Call(getattr, 1, "real"), "global (builtins|__builtin__).getattr is refused"),
        (Call(subprocess.run, ["touch", "owned"]), "global (subprocess|commands).run is refused"),
        (np.add, "global numpy._core._multiarray_umath.add is refused|global numpy.add is refused|global numpy._core"),
        (Call(np.frompyfunc, os.getcwd, 0, 1), "is refused"),
        (Call(np.load, "owned.npy"), "is refused"),
        (Call(np.ndarray, (10**9,)), "a call of numpy.ndarray is refused"),
        (np.array([1, "a", None], object), "dtype 'O8' is refused, must be numbers or text"),
        (np.zeros(2, [("a", "f8")]), "dtype 'V8' is refused"),
        (array((1, (10**12,), F8, False, b"\x00" * 8)), r"an array of shape \[1000000000000\] and dtype float64 has 8 B"),
        (array((1, (-1,), F8, False, b"\x00" * 8)), r"an array of shape \(-1,\) is refused"),
        (array((1, (1,), F8, False, ["text"])), "an array without plain bytes is refused"),
        (array("state"), "an array's state is refused"),
        (Call(np.ndarray.__reduce__(np.zeros(1))[0], dict, (0,), b"b"), "global (builtins|__builtin__).dict is refused"),
        (Call(np.ndarray.__reduce__(np.zeros(1))[0], F8, (0,), b"b"), "an array of another class is refused"),
        (Path("x"), "global pathlib"),
    ],
)  # fmt: skip
def test_a_program_is_refused_and_does_not_run(
    what: Any, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for protocol in (2, 3, 4, 5):
        with pytest.raises(UnpickleError, match=message):
            loads_data(pickle.dumps([what], protocol))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cannot be unpickled, EOFError"),
        (b"not a pickle", "cannot be unpickled, UnpicklingError"),
        (pickle.dumps(DATA)[:-40], "cannot be unpickled"),
        (b"cos\nsystem\n(S'touch owned'\ntR.", "global os.system is refused"),
        (b"(S'touch owned'\nios\nsystem\n.", "global os.system is refused"),  # INST
        (b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR}S'_code'\nS'O'\nsb.", "a dtype with fields is refused"),
        (b"cnumpy\ndtype\n}S'_call'\ncnumpy\nndarray\nsb.", "state for a function is refused"),
        (b"c_codecs\nencode\n(Vx\nVpunycode\ntR.", "_codecs.encode to 'punycode' is refused"),
        (b"Pone\n.", "a persistent id is refused"),
    ],
)
def test_broken_and_hand_written_pickles_are_refused(
    data: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UnpickleError, match=message):
        loads_data(data)
    assert not list(tmp_path.iterdir())


def test_the_message_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    with pytest.raises(UnpickleError, match=r"x\.pkl: No such file or directory"):
        load_data(path)
    path.write_bytes(pickle.dumps(Call(os.system, "true")))
    with pytest.raises(UnpickleError, match=r"x\.pkl: global posix\.system is refused, must be data: numbers, text"):
        load_data(path)


def nested(depth: int, begin: bytes = b"", end: bytes = b".") -> bytes:
    """A tuple in a tuple in a tuple ..., as a pickle."""
    return b"\x80\x04" + begin + b")" + b"\x85" * depth + end


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (nested(200_000), "is nested more than 100 deep, must be data"),
        (nested(200_000, b"}", b"Ns."), "ends the process that reads it (SIGSEGV), is damaged"),  # a key is hashed
        (b"\x80\x04Nr\xff\xff\xff\x3f.", "takes more than 512 MB of memory, is damaged or no recording"),  # a memo
        (b"\x80\x05\x96" + (6 << 30).to_bytes(8, "little") + b".", "takes more than 512 MB of memory"),
        (b"\x80\x04]\x94h\x00a.", "holds a container that holds itself, must be data"),
        (
            b"\x80\x02cnumpy.core.numeric\n_frombuffer\n(C\x00cnumpy\ndtype\n(X\x02\x00\x00\x00U0K\x00K\x01tR"
            b"J\xff\xff\xff\x7f\x85X\x01\x00\x00\x00CtR.",
            "dtype 'U0' is refused, must be numbers or text",
        ),
    ],
    ids=["deep", "deep key", "memo", "bytearray", "cycle", "no item size"],
)
def test_what_a_few_bytes_ask_for_is_limited(data: bytes, message: str, tmp_path: Path) -> None:
    """200 kB of nested tuples ended the process, and 13 bytes took 6 GB."""
    path = tmp_path / "x.pkl"
    path.write_bytes(data)
    with pytest.raises(UnpickleError, match="^" + re.escape(f"{path}: {message}")):
        load_data(path)


def test_what_takes_too_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, slow = tmp_path / "x.pkl", "while True: pass"
    path.write_bytes(pickle.dumps(1))
    limit = "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 2))\n"
    (tmp_path / "slow.py").write_text(limit + slow)
    monkeypatch.setattr(unpickle, "__file__", str(tmp_path / "slow.py"))
    with pytest.raises(UnpickleError, match=r"x\.pkl: takes more than 30 s to read, is damaged or no recording$"):
        load_data(path)


def test_data_within_the_limits_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    shared = (1, 2)
    data = {"shared": [shared] * 1000, "deep": functools.reduce(lambda inner, _: [inner], range(90), 0)}
    path.write_bytes(pickle.dumps(data))
    assert load_data(path) == data


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_a_damaged_pickle_is_data_or_an_error(data: st.DataObject) -> None:
    """Whatever bytes are changed: a refusal or plain data, no other exception and no other class."""
    raw = bytearray(pickle.dumps(DATA, data.draw(st.sampled_from([2, 5]))))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = loads_data(bytes(raw))
    except UnpickleError:
        return
    assert type(found).__module__ in ("builtins", "numpy", "research.uav3d.unpickle")
