"""Processes in which runs fly, beside the driver's, or beside a cluster's worker where policies of a user's own fly.

What ends such a process, or takes longer than a limit, is one failed run, and the next one flies in a new process.
"""

from __future__ import annotations

import itertools
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from sortie.sim.apart import Apart, DiedError, LimitError
from sortie.sim.campaign.signals import undisturbed
from sortie.sim.campaign.work import (
    RunResult,
    Task,
    flies_user_code,
    fly_in_worker,
    fly_one,
    killed,
    late,
    limits_of,
)

AHEAD = 2
"""Tasks given out per worker: one flies, one waits."""
ATTEMPTS = 4
"""As often as dask's scheduler tries a run whose worker dies: a process may be killed for no fault of the run."""


class Turns:
    """Runs fly side by side, and a run that may not have company flies alone."""

    def __init__(self) -> None:
        self._moved = threading.Condition()
        self._flying, self._alone = 0, False

    @contextmanager
    def turn(self, *, alone: bool) -> Iterator[None]:
        """Wait for a turn, and have it for the length of the block."""
        with self._moved:
            self._moved.wait_for(lambda: not self._alone)
            self._alone = alone
            self._moved.wait_for(lambda: not (alone and self._flying))
            self._flying += 1
        try:
            yield
        finally:
            with self._moved:
                self._flying -= 1
                self._alone = self._alone and not alone
                self._moved.notify_all()


class OneProcess:
    """Flies one run after the other in a process of its own, which ends where a run takes longer than its limits."""

    def __init__(self, memory_b: int | None = None, turns: Turns | None = None) -> None:
        """Args: `memory_b` is what it may take; `turns` are those of all processes on this machine."""
        self.memory_b, self._turns = memory_b, turns or Turns()
        self._process: Apart | None = None
        self._ended = False
        self._starting = threading.Lock()

    def end(self) -> None:
        """End the process, also in the middle of a run; whoever waits for that run gets an EOFError."""
        with self._starting:
            self._ended = True
            if self._process is not None:
                self._process.end()

    def close(self) -> None:
        """End the process; nobody flies with it any more."""
        self.end()
        if self._process is not None:
            self._process.close()

    def fly(self, code: str, task: Task) -> RunResult:
        """One run's row. Raises what the worker raises: RunError for other code or files; EOFError after `end`."""
        work, limits = partial(fly_one, code, task, self.memory_b), limits_of(task)
        for attempt in range(1, ATTEMPTS + 1):
            with self._turns.turn(alone=attempt == ATTEMPTS):  # others may have filled the memory
                process = self._started()
                try:
                    row: RunResult = process.call(work, limits)
                    return row
                except LimitError as error:
                    self._replace(process)
                    return late(task, code, error)
                except DiedError:
                    self._replace(process)
        return killed(task, code)

    def _started(self) -> Apart:
        with self._starting:
            if self._ended:
                raise EOFError
            if self._process is None:
                self._process = Apart()
            return self._process

    def _replace(self, process: Apart) -> None:
        """The next run flies in a new process."""
        with self._starting:
            process.close()
            self._process = None


class Processes:
    """An engine: some processes on this machine, without dask; a thread for each gives out its runs."""

    def __init__(self, workers: int, memory_b: int | None = None) -> None:
        """Args: how many processes, and what each of them may take."""
        self.workers = workers
        self.memory_b = memory_b
        self._todo: queue.SimpleQueue[tuple[str, Task] | None] = queue.SimpleQueue()
        self._landed: queue.SimpleQueue[RunResult | Exception] = queue.SimpleQueue()
        turns = Turns()
        self._processes = [OneProcess(memory_b, turns) for _ in range(workers)]
        self._threads = [threading.Thread(target=self._hand_out, args=(one,), daemon=True) for one in self._processes]
        with undisturbed():  # what these threads begin never gets Ctrl-C
            for thread in self._threads:
                thread.start()

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """As `Engine`."""
        flying = 0
        while True:
            for task in itertools.islice(tasks, AHEAD * self.workers - flying):
                self._todo.put((code, task))
                flying += 1
            if not flying:
                return
            came = [self._landed.get()]
            with suppress(queue.Empty):
                while True:  # rows that come together are written together
                    came.append(self._landed.get_nowait())
            flying -= len(came)
            if rows := [one for one in came if isinstance(one, RunResult)]:
                yield rows
            for one in came:
                if isinstance(one, Exception):
                    raise one

    def close(self) -> None:
        """End all processes."""
        for one in self._processes:
            self._todo.put(None)
            one.end()
        for thread, one in zip(self._threads, self._processes, strict=True):
            thread.join()
            one.close()

    def _hand_out(self, one: OneProcess) -> None:
        while (task := self._todo.get()) is not None:
            try:
                self._landed.put(one.fly(*task))
            except EOFError:
                return
            except Exception as error:
                self._landed.put(error)


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
