"""Nothing is lost: torn lines, full disks, killed drivers, folders of others."""

from __future__ import annotations

import errno
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, Pretended, plan, pretend, table_bytes, write

from sortie.sim.campaign.drive import run_campaign
from sortie.sim.campaign.parts import BrokenPartError, read_part
from sortie.sim.campaign.plan import CampaignPlan
from sortie.sim.campaign.rows import find_row, read_rows
from sortie.sim.campaign.store import CampaignStore
from sortie.sim.campaign.work import RunResult, Task
from sortie.sim.folders import RunError


def flown(p: CampaignPlan, folder: Path, **how: object) -> dict[str, bytes]:
    run_campaign(p, folder, Pretended(**how))  # type: ignore[arg-type]
    return table_bytes(folder)


def test_the_order_in_which_runs_finish_does_not_show(tmp_path: Path) -> None:
    p = plan(tmp_path)
    order = random.Random(1).sample(range(48), 48)
    assert flown(p, tmp_path / "a") == flown(p, tmp_path / "b", order=order)


@pytest.mark.parametrize("stop_after", [0, 1, 29, 30, 31, 47])
def test_a_driver_that_breaks_off_is_gone_on_with(tmp_path: Path, stop_after: int) -> None:
    p = plan(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, tmp_path / "a", Pretended(stop_after=stop_after))
    rest = Pretended()
    done = run_campaign(p, tmp_path / "a", rest)
    assert rest.flown == list(range(stop_after, 48))  # none lost, none twice
    assert (done.finished, done.of, done.failed) == (48, 48, 0)
    assert table_bytes(tmp_path / "a") == flown(p, tmp_path / "b")
    assert [x.name for x in (tmp_path / "a" / "journal").iterdir()] == [".lock"]


@pytest.mark.parametrize("harm", ["torn", "flipped", "foreign", "twice"])
def test_a_damaged_journal_costs_its_own_rows_alone(tmp_path: Path, harm: str) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, Pretended(stop_after=5))
    journal = folder / "journal" / "00000.jsonl"
    data = journal.read_bytes()
    lines = data.splitlines(keepends=True)
    if harm == "torn":
        journal.write_bytes(data[:-7])
    elif harm == "flipped":
        journal.write_bytes(b"".join(lines[:4]) + lines[4].replace(b"done", b"dome"))
    elif harm == "foreign":  # a row of another key, whole in itself
        other = plan(tmp_path, CAMPAIGN.replace("seed: 5", "seed: 6"))
        store = CampaignStore(tmp_path / "other", other)
        store.add([pretend(4, other.task(4), other.code)])
        store.close()
        journal.write_bytes(b"".join(lines[:4]) + (tmp_path / "other" / "journal" / "00000.jsonl").read_bytes())
    else:
        journal.write_bytes(data + lines[2])
    rest = Pretended()
    run_campaign(p, folder, rest)
    assert rest.flown == list(range(5 if harm == "twice" else 4, 48))
    assert table_bytes(folder) == flown(p, tmp_path / "b")


def test_a_full_disk_is_one_line_and_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    p, folder, real, calls = plan(tmp_path), tmp_path / "a", os.fsync, [0]

    def fsync(handle: int) -> None:
        calls[0] += 1
        if calls[0] == 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(RunError, match="a: cannot be written: No space left on device; what is finished is kept"):
        run_campaign(p, folder, Pretended())
    monkeypatch.undo()
    run_campaign(p, folder, Pretended())
    assert table_bytes(folder) == flown(p, tmp_path / "b")


