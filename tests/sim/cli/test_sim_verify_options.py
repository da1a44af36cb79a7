"""What `sortie verify` passes on to its three judges, and how their verdicts decide the exit code."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from cli_examples import Seen, run_line
from sim_examples import BASE

from sortie.policies.verification.invariants.language import Invariant
from sortie.sim.cli import verify as verify_command


def verified(monkeypatch: pytest.MonkeyPatch, proved: str = "proved", judged: str = "holds") -> dict[str, Seen]:
    """What `sortie verify` calls, each with one verdict."""
    seen = {
        "conform": Seen([SimpleNamespace(name="rule", verdict="holds", holds=True, what="", counterexample=None)]),
        "prove": Seen([SimpleNamespace(name="line", outcome=proved, what="", counterexample=None)]),
        "judge_over_time": Seen([SimpleNamespace(name="timed", outcome=judged, what="", view=None, scenario=None)]),
    }
    for name, function in seen.items():
        monkeypatch.setattr(verify_command, name, function)
    return seen


TIMED = "representation >= detections\nwithin 0.5 s: representation >= detections\n"


def test_every_option_arrives_in_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lines").write_text(TIMED)
    Path("s.yaml").write_text(BASE)
    seen, resolved = verified(monkeypatch), Seen(lambda view: [])
    monkeypatch.setattr(verify_command, "resolve", resolved)
    options = "--invariants lines --drones 3 --budget 4 --views 50 --scenario s.yaml --courses 6 --flights 7"
    assert run_line(f"verify 'best-2(received_budget=0.25)' {options}") == 0
    assert resolved.args == ("best-2", {"received_budget": 0.25})
    assert seen["conform"].kwargs == {"count": 50}
    decide, rules = seen["prove"].args
    assert seen["prove"].kwargs == {"max_drones": 3, "cells": 4}
    subject, timed = seen["judge_over_time"].args
    assert [rule.over_time for rule in (*rules, *timed)] == [False, True]
    assert all(isinstance(rule, Invariant) for rule in (*rules, *timed))
    assert seen["conform"].args == (decide,)
    assert (subject.policy, subject.name, subject.params) == (decide, "best-2", {"received_budget": 0.25})
    given = seen["judge_over_time"].kwargs
    assert given.pop("scenario").name == "example"
    assert given == {"drones": 3, "courses": 6, "flights": 7}


def test_each_verdict_that_is_refuted_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lines").write_text(TIMED)
    for proved, judged, broken in (("refuted", "holds", 1), ("proved", "refuted", 1), ("refuted", "refuted", 2)):
        verified(monkeypatch, proved, judged)
        assert run_line("verify silence --invariants lines") == 1
        assert f"{broken} do" in capsys.readouterr().err


def test_a_model_of_another_kind_is_verified_with_its_parameters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    verdicts = (("a", "holds"), ("b", "fails"), ("c", "not tried enough"))
    seen = Seen([SimpleNamespace(name=name, verdict=v, holds=v == "holds", what="") for name, v in verdicts])
    monkeypatch.setattr(verify_command, "verify_model", seen)
    monkeypatch.setattr(verify_command, "failing", lambda checks: [c for c in checks if not c.holds])
    assert run_line("verify link 'own.py:Blocked(loss_db=20, hard=true)'") == 1
    assert seen.args == ("link", "own.py:Blocked", {"loss_db": 20, "hard": True})
    assert "2 do not hold" in capsys.readouterr().err
    for words in ("link", "link a b"):
        assert run_line(f"verify {words}") == 2
        assert "must be [KIND] REF" in capsys.readouterr().err
    assert len(seen.calls) == 1
