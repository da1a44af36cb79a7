"""Damaged pickles for the reader of UAV3D's tables: each is read, or refused with one line that names it."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from random import Random
from unittest import mock

import fuzz_mutators
import fuzz_readers
import fuzz_worker
import numpy as np
import pytest

from research.uav3d import unpickle
from research.uav3d.uav3d import CAMERAS, read_infos

pytestmark = pytest.mark.slow
CASES = 300


def pickles() -> list[bytes]:
    camera = {"data_path": "a.png", "sensor2ego_translation": [1.0, 2.0, 3.0], "sensor2ego_rotation": [1.0, 0, 0, 0],
              "cam_intrinsic": np.eye(3)}  # fmt: skip
    info = {"token": "t", "timestamp": 1701498620885503488, "ego2global_translation": [1.0, 2.0, 0], "cams": dict.fromkeys(CAMERAS, camera),
            "gt_boxes": np.ones((2, 7)), "gt_names": np.array(["car"] * 2), "valid_flag": np.full(2, True)}  # fmt: skip
    whole = {"infos": [info], "metadata": {"version": "v1.0-trainval"}}
    return [pickle.dumps(whole, protocol) for protocol in (0, 2, 4, 5)]


def read_pickle(path: Path) -> None:
    """As the reader does it, but that the process of its own is a fork: starting Python would take nearly all the time."""
    with mock.patch.object(unpickle.subprocess, "run", forked):
        read_infos(path)


def forked(command: list[str], *, input: bytes, **_: object) -> subprocess.CompletedProcess[bytes]:
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if not child:
            code = 1
            try:
                warnings.simplefilter("default")
                sys.stdin = io.TextIOWrapper(io.BytesIO(input))
                sys.stdout = io.TextIOWrapper(out, encoding="utf-8")
                unpickle.try_out()
                sys.stdout.flush()
                code = 0
            except BaseException as error:
                err.write(f"{type(error).__name__}: {error}".encode(errors="replace"))
                err.flush()
            finally:
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        out.seek(0)
        err.seek(0)
        return subprocess.CompletedProcess(command, code, out.read(), err.read())


def in_opcodes(draw: Random, data: bytes, corpus: Sequence[bytes]) -> bytes:
    """Opcodes of a pickle dropped, doubled, moved, nested or with another argument."""
    try:
        starts = [at for _, _, at in pickletools.genops(data)]
    except Exception:
        return fuzz_mutators.flip(draw, data, corpus)
    ops = [data[a:b] for a, b in zip(starts, [*starts[1:], len(data)], strict=True)]
    at = draw.randrange(len(ops))
    match draw.randrange(6):
        case 0:
            del ops[at]
        case 1:
            ops[at:at] = ops[at : at + draw.randint(1, 20)] * draw.choice((1, 2, 50))
        case 2:
            ops[at:at] = [bytes([draw.choice(pickletools.opcodes).code.encode("latin-1")[0]])]
        case 3:
            n = draw.choice((1, 50, 3000, 60_000))
            ops[at:at] = [b"(" * n + b"t" * n]
        case 4:
            ops[at] = ops[at][:1] + fuzz_mutators.number(draw, ops[at][1:], corpus)
        case 5:
            other = draw.randrange(len(ops))
            ops[at], ops[other] = ops[other], ops[at]
    return b"".join(ops)


def test_a_damaged_pickle_is_read_or_refused_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = fuzz_readers.Reader(
        read_pickle, pickles, list, (*[in_opcodes] * 5, *fuzz_mutators.BINARY), ".pkl", limit_s=4.0
    )
    monkeypatch.setitem(fuzz_readers.READERS, "pickle", reader)
    cases, path = fuzz_worker.Cases("pickle"), tmp_path / "case.pkl"
    for number in range(len(cases.corpus) + CASES):
        path.write_bytes(cases[number])
        assert fuzz_worker.fault_of(reader, path, number < cases.intact) is None, number
