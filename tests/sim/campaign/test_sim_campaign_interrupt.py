"""Ctrl-C while a campaign flies: one line, nothing left running, and workers that never hear of it."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import psutil
import pytest
from campaign_examples import CAMPAIGN, CLUSTER, plan, rows_on_disk, write

from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.signals import EndedError, ended_by_sigterm, undisturbed
from sortie.sim.campaign.work import fly_one
from sortie.sim.folders import RunError

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
    [
        (0, signal.SIGINT, "interrupted", 130),
        (2, signal.SIGINT, "interrupted", 130),
        (0, signal.SIGTERM, "ended by SIGTERM", 143),
        (2, signal.SIGTERM, "ended by SIGTERM", 143),
    ],
)
def test_an_end_from_outside_is_one_line_and_leaves_nothing_running(
    tmp_path: Path, workers: int, number: signal.Signals, what: str, code: int
) -> None:
    """Ctrl-C goes to the whole process group, as a terminal sends it; SIGTERM to the driver alone."""
    folder, script = tmp_path / "a", tmp_path / "driver.py"
    script.write_text(DRIVER)
    campaign = write(tmp_path, CAMPAIGN.replace("{count: 6}", "{count: 200}"))
    command = [sys.executable, str(script), "", str(campaign), "--workers", str(workers), "--out", str(folder)]
    deadline = time.monotonic() + 600
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as driver:
        while rows_on_disk(folder) == 0:
            assert driver.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert len(of_session(driver.pid)) >= 1 + workers
        if number == signal.SIGINT:
            os.killpg(driver.pid, number)
        else:
            driver.send_signal(number)
        said, _ = driver.communicate(timeout=600)
    assert said == f"{what}; what is finished is kept in {folder}, the same command goes on\n"
    assert driver.returncode == code
    while of_session(driver.pid):  # multiprocessing's resource tracker goes last, by itself
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_workers_never_get_ctrl_c_those_that_replace_dead_ones_either(tmp_path: Path) -> None:
    p = plan(tmp_path)
    with open_engine(1) as engine:
        rows, found = engine.results(p.code, ((run, p.task(run)) for run in range(8))), list[int]()
        for _ in range(2):
            next(rows)
            (pid,) = _children(os.getpid())
            assert _blocks_ctrl_c(pid)
            found.append(pid)
            os.kill(pid, signal.SIGKILL)
        assert found[0] != found[1]
        assert {row.status for some in rows for row in some} == {"done"}
    assert _children(os.getpid()) == []


def _children(pid: int) -> list[int]:
    """Processes that serve a campaign's runs."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += [int(child) for child in (task / "children").read_text().split()]
    return [child for child in found if b"apart import serve" in Path(f"/proc/{child}/cmdline").read_bytes()]


def _blocks_ctrl_c(pid: int) -> bool:
    status = dict(line.split(":\t", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return bool(int(status["SigBlk"], 16) & 1 << signal.SIGINT - 1)


@CLUSTER
@pytest.mark.slow
def test_a_question_to_the_cluster_that_ctrl_c_breaks_off_is_not_told(caplog: pytest.LogCaptureFixture) -> None:
    """dask takes back what it has not asked yet, stumbles over that, and would log a traceback."""
    from distributed import LocalCluster

    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0, silence_logs="CRITICAL"
        ) as cluster,
        open_engine(scheduler=cluster.scheduler_address) as engine,
    ):
        (address,) = (worker.worker_address for worker in cluster.workers.values())
        with pytest.raises(RunError, match=f"--scheduler {address}: no scheduler answers there, but a Worker"):
            open_engine(scheduler=address).__enter__()
        loop = engine._client.loop  # type: ignore[attr-defined]
        free = threading.Event()
        loop.add_callback(free.wait)  # it answers nothing until then
        hand = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))

        def ask() -> None:
            hand.start()
            assert engine.workers

        with pytest.raises(KeyboardInterrupt):
            ask()
        hand.join()
        free.set()
    assert [record.message for record in caplog.records if record.levelno >= logging.WARNING] == []
    assert logging.getLogger("tornado.application").isEnabledFor(logging.ERROR)


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


@pytest.mark.parametrize(("number", "what"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "ended by SIGTERM")])
def test_an_end_while_commands_are_imported_is_one_line(number: signal.Signals, what: str) -> None:
    text = "import builtins, signal; import sortie.__main__ as m; real = builtins.__import__; "
    text += (
        f"builtins.__import__ = lambda n, *a: signal.raise_signal({number:d}) if n.endswith('.app') else real(n, *a); "
    )
    ended = subprocess.run([sys.executable, "-c", text + "m.main()"], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (128 + number, "", f"{what}; nothing was written\n")


def test_a_process_whose_driver_was_killed_says_nothing(tmp_path: Path) -> None:
    """Killed before the process reads its task, and before it answers."""
    p = plan(tmp_path)
    for sent in (False, True):
        ours, theirs = multiprocessing.Pipe()
        with (tmp_path / "place").open("wb") as place:
            files = [theirs.fileno(), place.fileno()]
            with subprocess.Popen(
                [sys.executable, "-c", f"from sortie.sim.apart import serve; serve(*{files})"],
                pass_fds=files, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            ) as process:  # fmt: skip
                theirs.close()
                if sent:
                    ours.send((sys.path, 0.0))
                    ours.send(partial(fly_one, p.code, (0, p.task(0)), None))
                ours.close()
                assert process.communicate(timeout=600)[0] == b""
        assert process.returncode == 0


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
