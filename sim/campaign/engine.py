"""Where runs are flown: in this process or one other, on a local cluster, or on a cluster that is already running.

An engine takes tasks as it can use them and gives results as they come; it never holds more than what is in flight.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import signal
import threading
import uuid
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import Any, Protocol

from sortie.sim.campaign.one_process import OneProcess, fly_apart
from sortie.sim.campaign.work import RunResult, Task, fly_batch, killed
from sortie.sim.folders import RunError

BATCH_S = 1.0
"""A task of the engine is about this long, so that its overhead of some milliseconds is below a hundredth."""
MAX_BATCH = 200
CONNECT_S = 15
AHEAD = 2
"""Tasks of the engine given out per worker: one flies, one waits."""


class Engine(Protocol):
    """Flies tasks."""

    @property
    def workers(self) -> int: ...

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """Results of tasks, in any order. Raises RunError where workers have other code or files, or where there are no workers."""


class InProcess:
    """One run after the other, here; for debugging, and where nothing else is installed."""

    workers = 1

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """As `Engine`."""
        for task in tasks:
            yield fly_batch(code, [task])[0]


class Dask:
    """A dask.distributed cluster, through its client."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._seconds_per_run: float | None = None

    @property
    def workers(self) -> int:
        """Number of worker threads; each flies one batch at a time."""
        return sum(w["nthreads"] for w in self._client.scheduler_info(n_workers=-1)["workers"].values())

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """As `Engine`. A batch on which workers died again and again is flown run by run, and the run at fault is reported."""
        from distributed import KilledWorker, as_completed

        flying: dict[Any, list[Task]] = {}
        done = as_completed(loop=self._client.loop)

        def submit(batch: list[Task]) -> None:
            name = f"sortie-{batch[0][0]}-{uuid.uuid4().hex[:12]}"
            future = self._client.submit(fly_apart, code, batch, key=name, pure=False)
            flying[future] = batch
            done.add(future)

        def fill() -> None:
            while len(flying) < AHEAD * max(1, self.workers):
                batch = list(itertools.islice(tasks, self._batch()))
                if not batch:
                    return
                submit(batch)

        fill()
        for future in done:
            batch, status = flying.pop(future), future.status
            if status in ("lost", "pending"):
                # its worker died between the end of the run and this look: the scheduler has it flown again
                flying[future] = batch
                done.add(future)
            elif status == "finished":
                results, seconds = future.result()
                self._learn(seconds / len(batch))
                fill()
                yield results
            elif status == "cancelled":
                raise RunError("the cluster is gone; the same command goes on when there is one")
            elif not isinstance(error := future.exception(), KilledWorker):
                raise (
                    error
                    if isinstance(error, RunError)
                    else RunError(f"a worker cannot fly: {type(error).__name__}: {error}")
                )
            elif len(batch) > 1:
                for task in batch:
                    submit([task])
            else:
                fill()
                yield [killed(batch[0], code)]

    def _batch(self) -> int:
        if self._seconds_per_run is None:
            return 1
        return max(1, min(MAX_BATCH, round(BATCH_S / max(self._seconds_per_run, 1e-6))))

    def _learn(self, seconds: float) -> None:
        known = self._seconds_per_run
        self._seconds_per_run = seconds if known is None else 0.8 * known + 0.2 * seconds


@contextmanager
def open_engine(workers: int = 0, scheduler: str | None = None, user_code: bool = False) -> Iterator[Engine]:
    """An engine: `scheduler` joins a running cluster, `workers` > 0 starts a local one, 0 flies here.

    With `user_code`, nothing flies here: 0 starts one process, without dask.

    Raises:
        RunError: dask.distributed is missing, or there is no scheduler at that address.
    """
    if scheduler is None and workers == 0:
        if not user_code:
            yield InProcess()
            return
        one = OneProcess(_undisturbed)
        try:
            yield one
        finally:
            one.close()
        return
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise RunError(
            "dask.distributed is missing: pip install 'sortie-sim[campaign]', or fly with --workers 0"
        ) from error
    settings = {
        "distributed.scheduler.allowed-failures": 3,
        "distributed.comm.timeouts.connect": f"{CONNECT_S}s",
        "distributed.worker.profile.enabled": False,  # a sample every 10 ms, and nobody looks at them
    }
    with dask.config.set(settings), _quiet():
        if scheduler is not None:
            _ensure_answers(scheduler)
        opened = ExitStack()
        try:
            with _undisturbed():
                if scheduler is not None:
                    joins: Any = scheduler
                else:
                    joins = opened.enter_context(
                        LocalCluster(
                            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0",
                            memory_limit=0, silence_logs="CRITICAL",
                        )
                    )  # fmt: skip
                client = opened.enter_context(Client(joins, timeout=f"{CONNECT_S}s", set_as_default=False))
            yield Dask(client)
        finally:
            with _undisturbed():
                opened.close()


def _ensure_answers(scheduler: str) -> None:
    """Before a client is made: one that finds nobody takes half a minute to go, and complains."""
    from distributed.comm import connect, get_address_host_port
    from distributed.core import send_recv
    from distributed.security import Security

    try:
        get_address_host_port(scheduler)
    except ValueError as error:
        raise RunError(f"--scheduler {scheduler}: must be an address like tcp://host:8786: {error}") from None
    answered: Future[str] = Future()

    async def greet() -> str:
        comm = await connect(scheduler, timeout=CONNECT_S, **Security().get_connection_args("client"))
        who = await send_recv(comm, reply=True, op="identity")
        comm.abort()
        return str(who["type"])

    def ask() -> None:
        try:
            answered.set_result(asyncio.run(greet()))
        except Exception as error:
            answered.set_exception(error)

    # in a thread: Ctrl-C ends the wait at once, a notebook has a loop of its own, and dask does not give up whoever takes
    # a connection and says nothing
    threading.Thread(target=ask, daemon=True).start()
    try:
        kind = answered.result(CONNECT_S + 1)
    except Exception as error:  # whatever they say there
        raise RunError(f"--scheduler {scheduler}: no scheduler answers there") from error
    if kind != "Scheduler":
        raise RunError(f"--scheduler {scheduler}: no scheduler answers there, but a {kind}")


@contextmanager
def _quiet() -> Iterator[None]:
    """A worker that is killed is told by its rows, a campaign that is interrupted by one line, neither by tracebacks: dask
    logs one where Ctrl-C breaks off a question to the cluster."""
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado.application", "asyncio")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ctrl-C waits until the end of the block.

    A terminal sends it to the whole process group, and the driver alone is to answer: threads that begin in here have it
    blocked, and what they begin inherits that, workers that take the place of dead ones too.
    """
    if threading.current_thread() is not threading.main_thread():  # handlers are the main thread's
        yield
        return
    resource_tracker.ensure_running()  # it lifts the block when it begins
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
    if came and callable(before):
        before(signal.SIGINT, None)
