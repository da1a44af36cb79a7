"""A detector's runs as rows to fit: each job by its own ranking and filling, and none of boxes that were sent."""

from __future__ import annotations

import numpy as np
import pytest
from perception_examples import capture

from research.calibrate import rows as making
from research.calibrate.collect import DetectorRuns
from research.calibrate.plan import DetectorJob
from research.calibrate.rows import FitRows, rows_of
from sortie.perception.ground_truth import ground_truth
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.exchange import FUSED_COVARIATES, cell_of
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.types import Boxes, Share
from sortie.scenarios.schema import Scene

TOWN = SceneModel(Scene(parked_density=0.4), None, (-60.0, -60.0, 60.0, 60.0))
EGO, PEER = capture(10.0, 20.0, yaw=0.3), capture(25.0, 10.0, yaw=0.4, drone=1)
MAP, SENT = Share(PEER, "features", 0.5, None, 1.0), Share(PEER, "detections", 0.0, None, 1.0)
JOBS = [
    DetectorJob(EGO, (MAP,), "masked", ""),
    DetectorJob(EGO, (SENT,), "masked", ""),
    DetectorJob(EGO, (MAP,), "zero", ""),
    DetectorJob(EGO, (), "masked", ""),
]
RANKS = {c: np.random.default_rng(k).normal(size=(64, 64)).astype(np.float32) for k, c in enumerate((EGO, PEER))}


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> FitRows:
    """Every car is found in every job, and one place where there is none; a weak box of another."""
    monkeypatch.setattr(making, "scene_model", lambda *at: TOWN)
    truth = ground_truth(TOWN.cars_at(EGO.t_s).table(), EGO.true_pose)
    n = len(truth)
    false = Boxes(np.array([[10.0, 500.0], [10.0, 600.0]]), np.ones((2, 2)), np.zeros(2), np.array([0.4, 0.1]))
    found = Boxes(truth.xy_m, truth.size_m, truth.yaw_rad, np.linspace(0.9, 0.3, n))
    boxes = [Boxes.join([found, false])] * len(JOBS)
    return rows_of(DetectorRuns("fit", 0, JOBS, boxes, RANKS), 0.2)


def column(rows: FitRows, job: int, name: str) -> np.ndarray:
    return np.asarray(rows.fused[rows.fused_job == job][:, FUSED_COVARIATES.index(name)])


def test_a_car_ranks_by_its_best_cell_among_all_of_its_drone(made: FitRows) -> None:
    looks = Eyes(TOWN).look(CaptureColumns.of([EGO, PEER]))
    row, col = cell_of(looks.xy_m)
    for k, c in enumerate((EGO, PEER)):
        for i in np.flatnonzero(looks.capture == k).tolist():
            about = [RANKS[c][r, s] for r, s in zip(row[i], col[i], strict=True)]
            best = max(about)
            assert made.confidence[i] == best
            assert made.above[i] == pytest.approx((RANKS[c] > best).mean())
            assert made.look_cars[i] == (looks.capture == k).sum()


def test_what_is_about_a_car_is_told_by_the_ranking_that_chose(made: FitRows) -> None:
    """Its rank decides which cells went, and how deep among them its cell lies."""
    looks = Eyes(TOWN).look(CaptureColumns.of([EGO, PEER]))
    above = made.above
    for job in (0, 2):
        mine = made.fused_look[made.fused_job == job]
        peer = looks.index[1, looks.car[mine]]
        senders = column(made, job, "senders")
        expected = (peer >= 0) & (above[peer] < 0.5)
        np.testing.assert_array_equal(senders > 0, expected)
        deep = np.clip(np.log(0.5) - np.log(np.maximum(above[peer], 1e-4)), 0, 6)
        np.testing.assert_allclose(
            column(made, job, "margin"),
            np.where(expected, deep, 0),
            atol=1e-5,
        )
        assert 0 < expected.sum() < len(expected)


def test_only_where_cells_are_filled_with_zeros_do_silent_ones_take_part(made: FitRows) -> None:
    for job, there in ((0, False), (2, True), (3, False)):
        assert bool(column(made, job, "silent").any()) is there


def test_boxes_that_were_sent_are_no_rows_to_fit(made: FitRows) -> None:
    assert np.isnan(made.job).all(axis=1).tolist() == [False, True, False, False]
    assert np.isfinite(made.job[[0, 2, 3]]).all()
    assert set(made.fused_job.tolist()) == set(made.alarm_job.tolist()) == {0, 2, 3}
    cars = int((made.fused_job == 0).sum())
    assert [len(v) for v in (made.score, made.offset, made.shift, made.heading, made.xy_m, made.fused_look)] == [
        3 * cars
    ] * 6
    assert (made.score > 0).sum() >= 0.9 * 3 * cars
    assert made.alarm[:, 5].tolist().count(0.4) == 3
    assert made.alarm[:, 5].min() > 0.2
