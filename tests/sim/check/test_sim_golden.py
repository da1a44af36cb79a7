"""Golden outcomes: the library's figures as they stood, renewed only by `pytest --update-golden`.

A moved figure is told in CHANGELOG.md under *Changed behaviour*, with why.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from sortie.scenarios.reading.load import load
from sortie.sim.check import golden
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

GOLDEN = Path(__file__).parent / "golden"


def figures(result: dict[str, Any]) -> dict[str, float | str]:
    """An outcome as golden files have it, without figures that have no value."""
    return {name: value for name, value in golden.figures(result).items() if value is not None}


def same(name: str, a: float | str, b: float | str, *, network: bool) -> bool:
    """Equal, or numbers that differ in their last bits only; with a `network`, boxes differ at the threshold."""
    if isinstance(a, str) or isinstance(b, str):
        return a == b
    of_boxes = network and (name.startswith(("ap50.", "tracking.", "phases.", "mission.target_")) or ".ap50." in name)
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=NETWORK_TOLERANCE if of_boxes else 0.0)


SHORT = ("duration_s=6", "mission.phases=[{at_s: 0, phase: search}, {at_s: 3, phase: track, region: {radius_m: 32}}]")
SEEN = ("fleet.drones=3", "perception.sample_rate_hz=2", "policy.params={rho: 0.1}")
"""Few drones and instants: a network takes a tenth of a second for each."""
NETWORK_TOLERANCE = 0.005
"""Of an average precision. Truth at the capture's time in place of the scoring's moves it by 0.03."""


CASES = {
    "track_target": ("track_target", ("perception.detector=none",)),
    "paper_replay": ("paper_replay", ("perception.detector=none",)),
    "paper_replay_contention": ("paper_replay_contention", ("perception.detector=none",)),
    "track_target_surrogate": ("track_target", ("perception.detector=surrogate", *SHORT)),
    "track_target_torch": ("track_target", ("perception.detector=torch", *SHORT, *SEEN)),
}
"""A library scenario and its settings, by the name of the file that holds the figures."""


@pytest.mark.parametrize("name", CASES)
def test_the_library_flies_as_it_did(name: str, request: pytest.FixtureRequest) -> None:
    scenario, sets = CASES[name]
    got = figures(outcome(run_sortie(load(scenario, sets))))
    path = GOLDEN / f"{name}.json"
    if request.config.getoption("--update-golden"):
        path.write_text(json.dumps(got, indent=1) + "\n")
        pytest.skip(f"wrote {path.name}")
    expected = json.loads(path.read_text())
    assert set(got) == set(expected)
    network = name.endswith("torch")
    moved = {k: (expected[k], v) for k, v in got.items() if not same(k, expected[k], v, network=network)}
    assert not moved, "figures moved; if they should have, renew them and say why in CHANGELOG.md"
