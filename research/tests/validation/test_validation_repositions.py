"""Viewpoints in flight: drones truly move when their policy asks, and nothing at all is different where none does."""

from __future__ import annotations

import pytest

from research.validation import repositions


@pytest.mark.parametrize(
    ("seeds", "duration_s", "message"),
    [
        (1, 60.0, "1 seeds, must be at least 2"),
        (2, 5.0, "duration_s is 5, must be above 5, when tracking begins"),
    ],
)
def test_gains_that_cannot_be_measured_are_refused(seeds: int, duration_s: float, message: str) -> None:
    """One sortie has no interval, and one that ends before it tracks has no accuracy: it was NaN."""
    with pytest.raises(ValueError, match=f"^{message}$"):
        list(repositions.measure(range(seeds), duration_s))
