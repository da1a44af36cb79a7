"""Where flights fly: in this process, in processes beside it, or on a cluster that is already running (`cluster.py`).

A pool takes tasks as it can use them and gives their rows as they come; it never holds more than what is in flight.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from typing import Protocol

from sortie.sim.apart import Apart, DiedError, LimitError
from sortie.sim.experiment.flight import MAX_ERROR, Flight, Task, failed, fly, fly_in_worker, limits_of
from sortie.sim.experiment.memory import machine_memory_b
from sortie.sim.experiment.signals import undisturbed
from sortie.sim.results.record import SortieRecord
from sortie.sim.user_errors import in_line

AHEAD = 2
"""Tasks given out per worker: one flies, one waits."""
TRIES = 3
"""Before the last one, which a flight makes alone: a process may be killed for no fault of the flight."""
LOOK_S = 1.0
"""How often a pool is looked at while nothing lands."""
Landed = list[tuple[Task, Flight]]


class Pool(Protocol):
    """Flies tasks."""

    def rows(self, tasks: Iterator[Task]) -> Iterator[Landed]:
        """Rows of tasks, in any order; those that come together are written together.

        Raises:
            RunError: workers have other code or files, or there are no workers.
        """


class Here:
    """Flies one task after the other in this process."""

    def __init__(
        self,
        watch: Callable[[Task, float], None] = lambda task, t_s: None,
        keep: Callable[[Task, SortieRecord], None] = lambda task, record: None,
        *,
        failing: bool = False,
    ) -> None:
        """Args: `watch` is called with the task that flies and the simulated time, s; `keep` with a task and its record;
        `failing` makes rows of what flights raise."""
        self._watch, self._keep, self._failing = watch, keep, failing

    def rows(self, tasks: Iterator[Task]) -> Iterator[Landed]:
        """As `Pool`; flights of a group land together."""
        for _, group in itertools.groupby(tasks, key=lambda task: task.group or task.number):
            yield [(task, self._fly(task)) for task in group]

    def _fly(self, task: Task) -> Flight:
        try:
            return fly(task, partial(self._watch, task), partial(self._keep, task))
        except Exception as error:
            if not self._failing:
                raise
            return failed(task, in_line(error, MAX_ERROR))


class Futures:
    """A pool whose flights are futures; what ends a flight's process again and again is the flight's row."""

    @property
    def workers(self) -> int:
        """How many tasks can fly at once."""
        raise NotImplementedError

    def submit(self, task: Task) -> Future[Flight]:
        """Begin a flight."""
        raise NotImplementedError

    def landed(self, future: Future[Flight]) -> Flight:
        """A future's row. Raises DiedError where its process ended on every try, and RunError."""
        return future.result()

    def look(self) -> None:
        """See whether there is anybody who flies."""

    def rows(self, tasks: Iterator[Task]) -> Iterator[Landed]:
        """As `Pool`. What no process survives is tried once more when nothing else flies: others may have filled the memory."""
        flying: dict[Future[Flight], Task] = {}
        deadly: list[Task] = []
        alone: Task | None = None
        while True:
            for task in itertools.islice(tasks, max(0, AHEAD * max(1, self.workers) - len(flying))):
                flying[self.submit(task)] = task
            if not flying:
                if not deadly:
                    return
                alone = deadly.pop(0)
                flying[self.submit(alone)] = alone
            done, _ = wait(flying, LOOK_S, FIRST_COMPLETED)
            if not done:
                self.look()
            landed: Landed = []
            error: Exception | None = None
            for future in done:
                task = flying.pop(future)
                try:
                    landed.append((task, self.landed(future)))
                except DiedError:
                    if task is alone:
                        landed.append((task, failed(task, "WorkerDied: on every attempt")))
                    else:
                        deadly.append(task)
                except Exception as wrong:
                    error = wrong
            if landed:
                yield landed
            if error is not None:
                raise error


class Beside:
    """A process beside this one that flies one task after the other; what ends it costs the flight that it has."""

    def __init__(self) -> None:
        self._process: Apart | None = None
        self._ended = False
        self._changing = threading.Lock()

    def fly(self, task: Task, memory_b: int | None) -> Flight:
        """One flight's row.

        Args:
            memory_b: what it may take.

        Raises:
            DiedError: the process ended on every try, or `end` was called.
            RunError: it has other code or files.
        """
        for attempt in range(1, TRIES + 1):
            process = self._started()
            try:
                row: Flight = process.call(partial(fly_in_worker, task, memory_b), limits_of(task))
                return row
            except LimitError as error:
                self._replace(process)
                return failed(task, in_line(error, MAX_ERROR))
            except DiedError:
                self._replace(process)
                if attempt == TRIES:
                    raise
        raise AssertionError

    def end(self) -> None:
        """End the process, also in the middle of a flight."""
        with self._changing:
            self._ended = True
            if self._process is not None:
                self._process.end()

    def close(self) -> None:
        """End the process; nobody flies with it any more."""
        self.end()
        if self._process is not None:
            self._process.close()

    def _started(self) -> Apart:
        with self._changing:
            if self._ended:
                raise DiedError("ended")
            if self._process is None:
                self._process = Apart()
            return self._process

    def _replace(self, process: Apart) -> None:
        """The next flight has a new process."""
        with self._changing:
            process.close()
            self._process = None


class Processes(Futures):
    """Processes on this machine; a thread for each gives out its tasks."""

    def __init__(self, workers: int, memory_b: int | None = None) -> None:
        """Args: how many processes, and what each of them may take; None divides the machine's memory."""
        self._workers = workers
        self._memory_b = machine_memory_b() // workers if memory_b is None else memory_b
        self._all = [Beside() for _ in range(workers)]
        self._idle: queue.SimpleQueue[Beside] = queue.SimpleQueue()
        for one in self._all:
            self._idle.put(one)
        self._threads = ThreadPoolExecutor(workers)
        started = threading.Barrier(workers)
        with undisturbed():  # what these threads begin never gets Ctrl-C
            list(self._threads.map(lambda _: started.wait(), range(workers)))

    @property
    def workers(self) -> int:
        """As `Futures`."""
        return self._workers

    def submit(self, task: Task) -> Future[Flight]:
        """As `Futures`."""
        return self._threads.submit(self._fly, task)

    def close(self) -> None:
        """End all processes."""
        for one in self._all:
            one.end()
        self._threads.shutdown(cancel_futures=True)
        for one in self._all:
            one.close()

    def _fly(self, task: Task) -> Flight:
        one = self._idle.get()
        try:
            return one.fly(task, self._memory_b)
        finally:
            self._idle.put(one)


@contextmanager
def processes(workers: int, memory_b: int | None = None) -> Iterator[Processes]:
    """Processes on this machine, which end with the block."""
    pool = Processes(max(1, workers), memory_b)
    try:
        yield pool
    finally:
        pool.close()
