"""The compiled loops over pairs give what numpy gives, bit for bit."""

from __future__ import annotations

import numpy as np

from sortie.radio.channel.crowd_loops import distances, shadowing
from sortie.radio.channel.draws import mix, normal_table
from sortie.radio.channel.shadowing import gauss_markov


def test_distances_are_numpys_and_a_pair_is_near_that_is_so_in_one_frame() -> None:
    rng = np.random.default_rng(4)
    at = rng.uniform(-900.0, 900.0, (7, 40, 3)).astype(np.float32)
    high, low = np.tril_indices(40, -1)
    step = at[:, low] - at[:, high]
    step *= step
    wanted = np.sqrt(step[..., 0] + step[..., 1] + step[..., 2])
    apart, near = np.empty_like(wanted), np.zeros(len(low), bool)
    near[3] = True  # one that is listed however far apart it is
    reach = np.float32(wanted[2, 5])
    distances(at, low, high, reach, apart, near)
    np.testing.assert_array_equal(apart, wanted)
    expected = (wanted <= reach).any(axis=0)
    assert 0 < expected.sum() < len(low)
    expected[3] = True
    np.testing.assert_array_equal(near, expected)


def test_shadowing_is_numpys_and_begins_anew_where_there_was_none() -> None:
    rng = np.random.default_rng(5)
    keys = rng.integers(0, 1 << 63, 500).astype(np.uint64)
    before = rng.normal(0.0, 4.0, 500).astype(np.float32)
    before[::3] = np.nan
    counters = mix(np.arange(64, 76, dtype=np.uint64))
    z = normal_table()[mix(keys[None, :] + counters[:, None]) >> np.uint64(48)]
    wanted = gauss_markov(z, 3.3, 0.97, before)
    found = np.empty((12, 500), np.float32)
    single = map(np.float32, (3.3, np.sqrt(1.0 - 0.97**2) * 3.3, 0.97))
    shadowing(keys, 64, normal_table(), *single, before, found)
    np.testing.assert_array_equal(found, wanted)
