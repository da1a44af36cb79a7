"""`sortie recording`, and a recording flown from the command line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from recording_examples import record_flight, small
from sim_examples import example
from typer.testing import CliRunner

from sortie.perception.recordings.recording import RecordingError
from sortie.sim.cli.app import app
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.compare import Contender, compare

pytestmark = pytest.mark.slow

RECORDED = "perception.detector=recorded"
SHORT = ("duration_s=2", "mission.phases=[{at_s: 0, phase: search}]", "policy.dwell_s=0.2")


def say(*arguments: str) -> str:
    done = CliRunner().invoke(app, list(arguments), env={"COLUMNS": "160"})
    assert done.exit_code == 0, done.output + repr(done.exception)
    return done.output


def test_a_recording_is_shown_and_evaluated(tmp_path: Path) -> None:
    path = small(tmp_path / "mine.npz")
    shown = say("recording", "show", str(path))
    assert "2 frames of 2 drones in 1 scenes" in shown
    assert "cells 3 × 64 × 64 of 3.2 m; features" in shown
    table = say(
        "recording", "evaluate", str(path), "--conditions", "single all-1@1", "--out", str(tmp_path / "all.parquet")
    )
    assert re.search(r"single\s+│\s+0\.500\s", table)
    assert re.search(r"all-1@1\s+│\s+1\.000\s.*│\s+24576\s+│\s+0\s", table)
    assert (tmp_path / "all.parquet").is_file()


def test_wrong_questions_are_told_before_anything_is_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate = ["recording", "evaluate", str(small(tmp_path / "m.npz"))]
    monkeypatch.setattr("sortie.perception.evaluation.evaluate_recording", lambda *_, **__: pytest.fail("evaluated"))
    for command, words in (
        (["recording", "show", str(tmp_path / "none.npz")], "no such recording"),
        ([*evaluate, "--conditions", "most@2"], "condition is 'most@2', must be like"),
        *(([*evaluate, "--tau", tau], f"tau is {tau}, must be 0.01 to 1") for tau in ("0.001", "nan", "1.5")),
    ):
        assert words in str(CliRunner().invoke(app, command).exception)


def test_sharing_gains_over_silence_on_a_recording(tmp_path: Path) -> None:
    """The made model sees 45 m far: peers know cars that the ego does not. The same flight twice is the same."""
    path = record_flight(example(*SHORT), tmp_path / "flight.npz", features=False)
    flight = (*SHORT, RECORDED, f"perception.recording={path}")
    sharing = example(*flight, "policy.name=all-4", "policy.params={received_budget: 0.05}")
    silent = example(*flight, "policy.name=silence", "policy.params={}")
    rows, gains = compare([Contender("silence", silent), Contender("all-4", sharing)], [silent.seed])
    assert gains[0].gain > 0.0
    assert rows[1].outcome["ap50"]["detector"] == "recorded"
    assert run_sortie(sharing).fingerprint == rows[1].outcome["fingerprint"]


def test_another_flight_than_the_recorded_one_is_refused(tmp_path: Path) -> None:
    path = record_flight(example(*SHORT), tmp_path / "flight.npz", features=False)
    away = example(*SHORT, RECORDED, f"perception.recording={path}", "fleet.route.waypoints_m=[[500, 0]]")
    with pytest.raises(
        RecordingError, match=r"drone 0 at 0 s flies \d+\.\d m from where it was recorded, must be within"
    ):
        run_sortie(away)
