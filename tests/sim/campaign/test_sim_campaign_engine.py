"""The same rows in the process, on one worker, on two, and on a cluster that is joined; workers that die."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, CLUSTER, InProcess, Pretended, plan, table_bytes, write
from typer.testing import CliRunner

from sortie.sim.apart import DiedError
from sortie.sim.campaign import cluster, processes
from sortie.sim.campaign.cluster import Dask
from sortie.sim.campaign.drive import Progress, run_campaign
from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.processes import AHEAD, OneProcess, Processes, Turns
from sortie.sim.campaign.rows import find_row
from sortie.sim.campaign.store import CampaignStore
from sortie.sim.campaign.work import Task, fly_batch
from sortie.sim.cli.app import app
from sortie.sim.folders import RunError
from sortie.sim.identity import RELEASE, codes_here

pytest.importorskip("distributed")

FAULTY = """
import os
from sortie.policies.contract import Directive

def decide(view, *, how="fail"):
    if view.me.battery_soc < 0.5:
        {what}
    return [Directive(view.ego, p, reason="nothing") for p in view.peers]
"""


@pytest.mark.slow
def test_zero_one_and_two_workers_give_the_same_bytes(tmp_path: Path) -> None:
    p = plan(tmp_path)
    for workers in (0, 1, 2):
        with open_engine(workers) as engine:
            assert engine.workers == max(1, workers)
            done = run_campaign(p, tmp_path / str(workers), engine)
            assert (done.finished, done.failed) == (48, 0)
    tables = [table_bytes(tmp_path / str(w)) for w in (0, 1, 2)]
    assert tables[0] == tables[1] == tables[2]
    assert list(tables[0]) == ["table.parquet"]


@CLUSTER
@pytest.mark.slow
def test_a_cluster_of_four_loses_two_on_the_way(tmp_path: Path) -> None:
    """The scheduler is joined by its address; two worker processes get SIGKILL while runs are in flight."""
    import dask
    from distributed import LocalCluster

    p = plan(tmp_path, CAMPAIGN.replace("replications: 2", "replications: 4"))
    run_campaign(p, tmp_path / "alone", InProcess())
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 10}),
        LocalCluster(
            n_workers=4, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0, silence_logs="CRITICAL"
        ) as cluster,
        open_engine(scheduler=cluster.scheduler_address) as engine,
    ):
        victims = [w.pid for w in cluster.workers.values()][:2]

        def progress(done: Progress) -> None:
            if victims and done.flown >= 5 * (3 - len(victims)):
                os.kill(victims.pop(), signal.SIGKILL)

        done = run_campaign(p, tmp_path / "cluster", engine, progress=progress)
    assert not victims
    assert (done.finished, done.failed) == (96, 0)
    assert table_bytes(tmp_path / "cluster") == table_bytes(tmp_path / "alone")


@pytest.mark.slow
def test_processes_that_are_killed_cost_nothing(tmp_path: Path) -> None:
    """Five times one of three, while it starts, flies, or waits."""
    p = plan(tmp_path)
    run_campaign(p, tmp_path / "alone", InProcess())
    killed: list[int] = []

    def progress(done: Progress) -> None:
        if done.flown > 6 * (len(killed) + 1) and len(killed) < 5:
            process = engine._processes[len(killed) % 3]._process
            if process is not None:
                killed.append(process._process.pid)
                process.end()

    with open_engine(3) as engine:
        assert isinstance(engine, Processes)
        done = run_campaign(p, tmp_path / "a", engine, progress=progress)
    assert len(killed) == 5
    assert (done.finished, done.failed) == (48, 0)
    assert table_bytes(tmp_path / "a") == table_bytes(tmp_path / "alone")


def test_a_run_that_flies_alone_waits_for_the_others_and_they_wait_for_it() -> None:
    turns, order, first_flies = Turns(), list[str](), threading.Event()
    first_may_land, alone_waits = threading.Event(), threading.Event()

    def first() -> None:
        with turns.turn(alone=False):
            first_flies.set()
            first_may_land.wait(60)
            order.append("first lands")

    def alone() -> None:
        alone_waits.set()
        with turns.turn(alone=True):
            order.append("alone begins")
            second.start()
            second.join(0.05)  # it would fly now, if it did not wait
            order.append("alone lands")

    def fly_second() -> None:
        with turns.turn(alone=False):
            order.append("second flies")

    second, threads = threading.Thread(target=fly_second), [threading.Thread(target=each) for each in (first, alone)]
    for thread, begun in zip(threads, (first_flies, alone_waits), strict=True):
        thread.start()
        assert begun.wait(60)
    first_may_land.set()
    for thread in (*threads, second):
        thread.join(60)
    assert order == ["first lands", "alone begins", "alone lands", "second flies"]


def test_the_last_attempt_of_a_run_that_kills_its_process_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    class Noting(Turns):
        def turn(self, *, alone: bool) -> AbstractContextManager[None]:
            asked.append(alone)
            return super().turn(alone=alone)

    asked = list[bool]()

    class Dies:
        def call(self, *_: Any) -> None:
            raise DiedError

        def close(self) -> None: ...

    monkeypatch.setattr(processes, "Apart", Dies)
    one = OneProcess(turns=Noting())
    assert one.fly("", (0, '{"metrics": [], "scenario": {"limits": {}}}')).error == "WorkerDied: on every attempt"
    assert asked == [False, False, False, True]


def test_rows_that_came_are_kept_when_another_run_cannot_fly(tmp_path: Path) -> None:
    """A worker with other code raises; what the others flew comes first."""
    p = plan(tmp_path)
    with open_engine(1) as engine:
        rows = engine.results(p.code, iter([(3, p.task(3))]))
        assert [row.run for row in next(rows)] == [3]
        assert list(rows) == []
        assert isinstance(engine, Processes)
        engine._landed.put(RunError("planted"))
        engine._landed.put(fly_batch(p.code, [(4, p.task(4))])[0][0])
        late = engine.results(p.code, iter([(5, p.task(5)), (6, p.task(6))]))
        assert [row.run for row in next(late)] == [4]
        with pytest.raises(RunError, match="planted"):
            next(late)


class _Future:
    """What dask gives for a task, here at once or as the death of its worker; or at first lost with its worker."""

    def __init__(self, call: Any, error: BaseException | None, *, lost: bool = False) -> None:
        self.call, self.error, self.lost = call, error, lost

    @property
    def status(self) -> str:
        if self.lost:
            self.lost = False
            return "lost"
        return "finished" if self.error is None else "error"

    def result(self) -> Any:
        return self.call()

    def exception(self) -> BaseException | None:
        return self.error

    def add_done_callback(self, call: Any) -> None:
        call(self)


class _Client:
    """A cluster whose workers die of one run, and lose the results of some; it counts what is in flight."""

    status = "running"

    def __init__(self, deadly: int = -1, lost: frozenset[int] = frozenset()) -> None:
        self.deadly, self.lost, self.batches, self.most, self.flying = deadly, lost, list[int](), 0, 0

    def scheduler_info(self, n_workers: int = 5) -> dict[str, Any]:
        return {"workers": {"a": {"nthreads": 1}, "b": {"nthreads": 1}}}

    def submit(self, function: Any, code: str, batch: list[Task], memory_b: int | None, **_: Any) -> _Future:
        from distributed import KilledWorker

        self.batches.append(len(batch))
        dies = any(run == self.deadly for run, _ in batch)
        lost = any(run in self.lost for run, _ in batch)
        self.flying += 1
        self.most = max(self.most, self.flying)

        def call() -> Any:
            self.flying -= 1
            return function(code, batch, memory_b)

        return _Future(call, KilledWorker("x", "y", 4) if dies else None, lost=lost)


def test_a_run_that_kills_its_workers_is_recorded_and_its_batch_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    p, client = plan(tmp_path), _Client(deadly=17)
    monkeypatch.setattr(cluster, "BATCH_S", 1e9)  # as many a batch as there may be
    monkeypatch.setattr(cluster, "MAX_BATCH", 5)
    done = run_campaign(p, tmp_path / "a", Dask(client, "tcp://head:8786"))
    assert (done.finished, done.failed) == (48, 1)
    table = pq.read_table(tmp_path / "a" / "runs").to_pylist()
    assert [(r["run"], r["error"]) for r in table if r["status"] == "failed"] == [(17, "WorkerDied: on every attempt")]
    assert all(r["key"] == p.key(r["run"]) for r in table)
    assert max(client.batches) == 5
    assert client.most <= AHEAD * 2 + max(client.batches)  # no more than what is in flight


def test_a_result_lost_with_its_worker_is_waited_for_again(tmp_path: Path) -> None:
    """The worker dies after its run has ended and before the result was fetched."""
    p, client = plan(tmp_path), _Client(lost=frozenset({0, 7, 48}))
    done = run_campaign(p, tmp_path / "a", Dask(client, "tcp://head:8786"))
    assert (done.finished, done.failed) == (p.runs, 0)
    assert sum(client.batches) == p.runs  # none was given out twice
    run_campaign(p, tmp_path / "alone", InProcess())
    assert table_bytes(tmp_path / "a") == table_bytes(tmp_path / "alone")


def test_batches_are_about_a_second_long() -> None:
    engine = Dask(_Client(), "tcp://head:8786")
    assert engine._batch() == 1  # until it is known how long a run takes
    engine._learn(0.3)
    assert engine._batch() == 3
    engine._learn(300)
    assert engine._batch() == 1


def test_a_worker_with_other_code_flies_nothing(tmp_path: Path) -> None:
    p = plan(tmp_path)
    with pytest.raises(RunError, match=rf"this worker runs Sortie {RELEASE}\+[0-9a-f]+, the campaign is of other"):
        run_campaign(CampaignPlan({**p.spec, "code": "other"}), tmp_path / "a", InProcess())


def test_a_worker_that_sees_another_policy_file_flies_nothing(tmp_path: Path) -> None:
    policy = tmp_path / "mine.py"
    policy.write_text(FAULTY.format(what="pass"))
    p = plan(tmp_path, CAMPAIGN.replace("worked", f"{policy}:decide"))
    policy.write_text(FAULTY.format(what="pass # edited"))
    with pytest.raises(RunError, match=r"mine.py: is not the file that the campaign was begun with"):
        fly_batch(p.code, [(0, p.task(0))])


def test_a_policy_file_that_is_edited_between_two_runs_is_noticed_by_the_same_worker(tmp_path: Path) -> None:
    policy = tmp_path / "mine.py"
    policy.write_text(FAULTY.format(what="pass"))
    p = plan(tmp_path, CAMPAIGN.replace("worked", f"{policy}:decide"))
    fly_batch(p.code, [(0, p.task(0))])
    policy.write_text(FAULTY.format(what="pass # edited"))
    with pytest.raises(RunError, match=r"mine.py: is not the file that the campaign was begun with"):
        fly_batch(p.code, [(1, p.task(1))])


def test_a_worker_flies_with_its_own_torch_alone(tmp_path: Path) -> None:
    torch = plan(tmp_path, base=BASE.replace("detector: none", "detector: torch")).code
    assert torch == codes_here()[1] != plan(tmp_path).code
    assert fly_batch(torch, [])[0] == fly_batch(plan(tmp_path).code, [])[0] == []
    other = f"{codes_here()[0]} torch 1.0"
    with pytest.raises(RunError, match=r"this worker runs Sortie \S+ torch \S+, the campaign is of \S+ torch 1\.0"):
        fly_batch(other, [])


def test_a_failing_run_is_recorded_and_the_rest_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    policy = tmp_path / "faulty.py"
    policy.write_text(FAULTY.format(what="raise RuntimeError('planted\\nin two lines')"))
    p, folder = plan(tmp_path, CAMPAIGN.replace("worked", f"{policy}:decide")), tmp_path / "a"
    done = run_campaign(p, folder, InProcess())
    table = pq.read_table(folder / "runs").to_pylist()
    low = [r for r in table if r["fleet.battery.initial_soc"] < 0.5 and r["policy"].endswith(":decide")]
    failed = [r for r in table if r["status"] == "failed"]
    assert [r["run"] for r in failed] == [r["run"] for r in low]
    assert done.failed == len(low) > 0
    assert "planted" in failed[0]["error"]
    assert "\n" not in failed[0]["error"]
    assert failed[0]["energy_j.total"] is None
    again = CliRunner().invoke(app, ["fly", "--from-campaign", str(folder), "--run", str(failed[0]["run"])])
    assert "planted" in str(again.exception)
    good = next(r for r in table if r["status"] == "done")
    out = tmp_path / "again"
    command = ["fly", "--from-campaign", str(folder), "--run", str(good["run"]), "--no-recording", "--out", str(out)]
    result = CliRunner().invoke(app, command)
    assert "the record is the campaign's" in result.stdout
    assert (out / "outcome.json").is_file()
    told = CliRunner().invoke(app, ["campaign", str(tmp_path / "small_ones.yaml"), "--out", str(folder), "--no-report"])
    assert (told.exit_code, f"{done.failed} failed" in told.stdout) == (1, True), (
        "nothing is flown; what failed is told"
    )


@pytest.mark.slow
def test_failed_runs_are_flown_again_on_the_command_line(tmp_path: Path) -> None:
    cause = tmp_path / "cause"
    cause.touch()
    policy = tmp_path / "faulty.py"
    policy.write_text(FAULTY.format(what=f"assert not os.path.exists({str(cause)!r}), 'planted'"))
    path, folder = write(tmp_path, CAMPAIGN.replace("worked", f"{policy}:decide")), tmp_path / "a"
    command = ["campaign", str(path), "--workers", "0", "--out", str(folder), "--no-report"]
    told = CliRunner().invoke(app, command)
    failed = [r["run"] for r in pq.read_table(folder / "runs").to_pylist() if r["status"] == "failed"]
    assert (told.exit_code, f"{len(failed)} failed" in told.stdout) == (1, True)
    assert failed
    cause.unlink()
    told = CliRunner().invoke(app, [*command, "--retry-failed"])
    assert (told.exit_code, f"48 runs finished; {len(failed)} of them now" in told.stdout) == (0, True)
    assert CliRunner().invoke(app, [*command[:-2], str(tmp_path / "b"), "--no-report"]).exit_code == 0
    assert table_bytes(folder) == table_bytes(tmp_path / "b")


def test_any_run_of_a_campaign_that_broke_off_can_be_flown(tmp_path: Path) -> None:
    """A run with a row is compared with it, whether its part is finished or not; one that was not flown has no row."""
    p, folder = plan(tmp_path), tmp_path / "a"
    store = CampaignStore(folder, p)
    store.add(fly_batch(p.code, [(run, p.task(run)) for run in (0, 3)])[0])
    store.close()
    for run, said in (
        (3, "the record is the campaign's"),
        (40, "has not flown run 40 yet: there is no record to compare"),
    ):
        out = tmp_path / str(run)
        command = ["fly", "--from-campaign", str(folder), "--run", str(run), "--no-recording", "--out", str(out)]
        result = CliRunner().invoke(app, command)
        assert (result.exit_code, said in result.output) == (0, True), result.output
        assert ("the record is" in result.output) == (run == 3)
        assert (out / "outcome.json").is_file()
    waiting = find_row(folder, 3)[1]
    run_campaign(p, folder, InProcess())
    assert waiting == find_row(folder, 3)[1] is not None


def test_a_broken_file_is_one_line_on_the_command_line(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    run_campaign(p, folder, Pretended())
    file = folder / "campaign.sqlite"
    file.write_bytes(file.read_bytes()[:5000])
    for command in (["campaign", "report", str(folder)], ["fly", "--from-campaign", str(folder), "--run", "40"]):
        result = CliRunner().invoke(app, command)
        assert isinstance(result.exception, RunError)  # sortie.sim.cli.app prints it in one line and exits with 2
        assert str(result.exception).startswith(f"{file}: is broken (")


def test_a_drawn_value_that_the_schema_refuses_is_a_failed_run(tmp_path: Path) -> None:
    text = CAMPAIGN.replace("{kind: uniform, low: 0.2, high: 1}", "{kind: normal, mean: 0.9, sd: 0.2}")
    p = plan(tmp_path, text)
    above = {r for r in range(p.runs) if p.varied(p.at(r).cell)["fleet.battery.initial_soc"] > 1}
    assert 0 < len(above) < p.runs
    run_campaign(p, tmp_path / "a", InProcess())
    table = pq.read_table(tmp_path / "a" / "runs").to_pylist()
    assert {r["run"] for r in table if r["status"] == "failed"} == above
    assert "initial_soc" in table[min(above)]["error"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workers", "1", "--scheduler", "tcp://localhost:1"], "--workers and --scheduler: name one of them"),
        (["--scheduler", "foo"], "--scheduler foo: must be an address like tcp://host:8786: missing port number"),
        (
            ["--scheduler", "smb://foo:1"],
            "--scheduler smb://foo:1: must be an address like tcp://host:8786: unknown address",
        ),
        (["--scheduler", "tcp://127.0.0.1:1"], "--scheduler tcp://127.0.0.1:1: no scheduler answers there"),
        (["--workers", "0", "--resume"], "no campaign there to resume (campaign.sqlite is missing)"),
        (["--workers", "0", "--out", __file__ + "/a"], "/a: its folder cannot be made or written to: "),
        (["--workers", "0", "--out", "/proc/nothing/here"], "/proc/nothing/here: "),
    ],
)
def test_what_cannot_be_done_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    import distributed

    monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
    monkeypatch.setattr(distributed, "Client", None)  # one that finds nobody would hang, and complain, when it goes
    path = write(tmp_path)
    if "--out" not in arguments:
        arguments = [*arguments, "--out", str(tmp_path / "a")]
    result = CliRunner().invoke(app, ["campaign", str(path), *arguments])
    assert isinstance(result.exception, RunError)  # sortie.sim.cli.app prints it in one line and exits with 2
    assert message in str(result.exception)


def test_the_driver_keeps_only_what_is_in_flight() -> None:
    """An engine pulls tasks as it can use them."""
    pulled = []

    def tasks() -> Iterator[Task]:
        for run in range(1000):
            pulled.append(run)
            yield run, "{}"

    stream = InProcess().results("other code", tasks())
    with pytest.raises(RunError):
        next(stream)
    assert pulled == [0]
