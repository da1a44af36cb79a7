"""The steps between a detector's runs and a fit, by hand: whose box is whose, what was sent, pools, thresholds and order."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from perception_examples import capture, only_target

from research.calibrate import calibrate as calibrating
from research.calibrate import fit as fitting
from research.calibrate.calibrate import FLOORS, LOST
from research.calibrate.collect import FLOOR, DetectorRuns
from research.calibrate.fit import BANDS, POOL, REACH, RESIDUALS
from research.calibrate.judge import CalibrationVerdict, LevelError
from research.calibrate.plan import THRESHOLD, DetectorJob
from research.calibrate.rows import FitRows, _sent, assign_boxes
from sortie.perception import budget
from sortie.perception.surrogate.exchange import ALARM_COVARIATES
from sortie.perception.surrogate.model import BAND, SHIPPED, load
from sortie.perception.types import Boxes, Share
from sortie.scenarios.disc import Disc


def boxes(*rows: tuple[float, ...]) -> Boxes:
    """Of x, y, length, width, yaw, score."""
    table = np.array(rows, float).reshape(-1, 6)
    return Boxes(table[:, :2], table[:, 2:4], table[:, 4], table[:, 5])


def test_a_box_is_of_the_nearest_car_that_has_none_yet_best_first() -> None:
    """Boxes by the estimated pose, cars by the true heading; front and back of a box may be exchanged."""
    ego = capture(0.0, 0.0, yaw=0.2, est=(100.0, 50.0, 60.0, np.pi / 2))
    looks: Any = SimpleNamespace(
        xy_m=np.array([[10.0, 0.0], [99.0, 99.0], [12.0, 0.0]]),
        yaw_rad=np.array([0.5, 0.0, 0.2]),
        car=np.array([4, 0, 1]),
    )
    size = np.full((5, 2), 2.0)
    size[4], size[1] = (4.0, 2.0), (5.0, 1.0)
    eyes: Any = SimpleNamespace(traffic=SimpleNamespace(size_m=size))
    # the ego's frame is turned by a quarter: ahead is north
    found = boxes(
        (100.0, 60.5, 4.4, 1.8, np.pi / 2 + 0.4, 0.9), (100.0, 60.2, 4.0, 2.0, np.pi / 2, 0.8), (99.0, 60.4, 4.0, 2.0, 0.0, 0.7),
        (100.0, 80.0, 4.0, 2.0, 1.0, 0.6),
    )  # fmt: skip
    score, offset, rest = assign_boxes(ego, found, looks, np.array([0, 2]), eyes)
    assert score.tolist() == [0.9, 0.8]
    np.testing.assert_allclose(offset[0], [0.5, 0.0, 0.1, np.log(1.1), np.log(0.9)], atol=1e-9)
    np.testing.assert_allclose(offset[1], [-1.8, 0.0, 0.0, np.log(0.8), np.log(2.0)], atol=1e-9)
    np.testing.assert_allclose(
        rest, [[10.4, 1.0, 4.0, 2.0, -np.pi / 2, 0.7], [30.0, 0.0, 4.0, 2.0, 1 - np.pi / 2, 0.6]], atol=1e-9
    )
    turned = boxes((100.0, 60.0, 4.0, 2.0, np.pi / 2 + 0.3 + np.pi - 0.1, 0.9))
    assert assign_boxes(ego, turned, looks, np.array([0]), eyes)[1][0, 2] == pytest.approx(-0.1)
    assert assign_boxes(ego, turned, looks, np.zeros(0, int), eyes)[2].shape == (1, 6)


def test_what_was_sent_is_by_each_job_s_own_ranking_region_and_slot() -> None:
    """A share without weight and boxes take no slot; the region is about what the sender believes."""
    rng = np.random.default_rng(1)
    ego = capture(0.0, 0.0)
    peers = [capture(5.0, 0.0, drone=k, est=(20.0 * k, 3.0, 60.0, 0.4)) for k in (1, 2)]
    ranks = {c: rng.random((64, 64)) for c in peers}
    weightless = Share(peers[0], "features", 1.0, None, 0.0)
    one = Share(peers[0], "features", 0.4, Disc(20.0, 3.0, 40.0), 1.0)
    two = Share(peers[1], "features", 0.5, None, 0.7)
    several = (weightless, Share(peers[0], "detections", 0.0, None, 1.0), one, two)
    jobs = [DetectorJob(ego, several, "masked", "")] * 2
    n = 300
    r, c = rng.integers(64, size=n), rng.integers(64, size=n)
    row, peer = (
        np.repeat([0, 1], n // 2),
        np.stack([np.arange(n), np.where(np.arange(n) % 3, np.arange(n)[::-1], -1)], axis=1),
    )
    sent = _sent(SimpleNamespace(jobs=jobs, ranks=ranks), SimpleNamespace(row=row, peer=peer), r, c, {})  # type: ignore[arg-type]
    for i in range(n):
        for slot, share in enumerate((one, two)):
            mask = budget.select(ranks[share.capture], share.rho, share.roi, *share.capture.est_pose)
            at = peer[i, slot]
            assert sent[i, slot] == (at >= 0 and mask[r[at], c[at]])
    assert 0 < sent[:, 0].sum() < sent[:, 1].sum() < n


def test_rows_of_several_moments_are_numbered_on() -> None:
    def rows(jobs: int, looks: int, cars: list[int]) -> FitRows:
        columns: dict[str, Any] = {f.name: np.zeros(1) for f in fields(FitRows)}
        columns |= {"job": np.zeros((jobs, 2)), "look": np.zeros((looks, 3)), "look_object": np.array(cars)}
        columns |= {
            "fused_job": np.array([0, jobs - 1]),
            "alarm_job": np.array([jobs - 1]),
            "fused_look": np.array([looks - 1]),
        }
        return FitRows(**columns)

    joined = FitRows.join([rows(2, 5, [0, 7]), rows(3, 4, [3, 1]), rows(1, 2, [0])])
    assert joined.fused_job.tolist() == [0, 1, 2, 4, 5, 5]
    assert joined.alarm_job.tolist() == [1, 4, 5]
    assert joined.fused_look.tolist() == [4, 8, 10]
    assert joined.look_object.tolist() == [0, 7, 11, 9, 12]
    assert len(joined.job) == 6


def test_residuals_lie_in_bands_of_equal_vagueness_worst_first_and_none_is_too_long() -> None:
    rng = np.random.default_rng(2)
    n = 5000
    unsure, fits = rng.normal(size=n), rng.random(n)
    residuals = rng.normal(size=(n, 5))
    residuals[:, 0] = fits
    residuals[::97, 1] = 40.0
    pool = fitting._bands(residuals, unsure, fits)
    assert pool.shape == (RESIDUALS, 6)
    assert np.abs(pool[:, :5]).max() == REACH
    bands = pool.reshape(-1, BAND, 6)
    assert (np.diff(bands[:, :, 0], axis=1) >= 0).all()
    starts = bands[:, :, 5]
    assert (starts == starts[:, :1]).all()
    assert (np.diff(starts[:, 0]) > 0).all()
    vagueness = dict(zip(fits.tolist(), unsure.tolist(), strict=True))
    for k, band in enumerate(bands):
        its = [vagueness[f] for f in band[:, 0].tolist()]
        assert min(its) == starts[k, 0]
        assert k + 1 == len(bands) or max(its) <= starts[k + 1, 0]


def test_residuals_are_made_as_long_as_the_sure_boxes_ask_for() -> None:
    """As many of the boxes count, by score, as did: the sure ones fit as if residuals were 0.8 times as long, weak ones as if
    they were longer, of which there are as many."""
    rng = np.random.default_rng(3)
    n = 4000
    pool = np.concatenate([rng.normal(size=(RESIDUALS, 5)) * 0.6, np.zeros((RESIDUALS, 1))], axis=1)
    pool[:, 5] = np.repeat(np.arange(RESIDUALS // BAND), BAND)
    unsure = rng.uniform(0, RESIDUALS // BAND, n)
    spread, centre = np.tile([0.7, 0.7, 0.05, 0.02, 0.02], (n, 1)), np.zeros((n, 5))
    score = np.where(np.arange(n) % 2, 0.95, 0.02)
    drawn = centre + spread * np.where(score > 0.5, 0.8, 1.3)[:, None] * pool[rng.integers(RESIDUALS, size=n), :5]
    good = fitting._iou(drawn) >= 0.5
    assert good[score > 0.5].mean() - good[score < 0.5].mean() > 0.1
    out = fitting._as_good(pool, centre, spread, unsure, good, score, rng)
    factor = (out[:, 0] / pool[:, 0]).reshape(4, -1)
    np.testing.assert_allclose(factor, factor[:, :1] * np.ones_like(factor), rtol=1e-9)
    assert factor[:, 0] == pytest.approx([0.8] * 4, abs=0.09)
    np.testing.assert_array_equal(out[:, 5], pool[:, 5])


def test_false_alarms_are_counted_by_band_and_drawn_from_drones_that_fly_alike() -> None:
    rng = np.random.default_rng(4)
    jobs = np.zeros((30, len(ALARM_COVARIATES)))
    square = np.arange(30) % 3 == 0
    jobs[square, ALARM_COVARIATES.index("square")] = 1.0
    of = rng.integers(29, size=4000)  # the last job has none
    alarm = np.concatenate([of[:, None], rng.random((4000, 4)), rng.uniform(0.1, 0.99, (4000, 1))], axis=1)
    rows: Any = SimpleNamespace(job=jobs, alarm=alarm, alarm_job=of)
    edges, counts, pools = fitting._alarms(rows, 0.1, rng)
    assert (edges[0], edges[-1]) == (0.1, pytest.approx(1.0, abs=1e-4))
    assert edges[1:-1] == pytest.approx(np.quantile(alarm[:, 5], BANDS[1:]), abs=1e-4)
    np.testing.assert_array_equal(counts.sum(axis=1), np.bincount(of, minlength=30))
    for b in range(len(BANDS)):
        mine = (alarm[:, 5] >= edges[b]) & (alarm[:, 5] < edges[b + 1])
        np.testing.assert_array_equal(counts[:, b], np.bincount(of[mine], minlength=30))
        scores = pools[:, b, :, 5]
        assert (scores >= edges[b]).all()
        assert (scores < edges[b + 1]).all()
    assert pools.shape == (2, len(BANDS), POOL, 6)
    common = len(BANDS) - 3  # of the highest scores there are too few of square drones alone
    assert not square[pools[0, :common, :, 0].astype(int)].any()
    assert square[pools[1, :common, :, 0].astype(int)].all()
    few: Any = SimpleNamespace(job=jobs, alarm=alarm[:49], alarm_job=of[:49])
    with pytest.raises(ValueError, match=r"49 false alarms above 0\.1, at least 50 are needed"):
        fitting._alarms(few, 0.1, rng)


@pytest.mark.parametrize(
    ("lost", "floor"),
    [
        ({}, FLOORS[0]),
        ({(False, 0.3): 0.004}, 0.25),
        ({(True, 0.3): 0.004, (False, 0.25): 0.0031}, 0.2),
        ({(True, f): 1.0 for f in FLOORS}, FLOORS[-1]),
    ],
)
def test_the_floor_is_the_highest_that_costs_little_alone_and_shared(
    lost: dict[tuple[bool, float], float], floor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ap(recorded: Any, seed: int, shared: bool, floor: float) -> tuple[float, float]:
        return 0.5, 0.5 - lost.get((shared, floor), 0.9 * LOST)

    monkeypatch.setattr(calibrating, "_ap", ap)
    assert calibrating._floor([], 0) == floor


def test_what_a_floor_costs_is_measured_on_drones_alone_or_with_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """One car. Alone it is found at 0.5 after a false positive of 0.9, shared by a box of 0.15; weaker boxes never count."""
    monkeypatch.setattr(calibrating, "scene_model", lambda *at: only_target(10.0, 0.0))
    ego = capture(0.0, 0.0)
    (x, y, length, width, yaw), *_ = only_target(10.0, 0.0).cars_at(5.0).table().tolist()
    right, wrong = (x, y, length, width, yaw), (-40.0, 0.0, length, width, yaw)
    share = Share(capture(5.0, 0.0, drone=1), "features", 1.0, None, 1.0)
    jobs = [DetectorJob(ego, shares, "masked", "") for shares in ((), (share,), (share,))]
    found = [
        boxes((*wrong, 0.9), (*right, 0.5)),
        boxes((*right, 0.15)),
        boxes((*right, THRESHOLD - 0.01)),
    ]
    runs = [DetectorRuns("fit", 0, jobs, found, {})]
    assert calibrating._ap(runs, 0, False, 0.2) == (0.5, 0.5)
    assert calibrating._ap(runs, 0, False, 0.6) == (0.5, 0.0)
    assert calibrating._ap(runs, 0, True, 0.1) == (0.5, 0.5)
    assert calibrating._ap(runs, 0, True, 0.2) == (0.5, 0.0)


def test_what_a_drone_alone_would_send_is_counted_over_its_cars_and_its_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    ego, other = capture(0.0, 0.0), capture(9.0, 0.0, drone=1)
    share = Share(other, "features", 1.0, None, 1.0)
    jobs = [DetectorJob(e, s, "masked", "") for e, s in ((ego, ()), (ego, (share,)), (other, ()))]
    runs = DetectorRuns("fit", 0, jobs, [boxes(), boxes((0, 0, 1, 1, 0, 1)), boxes()], {})
    asked: list[Any] = []
    alarm = np.zeros((3, 6))
    alarm[:, 5] = 0.05, 0.3, 0.85
    table = SimpleNamespace(score=np.array([0.0, 0.1, 0.5, 0.95]), alarm=alarm, job=np.zeros((2, 3)))
    monkeypatch.setattr(calibrating, "rows_of", lambda *at: asked.append(at))
    monkeypatch.setattr(calibrating, "FitRows", SimpleNamespace(join=lambda several: table))
    found = calibrating._boxes([runs], 6)
    ((kept, floor, seed),) = asked
    assert ([j.ego.drone for j in kept.jobs], [len(b) for b in kept.boxes], floor, seed) == ([0, 1], [0, 0], FLOOR, 6)
    at = {round(t, 2): (share, alarms) for t, share, alarms in found.T.tolist()}
    assert (at[0.05], at[0.1], at[0.3], at[0.8], at[0.9], at[1.0]) == (
        (0.75, 1.5), (0.75, 1.0), (0.5, 1.0), (0.25, 0.5), (0.25, 0.0), (0.0, 0.0),
    )  # fmt: skip


def test_a_calibration_is_fitted_to_some_scenes_and_judged_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every step is given the fitted scenes, the judge those held out, each what the step before made of the parameters."""
    shipped, asked = load(SHIPPED), list[Any]()
    level = LevelError("alone", 0.5, 0.51, 0.01, 0.0, 0.02, 4)

    def marked(name: str, parameters: Any, recorded: Any, *rest: Any) -> Any:
        asked.append((name, parameters.residuals[0, 0, 0].item(), recorded, *[r for r in rest if not callable(r)]))
        residuals = parameters.residuals.copy()
        residuals[0, 0, 0] += 1
        return replace(parameters, residuals=residuals)

    zeroed = shipped.residuals.copy()
    zeroed[0, 0, 0] = 0.0
    stand_ins: dict[str, Any] = {
        "_detector_runs": lambda split, count, *rest: [f"{split} {k}" for k in range(count)],
        "_floor": lambda recorded, seed: asked.append(("floor", recorded, seed)) or 0.2,
        "_boxes": lambda recorded, seed: asked.append(("boxes", recorded, seed)),
        "rows_of": lambda recorded, floor, seed: (recorded, floor, seed),
        "FitRows": SimpleNamespace(join=lambda rows: rows),
        "fit": lambda rows, boxes, floor, seed, progress: asked.append(("fit", rows, floor, seed)) or replace(shipped, residuals=zeroed),
        "fit_shared_false_positives": lambda recorded, floor, seed: asked.append(("shared", recorded, floor, seed)) or np.full(4, 0.25, np.float32),
        "fit_correlation": lambda *at: marked("together", *at), "level": lambda *at: marked("levels", *at),
        "judge": lambda parameters, recorded, seed: marked("judge", parameters, recorded, seed) and CalibrationVerdict([level], []),
    }  # fmt: skip
    for name, made in stand_ins.items():
        monkeypatch.setattr(calibrating, name, made)
    stages: list[Any] = []
    out = tmp_path / "mine.safetensors"
    parameters, verdict = calibrating.calibrate(
        out, work=tmp_path, scenes=2, held_out=3, seed=6, progress=lambda *at: stages.append(at)
    )
    fitted, judged = ["fit 0", "fit 1"], ["held-out 0", "held-out 1", "held-out 2"]
    assert asked == [
        ("floor", fitted, 6), ("boxes", fitted, 6), ("fit", [(f, 0.2, 6) for f in fitted], 0.2, 6), ("shared", fitted, 0.2, 6),
        ("together", 0.0, fitted, 6, THRESHOLD), ("levels", 1.0, fitted, 6, THRESHOLD), ("judge", 2.0, judged, 6),
    ]  # fmt: skip
    assert verdict.levels == [level]
    read = load(out)
    assert read.residuals[0, 0, 0] == parameters.residuals[0, 0, 0] == 2.0
    assert read.shared_false_positives.tolist() == [0.25] * 4
    assert read.card["levels"][0]["error"] == 0.01
    assert {k: read.card[k] for k in ("fusion", "seed", "scenes", "held_out")} == {
        "fusion": shipped.card["fusion"], "seed": 6, "scenes": 2, "held_out": 3,
    }  # fmt: skip
    assert read.id.startswith(f"{read.card['fusion']}-{read.card['weights']}-")
    assert "1 of 1 conditions within" in out.with_suffix(".md").read_text()
