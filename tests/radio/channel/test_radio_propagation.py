"""Two rays, antennas and shadowing in space against closed forms; large fleets against small ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simpy
from hypothesis import given
from hypothesis import strategies as st
from radio_examples import CROSS_M, still
from scipy import stats

from sortie.radio import Air
from sortie.radio.channel.antenna import FLOOR_DB, antenna_loss_db
from sortie.radio.channel.draws import fade_table_db, normal_table
from sortie.radio.channel.earshot import both_ways, near_pairs
from sortie.radio.channel.large_fleet import EPOCH
from sortie.radio.channel.pathloss import LIGHT_MPS, free_space_loss_db, path_loss_db, range_m, two_ray_loss_db
from sortie.radio.channel.shadowing import ShadowField, gauss_markov
from sortie.radio.channel.snr import OUT_OF_RANGE_DB, SQUARE, Channel, earshot_m
from sortie.radio.settings import AirSettings

# --- two rays ------------------------------------------------------------------------------------------


def test_beyond_the_break_point_the_loss_grows_by_40_db_a_decade() -> None:
    """There 40 log10(d) − 20 log10(h_a h_b), whatever the carrier (Rappaport, §4.6)."""
    h_a, h_b = 2.0, 1.5
    break_m = 4.0 * h_a * h_b * 2.4e9 / LIGHT_MPS
    d = break_m * np.array([50.0, 500.0])
    loss = two_ray_loss_db(d, h_a, h_b, 2.4)
    assert loss[1] - loss[0] == pytest.approx(40.0, abs=0.3)
    assert loss[1] == pytest.approx(40.0 * np.log10(d[1]) - 20.0 * np.log10(h_a * h_b), abs=0.1)


def test_within_the_break_point_it_swings_around_free_space_and_its_last_maximum_is_there() -> None:
    """With a mirror of −1 the ways differ by half a wavelength at the break point: the two rays add up to 6 dB."""
    h_a, h_b = 3.0, 2.0
    break_m = 4.0 * h_a * h_b * 2.4e9 / LIGHT_MPS
    d = np.linspace(0.5 * break_m, 3.0 * break_m, 20_001)
    gain = free_space_loss_db(d, 2.4) - two_ray_loss_db(d, h_a, h_b, 2.4)
    assert abs(d[gain.argmax()] / break_m - 1.0) < 0.05
    assert 5.0 < gain.max() <= 6.03
    near = np.linspace(20.0, 0.5 * break_m, 20_001)
    swing = free_space_loss_db(near, 2.4) - two_ray_loss_db(near, h_a, h_b, 2.4)
    assert swing.min() < -5.0
    assert (10 ** (swing / 10)).mean() == pytest.approx(1.0, abs=0.5)


def test_high_over_rough_ground_free_space_is_left() -> None:
    d = np.array([20.0, 60.0, 150.0])
    np.testing.assert_allclose(two_ray_loss_db(d, 60.0, 60.0, 5.2, 0.05), free_space_loss_db(d, 5.2), atol=1e-3)
    assert np.abs(two_ray_loss_db(d, 60.0, 60.0, 5.2, 0.0) - free_space_loss_db(d, 5.2)).max() > 0.1


def test_the_reflection_is_the_sum_of_two_phasors() -> None:
    """Written out from its geometry, with complex numbers and a sloping direct ray."""
    a, b = np.array([0.0, 0.0, 12.0]), np.array([80.0, 30.0, 4.0])
    image = a * [1, 1, -1]
    direct, around = np.linalg.norm(b - a), np.linalg.norm(b - image)
    grazing = np.arcsin(16.0 / around)
    root = np.sqrt(15.0 - np.cos(grazing) ** 2)
    mirror = (15.0 * np.sin(grazing) - root) / (15.0 * np.sin(grazing) + root)
    k = 2 * np.pi * 2.437e9 / LIGHT_MPS
    rough = np.exp(-2 * (k * 0.02 * np.sin(grazing)) ** 2)
    field = np.exp(-1j * k * direct) / direct + mirror * rough * np.exp(-1j * k * around) / around
    expected = -20 * np.log10(abs(field) / (2 * k))
    assert float(two_ray_loss_db(direct, 12.0, 4.0, 2.437, 0.02)) == pytest.approx(expected, abs=1e-6)


@given(st.sampled_from(["log_distance", "free_space", "two_ray"]), st.floats(60.0, 160.0))
def test_beyond_the_range_no_model_loses_less(model: str, loss_db: float) -> None:
    config = AirSettings(path_loss=model)
    far = range_m(config, loss_db) * np.geomspace(1.0, 30.0, 200)
    assert (path_loss_db(config, far, np.full(200, 7.0), np.full(200, 3.0)) >= loss_db - 1e-9).all()


# --- antennas ------------------------------------------------------------------------------------------


def test_a_dipole_loses_nothing_broadside_and_half_at_39_degrees_off() -> None:
    """The half-power beam of a half-wave dipole is 78° wide (Balanis, §4.6)."""
    assert float(antenna_loss_db("dipole", 0.0)) == pytest.approx(0.0, abs=1e-9)
    assert float(antenna_loss_db("dipole", np.sin(np.radians(39.0)))) == pytest.approx(3.0, abs=0.03)
    assert antenna_loss_db("dipole", [1.0, -1.0]).tolist() == [FLOOR_DB, FLOOR_DB]
    assert antenna_loss_db("isotropic", [0.3, 1.0]).tolist() == [0.0, 0.0]


def test_an_airframe_that_banks_turns_its_antenna_away() -> None:
    """Two drones side by side: one banks toward the other by 30°, its partner stays level."""
    up = np.zeros((3, 2, 3))
    up[:, :, 2] = 1.0
    up[1, 0] = [np.sin(np.radians(30)), 0.0, np.cos(np.radians(30))]  # rolls toward the east, where the other is
    up[2, 0] = [0.0, np.sin(np.radians(30)), np.cos(np.radians(30))]  # pitches across: still broadside
    config = AirSettings(shadowing_sigma_db=0.0, antenna="dipole")
    channel = Channel(config, still(CROSS_M[:2], 3), 1, 0, 0.1, up)
    snr = []
    for _ in range(3):
        channel.advance()
        snr.append(channel.snr_db[[0, 1], [1, 0]])
    lost = float(antenna_loss_db("dipole", 0.5))
    assert 1.5 < lost < 2.5
    np.testing.assert_allclose(snr[0] - snr[1], [lost, lost])
    np.testing.assert_allclose(snr[0], snr[2], atol=1e-9)
    level = Channel(config, still(CROSS_M[:2], 3), 1, 0, 0.1)
    level.advance()
    np.testing.assert_allclose(level.snr_db[[0, 1], [1, 0]], snr[0])


def test_a_dipole_hardly_hears_a_jammer_below_it() -> None:
    heard = {}
    for antenna in ("isotropic", "dipole"):
        channel = Channel(AirSettings(shadowing_sigma_db=0.0, antenna=antenna), still(CROSS_M[:2]), 1, 0, 0.1)
        channel.advance()
        clear = channel.snr_db[1, 0]
        channel.advance(None, [((0.0, 0.0, 0.0), 50.0)])
        heard[antenna] = clear - channel.snr_db[1, 0]
    assert heard["isotropic"] - heard["dipole"] == pytest.approx(FLOOR_DB, abs=0.01)


def test_drones_have_antennas_of_their_own_in_small_fleets_and_large_ones() -> None:
    """One above the other, a dipole loses most: once for each end that has one."""
    above = still(np.array([[0.0, 0.0, 40.0], [0.0, 0.0, 80.0]]))
    many = still(np.concatenate([above[0], [[5000.0 * k, 5000.0, 60.0] for k in range(1, 40)]]))
    for places in (above, many):
        snr = []
        for own in ({}, {1: "dipole"}, {0: "dipole", 1: "dipole"}):
            config = AirSettings(shadowing_sigma_db=0.0, own_antennas=own)
            channel = Channel(config, places, 1, 0, 0.1)
            channel.advance()
            snr.append([channel.snr_db[0, 1], channel.snr_db[1, 0]])
        np.testing.assert_allclose(np.subtract(snr[0], snr[1]), FLOOR_DB, atol=1e-3)
        np.testing.assert_allclose(np.subtract(snr[0], snr[2]), 2 * FLOOR_DB, atol=1e-3)
    with pytest.raises(ValueError, match=r"own_antennas\[1\] is 'yagi', must be one of \['isotropic', 'dipole'\]"):
        AirSettings(own_antennas={1: "yagi"})  # type: ignore[dict-item]


# --- shadowing in space --------------------------------------------------------------------------------


def _field_samples(moves: np.ndarray, t_s: float, fields: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Shadowing of a long link before and after both its ends have moved, in many fields."""
    ends = np.array([[0.0, 0.0, 60.0], [400.0, 0.0, 60.0]])
    before, after = [], []
    for seed in range(fields):
        field = ShadowField(3.5, 30.0, 4.5, seed, 0)
        before.append(field.between(ends, 0.0)[0, 1])
        after.append(field.between(ends + moves, t_s)[0, 1])
    return np.array(before), np.array(after)


