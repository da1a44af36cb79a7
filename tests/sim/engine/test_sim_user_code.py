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
from sortie.sim.engine.sortie import run_sortie

POLICY = """
import sys

def leaves(view):
    sys.exit(0)

def spins(view):
    while True:
        pass
"""
LEAVES = "policy 'mine.py:leaves' on drone {} raises ProgramExitError: exit code 0, must return (mine.py, line 5)"
SPINS = "example, seed 3: no answer within 2 s (limits.decision_s) (mine.py, line "
COMMANDS: list[tuple[list[str], str]] = [
    (["fly", "--policy", "mine.py:spins", "--set", "limits.decision_s=2"], SPINS),
    (["fly", "--policy", "mine.py:leaves"], LEAVES),
    (["check", "--set", "policy={name: 'mine.py:leaves'}"], LEAVES),
    (["compare", "--policies", "worked,mine.py:leaves"], LEAVES),
]


def test_no_command_succeeds_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(POLICY)
    Path("example.yaml").write_text(BASE + "seed: 3\nexpect: [{metric: bytes.data_sent, at_least: 0}]\n")
    for (what, *options), words in COMMANDS:
        assert command(what, "example.yaml", *options, "--set", "duration_s=3.5") == 2
        line = " ".join(capsys.readouterr().err.split())
        assert line.startswith("error: ")
        assert any(words.format(drone) in line for drone in range(5))
    assert not Path("runs").exists()


def test_a_function_that_leaves_is_an_error_of_it() -> None:
    def leaves(view: FleetView) -> Sequence[Directive]:
        raise SystemExit(0)

    words = r"leaves' on drone \d raises ProgramExitError: exit code 0, must return \(test_"
    with pytest.raises(PolicyError, match=words):
        run_sortie(example(), leaves)


def test_a_policy_cannot_change_what_it_reads() -> None:
    """An age set to zero would defeat the staleness rules, and be the record's."""

    def younger(view: FleetView) -> Sequence[Directive]:
        ages_s: Any = view.age_s
        for peer in view.peers:
            ages_s[peer] = 0.0
        return resolve("worked")(view)

    def without(view: FleetView) -> Sequence[Directive]:
        known: Any = view.descriptors
        known.clear()
        return []

    assigns = r"younger' on drone \d raises TypeError: 'mappingproxy' object does not support item assignment \(test_"
    for policy, views, words in (
        (younger, "false", assigns),
        (younger, "true", assigns),
        (without, "false", "raises AttributeError: 'mappingproxy' object has no attribute 'clear'"),
    ):
        with pytest.raises(PolicyError, match=words):
            run_sortie(example(f"record.views={views}"), policy)
