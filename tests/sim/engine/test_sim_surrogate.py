"""A sortie with the surrogate: scored as it flies, alike whoever watches, and the outcome names what scored it."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pyarrow as pa
from recorded import recorded
from sim_examples import example

from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

SHORT = ("duration_s=3", "fleet.drones=3", "mission.phases=[{}]", "perception.detector=surrogate")
"""Flights of their own: they differ from the recorded one in who watches, who flies, and when they end."""


class Watcher:
    """Counts the fusions that it is shown, second by second."""

    def __init__(self) -> None:
        self.fusions: list[int] = []

    def begin(self, scenario: Any, scene: Any) -> None:
        pass

    def second(self, t_s: float, new: dict[str, pa.Table]) -> None:
        self.fusions.append(new["fusions"].num_rows)


def test_a_watched_sortie_is_the_same_and_is_scored_as_it_flies() -> None:
    watcher = Watcher()
    assert run_sortie(example(*SHORT), observer=watcher).fingerprint == run_sortie(example(*SHORT)).fingerprint
    assert sum(watcher.fusions) == 3 * 2 * 3
    assert max(watcher.fusions) <= 6


def test_the_outcome_names_what_scored_it_and_sharing_pays() -> None:
    result = outcome(recorded("surrogate"))
    assert result["ap50"]["detector"] == "surrogate"
    assert result["ap50"]["calibration"].startswith("disconet-")
    assert outcome(recorded("base"))["ap50"]["calibration"] is None
    alone = outcome(run_sortie(example("perception.detector=surrogate"), "silence"))
    assert 0.05 < alone["ap50"]["full_scene"] < result["ap50"]["full_scene"] < 0.9


def test_a_sortie_s_boxes_do_not_depend_on_its_end_nor_on_who_else_flies() -> None:
    """The area flown is larger then, and has more cars."""

    def boxes(*overrides: str) -> list[dict[str, Any]]:
        scenario = load(
            "track_target", [*SHORT, "duration_s=4", "fleet.drones=5", "perception.sample_rate_hz=1", *overrides]
        )
        return run_sortie(scenario, "silence").tables["detections"].to_pylist()

    plain = boxes()
    assert len(plain) > 100
    assert [b for b in boxes("duration_s=6") if b["t_s"] < 4.0] == plain
    assert [b for b in boxes("fleet.drones=6") if b["drone"] == 0] == [b for b in plain if b["drone"] == 0]


def test_it_flies_without_torch() -> None:
    code = (
        "import sys\nfrom sortie.scenarios.reading.load import load\nfrom sortie.sim.engine.sortie import run_sortie\n"
        "run_sortie(load('track_target', ['duration_s=1', 'perception.detector=surrogate']))\n"
        "print('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