@pytest.mark.parametrize(
    ("moves", "t_s", "expected"),
    [
        ([[15, 0, 0], [0, 0, 0]], 0.0, np.exp(-0.5)),  # one end
        ([[0, 18, 24], [0, 15, 0]], 0.0, np.exp(-1.0 - 0.5)),  # both
        ([[0, 0, 0], [0, 0, 0]], 4.5, np.exp(-1.0)),  # neither: the surroundings change
        ([[0, 9, 0], [12, 0, 0]], 1.0, np.exp(-0.3 - 0.4 - 1 / 4.5)),
    ],
)
def test_shadowing_loses_its_memory_as_gudmundson_says(moves: list, t_s: float, expected: float) -> None:
    before, after = _field_samples(np.array(moves, float), t_s)
    assert before.std() == pytest.approx(3.5, rel=0.06)
    assert np.corrcoef(before, after)[0, 1] == pytest.approx(expected, abs=4 * (1 - expected**2) / np.sqrt(1500))


def test_shadowing_is_normal_symmetric_and_shared_between_neighbours() -> None:
    place = np.array([[0, 0, 60], [3, 0, 60], [300, 0, 60], [303, 0, 60], [0, 300, 60]], float)
    squares = np.array([ShadowField(3.5, 30.0, 4.5, seed, 0).between(place, 1.0) for seed in range(1200)])
    np.testing.assert_allclose(squares, np.swapaxes(squares, 1, 2))
    assert stats.kstest(squares[:, 0, 2] / 3.5, "norm").pvalue > 1e-3
    assert squares[:, 0, 1].std() == pytest.approx(3.5, rel=0.08)  # also where the ends are near one another
    near = np.corrcoef(squares[:, 0, 2], squares[:, 1, 3])[0, 1]
    far = np.corrcoef(squares[:, 0, 2], squares[:, 0, 4])[0, 1]
    assert near == pytest.approx(np.exp(-0.2), abs=0.04)  # two links whose ends are 3 m apart each
    assert abs(far) < 0.12  # one end is shared, the other is 424 m off


