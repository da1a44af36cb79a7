"""Ctrl-C, whenever it comes, is one line and exit code 130."""

from __future__ import annotations

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from sim_examples import BASE

import sortie
from sortie.sim.cli import app

COMMAND = """
import signal, sys
{before}
class AtImport:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, AtImport())
sys.argv = ["sortie", "list", "scenarios"]
from {module} import {function}
{function}()
"""


def entry_point() -> dict[str, str]:
    """Module and function of the command, as it is installed."""
    text = (Path(app.__file__).resolve().parents[2] / "pyproject.toml").read_text("utf-8")
    module, _, function = tomllib.loads(text)["project"]["scripts"]["sortie"].partition(":")
    return {"module": module, "function": function}


def started(name: str, before: str = "") -> subprocess.CompletedProcess[str]:
    """The command, with a Ctrl-C when a module is about to be imported."""
    code = COMMAND.format(before=before, name=name, **entry_point())
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "name",
    ["subprocess", "sortie.sim.cli.app", "typer", "numpy", "scipy.special", "pyarrow", "sortie.fleet.flight.motion"],
)
def test_while_the_command_is_still_imported(name: str) -> None:
    ended = started(name)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "interrupted; nothing was written\n")


def test_where_it_is_ignored_it_stays_so() -> None:
    """As a shell does for what it starts in the background."""
    ended = started("numpy", "signal.signal(signal.SIGINT, signal.SIG_IGN)")
    assert ended.returncode == 0, ended.stderr
    assert "track_target" in ended.stdout


def test_while_a_sortie_flies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def flown(*args: object, **options: object) -> None:
        signal.raise_signal(signal.SIGINT)

    scenario = tmp_path / "example.yaml"
    scenario.write_text(BASE)
    monkeypatch.setattr(sortie, "fly", flown)
    monkeypatch.setattr(sys, "argv", ["sortie", "fly", str(scenario), "--out", str(tmp_path / "run")])
    with pytest.raises(SystemExit) as stop:
        app.app()
    assert stop.value.code == 130
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "interrupted; what was not finished was not written\n")
    assert not (tmp_path / "run").exists()
