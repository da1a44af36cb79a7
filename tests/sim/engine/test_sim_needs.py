"""What a sortie needs is counted before it flies, and compared with what is free."""

from __future__ import annotations

from collections import namedtuple
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sortie.scenarios import scratch
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.cli.app import app
from sortie.sim.engine import needs as module
from sortie.sim.engine.needs import Needs, ensure_room, needs
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError

Memory, Disk = namedtuple("Memory", "available"), namedtuple("Disk", "free")


def scenario(duration_s: float = 20, drones: int = 5, detector: str = "none") -> Scenario:
    return load(
        "track_target", [f"duration_s={duration_s}", f"fleet.drones={drones}", f"perception.detector={detector}"]
    )


def free(monkeypatch: pytest.MonkeyPatch, memory: float = 1e12, disk: float = 1e13) -> None:
    monkeypatch.setattr(module.psutil, "virtual_memory", lambda: Memory(int(memory)))
    monkeypatch.setattr(module.shutil, "disk_usage", lambda folder: Disk(int(disk)))
    monkeypatch.setattr(scratch, "folder", lambda: "/scratch")


@pytest.mark.parametrize("detector", ["none", "surrogate"])
@pytest.mark.parametrize("drones", [2, 12])
def test_the_record_lies_between_the_counts(drones: int, detector: str) -> None:
    flown = scenario(12, drones, detector)
    need = needs(flown)
    bytes_of = {name: table.nbytes for name, table in run_sortie(flown).tables.items()}
    certain = sum(bytes_of[name] for name in ("states", "descriptors", "receptions", "mission", "people", "medium"))
    floats = module.AIRFRAME_FLOATS * drones + sum(
        module.math.prod(shape) for shape in module.shapes_of(drones).values()
    )
    motion = 8 * floats * flown.frames
    assert need.least_disk - motion == pytest.approx(certain, rel=0.05)
    assert sum(bytes_of.values()) <= (need.most_disk - motion) / 2


def test_needs_rise_with_duration_and_drones() -> None:
    hour, two_hours, fleet = needs(scenario(3600)), needs(scenario(7200)), needs(scenario(7200, 100))
    assert two_hours.least_disk == pytest.approx(2 * hour.least_disk, rel=1e-3)
    assert two_hours.memory - hour.memory < 10e6, "no detector: memory hardly depends on the duration"
    assert fleet.least_disk > 20 * two_hours.least_disk
    assert fleet.memory < 500e6


def test_links_within_earshot_are_counted_for_large_fleets() -> None:
    """All with all at 20 dBm; at −20 dBm, with drones 200 m apart, nearly nobody."""
    apart = scenario(60, 1000).fleet.formation.model_copy(update={"spacing_m": 200.0})
    loud = scenario(60, 1000)
    fleet = loud.fleet.model_copy(update={"formation": apart})
    quiet = loud.model_copy(update={"fleet": fleet, "radio": loud.radio.model_copy(update={"tx_power_dbm": -20.0})})
    assert needs(loud).memory - needs(quiet).memory == pytest.approx(1000 * 999 * 20 * 32, rel=0.2)


@pytest.mark.parametrize(
    ("need", "words", "sure"),
    [
        (Needs(int(3e9), 1, 1), "needs 3.0 GB of memory, 2.0 GB are free", True),
        (Needs(1, int(5e9), int(9e9)), "needs at least 5.0 GB of disk, 4.0 GB are free in /scratch", True),
        (Needs(1, 1, int(9e9)), "may need up to 9.0 GB of disk, 4.0 GB are free in /scratch", False),
        (Needs(1, 1, int(4e9)), "", False),
    ],
)
def test_what_is_short_is_said(
    need: Needs, words: str, sure: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    free(monkeypatch, memory=2e9, disk=4e9)
    monkeypatch.setattr(module, "needs", lambda _: need)
    assert module.shortage(need, tmp_path / "runs/a") == (words, sure)
    assert ensure_room(scenario(), tmp_path, force=True) == words
    if not sure:
        assert ensure_room(scenario(), tmp_path) == words
        return
    with pytest.raises(RunError) as error:
        ensure_room(scenario(), tmp_path)
    assert str(error.value) == f"track_target: {words}; make room, set TMPDIR to another disk, or fly it with --force"


def test_fly_refuses_without_force(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    free(monkeypatch, memory=1e6)
    monkeypatch.chdir(tmp_path)
    asked = [
        "fly",
        "track_target",
        "--no-recording",
        "--out",
        "run",
        "--set",
        "duration_s=1",
        "--set",
        "perception.detector=none",
    ]
    refused = CliRunner().invoke(app, asked)
    assert refused.exit_code == 1
    assert not (tmp_path / "run").exists()
    told = " ".join(str(refused.exception or refused.output).split())
    assert "of memory, 1 MB are free; make room, set TMPDIR to another disk, or fly it with --force" in told
    flown = CliRunner().invoke(app, [*asked, "--force"])
    assert flown.exit_code == 0, flown.output
    assert (tmp_path / "run/outcome.json").is_file()
