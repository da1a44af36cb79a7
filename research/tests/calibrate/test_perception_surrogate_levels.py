"""The last step of a fit: AP that was planted is met again, group by group."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from perception_examples import capture
from surrogate_examples import detector_runs

from research.calibrate.levels import BOUNDS, group_of, level, longer
from research.calibrate.plan import DetectorJob
from sortie.perception.surrogate.model import KINDS, SHIPPED, load
from sortie.perception.types import Share

EGO, ASKEW = capture(0.0, 0.0), capture(0.0, 0.0, yaw=0.5)
PEER, OLD = capture(10.0, 0.0, drone=1), capture(10.0, 0.0, drone=1, t_s=4.8)


def job(rho: float, ego: object = EGO, **other: object) -> DetectorJob:
    share = Share(PEER, "features", rho, None, 1.0)._replace(**other)  # type: ignore[arg-type]
    return DetectorJob(ego, (share, share), "masked", "")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("detector_job", "group"),
    [
        (DetectorJob(EGO, (), "masked", ""), 1),
        (DetectorJob(ASKEW, (), "masked", ""), 0),
        (job(0.01), 3),
        (job(0.01, ASKEW), 2),
        (job(0.015), 3),
        (job(0.016), 5),
        (job(0.5), 5),
        (job(1.0), 7),
        (job(1.0, ASKEW), 6),
        (job(0.5, weight=0.5), None),
        (job(0.5, roi=(0.0, 0.0, 32.0)), None),
        (job(0.5, capture=OLD), None),
        (job(0.5, missing=(3,)), None),
        (job(0.5, representation="detections"), None),
        (replace(job(0.5), unsent="zero"), None),
    ],
)
def test_plain_jobs_are_grouped_by_how_much_is_sent_and_how_the_drone_flies(
    detector_job: DetectorJob, group: int | None
) -> None:
    assert group_of(detector_job) == group


def test_two_budgets_are_no_plain_job() -> None:
    some, more = job(0.1).shares[0], job(0.2).shares[0]
    assert group_of(replace(job(0.1), shares=(some, more))) is None


@pytest.mark.slow
def test_residuals_that_are_too_short_or_too_long_get_their_length_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drones alone and with whole maps, whose boxes lie off by 1.2 times, and 0.9 times, what the fit says; by the same luck, so
    that nothing else tells them apart."""
    monkeypatch.setattr("research.calibrate.levels.DRAWS", 1)
    parameters = load(SHIPPED)
    planted = np.ones(KINDS)
    planted[[0, 1]], planted[[6, 7]] = 1.2, 0.9
    theirs = detector_runs(longer(parameters, planted), 50, lambda j: group_of(j) in (0, 6), draw=0)
    steps: list[tuple[int, int]] = []
    found = level(parameters, theirs, 0, 0.1, lambda *at: steps.append(at))
    factor = (found.residuals[..., :5] / np.where(parameters.residuals == 0, 1, parameters.residuals)[..., :5]).max(
        axis=(1, 2)
    )
    assert factor[0] == pytest.approx(1.2, abs=0.03)
    assert factor[6] == pytest.approx(0.9, abs=0.03)
    assert factor[[2, 3, 4, 5]].tolist() == [1.0] * 4, "nothing is known of them"
    np.testing.assert_array_equal(found.residuals[..., 5], parameters.residuals[..., 5])
    assert steps[0][0] == 0
    assert steps[-1][0] == steps[-1][1]


def test_factors_stay_within_their_bounds() -> None:
    """A detector that finds nothing: no residual is long enough for that."""
    parameters = load(SHIPPED)
    blind = [replace(a, boxes=[b.take(np.zeros(0, int)) for b in a.boxes]) for a in detector_runs(parameters, 3)]
    found = level(parameters, blind, 0, 0.1, lambda done, of: None)
    np.testing.assert_allclose(found.residuals[0, :, :5], BOUNDS[1] * parameters.residuals[0, :, :5], rtol=1e-5)
