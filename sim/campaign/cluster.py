"""A dask.distributed cluster that is already running: certificates, workers that come and go, a scheduler that dies."""

from __future__ import annotations

import asyncio
import itertools
import logging
import queue
import ssl
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from sortie.sim.campaign.processes import AHEAD, fly_apart
from sortie.sim.campaign.signals import undisturbed
from sortie.sim.campaign.work import RunResult, Task, killed
from sortie.sim.folders import RunError

Security = tuple[Path, Path, Path]
"""PEM files: the authority's certificate, one's own certificate, its key."""
BATCH_S = 1.0
"""A task of the engine is about this long, so that its overhead of some milliseconds is below a hundredth."""
MAX_BATCH = 200
CONNECT_S = 15
WAIT_S = 300.0
"""How long a cluster may be without workers."""
PATIENCE_S = 3.0
"""After this long without workers a line says so."""
LOOK_S = 1.0
"""How often it is looked whether there are workers, while none answers."""


def _come(landed: queue.SimpleQueue[Any]) -> list[Any]:
    """All that has landed; nothing after `LOOK_S`. Rows that come together are written together: a disk takes as long for
    one batch as for many."""
    try:
        came = [landed.get(timeout=LOOK_S)]
    except queue.Empty:
        return []
    while not landed.empty():
        came.append(landed.get())
    return came


class Dask:
    """A dask.distributed cluster, through its client."""

    def __init__(
        self,
        client: Any,
        where: str,
        memory_b: int | None = None,
        wait_s: float = WAIT_S,
        notice: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._client, self._where, self._memory_b, self._wait_s, self._notice = client, where, memory_b, wait_s, notice
        self._seconds_per_run: float | None = None
        self._alone_since_s: float | None = None
        self._noticed = False

    @property
    def workers(self) -> int:
        """Number of worker threads; each flies one batch at a time."""
        with self._of_cluster():
            info = self._client.scheduler_info(n_workers=-1)
            return sum(
                w["nthreads"] for w in info["workers"].values()
            )  # no "workers": the scheduler died before it answered

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        """As `Engine`. A batch on which workers died again and again is flown run by run, and the run at fault is reported."""
        from distributed import KilledWorker

        flying: dict[Any, list[Task]] = {}
        landed: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def submit(batch: list[Task]) -> None:
            name = f"sortie-{batch[0][0]}-{uuid.uuid4().hex[:12]}"
            with self._of_cluster():
                future = self._client.submit(fly_apart, code, batch, self._memory_b, key=name, pure=False)
                flying[future] = batch
                future.add_done_callback(landed.put)

        def fill() -> None:
            while len(flying) < AHEAD * max(1, self.workers):
                batch = list(itertools.islice(tasks, self._batch()))
                if not batch:
                    return
                submit(batch)

        def settle(future: Any) -> list[RunResult]:
            """The rows of a batch; nothing if it is to be flown again."""
            batch, status = flying.pop(future), future.status
            if status in ("lost", "pending"):
                # its worker died between the end of the run and this look: the scheduler has it flown again
                flying[future] = batch
                with self._of_cluster():
                    future.add_done_callback(landed.put)
                return []
            if status == "finished":
                with self._of_cluster():
                    results, seconds = future.result()
                self._learn(seconds / len(batch))
                return list(results)
            if status == "cancelled":
                raise self._gone()
            if not isinstance(error := future.exception(), KilledWorker):
                raise (
                    error
                    if isinstance(error, RunError)
                    else RunError(f"a worker cannot fly: {type(error).__name__}: {_in_one_line(error)}")
                )
            if len(batch) == 1:
                return [killed(batch[0], code)]
            for task in batch:
                submit([task])
            return []

        fill()
        while flying:
            came = _come(landed)
            if not came:
                self._look()
                continue
            rows: list[RunResult] = []
            try:
                for future in came:
                    rows += settle(future)
                fill()
            except RunError:
                if rows:
                    yield rows
                raise
            if rows:
                yield rows

    def _look(self) -> None:
        """Whether there are workers: one line when there are none, an error when that lasts."""
        if self._client.status not in ("running", "connecting"):
            raise self._gone()
        if self.workers:
            self._alone_since_s, self._noticed = None, False
            return
        now_s = time.monotonic()
        self._alone_since_s = now_s if self._alone_since_s is None else self._alone_since_s
        begin = f"; start one: dask worker {self._where}"
        alone_s = now_s - self._alone_since_s
        if alone_s >= PATIENCE_S - LOOK_S and not self._noticed:
            self._noticed = True
            self._notice(f"{self._name}: no workers; waiting for up to {self._wait_s:g} s (--wait-for-workers){begin}")
        if alone_s >= self._wait_s:
            raise RunError(
                f"{self._name}: no worker for {self._wait_s:g} s (--wait-for-workers); what is finished is kept, "
                f"the same command goes on{begin}"
            )

    @property
    def _name(self) -> str:
        return f"--scheduler {self._where}"

    def _gone(self) -> RunError:
        return RunError(f"{self._name}: the scheduler is gone; what is finished is kept, the same command goes on")

    @contextmanager
    def _of_cluster(self) -> Iterator[None]:
        """Whatever dask raises when its scheduler dies in the middle of a call is one line."""
        try:
            yield
        except RunError:
            raise
        except Exception as error:
            raise self._gone() from error

    def _batch(self) -> int:
        if self._seconds_per_run is None:
            return 1
        return max(1, min(MAX_BATCH, round(BATCH_S / max(self._seconds_per_run, 1e-6))))

    def _learn(self, seconds: float) -> None:
        known = self._seconds_per_run
        self._seconds_per_run = seconds if known is None else 0.8 * known + 0.2 * seconds


@contextmanager
def open_cluster(
    scheduler: str,
    security: Security | None,
    memory_b: int | None,
    wait_s: float,
    notice: Callable[[str], None],
) -> Iterator[Dask]:
    """The engine of a cluster, as `open_engine` describes it."""
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise RunError(
            "dask.distributed is missing: pip install 'sortie-sim[campaign]', or fly with --workers"
        ) from error
    with dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECT_S}s"}), _quiet():
        certificates = _certificates(security)
        _ensure_answers(scheduler, certificates, given=security is not None)
        opened = ExitStack()
        try:
            with undisturbed():
                try:
                    client = opened.enter_context(
                        Client(scheduler, timeout=f"{CONNECT_S}s", set_as_default=False, security=certificates)
                    )
                except Exception as error:  # a scheduler that dies in these seconds
                    raise RunError(
                        f"--scheduler {scheduler}: is gone ({_in_one_line(error)}); the same command goes on"
                    ) from error
            yield Dask(client, scheduler, memory_b, wait_s, notice)
        finally:
            with undisturbed(), suppress(Exception):  # the rows are on disk, whatever a dying cluster says
                opened.close()


