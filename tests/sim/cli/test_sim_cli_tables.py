"""What commands print: each figure in its own column, with its interval, and texts as their authors wrote them."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_examples import Seen, command, run_line, table_rows
from record_by_hand import record
from rich.table import Table
from sim_examples import BASE

from sortie.perception.evaluation import SINGLE, Sharing
from sortie.perception.metrics.bootstrap import Difference
from sortie.scenarios.reading.load import load_conditions
from sortie.scenarios.report_text import points
from sortie.sim.check.expectations import Verdict
from sortie.sim.cli import console
from sortie.sim.cli.conditions import _by_condition
from sortie.sim.cli.tables import verdict_table
from sortie.sim.experiment.conditions import Cell
from sortie.sim.results.outcome import outcome
from sortie.sim.results.summary import transitions_table
from sortie.sim.terminal import Terminal


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console.out, "_width", 200)  # tables as they are, whatever the terminal's width


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scenario."""
    (tmp_path / "s.yaml").write_text(BASE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_evaluation_of_a_recording(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    alone, way = SINGLE, Sharing.parse("all-4@1")
    shown = SimpleNamespace(conditions=[alone, way], resampled="scene", groups=lambda by: np.array([1, 1, 4]))
    shown.ap = lambda c, region="full": {"full": 0.25, "mission": 0.5}[region]
    shown.gain = lambda c, over: Difference(0.0, 0.0, 0.125, 0.1, 0.2) if (c, over) == (way, alone) else None
    shown.payload_bytes = {alone: np.zeros(2), way: np.array([100.0, 300.0])}
    shown.index_bytes = {alone: np.zeros(2), way: np.array([7.0, 9.0])}
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
    monkeypatch.setattr("sortie.sim.cli.conditions.fly_conditions", flown)
    assert run_line("compare c.yaml --policies silence,boxes --set duration_s=4 --by-torch --out o.json") == 0
    conditions, policies = flown.args
    assert policies == ["silence", "boxes"]
    sets = ["perception.detector=surrogate", "duration_s=3", "duration_s=4"]
    assert list(conditions.set) == sets, "the last one holds"
    assert flown.kwargs["by_torch"] is True
    rows = table_rows(capsys.readouterr().out)
    assert ["wide", "0.5", "0.5", "0.75"] in [[*cells[:2], *(c.rstrip("0") for c in cells[2:])] for cells in rows]
    (silence,), (boxes,) = ([cells for cells in rows if cells[0] == p] for p in ("silence", "boxes"))
    assert silence[:4] == ["silence", "0.375", "–", "100%"]
    assert (boxes[1], boxes[2].split()[0], boxes[3]) == ("0.438", "+6.2", "117%")
    assert boxes[-2:] == ["4.0", "25.0%"]
    kept = json.loads((here / "o.json").read_text())
    assert [(row["policy"], row["data_bytes"]) for row in kept["summary"]] == [("silence", 0.0), ("boxes", 2e6)]
    figures = {"ap": 0.125, "data_bytes": 2e6, "energy_j": 4000.0, "miss_rate": 0.25, "flown_share": 1.0}
    assert kept["cells"][3] == {"policy": "boxes", "condition": "narrow", **figures}
    command("compare", "c.yaml", "--policies", "silence")
    assert flown.kwargs["by_torch"] is False


def test_the_best_of_a_condition_is_bold_in_whichever_table_it_stands(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a narrow terminal each policy has a table of its own."""
    (here / "c.yaml").write_text(CONDITIONS)
    conditions = load_conditions("c.yaml")
    assert conditions is not None
    cells = [Cell(p, c, ap, 0.0, 0.0, 0.0) for (p, c), ap in LATER.items()]
    tables = list(_by_condition(conditions, ["silence", "boxes"], cells, 20))
    bold = [[cell.style == "bold" for cell in table.columns[2].cells] for table in tables]
    assert bold == [[False, True], [True, False]]
    (wide,) = _by_condition(conditions, ["silence", "boxes"], cells, 200)
    assert [len(wide.columns), list(wide.columns[1].cells)] == [4, ["0.5", "0.125"]]


REASON = "as in [roi] and [/roi]"
"""Which the terminal's markup would swallow, or stumble over."""


def printed(table: Table) -> str:
    console = Terminal(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_points_without_an_interval_stand_alone() -> None:
    assert points((0.013, 0.005, 0.02)) == "1.3 [0.5, 2.0]"
    assert points((0.013, math.nan, math.nan), "+.2f") == "+1.30"


def test_brackets_in_what_users_and_policies_wrote_are_brackets() -> None:
    changes = outcome(record())["transitions"]
    told = {**outcome(record()), "transitions": [{**each, "reason": REASON} for each in changes]}
    assert REASON in printed(transitions_table(told))
    expected, got, because, explanation = (f"{word} {REASON}" for word in ("wants", "got", "because", "record"))
    said = printed(verdict_table("mine", [Verdict(expected, got, False, because, explanation=explanation)]))
    assert all(text in said for text in (expected, got, because, explanation))
