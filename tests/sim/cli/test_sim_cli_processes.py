"""The command as a process of its own: what a shell sees of it, what it loads, and how Ctrl-C ends it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from cli_examples import run_line
from places import ROOT
from sim_examples import BASE

import sortie
from sortie.scenarios.exit_codes import USER

MODULE, _, FUNCTION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"][
    "sortie"
].partition(":")
"""Module and function of the command, as it is installed."""


def python(code: str, *arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    """A Python process with a program."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_fly_prints_the_outcome_and_keeps_the_run_and_an_error_is_one_line(tmp_path: Path) -> None:
    """Its energy by cause is what left the batteries."""
    (tmp_path / "example.yaml").write_text(BASE)
    start = f"from {MODULE} import {FUNCTION}; {FUNCTION}()"
    sets = ("--set", "fleet.battery.initial_soc=0.5")
    done = python(start, "fly", "example.yaml", *sets, "--no-recording", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for word in ("context plane", "data plane", "energy", "fingerprint", "decisions and events"):
        assert word in done.stdout
    (folder,) = (tmp_path / "runs").glob("example-s1-worked-????????")
    kept = json.loads((folder / "outcome.json").read_text())
    assert max(kept["battery"].values()) < 0.5
    total = kept["energy_j"].pop("total")
    assert total == pytest.approx(sum(kept["energy_j"].values()))
    assert total == pytest.approx(sum(drone["energy_j"] for drone in kept["drones"].values()))


def test_output_that_cannot_be_written_is_one_line() -> None:
    """A disk that is full, a pipe that nobody reads, and an output that was closed, in three forks of one process."""
    code = f"""
import os, sys
from {MODULE} import {FUNCTION}
reads, closed_pipe = os.pipe()
os.close(reads)
for out in (os.open("/dev/full", os.O_WRONLY), closed_pipe, None):
    if os.fork() == 0:
        os.close(1) if out is None else os.dup2(out, 1)
        sys.stdout = None if out is None else open(1, "w", closefd=False)
        sys.argv = ["sortie", "list", "policies"]
        {FUNCTION}()
    sys.stderr.write(f"{{os.waitstatus_to_exitcode(os.wait()[1])}}\\n")
    sys.stderr.flush()
"""
    whys = ("No space left on device", "Broken pipe", "it was closed")
    lines = [f"error: standard output: {why}; not everything was printed\n{USER}\n" for why in whys]
    assert python(code).stderr == "".join(lines)


INTERRUPTED = """
import os, signal, sys

class AtImport:
    def __init__(self, name):
        self.name = name

    def find_spec(self, name, path=None, target=None):
        if name == self.name:
            signal.raise_signal(signal.SIGINT)

for name, handler in {cases}:
    if os.fork() == 0:
        signal.signal(signal.SIGINT, signal.SIG_IGN if handler == "ignored" else signal.default_int_handler)
        sys.meta_path.insert(0, AtImport(name))
        sys.argv = ["sortie", "list", "scenarios"]
        from {module} import {function}
        {function}()
    sys.stderr.write(f"{{os.waitstatus_to_exitcode(os.wait()[1])}}\\n")
    sys.stderr.flush()
"""


def test_ctrl_c_while_the_command_is_still_imported_is_one_line() -> None:
    """Where it is ignored it stays so, as a shell does for what it starts in the background."""
    names = ("sortie.sim.cli.app", "typer", "numpy", "scipy.special", "pyarrow", "sortie.fleet.flight.motion")
    cases = [*((name, "") for name in names), ("numpy", "ignored")]
    done = python(INTERRUPTED.format(cases=cases, module=MODULE, function=FUNCTION))
    assert done.stderr == "interrupted; nothing was written\n130\n" * len(names) + "0\n"
    assert done.stdout.count("track_target") == 1


def test_ctrl_c_while_a_sortie_flies_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "example.yaml").write_text(BASE)
    monkeypatch.setattr(sortie, "fly", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    assert run_line(f"fly {tmp_path}/example.yaml --out {tmp_path}/run") == 130
    assert capsys.readouterr() == ("", "interrupted; what was not finished was not written\n")
    assert not (tmp_path / "run").exists()


HEAVY = {"torch", "numba", "scipy.stats", "scipy.signal", "scipy.interpolate", "networkx", "rerun", "matplotlib"}
"""Each takes from a fifth of a second to some seconds, for which users and workers of a campaign would wait."""
LOADED = """
import sys
import sortie.sim.cli.app
print(*sys.modules)
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
search = "mission.phases=[{at_s: 0, phase: search}]"
run_sortie(load("track_target", ["perception.detector=surrogate", "duration_s=1", search]))
print(*sys.modules)
"""


def test_the_command_line_loads_nothing_heavy_and_neither_does_a_flight_without_the_network() -> None:
    """But for numba: the radio's stations are compiled."""
    done = python(LOADED)
    assert done.returncode == 0, done.stderr
    imported, flown = (set(line.split()) for line in done.stdout.splitlines())
    assert "sortie.sim.cli.fly" in imported
    assert HEAVY & imported == set()
    assert HEAVY & flown == {"numba"}
