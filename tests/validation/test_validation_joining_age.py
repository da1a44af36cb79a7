"""The parameters of lateness are those of the plan's fit, and the model follows what was observed."""

import numpy as np
import pytest
from joining_age import AGES_S, TOWNS, chance, fitted, observed

from sortie.perception.lateness import MOVING, SIGMA0_M, SPEED_MPS, still_right


def test_lateness_is_what_the_calibration_towns_show() -> None:
    kept = observed(range(TOWNS))
    fit = fitted(kept)
    assert (round(fit.sigma0_m, 2), round(fit.speed_mps, 1), round(fit.moving, 2)) == (SIGMA0_M, SPEED_MPS, MOVING)
    for age_s in AGES_S:
        at = kept.age_s == age_s
        model = still_right(kept.reach_m[at], age_s).mean()
        assert model == pytest.approx(kept.right[at].mean(), abs=0.03)
        np.testing.assert_allclose(
            still_right(kept.reach_m[at], age_s), chance(kept.reach_m[at], kept.age_s[at], SIGMA0_M, SPEED_MPS, MOVING)
        )
