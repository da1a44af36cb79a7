"""Nothing is lost: torn lines, full disks, killed drivers, folders of others."""

from __future__ import annotations

import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from campaign_examples import BASE, CAMPAIGN, Pretended, plan, pretend, table_bytes, write

from sim.campaign.drive import run_campaign
from sim.campaign.plan import Plan
from sim.campaign.store import Store
from sim.folders import RunError


def flown(p: Plan, folder: Path, **how: object) -> dict[str, bytes]:
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
        store = Store(tmp_path / "other", other)
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


def test_a_late_answer_for_a_run_that_is_finished_is_not_counted_twice(tmp_path: Path) -> None:
    p = plan(tmp_path)
    store = Store(tmp_path / "a", p)
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
        run_campaign(Plan({**p.spec, "code": "other"}), folder, Pretended())
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
    store = Store(tmp_path / "a", p)
    with pytest.raises(RunError, match="a: another driver is at work there"):
        Store(tmp_path / "a", p)
    store.close()
    Store(tmp_path / "a", p).close()


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
from sim.cli import main
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
