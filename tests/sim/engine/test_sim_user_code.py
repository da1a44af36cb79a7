"""A user's policy in flight: it cannot end the command, take for ever, or change what others read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from cli_examples import command
from sim_examples import BASE, example

from sortie.policies.contract import Directive, FleetView, PolicyError
from sortie.policies.registry import resolve
from sortie.sim.engine import sortie as clock
from sortie.sim.engine.sortie import LimitError, run_sortie
from sortie.sim.results import run_folder

POLICY = """
import os, sys
from sortie.policies.contract import Directive

def silent(view):
    return [Directive(view.ego, p, reason="silent") for p in view.peers]

def leaves(view):
    sys.exit(0)

def spins(view):
    while True:
        pass

def moves(view):
    if os.path.isdir("elsewhere"):
        os.chdir("elsewhere")
    return silent(view)
"""
NAMES = {
    "leaves": "raises ProgramExitError: exit code 0, must return (mine.py, line 9)",
    "spins": "raises TookTooLongError: no answer within 2 s (limits.decision_s) (mine.py, line 1",
}


@pytest.fixture
def scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(POLICY)
    path = tmp_path / "example.yaml"
    path.write_text(BASE + "limits: {decision_s: 2}\nexpect: [{metric: bytes.data_sent, at_least: 0}]\n")
    return path


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", ["fly", "check", "compare"])
def test_no_command_succeeds_with_it(scenario: Path, name: str, what: str, capsys: pytest.CaptureFixture[str]) -> None:
    flown = {
        "fly": ["--policy", f"mine.py:{name}"],
        "check": ["--set", f"policy={{name: 'mine.py:{name}'}}"],
        "compare": ["--policies", f"worked,mine.py:{name}"],
    }
    assert command(what, scenario, *flown[what]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert f"policy 'mine.py:{name}' on drone " in told
    assert NAMES[name] in told
    assert not Path("runs").exists()


def test_a_function_of_ones_own_is_limited_too() -> None:
    def leaves(view: FleetView) -> Sequence[Directive]:
        raise SystemExit(0)

    def spins(view: FleetView) -> Sequence[Directive]:
        while True:
            pass

    with pytest.raises(
        PolicyError, match=r"leaves' on drone \d raises ProgramExitError: exit code 0, must return \(test_"
    ):
        run_sortie(example(), leaves)
    with pytest.raises(PolicyError, match=r"spins' on drone \d raises TookTooLongError: no answer within 0.2 s"):
        run_sortie(example("limits.decision_s=0.2"), spins)


def test_a_flight_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the clock on the wall, which is moved on here by a minute a look."""
    now_s = iter(range(0, 10**6, 60))
    monkeypatch.setattr(clock, "perf_counter", lambda: float(next(now_s)))
    told = r"^example, seed 3: the flight takes longer than 90 s \(limits\.run_s\), and is at 1 s$"
    with pytest.raises(LimitError, match=told):
        run_sortie(example("limits.run_s=90"), seed=3)


def test_a_run_is_kept_where_the_command_was_begun(scenario: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    command(
        "fly", scenario, "--policy", "mine.py:moves", "--no-recording", "--out", "runs/one", "--set", "duration_s=0.5"
    )
    assert run_folder.load(tmp_path / "runs" / "one").policy == "mine.py:moves"
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.parametrize("views", ["false", "true"])
def test_a_policy_cannot_change_what_it_reads(views: str) -> None:
    """An age set to zero would defeat the staleness rules, and be the record's."""

    def younger(view: FleetView) -> Sequence[Directive]:
        ages_s: Any = view.age_s
        for peer in view.peers:
            ages_s[peer] = 0.0
        return resolve("worked")(view)

    told = r"younger' on drone \d raises TypeError: 'mappingproxy' object does not support item assignment \(test_"
    with pytest.raises(PolicyError, match=told):
        run_sortie(example("duration_s=1", f"record.views={views}"), younger)

    def without(view: FleetView) -> Sequence[Directive]:
        known: Any = view.descriptors
        known.clear()
        return []

    with pytest.raises(PolicyError, match="raises AttributeError: 'mappingproxy' object has no attribute 'clear'"):
        run_sortie(example("duration_s=1"), without)
