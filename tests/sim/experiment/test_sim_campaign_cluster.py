"""A dask cluster: workers that come late, die or lose results, schedulers that die, certificates."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import CAMPAIGN, CLUSTER, InProcess, plan, pretend, small_cluster, table_bytes, write
from typer.testing import CliRunner

from sortie.sim.cli.app import app
from sortie.sim.experiment import cluster, pools
from sortie.sim.experiment.cluster import Cluster
from sortie.sim.experiment.drive import Progress, open_pool, run_campaign
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.pools import AHEAD
from sortie.sim.folders import RunError

pytest.importorskip("distributed")

GONE = "--scheduler tcp://head:8786: the scheduler is gone; what is finished is kept, the same command goes on"


class _Client:
    """A cluster without workers: each look at it takes the next of `looks`. It answers with rows that follow from the task."""

    def __init__(self, *looks: Callable[[_Client], int]) -> None:
        self.status, self.flying, self._looks = "running", list[tuple[Future[Flight], Task]](), iter(looks)

    def scheduler_info(self, n_workers: int = 5) -> dict[str, Any]:
        threads = next(self._looks, lambda client: 0)(self)
        return {"workers": {"a": {"nthreads": threads}} if threads else {}}

    def get_executor(self, *, pure: bool) -> _Client:
        return self

    def submit(self, function: Any, task: Task, memory_b: int | None) -> Future[Flight]:
        future: Future[Flight] = Future()
        self.flying.append((future, task))
        return future


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LOOK_S", 0.01)
    monkeypatch.setattr(pools, "LOOK_S", 0.01)
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.02)


def test_a_cluster_without_workers_is_told_and_given_up(tmp_path: Path) -> None:
    p, noticed = plan(tmp_path), list[str]()
    with pytest.raises(RunError) as told:
        run_campaign(p, tmp_path / "a", Cluster(_Client(), "tcp://head:8786", wait_s=0.2, notice=noticed.append))
    begin = "start one: dask worker tcp://head:8786"
    assert noticed == [
        f"--scheduler tcp://head:8786: no workers; waiting for up to 0.2 s (--wait-for-workers); {begin}"
    ]
    assert str(told.value) == (
        "--scheduler tcp://head:8786: no worker for 0.2 s (--wait-for-workers); what is finished is kept, "
        f"the same command goes on; {begin}"
    )


def _all_end(client: _Client) -> int:
    for future, task in client.flying:
        future.set_result(pretend(task))
    client.flying.clear()
    return 1


def test_workers_that_come_late_are_used(tmp_path: Path) -> None:
    p, noticed = plan(tmp_path), list[str]()
    client = _Client(*[lambda client: 0] * 8, *[_all_end] * 200)
    done = run_campaign(p, tmp_path / "a", Cluster(client, "tcp://head:8786", wait_s=600, notice=noticed.append))
    assert (done.finished, done.failed) == (48, 0)
    assert len(noticed) == 1


def test_rows_that_come_together_are_written_together(tmp_path: Path) -> None:
    """Also those that came with what ends the campaign."""
    p = plan(tmp_path)

    def end(client: _Client) -> int:
        for future, task in client.flying:
            if task.number == 2:
                future.set_exception(OSError("planted"))
            else:
                future.set_result(pretend(task))
        client.flying.clear()
        return 3

    client = _Client(lambda client: 3, end, *[lambda client: 3] * 9)
    rows = Cluster(client, "tcp://head:8786").rows(iter([p.task(run) for run in range(6)]))
    assert sorted(task.number for task, _ in next(rows)) == [0, 1, 3, 4, 5]
    with pytest.raises(RunError, match="a worker cannot fly: OSError: planted"):
        next(rows)


def test_a_run_that_kills_its_workers_is_recorded(tmp_path: Path) -> None:
    from distributed import KilledWorker

    def end(client: _Client) -> int:
        for future, task in client.flying:
            if task.number == 17:
                future.set_exception(KilledWorker("x", "y", 4))
            else:
                future.set_result(pretend(task))
        assert len(client.flying) <= 2 * AHEAD  # no more than what is in flight
        client.flying.clear()
        return 2

    p = plan(tmp_path)
    done = run_campaign(p, tmp_path / "a", Cluster(_Client(*[end] * 200), "tcp://head:8786"))
    assert (done.finished, done.failed) == (48, 1)
    table = pq.read_table(tmp_path / "a" / "runs").to_pylist()
    assert [(r["run"], r["error"]) for r in table if r["status"] == "failed"] == [(17, "WorkerDied: on every attempt")]


def _dies(client: _Client) -> int:
    raise OSError("Connection reset by peer\nin two lines")


def _cancels(client: _Client) -> int:
    for future, _ in client.flying:
        future.cancel()
        future.set_running_or_notify_cancel()
    client.flying.clear()
    return 0


def _closes(client: _Client) -> int:
    client.status = "closed"
    return 0


class _Silent(_Client):
    """Dies before its first answer: dask passes over the error, and then knows nothing of workers."""

    def scheduler_info(self, n_workers: int = 5) -> dict[str, Any]:
        return {}


def test_a_scheduler_that_dies_is_one_line(tmp_path: Path) -> None:
    """Whatever dask gives then, and however often it was asked before."""
    endings: dict[str, _Client] = {"before its first answer": _Silent()}
    for what in (_dies, _cancels, _closes):
        for before in (0, 1, 5):
            endings[f"{what.__name__} {before}"] = _Client(*[lambda client: 0] * before, *[what] * 9)
    said = {}
    for name, client in endings.items():
        with pytest.raises(RunError) as error:
            run_campaign(plan(tmp_path), tmp_path / name, Cluster(client, "tcp://head:8786", wait_s=600))
        said[name] = str(error.value)
    assert said == dict.fromkeys(endings, GONE)


Certificates = Callable[[str], tuple[Path, Path, Path]]


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    """CA, certificate and key of an authority, made once for each name."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs the openssl command")

    def run(*arguments: str | Path) -> None:
        subprocess.run([openssl, *map(str, arguments)], check=True, capture_output=True)

    @cache
    def make(name: str) -> tuple[Path, Path, Path]:
        folder = tmp_path_factory.mktemp(name)
        ca, ca_key, cert, key, ask = (folder / f for f in ("ca.pem", "ca.key", "cert.pem", "key.pem", "ask.csr"))
        new = ["-newkey", "rsa:2048", "-nodes"]
        run("req", "-x509", *new, "-days", "2", "-subj", f"/CN={name} authority", "-keyout", ca_key, "-out", ca)
        run("req", *new, "-subj", f"/CN={name}", "-keyout", key, "-out", ask)
        run("x509", "-req", "-in", ask, "-CA", ca, "-CAkey", ca_key, "-CAcreateserial", "-days", "2", "-out", cert)
        return ca, cert, key

    return make


