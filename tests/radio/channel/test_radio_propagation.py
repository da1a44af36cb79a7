"""Two rays, antennas, earshot and shadowing in space against closed forms."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from wrong_rows import wrong_rows

from sortie.radio.channel.antenna import FLOOR_DB, antenna_loss_db
from sortie.radio.channel.draws import fade_table_db, normal_table
from sortie.radio.channel.pathloss import LIGHT_MPS, free_space_loss_db, path_loss_db, range_m, two_ray_loss_db
from sortie.radio.channel.shadowing import ShadowField, gauss_markov
from sortie.radio.channel.snr import earshot_m, noise_dbm
from sortie.radio.rates import CURVES, group_curve
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
    for roughness_m, alike in ((0.05, True), (0.0, False)):
        loss_db = two_ray_loss_db(d, 60.0, 60.0, 5.2, roughness_m)
        assert (np.abs(loss_db - free_space_loss_db(d, 5.2)).max() < 1e-3) == alike
        config = AirSettings(path_loss="two_ray", ground_roughness_m=roughness_m)
        np.testing.assert_array_equal(path_loss_db(config, d, 60.0, 60.0), loss_db)


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


def test_out_of_earshot_the_luckiest_frame_of_either_kind_fails() -> None:
    """A group frame fills 20 MHz with all of its power, a unicast one the channel: each is 2 dB short of half of its frames."""

    def check(sigma_db: float, group_mbps: float, bandwidth_mhz: int) -> None:
        c = AirSettings(bandwidth_mhz=bandwidth_mhz, group_rate_mbps=group_mbps, shadowing_sigma_db=sigma_db)
        lucky_dbm = c.tx_power_dbm + 5 * sigma_db + float(fade_table_db(c.rician_k_db)[-1])
        received_dbm = lucky_dbm - float(path_loss_db(c, earshot_m(c), 60.0, 60.0))
        short_db = (
            group_curve(group_mbps).snr_db(0.5) - (received_dbm - noise_dbm(20, c.noise_figure_db)),
            CURVES[0].snr_db(0.5) - (received_dbm - noise_dbm(bandwidth_mhz, c.noise_figure_db)),
        )
        assert min(short_db) == pytest.approx(2.0)

    assert wrong_rows(product([0.0, 3.5], [6.0, 24.0], [20, 40, 80]), check) == {}


def test_a_dipole_loses_nothing_broadside_and_half_at_39_degrees_off() -> None:
    """The half-power beam of a half-wave dipole is 78° wide (Balanis, §4.6)."""
    assert float(antenna_loss_db("dipole", 0.0)) == pytest.approx(0.0, abs=1e-9)
    assert float(antenna_loss_db("dipole", np.sin(np.radians(39.0)))) == pytest.approx(3.0, abs=0.03)
    assert antenna_loss_db("dipole", [1.0, -1.0]).tolist() == [FLOOR_DB, FLOOR_DB]
    assert antenna_loss_db("isotropic", [0.3, 1.0]).tolist() == [0.0, 0.0]


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


def test_shadowing_has_one_deviation_however_long_the_link() -> None:
    """Mean square of links of one length that lie far apart, over many fields."""

    def check(distance_m: float) -> None:
        ends = np.random.default_rng(4).random((30, 3)) * 20_000.0
        place = np.concatenate([ends, ends + np.array([distance_m, 0.0, 0.0])])
        fields = [ShadowField(3.5, 30.0, 4.5, seed, 0).between(place, 0.0) for seed in range(120)]
        assert np.sqrt(np.mean([np.diag(field, 30) ** 2 for field in fields])) == pytest.approx(3.5, rel=0.03)

    assert wrong_rows([7.5, 15.0, 30.0, 60.0], check) == {}


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