@pytest.mark.parametrize("distance_m", [7.5, 15.0, 30.0, 60.0])
def test_shadowing_has_one_deviation_however_long_the_link(distance_m: float) -> None:
    """Mean square of links of one length that lie far apart, over many fields."""
    ends = np.random.default_rng(4).random((30, 3)) * 20_000.0
    place = np.concatenate([ends, ends + np.array([distance_m, 0.0, 0.0])])
    fields = [ShadowField(3.5, 30.0, 4.5, seed, 0).between(place, 0.0) for seed in range(120)]
    assert np.sqrt(np.mean([np.diag(field, 30) ** 2 for field in fields])) == pytest.approx(3.5, rel=0.03)


def test_the_channel_takes_its_shadowing_from_the_field() -> None:
    config = AirSettings(shadowing_distance_m=30.0)
    five, six = Channel(config, still(CROSS_M[:5]), 9, 2, 0.1), Channel(config, still(CROSS_M), 9, 2, 0.1)
    for _ in range(3):
        five.advance()
        six.advance()
    np.testing.assert_allclose(five.snr_db, six.snr_db[:5, :5])
    expected = ShadowField(3.5, 30.0, config.shadowing_time_s, 9, 2).between(CROSS_M, 0.2)
    off = ~np.eye(6, dtype=bool)
    np.testing.assert_allclose(six.shadow_db[off], expected[off])


