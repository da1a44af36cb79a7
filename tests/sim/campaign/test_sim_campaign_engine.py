"""The same rows in this process, on one worker and on two; workers that die; runs that fail, and flying one again."""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, InProcess, plan, table_bytes, write
from typer.testing import CliRunner

from sortie.sim.apart import DiedError
from sortie.sim.campaign import cluster, processes
from sortie.sim.campaign.drive import Progress, run_campaign
from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.processes import OneProcess, Processes, Turns
from sortie.sim.campaign.rows import find_row
from sortie.sim.campaign.store import CampaignStore
from sortie.sim.campaign.work import fly_batch
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


def test_a_worker_with_other_code_or_another_torch_flies_nothing(tmp_path: Path) -> None:
    p = plan(tmp_path)
    with pytest.raises(RunError, match=rf"this worker runs Sortie {RELEASE}\+[0-9a-f]+, the campaign is of other"):
        run_campaign(CampaignPlan({**p.spec, "code": "other"}), tmp_path / "a", InProcess())
    torch = plan(tmp_path, base=BASE.replace("detector: none", "detector: torch")).code
    assert torch == codes_here()[1] != plan(tmp_path).code
    assert fly_batch(torch, [])[0] == fly_batch(plan(tmp_path).code, [])[0] == []
    other = f"{codes_here()[0]} torch 1.0"
    with pytest.raises(RunError, match=r"this worker runs Sortie \S+ torch \S+, the campaign is of \S+ torch 1\.0"):
        fly_batch(other, [])


def test_a_worker_that_sees_another_policy_file_flies_nothing(tmp_path: Path) -> None:
    """Whether it was edited before the worker's first run, or between two of its runs."""
    for before in ([], [0]):
        policy = tmp_path / "mine.py"
        policy.write_text(FAULTY.format(what="pass"))
        p = plan(tmp_path, CAMPAIGN.replace("worked", f"{policy}:decide"))
        fly_batch(p.code, [(run, p.task(run)) for run in before])
        policy.write_text(FAULTY.format(what="pass # edited"))
        with pytest.raises(RunError, match=r"mine.py: is not the file that the campaign was begun with"):
            fly_batch(p.code, [(2, p.task(2))])


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


def test_a_drawn_value_that_the_schema_refuses_is_a_failed_run(tmp_path: Path) -> None:
    p = plan(tmp_path, CAMPAIGN.replace("{kind: uniform, low: 0.2, high: 1}", "{kind: normal, mean: 0.9, sd: 0.2}"))
    above = [r for r in range(p.runs) if p.varied(p.at(r).cell)["fleet.battery.initial_soc"] > 1]
    assert 0 < len(above) < p.runs
    rows, _ = fly_batch(p.code, [(run, p.task(run)) for run in above])
    assert {row.status for row in rows} == {"failed"}
    assert "initial_soc" in rows[0].error


ADDRESS = "must be an address like tcp://host:8786"
CANNOT_BE_DONE = [
    ("--workers 1 --scheduler tcp://localhost:1", "--workers and --scheduler: name one of them"),
    ("--scheduler foo", f"--scheduler foo: {ADDRESS}: missing port number"),
    ("--scheduler smb://foo:1", f"--scheduler smb://foo:1: {ADDRESS}: unknown address"),
    ("--scheduler tcp://127.0.0.1:1", "--scheduler tcp://127.0.0.1:1: no scheduler answers there"),
    ("--workers 0 --resume", "no campaign there to resume (campaign.sqlite is missing)"),
    (f"--workers 0 --out {__file__}/a", "/a: its folder cannot be made or written to: "),
    ("--workers 0 --out /proc/nothing/here", "/proc/nothing/here: "),
]


def test_what_cannot_be_done_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed

    monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
    monkeypatch.setattr(distributed, "Client", None)  # one that finds nobody would hang, and complain, when it goes
    campaign, wrong = str(write(tmp_path)), {}
    for options, message in CANNOT_BE_DONE:
        out = [] if "--out" in options else ["--out", str(tmp_path / "a")]
        error = CliRunner().invoke(app, ["campaign", campaign, *options.split(), *out]).exception
        if not isinstance(error, RunError) or message not in str(error):
            wrong[options] = error
    assert wrong == {}
