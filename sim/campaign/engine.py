"""Where runs are flown: in this process, on a local cluster, or on one that is there already. One code path for all.

An engine takes tasks as it can use them and gives results as they come; it never holds more than what is in flight.
"""

from __future__ import annotations

import itertools
import json
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from sim.campaign.work import Result, Task, fly_batch, task_key
from sim.folders import RunError

BATCH_S = 1.0
"""A task of the engine is about this long, so that its overhead of some milliseconds is below a hundredth."""
MAX_BATCH = 200
AHEAD = 2
"""Tasks of the engine given out per worker: one flies, one waits."""


class Engine(Protocol):
    """Flies tasks."""

    @property
    def workers(self) -> int: ...

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[Result]]:
        """Results of tasks, in any order. Raises RunError where runs would not be the campaign's, or nobody flies them."""


class InProcess:
    """One run after the other, here; for debugging, and where nothing else is installed."""

    workers = 1

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[Result]]:
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
        """Threads of all workers, each of which flies one batch at a time."""
        return sum(w["nthreads"] for w in self._client.scheduler_info(n_workers=-1)["workers"].values())

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[Result]]:
        """As `Engine`. A batch on which workers died again and again is flown run by run, and the run at fault told."""
        from distributed import KilledWorker, as_completed

        flying: dict[Any, list[Task]] = {}
        done = as_completed(loop=self._client.loop)

        def submit(batch: list[Task]) -> None:
            name = f"sortie-{batch[0][0]}-{uuid.uuid4().hex[:12]}"
            future = self._client.submit(fly_batch, code, batch, key=name, pure=False)
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
                yield [_killer(batch[0], code)]

    def _batch(self) -> int:
        if self._seconds_per_run is None:
            return 1
        return max(1, min(MAX_BATCH, round(BATCH_S / max(self._seconds_per_run, 1e-6))))

    def _learn(self, seconds: float) -> None:
        known = self._seconds_per_run
        self._seconds_per_run = seconds if known is None else 0.8 * known + 0.2 * seconds


def _killer(task: Task, code: str) -> Result:
    """The row of a run that no worker survived."""
    run, text = task
    nothing = (None,) * len(json.loads(text)["metrics"])
    return Result(run, task_key(text, code), "failed", "WorkerDied: on every attempt", "", nothing)


@contextmanager
def open_engine(workers: int = 0, scheduler: str | None = None) -> Iterator[Engine]:
    """An engine: `scheduler` joins a running cluster, `workers` > 0 starts a local one, 0 flies here.

    Raises:
        RunError: dask.distributed is missing, or there is no scheduler at that address.
    """
    if scheduler is None and workers == 0:
        yield InProcess()
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
        "distributed.comm.timeouts.connect": "15s",
        "distributed.worker.profile.enabled": False,  # a sample every 10 ms, and nobody looks at them
    }
    with dask.config.set(settings):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout="15s", set_as_default=False)
            except (OSError, ValueError, TimeoutError) as error:
                raise RunError(f"--scheduler {scheduler}: no scheduler answers there") from error
            with client:
                yield Dask(client)
            return
        # quiet: a worker that is killed is told by its rows, not by tracebacks
        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", memory_limit=0,
                silence_logs="CRITICAL",
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):  # fmt: skip
            yield Dask(client)
