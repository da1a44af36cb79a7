"""The detector over one scene, with the shipped weights: what shares do, what age does, what repeats."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from perception_examples import cross, same
from places import HELPERS

from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import source_of
from sortie.perception.metrics.ap import match
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene import render
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture, Share
from sortie.scenarios.schema import Perception, Scene, Target


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), Target(waypoints_m=((0, 0), (100, 0))), (-50, -50, 50, 50))


@pytest.fixture(scope="module")
def detector(scene: SceneModel) -> TorchDetector:
    return TorchDetector(scene, Perception(), seed=1)


@pytest.fixture(scope="module")
def fleet() -> list[Capture]:
    return cross(10.0, 20.0, 0.3)


def share(
    c: Capture, representation: str = "features", rho: float = 1.0, roi: tuple[float, ...] | None = None
) -> Share:
    return Share(c, representation, rho, roi, 1.0)


def test_boxes_look_like_cars_and_come_best_first(detector: TorchDetector, fleet: list[Capture]) -> None:
    found = detector.detect([(fleet[0], [share(c) for c in fleet[1:]])])[0]
    assert len(found) > 5
    assert (np.diff(found.score) <= 0).all()
    assert (found.score >= 0.1).all()
    assert 3.5 < np.median(found.size_m[:, 0]) < 5.5
    assert 1.5 < np.median(found.size_m[:, 1]) < 2.3
    truth = detector.truth(5.0, fleet[0])
    assert match(found.take(found.score > 0.5), truth).hit.mean() > 0.5


def test_the_same_question_has_the_same_answer_whatever_is_asked_beside_it(
    scene: SceneModel, detector: TorchDetector, fleet: list[Capture]
) -> None:
    jobs = [(c, [share(p) for p in fleet if p is not c]) for c in fleet]
    together = detector.detect(jobs)
    alone = TorchDetector(scene, Perception(), seed=1).detect(jobs[3:4])
    assert same(together[3], alone[0])


PROGRAM = """
import hashlib, sys
sys.path.insert(0, {tests!r})
from perception_examples import cross
from sortie.perception.ground_truth import ground_truth
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception, Scene
fleet = cross(10.0, 20.0, 0.3)
detector = TorchDetector(SceneModel(Scene(), None, (-50, -50, 50, 50)), Perception(), seed=1)
found = detector.detect([(fleet[0], [Share(c, "features", 0.1, None, 1.0) for c in fleet[1:]])])[0]
digest = hashlib.sha256(b"".join(getattr(found, f).tobytes() for f in found.__slots__)).hexdigest()
sys.stdout.write(digest)
"""


@pytest.mark.slow
def test_boxes_are_equal_across_processes() -> None:

    program = PROGRAM.format(tests=str(HELPERS))
    runs = [
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True) for _ in range(2)
    ]
    assert len(runs[0].stdout) == 64
    assert runs[0].stdout == runs[1].stdout


def test_a_budget_an_roi_the_two_masks_and_age_matter_and_nothing_sent_is_a_single_drone(
    scene: SceneModel, detector: TorchDetector, fleet: list[Capture]
) -> None:
    shares = [share(c, rho=0.1) for c in fleet[1:]]
    full, tenth, disc, late, single, nothing, aside, raw = detector.detect(
        [
            (fleet[0], [share(c) for c in fleet[1:]]),
            (fleet[0], shares),
            (fleet[0], [s._replace(roi=(10.0, 20.0, 32.0)) for s in shares]),
            (fleet[0], [share(c._replace(t_s=c.t_s - 2.0)) for c in fleet[1:]]),
            (fleet[0], []),
            (fleet[0], [share(fleet[1], rho=0.0)]),
            (fleet[0], [share(fleet[1], roi=(5000.0, 0.0, 32.0))]),
            (fleet[0], [share(c, "raw", rho=0.0) for c in fleet[1:]]),
        ]
    )
    zero = TorchDetector(scene, Perception(unsent_cells="zero"), seed=1).detect([(fleet[0], shares)])[0]
    answers = [full, tenth, disc, late, zero, single]
    assert not any(same(a, b) for k, a in enumerate(answers) for b in answers[:k])
    assert same(raw, full)
    for other in (nothing, aside):
        assert len(other) == len(single)
        assert other.xy_m == pytest.approx(single.xy_m, abs=1e-2)


def test_sent_boxes_join_and_tracks_are_at_most_twelve_in_the_region(
    detector: TorchDetector, fleet: list[Capture]
) -> None:
    roi = (10.0, 20.0, 60.0)
    single, joined, alone = detector.detect(
        [(fleet[0], []), (fleet[0], [share(fleet[2], "detections")]), (fleet[2], [])]
    )
    assert len(joined) >= len(single)
    assert detector.count_boxes(fleet[2], None) >= detector.count_boxes(fleet[2], roi)
    tracks = source_of(share(fleet[2], "tracks", roi=roi), alone).boxes
    assert len(tracks) == min(12, detector.count_boxes(fleet[2], roi))
    assert (np.hypot(*(tracks.xy_m - roi[:2]).T) <= roi[2] + 1e-3).all()


def test_moments_begun_together_are_one_after_the_other(
    scene: SceneModel, fleet: list[Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when what one needs is no longer kept once the next has begun."""
    monkeypatch.setattr("sortie.perception.network.detector.KEPT_CAPTURES", 1)
    fleets = [[c._replace(t_s=c.t_s + late) for c in fleet[:3]] for late in (0.0, 0.5, 1.0)]
    asked = [[(ego, [share(c, rho=0.05) for c in f if c is not ego]) for ego in f] for f in fleets]
    detector = TorchDetector(scene, Perception(), seed=1)
    waiting = [detector.begin(jobs) for jobs in asked]
    together = [wait() for wait in reversed(waiting)][::-1]
    for jobs, found in zip(asked, together, strict=True):
        alone = TorchDetector(scene, Perception(), seed=1).detect(jobs)
        assert all(same(a, b) for a, b in zip(found, alone, strict=True))


