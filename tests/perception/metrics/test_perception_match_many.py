"""Matching many frames at once says what matching them one by one says."""

from __future__ import annotations

import numpy as np
import pytest

from sortie.perception.metrics import ap
from sortie.perception.types import Boxes


def boxes(rng: np.random.Generator, count: int) -> Boxes:
    """Crowded, so that detections compete; scores in tenths, so that they tie."""
    xy = rng.uniform(-5, 5, (count, 2)).astype(np.float32)
    size = np.tile(np.float32([4.5, 1.9]), (count, 1))
    yaw = rng.uniform(-0.1, 0.1, count).astype(np.float32)
    return Boxes(xy, size, yaw, (rng.integers(0, 10, count) / 10).astype(np.float32))


@pytest.mark.parametrize("batch", [1, 3, 64])
def test_frame_by_frame_or_all_at_once(batch: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ap, "MATCH_BATCH", batch)
    rng = np.random.default_rng(4)
    found = [boxes(rng, n) for n in (30, 0, 12, 0, 45, 1, 20)]
    truth = [boxes(rng, n) for n in (25, 3, 0, 0, 30, 1, 18)]
    many = ap.match_many(found, truth)
    assert sum(m.hit.sum() for m in many) > 20
    for one, f, t in zip(many, found, truth, strict=True):
        alone = ap.match(f, t)
        assert one.score.tolist() == alone.score.tolist()
        assert one.hit.tolist() == alone.hit.tolist()
        assert one.truths == alone.truths


def test_no_frames_no_matches() -> None:
    assert ap.match_many([], []) == []
