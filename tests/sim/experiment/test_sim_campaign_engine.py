"""The same rows in this process, on one worker and on two; workers that die; runs that fail, and flying one again."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, InProcess, plan, pretend, table_bytes, write
from typer.testing import CliRunner

from sortie.sim.apart import DiedError
from sortie.sim.cli.app import app
from sortie.sim.experiment import cluster, pools
from sortie.sim.experiment.drive import Progress, open_pool, run_campaign
from sortie.sim.experiment.flight import Flight, Task, fly_in_worker
from sortie.sim.experiment.plan import CampaignPlan
from sortie.sim.experiment.pools import Beside, Futures, Processes, processes
from sortie.sim.experiment.rows import find_row
from sortie.sim.experiment.store import CampaignStore
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
        with open_pool(workers) as pool:
            assert isinstance(pool, Processes)
            assert pool.workers == max(1, workers)
            done = run_campaign(p, tmp_path / str(workers), pool)
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
            process = pool._all[len(killed) % 3]._process
            if process is not None:
                killed.append(process._process.pid)
                process.end()

    with processes(3) as pool:
        done = run_campaign(p, tmp_path / "a", pool, progress=progress)
    assert len(killed) == 5
    assert (done.finished, done.failed) == (48, 0)
    assert table_bytes(tmp_path / "a") == table_bytes(tmp_path / "alone")


def test_the_last_attempt_of_a_run_that_kills_its_process_is_alone(tmp_path: Path) -> None:
    """After all others have landed, so that none of them fills the memory."""
    p, begun, landed = plan(tmp_path), Counter[int](), list[int]()

    class Deadly(Futures):
        workers = 3

        def submit(self, task: Task) -> Future[Flight]:
            begun[task.number] += 1
            future: Future[Flight] = Future()
            if task.number in (5, 9) and begun[task.number] + task.number < 11:  # 9 lives in the end
                future.set_exception(DiedError("killed"))
            else:
                future.set_result(pretend(task))
            return future

    for rows in Deadly().rows(p.task(run) for run in range(12)):
        for task, row in rows:
            landed.append(task.number)
            assert row.error == ("WorkerDied: on every attempt" if task.number == 5 else "")
    assert landed[-2:] == [5, 9]
    assert sorted(landed) == list(range(12))
    assert begun == Counter({run: 1 + (run in (5, 9)) for run in range(12)})


def test_a_process_that_dies_is_tried_three_times(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = list[int]()

    class Dies:
        def __init__(self) -> None:
            made.append(1)

        def call(self, *_: Any) -> None:
            raise DiedError

        def close(self) -> None: ...

    monkeypatch.setattr(pools, "Apart", Dies)
    with pytest.raises(DiedError):
        Beside().fly(plan(tmp_path).task(0), None)
    assert len(made) == 3


def test_a_worker_with_other_code_or_another_torch_flies_nothing(tmp_path: Path) -> None:
    p = plan(tmp_path)
    with pytest.raises(RunError, match=rf"this worker runs Sortie {RELEASE}\+[0-9a-f]+, it is asked for other"):
        run_campaign(CampaignPlan({**p.spec, "code": "other"}), tmp_path / "a", InProcess())
    torch = plan(tmp_path, base=BASE.replace("detector: none", "detector: torch")).code
    assert torch == codes_here()[1] != plan(tmp_path).code
    other = replace(p.task(0), code=f"{codes_here()[0]} torch 1.0")
    with pytest.raises(RunError, match=r"this worker runs Sortie \S+ torch \S+, it is asked for \S+ torch 1\.0"):
        fly_in_worker(other)


def test_a_worker_that_sees_another_policy_file_flies_nothing(tmp_path: Path) -> None:
    """Whether it was edited before the worker's first run, or between two of its runs."""
    for before in ([], [0]):
        policy = tmp_path / "mine.py"
        policy.write_text(FAULTY.format(what="pass"))
        p = plan(tmp_path, CAMPAIGN.replace("worked", f"{policy}:decide"))
        for run in before:
            assert fly_in_worker(p.task(run)).error == ""
        policy.write_text(FAULTY.format(what="pass # edited"))
        with pytest.raises(RunError, match=r"mine.py: is not the file that the experiment was begun with"):
            fly_in_worker(p.task(2))


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
    store.add([(p.task(run), fly_in_worker(p.task(run))) for run in (0, 3)])
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
    assert all("initial_soc" in fly_in_worker(p.task(run)).error for run in above)


ADDRESS = "must be an address like tcp://host:8786"
CANNOT_BE_DONE = [
    ("--workers 1 --scheduler tcp://localhost:1", "--workers and --scheduler: name one of them"),
    ("--scheduler foo", f"--scheduler foo: {ADDRESS}: missing port number"),
    ("--scheduler smb://foo:1", f"--scheduler smb://foo:1: {ADDRESS}: unknown address"),
    ("--scheduler tcp://127.0.0.1:1", "--scheduler tcp://127.0.0.1:1: no scheduler answers there"),
    ("--workers 0 --resume", "no campaign there to resume (campaign.sqlite is missing)"),
    (f"--workers 0 --out {__file__}/a", "/a: its folder cannot be made or written to: "),
    ("--workers 0 --out /proc/nothing/here", "/proc/nothing/here/campaign.sqlite: cannot be written: "),
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
