"""What a calibration asks the detector, keeps, and is judged by; the detector itself is played by others here."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from research.calibrate import collect as collecting
from research.calibrate.calibrate import calibrate
from research.calibrate.collect import DetectorRuns, captures_of, collect, read
from research.calibrate.judge import IN_DISC, judge
from research.calibrate.plan import AREA_M, LANE_M, MANNERS, DetectorJob, draw_target, moment, scene_model
from sortie.perception.scene.traffic import TARGET_ID, TargetPath
from sortie.perception.surrogate.features import square
from sortie.perception.surrogate.model import SHIPPED, load
from sortie.perception.types import Boxes, Capture

STREET = MANNERS.index("street")


def test_square_is_along_or_across_the_cells() -> None:
    turn = np.radians([0, 90, -180, 3, 87, -3, 45])
    np.testing.assert_allclose(square(turn), [1, 1, 1, np.exp(-1), np.exp(-1), np.exp(-1), np.exp(-15)], rtol=1e-9)


@pytest.mark.parametrize("split", ["fit", "held-out"])
def test_along_a_street_drones_fly_as_sorties_do(split: Any) -> None:
    ways, speeds = set(), []
    for scene in range(40):
        jobs = moment(0, split, scene, STREET)
        egos = {j.ego.drone: j.ego for j in jobs}
        for ego in egos.values():
            assert float(square(np.array(ego.true_yaw_rad))) > 0.7  # within a degree
            assert ego.est_position_m[2] == ego.position_m[2]
            assert 56 < ego.position_m[2] < 64
        now = {c.drone: c for j in jobs for c in (j.ego, *(s.capture for s in j.shares)) if c.t_s == j.ego.t_s}
        ways.add(round(np.degrees(ego.true_yaw_rad) / 90) % 4)
        x, y, _ = np.median([c.position_m for c in now.values()], axis=0)
        assert min(abs(x), abs(y)) < 8, "about the street through the origin"
        assert max(abs(x), abs(y)) < AREA_M + 30
        older = [s.capture for j in jobs for s in j.shares if s.capture.t_s < j.ego.t_s]
        speeds += [
            np.hypot(*np.subtract(now[c.drone].position_m, c.position_m)[:2]) / (now[c.drone].t_s - c.t_s)
            for c in older
            if c.drone in now
        ]
    assert ways == {0, 1, 2, 3}
    assert 4 < np.mean(speeds) < 6
    assert max(speeds) < 10.1


def test_along_a_street_the_target_drives_below_the_fleet_and_the_disc_is_about_it() -> None:
    speeds = []
    for scene in range(40):
        jobs = moment(0, "held-out", scene, STREET)
        (t_s,) = {j.ego.t_s for j in jobs}
        target = TargetPath.of(draw_target(0, "held-out", scene))
        x, y, yaw = target.pose(t_s)
        assert {j.disc for j in jobs} == {(x, y, 32.0)}
        cars = scene_model(0, "held-out", scene).cars_at(t_s)
        assert (cars.x_m[0], cars.y_m[0], cars.yaw_rad[0]) == (x, y, yaw), "it is there to be seen"
        assert cars.ids[0] == TARGET_ID
        assert np.sin(yaw) * x - np.cos(yaw) * y == pytest.approx(LANE_M, abs=1e-9), "on the right of the street"
        ahead = {round(float(np.cos(j.ego.true_yaw_rad - yaw)), 2) for j in jobs}
        assert ahead == {1.0}, "the way that the fleet flies"
        away = [np.hypot(*np.subtract(j.ego.position_m[:2], (x, y))) for j in jobs]
        assert min(away) < 70
        was = target.pose(t_s - 1)
        speeds.append(np.hypot(x - was[0], y - was[1]))
    assert 0.4 < min(speeds) < max(speeds) < 12
    assert np.std(speeds) > 1


@pytest.mark.parametrize("index", range(len(MANNERS)))
def test_an_older_capture_is_of_the_same_flight(index: int) -> None:
    """The drone was behind where it is now, with the same attitude and the same error."""
    looked = 0
    for scene in range(20):
        captures = captures_of(moment(3, "fit", scene, index))
        t_s = max(c.t_s for c in captures)
        now = {c.drone: c for c in captures if c.t_s == t_s}
        for old in (c for c in captures if c.t_s < t_s):
            new = now[old.drone]  # for the fit every drone is an ego
            assert old.orientation_xyzw == new.orientation_xyzw
            np.testing.assert_allclose(
                np.subtract(old.est_position_m, old.position_m),
                np.subtract(new.est_position_m, new.position_m),
                atol=1e-9,
            )
            assert old.position_m[2] == new.position_m[2]
            looked += 1
    assert looked > 20


class FakeProbe:
    """A detector that gives a box at every drone that takes part."""

    calls = 0

    def __init__(self, *_: object) -> None: ...

    def detect_job(self, job: DetectorJob) -> Boxes:
        FakeProbe.calls += 1
        drones = [job.ego, *(s.capture for s in job.shares)]
        rows = np.array([(*d.position_m[:2], 4.5, 1.9, 0.0, 1 / (1 + k)) for k, d in enumerate(drones)])
        return Boxes.placed(rows, (0.0, 0.0, 0.0))

    def ranks(self, capture: Capture) -> np.ndarray:
        return np.full((64, 64), capture.drone, np.float32)


def test_a_calibration_that_its_card_would_replace_is_refused_before_anything_is_run(tmp_path: Path) -> None:
    out = tmp_path / "mine.md"
    with pytest.raises(ValueError, match=f"^{re.escape(f'out is {out}, must not end in .md, as its card does')}$"):
        calibrate(out, work=tmp_path, scenes=2, held_out=2)


def test_runs_are_kept_and_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collecting, "Probe", FakeProbe)
    for split in ("fit", "held-out"):
        for index in range(len(MANNERS)):
            path = collect(tmp_path, 0, split, 3, index, None, "key")
            jobs, before = moment(0, split, 3, index), FakeProbe.calls
            assert collect(tmp_path, 0, split, 3, index, None, "key") == path
            assert FakeProbe.calls == before
            kept = read(path, split)
            assert kept.jobs == jobs
            assert [len(b) for b in kept.boxes] == [1 + len(j.shares) for j in jobs]
            np.testing.assert_allclose(kept.boxes[-1].xy_m[0], jobs[-1].ego.position_m[:2], rtol=1e-6)
            assert all((ranks == c.drone).all() for c, ranks in kept.ranks.items())
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("name", ["draw_target", "draw_scene", "moment"])
def test_answers_to_another_question_are_not_taken_for_these(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan changes: the target drives elsewhere, the town is another, other fleets are asked."""
    monkeypatch.setattr(collecting, "Probe", FakeProbe)
    before = collect(tmp_path, 0, "fit", 3, STREET, None, "key")
    changed = getattr(collecting, name)
    monkeypatch.setattr(collecting, name, lambda seed, split, scene, *index: changed(seed, split, scene + 1, *index))
    calls = FakeProbe.calls
    assert collect(tmp_path, 0, "fit", 3, STREET, None, "key") != before
    assert FakeProbe.calls > calls


