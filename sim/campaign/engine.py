"""Where runs are flown: in processes beside the driver's, or on a cluster that is already running.

An engine takes tasks as it can use them and gives results as they come; it never holds more than what is in flight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from sortie.sim.campaign.cluster import WAIT_S, Security, open_cluster
from sortie.sim.campaign.memory import machine_memory_b
from sortie.sim.campaign.processes import Processes
from sortie.sim.campaign.work import RunResult, Task
from sortie.sim.folders import RunError


class Engine(Protocol):
    """Flies tasks."""

    @property
    def workers(self) -> int: ...

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """Results of tasks, in any order. Raises RunError where workers have other code or files, or where there are no workers."""


@contextmanager
def open_engine(
    workers: int = 0,
    scheduler: str | None = None,
    *,
    security: Security | None = None,
    memory_b: int | None = None,
    wait_s: float = WAIT_S,
    notice: Callable[[str], None] = lambda line: None,
) -> Iterator[Engine]:
    """An engine: `scheduler` joins a running cluster; without one, `workers` processes start here, at least one.

    Nothing flies in the driver: a run that ends its process, or takes all memory, is one failed run.

    Args:
        workers: processes on this machine.
        scheduler: the address of a cluster that is running.
        security: files of certificates for TLS.
        memory_b: what a worker may take. None divides the machine's memory among the workers, and leaves it to the workers of
            a cluster that is joined.
        wait_s: how long a cluster may be without workers.
        notice: called with a line when there are none.

    Raises:
        RunError: dask.distributed is missing, there is no scheduler at that address, or the certificates do not fit.
    """
    if scheduler is not None:
        with open_cluster(scheduler, security, memory_b, wait_s, notice) as cluster:
            yield cluster
        return
    if security is not None:
        raise RunError("--security goes with --scheduler")
    count = max(1, workers)
    processes = Processes(count, machine_memory_b() // count if memory_b is None else memory_b)
    try:
        yield processes
    finally:
        processes.close()