@contextmanager
def no_file_beyond(size_b: int) -> Iterator[None]:
    """A quota: a write that reaches it is short, the next one fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_b, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_short_write_is_not_counted_and_leaves_no_torn_line(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    store, journal = CampaignStore(folder, p), folder / "journal" / "00000.jsonl"
    rows = [pretend(run, p.task(run), p.code) for run in range(12)]
    store.add(rows[:2])
    size = journal.stat().st_size
    with (
        no_file_beyond(4 * size),
        pytest.raises(RunError, match=r"a: cannot be written: File too large; what is .* goes on once there is room"),
    ):
        store.add(rows[2:])
    assert (store.finished, journal.stat().st_size) == (2, size)
    store.add(rows[4:])  # behind a torn line they would not be read again
    assert store.finished == 10
    store.close()
    store = CampaignStore(folder, p)
    assert (store.finished, list(store.missing([0]))[:3]) == (10, [2, 3, 12])
    store.close()


@pytest.mark.parametrize("left", ["", "campaign.json", "killed"])
def test_a_campaign_that_could_not_write_its_manifest_begins_again(tmp_path: Path, left: str) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    with no_file_beyond(100), pytest.raises(RunError, match="a: cannot be written: File too large"):
        run_campaign(p, folder, Pretended())
    assert sorted(x.name for x in folder.iterdir()) == ["journal", "runs"]
    if left == "killed":  # on the way
        (folder / ".campaign.json.partial").write_text("{")
    elif left:  # rows of nobody knows which campaign
        (folder / "runs" / "part-00000.parquet").write_text("x")
        with pytest.raises(RunError, match=r"a: holds files but no campaign.json"):
            run_campaign(p, folder, Pretended())
        return
    run_campaign(p, folder, Pretended())
    assert table_bytes(folder) == flown(p, tmp_path / "b")


@pytest.mark.parametrize("harm", ["overwritten", "torn", "empty", "copied", "swapped", "of another campaign", "text"])
def test_a_broken_part_is_told_and_flown_again(tmp_path: Path, harm: str) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    before = flown(p, folder)
    part = folder / "runs" / "part-00001.parquet"
    data = part.read_bytes()
    if harm == "of another campaign":
        other = flown(plan(tmp_path, CAMPAIGN.replace("seed: 5", "seed: 6")), tmp_path / "other")[part.name]
    elif harm == "swapped":  # two rows in the middle, keys and all
        pq.write_table(pq.read_table(part).take([*range(8), 9, 8, *range(10, 18)]), part)
        other = part.read_bytes()
    else:
        other = {
            "overwritten": data[:300] + b"\xaa" * 400 + data[700:],
            "torn": data[: len(data) // 2],
            "empty": b"",
            "copied": before["part-00000.parquet"],
            "text": b"not Parquet at all",
        }[harm]
    part.write_bytes(other)
    told = r"part-00001\.parquet: is broken \(.+\); the campaign's command flies it again$"
    with pytest.raises(RunError, match=told):
        read_rows(folder)
    with pytest.raises(RunError, match=told):
        find_row(folder, 40)
    assert find_row(folder, 3) is not None  # in a part that is whole
    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, Pretended(stop_after=5))
    rest = Pretended()
    run_campaign(p, folder, rest)
    assert rest.flown == list(range(35, 48))
    assert table_bytes(folder) == before


def test_a_flipped_bit_of_a_part_is_found_wherever_it_lies(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    data = flown(p, folder)["part-00001.parquet"]
    table, found = read_part(folder, p, 1), 0
    for at in random.Random(1).sample(range(len(data)), 200):
        (folder / "runs" / "part-00001.parquet").write_bytes(data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :])
        try:
            assert read_part(folder, p, 1).equals(table)  # type: ignore[union-attr]  # where nothing is read from
        except BrokenPartError:
            found += 1
    assert found > 100


def test_files_of_others_among_the_journals_are_left_alone(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    with pytest.raises(KeyboardInterrupt):
        run_campaign(p, folder, Pretended(stop_after=5))
    others = [folder / "journal" / name for name in ("notes.jsonl", "00099.jsonl", "0.jsonl", "-0001.jsonl")]
    text = (folder / "journal" / "00000.jsonl").read_text()
    for other in others:
        other.write_text(text)
    rest = Pretended()
    run_campaign(p, folder, rest)
    assert rest.flown == list(range(5, 48))
    assert [other.read_text() for other in others] == [text] * 4


FAILED = [2, 29, 30, 41]
"""In both parts, and at their edges."""


class Failing(Pretended):
    """Some of its runs fail."""

    def results(self, code: str, tasks: Iterator[Task]) -> Iterator[list[RunResult]]:
        for (row,) in super().results(code, tasks):
            failed = row.run in FAILED
            yield [
                row._replace(status="failed", error="planted", fingerprint="", values=(None, None)) if failed else row
            ]


def with_failures(p: CampaignPlan, folder: Path, stop_after: int | None = None) -> None:
    """A campaign some of whose runs failed."""
    with suppress(KeyboardInterrupt):
        run_campaign(p, folder, Failing(stop_after=stop_after))


@pytest.mark.parametrize("stop_after", [None, 35, 46])
def test_failed_runs_are_flown_again_where_that_is_asked(tmp_path: Path, stop_after: int | None) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    with_failures(p, folder, stop_after)
    rest = Pretended()
    done = run_campaign(p, folder, rest, retry_failed=True)
    assert rest.flown == sorted({*FAILED, *range(stop_after or 48, 48)})
    assert (done.finished, done.failed) == (48, 0)
    assert table_bytes(folder) == flown(p, tmp_path / "b")
    assert [x.name for x in (folder / "journal").iterdir()] == [".lock"]


def test_failed_runs_that_fail_again_stay_failed(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    with_failures(p, folder)
    before = table_bytes(folder)
    again = Failing()
    done = run_campaign(p, folder, again, retry_failed=True)
    assert (again.flown, done.failed) == (FAILED, 4)
    assert table_bytes(folder) == before
    unasked = Pretended()
    assert run_campaign(p, folder, unasked).failed == 4
    assert unasked.flown == []


def test_a_retry_that_is_killed_at_any_moment_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At every fsync in turn, before and after it: between the journal and the part that it takes the place of, too."""
    p, real = plan(tmp_path), os.fsync
    with_failures(p, tmp_path / "failed")
    whole = flown(p, tmp_path / "b")
    for kill in range(1, 100):
        folder, calls = tmp_path / str(kill), [0]
        shutil.copytree(tmp_path / "failed", folder)

        def fsync(handle: int, kill: int = kill, calls: list[int] = calls) -> None:
            calls[0] += 1
            if 2 * calls[0] - 1 == kill:
                raise KeyboardInterrupt
            real(handle)
            if 2 * calls[0] == kill:
                raise KeyboardInterrupt

        monkeypatch.setattr(os, "fsync", fsync)
        first, rest = Pretended(), Pretended()
        with suppress(KeyboardInterrupt):
            run_campaign(p, folder, first, retry_failed=True)
        monkeypatch.undo()
        run_campaign(p, folder, rest, retry_failed=True)
        assert table_bytes(folder) == whole
        assert set(rest.flown) <= set(FAILED)  # a row that was good is not flown again
        if 2 * calls[0] < kill:
            assert kill > 20
            return
    pytest.fail("it was killed every time")


