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
TOLD = {
    "leaves": "policy 'mine.py:leaves' on drone {} raises ProgramExitError: exit code 0, must return (mine.py, line 5)",
    "spins": "example, seed 3: no answer within 2 s (limits.decision_s) (mine.py, line ",
}


@pytest.fixture
def scenario(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(POLICY)
    path = tmp_path / "example.yaml"
    path.write_text(BASE + "seed: 3\nexpect: [{metric: bytes.data_sent, at_least: 0}]\n")
    return path


@pytest.mark.parametrize(
    ("what", "name"), [("fly", "spins"), ("fly", "leaves"), ("check", "leaves"), ("compare", "leaves")]
)
def test_no_command_succeeds_with_it(what: str, name: str, scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = {
        "fly": ["--policy", f"mine.py:{name}"],
        "check": ["--set", f"policy={{name: 'mine.py:{name}'}}"],
        "compare": ["--policies", f"worked,mine.py:{name}"],
    }
    limits = ["--set", "limits.decision_s=2"] if name == "spins" else []
    assert command(what, scenario, *flown[what], *limits) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert any(TOLD[name].format(drone) in " ".join(told.split()) for drone in range(9))
    assert not Path("runs").exists()


def test_a_function_that_leaves_is_an_error_of_it() -> None:
    def leaves(view: FleetView) -> Sequence[Directive]:
        raise SystemExit(0)

    with pytest.raises(
        PolicyError, match=r"leaves' on drone \d raises ProgramExitError: exit code 0, must return \(test_"
    ):
        run_sortie(example(), leaves)


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
