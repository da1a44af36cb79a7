"""In flown sorties: receiving is never worse than flying alone, on any rung, at any rate, however old payloads may be.

Raw images are left out, as the air does not carry them; tests/perception/surrogate has them at every age.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.stats import ttest_1samp
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

TOWNS = 6
RATES_HZ = (1.0, 2.0, 5.0, 10.0)
RUNGS = {
    "tracks": (Representation.TRACKS, 0.0),
    "detections": (Representation.DETECTIONS, 0.0),
    "features": (Representation.FEATURES, 0.1),
}
LEVEL = 0.01
"""Of each one-sided test."""

pytestmark = pytest.mark.slow


def to_all(kind: Representation, rho: float, rate_hz: float, view: FleetView) -> list[Directive]:
    return [Directive(view.ego, p, kind, rho, None, rate_hz, deadline_s=1.0, reason="to all") for p in view.peers]


def alone(view: FleetView) -> list[Directive]:
    return []


@pytest.fixture(scope="module", params=["nms", "average"])
def gains(request: pytest.FixtureRequest) -> dict[tuple[str, float], np.ndarray]:
    """AP over silence in each town, by rung and rate."""
    out: dict[tuple[str, float], list[float]] = {}
    rungs = RUNGS if request.param == "nms" else ("tracks", "detections")  # the rule does not concern maps
    for town in range(TOWNS):
        scenario = example(
            "perception.detector=surrogate",
            "perception.max_age_s=2",
            f"perception.join={request.param}",
            f"perception.scene.seed={900 + town}",
            "duration_s=8",
        )
        ap = {
            name: outcome(run_sortie(scenario, policy, town + 1))["ap50"]["full_scene"]
            for name, policy in [
                (("", 0.0), alone),
                *(((r, hz), partial(to_all, *RUNGS[r], hz)) for r in rungs for hz in RATES_HZ),
            ]
        }
        silence = ap.pop(("", 0.0))
        for name, value in ap.items():
            out.setdefault(name, []).append(value - silence)
    return {name: np.array(values) for name, values in out.items()}


def test_receiving_is_never_worse_than_flying_alone(gains: dict[tuple[str, float], np.ndarray]) -> None:
    worse = {
        name: gain.tolist() for name, gain in gains.items() if ttest_1samp(gain, 0.0, alternative="less").pvalue < LEVEL
    }
    assert not worse


def test_boxes_are_worth_sending_at_any_rate(gains: dict[tuple[str, float], np.ndarray]) -> None:
    """The paper's lowest rung, detections at 2 Hz, was worse than silence."""
    for rung in ("tracks", "detections"):
        for hz in RATES_HZ:
            assert gains[rung, hz].mean() > 0.0, (rung, hz)
