"""The parameters of lateness are those of the plan's fit, and the model follows what was observed."""

from dataclasses import fields

import numpy as np
import pytest

from research.validation.joining_age import AGES_S, TOWNS, Kept, chance, fitted, observed
from sortie.perception.lateness import MOVING, SIGMA0_M, SPEED_MPS, still_right


def test_lateness_is_what_the_calibration_towns_show() -> None:
    """The fit lies within twice its standard error, as eighths of the towns show it, of what rounds to the parameters; towns are
    what was drawn independently."""
    eighths = [observed(range(k, TOWNS, 8)) for k in range(8)]
    kept = Kept(*(np.concatenate([getattr(e, f.name) for e in eighths]) for f in fields(Kept)))
    error = np.std([fitted(e) for e in eighths], axis=0, ddof=1) / np.sqrt(8)
    assert (error < (0.01, 0.3, 0.05)).all()
    rounding = np.array((0.005, 0.05, 0.005))
    assert (np.abs(np.array(fitted(kept)) - (SIGMA0_M, SPEED_MPS, MOVING)) < 2 * error + rounding).all()
    for age_s in AGES_S:
        at = kept.age_s == age_s
        model = still_right(kept.reach_m[at], age_s).mean()
        assert model == pytest.approx(kept.right[at].mean(), abs=0.03)
        np.testing.assert_allclose(
            still_right(kept.reach_m[at], age_s), chance(kept.reach_m[at], kept.age_s[at], SIGMA0_M, SPEED_MPS, MOVING)
        )