# --- large fleets ----------------------------------------------------------------------------------------

NEAR = AirSettings(tx_power_dbm=0.0, path_loss_exponent=3.0)


def _wide_fleet(n: int, frames: int = 70) -> np.ndarray:
    """Drones in a square that grows with their number, all flying east; the first n are the same for every n."""
    rng = np.random.default_rng(3)
    start = np.concatenate([np.concatenate([rng.random((1, 2)), np.full((1, 1), 0.06)], axis=1) for _ in range(n)])
    drift = np.arange(frames)[:, None, None] * np.array([0.5, 0.0, 0.0])
    return 1000.0 * start + drift * (np.arange(n) % 7)[None, :, None]


def test_a_large_fleet_works_out_just_the_links_within_earshot() -> None:
    positions = _wide_fleet(120)
    channel = Channel(NEAR, positions, 1, 0, 0.1)
    far_m = earshot_m(NEAR)
    assert 100.0 < far_m < 600.0
    for frame in range(70):
        channel.advance()
        p = positions[frame]
        apart = np.sqrt(((p[:, None] - p[None]) ** 2).sum(axis=-1))
        listed = channel.snr_db > OUT_OF_RANGE_DB
        near = (apart <= far_m) & ~np.eye(120, dtype=bool)
        assert (listed | ~near).all()
        assert listed.sum() < 1.3 * near.sum()
        assert 0.02 < near.mean() < 0.5
        np.testing.assert_allclose(channel.shadow_db, channel.shadow_db.T, equal_nan=True)


def test_links_of_a_large_fleet_do_not_depend_on_how_many_more_there_are() -> None:
    few, many = (Channel(NEAR, _wide_fleet(n), 5, 1, 0.1) for n in (90, 130))
    small = Channel(NEAR, _wide_fleet(SQUARE), 5, 1, 0.1)
    for _ in range(2 * EPOCH + 3):
        for channel in (few, many, small):
            channel.advance()
        np.testing.assert_array_equal(few.snr_db, many.snr_db[:90, :90])
        both = few.snr_db[:SQUARE, :SQUARE] > OUT_OF_RANGE_DB
        np.testing.assert_allclose(few.snr_db[:SQUARE, :SQUARE][both], small.snr_db[both], atol=1e-4)


@pytest.mark.parametrize(("sigma_db", "k_db"), [(3.5, 12.0), (0.0, 40.0)])
def test_nothing_out_of_earshot_is_heard(sigma_db: float, k_db: float) -> None:
    """A small fleet works every link out: beyond earshot, in 1000 frames of 32 drones, no link carries a descriptor."""
    config = replace(NEAR, shadowing_sigma_db=sigma_db, rician_k_db=k_db, preamble_detection_dbm=-110.0)
    positions = np.repeat(_wide_fleet(SQUARE, 1), 1000, axis=0) * earshot_m(config) / 235.0
    apart = np.sqrt(((positions[0][:, None] - positions[0][None]) ** 2).sum(axis=-1))
    heard = np.zeros((SQUARE, SQUARE), int)
    env = simpy.Environment()
    air = Air(env, config, positions, seed=2, frame_s=0.1)
    for frame in range(1000):
        env.run(until=0.1 * frame + 1e-3)
        air.advance()
        for i in range(SQUARE):
            air.broadcast(i, 20, lambda ids, i=i: np.add.at(heard[i], ids, 1))
    env.run(until=100.0)
    beyond = apart > earshot_m(config)
    assert beyond.sum() > 500
    assert heard[beyond].sum() == 0
    assert heard.sum() > 1000
    assert sigma_db or apart[heard > 0].max() > 0.5 * earshot_m(config)