def test_a_late_answer_for_a_run_that_is_finished_is_not_counted_twice(tmp_path: Path) -> None:
    p = plan(tmp_path)
    store = CampaignStore(tmp_path / "a", p)
    row = pretend(3, p.task(3), p.code)
    store.add([row])
    store.add([row, row])
    assert store.finished == 1
    store.add([pretend(r, p.task(r), p.code) for r in range(30)])
    store.add([row])
    assert store.finished == 30
    store.close()


def test_folders_of_others_are_refused(tmp_path: Path) -> None:
    p, folder = plan(tmp_path), tmp_path / "a"
    run_campaign(p, folder, Pretended())
    before = table_bytes(folder)
    wider = plan(tmp_path, CAMPAIGN.replace("low: 0.2", "low: 0.3"))
    with pytest.raises(RunError, match=r"holds results of another campaign, its campaign\.vary differs; name another"):
        run_campaign(wider, folder, Pretended())
    with pytest.raises(RunError, match=r"holds results of another campaign, its base.duration_s differs"):
        run_campaign(plan(tmp_path, base=BASE.replace("0.5", "0.6")), folder, Pretended())
    with pytest.raises(RunError, match=r"a: holds results of Sortie 0.1.0\+[0-9a-f]+, this is other; name another"):
        run_campaign(CampaignPlan({**p.spec, "code": "other"}), folder, Pretended())
    assert table_bytes(folder) == before
    manifest = json.loads((folder / "campaign.json").read_text())
    manifest["spec"]["format"] = 0
    (folder / "campaign.json").write_text(json.dumps(manifest))
    with pytest.raises(RunError, match="holds results of format 0, must be 1"):
        run_campaign(p, folder, Pretended())
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.tex").write_text("x")
    with pytest.raises(RunError, match="holds files but no campaign"):
        run_campaign(p, tmp_path / "b", Pretended())


