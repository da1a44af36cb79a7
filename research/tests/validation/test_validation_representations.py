"""The measurement of representations: its plan, its rules, and its bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from research.train.box_errors import Calibration
from research.validation.representations import BOX_WAYS, SILENCE, Row, Way, difference, read_plan, verdicts

PLAN = read_plan()
CALIBRATED = Calibration(1000, (0.7, 0.95), (0.4, 0.87))


def row(way: Way, ap: float, spread: float = 0.001) -> Row:
    draws = ap + spread * np.random.default_rng(0).normal(size=200)
    return Row(way, 1.0, ap, ap - spread, ap + spread, draws)


def rows(**moved: float) -> list[Row]:
    """As the hypotheses expect them; `moved` by label, with _ for what is no letter."""
    boxes = [row(way, {"detections, averaged": 0.6, "uncertain boxes": 0.6}.get(way.label, 0.4)) for way in BOX_WAYS]
    features = [row(Way("features", f"features, ρ = {r:g}", r), 0.4 + 0.1 * r) for r in PLAN.rho]
    codes = [
        row(Way("codes", f"codes of {n} B, ρ = {r:g}", r, n), 0.399 + 0.1 * r)
        for n in PLAN.code_bytes
        for r in PLAN.rho
    ]
    every = [row(SILENCE, 0.3), *boxes, *features, *codes]
    keys = {"".join(c if c.isalnum() else "_" for c in r.way.label): r for r in every}
    for key, ap in moved.items():
        keys[key] = replace(keys[key], ap=keys[key].ap + ap, draws=keys[key].draws + ap)
    return list(keys.values())


def test_a_difference_is_paired() -> None:
    delta, low, high = difference(rows(), "uncertain boxes", "detections, averaged")
    assert (delta, low, high) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize(
    ("moved", "calibrated", "fails"),
    [
        ({}, CALIBRATED, None),
        ({"codes_of_10_B__ρ___0_05": -0.02}, CALIBRATED, 0),
        ({"codes_of_5_B__ρ___1": -0.03}, CALIBRATED, 1),
        ({"codes_of_5_B__ρ___0_25": -0.024}, CALIBRATED, 2),
        ({"uncertain_boxes": -0.02}, CALIBRATED, 3),
        ({"uncertain_boxes__anything_in_common": 0.25}, CALIBRATED, 4),
        ({"features__ρ___1": 0.13}, CALIBRATED, 5),
        ({}, replace(CALIBRATED, within=(0.7, 0.98)), 6),
    ],
)
def test_each_hypothesis_falls_by_its_own_rule(
    moved: dict[str, float], calibrated: Calibration, fails: int | None
) -> None:
    found = verdicts(PLAN, rows(**moved), calibrated)
    assert len(found) == len(PLAN.hypotheses)
    wrong = [k for k, holds in enumerate(found) if not holds]
    assert fails in wrong if fails is not None else not wrong
