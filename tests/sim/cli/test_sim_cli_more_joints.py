"""What some commands pass on: every option arrives in its own place, and every figure that they print stands in its own
column. Commands: `compare` over conditions, `verify`, `import`, `view`, `report`, and `recording evaluate`.
What they call is stood in for, so that nothing is computed.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_examples import Seen, command, table_rows
from sim_examples import BASE

import sortie
from sortie.perception.evaluation import SINGLE, Sharing
from sortie.perception.metrics.bootstrap import Difference
from sortie.policies.contract import PolicyError
from sortie.policies.verification.invariants.language import Invariant
from sortie.scenarios.reading.load import ScenarioError
from sortie.sim.cli import console
from sortie.sim.cli import verify as verify_command
from sortie.sim.cli.options import loaded, split_policies
from sortie.sim.studies.conditions import Cell


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console.out, "_width", 200)  # tables as they are, whatever the terminal's width


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scenario."""
    (tmp_path / "s.yaml").write_text(BASE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_recording(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    alone, way = SINGLE, Sharing.parse("all-4@1")
    shown = SimpleNamespace(
        conditions=[alone, way], resampled="scene", groups=lambda by: np.array([1, 1, 4]),
        ap=lambda c, region="full": {"full": 0.25, "mission": 0.5}[region],
        gain=lambda c, over: Difference(0.0, 0.0, 0.125, 0.1, 0.2) if (c, over) == (way, alone) else None,
        payload_bytes={alone: np.zeros(2), way: np.array([100.0, 300.0])},
        index_bytes={alone: np.zeros(2), way: np.array([7.0, 9.0])},
    )  # fmt: skip
    at, kept = Seen(shown), Seen(True)
    evaluated = Seen(SimpleNamespace(at=at, save=kept))
    monkeypatch.setattr("sortie.perception.evaluation.evaluate_recording", evaluated)
    options = ("--fusion", "own.py:fuse", "--conditions", "single best-2@0.02", "--tau", "0.25", "--out", "m.parquet")
    assert command("recording", "evaluate", "r.npz", *options) == 0
    (path, ways), given = evaluated.args, evaluated.kwargs
    assert (path, given) == (Path("r.npz"), {"fusion": "own.py:fuse"})
    assert [w.label for w in ways] == [Sharing.parse(text).label for text in ("single", "best-2@0.02")]
    assert (at.args, kept.args) == ((0.25,), (Path("m.parquet"),))
    printed = capsys.readouterr().out
    assert ["single", "0.250", "", "0.500", "0", "0"] in table_rows(printed)
    assert ["all-4@1", "0.250", "+12.5 [+10.0, +20.0]", "0.500", "200", "8"] in table_rows(printed)
    assert "interval over 2 scene(s)" in printed
    assert command("recording", "evaluate", "r.npz", "--tau", "1") == 0
    assert (at.args, evaluated.args[1]) == ((1.0,), None)
    assert command("recording", "evaluate", "r.npz", "--tau", "1.01") == 2
    assert len(evaluated.calls) == 2


# --- studies --------------------------------------------------------------------------------------------------------

CONDITIONS = """
base: s.yaml
set: [perception.detector=surrogate, duration_s=3]
conditions:
  - {name: wide, budget: 0.5, metric: full_scene}
  - {name: narrow, budget: 0.125, metric: full_scene}
"""
LATER = {("silence", "wide"): 0.5, ("silence", "narrow"): 0.25, ("boxes", "wide"): 0.75, ("boxes", "narrow"): 0.125}


def test_compare_over_conditions(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Gains over silence: 0.25 and -0.125; the mean of each policy's conditions stands in its row."""
    (here / "c.yaml").write_text(CONDITIONS)
    cells = [Cell(p, c, ap, 2e6 if p == "boxes" else 0.0, 4000.0, 0.25) for (p, c), ap in LATER.items()]
    flown = Seen(cells)
    monkeypatch.setattr("sortie.sim.cli.conditions.fly_all", flown)
    monkeypatch.setattr("sortie.sim.cli.conditions.torch_answers", lambda: "by torch")
    own = ("--set", "duration_s=4")
    assert command("compare", "c.yaml", "--policies", "silence,boxes", *own, "--by-torch", "--out", "o.json") == 0
    conditions, policies = flown.args
    assert policies == ["silence", "boxes"]
    assert list(conditions.set) == ["perception.detector=surrogate", "duration_s=3", "duration_s=4"], (
        "the last one holds"
    )
    assert flown.kwargs["detector_of"] == "by torch"
    rows = table_rows(capsys.readouterr().out)
    assert ["wide", "0.5", "0.5", "0.75"] in [[*cells[:2], *(c.rstrip("0") for c in cells[2:])] for cells in rows]
    (silence,), (boxes,) = ([cells for cells in rows if cells[0] == p] for p in ("silence", "boxes"))
    assert silence[:4] == ["silence", "0.375", "–", "100%"]
    assert (boxes[1], boxes[2].split()[0], boxes[3]) == ("0.438", "+6.2", "117%")
    assert boxes[-2:] == ["4.0", "25.0%"]
    kept = json.loads((here / "o.json").read_text())
    assert [(row["policy"], row["data_bytes"]) for row in kept["summary"]] == [("silence", 0.0), ("boxes", 2e6)]
    assert kept["cells"][3] == {
        "policy": "boxes", "condition": "narrow", "ap": 0.125, "data_bytes": 2e6, "energy_j": 4000.0, "miss_rate": 0.25,
        "flown_share": 1.0,
    }  # fmt: skip
    command("compare", "c.yaml", "--policies", "silence")
    assert flown.kwargs["detector_of"] is not None
    assert flown.kwargs["detector_of"] != "by torch"


def test_the_best_of_a_condition_is_bold_in_whichever_table_it_stands(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a narrow terminal each policy has a table of its own."""
    from sortie.scenarios.reading.load import load_conditions
    from sortie.sim.cli.conditions import _by_condition

    (here / "c.yaml").write_text(CONDITIONS)
    conditions = load_conditions("c.yaml")
    assert conditions is not None
    cells = [Cell(p, c, ap, 0.0, 0.0, 0.0) for (p, c), ap in LATER.items()]
    tables = list(_by_condition(conditions, ["silence", "boxes"], cells, 20))
    bold = [[cell.style == "bold" for cell in table.columns[2].cells] for table in tables]
    assert bold == [[False, True], [True, False]]
    (wide,) = _by_condition(conditions, ["silence", "boxes"], cells, 200)
    assert [len(wide.columns), list(wide.columns[1].cells)] == [4, ["0.5", "0.125"]]


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


def test_verify(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "lines").write_text("representation >= detections\nwithin 0.5 s: representation >= detections\n")
    seen, resolved = verified(monkeypatch), Seen(lambda view: [])
    monkeypatch.setattr(verify_command, "resolve", resolved)
    options = (
        "--invariants", "lines", "--drones", "3", "--budget", "4", "--views", "50", "--scenario", "s.yaml", "--courses", "6",
        "--flights", "7",
    )  # fmt: skip
    assert command("verify", "best-2(received_budget=0.25)", *options) == 0
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


@pytest.mark.parametrize(
    ("proved", "judged", "broken"), [("refuted", "holds", 1), ("proved", "refuted", 1), ("refuted", "refuted", 2)]
)
def test_each_verdict_that_is_refuted_counts(
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    proved: str,
    judged: str,
    broken: int,
) -> None:
    (here / "lines").write_text("representation >= detections\nwithin 0.5 s: representation >= detections\n")
    verified(monkeypatch, proved, judged)
    assert command("verify", "silence", "--invariants", "lines") == 1
    assert f"{broken} do" in capsys.readouterr().err


def test_a_model_of_another_kind_is_verified_with_its_parameters(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = [
        SimpleNamespace(name=name, verdict=verdict, holds=verdict == "holds", what="")
        for name, verdict in (("a", "holds"), ("b", "fails"), ("c", "not tried enough"))
    ]
    seen = Seen(checks)
    monkeypatch.setattr(verify_command, "verify_model", seen)
    monkeypatch.setattr(verify_command, "failing", lambda checks: [c for c in checks if not c.holds])
    assert command("verify", "link", "own.py:Blocked(loss_db=20, hard=true)") == 1
    assert seen.args == ("link", "own.py:Blocked", {"loss_db": 20, "hard": True})
    assert "2 do not hold" in capsys.readouterr().err
    for words in (("link",), ("link", "a", "b")):
        assert command("verify", *words) == 2
        assert "must be [KIND] REF" in capsys.readouterr().err
    assert len(seen.calls) == 1


# --- runs -----------------------------------------------------------------------------------------------------------


def test_view_and_report(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viewed, pictured, reported = Seen(True), Seen(True), Seen(Path("page"))
    opened = Seen(SimpleNamespace(view=viewed, picture=pictured, report=reported))
    monkeypatch.setattr(sortie, "open_run", opened)
    assert command("view", "r", "--picture", "p.png", "--at", "2.5") == 0
    assert (opened.args, pictured.args, viewed.calls) == ((Path("r"),), (Path("p.png"), 2.5), [])
    assert command("view", "r") == 0
    assert (len(viewed.calls), len(pictured.calls)) == (1, 1)
    assert command("report", "r", "--out", "o.html") == 0
    assert command("report", "r") == 0
    assert [args for args, _ in reported.calls] == [(Path("o.html"),), (Path("r/report.html"),)]


def test_import(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = Seen()
    monkeypatch.setattr("sortie.sim.cli.import_log.flown_log", seen)
    options = (
        "--rate", "5", "--from", "1.5", "--until", "2.5", "--lift", "3.5", "--system", "7", "--system", "2", "--together", "--ground",
        "47,8", "--out", "o",
    )  # fmt: skip
    assert command("import", "a.bin", "b.tlog", *options) == 2
    assert seen.args == ([Path("a.bin"), Path("b.tlog")], Path("o"), 5.0, 1.5, 2.5, 3.5, [7, 2])
    assert seen.kwargs == {"together": True, "ground": ["47,8"]}
    command("import", "My Log.bin")
    assert seen.args == ([Path("My Log.bin")], Path("my_log"), 10.0, 0.0, None, None, ())
    assert seen.kwargs == {"together": False, "ground": ()}


# --- options that several commands take -----------------------------------------------------------------------------


def test_a_policy_that_is_named_wins_over_the_one_that_is_set(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flown = loaded("s.yaml", ["policy.name=boxes", "duration_s=4"], "silence")
    assert (flown.policy.name, flown.duration_s) == ("silence", 4.0)
    assert capsys.readouterr().err == ""
    own = loaded("s.yaml", ["policy.changes=[{at_s: 1, name: boxes}]"], "worked")
    assert [change.name for change in own.policy.changes] == ["boxes"], "the scenario's own policy keeps its changes"
    assert capsys.readouterr().err == ""


def test_commas_in_brackets_separate_parameters() -> None:
    assert split_policies(" a(x=1, y=f(2,3)) ,b, ") == ["a(x=1, y=f(2,3))", "b"]
    assert split_policies("a(x=[1, 2], y='c, d)'),b") == ["a(x=[1, 2], y='c, d)')", "b"]
    with pytest.raises(PolicyError, match=r"^policies 'a\(x=1,b': a bracket is not closed"):
        split_policies("a(x=1,b")


def test_quoted_commas_and_brackets_reach_a_policy_of_ones_own(here: Path) -> None:
    name, params = "d (1)/own.py:decide", {"x": "a, b", "y": "(", "z": 2.5}
    text = f"""{name}( x = "a, b", y='(', z=2.5, )"""
    flown = loaded("s.yaml", [], text).policy
    assert (flown.name, flown.params) == (name, params)
    assert verify_command._called(text, "link") == (name, params)
    with pytest.raises(ScenarioError, match=r"policy\.params\.x: a list of 2, must be a number, true, false or text$"):
        loaded("s.yaml", [], f"{name}(x=[1, 2.5])")


def test_what_is_wrong_in_the_bracket_of_a_policy_is_said_of_the_policy(here: Path) -> None:
    for policy, message in (
        ("best-2(0.1)", r"^policy 'best-2\(0.1\)': '0.1' in the bracket, must be key=value$"),
        ("best-2(rho=[0.1)", r"^policy 'best-2\(rho=\[0.1\)': the bracket is not closed"),
    ):
        with pytest.raises(PolicyError, match=message):
            loaded("s.yaml", [], policy)
