"""Nothing is lost: full disks, killed drivers, folders of others; a damaged store is one line."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from campaign_examples import CAMPAIGN, Pretended, failed, plan, pretend, rows_on_disk, table_bytes

from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.plan import CampaignPlan
from sortie.sim.experiment.report import write_report
from sortie.sim.experiment.rows import read_rows
from sortie.sim.experiment.store import FILE, TABLE, CampaignStore, CampaignTable
from sortie.sim.folders import RunError
from sortie.sim.identity import RELEASE, file_digest


def flown(p: CampaignPlan, folder: Path, **how: object) -> dict[str, bytes]:
    run_campaign(p, folder, Pretended(**how))  # type: ignore[arg-type]
    return table_bytes(folder)


def test_the_order_in_which_runs_finish_does_not_show(tmp_path: Path) -> None:
    p = plan(tmp_path)
    order = random.Random(1).sample(range(48), 48)
    assert flown(p, tmp_path / "a") == flown(p, tmp_path / "b", order=order)


def test_a_driver_that_breaks_off_is_gone_on_with(tmp_path: Path) -> None:
    """Also before its first row, whatever of its files is there: none is lost, and none is flown twice."""
    p = plan(tmp_path)
    whole = flown(p, tmp_path / "whole")
    for stop_after in (0, 1, 29, 30, 31, 47):
        folder, rest = tmp_path / str(stop_after), Pretended()
        with pytest.raises(KeyboardInterrupt):
            run_campaign(p, folder, Pretended(stop_after=stop_after))
        done = run_campaign(p, folder, rest)
        assert rest.flown == list(range(stop_after, 48))
        assert (done.finished, done.of, done.failed) == (48, 48, 0)
        assert table_bytes(folder) == whole
    for left in ([], [FILE], [".lock", FILE]):
        folder = tmp_path / f"left {len(left)}"
        folder.mkdir()
        for name in left:
            (folder / name).touch()
        assert flown(p, folder) == whole


def change(folder: Path, *statements: str) -> None:
    """Change a campaign's file by hand."""
    with closing(sqlite3.connect(folder / FILE)) as db, db:
        for statement in statements:
            db.execute(statement)


DAMAGE = [
    *(
        f"UPDATE flights SET {change} WHERE key = (SELECT key FROM runs WHERE run = 31)"  # noqa: S608
        for change in (
            "figures = x'00ff'",
            "figures = '['",
            "figures = '[1]'",
            "figures = 'null'",
            "figures = json_set(figures, '$.\"energy_j.total\"', 'text')",
            "figures = '{}'",
            "matched = x'00ff'",
            "files = '['",
        )
    ),
    "UPDATE plan SET spec = '[]'",
    "UPDATE plan SET spec = '{\"format\": 2}'",
    "UPDATE plan SET spec = '{'",
    "DROP TABLE plan",
]


def test_a_damaged_store_is_one_line(tmp_path: Path) -> None:
    p, whole = plan(tmp_path), tmp_path / "whole"
    flown(p, whole)
    for number, statement in enumerate(DAMAGE):
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder)
        change(folder, statement)
        with pytest.raises(RunError) as told:
            read_rows(folder)
        assert str(told.value).startswith((f"{folder / FILE}: is broken (", f"{folder}: no campaign there")), statement
        assert "\n" not in str(told.value)


