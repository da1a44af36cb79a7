"""Clusters without workers, schedulers that die, certificates: one line each."""

from __future__ import annotations

import logging
import shutil
import ssl
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from campaign_examples import CLUSTER, InProcess, plan, table_bytes, write
from typer.testing import CliRunner

import sortie
from sortie.sim.campaign import cluster
from sortie.sim.campaign.cluster import Dask, _quiet
from sortie.sim.campaign.drive import run_campaign
from sortie.sim.campaign.engine import open_engine
from sortie.sim.cli.app import app
from sortie.sim.folders import RunError

pytestmark = pytest.mark.slow

pytest.importorskip("distributed")

GONE = "--scheduler tcp://head:8786: the scheduler is gone; what is finished is kept, the same command goes on"


class _Waiting:
    """What dask gives for a task that no worker takes, until somebody ends it."""

    def __init__(self, call: Callable[[], Any]) -> None:
        self.status, self.result, self._calls = "pending", call, list[Callable[[Any], None]]()

    def add_done_callback(self, call: Callable[[Any], None]) -> None:
        self._calls.append(call)

    def end(self, status: str) -> None:
        self.status, calls, self._calls = status, self._calls, []
        for call in calls:
            call(self)


class _Client:
    """A cluster without workers: each look at it takes the next of `looks`."""

    def __init__(self, *looks: Callable[[_Client], int]) -> None:
        self.status, self.flying, self._looks = "running", list[_Waiting](), iter(looks)

    def scheduler_info(self, n_workers: int = 5) -> dict[str, Any]:
        threads = next(self._looks, lambda client: 0)(self)
        return {"workers": {"a": {"nthreads": threads}} if threads else {}}

    def submit(self, function: Any, code: str, batch: Any, memory_b: int | None, **_: Any) -> _Waiting:
        self.flying.append(_Waiting(lambda: function(code, batch, memory_b)))
        return self.flying[-1]


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LOOK_S", 0.01)
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.02)


def test_a_cluster_without_workers_is_told_and_given_up(tmp_path: Path) -> None:
    p, noticed = plan(tmp_path), list[str]()
    with pytest.raises(RunError) as told:
        run_campaign(p, tmp_path / "a", Dask(_Client(), "tcp://head:8786", wait_s=0.2, notice=noticed.append))
    begin = "start one: dask worker tcp://head:8786"
    assert noticed == [
        f"--scheduler tcp://head:8786: no workers; waiting for up to 0.2 s (--wait-for-workers); {begin}"
    ]
    assert str(told.value) == (
        "--scheduler tcp://head:8786: no worker for 0.2 s (--wait-for-workers); what is finished is kept, "
        f"the same command goes on; {begin}"
    )


def test_workers_that_come_late_are_used(tmp_path: Path) -> None:
    def fly(client: _Client) -> int:
        for future in client.flying:
            future.end("finished")
        return 1

    p, noticed = plan(tmp_path), list[str]()
    client = _Client(*[lambda client: 0] * 8, *[fly] * 200)
    done = run_campaign(p, tmp_path / "a", Dask(client, "tcp://head:8786", wait_s=600, notice=noticed.append))
    assert (done.finished, done.failed) == (48, 0)
    assert len(noticed) == 1


def _all_end(client: _Client) -> int:
    for future in client.flying:
        future.end("finished")
    return 1


def test_batches_that_come_together_are_written_together(tmp_path: Path) -> None:
    """Also those that came with what ends the campaign."""
    p = plan(tmp_path)
    tasks = [(run, p.task(run)) for run in range(6)]

    def lose_the_third(client: _Client) -> int:
        for i, future in enumerate(client.flying):
            future.end("finished" if i < 2 else "cancelled")
        return 3

    three = [lambda client: 3] * 2
    together = Dask(_Client(*three, _all_end, *[_all_end] * 20), "tcp://head:8786").results(p.code, iter(tasks))
    assert [r.run for r in next(together)] == [0, 1]
    assert sorted(r.run for rows in together for r in rows) == [2, 3, 4, 5]
    broken = Dask(_Client(*three, *three, lose_the_third), "tcp://head:8786").results(p.code, iter(tasks))
    assert [r.run for r in next(broken)] == [0, 1]
    with pytest.raises(RunError):
        next(broken)


