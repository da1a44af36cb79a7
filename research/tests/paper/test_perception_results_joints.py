"""What a table's settings pass on to its scores, and what the bootstrap, the exchanges and the picture take of theirs."""

from __future__ import annotations

import numpy as np
import pytest
from harness_examples import MadeFrames, MadeInstrument, made_frames

from research.paper import scores
from research.paper.measures import under
from research.paper.picture import picture, sharers
from research.paper.results import TableResults, TableSettings
from research.paper.scores import Bootstrap, split
from research.paper.ways import SINGLE, Sharing, Ways, evaluate
from sortie.perception.evaluation import sharing
from sortie.perception.evaluation.harness import (
    REGION_M,
    Evaluation,
    Settings,
    exchanges,
    frame_keys,
    mission_target,
    truth,
)
from sortie.perception.geometry import FULL, SMALL
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import suppress
from sortie.perception.metrics.bootstrap import rank
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc
from sortie.scenarios.intervals import resamples
from sortie.scenarios.streams import stream

WAYS = Ways("zeros", "region_first")
SHARED = Sharing(0.1, "best-2")
UNDER = under(SHARED, "zero", "norm", WAYS)


def astray(scenes: list[int]) -> MadeFrames:
    """Frames whose drones believe to be where others of them are, and a little off."""
    made = made_frames(scenes)
    est = made.true_pose[:, [2, 0, 3, 4, 1]] + np.array([25.0, -18.0, 0.4])
    return MadeFrames(made.true_pose, est, made.cars, made.scene)


@pytest.fixture(scope="module")
def two_egos() -> Evaluation:
    """Five frames of three scenes."""
    frames = made_frames([7, 7, 3, 9, 9])
    return evaluate(MadeInstrument(), frames, [SINGLE, UNDER], regions=("full", "mission", "ego"), egos=2)


def test_a_table_is_measured_by_its_own_settings(two_egos: Evaluation) -> None:
    """What ranks cells, what is resampled and how often, and what peers that were not chosen count as."""
    results = TableResults(two_egos, TableSettings(("zero",), "norm", 0.2, "scene", 17, WAYS))
    got = results.scores("zero").draws(SHARED, "full")
    cut = two_egos.at(0.2)
    wanted = rank(cut.matched(UNDER), cut.groups("full", "scene")).ap(resamples(3, 17, 0))
    np.testing.assert_array_equal(got, wanted)
    assert results.all_scores()["zero"] is results.scores("zero")


def test_scores_of_one_threshold_and_disc_are_not_those_of_another(two_egos: Evaluation) -> None:
    """Whichever was asked for first."""
    results = TableResults(two_egos, TableSettings(("zero",), "norm", 0.2, draws=3, ways=WAYS))
    for tau, disc in ((0.2, "mission"), (0.4, "ego"), (0.4, "mission"), (0.2, "ego")):
        got = results.scores("zero", tau=tau, disc=disc).ap(SHARED, "mission")  # type: ignore[arg-type]
        assert got == two_egos.at(tau).ap(UNDER, disc)  # type: ignore[arg-type]
    assert two_egos.at(0.2).ap(UNDER, "mission") != two_egos.at(0.4).ap(UNDER, "ego")


@pytest.mark.parametrize("by", ["frame", "scene"])
def test_draws_and_halves_are_of_the_bootstraps_own_seed_and_groups(two_egos: Evaluation, by: str) -> None:
    its = Bootstrap(two_egos, "zero", "norm", by=by, draws=9, seed=5, ways=WAYS)  # type: ignore[arg-type]
    ranked = rank(two_egos.matched(UNDER), two_egos.groups("full", by))  # type: ignore[arg-type]
    groups = {"frame": 5, "scene": 3}[by]
    np.testing.assert_array_equal(its.draws(SHARED, "full"), ranked.ap(resamples(groups, 9, 5)))
    for resampled in (False, True):
        both = [ranked.ap(w) for w in split(groups, 9, 5, resampled=resampled)]
        got = its.halves(SHARED, "full", resampled=resampled)
        np.testing.assert_array_equal(got, np.stack(both, axis=1))


def test_the_bytes_of_a_frame_are_those_of_its_egos_without_the_index(two_egos: Evaluation) -> None:
    """Two egos, each with a tenth of four maps; two silent peers send nothing."""
    its = Bootstrap(two_egos, "zero", "norm", ways=WAYS)
    assert its.fleet_frame_bytes(SHARED) == [2 * 1638 * 160.0] * 5
    assert two_egos.index_bytes[UNDER].tolist() == [1024] * 10


