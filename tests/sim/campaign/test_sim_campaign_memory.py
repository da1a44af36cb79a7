"""A run that takes more memory than its worker may is one failed run with its seed, and the others go on."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import CAMPAIGN, plan, write
from typer.testing import CliRunner

from sortie.sim.campaign import memory, work
from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.processes import Processes
from sortie.sim.campaign.work import fly_batch
from sortie.sim.cli.app import app

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
    for how, count, limit_b in (({}, 1, whole), ({"workers": 2}, 2, whole // 2), ({"memory_b": 7}, 1, 7)):
        with open_engine(**how) as engine:
            assert isinstance(engine, Processes)
            assert (engine.workers, engine.memory_b) == (count, limit_b)
            assert [one.memory_b for one in engine._processes] == [limit_b] * count


def test_a_run_without_memory_says_which_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fly_here(*_: Any, **__: Any) -> None:
        raise MemoryError

    p = plan(tmp_path)
    monkeypatch.setattr(work, "fly_here", fly_here)
    (row,), _ = fly_batch(p.code, [(3, p.task(3))], 64_000_000_000)
    assert (row.run, row.key, row.status) == (3, p.key(3), "failed")
    assert row.error == "MemoryError: more than 64 GB (--worker-memory)"
    (row,), _ = fly_batch(p.code, [(3, p.task(3))])
    assert row.error == "MemoryError: "


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