@pytest.mark.slow
def test_what_cannot_be_done_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, certificates: Certificates
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
    (ca, cert, key), (*_, their_key) = certificates("ours"), certificates("theirs")
    tcp, tls = ["--scheduler", "tcp://127.0.0.1:1"], ["--scheduler", "tls://127.0.0.1:1"]
    ours = ["--security", ca, cert, key]
    memory = "worker_memory_gb: {}, must be a number above 0, or None"
    table: list[tuple[list[Any], str]] = [
        ([*tcp, *ours], f"{' '.join(tcp)}: must be an address like tls://host:8786, as --security is given"),
        (tls, f"{' '.join(tls)}: needs --security CA CERT KEY"),
        ([*tls, *ours], f"{' '.join(tls)}: no scheduler answers there that takes these certificates"),
        (["--workers", "0", *ours], "--security goes with --scheduler"),
        ([*tls, "--security", ca, "nowhere.pem", key], "--security nowhere.pem: no such file"),
        ([*tls, "--security", key, cert, key], f"--security {key}: is not a PEM certificate ("),
        ([*tls, "--security", ca, cert, their_key], f"--security {cert} {their_key}: not a certificate and its key ("),
        (["--workers", "0", "--worker-memory", "0"], memory.format("0.0")),
        (["--workers", "0", "--worker-memory", "nan"], memory.format("nan")),
    ]
    campaign, wrong = write(tmp_path), {}
    for options, message in table:
        arguments = ["campaign", campaign, "--out", tmp_path / "a", *options]
        error = CliRunner().invoke(app, list(map(str, arguments))).exception
        if not isinstance(error, RunError) or not str(error).startswith(message) or "\n" in str(error):
            wrong[message] = error
    assert wrong == {}


@pytest.mark.slow
@CLUSTER
def test_a_cluster_with_tls_flies_the_same_rows_and_lets_nobody_else_in(
    tmp_path: Path, certificates: Certificates, monkeypatch: pytest.MonkeyPatch
) -> None:
    p = plan(tmp_path)
    run_campaign(p, tmp_path / "alone", InProcess())
    with small_cluster(security=cluster._certificates(certificates("ours"))) as opened:
        address = opened.scheduler_address
        assert address.startswith("tls://")
        with open_pool(scheduler=address, security=certificates("ours")) as pool:
            run_campaign(p, tmp_path / "joined", pool)
        assert table_bytes(tmp_path / "joined") == table_bytes(tmp_path / "alone")
        monkeypatch.setattr(cluster, "CONNECT_S", 2.0)
        for scheduler, security in ((address, certificates("theirs")), (address.replace("tls://", "tcp://"), None)):
            with (
                pytest.raises(RunError, match=f"--scheduler {scheduler}: no scheduler answers there"),
                open_pool(scheduler=scheduler, security=security),
            ):
                pass


@CLUSTER
@pytest.mark.slow
def test_a_cluster_of_four_loses_two_on_the_way(tmp_path: Path) -> None:
    """The scheduler is joined by its address; two worker processes get SIGKILL while runs are in flight."""
    import dask

    p = plan(tmp_path, CAMPAIGN.replace("replications: 2", "replications: 4"))
    run_campaign(p, tmp_path / "alone", InProcess())
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 10}),
        small_cluster(4) as cluster,
        open_pool(scheduler=cluster.scheduler_address) as pool,
    ):
        victims = [w.pid for w in cluster.workers.values()][:2]

        def progress(done: Progress) -> None:
            if victims and done.flown >= 5 * (3 - len(victims)):
                os.kill(victims.pop(), signal.SIGKILL)

        done = run_campaign(p, tmp_path / "cluster", pool, progress=progress)
    assert not victims
    assert (done.finished, done.failed) == (96, 0)
    assert table_bytes(tmp_path / "cluster") == table_bytes(tmp_path / "alone")
