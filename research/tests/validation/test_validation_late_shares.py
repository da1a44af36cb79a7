"""Fusing what arrived is never worse than leaving it out: every rung, age and rate, on towns that fitted nothing."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from research.validation import late_shares
from research.validation.late_shares import RUNGS, Case
from sortie.perception.joining import Rule

TOWNS = 20
LEVEL = 0.01
"""Of each one-sided test."""


@pytest.fixture(
    scope="module",
    params=[pytest.param(rule, marks=pytest.mark.slow) for rule in get_args(Rule)],
)
def gains(request: pytest.FixtureRequest) -> dict[Case, np.ndarray]:
    return late_shares.gains(request.param, TOWNS)


@pytest.mark.parametrize("rung", RUNGS)
def test_fusing_what_arrived_is_never_worse_than_leaving_it_out(gains: dict[Case, np.ndarray], rung: str) -> None:
    worse = {
        age: (float(gain.mean()), p)
        for (name, age), gain in gains.items()
        if name == rung and (p := float(ttest_1samp(gain, 0.0, alternative="less").pvalue)) < LEVEL
    }
    assert not worse


def test_what_is_fresh_is_worth_most(gains: dict[Case, np.ndarray]) -> None:
    for rung in RUNGS:
        assert gains[rung, "0 s"].mean() > gains[rung, "0.3 s"].mean() + 0.02
        assert gains[rung, "10 Hz"].mean() > gains[rung, "2 Hz"].mean()
