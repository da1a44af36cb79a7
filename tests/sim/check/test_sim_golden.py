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
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

GOLDEN = Path(__file__).parent / "golden"
LEFT_OUT = {"fingerprint", "version", "own_files", "wall_s", "realtime_factor", "policy_eval_us"}
"""Wall clock, and what changes with every release; figures may differ in the last bits between processors."""


def figures(result: dict[str, Any]) -> dict[str, float | str]:
    """An outcome as flat dotted figures."""
    flat: dict[str, float | str] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{prefix}.{key}" if prefix else key, inner)
        elif isinstance(value, list):
            for i, inner in enumerate(value):
                walk(f"{prefix}.{i}", inner)
        elif value is not None:
            flat[prefix] = value

    walk("", {k: v for k, v in result.items() if k not in LEFT_OUT})
    return flat


def same(a: float | str, b: float | str) -> bool:
    """Equal, or numbers that differ in their last bits only."""
    return a == b or (not isinstance(a, str) and not isinstance(b, str) and math.isclose(a, b, rel_tol=1e-6))


@pytest.mark.parametrize("name", ["track_target", "paper_replay"])
def test_the_library_flies_as_it_did(name: str, request: pytest.FixtureRequest) -> None:
    got = figures(outcome(run_sortie(load(name, ["perception.detector=none"]))))
    path = GOLDEN / f"{name}.json"
    if request.config.getoption("--update-golden"):
        path.write_text(json.dumps(got, indent=1) + "\n")
        pytest.skip(f"wrote {path.name}")
    expected = json.loads(path.read_text())
    assert set(got) == set(expected)
    moved = {k: (expected[k], v) for k, v in got.items() if not same(expected[k], v)}
    assert not moved, "figures moved; if they should have, renew them and say why in CHANGELOG.md"
