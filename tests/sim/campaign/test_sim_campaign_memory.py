"""A run that takes more memory than its worker may is one failed run with its seed, and the others go on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_examples import CAMPAIGN, CLUSTER, plan, table_bytes, write
from typer.testing import CliRunner

import sortie
from sortie.sim.campaign import memory, work
from sortie.sim.campaign.engine import open_engine
from sortie.sim.campaign.one_process import OneProcess
from sortie.sim.campaign.work import fly_batch
from sortie.sim.cli.app import app

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts what programs write to")
TAKES = """
import resource
from sortie.sim.campaign.memory import limited

def takes(size_b):
    try:
        return len(bytearray(size_b)) == size_b
    except MemoryError:
        return False

GB = 1_000_000_000
before = resource.getrlimit(resource.RLIMIT_DATA)
print(takes(2 * GB))
with limited(GB):
    print(takes(GB // 2), takes(2 * GB))
    with limited(3 * GB):  # another thread's run: the first limit stays
        print(takes(2 * GB))
    print(takes(GB // 2), takes(2 * GB))
print(takes(2 * GB), resource.getrlimit(resource.RLIMIT_DATA) == before)
with limited(None):
    print(takes(2 * GB))
"""


@LINUX
def test_allocations_beyond_the_limit_fail_and_only_those() -> None:
    said = subprocess.run([sys.executable, "-c", TAKES], check=True, capture_output=True, text=True).stdout
    assert said.splitlines() == ["True", "True False", "False", "True False", "True True", "True"]


def test_a_container_has_less_than_its_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = memory.machine_memory_b()
    group = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "_GROUP", group)
    assert memory.machine_memory_b() >= whole > 100_000_000
    group.write_text("max\n")
    assert memory.machine_memory_b() >= whole
    group.write_text("100000000\n")
    assert memory.machine_memory_b() == 100_000_000


def test_a_worker_may_take_what_the_machine_has_unless_it_is_told_less(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_engine() as engine:
        assert isinstance(engine, OneProcess)
        assert engine.memory_b == memory.machine_memory_b()
    with open_engine(memory_b=7) as engine:
        assert isinstance(engine, OneProcess)
        assert engine.memory_b == 7


def test_a_run_without_memory_says_which_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_sortie(*_: Any, **__: Any) -> None:
        raise MemoryError

    p = plan(tmp_path)
    monkeypatch.setattr(work, "run_sortie", run_sortie)
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
    return write(folder, text.replace("replications: 2", "replications: 1").replace("values: [20, 40]", "values: [20]"))


@LINUX
def test_a_run_that_takes_too_much_is_one_failed_run(tmp_path: Path) -> None:
    command = ["campaign", str(greedy(tmp_path)), "--workers", "0", "--worker-memory", "2", "--no-report"]
    result = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "a")])
    rows = pq.read_table(tmp_path / "a" / "runs").to_pylist()
    failed = [row for row in rows if row["status"] == "failed"]
    assert [row["run"] for row in failed] == [row["run"] for row in rows if row["fleet.battery.initial_soc"] < 0.5]
    assert 0 < len(failed) < len(rows) == 6
    assert (result.exit_code, result.stderr) == (1, "")
    for row in failed:
        assert "raises MemoryError" in row["error"]
        assert "\n" not in row["error"]
        assert row["seed"] > 0


@LINUX
@CLUSTER
@pytest.mark.slow
def test_a_cluster_has_the_same_limit(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    campaign = greedy(tmp_path)
    done = [sortie.campaign(campaign, out=tmp_path / f"{n}", workers=n, worker_memory_gb=2) for n in (0, 1)]
    assert done[0].failed == done[1].failed > 0
    assert table_bytes(tmp_path / "0") == table_bytes(tmp_path / "1")
