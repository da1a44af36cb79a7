"""A dask.distributed cluster that is already running: certificates, workers that come and go, a scheduler that dies."""

from __future__ import annotations

import asyncio
import logging
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from sortie.sim.apart import DiedError
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.pools import LOOK_S, Beside, Futures
from sortie.sim.experiment.signals import undisturbed
from sortie.sim.folders import RunError

Security = tuple[Path, Path, Path]
"""PEM files: the authority's certificate, one's own certificate, its key."""
CONNECT_S = 15
WAIT_S = 300.0
"""How long a cluster may be without workers."""
PATIENCE_S = 3.0
"""After this long without workers a line says so."""


class Cluster(Futures):
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
        self._executor = client.get_executor(pure=False)
        self._alone_since_s: float | None = None
        self._noticed = False

    @property
    def workers(self) -> int:
        """Number of worker threads; each flies one task at a time."""
        with self._of_cluster():
            info = self._client.scheduler_info(n_workers=-1)
            return sum(
                w["nthreads"] for w in info["workers"].values()
            )  # no "workers": the scheduler died before it answered

    def submit(self, task: Task) -> Future[Flight]:
        """As `Futures`."""
        with self._of_cluster():
            future: Future[Flight] = self._executor.submit(fly_beside, task, self._memory_b)
            return future

    def landed(self, future: Future[Flight]) -> Flight:
        """As `Futures`."""
        from distributed import KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            raise DiedError("the workers that flew it died") from error
        except CancelledError as error:
            raise self._gone() from error
        except (DiedError, RunError):
            raise
        except Exception as error:
            raise RunError(f"a worker cannot fly: {type(error).__name__}: {_in_one_line(error)}") from error

    def look(self) -> None:
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


_OF_THREAD = threading.local()


def fly_beside(task: Task, memory_b: int | None = None) -> Flight:
    """One flight's row, in a cluster's worker: flown by a process beside it, so that limits hold and what ends it costs one flight."""
    from distributed import get_worker

    if not hasattr(_OF_THREAD, "beside"):
        _OF_THREAD.beside = Beside()
    one: Beside = _OF_THREAD.beside
    limit_b = memory_b or get_worker().memory_manager.memory_limit
    return one.fly(task, limit_b)


@contextmanager
def open_cluster(
    scheduler: str,
    security: Security | None,
    memory_b: int | None,
    wait_s: float,
    notice: Callable[[str], None],
) -> Iterator[Cluster]:
    """The workers of a cluster.

    Args:
        scheduler: its address.
        security: files of certificates for TLS.
        memory_b: what a worker may take; None leaves it to what the workers were started with.
        wait_s: how long the cluster may be without workers.
        notice: called with a line when there are none.

    Raises:
        RunError: dask.distributed is missing, there is no scheduler at that address, or the certificates do not fit.
    """
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
            yield Cluster(client, scheduler, memory_b, wait_s, notice)
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
