"""Two rays, antennas, earshot, shadowing in space, and path losses and link models of one's own."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy import stats
from wrong_rows import wrong_rows

from sortie.radio.channel.antenna import FLOOR_DB, antenna_loss_db
from sortie.radio.channel.draws import fade_table_db, normal_table
from sortie.radio.channel.pathloss import LIGHT_MPS, free_space_loss_db, path_loss_db, range_m, two_ray_loss_db
from sortie.radio.channel.shadowing import ShadowField, gauss_markov
from sortie.radio.channel.snr import OUT_OF_RANGE_DB, Channel, earshot_m, noise_dbm
from sortie.radio.rates import CURVES, group_curve
from sortie.radio.settings import AirSettings
from sortie.scenarios.plugins.reference import PluginError

# --- two rays ------------------------------------------------------------------------------------------


def test_beyond_the_break_point_the_loss_grows_by_40_db_a_decade() -> None:
    """There 40 log10(d) − 20 log10(h_a h_b), whatever the carrier (Rappaport, §4.6)."""
    h_a, h_b = 2.0, 1.5
    break_m = 4.0 * h_a * h_b * 2.4e9 / LIGHT_MPS
    d = break_m * np.array([50.0, 500.0])
    loss = two_ray_loss_db(d, h_a, h_b, 2.4)
    assert loss[1] - loss[0] == pytest.approx(40.0, abs=0.3)
    assert loss[1] == pytest.approx(40.0 * np.log10(d[1]) - 20.0 * np.log10(h_a * h_b), abs=0.1)


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
    """A group frame fills 20 MHz with all of its power, a unicast one the channel: each lacks 2 dB for a half."""

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


RNG = np.random.default_rng(1)
DRIFT_M = np.arange(8.0)[:, None, None] * np.array([0.5, 0.2, 0.0])
FIVE_M = RNG.uniform(-200.0, 200.0, (1, 5, 3)) + DRIFT_M
CROWD_M = RNG.uniform(-200.0, 200.0, (1, 40, 3)) + DRIFT_M


def wall(distance_m: Any, height_a_m: Any, height_b_m: Any, carrier_ghz: float, *, wall_db: float = 12.0) -> Any:
    return free_space_loss_db(np.maximum(distance_m, 1.0), carrier_ghz) + wall_db


class Less:
    """Takes 3 dB a frame from every link, and keeps what it was shown."""

    def __init__(self, drones: int, frame_s: float, rng: np.random.Generator) -> None:
        self.made, self.seen = (drones, frame_s), []

    def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
        self.seen.append((t_s, positions_m))
        return snr_db - 3.0


def channel(flight: Any, **settings: Any) -> Channel:
    made = Channel(AirSettings(**settings), flight, 1, 0, 0.1)
    made.advance()
    return made


def test_a_path_loss_takes_the_place_of_the_built_in_one_for_links_and_for_jammers() -> None:
    jammer = [((0.0, 0.0, 60.0), 20.0)]
    for flight in (FIVE_M, CROWD_M):
        free, walled = channel(flight, path_loss="free_space"), channel(flight, path_loss=wall)
        assert_allclose(walled.snr_db, free.snr_db - 12.0, atol=1e-4)
        quiet_mw, loud_mw = (10.0 ** (c.noise_rise_db(jammer) / 10.0) - 1.0 for c in (walled, free))
        assert_allclose(quiet_mw, loud_mw * 10.0**-1.2, rtol=1e-6)


def test_a_link_model_reaches_every_link_of_a_large_fleet() -> None:
    """Also those that the built-in models leave out, because nobody would hear anything there."""

    class Good(Less):
        def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
            return np.full_like(snr_db, 30.0)

    weak: dict[str, Any] = {"tx_power_dbm": -12.0, "path_loss_exponent": 3.0}
    assert (channel(CROWD_M, **weak).snr_db == OUT_OF_RANGE_DB).any()
    good_db = channel(CROWD_M, **weak, link=Good).snr_db
    assert (good_db[~np.eye(40, dtype=bool)] == 30.0).all()


@pytest.mark.parametrize("flight", [FIVE_M, CROWD_M], ids=["five", "forty"])
def test_a_link_model_changes_every_link_frame_by_frame(flight: Any) -> None:
    """It is shown each frame's places. Events and jammers act on what it returns."""
    made: list[Less] = []

    def keep(*args: Any) -> Less:
        made.append(Less(*args))
        return made[0]

    plain, own = channel(flight), channel(flight, link=keep)
    extra, jammer = np.full((flight.shape[1],) * 2, 7.0), [((0.0, 0.0, 60.0), 10.0)]
    for how in ((), (extra,), (None, jammer)):
        plain.advance(*how)
        own.advance(*how)
        assert_allclose(own.snr_db, plain.snr_db - 3.0, atol=1e-4)
        assert np.isnan(np.diagonal(own.snr_db)).all()
    (model,) = made
    assert model.made == (flight.shape[1], 0.1)
    for frame, (t_s, places_m) in enumerate(model.seen):
        assert t_s == pytest.approx(0.1 * frame)
        assert_allclose(places_m, flight[frame])


