"""Percentiles in passes against numpy's, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.sim.results import selection
from sortie.sim.results.selection import percentiles

numbers = st.lists(
    st.one_of(
        st.floats(allow_nan=False, width=64, min_value=-1e300, max_value=1e300), st.sampled_from([0.0, -0.0, 0.1, 0.2])
    )
)


@given(st.lists(numbers, max_size=5), st.tuples(st.floats(0, 100), st.sampled_from([0.0, 50.0, 99.0, 100.0])))
def test_equal_to_numpys(pieces: list[list[float]], of: tuple[float, float]) -> None:
    arrays = [np.array(piece, float) for piece in pieces]
    every = np.concatenate([np.zeros(0), *arrays])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selection, "IN_MEMORY", 0)
        found = percentiles(lambda: arrays, of)
    if not len(every):
        assert found is None
    else:
        assert found == np.percentile(every, of).tolist() == percentiles(lambda: arrays, of)


def test_many_numbers_from_many_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "IN_MEMORY", 1000)
    draws = np.random.default_rng(1).exponential(0.1, 200_001)
    found = percentiles(lambda: np.split(draws, 7 * [0] + [5, 70_000]), (50.0, 99.0))
    assert found == np.percentile(draws, [50, 99]).tolist()
