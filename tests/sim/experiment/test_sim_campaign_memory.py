"""A run that takes more memory than its worker may is one failed run with its seed, and the others go on."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import CAMPAIGN, plan, write
from typer.testing import CliRunner

from sortie.sim.cli.app import app
from sortie.sim.experiment import flight, memory
from sortie.sim.experiment.flight import fly_in_worker
from sortie.sim.experiment.pools import processes

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts what programs write to")


def test_a_container_has_less_than_its_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = memory.machine_memory_b()
    group = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "_GROUP", group)
    assert memory.machine_memory_b() >= whole > 100_000_000
    group.write_text("max\n")
    assert memory.machine_memory_b() >= whole
    group.write_text("100000000\n")
    assert memory.machine_memory_b() == 100_000_000


def test_workers_share_the_machine_unless_they_are_told_less() -> None:
    whole = memory.machine_memory_b()
    for count, told, limit_b in ((1, None, whole), (2, None, whole // 2), (1, 7, 7)):
        with processes(count, told) as pool:
            assert (pool.workers, pool._memory_b) == (count, limit_b)


def test_a_run_without_memory_says_which_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fly_here(*_: Any, **__: Any) -> None:
        raise MemoryError

    task = plan(tmp_path).task(3)
    monkeypatch.setattr(flight, "fly_here", fly_here)
    row = fly_in_worker(task, 64_000_000_000)
    assert (row.key, row.error) == (task.key, "MemoryError: more than 64 GB (--worker-memory)")
    assert fly_in_worker(task).error == "MemoryError: "


POLICY = """
from sortie.policies.contract import Directive

def decide(view):
    if view.me.battery_soc < 0.5:
        bytearray(40_000_000_000)
    return [Directive(view.ego, p, reason="silent") for p in view.peers]
"""


def greedy(folder: Path) -> Path:
    """A campaign in which a policy takes 40 GB where the battery is low."""
    (folder / "mine.py").write_text(POLICY)
    text = CAMPAIGN.replace('[worked, "best-2(received_budget=0.1)"]', f"['{folder}/mine.py:decide']")
    return write(
        folder,
        text.replace("replications: 2", "replications: 1")
        .replace("values: [20, 40]", "values: [20]")
        .replace("{count: 6}", "{count: 3}"),
    )


@LINUX
def test_a_run_that_takes_too_much_is_one_failed_run(tmp_path: Path) -> None:
    command = ["campaign", str(greedy(tmp_path)), "--workers", "0", "--worker-memory", "2", "--no-report"]
    result = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "a")])
    rows = pq.read_table(tmp_path / "a" / "runs").to_pylist()
    failed = [row for row in rows if row["status"] == "failed"]
    assert [row["run"] for row in failed] == [row["run"] for row in rows if row["fleet.battery.initial_soc"] < 0.5]
    assert 0 < len(failed) < len(rows) == 3
    assert (result.exit_code, result.stderr) == (1, "")
    for row in failed:
        assert "raises MemoryError" in row["error"]
        assert "\n" not in row["error"]
        assert row["seed"] > 0
