"""Misses that hang together: the factor of a detector whose own is known is found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surrogate_examples import detector_runs

from research.calibrate.correlation import estimate_shared, fit_correlation, fit_shared_false_positives
from sortie.perception.surrogate.model import SHIPPED, Parameters, load
from sortie.scenarios.shipped import CALIBRATION, NETWORKS

BASE = np.array([0.2, 0.25, 0.2, 0.0], np.float32)


@pytest.mark.slow
def test_a_detector_whose_misses_hang_together_more_gets_a_larger_factor() -> None:
    """Of forty scenes: of ten the gain is uncertain by as much as a factor is worth. The coarse network's calibration, which
    misses more cars: with the fine one's a factor is worth less than that."""
    parameters = replace(load(NETWORKS / f"disconet{CALIBRATION}"), alike=BASE)
    factors = []
    for times in (0.0, 3.5):
        steps: list[tuple[int, int]] = []
        found = fit_correlation(
            parameters,
            detector_runs(replace(parameters, alike=times * BASE), 40),
            0,
            0.1,
            lambda *at, steps=steps: steps.append(at),
        )
        factors.append(float(found.alike[0] / BASE[0]))
        np.testing.assert_allclose(found.alike[:3], np.minimum(factors[-1] * BASE, 0.95)[:3], rtol=1e-5)
        assert steps[0][0] == 0
        assert steps[-1][0] == steps[-1][1]
    assert 1.0 <= factors[0] < factors[1] - 0.5
    assert factors[1] <= 3.5


@pytest.mark.parametrize(
    ("part", "low", "high"), [pytest.param(0.0, 0.0, 0.1, marks=pytest.mark.slow), (0.5, 0.25, 0.5)]
)
def test_the_part_of_the_cars_that_lie_off_for_all_is_found_again(part: float, low: float, high: float) -> None:
    parameters = replace(load(SHIPPED), alike=BASE)
    theirs = detector_runs(replace(parameters, alike=np.append(BASE[:3], np.float32(part))), 20)
    found = fit_correlation(parameters, theirs, 0, 0.1, lambda done, of: None)
    assert low <= float(found.alike[3]) <= high


@pytest.mark.parametrize(("wanted", "factor"), [(0.06, 1.0), (0.035, 1.5), (0.0325, 1.625), (-1.0, 3.5)])
def test_between_two_factors_the_gain_is_straight(
    monkeypatch: pytest.MonkeyPatch, wanted: float, factor: float
) -> None:
    """Gains of 0.055 − 0.02 (factor − 0.5), planted, and of 0.3 − 0.2 part: found on the line, at either end where they do
    not reach so far."""
    parameters = replace(load(SHIPPED), alike=BASE)

    def gain(of: Parameters, *about: object, own: bool = False) -> float:
        if about[-1] == "average":
            return 0.25 if own else 0.3 - 0.2 * float(of.alike[3])
        return wanted if own else 0.055 - 0.02 * (float(of.alike[0] / BASE[0]) - 0.5)

    monkeypatch.setattr("research.calibrate.correlation._gain", gain)
    found = fit_correlation(parameters, [], 0, 0.1, lambda done, of: None)
    assert float(found.alike[0] / BASE[0]) == pytest.approx(factor, rel=1e-4)
    assert float(found.alike[3]) == pytest.approx(0.25, rel=1e-4)


@pytest.mark.parametrize(("part", "chance"), [(0.5, 0.3), (0.9, 0.7), (1.0, 0.25)])
def test_what_alarms_have_in_common_is_found_from_how_many_have_them(part: float, chance: float) -> None:
    rng = np.random.default_rng(1)
    shared = rng.random(200_000) < part
    seen = np.where(shared, rng.binomial(4, chance, size=len(shared)), 0)
    assert estimate_shared(seen.tolist(), 4) == pytest.approx((part, chance), abs=0.01)


def test_where_nobody_shares_an_alarm_there_are_no_shared_false_positives() -> None:
    assert estimate_shared([0, 0, 0], 4) == (0.0, 1.0)
    assert estimate_shared([], 4) == (0.0, 1.0)
    assert estimate_shared([4, 4], 4) == (1.0, 1.0)


@pytest.mark.parametrize(("part", "chance"), [(0.0, 1.0), pytest.param(0.5, 0.3, marks=pytest.mark.slow), (0.9, 0.8)])
def test_a_fleet_of_known_shared_false_positives_is_measured_as_such(part: float, chance: float) -> None:
    planted = replace(load(SHIPPED), shared_false_positives=np.array([part, chance, 0.4, 0.1], np.float32))
    found = fit_shared_false_positives(detector_runs(planted, 40), planted.floor, 0)
    # how often another has it too: some stand so near a car that was missed that they are taken for it
    assert 0.75 * part * chance <= found[0] * found[1] <= part * chance + 0.02
    if part:
        assert found[1] == pytest.approx(chance, abs=0.1)
        assert found[2] == pytest.approx(0.4, abs=0.1)
        assert found[3] == pytest.approx(0.1, abs=0.03)