def test_a_descriptor_reaches_drones_of_a_large_fleet_within_earshot_in_the_order_of_their_ids() -> None:
    positions = _wide_fleet(120) * [0.4, 0.4, 1.0]
    far_m, heard = earshot_m(NEAR), []
    env = simpy.Environment()
    air = Air(env, NEAR, positions, seed=1, frame_s=0.1)
    for frame in range(70):
        env.run(until=0.1 * frame + 1e-3)
        air.advance()
        apart = np.sqrt(((positions[frame][:, None] - positions[frame][None]) ** 2).sum(axis=-1))
        for i in range(0, 120, 13):
            near = set(np.flatnonzero(apart[i] <= far_m).tolist())
            air.broadcast(i, 208, lambda ids, near=near: heard.append((list(ids), near)))
    env.run(until=7.0)
    assert len(heard) == 70 * 10
    assert sum(len(ids) for ids, _ in heard) > 300
    for ids, near in heard:
        assert ids == sorted(ids)
        assert set(ids) <= near


def test_shadowing_by_counter_has_the_distribution_of_that_by_stream() -> None:
    n = SQUARE + 16
    place = np.random.default_rng(1).random((n, 3)) * 30.0
    channel = Channel(AirSettings(), still(place, 640), 4, 0, 0.1)
    shadows = []
    for _ in range(640):
        channel.advance()
        shadows.append(channel.shadow_db[SQUARE:, :SQUARE].ravel())
    s = np.array(shadows)
    assert s.std() == pytest.approx(3.5, rel=0.03)
    assert (s[:-10] * s[10:]).mean() / s.var() == pytest.approx(np.exp(-1 / 4.5), abs=0.03)


def test_tables_are_their_distributions() -> None:
    assert normal_table().std() == pytest.approx(1.0, abs=1e-4)
    gain = 10 ** (fade_table_db(12.0) / 10)
    assert gain.mean() == pytest.approx(1.0, abs=1e-4)
    assert (np.diff(gain) >= 0).all()


def test_a_gauss_markov_process_goes_on_over_a_gap_in_its_block() -> None:
    z = np.random.default_rng(0).standard_normal((40, 3))
    whole = gauss_markov(z, 2.0, 0.9, None)
    first = gauss_markov(z[:15], 2.0, 0.9, None)
    np.testing.assert_allclose(gauss_markov(z[15:], 2.0, 0.9, first[-1]), whole[15:])
    begun = gauss_markov(z[15:], 2.0, 0.9, np.array([first[-1, 0], np.nan, first[-1, 2]]))
    np.testing.assert_allclose(begun[:, [0, 2]], whole[15:][:, [0, 2]])
    assert begun[0, 1] == 2.0 * z[15, 1]


def test_every_pair_in_range_is_listed_both_ways() -> None:
    p = np.random.default_rng(2).random((5, 80, 3)) * 100.0
    low, high, distance = near_pairs(p, 25.0)
    links = both_ways(80, low, high)
    apart = np.sqrt(((p[:, :, None] - p[:, None]) ** 2).sum(axis=-1))
    near = (apart.min(axis=0) <= 25.0) & ~np.eye(80, dtype=bool)
    assert np.argwhere(near).tolist() == np.stack([links.sender, links.receiver], axis=1).tolist()
    assert links.begin == [0, *np.cumsum(near.sum(axis=1)).tolist()]
    np.testing.assert_allclose([links.of_pairs(row) for row in distance], apart[:, links.sender, links.receiver])
    assert (np.diff(high * 80 + low) > 0).all()


@pytest.mark.parametrize("frame", [0, 4])
def test_a_pair_that_is_near_in_the_first_or_last_frame_alone_is_listed(frame: int) -> None:
    """Both ends fly away from one another, or towards one another: 20 m each between that frame and the middle one."""
    p = np.zeros((5, 2, 3))
    p[:, 0, 0] = -12.0 - 10.0 * abs(np.arange(5) - frame)
    p[:, 1] = -p[:, 0]
    low, high, distance = near_pairs(p, 25.0)
    assert (low.tolist(), high.tolist()) == ([0], [1])
    np.testing.assert_allclose(distance[:, 0], 24.0 + 20.0 * abs(np.arange(5) - frame))


def test_broken_attitudes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"up has shape \(4, 2, 2\), must be \(4, 2, 3\), as positions_m"):
        Channel(AirSettings(), np.zeros((4, 2, 3)), 1, 0, 0.1, np.zeros((4, 2, 2)))
    with pytest.raises(ValueError, match="up holds a value that is not finite"):
        Channel(AirSettings(), np.zeros((4, 2, 3)), 1, 0, 0.1, np.full((4, 2, 3), np.inf))
