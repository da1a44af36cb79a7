"""An engine of one worker process without dask: where a campaign with policies of a user's own flies with `--workers 0`.

The driver runs no user code. What ends the process, or cannot be interrupted, is one failed run, and the next one flies in
a new process.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection

from sortie.policies.user_calls import STUCK
from sortie.sim.campaign.work import RunResult, Task, fly_in_worker, killed, stuck

ATTEMPTS = 4
"""As often as dask's scheduler tries a run whose worker dies: a process may be killed for no fault of the run."""
_BEGIN = "from sortie.sim.campaign.one_process import serve; serve({})"


class OneProcess:
    """Flies one run after the other in a process of its own.

    It is started by `-P`, so that no module of the working folder takes the place of an installed one.
    """

    workers = 1

    def __init__(self, undisturbed: Callable[[], AbstractContextManager[None]]) -> None:
        """Args: `undisturbed` keeps Ctrl-C from a process that is started within it."""
        self._undisturbed = undisturbed
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """As `Engine`."""
        for task in tasks:
            yield [self._fly(code, task)]

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.wait()
            self._pipe.close()
        self._process = None

    def _fly(self, code: str, task: Task) -> RunResult:
        for _ in range(ATTEMPTS):
            answer = self._answer(code, task)
            if isinstance(answer, Exception):
                raise answer
            if isinstance(answer, RunResult):
                return answer
            if answer in (STUCK, -signal.SIGXCPU):
                return stuck(task, code)
        return killed(task, code)

    def _answer(self, code: str, task: Task) -> RunResult | Exception | int:
        """The run's row, what the worker raised, or the exit code of a process that has ended."""
        if self._process is None:
            self._start()
        assert self._process is not None  # noqa: S101 - it was started just now
        assert self._pipe is not None  # noqa: S101
        try:
            self._pipe.send((code, task))
            answer: RunResult | Exception = self._pipe.recv()
            return answer
        except (EOFError, OSError):
            ended = self._process.wait()
            self.close()
            return ended

    def _start(self) -> None:
        ours, theirs = multiprocessing.Pipe()
        with self._undisturbed():
            self._process = subprocess.Popen(  # noqa: S603 - our own code
                [sys.executable, "-P", "-c", _BEGIN.format(theirs.fileno())], pass_fds=[theirs.fileno()]
            )
        theirs.close()
        self._pipe = ours


def serve(file: int) -> None:
    """Fly what comes in until the driver is gone."""
    pipe, driver = Connection(file), os.getppid()
    threading.Thread(target=_end_with, args=(driver,), daemon=True).start()
    while True:
        try:
            code, task = pipe.recv()
        except EOFError:
            return
        try:
            answer: RunResult | Exception = fly_in_worker(code, [task])[0][0]
        except Exception as error:
            answer = error
        pipe.send(answer)


def _end_with(driver: int) -> None:
    """End this process when the driver is gone, also in the middle of a run."""
    while os.getppid() == driver:
        time.sleep(0.5)
    os._exit(1)
