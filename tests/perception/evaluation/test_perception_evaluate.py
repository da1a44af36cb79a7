"""The evaluator over made frames: against the one-image functions, in every region, resumed, saved and read back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness_examples import MadeFrames, MadeInstrument, made_frames
from wrong_rows import wrong_rows

from sortie.perception.evaluation import FULL_SHARING, SINGLE, Evaluation, Settings, Sharing, evaluate, sharing
from sortie.perception.evaluation.harness import REGION_M, frame_hash, frame_keys, mission_target, truth
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.metrics.ap import CONVENTIONS, match, suppress
from sortie.perception.metrics.bootstrap import compare
from sortie.perception.types import Boxes

BEST = Sharing(0.1, "best-2", roi=True)
THREE = (SINGLE, BEST, FULL_SHARING)
EVERYWHERE = ("full", "mission", "ego")


def evaluated(
    instrument: object, frames: MadeFrames, conditions: Sequence[Sharing], store: Path | None = None, **settings: Any
) -> Evaluation:
    return evaluate(instrument, frames, conditions, Settings(**settings), store=store)


@pytest.fixture(scope="module")
def frames() -> MadeFrames:
    return made_frames([7, 7, 3, 9, 9])


@pytest.fixture(scope="module")
def whole(frames: MadeFrames) -> Evaluation:
    return evaluated(MadeInstrument(), frames, THREE, regions=EVERYWHERE)


def some(frames: MadeFrames, which: list[int]) -> MadeFrames:
    return MadeFrames(*(getattr(frames, name)[which] for name in ("true_pose", "est_pose", "cars", "scene")))


def alike(a: Evaluation, b: Evaluation, drop: int = 0) -> None:
    """Equal to the bit, `drop` frames at the start of b left out."""
    skip = drop * b.settings.egos
    assert a.conditions == b.conditions
    assert a.settings.regions == b.settings.regions
    assert a.scene.tolist() == b.scene[drop:].tolist()
    assert np.array_equal(a.target, b.target[drop:], equal_nan=True)
    for key, units in a.units.items():
        for one, other in zip(units, b.units[key][skip:], strict=True):
            assert (one.score.tolist(), one.hit.tolist()) == (other.score.tolist(), other.hit.tolist())
            assert one.truths == other.truths
    for c in a.conditions:
        for cost in ("cells", "payload_bytes", "index_bytes"):
            assert getattr(a, cost)[c].tolist() == getattr(b, cost)[c][skip:].tolist()


@pytest.mark.parametrize("name", CONVENTIONS)
def test_all_images_at_once_are_one_after_another(frames: MadeFrames, name: str) -> None:
    found = evaluated(MadeInstrument(), frames, [FULL_SHARING], regions=EVERYWHERE, convention=name)
    hits = 0
    for f, key in enumerate(frame_keys(frames)):
        view = MadeInstrument().look(frames, f)
        target = mission_target(frames, f, key)
        for ego in range(5):
            sent = np.ones((4, 64, 64), bool)
            peers = tuple(p for p in range(5) if p != ego)
            boxes = view.detect([Exchange(ego, peers, sent)], 0.01)[0]
            x, y, yaw = frames.est_pose[f, ego]
            c, s = np.cos(yaw), np.sin(yaw)
            xy = np.stack([x + c * boxes[:, 0] - s * boxes[:, 1], y + s * boxes[:, 0] + c * boxes[:, 1]], axis=1)
            world = suppress(Boxes(xy, boxes[:, 2:4], boxes[:, 4] + yaw, boxes[:, 5].astype(np.float32)), 0.15)
            there = truth(frames, f, ego, MadeInstrument.geometry)
            at = {
                "full": None,
                "ego": (*frames.true_pose[f, ego, :2], REGION_M),
                "mission": target and (*target, REGION_M),
            }
            for region in EVERYWHERE:
                ours = found.units[FULL_SHARING, region][f * 5 + ego]
                if region == "mission" and target is None:
                    assert (len(ours.score), ours.truths) == (0, 0)
                    continue
                plain = match(world, there, at[region], convention=CONVENTIONS[name])
                assert ours.truths == plain.truths
                assert ours.score.tolist() == plain.score.tolist()
                assert ours.hit.tolist() == plain.hit.tolist()
                hits += int(ours.hit.sum())
    assert hits > 100


def test_truth_is_what_stands_in_the_true_square(frames: MadeFrames) -> None:
    for ego in range(5):
        x, y, yaw = frames.true_pose[0, ego]
        expected = []
        for car in frames.cars[0, :-1]:
            turned = np.exp(-1j * yaw) * complex(car[0] - x, car[1] - y)
            if abs(turned.real) < 102.4 and abs(turned.imag) < 102.4:
                expected.append(car.tolist())
        there = truth(frames, 0, ego, MadeInstrument.geometry)
        assert there.table().tolist() == expected
        assert len(there) < 39 or ego != 1


def test_a_target_is_near_the_fleet_and_the_frames_own(frames: MadeFrames) -> None:
    keys = frame_keys(frames)
    assert keys == [(7, 0), (7, 1), (3, 0), (9, 0), (9, 1)]
    many = made_frames([5] * 200, seed=3)
    chosen = []
    for f, key in enumerate(frame_keys(many)):
        centre = many.true_pose[f, :, :2].mean(axis=0)
        away = np.hypot(*(many.cars[f, :, :2] - centre).T)
        target = mission_target(many, f, key)
        if not (away <= sharing.FOOTPRINT_M).any():
            assert target is None
            continue
        which = np.flatnonzero((many.cars[f, :, :2] == target).all(axis=1))
        assert len(which) == 1
        assert away[which[0]] <= sharing.FOOTPRINT_M
        chosen.append(np.count_nonzero(away[away <= sharing.FOOTPRINT_M] < away[which[0]]) == 0)
    assert 0.03 < np.mean(chosen) < 0.4, "drawn evenly, not the nearest"


def test_frames_without_a_target_do_not_count_for_the_mission(frames: MadeFrames) -> None:
    cars = frames.cars.copy()
    cars[1, :, :2] += 500.0
    found = evaluated(MadeInstrument(), replace(frames, cars=cars), [FULL_SHARING])
    assert np.isnan(found.target[1]).all()
    assert not np.isnan(found.target[[0, 2, 3, 4]]).any()
    assert found.groups("mission").tolist() == [f for f in (0, 2, 3, 4) for _ in range(5)]
    assert found.groups("mission", by="scene").tolist() == [s for s in (7, 3, 9, 9) for _ in range(5)]
    assert len(found.matched(FULL_SHARING, "mission")) == 20
    assert len(found.matched(FULL_SHARING, "full")) == len(found.groups()) == 25


def test_bytes_of_a_fleet_frame(whole: Evaluation) -> None:
    assert whole.payload_bytes[FULL_SHARING].reshape(-1, 5).sum(axis=1).tolist() == [13_107_200] * 5
    assert whole.index_bytes[FULL_SHARING].tolist() == [0] * 25
    assert whole.cells[BEST].tolist() == [1638] * 25
    assert whole.payload_bytes[BEST].tolist() == [1638 * 160] * 25
    assert whole.index_bytes[BEST].tolist() == [2 * 512] * 25
    assert whole.cells[SINGLE].tolist() == [0] * 25


def test_a_gain_is_paired_over_scenes(whole: Evaluation, frames: MadeFrames) -> None:
    found = whole.gain(BEST, SINGLE, "mission")
    wanted = compare(whole.matched(SINGLE, "mission"), whole.matched(BEST, "mission"), whole.groups("mission", "scene"))
    assert found == wanted
    assert found.low <= found.delta == whole.ap(BEST, "mission") - whole.ap(SINGLE, "mission") <= found.high
    one_scene = evaluated(MadeInstrument(), replace(frames, scene=np.full(5, 7)), THREE)
    assert (whole.resampled, one_scene.resampled) == ("scene", "frame")
    other = evaluated(MadeInstrument(), frames, [FULL_SHARING], convention="uav3d")
    with pytest.raises(ValueError, match=r"^convention is 'uav3d', must be 'rotated' to be resampled$"):
        other.gain(FULL_SHARING, FULL_SHARING)


def test_a_pool_of_threads_changes_nothing(frames: MadeFrames, whole: Evaluation) -> None:
    seen: list[tuple[int, int]] = []
    settings = Settings(regions=EVERYWHERE)
    with ThreadPoolExecutor(3) as pool:
        several = evaluate(
            MadeInstrument(), frames, THREE, settings, each=pool.map, progress=lambda *done: seen.append(done)
        )
    alike(several, whole)
    assert seen == [(k, 5) for k in range(1, 6)]


def test_a_threshold_after_is_a_floor_before(frames: MadeFrames, whole: Evaluation) -> None:
    cut, floored = whole.at(0.3), evaluated(MadeInstrument(), frames, THREE, regions=EVERYWHERE, floor=0.3)
    for key, units in cut.units.items():
        for one, other in zip(units, floored.units[key], strict=True):
            assert one.hit.tolist() == other.hit.tolist()
            assert one.score.tolist() == other.score.tolist()
    assert cut.ap(FULL_SHARING) < whole.ap(FULL_SHARING)
    with pytest.raises(ValueError, match=r"tau is nan, must be at least the floor 0.01"):
        whole.at(float("nan"))
    with pytest.raises(ValueError, match=r"tau is 0.2, must be at least the floor 0.3"):
        cut.at(0.2)


def test_an_evaluation_goes_on_where_it_was_cut_off(frames: MadeFrames, whole: Evaluation, tmp_path: Path) -> None:
    class Tired(MadeInstrument):
        def look(self, frames: MadeFrames, frame: int) -> object:
            if frame == 3:
                raise KeyboardInterrupt
            return super().look(frames, frame)

    with pytest.raises(KeyboardInterrupt):
        evaluated(Tired(), frames, THREE, regions=EVERYWHERE, store=tmp_path)
    rest = MadeInstrument()
    alike(evaluated(rest, frames, THREE, regions=EVERYWHERE, store=tmp_path), whole)
    assert rest.looked == [3, 4], "three frames were kept"

    more = MadeInstrument()
    wider = evaluated(more, frames, (*THREE, Sharing(0.02)), regions=EVERYWHERE, store=tmp_path)
    assert more.computed == 25, "only the new condition"
    assert wider.ap(BEST) == whole.ap(BEST)
    again = MadeInstrument()
    alike(evaluated(again, some(frames, [2, 3, 4]), THREE, regions=EVERYWHERE, store=tmp_path), whole, drop=2)
    assert again.looked == []


def test_a_store_answers_only_for_what_it_holds(
    frames: MadeFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def looked(instrument: MadeInstrument, frames: MadeFrames, **settings: Any) -> int:
        evaluated(instrument, frames, [FULL_SHARING], store=tmp_path, **settings)
        return len(instrument.looked)

    moved = replace(frames, est_pose=frames.est_pose + 1e-6)
    assert [looked(MadeInstrument(), frames) for _ in range(2)] == [5, 0]
    assert [looked(MadeInstrument("other"), frames), looked(MadeInstrument(), moved)] == [5, 5]
    for change in ({"floor": 0.02}, {"seed": 1}, {"convention": "uav3d"}, {"regions": ["ego"]}):
        assert looked(MadeInstrument(), frames, **change) == 5, change
    monkeypatch.setattr("sortie.perception.evaluation.harness.boxes_digest", lambda: "another")
    assert looked(MadeInstrument(), frames) == 5, "by other code"


def test_a_frame_is_known_again_beside_frames_with_more_cars(frames: MadeFrames) -> None:
    """Cars are padded to the fullest frame of those that were loaded together."""
    wider = np.pad(frames.cars, ((0, 0), (0, 3), (0, 0)), constant_values=np.nan)
    key = frame_keys(frames)[1]
    assert frame_hash(replace(frames, cars=wider), 1, key) == frame_hash(frames, 1, key)
    moved = wider.copy()
    moved[1, 0, 0] += 1e-9
    assert frame_hash(replace(frames, cars=moved), 1, key) != frame_hash(frames, 1, key)


def test_a_broken_store_says_which_file(frames: MadeFrames, tmp_path: Path) -> None:
    evaluated(MadeInstrument(), frames, [FULL_SHARING], store=tmp_path)
    part = next(tmp_path.glob("*/*.parquet"))
    part.write_bytes(b"nothing")
    with pytest.raises(ValueError, match=rf"{part.name}: not part of an evaluation .* remove it to go on"):
        evaluated(MadeInstrument(), frames, [FULL_SHARING], store=tmp_path)


def test_saved_and_read_back(whole: Evaluation, tmp_path: Path) -> None:
    whole.save(tmp_path / "deep" / "e.parquet")
    back = Evaluation.load(tmp_path / "deep" / "e.parquet")
    alike(back, whole)
    assert back.settings == whole.settings
    assert back.ap(BEST, "mission") == whole.ap(BEST, "mission")
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["e.parquet"], "no temporary file is left"


def test_what_is_refused(frames: MadeFrames, tmp_path: Path) -> None:
    (tmp_path / "e.parquet").write_bytes(b"nothing")
    fits = [FULL_SHARING]
    rows = [
        (lambda: evaluated(MadeInstrument(), frames, fits, egos=6), "egos is 6, must be 1 to the 5 drones of a frame"),
        (lambda: evaluated(MadeInstrument(), frames, fits, egos=0), "egos is 0, must be"),
        (
            lambda: evaluated(MadeInstrument(), frames, fits, regions=["half"]),
            "region is 'half', must be full or mission",
        ),
        (
            lambda: evaluated(MadeInstrument(), frames, fits, convention="coco"),
            "convention is 'coco', must be rotated or",
        ),
        (
            lambda: evaluated(MadeInstrument(), frames, [Sharing(0.1, "best-5")]),
            "peers is 'best-5', must fit a fleet with 4",
        ),
        (lambda: Evaluation.load(tmp_path / "e.parquet"), r"e\.parquet: not an evaluation of this project"),
        (lambda: Evaluation.load(tmp_path / "missing.parquet"), r"missing\.parquet: not an evaluation of this project"),
    ]

    def check(call: Callable[[], object], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            call()

    assert wrong_rows(rows, check) == {}


def test_fewer_egos_are_the_first_ones(frames: MadeFrames, whole: Evaluation) -> None:
    two = evaluated(MadeInstrument(), frames, [FULL_SHARING], egos=2)
    assert len(two.units[FULL_SHARING, "full"]) == 10
    assert two.units[FULL_SHARING, "full"][3].score.tolist() == whole.units[FULL_SHARING, "full"][6].score.tolist()