@pytest.mark.parametrize(("fusion", "asked"), [("disconet", 0), ("late", 1)])
def test_what_is_asked_while_a_moment_is_under_way_holds_nobody_up(scene: SceneModel, fusion: str, asked: int) -> None:
    """With one thread a task that waited for one behind it would wait for ever: what it needs must be before it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        detector = TorchDetector(scene, Perception(fusion=fusion), seed=1)
    finally:
        torch.set_num_threads(threads)
    two = [
        c._replace(position_m=(x, 0.0, 60.0), est_position_m=(x, 0.0, 60.0))
        for c, x in zip(cross(0.0, 0.0, 0.0), (0.0, 400.0), strict=False)
    ]
    begun = detector.begin([(two[0], [share(two[1])])])  # too far away to have a say
    waiting = ThreadPoolExecutor(2)
    count = waiting.submit(detector.count_boxes, two[asked], None)
    assert len(waiting.submit(begun).result(timeout=600.0)[0]) > 0
    assert count.result(timeout=600.0) > 0


def test_a_moment_that_fails_leaves_nothing_behind(
    scene: SceneModel, fleet: list[Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    detector, jobs = TorchDetector(scene, Perception(), seed=1), [(c, []) for c in fleet]
    whole = [len(b) for b in TorchDetector(scene, Perception(), seed=1).detect(jobs)]
    noise = render._noise

    def fails(seed: int, replication: int, capture: Capture) -> np.ndarray:
        if capture is fleet[0]:
            raise MemoryError("planted")
        return noise(seed, replication, capture)

    monkeypatch.setattr(render, "_noise", fails)
    with pytest.raises(MemoryError, match="planted"):
        detector.detect(jobs)
    monkeypatch.setattr(render, "_noise", noise)
    assert [len(b) for b in detector.detect(jobs)] == whole


def test_half_the_digits_find_the_same_cars(detector: TorchDetector, scene: SceneModel, fleet: list[Capture]) -> None:
    short = TorchDetector(scene, Perception(precision="bfloat16"), seed=1)
    jobs = [(ego, [share(c, rho=0.1) for c in fleet if c is not ego]) for ego in fleet]
    for exact, found in zip(detector.detect(jobs), short.detect(jobs), strict=True):
        sure = exact.take(exact.score > 0.5)
        assert len(sure) > 3
        assert not same(exact, found)
        # sure boxes are there again, where they were and as sure, but for those of two peaks that are as high
        far = np.hypot(*(sure.xy_m[:, None] - found.xy_m[None]).transpose(2, 0, 1))
        again = far.min(axis=1) < 0.2
        assert again.mean() > 0.95
        np.testing.assert_allclose(found.score[far.argmin(axis=1)][again], sure.score[again], atol=0.05)
    features = short._kept[fleet[0]].features.result()
    assert features.dtype == torch.float32
    assert torch.equal(features, features.half().float()), "as the radio carries them"


def test_threshold_cuts(scene: SceneModel, fleet: list[Capture]) -> None:
    low, high = (
        TorchDetector(scene, Perception(score_threshold=t), seed=1).detect([(fleet[0], [])])[0] for t in (0.05, 0.6)
    )
    assert len(high) < len(low)
    assert (high.score >= 0.6).all()


def test_a_sortie_far_from_the_origin_sees_the_same_way(fleet: list[Capture]) -> None:
    there = SceneModel(Scene(), None, (3150, -4050, 3250, -3950))
    captures = cross(3210.0, -3980.0, 0.3)
    found = TorchDetector(there, Perception(), seed=1).detect([(captures[0], [share(c) for c in captures[1:]])])[0]
    truth = ground_truth(there.cars_at(5.0).table(), (3210.0, -3980.0, 0.3))
    assert match(found.take(found.score > 0.5), truth).hit.mean() > 0.5


def test_ground_truth_is_every_car_in_the_turned_square(scene: SceneModel) -> None:
    cars = scene.cars_at(5.0)
    for yaw in (0.0, 0.6):
        truth = ground_truth(scene.cars_at(5.0).table(), (10.0, 20.0, yaw), 60.0)
        count = 0
        for x, y in zip(cars.x_m, cars.y_m, strict=True):
            forward = np.cos(yaw) * (x - 10) + np.sin(yaw) * (y - 20)
            left = np.cos(yaw) * (y - 20) - np.sin(yaw) * (x - 10)
            count += abs(forward) < 60 and abs(left) < 60
        assert len(truth) == count > 5
    assert (truth.score == 1).all()
