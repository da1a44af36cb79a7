"""A run's folder: written whole or not at all, under the name of what flew, and never over what no run wrote."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from sim_examples import example

from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import TABLES, SortieRecord
from sortie.sim.results.run_files import SCENARIO

FIELDS = (
    "scenario policy seed version fingerprint ap50 bytes context_share deadline_miss_rate age_s battery energy_j "
    "switches policy_eval_us wall_s realtime_factor"
)
"""outcome.json holds at least these."""


@cache
def flight() -> SortieRecord:
    """Half a second of five drones."""
    return run_sortie(example("duration_s=0.5"))


def record(**changes: Any) -> SortieRecord:
    """The same flight, or another one by these changes."""
    return replace(flight(), **changes)


def dies(folder: Path) -> None:
    raise OSError(28, "No space left on device")


def test_a_run_is_kept_whole_and_reads_back(tmp_path: Path) -> None:
    flown, path = record(), tmp_path / "run"
    result = outcome(flown)
    assert run_folder.save(flown, path) == path
    assert set(result) >= set(FIELDS.split())
    assert json.loads((path / "outcome.json").read_text()) == result
    files = {
        "outcome.json",
        "scenario.yaml",
        "record.json",
        *(f"{name}.parquet" for name in (*TABLES, "accuracy", "links")),
    }
    assert {p.name for p in path.iterdir()} == files
    assert pq.read_table(path / "states.parquet").num_rows == 25
    back = run_folder.load(path)
    assert back.fingerprint == flown.fingerprint
    assert outcome(back) == result


def test_a_runs_folder_is_named_after_what_flew() -> None:
    for changes, wanted in (
        ({}, "example-s1-worked"),
        ({"seed": 4}, "example-s4-worked"),
        ({"replication": 2}, "example-s1-worked-r2"),
        ({"policy": "best-2(received_budget=0.1)"}, "example-s1-best-2_received_budget_0.1"),
    ):
        flown = record(**changes)
        assert str(run_folder.default_path(flown)) == f"runs/{wanted}-{flown.fingerprint[:8]}"
    other = record(totals={**record().totals, "decisions": 1})
    assert run_folder.default_path(other) != run_folder.default_path(record()), "what flew otherwise is elsewhere"


def test_a_run_that_dies_while_saving_leaves_no_half_run(tmp_path: Path) -> None:
    flown, path = record(), tmp_path / "run"
    with pytest.raises(RunError, match="run: cannot be written: No space left on device"):
        run_folder.save(flown, path, dies)
    assert list(tmp_path.iterdir()) == []
    run_folder.save(flown, path)
    with pytest.raises(RunError):
        run_folder.save(record(seed=9), path, dies, replace=True)
    assert run_folder.load(path).fingerprint == flown.fingerprint, "the older run is still whole"


def test_what_no_run_wrote_is_not_replaced(tmp_path: Path) -> None:
    """In the run's folder, or in its place."""
    for theirs, named in (
        (["mynotes.txt"], "mynotes.txt"),
        (["photos/a.jpg"], "photos"),
        (["other_run/outcome.json"], "other_run"),
        (["b.txt", "a.txt", "photos/a.jpg"], "a.txt"),
    ):
        path = tmp_path / str(len(theirs) + len(named))
        run_folder.save(record(), path)
        for name in theirs:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_text("a day's work")
        what = f"{path}: holds {named}, which no run wrote; choose another folder or move it"
        with pytest.raises(RunError, match=f"^{re.escape(what)}$"):
            run_folder.save(record(seed=2), path, replace=True)
        assert [(path / name).read_text() for name in theirs] == ["a day's work"] * len(theirs)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    with pytest.raises(RunError, match=r"holds chapter\.tex, which no run wrote"):
        run_folder.save(record(), tmp_path / "thesis", replace=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="is a file, a run needs a folder"):
        run_folder.save(record(), tmp_path / "file", replace=True)


def test_a_link_to_a_folder_stays_one(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    for _ in range(2):
        run_folder.save(record(), tmp_path / "run")
        assert (tmp_path / "run").is_symlink()
        assert run_folder.load(tmp_path / "disk").fingerprint == record().fingerprint
    assert {p.name for p in tmp_path.iterdir()} == {"disk", "run"}


def test_a_run_is_kept_as_utf_8_whatever_the_locale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def in_latin(encoding: str | None, stacklevel: int = 2) -> str:
        return encoding or "latin-1"

    scenario: Scenario = record().scenario.model_copy(update={"description": "north → south"})
    flown = record(scenario=scenario)
    monkeypatch.setattr(io, "text_encoding", in_latin)  # what pathlib asks for the locale's
    run_folder.save(flown, tmp_path / "run")
    assert "→" in (tmp_path / "run" / SCENARIO).read_text("utf-8")
    assert run_folder.load(tmp_path / "run").fingerprint == flown.fingerprint
