"""What a sortie needs is counted before it flies, and compared with what is free."""

from __future__ import annotations

from collections import namedtuple
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sortie.scenarios import scratch
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.cli.app import app
from sortie.sim.engine import needs as module
from sortie.sim.engine.needs import Forecast, Needs, ensure_room, needs
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


def test_the_record_lies_between_the_counts() -> None:
    """Short flights of their own, of two sizes."""
    for drones, detector in ((2, "surrogate"), (12, "none")):
        flown = scenario(6, drones, detector)
        need = needs(flown)
        bytes_of = {name: table.nbytes for name, table in run_sortie(flown).tables.items()}
        certain = sum(bytes_of[name] for name in ("states", "descriptors", "receptions", "mission", "people", "medium"))
        motion = 8 * module.frame_floats(drones) * flown.frames
        assert need.least_disk - motion == pytest.approx(certain, rel=0.05)
        assert sum(bytes_of.values()) <= need.most_disk / 2 - motion


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


SHORT_OF: list[tuple[Needs, str, bool]] = [
    (Needs(int(3e9), 1, 1), "needs 3.0 GB of memory, 2.0 GB are free", True),
    (Needs(1, int(5e9), int(9e9)), "needs at least 5.0 GB of disk, 4.0 GB are free in /scratch", True),
    (Needs(1, 1, int(9e9)), "may need up to 9.0 GB of disk, 4.0 GB are free in /scratch", False),
    (Needs(1, 1, int(4e9)), "", False),
]
"""A need, what is short, and whether that is sure."""


def test_what_is_short_is_named_and_refused_where_it_is_sure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    free(monkeypatch, memory=2e9, disk=4e9)
    for need, words, sure in SHORT_OF:
        assert module.shortage(need, tmp_path / "runs/a") == (words, sure)
        assert ensure_room(scenario(), need, tmp_path, force=True) == words
        if not sure:
            assert ensure_room(scenario(), need, tmp_path) == words
            continue
        with pytest.raises(RunError) as error:
            ensure_room(scenario(), need, tmp_path)
        ending = "make room, set TMPDIR to another disk, or fly it with --force"
        assert str(error.value) == f"track_target: {words}; {ending}"


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
    line = " ".join(str(refused.exception or refused.output).split())
    assert "of memory, 1 MB are free; make room, set TMPDIR to another disk, or fly it with --force" in line
    flown = CliRunner().invoke(app, [*asked, "--force"])
    assert flown.exit_code == 0, flown.output
    assert (tmp_path / "run/outcome.json").is_file()


def told(seconds: list[tuple[float, float]], begun_s: float = 100.0, **options: int) -> tuple[list[str], list[float]]:
    """What a forecast says, and what it passes on; by pairs of simulated time and the clock at that time."""
    lines: list[str] = []
    passed: list[float] = []
    times = iter([begun_s, *(wall_s for _, wall_s in seconds)])
    forecast = Forecast(scenario(60, 1000), lines.append, passed.append, clock=lambda: next(times), **options)
    for t_s, _ in seconds:
        forecast(t_s)
    return lines, passed


def test_how_long_a_flight_takes_is_measured_after_its_first_second() -> None:
    """4 s to make it ready, a cheap first second, then 10 s for each: 4 + 2 + 59 × 10."""
    seconds = [(0.0, 104.0), (1.0, 106.0), (2.0, 116.0)]
    words = "1,000 drones for 60 s: about 10 minutes and 1.2 GB of memory on this machine, estimated from the first 2 s"
    assert told(seconds, memory=int(1.2e9)) == ([words], [0.0, 1.0, 2.0])
    (words,), _ = told(seconds, flights=30)
    assert words == "1,000 drones for 30 × 60 s: about 5.0 hours on this machine, estimated from the first 2 s"


def test_a_fast_flight_is_measured_for_some_seconds_and_a_short_one_is_not_told_of() -> None:
    """1 s each, so it is told after 5 s of the clock; at half of that it ends within a minute."""
    (words,), passed = told([(float(t), 100.0 + 4.0 + t) for t in range(7)])
    assert words.endswith("about 1 minute on this machine, estimated from the first 6 s")
    assert len(passed) == 7, "goes on"
    assert told([(float(t), 100.0 + 0.5 * t) for t in range(60)])[0] == []


def test_fly_and_check_tell_how_long_they_take(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "LONG_S", 0.0)
    monkeypatch.setattr(module, "MEASURED_WALL_S", 0.0)
    defaults: Any = module.Forecast.__init__.__kwdefaults__
    monkeypatch.setitem(defaults, "clock", count(0.0, 0.01).__next__)
    monkeypatch.chdir(tmp_path)
    short = ["track_target", "--set", "duration_s=3", "--set", "perception.detector=none"]
    flown = CliRunner().invoke(app, ["fly", *short, "--no-recording", "--out", "run"])
    assert flown.exit_code == 0, flown.output
    memory = module._text(needs(scenario(3)).memory)
    about = f"track_target: 5 drones for 3 s: about 0 minutes and {memory} of memory on this machine"
    assert f"{about}, estimated from the first 2 s" in flown.stderr
    checked = CliRunner().invoke(app, ["check", *short])
    assert (
        "track_target: 5 drones for 2 × 3 s: about 0 minutes on this machine, estimated from" in checked.stderr
    )  # and silence
