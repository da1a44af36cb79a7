"""Exit codes of the command, output that cannot be written, and files without an end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cli_examples import command
from sim_examples import BASE

import sortie
from sortie.fleet.logs.flightlog import read_logs
from sortie.perception.recordings.recording import open_recording
from sortie.policies.registry import resolve
from sortie.scenarios.exit_codes import DEFECT, ENDED, FAILED, INTERRUPTED, USER
from sortie.scenarios.reading.load import load
from sortie.scenarios.traces import read_columns
from sortie.sim.export.endpoint import read_key
from sortie.sim.export.telemetry import MavlinkEndpoint
from sortie.sim.identity import file_digest

PAGE = Path(sortie.__file__).resolve().parents[1] / "docs" / "site" / "command_line.md"
POLICY = "def mine(view):\n    raise ValueError('shapes (3,) (4,)')\n"


def test_the_page_has_them_all() -> None:
    table = PAGE.read_text("utf-8").partition("## Exit codes")[2].partition("## ")[0]
    codes = [int(code) for row in re.findall(r"^\| ([\d, ]+) \|", table, re.MULTILINE) for code in row.split(", ")]
    assert codes == [0, FAILED, USER, DEFECT, INTERRUPTED, ENDED]


@pytest.mark.parametrize(
    ("arguments", "flown", "code", "line"),
    [
        (["list", "policies"], None, 0, ""),
        (["list", "nothing"], None, USER, "nothing"),
        (["fly", "one.yaml", "--sed", "3"], None, USER, "No such option"),
        (["fly", "gone.yaml"], None, USER, "error: gone.yaml: no such file"),
        (["fly", "one.yaml", "--policy", "mine.py:mine"], None, USER, "ValueError: shapes (3,) (4,) (mine.py, line 2)"),
        (["fly", "/dev/zero"], None, USER, "error: /dev/zero: cannot be read, is a device, a pipe or a socket"),
        (["compare", "one.yaml", "--policies", "silence", "--seeds", "1000000"], None, USER, "10000"),
        (
            ["fly", "one.yaml", "--mavlink", "udpout:127.0.0.1:1", "--pace", "nan"],
            None,
            USER,
            "error: pace is nan, must",
        ),
        (["check", "one.yaml"], None, FAILED, "1 expectation failed"),
        (["fly", "one.yaml"], lambda *_, **__: np.zeros(3) + np.zeros(4), DEFECT, "Traceback (most recent call last)"),
        (["fly", "one.yaml"], lambda *_, **__: {}["gone"], DEFECT, "This is a defect of Sortie"),
        (["fly", "one.yaml"], lambda *_, **__: signal.raise_signal(signal.SIGINT), INTERRUPTED, "interrupted; what"),
    ],
)
def test_exit_codes(
    arguments: list[str], flown: Callable[..., object] | None, code: int, line: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "one.yaml").write_text(f"{BASE}\nexpect: [{{metric: bytes.data_sent, at_least: 1.0e12}}]\n")
    (tmp_path / "mine.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    if flown is not None:
        monkeypatch.setattr(sortie, "fly", flown)
    if arguments[0] in ("fly", "check"):
        arguments = [*arguments, "--set", "duration_s=1", "--set", "events=[]", "--set", "perception.detector=none"]
    assert command(*arguments) == code
    printed = capsys.readouterr()
    assert line in " ".join((printed.out + printed.err).split())
    assert ("Traceback" in printed.err) == (code == DEFECT)


def closed_pipe() -> int:
    reads, writes = os.pipe()
    os.close(reads)
    return writes


@pytest.mark.parametrize(
    ("out", "before", "why"),
    [
        (lambda: os.open("/dev/full", os.O_WRONLY), "", "No space left on device"),
        (closed_pipe, "", "Broken pipe"),
        (closed_pipe, "exec >&-;", "it was closed"),
    ],
)
def test_output_that_cannot_be_written_is_one_line(out: Callable[[], int], before: str, why: str) -> None:
    done = subprocess.run(
        ["/bin/sh", "-c", f'{before} exec "$@"', "sh", sys.executable, "-m", "sortie", "list", "policies"],
        stdout=out(), stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    line = f"error: standard output: {why}; not everything was printed\n"
    assert (done.returncode, done.stderr) == (USER, line)


@pytest.mark.parametrize(
    ("read", "what"),
    [
        (load, "is a device, a pipe or a socket, must be a file"),
        (read_logs, "is a device, a pipe or a socket, must be a file"),
        (read_key, "is a device, a pipe or a socket, must be a file"),
        (file_digest, "is a device, a pipe or a socket, must be a file"),
        (open_recording, "is a device, a pipe or a socket, must be a file"),
        (lambda path: read_columns(path, {}), "is a device, a pipe or a socket, must be a file"),
        (lambda path: resolve(f"{path}:mine"), "not found"),
    ],
)
def test_a_device_is_refused(read: Callable[[Path], object], what: str) -> None:
    """/dev/null, as a reader that does not refuse devices ends there."""
    with pytest.raises((sortie.SortieError, OSError)) as caught:
        read(Path("/dev/null"))
    assert what in str(caught.value)
    assert "/dev/null" in str(caught.value)


def test_a_scenario_may_come_through_a_pipe(tmp_path: Path) -> None:
    reads, writes = os.pipe()
    os.write(writes, BASE.encode())
    os.close(writes)
    try:
        assert load(f"/dev/fd/{reads}").name == "example"
    finally:
        os.close(reads)


@pytest.mark.parametrize("pace", [float("nan"), float("inf"), -1.0, 1e-9, 1e9])
def test_a_pace_has_bounds(pace: float) -> None:
    with pytest.raises(sortie.RunError, match=r"^pace is .*, must be 0\.001 to 1000, or 0 for as fast as possible$"):
        MavlinkEndpoint("udpout:127.0.0.1:1", pace)
