"""A process beside the driver's, or beside the worker's on a cluster where policies of a user's own fly.

What ends the process, or cannot be interrupted, is one failed run, and the next one flies in a new process. `OneProcess` is
also an engine: the one that flies a campaign with `--workers 0`, without dask.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from multiprocessing.connection import Connection

from sortie.scenarios.plugins.user_calls import STUCK
from sortie.sim.campaign.work import RunResult, Task, flies_user_code, fly_in_worker, killed, stuck

ATTEMPTS = 4
"""As often as dask's scheduler tries a run whose worker dies: a process may be killed for no fault of the run."""
_BEGIN = "from sortie.sim.campaign.one_process import serve; serve({})"


class OneProcess:
    """Flies one run after the other in a process of its own.

    It is started by `-P`, so that no module of the working folder takes the place of an installed one.
    """

    workers = 1

    def __init__(
        self, undisturbed: Callable[[], AbstractContextManager[None]] = nullcontext, memory_b: int | None = None
    ) -> None:
        """Args: `undisturbed` keeps Ctrl-C from a process that is started within it; `memory_b` is what it may take."""
        self._undisturbed, self.memory_b = undisturbed, memory_b
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """As `Engine`."""
        for task in tasks:
            yield [self.fly(code, task)]

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.wait()
            self._pipe.close()
        self._process = None

    def fly(self, code: str, task: Task) -> RunResult:
        """One run's row. Raises what the worker raises: RunError for other code or files."""
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
            self._pipe.send((code, task, self.memory_b))
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


def fly_apart(code: str, tasks: Sequence[Task], memory_b: int | None = None) -> tuple[list[RunResult], float]:
    """`fly_in_worker` for a worker of a cluster: runs with a user's code fly in a process beside it."""
    if not any(flies_user_code(task) for task in tasks):
        return fly_in_worker(code, tasks, memory_b)
    begin_s = time.perf_counter()
    if not hasattr(_OF_THREAD, "one"):
        _OF_THREAD.one = OneProcess()
    _OF_THREAD.one.memory_b = memory_b
    return [_OF_THREAD.one.fly(code, task) for task in tasks], time.perf_counter() - begin_s


_OF_THREAD = threading.local()


def serve(file: int) -> None:
    """Fly what comes in until the driver is gone."""
    pipe, driver = Connection(file), os.getppid()
    threading.Thread(target=_end_with, args=(driver,), daemon=True).start()
    while True:
        try:
            code, task, memory_b = pipe.recv()
        except (EOFError, OSError):  # the driver was killed
            return
        try:
            answer: RunResult | Exception = fly_in_worker(code, [task], memory_b)[0][0]
        except Exception as error:
            answer = error
        with suppress(OSError):
            pipe.send(answer)


def _end_with(driver: int) -> None:
    """End this process when the driver is gone, also in the middle of a run."""
    while os.getppid() == driver:
        time.sleep(0.5)
    os._exit(1)