def test_a_damaged_table_is_written_anew(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    before = flown(p, folder)
    (folder / TABLE).write_bytes(b"not Parquet at all")
    again = Pretended()
    run_campaign(p, folder, again)
    assert (again.flown, table_bytes(folder)) == ([], before)
    (folder / TABLE).unlink()
    write_report(folder)
    assert table_bytes(folder) == before


@contextmanager
def no_file_beyond(size_b: int) -> Iterator[None]:
    """A quota: a write that reaches it is short, the next one fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_b, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_one_line_and_costs_nothing(tmp_path: Path) -> None:
    p = plan(tmp_path)
    whole = flown(p, tmp_path / "whole")
    for size_b in (100, 9_000, 25_000, 29_000):
        folder, first, rest = tmp_path / str(size_b), Pretended(), Pretended()
        one_line = pytest.raises(RunError, match=r": cannot be written: .*; what is finished is kept, the")
        with no_file_beyond(size_b), one_line:
            run_campaign(p, folder, first)
        kept = rows_on_disk(folder)
        assert kept == max(0, len(first.flown) - 1)  # the last one had no room
        assert (kept > 0) == (size_b > 20_000)  # the plan comes first, of some 13 kB
        run_campaign(p, folder, rest)
        assert rest.flown == list(range(kept, 48))
        assert table_bytes(folder) == whole


FAILED = [2, 29, 30, 41]
"""In both parts, and at their edges."""


def failing(stop_after: int | None = None) -> Pretended:
    """Some of its runs fail."""
    return Pretended(stop_after=stop_after, change=lambda task, row: failed(task) if task.number in FAILED else row)


def test_failed_runs_are_flown_again_where_that_is_asked(tmp_path: Path) -> None:
    p = plan(tmp_path)
    whole = flown(p, tmp_path / "whole")
    for stop_after in (None, 35, 46):
        folder, rest = tmp_path / str(stop_after), Pretended()
        with suppress(KeyboardInterrupt):
            run_campaign(p, folder, failing(stop_after))
        done = run_campaign(p, folder, rest, retry_failed=True)
        assert rest.flown == sorted({*FAILED, *range(stop_after or 48, 48)})
        assert (done.finished, done.failed) == (48, 0)
        assert table_bytes(folder) == whole


def test_failed_runs_that_fail_again_stay_failed(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    run_campaign(p, folder, failing())
    before = table_bytes(folder)
    again = failing()
    done = run_campaign(p, folder, again, retry_failed=True)
    assert (again.flown, done.failed) == (FAILED, 4)
    assert table_bytes(folder) == before
    unasked = Pretended()
    assert run_campaign(p, folder, unasked).failed == 4
    assert unasked.flown == []


@pytest.mark.slow
def test_a_driver_that_is_killed_at_any_statement_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL before every statement in turn, of a retry and of a new campaign: no good row is lost or flown twice."""
    p, real = plan(tmp_path), sqlite3.connect
    run_campaign(p, tmp_path / "failed", failing())
    whole = flown(p, tmp_path / "b")
    for begin, statements in (("failed", range(1, 16)), ("new", range(1, 40, 3))):
        for kill in statements:
            folder = tmp_path / f"{begin} {kill}"
            if begin == "failed":
                shutil.copytree(tmp_path / "failed", folder)
            if (child := os.fork()) == 0:
                count = iter(range(1, 10**6))

                def connect(*args: Any, kill: int = kill, count: Iterator[int] = count, **kwargs: Any) -> Any:
                    db = real(*args, **kwargs)
                    db.set_trace_callback(
                        lambda _: os.kill(os.getpid(), signal.SIGKILL) if next(count) == kill else None
                    )
                    return db

                monkeypatch.setattr(sqlite3, "connect", connect)
                run_campaign(p, folder, Pretended(), retry_failed=True)
                os._exit(0)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
            kept, rest = rows_on_disk(folder), Pretended()
            run_campaign(p, folder, rest, retry_failed=True)
            assert table_bytes(folder) == whole
            assert set(rest.flown) <= set(FAILED) if begin == "failed" else rest.flown == list(range(kept, 48))


def test_a_late_answer_for_a_run_that_is_finished_is_not_counted_twice(tmp_path: Path) -> None:
    p = plan(tmp_path)
    store = CampaignStore(tmp_path / "a", p)

    def row(run: int) -> tuple[Task, Flight]:
        return p.task(run), pretend(p.task(run))

    store.add([row(3)])
    store.add([row(3), row(3)])
    assert store.finished == 1
    store.add([row(run) for run in range(30)])
    store.add([row(3)])
    assert store.finished == 30
    store.close()


def test_folders_of_others_are_refused(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    before = flown(p, folder)

    def refused(p: CampaignPlan, folder: Path, why: str) -> None:
        with pytest.raises(RunError, match=why):
            run_campaign(p, folder, Pretended())

    other = CampaignPlan({**p.spec, "code": "other"})
    refused(other, folder, rf"a: holds results of Sortie {RELEASE}\+[0-9a-f]+, this is other; name another")
    assert table_bytes(folder) == before
    change(folder, "UPDATE plan SET spec = json_set(spec, '$.format', 0)")
    refused(p, folder, "holds results of format 0, must be 2")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.tex").write_text("x")
    refused(p, tmp_path / "b", r"b: holds thesis.tex and no campaign.sqlite; name another folder for the campaign")
    (folder / FILE).write_text("a file of somebody else")
    refused(p, folder, r"campaign\.sqlite: is broken \(file is not a database\); remove it to fly")


def test_a_campaign_that_changes_flies_what_is_new_alone(tmp_path: Path) -> None:
    """More draws and another policy; and back again, where everything is there."""
    p, folder = plan(tmp_path), tmp_path / "a"
    before = flown(p, folder)
    text = CAMPAIGN.replace("{count: 6}", "{count: 7, method: random}")
    first = CAMPAIGN.replace("{count: 6}", "{count: 6, method: random}")
    for changed, new, said in (
        (CAMPAIGN.replace("[worked,", "[silence, worked,"), 24, "its campaign.policies was another"),
        (CAMPAIGN, 0, "its campaign.policies was another"),
        (first, 48, "its campaign.sample was another"),
        (text, 8, "its campaign.sample was another"),
    ):
        rest, lines = Pretended(), list[str]()
        done = run_campaign(plan(tmp_path, changed), folder, rest, notice=lines.append)
        assert (len(rest.flown), done.finished) == (new, done.of)
        assert lines == [f"{folder}: {said}; flights that fit are not flown again"]
        assert (table_bytes(folder) == before) == (changed == CAMPAIGN)


def test_a_data_file_that_changes_means_new_flights(tmp_path: Path) -> None:
    """Those that read it, and no others; a resumed campaign never mixes two of its states."""
    p, folder, data = plan(tmp_path), tmp_path / "a", tmp_path / "gains.csv"
    data.write_text("1")

    def reads(task: Task, row: Flight) -> Flight:
        return replace(row, files={str(data): file_digest(data)}) if task.number % 4 == 0 else row

    run_campaign(p, folder, Pretended(change=reads))
    data.write_text("2")
    rest, lines = Pretended(change=reads), list[str]()
    run_campaign(p, folder, rest, notice=lines.append)
    assert rest.flown == list(range(0, 48, 4))
    assert lines == [f"{folder}: {data} has changed since; 12 flights with it are flown again"]
    data.rename(tmp_path / "away")
    with pytest.raises(RunError, match=r"gains\.csv: is gone, and flights in .*a have read it; put it back first"):
        run_campaign(p, folder, Pretended())
    (tmp_path / "away").rename(data)
    again = Pretended()
    run_campaign(p, folder, again)
    assert again.flown == [], "nothing was lost"


def test_a_folder_of_0_2_can_be_read(tmp_path: Path) -> None:
    """Its rows had a table of their own, with a hash each; the code is another one since, so none is flown on."""
    p, folder, old = plan(tmp_path), tmp_path / "a", tmp_path / "old"
    whole = flown(p, folder)
    with closing(CampaignTable(folder)) as table:
        rows = [row for part in range(table.parts) for row in (table.part(part) or pa.table({})).to_pylist()]
    old.mkdir()
    with closing(sqlite3.connect(old / FILE)) as db, db:
        db.execute("CREATE TABLE plan (digest TEXT, spec TEXT)")
        db.execute("CREATE TABLE rows (run INTEGER PRIMARY KEY, row TEXT, sha256 TEXT)")
        db.execute("INSERT INTO plan VALUES (?, ?)", ("digest", json.dumps(p.spec)))
        for row in rows:
            db.execute("INSERT INTO rows VALUES (?, ?, ?)", (row["run"], json.dumps(list(row.values())), "hash"))
    assert read_rows(old).all.equals(read_rows(folder).all)
    write_report(old)
    assert table_bytes(old) == whole
    rest = Pretended()
    run_campaign(p, old, rest)
    assert (rest.flown, table_bytes(old)) == ([], whole)


@pytest.mark.slow
def test_it_stops_when_enough_is_known_whoever_finished_first(tmp_path: Path) -> None:
    text = CAMPAIGN.replace("{count: 6}", "{count: 300}").replace(
        "seed: 5", "stop_when: {metric: bytes.data_sent, half_width: 0.05}\nseed: 5"
    )
    p = plan(tmp_path, text)
    assert (p.runs, p.shard) == (2400, 120)
    order = list(range(600, 1000)) + list(range(600)) + list(range(1000, 2400))
    first = flown(p, tmp_path / "a")
    assert first == flown(p, tmp_path / "b", order=order)

    count = pq.read_table(tmp_path / "a" / "runs").num_rows
    assert count % 120 == 0
    assert 600 <= count <= 840
    again = Pretended()
    done = run_campaign(p, tmp_path / "a", again)
    assert (again.flown, done.finished) == ([], count)


def test_rows_have_their_columns(tmp_path: Path) -> None:
    p = plan(tmp_path)
    flown(p, tmp_path / "a")
    table = pq.read_table(tmp_path / "a" / "runs")
    names = "run unit cell replication policy seed status error fingerprint key"
    varied = ["fleet.battery.initial_soc", "fleet.formation.spacing_m"]
    assert table.column_names == [*names.split(), *varied, "bytes.data_sent", "energy_j.total"]
    assert table["run"].to_pylist() == list(range(48))
    row = table.slice(31, 1).to_pylist()[0]
    assert row["key"] == p.task(31).key
    assert row["fleet.battery.initial_soc"] == p.varied(row["cell"])["fleet.battery.initial_soc"]
    polars = pytest.importorskip("polars")
    assert polars.read_parquet(tmp_path / "a" / "runs" / "*.parquet").shape == (48, 14)
