"""Ctrl-C while a campaign flies: one line, nothing left running, and workers that never hear of it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from campaign_examples import CAMPAIGN, rows_on_disk, write

from sortie.sim.experiment.signals import EndedError, ended_by_sigterm, undisturbed

pytest.importorskip("distributed")

DRIVER = """
import sys
from sortie.sim.cli.app import main
if __name__ == "__main__":
    sys.argv[:2] = ["sortie", "campaign"]
    main()
"""


def of_session(session: int) -> list[int]:
    """A session's processes, but for those that have ended and wait to be asked how."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("workers", "number", "what", "code"),
    [(2, signal.SIGINT, "interrupted", 130), (0, signal.SIGTERM, "ended by SIGTERM", 143)],
)
def test_an_end_from_outside_is_one_line_and_leaves_nothing_running(
    tmp_path: Path, workers: int, number: signal.Signals, what: str, code: int
) -> None:
    """Ctrl-C goes to the whole process group, as a terminal sends it; SIGTERM to the driver alone."""
    folder, script = tmp_path / "a", tmp_path / "driver.py"
    script.write_text(DRIVER)
    campaign = write(tmp_path, CAMPAIGN.replace("{count: 6}", "{count: 200}"))
    command = [sys.executable, str(script), "", str(campaign), "--workers", str(workers), "--out", str(folder)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as driver:
        while rows_on_disk(folder) == 0:
            assert driver.poll() is None
            time.sleep(0.01)
        assert len(of_session(driver.pid)) >= 1 + workers
        if number == signal.SIGINT:
            os.killpg(driver.pid, number)
        else:
            driver.send_signal(number)
        said, _ = driver.communicate()
    assert said == f"{what}; what is finished is kept in {folder}, the same command goes on\n"
    assert driver.returncode == code
    deadline = time.monotonic() + 600  # ends a hang alone
    while of_session(driver.pid):  # multiprocessing's resource tracker goes last, by itself
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _blocks_ctrl_c(pid: int) -> bool:
    status = dict(line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return bool(int(status["SigBlk"], 16) & 1 << signal.SIGINT - 1)


def test_sigterm_is_an_error_of_the_block_alone() -> None:
    with ended_by_sigterm():
        with pytest.raises(EndedError):
            signal.raise_signal(signal.SIGTERM)
        reached = False

        def work() -> None:
            nonlocal reached
            with undisturbed():
                signal.raise_signal(signal.SIGTERM)
                reached = True

        with pytest.raises(EndedError):
            work()
        assert reached
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


IMPORTING = """
import builtins, signal
import sortie.__main__ as program
real = builtins.__import__
builtins.__import__ = lambda n, *a: signal.raise_signal({number:d}) if n.endswith(".app") else real(n, *a)
program.main()
"""


def test_an_end_while_commands_are_imported_is_one_line() -> None:
    for number, what in ((signal.SIGINT, "interrupted"), (signal.SIGTERM, "ended by SIGTERM")):
        program = [sys.executable, "-c", IMPORTING.format(number=number)]
        ended = subprocess.run(program, capture_output=True, text=True, check=False)
        assert (ended.returncode, ended.stdout, ended.stderr) == (128 + number, "", f"{what}; nothing was written\n")


def test_ctrl_c_waits_for_the_end_of_what_must_not_be_broken_off() -> None:
    blocked, before = [], signal.getsignal(signal.SIGINT)

    def work() -> None:
        with undisturbed():
            signal.raise_signal(signal.SIGINT)
            with subprocess.Popen(["sleep", "60"]) as child:
                blocked.append(_blocks_ctrl_c(child.pid))
                child.kill()

    with pytest.raises(KeyboardInterrupt):
        work()
    assert blocked == [True]
    assert signal.getsignal(signal.SIGINT) is before
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