def _dies(client: _Client) -> int:
    raise OSError("Connection reset by peer\nin two lines")


def _cancels(client: _Client) -> int:
    for future in client.flying:
        future.end("cancelled")
    return 0


def _closes(client: _Client) -> int:
    client.status = "closed"
    return 0


@pytest.mark.parametrize("what", [_dies, _cancels, _closes])
@pytest.mark.parametrize("before", [0, 1, 5])
def test_a_scheduler_that_dies_is_one_line(tmp_path: Path, what: Callable[[_Client], int], before: int) -> None:
    client = _Client(*[lambda client: 0] * before, *[what] * 9)
    with pytest.raises(RunError) as told:
        run_campaign(plan(tmp_path), tmp_path / "a", Dask(client, "tcp://head:8786", wait_s=600))
    assert str(told.value) == GONE


def test_a_scheduler_that_dies_before_its_first_answer_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """dask passes over the error, and then knows nothing of workers."""
    monkeypatch.setattr(_Client, "scheduler_info", lambda self, n_workers=5: {})
    with pytest.raises(RunError) as told:
        run_campaign(plan(tmp_path), tmp_path / "a", Dask(_Client(), "tcp://head:8786"))
    assert str(told.value) == GONE


def test_a_result_that_cannot_be_fetched_is_one_line(tmp_path: Path) -> None:
    def lose(client: _Client) -> int:
        def call() -> Any:
            raise TimeoutError

        for future in client.flying:
            future.result = call
            future.end("finished")
        return 1

    with pytest.raises(RunError) as told:
        run_campaign(plan(tmp_path), tmp_path / "a", Dask(_Client(*[lose] * 9), "tcp://head:8786"))
    assert str(told.value) == GONE


