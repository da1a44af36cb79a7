"""What research adds to the product's evaluation: labels, equal conditions computed once, threads."""

import numpy as np
import pytest
from harness_examples import MadeFrames, MadeInstrument, made_frames

from research.paper.scores import Bootstrap
from research.paper.ways import FULL_SHARING, SINGLE, Sharing, evaluate

THREE = (SINGLE, Sharing(0.1, "best-2", roi=True), FULL_SHARING)


@pytest.fixture
def frames() -> MadeFrames:
    return made_frames([7, 7, 3, 9, 9])


def test_labels_have_the_words_of_research() -> None:
    several = Sharing(0.1, "all-4", "overlap", "masked", True, cells_by="norm", absent="zeros")
    assert several.label == "all-4@0.1,overlap,masked,roi,norm,zeros"
    assert Sharing.parse(several.label) == several
    with pytest.raises(ValueError, match="cells_by is 'luck', must be confidence or norm"):
        Sharing(0.1, cells_by="luck")


def test_conditions_that_differ_in_nothing() -> None:
    parse = Sharing.parse
    assert parse("best-4@0.1").plain() == parse("worst-4@0.1").plain() == parse("all-4@0.1")
    assert parse("best-2@0.1").plain() == parse("best-2@0.1")
    assert parse("all-4@1,overlap,norm,roi").plain() == FULL_SHARING
    assert parse("best-2@0.5,norm").plain() == parse("best-2@0.5"), "half of full sharing is all that two have"
    assert parse("best-2@0.49,norm").plain() == parse("best-2@0.49,norm")
    assert parse("all-4@0,masked").plain() == SINGLE
    assert parse("all-4@0").plain() == parse("all-4@0"), "four silent peers still dilute"
    assert parse("best-2@0.1,zeros").plain() == parse("best-2@0.1,zeros"), "two absent peers dilute"
    assert parse("all-4@0.1,zeros").plain() == parse("all-4@0.1"), "nobody is absent"
    assert parse("best-2@0.1,masked,zeros").plain() == parse("best-2@0.1,masked")
    assert parse("best-2@0.4").plain(drones=3) == parse("all-2@0.4")


def test_equal_conditions_are_computed_once(frames: MadeFrames) -> None:
    instrument = MadeInstrument()
    twins = (*THREE, Sharing(0.1, "best-4"), Sharing(0.1, "worst-4"), Sharing(1.0, cells_by="norm"), SINGLE)
    found = evaluate(instrument, frames, twins)
    assert instrument.computed == 4 * 25
    assert found.conditions == twins[:-1]
    assert found.ap(Sharing(1.0, cells_by="norm")) == found.ap(FULL_SHARING)
    assert found.cells[Sharing(0.1, "worst-4")].tolist() == [1638] * 25


def test_workers_change_nothing(frames: MadeFrames) -> None:
    seen: list[tuple[int, int]] = []
    one = evaluate(MadeInstrument(), frames, THREE)
    several = evaluate(MadeInstrument(), frames, THREE, workers=3, progress=lambda *done: seen.append(done))
    for key, units in one.units.items():
        for a, b in zip(units, several.units[key], strict=True):
            assert np.array_equal(a.score, b.score)
            assert np.array_equal(a.hit, b.hit)
    assert seen == [(k, 5) for k in range(1, 6)]


def test_a_worker_is_told_to_start_and_its_error_comes_out(frames: MadeFrames) -> None:
    class Broken(MadeInstrument):
        started = 0

        def start_worker(self) -> None:
            Broken.started += 1

        def look(self, frames: object, frame: int) -> object:
            raise RuntimeError(f"no light in frame {frame}")

    with pytest.raises(RuntimeError, match="no light in frame 0"):
        evaluate(Broken(), frames, THREE, workers=2)
    assert 1 <= Broken.started <= 2


def test_what_is_resampled_is_in_our_convention(frames: MadeFrames) -> None:
    """Intervals of another AP than the one beside them would look like any others."""
    found = evaluate(MadeInstrument(), frames, [FULL_SHARING], convention="uav3d")
    with pytest.raises(
        ValueError, match=r"^the evaluation's convention is 'uav3d', must be 'rotated' to be resampled$"
    ):
        Bootstrap(found, "zero")