def _certificates(files: Security | None) -> Any:
    """What dask takes for TLS; without files, what its own configuration has."""
    from distributed.security import Security as Certificates

    if files is None:
        return Certificates()
    for path in files:
        if not path.is_file():
            raise RunError(f"--security {path}: no such file")
    ca, cert, key = map(str, files)
    try:
        context = ssl.create_default_context(cafile=ca)
    except (ssl.SSLError, OSError) as error:
        raise RunError(f"--security {ca}: is not a PEM certificate ({_in_one_line(error)})") from error
    try:
        context.load_cert_chain(cert, key, password=lambda: "")
    except (ssl.SSLError, OSError, ValueError) as error:
        raise RunError(f"--security {cert} {key}: not a certificate and its key ({_in_one_line(error)})") from error
    ours = {
        f"tls_{who}_{what}": path
        for who in ("client", "scheduler", "worker")
        for what, path in (("cert", cert), ("key", key))
    }
    return Certificates(require_encryption=True, tls_ca_file=ca, **ours)


def _ensure_answers(scheduler: str, certificates: Any, *, given: bool) -> None:
    """Before a client is made: one that finds nobody takes half a minute to go, and complains."""
    from distributed.comm import connect, get_address_host_port
    from distributed.core import send_recv

    try:
        get_address_host_port(scheduler)
    except ValueError as error:
        raise RunError(f"--scheduler {scheduler}: must be an address like tcp://host:8786: {error}") from None
    encrypted = scheduler.startswith("tls://")
    if given and not encrypted:
        raise RunError(f"--scheduler {scheduler}: must be an address like tls://host:8786, as --security is given")
    arguments = certificates.get_connection_args("client")
    if encrypted and arguments.get("ssl_context") is None:
        raise RunError(f"--scheduler {scheduler}: needs --security CA CERT KEY")
    answered: Future[str] = Future()

    async def greet() -> str:
        comm = await connect(scheduler, timeout=CONNECT_S, **arguments)
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
        why = " that takes these certificates" if encrypted else ""
        raise RunError(f"--scheduler {scheduler}: no scheduler answers there{why}") from error
    if kind != "Scheduler":
        raise RunError(f"--scheduler {scheduler}: no scheduler answers there, but a {kind}")


def _in_one_line(error: BaseException | None) -> str:
    return " ".join(str(error).split())[:200]


@contextmanager
def _quiet() -> Iterator[None]:
    """A worker that is killed is told by its rows, a campaign that is interrupted by one line, neither by tracebacks: dask
    logs one where Ctrl-C breaks off a question to the cluster, and where a scheduler dies."""
    roots = ("distributed", "tornado", "asyncio")
    known = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] in roots]
    loggers = [logging.getLogger(name) for name in {*roots, *known}]  # some have levels and handlers of their own
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
