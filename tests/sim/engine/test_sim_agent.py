"""What an agent does once, however many peers it is for and however often it is asked again."""

from __future__ import annotations

from typing import Any

import pytest
from sim_examples import PATIENT

import sortie.fleet.agent
from sortie.policies.decision_loop import DecisionLoop
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie

SETS = ["perception.detector=none", "duration_s=3", "mission.phases=[{at_s: 0, phase: search}]"]


def test_what_goes_to_four_peers_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    plain = sortie.fleet.agent.make_payload

    def counted(*what: Any, **more: Any) -> Any:
        made.append(plain(*what, **more))
        return made[-1]

    monkeypatch.setattr(sortie.fleet.agent, "make_payload", counted)
    sent = run_sortie(load("track_target", [*SETS, *PATIENT]), "all-4").tables["transmissions"].num_rows
    assert sent > 200
    assert 3.8 * len(made) < sent <= 4 * len(made)


def test_a_directive_that_is_asked_again_is_enforced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worked policy makes new directives in every frame; they are equal to the last ones."""
    asked: list[Any] = []
    plain = DecisionLoop._step

    def counted(self: DecisionLoop, *what: Any) -> None:
        asked.append(what[1])
        plain(self, *what)

    monkeypatch.setattr(DecisionLoop, "_step", counted)
    decisions = run_sortie(load("track_target", [*SETS, "duration_s=8"]), "worked").totals["decisions"]
    assert decisions == 400
    # two peers a decision; they are looked at in every frame only while an upgrade waits for its dwell time
    assert len(asked) < decisions