def test_what_dask_logs_is_not_told(caplog: pytest.LogCaptureFixture) -> None:
    """Its modules have levels of their own, which that of "distributed" does not change."""
    names = ("distributed", "distributed.client", "distributed.mine", "tornado.application", "asyncio")
    logging.getLogger("distributed.client").setLevel(logging.WARNING)
    before = [logging.getLogger(name).level for name in names]
    with _quiet():
        for name in names:
            logging.getLogger(name).critical("Traceback")
    assert caplog.messages == []
    assert [logging.getLogger(name).level for name in names] == before


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, Path, Path]]:
    """CA, certificate and key of an authority, made once for each name."""
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs the openssl command")
    made: dict[str, tuple[Path, Path, Path]] = {}

    def run(*arguments: str | Path) -> None:
        subprocess.run([openssl, *map(str, arguments)], check=True, capture_output=True)

    def make(name: str) -> tuple[Path, Path, Path]:
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            ca, ca_key, cert, key, ask = (folder / f for f in ("ca.pem", "ca.key", "cert.pem", "key.pem", "ask.csr"))
            new = ["-newkey", "rsa:2048", "-nodes"]
            run("req", "-x509", *new, "-days", "2", "-subj", f"/CN={name} authority", "-keyout", ca_key, "-out", ca)
            run("req", *new, "-subj", f"/CN={name}", "-keyout", key, "-out", ask)
            sign = ["-CA", ca, "-CAkey", ca_key, "-CAcreateserial", "-days", "2"]
            run("x509", "-req", "-in", ask, *sign, "-out", cert)
            made[name] = (ca, cert, key)
        return made[name]

    return make


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (
            lambda ours, theirs: ["--scheduler", "tcp://127.0.0.1:1", "--security", *ours],
            "--scheduler tcp://127.0.0.1:1: must be an address like tls://host:8786, as --security is given",
        ),
        (
            lambda ours, theirs: ["--scheduler", "tls://127.0.0.1:1"],
            "--scheduler tls://127.0.0.1:1: needs --security CA CERT KEY",
        ),
        (
            lambda ours, theirs: ["--scheduler", "tls://127.0.0.1:1", "--security", *ours],
            "--scheduler tls://127.0.0.1:1: no scheduler answers there that takes these certificates",
        ),
        (
            lambda ours, theirs: ["--workers", "0", "--security", *ours],
            "--security goes with --scheduler",
        ),
        (
            lambda ours, theirs: ["--scheduler", "tls://127.0.0.1:1", "--security", ours[0], "nowhere.pem", ours[2]],
            "--security nowhere.pem: no such file",
        ),
        (
            lambda ours, theirs: ["--scheduler", "tls://127.0.0.1:1", "--security", ours[2], ours[1], ours[2]],
            "--security {key}: is not a PEM certificate (",
        ),
        (
            lambda ours, theirs: ["--scheduler", "tls://127.0.0.1:1", "--security", ours[0], ours[1], theirs[2]],
            "--security {cert} {their_key}: not a certificate and its key (",
        ),
        (lambda ours, theirs: ["--workers", "0", "--worker-memory", "0"], "worker_memory_gb: 0.0, must be a number above 0, or None"),
        (lambda ours, theirs: ["--workers", "0", "--worker-memory", "nan"], "worker_memory_gb: nan, must be a number above 0, or"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    certificates: Callable[[str], tuple[Path, Path, Path]],
    how: Callable[[tuple[Path, ...], tuple[Path, ...]], list[object]],
    message: str,
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
    ours, theirs = certificates("ours"), certificates("theirs")
    arguments = ["campaign", str(write(tmp_path)), "--out", str(tmp_path / "a"), *map(str, how(ours, theirs))]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, RunError), result.output
    said = str(result.exception)
    assert said.startswith(message.format(cert=ours[1], key=ours[2], their_key=theirs[2]))
    assert "\n" not in said


def test_security_is_three_paths(tmp_path: Path) -> None:
    for wrong in ("ca.pem", ("ca.pem", "cert.pem")):
        with pytest.raises(RunError, match="must be three paths: CA, certificate, key"):
            sortie.campaign("link_battery", security=wrong)  # type: ignore[arg-type]


@pytest.fixture
def tls_scheduler(certificates: Callable[[str], tuple[Path, Path, Path]]) -> Iterator[str]:
    """A cluster that speaks TLS alone; its address."""
    from distributed import LocalCluster

    made = cluster._certificates(certificates("ours"))
    with LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0, silence_logs="CRITICAL",
        security=made,
    ) as opened:  # fmt: skip
        yield opened.scheduler_address


@CLUSTER
def test_a_cluster_with_tls_flies_the_same_rows_and_lets_nobody_else_in(
    tmp_path: Path,
    tls_scheduler: str,
    certificates: Callable[[str], tuple[Path, Path, Path]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    p = plan(tmp_path)
    assert tls_scheduler.startswith("tls://")
    run_campaign(p, tmp_path / "alone", InProcess())
    with open_engine(scheduler=tls_scheduler, security=certificates("ours")) as engine:
        run_campaign(p, tmp_path / "joined", engine)
    assert table_bytes(tmp_path / "joined") == table_bytes(tmp_path / "alone")
    address = tls_scheduler.replace("tls://", "tcp://")
    monkeypatch.setattr(cluster, "CONNECT_S", 2.0)
    for scheduler, security in ((tls_scheduler, certificates("theirs")), (address, None)):
        with (
            pytest.raises(RunError, match=f"--scheduler {scheduler}: no scheduler answers there"),
            open_engine(scheduler=scheduler, security=security),
        ):
            pass


def test_openssl_makes_what_python_takes(certificates: Callable[[str], tuple[Path, Path, Path]]) -> None:
    ca, cert, key = certificates("ours")
    ssl.create_default_context(cafile=str(ca)).load_cert_chain(cert, key)
