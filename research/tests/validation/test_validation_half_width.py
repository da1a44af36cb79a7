"""Comparisons to a half-width: their intervals contain the truth as often as the page says."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from research.validation import half_width_coverage
from research.validation.stored import FOLDER


def test_the_measured_cover_is_that_of_the_plan() -> None:
    """Hypotheses 1 and 3 and the bias at fixed numbers of units, read from the stored tables."""
    tables = json.loads((FOLDER / "half_width.json").read_text("utf-8"))["tables"]
    cases = {name: figures for name, *figures in tables["half_width"]["rows"]}
    error = math.sqrt(0.95 * 0.05 / half_width_coverage.REPETITIONS)
    for name, (printed, _, off, *_) in cases.items():
        slack = 0 if name.startswith("all ") else 2 * error
        assert 0.93 - slack <= printed <= 0.97 + slack, name
        assert abs(off) <= 0.1, name
    each, one = (figure for _, figure in tables["fixed_units"]["rows"])
    assert abs(each[0]) < 3 * (each[2] - each[0]) / 1.96
    assert abs(one[0]) > 3 * (one[2] - one[0]) / 1.96


@pytest.mark.parametrize(("correlation", "paired"), [(0.0, 37), (0.9, 17)])
def test_it_covers_and_uses_what_helps(correlation: float, paired: int) -> None:
    """120 repetitions; three standard errors."""
    source = half_width_coverage.made(np.random.default_rng(8), "normal", correlation, 0.01 * math.sqrt(30) / 1.96)
    found = half_width_coverage.repeated(source, 0.0, 0.01, 120).mean(axis=0)
    assert abs(found[0] - 0.955) < 3 * math.sqrt(0.955 * 0.045 / 120)
    assert found[3] == pytest.approx(paired, rel=0.12)
    assert (found[5] > 0.9) == (correlation == 0.9)


def test_sorties_are_those_of_the_second_run() -> None:
    gains = half_width_coverage.sorties("all-4 mission", "silence mission")
    assert gains.shape == (2000, 2)
    assert np.corrcoef(gains.T)[0, 1] == pytest.approx(0.83, abs=0.005)