def test_resampled_halves_are_drawn_by_other_numbers_than_the_split(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is in a half would otherwise say how often it is drawn. The halves are those of the plain split."""
    names: list[str] = []

    def noted(seed: int, replication: int, key: tuple[int, ...], name: str) -> np.random.Generator:
        names.append(name)
        return stream(seed, replication, key, name)

    monkeypatch.setattr(scores, "stream", noted)
    drawn, plain = split(40, 30, 3, resampled=True), split(40, 30, 3, resampled=False)
    for some, member in zip(drawn, plain, strict=True):
        assert ((some > 0) <= (member > 0)).all()
        assert (some.sum(axis=1) == 20).all()
    assert names[0] == names[2] != names[1]


def test_exchanges_go_by_what_drones_believe_and_by_the_settings_seed() -> None:
    """Peers by the overlap of the places they believe in, the disc on the grids as they believe, random peers by the seed."""
    frames, settings = astray([4, 4]), Settings(seed=6)
    key = frame_keys(frames)[1]
    target, view = mission_target(frames, 1, key, 6), MadeInstrument().look(frames, 1)
    assert target is not None
    conditions = [Sharing(0.05, "best-2"), Sharing(0.05, "random-2"), Sharing(0.05, roi=True), Sharing(0.05)]
    got = exchanges(view, frames, 1, key, conditions, settings, FULL, target)
    est = frames.est_pose[1]
    overlap = sharing.footprint_overlap(est[:, :2], np.full(5, sharing.FOOTPRINT_M))
    roi = sharing.in_disc(est, Disc(*target, REGION_M), FULL)
    plain = sharing.sending_order(view.rank("confidence"))
    steered = sharing.sending_order(view.rank("confidence"), roi)
    total = int(0.05 * 4 * 4096)
    for n, c in enumerate(conditions):
        for ego in range(5):
            e, count = got[5 * n + ego]
            assert e.peers == sharing.choose(c, ego, overlap[ego], key, 6)
            assert sum(count) == total
            order = (steered if c.roi else plain)[list(e.peers)]
            np.testing.assert_array_equal(e.sent, order < np.array(count)[:, None, None])
    by_truth = sharing.footprint_overlap(frames.true_pose[1][:, :2], np.full(5, sharing.FOOTPRINT_M))
    assert any(sharing.choose(conditions[0], k, by_truth[k]) != got[k][0].peers for k in range(5))
    assert any(sharing.choose(conditions[1], k, overlap[k], key) != got[5 + k][0].peers for k in range(5))


def test_targets_are_drawn_by_the_evaluations_seed_about_the_true_centre() -> None:
    frames = astray([4, 4, 5, 6])
    found = evaluate(MadeInstrument(), frames, [SINGLE], regions=("full", "ego"), egos=2, seed=3)
    keys = frame_keys(frames)
    wanted = [mission_target(frames, f, key, 3) for f, key in enumerate(keys)]
    assert [tuple(t) for t in found.target.tolist()] == wanted
    assert wanted != [mission_target(frames, f, key) for f, key in enumerate(keys)]
    for f in range(4):
        centre = frames.true_pose[f, :, :2].mean(axis=0)
        assert np.hypot(*(found.target[f] - centre)) <= sharing.FOOTPRINT_M
        for ego in range(2):  # the disc about an ego is where it truly is
            cars = truth(frames, f, ego, FULL).xy_m
            near = np.hypot(*(cars - frames.true_pose[f, ego, :2]).T) <= REGION_M
            assert found.units[SINGLE, "ego"][2 * f + ego].truths == near.sum()


def test_no_car_near_the_believed_centre_is_a_target() -> None:
    made = astray([4])
    centre = made.est_pose[0, :, :2].mean(axis=0)
    cars = made.cars.copy()
    cars[0, :, :2] = centre + np.array([1.0, 0.0])
    far = MadeFrames(made.true_pose - np.array([300.0, 0.0, 0.0]), made.est_pose, cars, made.scene)
    assert mission_target(far, 0, (4, 0)) is None


def test_the_truth_is_of_the_instruments_square() -> None:
    frames = made_frames([1])
    small, full = (truth(frames, 0, 2, g) for g in (SMALL, FULL))
    wanted = ground_truth(frames.cars[0], frames.true_pose[0, 2], 51.2)
    np.testing.assert_array_equal(small.xy_m, wanted.xy_m)
    assert 0 < len(small) < len(full)


def test_in_a_fleet_of_three_two_peers_are_all() -> None:
    """Conditions that differ in nothing there are computed once, and those of a half budget are not taken for whole ones."""
    made = made_frames([1, 2])
    frames = MadeFrames(made.true_pose[:, :3], made.est_pose[:, :3], made.cars, made.scene)
    instrument = MadeInstrument()
    all_2, best_2, half = (
        Sharing(1.0, "all-2"),
        Sharing(1.0, "best-2", cells_by="norm"),
        Sharing(0.5, "all-2", cells_by="norm"),
    )
    found = evaluate(instrument, frames, [all_2, best_2, half], egos=3)
    assert instrument.computed == 2 * 3 * 2
    assert found.cells[all_2].tolist() == found.cells[best_2].tolist() == [2 * 4096] * 6
    assert found.cells[half].tolist() == [4096] * 6
    assert half.plain(3).cells_by == "norm"


def test_a_picture_is_of_its_frame_ego_threshold_and_ways() -> None:
    frames, instrument = astray([7, 3]), MadeInstrument()
    seen = picture(instrument, frames, 1, ego=3, budgets=(0.03, 0.2), tau=0.35, cells_by="norm", ways=WAYS)
    key = frame_keys(frames)[1]
    target, view = mission_target(frames, 1, key), instrument.look(frames, 1)
    assert target is not None
    assert seen.disc == (*target, REGION_M)
    np.testing.assert_array_equal(seen.true_pose, frames.true_pose[1])
    np.testing.assert_array_equal(seen.est_pose, frames.est_pose[1])
    np.testing.assert_array_equal(seen.truth.xy_m, truth(frames, 1, 3, FULL).xy_m)
    conditions = [Sharing(1.0), *(under(Sharing(b), "zero", "norm", WAYS) for b in (0.03, 0.2))]
    given = exchanges(view, frames, 1, key, conditions, Settings(), FULL, target)
    full, *budgets = (e for e, _ in given if e.ego == 3)
    x, y, yaw = frames.est_pose[1, 3].tolist()
    wanted = suppress(Boxes.placed(view.detect([full], 0.35)[0], (x, y, yaw)), 0.15)
    np.testing.assert_array_equal(seen.found.xy_m, wanted.xy_m)
    assert 0 < len(wanted) < len(view.detect([full], 0.1)[0])
    for (budget, counts), exchange, asked in zip(seen.shared, budgets, (0.03, 0.2), strict=True):
        assert budget == asked
        np.testing.assert_array_equal(counts, sharers(exchange, frames.est_pose[1], FULL))