def test_a_link_model_cannot_change_the_flight() -> None:
    class Moves(Less):
        def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
            positions_m += 1e6
            snr_db += 1.0
            return snr_db - 1.0

    plain, own = channel(FIVE_M), channel(FIVE_M, link=Moves)
    for _ in range(3):
        assert_allclose(own.snr_db, plain.snr_db)
        plain.advance()
        own.advance()


def test_a_path_loss_cannot_change_the_distances_that_antennas_and_jammers_use() -> None:
    def by_kilometres(distance_m: Any, height_a_m: Any, height_b_m: Any, carrier_ghz: float) -> Any:
        distance_m /= 1000.0
        height_a_m += 1e3
        height_b_m -= 1e3
        return free_space_loss_db(np.maximum(1000.0 * distance_m, 1.0), carrier_ghz)

    plain, own = (channel(FIVE_M, antenna="dipole", path_loss=loss) for loss in ("free_space", by_kilometres))
    assert_allclose(own.snr_db, plain.snr_db)
    jammer = [((0.0, 0.0, 60.0), 20.0)]
    assert_allclose(own.noise_rise_db(jammer), plain.noise_rise_db(jammer))


def test_its_random_numbers_are_its_own_and_the_same_each_time() -> None:
    class Random(Less):
        def __init__(self, drones: int, frame_s: float, rng: np.random.Generator) -> None:
            self._rng = rng

        def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
            return snr_db + self._rng.normal(size=snr_db.shape)

    one, again, plain = channel(FIVE_M, link=Random), channel(FIVE_M, link=Random), channel(FIVE_M)
    assert_allclose(one.snr_db, again.snr_db)
    assert_allclose(one.shadow_db, plain.shadow_db, err_msg="shadowing is drawn as without it")


def test_no_frame_is_heard_beyond_the_range_of_a_path_loss_of_ones_own() -> None:
    settings = AirSettings(path_loss=wall)
    far_m = range_m(settings, 100.0) * np.geomspace(1.0, 30.0, 100)
    assert (path_loss_db(settings, far_m, 10.0, 10.0) >= 100.0).all()


def returning(change: Callable[..., Any]) -> type[Less]:
    class Own(Less):
        def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
            return change(snr_db)

    return Own


REFUSED = [
    (
        {"path_loss": lambda d, a, b, c: 0.0 * d},
        r"path_loss <lambda>: 0.0 dB at [\d.]+ m, must be at least [\d.]+ dB, that of",
    ),
    ({"path_loss": lambda d, a, b, c: d + np.nan}, "path_loss <lambda>: returns nan, must be finite$"),
    ({"path_loss": lambda d, a, b, c: [1.0, 2.0]}, r"path_loss <lambda>: returns shape \(2,\), must be \(8, 25\)$"),
    ({"path_loss": lambda d: d}, "path_loss <lambda>: TypeError: .*takes 1 positional argument but 4 were given"),
    ({"link": returning(lambda snr: snr[0])}, r"link Own.snr_db: returns shape \(5,\), must be \(5, 5\)$"),
    ({"link": returning(lambda snr: snr + np.inf)}, "link Own.snr_db: returns inf, must be finite$"),
]


def test_a_model_that_returns_something_else_is_refused() -> None:
    def check(settings: dict[str, Any], message: str) -> None:
        with pytest.raises(PluginError, match=f"^{message}"):
            channel(FIVE_M, **settings)

    assert wrong_rows(REFUSED, check) == {}
