"""The interval of `sortie compare` covers what it promises, counted anew from the stored sorties."""

from __future__ import annotations

import pytest

from research.validation import compare_coverage


@pytest.mark.parametrize("run", compare_coverage.FIRST_SEED)
def test_the_printed_interval_covers_the_true_difference(run: str) -> None:
    """Over the 200 repetitions of a run within three standard errors (1.1 points) of 95 %, over random eights 93 to 97 %."""
    assert abs(compare_coverage.covered(run, compare_coverage.printed).mean() - 0.95) < 3 * 0.011
    shares = compare_coverage.eights(run, 2000).mean(axis=0)
    assert 0.93 < shares.min() <= shares.max() < 0.97
