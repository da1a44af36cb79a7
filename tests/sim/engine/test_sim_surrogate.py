"""A sortie with the surrogate: scored afterwards, alike whoever watches, and the outcome says what scored it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa

from sortie.scenarios.reading.load import load as read
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import outcome


def short(*overrides: str) -> Scenario:
    return read(
        "track_target",
        ["duration_s=4", "mission.phases=[{at_s: 0, phase: search}]", "perception.detector=surrogate", *overrides],
    )


class Watcher:
    """Counts the fusions that it is shown, second by second."""

    def __init__(self) -> None:
        self.fusions: list[int] = []

    def begin(self, scenario: Scenario, scene: Any) -> None:
        pass

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        self.fusions.append(new["fusions"].num_rows)


def test_a_watched_sortie_is_the_same_and_is_scored_as_it_flies() -> None:
    watcher = Watcher()
    assert run_sortie(short(), observer=watcher).fingerprint == run_sortie(short()).fingerprint
    assert sum(watcher.fusions) == 4 * 2 * 5
    assert max(watcher.fusions) <= 10


def test_the_outcome_says_what_scored_it_and_a_run_keeps_it(tmp_path: Path) -> None:
    record = run_sortie(short())
    result = outcome(record)
    run_folder.save(record, tmp_path / "run")
    assert result["ap50"]["detector"] == "surrogate"
    assert result["ap50"]["calibration"].startswith("disconet-")
    assert 0.05 < result["ap50"]["full_scene"] < 0.9
    again = run_folder.load(tmp_path / "run")
    assert again.calibration == record.calibration
    assert again.fingerprint == record.fingerprint
    assert outcome(run_sortie(short("perception.detector=none")))["ap50"]["calibration"] is None


def test_sharing_pays_and_replications_differ() -> None:
    scores = [
        outcome(run_sortie(short("duration_s=20"), policy))["ap50"]["full_scene"] for policy in ("all-4", "silence")
    ]
    assert scores[0] > scores[1]
    assert run_sortie(short(), replication=1).fingerprint != run_sortie(short()).fingerprint


def test_a_sortie_s_boxes_do_not_depend_on_its_end_nor_on_who_else_flies() -> None:
    """The area flown is larger then, and has more cars."""

    def boxes(*overrides: str) -> list[dict[str, Any]]:
        return run_sortie(short("perception.sample_rate_hz=1", *overrides), "silence").tables["detections"].to_pylist()

    plain = boxes()
    assert len(plain) > 200
    assert [b for b in boxes("duration_s=6") if b["t_s"] < 4.0] == plain
    assert [b for b in boxes("fleet.drones=6") if b["drone"] == 0] == [b for b in plain if b["drone"] == 0]


def test_it_flies_without_torch() -> None:
    code = (
        "import sys\nfrom sortie.scenarios.reading.load import load\nfrom sortie.sim.engine.sortie import run_sortie\n"
        "run_sortie(load('track_target', ['duration_s=1', 'perception.detector=surrogate']))\n"
        "print('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