def test_two_drivers_do_not_share_a_folder(tmp_path: Path) -> None:
    p = plan(tmp_path)
    store = CampaignStore(tmp_path / "a", p)
    with pytest.raises(RunError, match="a: another driver is at work there"):
        CampaignStore(tmp_path / "a", p)
    store.close()
    CampaignStore(tmp_path / "a", p).close()


def test_it_stops_when_enough_is_known_whoever_finished_first(tmp_path: Path) -> None:
    text = CAMPAIGN.replace("{count: 6}", "{count: 300}").replace(
        "seed: 5", "stop_when: {metric: bytes.data_sent, half_width: 0.05}\nseed: 5"
    )
    p = plan(tmp_path, text)
    assert (p.runs, p.shard) == (2400, 120)
    order = list(range(600, 1000)) + list(range(600)) + list(range(1000, 2400))
    first = flown(p, tmp_path / "a")
    assert first == flown(p, tmp_path / "b", order=order)
    # the drawn field itself is the metric: uniform on 0.8, so the interval needs n ≥ (1.96 × 0.231 / 0.05)² ≈ 82 draws
    assert 600 <= 120 * len(first) <= 840
    again = Pretended()
    done = run_campaign(p, tmp_path / "a", again)
    assert (again.flown, done.finished) == ([], 120 * len(first))


def test_rows_have_their_columns(tmp_path: Path) -> None:
    p = plan(tmp_path)
    flown(p, tmp_path / "a")
    table = pq.read_table(tmp_path / "a" / "runs")
    assert table.column_names == [
        "run", "unit", "cell", "replication", "policy", "seed", "status", "error", "fingerprint", "key",
        "fleet.battery.initial_soc", "fleet.formation.spacing_m", "bytes.data_sent", "energy_j.total",
    ]  # fmt: skip
    assert table["run"].to_pylist() == list(range(48))
    row = table.slice(31, 1).to_pylist()[0]
    assert row["key"] == p.key(31)
    assert row["fleet.battery.initial_soc"] == p.varied(row["cell"])["fleet.battery.initial_soc"]


def test_polars_reads_it_with_one_line(tmp_path: Path) -> None:
    polars = pytest.importorskip("polars")
    flown(plan(tmp_path), tmp_path / "a")
    assert polars.read_parquet(tmp_path / "a" / "runs" / "*.parquet").shape == (48, 14)


DRIVER = """
import sys
from sortie.sim.cli.app import main
sys.argv = ["sortie", "campaign", sys.argv[1], "--workers", "0", "--out", sys.argv[2], "--no-report"]
main()
"""


@pytest.mark.slow
def test_sigkill_of_the_driver_at_any_moment_leaves_no_trace(tmp_path: Path) -> None:
    """Three kills while real sorties fly, each once some rows more are on disk; the table is the undisturbed one."""
    campaign, folder = write(tmp_path), tmp_path / "a"
    command = [sys.executable, "-c", DRIVER, str(campaign)]
    for kill in range(3):
        driver = subprocess.Popen([*command, str(folder)], stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + 300
        while _rows_on_disk(folder) < 9 * (kill + 1):
            assert driver.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.005)
        driver.send_signal(signal.SIGKILL)
        assert driver.wait() == -signal.SIGKILL
    subprocess.run([*command, str(folder)], check=True, stdout=subprocess.DEVNULL)
    subprocess.run([*command, str(tmp_path / "b")], check=True, stdout=subprocess.DEVNULL)
    assert table_bytes(folder) == table_bytes(tmp_path / "b")
    assert len(table_bytes(folder)) == 2


def _rows_on_disk(folder: Path) -> int:
    journal, part = folder / "journal" / "00000.jsonl", folder / "runs" / "part-00000.parquet"
    try:
        return 30 if part.exists() else journal.read_bytes().count(b"\n")
    except FileNotFoundError:
        return 0
