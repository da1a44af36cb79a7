"""A run's folder: which sortie it takes, and that it comes back whole."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recorded import recorded
from sim_examples import example

from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.run_folder import OtherRunError, ensure_usable, load, save


@pytest.fixture(scope="module")
def flown() -> SortieRecord:
    return run_sortie(example("duration_s=0.5", "mission.phases=[{at_s: 0, phase: search}]", "fleet.drones=2"))


def test_a_folder_takes_the_same_sortie_again_and_no_other(tmp_path: Path, flown: SortieRecord) -> None:
    path = tmp_path / "run"

    def ensure(scenario: Scenario = flown.scenario, seed: int = flown.seed, replication: int = 0) -> None:
        ensure_usable(path, scenario, seed, replication, replace=False)

    ensure()  # nothing there
    save(flown, path)
    ensure()
    params = flown.scenario.policy.model_copy(update={"params": {"rho": 0.5}})
    another = flown.scenario.model_copy(update={"policy": params})
    others: list[dict[str, Any]] = [{"seed": 9}, {"replication": 2}, {"scenario": another}]
    words = re.escape(f"{path}: holds another run; choose another folder, or replace it with --replace")
    for other in others:
        with pytest.raises(OtherRunError, match=words):
            ensure(**other)
    ensure_usable(path, flown.scenario, 9, 0, replace=True)


def test_a_damaged_run_is_replaced_only_where_that_is_asked(tmp_path: Path, flown: SortieRecord) -> None:
    path = save(flown, tmp_path / "run")
    (path / "outcome.json").write_text("{}")
    with pytest.raises(RunError, match=r"run: the run is damaged: outcome.json: fingerprint is None"):
        ensure_usable(path, flown.scenario, flown.seed, 0, replace=False)
    with pytest.raises(OtherRunError):
        save(flown, path)
    save(flown, path, replace=True)
    assert load(path).fingerprint == flown.fingerprint


def test_a_run_comes_back_whole(tmp_path: Path, flown: SortieRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in many row groups, and with all that is told beside the tables."""
    monkeypatch.setattr("sortie.sim.results.spool._ROW_GROUP_BYTES", 100)
    states = flown.tables["states"]
    cut = {**flown.tables, "states": pa.concat_tables([states.slice(k, 2) for k in range(0, states.num_rows, 2)])}
    told = replace(flown, tables=cut, calibration="fit 7", metrics={"m": None, "n": 2.0}, own_files={"a": "b"})
    save(told, tmp_path / "run")
    back = load(tmp_path / "run")
    for name in ("policy", "seed", "replication", "version", "detector", "calibration", "metrics", "own_files"):
        assert getattr(back, name) == getattr(told, name)
    assert (back.totals, back.wall) == (flown.totals, flown.wall)
    assert back.fingerprint == flown.fingerprint
    assert back.tables["states"].equals(states.combine_chunks())


def test_a_run_that_lacks_a_table_that_its_scenario_keeps_is_damaged(tmp_path: Path) -> None:
    run = save(recorded("members"), tmp_path / "run")
    assert {"views", "beliefs", "rosters", "disagreement"} < load(run).tables.keys()
    for name in ("views", "view_descriptors", "view_directives", "beliefs", "rosters", "disagreement", "states"):
        file = run / f"{name}.parquet"
        whole = file.read_bytes()
        file.unlink()
        with pytest.raises(ValueError, match=f"the run is damaged: .*{name}.parquet"):
            load(run)
        first = pq.read_schema(pa.BufferReader(whole)).names[0]
        pq.write_table(pq.read_table(pa.BufferReader(whole)).drop_columns([first]), file)
        with pytest.raises(ValueError, match=f"{name}.parquet has no column {first}"):
            load(run)
        file.write_bytes(whole)
