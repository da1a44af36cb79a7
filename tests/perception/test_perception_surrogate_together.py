"""Misses that hang together: the factor of a detector whose own is known is found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from perception.surrogate.collect import Asked
from perception.surrogate.detector import SurrogateDetector
from perception.surrogate.model import SHIPPED, Parameters, load
from perception.surrogate.plan import draw_scene, moment, scene_model
from perception.surrogate.together import hang_together
from scenarios.schema import Perception

BASE = np.array([0.2, 0.25, 0.2], np.float32)


def asked(parameters: Parameters, scenes: int) -> list[Asked]:
    """What a surrogate would have answered where the detector is asked."""
    out = []
    for scene in range(scenes):
        jobs = [j for j in moment(0, "fit", scene, 0).jobs if not j.shares]
        detector = SurrogateDetector.of(
            scene_model(draw_scene(0, "fit", scene)), Perception(score_threshold=0.1), parameters, 1, 5
        )
        boxes = list(detector.detect_many([[(j.ego, ())] for j in jobs]))
        out.append(Asked("fit", scene, jobs, boxes, {}))
    return out


@pytest.mark.parametrize(("of_theirs", "low", "high"), [(0.0, 1.0, 1.3), (3.0, 2.0, 3.5)])
def test_the_factor_of_a_known_detector_is_found_again(of_theirs: float, low: float, high: float) -> None:
    parameters = replace(load(SHIPPED), alike=BASE)
    theirs = asked(replace(parameters, alike=of_theirs * BASE), 10)
    told: list[tuple[int, int]] = []
    found = hang_together(parameters, theirs, 0, 0.1, lambda done, of: told.append((done, of)))
    factor = float(found.alike[0] / BASE[0])
    assert low <= factor <= high
    np.testing.assert_allclose(found.alike, np.minimum(factor * BASE, 0.95), rtol=1e-5)
    assert told[0][0] == 0
    assert told[-1][0] == told[-1][1]


@pytest.mark.parametrize(("wanted", "factor"), [(0.06, 1.0), (0.035, 1.5), (0.0325, 1.625), (-1.0, 3.5)])
def test_between_two_factors_the_gain_is_straight(
    monkeypatch: pytest.MonkeyPatch, wanted: float, factor: float
) -> None:
    """Gains of 0.055 − 0.02 (factor − 0.5), planted: found on the line, at either end where they do not reach so far."""
    parameters = replace(load(SHIPPED), alike=BASE)

    def gain(of: Parameters, *_: object, own: bool = False) -> float:
        return wanted if own else 0.055 - 0.02 * (float(of.alike[0] / BASE[0]) - 0.5)

    monkeypatch.setattr("perception.surrogate.together._gain", gain)
    found = hang_together(parameters, [], 0, 0.1, lambda done, of: None)
    assert float(found.alike[0] / BASE[0]) == pytest.approx(factor, rel=1e-4)