def test_answers_of_another_code_are_not_taken_for_this_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collecting, "Probe", FakeProbe)
    before = collect(tmp_path, 0, "fit", 3, STREET, None, "key")
    monkeypatch.setattr(collecting, "boxes_digest", lambda: "another")
    assert collect(tmp_path, 0, "fit", 3, STREET, None, "key") != before


def test_runs_of_another_plan_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collecting, "Probe", FakeProbe)
    path = collect(tmp_path, 0, "held-out", 0, STREET, None, "key")
    monkeypatch.setattr(collecting, "moment", lambda *at: moment(*at)[:-1])
    with pytest.raises(ValueError) as error:
        read(path, "held-out")
    count = len(moment(0, "held-out", 0, STREET))
    assert str(error.value) == f"{path}: holds {count} results, the plan has {count - 1} jobs; remove it"


def test_the_disc_is_judged_beside_the_scene() -> None:
    """A detector that finds all cars in the disc and none elsewhere has an AP of 1 there, and of their share in the scene."""
    cars: list[int] = []
    inside: list[int] = []

    def answered(scene: int) -> DetectorRuns:
        jobs = moment(0, "held-out", scene, STREET)
        truths = truth_of(scene, jobs)
        for t, j in zip(truths, jobs, strict=True):
            if j.condition == "street: alone":
                cars.append(len(t))
                inside.append(len(t.inside(j.disc)))
        boxes = [t.inside(j.disc) for t, j in zip(truths, jobs, strict=True)]
        return DetectorRuns("held-out", scene, jobs, boxes, {})

    parameters = load(SHIPPED)
    verdict = judge(parameters, [answered(s) for s in range(3)])
    level = {v.condition: v for v in verdict.levels}
    assert level["street: alone" + IN_DISC].torch == 1.0
    assert level["street: alone"].torch == pytest.approx(sum(inside) / sum(cars))
    assert 0.2 < level["street: alone" + IN_DISC].surrogate < 0.9
    assert all(o.torch == 0.0 and not o.significant for o in verdict.orders)


def truth_of(scene: int, jobs: Sequence[DetectorJob]) -> list[Boxes]:
    from sortie.perception.ground_truth import ground_truth

    model = scene_model(0, "held-out", scene)
    return [ground_truth(model.cars_at(j.ego.t_s).table(), j.ego.true_pose) for j in jobs]
