"""The fuzzer: it finds planted faults of every kind, and a few cases of each reader pass."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import fuzz_worker
import pytest
from fuzz_mutators import MAX_BYTES
from fuzz_readers import READERS, Reader
from places import ROOT

from sortie.scenarios.errors import SortieError

pytestmark = pytest.mark.slow

DRIVER = ROOT / "tests" / "fuzz"


@pytest.mark.parametrize("name", READERS)
def test_a_few_cases_of_each_reader_pass(name: str, tmp_path: Path) -> None:
    cases = fuzz_worker.Cases(name)
    path = tmp_path / f"case{cases.reader.suffix}"
    for number in range(len(cases.corpus) + 25):
        path.write_bytes(cases[number])
        assert len(path.read_bytes()) <= max(MAX_BYTES, *map(len, cases.corpus))
        assert fuzz_worker.fault_of(cases.reader, path, number < cases.intact) is None, number


def test_a_case_is_its_number() -> None:
    one, other = fuzz_worker.Cases("directive"), fuzz_worker.Cases("directive")
    assert [one[k] for k in range(50)] == [other[k] for k in reversed(range(50))][::-1]
    assert len({one[k] for k in range(50)}) > 40


def raises(error: BaseException) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        raise error

    return read


def out_of_memory(path: Path) -> object:
    try:
        raise MemoryError
    except MemoryError as error:
        raise SortieError(f"{path}: is damaged") from error


@pytest.mark.parametrize(
    ("read", "found"),
    [
        (raises(KeyError("x")), "KeyError: 'x'"),
        (raises(SystemExit(0)), "SystemExit: 0"),
        (raises(SortieError("is damaged")), "does not name the file: is damaged"),
        (out_of_memory, "took more memory than there is: "),
        (lambda path: warnings.warn("odd", UserWarning, stacklevel=1), "UserWarning: odd"),
    ],
    ids=["error", "exit", "no name", "memory", "warning"],
)
def test_a_planted_fault_is_found(read: Callable[[Path], object], found: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fault = fuzz_worker.fault_of(Reader(read, list, suffix=".x"), tmp_path / "case.x")
    assert fault is not None
    assert found in fault["what"]


def test_an_intact_file_that_is_refused_is_a_fault(tmp_path: Path) -> None:
    path = tmp_path / "case.x"
    reader = Reader(raises(SortieError(f"{path}: is damaged")), list, suffix=".x")
    assert fuzz_worker.fault_of(reader, path) is None
    fault = fuzz_worker.fault_of(reader, path, intact=True)
    assert fault is not None
    assert fault["what"].startswith("refuses a valid file")


PLANTED = """
import os, sys
sys.path[:0] = [{fuzz!r}, {helpers!r}]
import fuzz_readers
def read(path):
    if path.read_bytes() != fuzz_readers._directives()[0]:
        {fault}
fuzz_readers.READERS["directive"] = fuzz_readers.Reader(read, lambda: fuzz_readers._directives()[:1], limit_s=0.2)
import fuzz_worker
from pathlib import Path
fuzz_worker.work("directive", 0, 30, Path({folder!r}))
"""


@pytest.mark.parametrize(
    ("fault", "code"),
    [("while True: pass", -signal.SIGPROF), ("os._exit(3)", 3), ("os.kill(os.getpid(), 11)", -signal.SIGSEGV)],
    ids=["hangs", "exits", "crashes"],
)
def test_a_worker_that_hangs_or_dies_leaves_the_case_s_number(fault: str, code: int, tmp_path: Path) -> None:
    (tmp_path / "place").write_bytes(bytes(32))
    text = PLANTED.format(fuzz=str(DRIVER), helpers=str(DRIVER.parent / "helpers"), folder=str(tmp_path), fault=fault)
    done = subprocess.run(
        [sys.executable, "-c", text], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, check=False
    )
    assert done.returncode == code, done.stderr
    number = int.from_bytes((tmp_path / "place").read_bytes()[:8], "little")
    assert number == 1  # case 0 is the intact file


def test_the_command_prints_a_table(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(DRIVER), "directive", "--last", "200"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "directive: 200 cases, 0 kinds of fault" in done.stdout
    assert done.stdout.splitlines()[-1].split()[:2] == ["directive", "200"]
