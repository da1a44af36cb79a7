"""One frame as the data figure: cells where their senders' cells lie, boxes where they were found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from paper_examples import MadeFrames, MadeInstrument, made_frames

from research.paper import figure_frame, figures
from research.paper.picture import picture, sharers
from research.paper.ways import Serve, Ways
from sortie.perception.evaluation.harness import REGION_M
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.geometry import CELLS, FULL, to_world


@pytest.fixture
def frames() -> MadeFrames:
    return made_frames(1)


def test_a_cell_is_shared_where_its_sender_has_it() -> None:
    rng = np.random.default_rng(0)
    pose = np.array([(3.0, -8.0, 0.7), (23.0, 1.0, -2.0), (-9.0, 14.0, 0.9)])
    sent = rng.random((2, CELLS, CELLS)) < 0.1
    got = sharers(Exchange(0, (1, 2), sent), pose, FULL)
    by_hand = np.zeros((CELLS, CELLS), int)
    for i in range(CELLS):
        for j in range(CELLS):
            x, y = to_world(np.array((i - 31.5) * 3.2), np.array((j - 31.5) * 3.2), pose[0])
            for peer, mask in zip((1, 2), sent, strict=True):
                turn = np.exp(-1j * pose[peer, 2]) * complex(x - pose[peer, 0], y - pose[peer, 1])
                r, c = int(np.floor(turn.real / 3.2)) + 32, int(np.floor(turn.imag / 3.2)) + 32
                by_hand[i, j] += 0 <= r < CELLS and 0 <= c < CELLS and bool(mask[r, c])
    assert (got == by_hand).all()
    assert got.max() == 2


def test_peers_at_the_egos_own_pose_add_up() -> None:
    sent = np.random.default_rng(0).random((4, CELLS, CELLS)) < 0.3
    pose = np.tile([5.0, 6.0, 1.0], (5, 1))
    assert (sharers(Exchange(2, (0, 1, 3, 4), sent), pose, FULL) == sent.sum(axis=0)).all()


def test_a_picture_has_what_was_there_what_was_found_and_what_was_shared(frames: MadeFrames) -> None:
    seen = picture(MadeInstrument(), frames, 0, ego=3, budgets=(0.25, 0.02))
    assert seen.truth.xy_m == pytest.approx(frames.cars[0, :2, :2]), "the far car is outside the ego's square"
    assert seen.found.xy_m[:2] == pytest.approx(frames.cars[0, :2, :2], abs=1e-4), (
        "placed by the pose it was found from"
    )
    assert seen.disc == (*frames.cars[0, 0, :2], 32.0)
    wide, narrow = (counts for _, counts in seen.shared)
    assert 1024 * 4 * 0.5 < wide.sum() <= 1024 * 4 * 1.3
    assert 0 < narrow.sum() < wide.sum() / 5
    assert seen.shared[0][0] == 0.25


def test_a_picture_shows_the_cells_that_are_served_first(frames: MadeFrames) -> None:
    """A budget that the mission's disc uses up: no cell beyond it is shared, but for the estimated poses' error."""
    centre = (np.arange(CELLS) + 0.5 - CELLS / 2) * FULL.cell_m
    x, y = to_world(*np.meshgrid(centre, centre, indexing="ij"), frames.est_pose[0, 0])

    def furthest(serve: Serve) -> float:
        seen = picture(MadeInstrument(), frames, 0, budgets=(0.02,), ways=Ways(serve=serve))
        assert seen.disc is not None
        apart = np.hypot(x - seen.disc.x_m, y - seen.disc.y_m)
        return float(apart[seen.shared[0][1] > 0].max())

    assert furthest("region_first") < REGION_M + FULL.cell_m < furthest("grid")


@pytest.mark.parametrize(
    ("frame", "ego", "message"), [(1, 0, "frame is 1, must be 0 to 0"), (0, 5, "ego is 5, must be 0 to 4")]
)
def test_what_is_not_there_is_named(frames: MadeFrames, frame: int, ego: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        picture(MadeInstrument(), frames, frame, ego=ego)


def test_the_figure_is_drawn_with_and_without_views(frames: MadeFrames, tmp_path: Path) -> None:
    views = np.zeros((5, 5, 90, 160, 3), np.uint8)
    for name, images in (("with.png", views), ("without.png", None)):
        figures.save(figure_frame.draw(picture(MadeInstrument(), frames, 0, views=images)), tmp_path / name)
    assert (tmp_path / "with.png").read_bytes() != (tmp_path / "without.png").read_bytes()
