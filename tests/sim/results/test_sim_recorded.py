"""The flights that tests share: flown once however many ask, kept whole, and flown again by other code."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from recorded import FLIGHTS, MOST_CODES, folder_of_code, kept, recorded
from sim_examples import example

from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord

SHORT = example("duration_s=0.2", "mission.phases=[{at_s: 0}]", "fleet.drones=2")


def test_a_flight_is_flown_once_however_many_ask_and_again_for_another_scenario(tmp_path: Path) -> None:
    flown: list[Scenario] = []

    def fly(scenario: Scenario) -> SortieRecord:
        flown.append(scenario)
        return run_sortie(scenario)

    with ThreadPoolExecutor(4) as workers:
        records = list(workers.map(lambda _: kept("short", SHORT, tmp_path, fly), range(4)))
    assert len(flown) == 1
    assert {record.fingerprint for record in records} == {run_sortie(SHORT).fingerprint}
    kept("short", SHORT.model_copy(update={"seed": 2}), tmp_path, fly)
    assert [scenario.seed for scenario in flown] == [1, 2]


def test_other_code_has_another_folder_and_few_are_kept(tmp_path: Path) -> None:
    folders = [folder_of_code(tmp_path, f"code {k}") for k in range(MOST_CODES + 2)]
    assert len(set(folders)) == MOST_CODES + 2
    assert folder_of_code().name not in {folder.name for folder in folders}
    assert len([path for path in tmp_path.iterdir() if path.is_dir()]) == MOST_CODES
    assert folders[-1].exists()


def test_each_flight_has_the_rows_for_which_it_is_kept() -> None:
    wanted = {
        "faults": {"events", "drops"},
        "lost_drone": {"events"},
        "members": {"events", "view_descriptors", "beliefs", "rosters", "disagreement"},
        "person": {"people"},
        "relay": {"topology"},
    }
    lacking = {}
    for name in FLIGHTS:
        record = recorded(name)
        tables = {"states", "descriptors", "directives", *wanted.get(name, ())}
        tables |= {"fusions", "truths"} if record.detector != "none" else set()
        if none := {table for table in tables if not record.tables[table].num_rows}:
            lacking[name] = none
    assert lacking == {}
