"""The link budget, shadowing, fading and rates against closed forms and independent computations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from radio_examples import CROSS_M, fades_db, moving, still, tilting
from scipy import integrate, stats
from wrong_rows import wrong_rows

from sortie.radio.channel.antenna import antenna_loss_db
from sortie.radio.channel.pathloss import free_space_loss_db, log_distance_loss_db, path_loss_db
from sortie.radio.channel.snr import Channel, noise_dbm
from sortie.radio.rates import (
    CURVES,
    LEGACY_CURVES,
    NO_LINK_PER,
    STANDARDS,
    choose_mcs,
    group_curve,
    per,
    rate_table,
    rescale,
    snr_index,
)
from sortie.radio.settings import AirSettings


def step(channel: Channel, *args: object) -> np.ndarray:
    """The next frame's SNR, [N, N]."""
    channel.advance(*args)
    return channel.snr_db


def test_free_space_loss_is_friis_and_the_noise_floor_that_of_the_bandwidth() -> None:
    distance_m = np.array([1.0, 20.0, 100.0, 300.0])
    for carrier_ghz, loss_db in ((2.437, [40.2, 66.2, 80.2, 89.7]), (5.2, [46.8, 72.8, 86.8, 96.3])):
        assert free_space_loss_db(distance_m, carrier_ghz) == pytest.approx(loss_db, abs=0.06)
        assert log_distance_loss_db(distance_m, carrier_ghz, 2.0) == pytest.approx(loss_db, abs=0.06)
    assert [noise_dbm(mhz, 7.0) for mhz in (20, 40, 80)] == pytest.approx([-94.0, -91.0, -88.0], abs=0.05)


def test_log_distance_adds_ten_times_the_exponent_a_decade_and_stops_at_one_metre() -> None:
    near, far = log_distance_loss_db([10.0, 100.0], 5.2, 2.7)
    assert far - near == pytest.approx(27.0)
    assert log_distance_loss_db(0.0, 5.2, 2.7) == log_distance_loss_db(1.0, 5.2, 2.7)


@pytest.mark.parametrize("antenna", ["isotropic", "dipole"])
@pytest.mark.parametrize("path_loss", ["log_distance", "two_ray"])
def test_every_frame_is_the_link_budget_of_that_frame(antenna: Any, path_loss: Any) -> None:
    """With jammers, losses that differ by direction, tilted antennas of some drones: by hand, link by link."""
    n, frames = 4, 40
    own = {1: "isotropic"} if antenna == "dipole" else {2: "dipole"}
    config = AirSettings(
        shadowing_sigma_db=0.0, antenna=antenna, own_antennas=own, path_loss=path_loss, ground_roughness_m=0.0
    )
    at, up = moving(frames, n), tilting(frames, n)
    channel = Channel(config, at, 1, 0, 0.1, up)
    extra = np.arange(n * n, dtype=float).reshape(n, n)
    jammers = [((50.0, 40.0, 10.0), 15.0), ((-80.0, 0.0, 90.0), 25.0)]
    pattern = config.antennas(n)

    def lost_db(drone: int, toward: np.ndarray, frame: int) -> float:
        cosine = toward @ up[frame, drone] / np.linalg.norm(toward)
        return float(antenna_loss_db(pattern[drone], cosine))

    for frame in range(frames):
        channel.advance(extra, jammers)
        for j in range(n):
            noise_mw = 10 ** (channel.noise_dbm / 10)
            for place, power_dbm in jammers:
                away = at[frame, j] - place
                loss = float(path_loss_db(config, np.linalg.norm(away), at[frame, j, 2], place[2]))
                noise_mw += 10 ** ((power_dbm - loss - lost_db(j, away, frame)) / 10)
            for i in set(range(n)) - {j}:
                away = at[frame, i] - at[frame, j]
                loss = float(path_loss_db(config, np.linalg.norm(away), at[frame, i, 2], at[frame, j, 2]))
                loss += lost_db(i, away, frame) + lost_db(j, away, frame) + extra[i, j]
                wanted = config.tx_power_dbm - loss - 10 * np.log10(noise_mw)
                assert channel.snr_db[i, j] == pytest.approx(wanted, abs=1e-6), (frame, i, j)


def test_a_sender_knows_the_frame_before_whatever_has_changed_since() -> None:
    """Jammer, loss and motion show in what it knows one frame later, and then as they were."""
    at = still(CROSS_M[:3], 10).copy()
    at[5:, 1, 0] += 100.0
    channel = Channel(AirSettings(), at, 1, 0, 0.1)
    jammers = [((0.0, 30.0, 60.0), 10.0)]
    channel.advance()
    was = channel.now.square_db
    np.testing.assert_array_equal(channel.before.square_db, was)  # in the first frame its own
    for frame in range(1, 10):
        extra = None if frame % 3 else np.full((3, 3), float(frame))
        channel.advance(extra, jammers if frame % 2 else ())
        np.testing.assert_array_equal(channel.before.square_db, was)
        assert not np.allclose(channel.now.square_db[0, 1], was[0, 1], atol=1e-6)
        was = channel.now.square_db


def _shadowing(frames: int) -> np.ndarray:
    channel = Channel(AirSettings(), still(CROSS_M), 3, 0, 0.1)
    rows = []
    for _ in range(frames):
        channel.advance()
        rows.append(channel.shadow_db[np.triu_indices(6, 1)])
    return np.array(rows)


def test_shadowing_is_symmetric_and_has_its_deviation_and_autocorrelation() -> None:
    channel, rows = Channel(AirSettings(), still(CROSS_M), 3, 0, 0.1), []
    for _ in range(12_000):  # 1200 s × 15 pairs, about 2000 independent values
        channel.advance()
        rows.append(channel.shadow_db[np.triu_indices(6, 1)])
    np.testing.assert_array_equal(channel.shadow_db, channel.shadow_db.T)
    x = np.array(rows)
    assert x.std() == pytest.approx(3.5, rel=0.08)
    lagged = (x[:-10] * x[10:]).mean() / x.var()
    assert lagged == pytest.approx(np.exp(-1 / 4.5), abs=0.03)  # 0.80 at one second


def test_fading_is_rician_in_mean_and_outage() -> None:
    gains = 10 ** (fades_db(AirSettings(rician_k_db=8.0), 6, 4000)[:, ~np.eye(6, dtype=bool)] / 10)
    envelope = np.sqrt(gains.ravel())  # 120,000 values
    k = 10**0.8
    rice = stats.rice(b=np.sqrt(2 * k), scale=np.sqrt(1 / (2 * (k + 1))))
    assert envelope.mean() == pytest.approx(rice.mean(), rel=2e-3)
    assert (envelope**2).mean() == pytest.approx(1.0, rel=4e-3)
    for depth_db in (-3.0, -6.0, -9.0):
        outage = rice.cdf(10 ** (depth_db / 20))
        assert (envelope < 10 ** (depth_db / 20)).mean() == pytest.approx(outage, abs=4 * np.sqrt(outage / 120_000))
    bound = 4 / np.sqrt(gains.size)
    assert abs(np.corrcoef(gains[:-1].ravel(), gains[1:].ravel())[0, 1]) < bound  # from one frame to the next
    assert abs(np.corrcoef(gains[:, :-1].ravel(), gains[:, 1:].ravel())[0, 1]) < bound  # from one link to another


def test_a_fade_is_of_a_direction_and_of_an_exchange_or_a_frame() -> None:
    own, frame = (fades_db(AirSettings(fading=name), 3, 400, per_frame=2) for name in ("exchange", "frame"))
    off = ~np.eye(3, dtype=bool)
    for fades in (own, frame):
        assert (fades != fades.transpose(0, 2, 1))[:, off].mean() > 0.99
    assert (frame[0::2] == frame[1::2])[:, off].all()
    assert (own[0::2] != own[1::2])[:, off].mean() > 0.99
    assert (frame[1:-1:2] != frame[2::2])[:, off].mean() > 0.99


def test_a_sixth_drone_leaves_the_links_of_the_first_five_as_they_were() -> None:
    five, six = Channel(AirSettings(), still(CROSS_M[:5]), 9, 2, 0.1), Channel(AirSettings(), still(CROSS_M), 9, 2, 0.1)
    for _ in range(1100):  # past the first block of draws
        a, b = step(five), step(six)
        np.testing.assert_array_equal(a, b[:5, :5])
    other = Channel(AirSettings(), still(CROSS_M[:5]), 9, 3, 0.1)
    assert not np.array_equal(step(other), a, equal_nan=True)
    fades = fades_db(AirSettings(), 5, 50, seed=9)
    off = ~np.eye(5, dtype=bool)
    np.testing.assert_array_equal(fades[:, off], fades_db(AirSettings(), 6, 50, seed=9)[:, :5, :5][:, off])
    assert (fades != fades_db(AirSettings(), 5, 50, seed=10))[:, off].mean() > 0.99


def test_a_flight_of_many_blocks_is_one_flight() -> None:
    """Blocks hold fewer frames the more drones there are; a drone far off changes nothing but their length."""
    path = np.cumsum(np.full((2100, 2, 3), 0.01), axis=0) + CROSS_M[:2]
    crowd = np.concatenate([path, np.full((2100, 22, 3), 5000.0)], axis=1)
    two, many = Channel(AirSettings(), path, 1, 0, 0.1), Channel(AirSettings(), crowd, 1, 0, 0.1)
    for _ in range(2100):
        np.testing.assert_array_equal(step(two), step(many)[:2, :2])


def test_wrong_shapes_are_refused() -> None:
    one = Channel(AirSettings(), np.zeros((1, 2, 3)), 1, 0, 0.1)
    nan, flat = np.full((9, 2, 3), np.nan), np.zeros((9, 2, 3))
    rows = [
        (lambda: Channel(AirSettings(), np.zeros((3, 3)), 1, 0, 0.1), r"positions_m has shape \(3, 3\), must be \(fra"),
        (lambda: Channel(AirSettings(), np.zeros((9, 0, 3)), 1, 0, 0.1), r"positions_m has shape \(9, 0, 3\), must be"),
        (lambda: Channel(AirSettings(), nan, 1, 0, 0.1), "positions_m holds a value that is not finite"),
        (lambda: Channel(AirSettings(), flat, 1, 0, 0.0), r"frame_s is 0\.0, must be > 0"),
        (
            lambda: Channel(AirSettings(), flat, 1, 0, 0.1, flat[..., :2]),
            r"up has shape \(9, 2, 2\), must be \(9, 2, 3",
        ),
        (lambda: Channel(AirSettings(), flat, 1, 0, 0.1, nan), "up holds a value that is not finite"),
        (lambda: one.advance(np.zeros((3, 3))), r"extra_loss_db has shape \(3, 3\), must be \(2, 2\)"),
        (lambda: one.reroute(flat), r"positions_m has shape \(9, 2, 3\), must be \(1, 2, 3\) and finite"),
        (lambda: [one.advance() for _ in range(2)], "the flight has 1 frames"),
    ]

    def check(call: Callable[[], object], message: str) -> None:
        with pytest.raises((ValueError, IndexError), match=message):
            call()

    assert wrong_rows(rows, check) == {}


# --- rates -----------------------------------------------------------------------------------------


def test_per_follows_its_curve_and_scales_with_length() -> None:
    curve = CURVES[5]
    assert per(curve.centre_db, 5) == pytest.approx(1.0 - 0.5**curve.weight)
    half_db = curve.snr_db(0.5)
    assert per(half_db, 5) == pytest.approx(0.5)
    assert per(half_db, 5, 2 * 1458) == pytest.approx(0.75)
    assert per(curve.snr_db(1e-9, 300), 5, 300) == pytest.approx(1e-9)
    assert rescale(0.5, 2.0) == pytest.approx(0.75)
    assert per(-500.0, 11) == 1.0
    assert per(500.0, 0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("k_db", [0.0, 12.0])
@pytest.mark.parametrize(("snr_db", "mcs"), [(6.0, 1), (20.0, 7), (33.0, 11)])
def test_mean_per_is_the_average_over_a_rice_envelope(k_db: float, snr_db: float, mcs: int) -> None:
    k = 10 ** (k_db / 10)
    rice = stats.rice(b=np.sqrt(2 * k), scale=np.sqrt(1 / (2 * (k + 1))))
    r = np.linspace(1e-4, 4.0, 400_001)
    values = np.array([per(snr_db + g, mcs, 1494) for g in 20 * np.log10(r[::20])])
    expected = integrate.trapezoid(values * rice.pdf(r[::20]), r[::20])
    table = rate_table(80, k_db, 1494)
    assert table.all_per[mcs][table.index(snr_db)] == pytest.approx(expected, abs=2e-3)


def test_the_chosen_mcs_has_the_highest_goodput() -> None:
    table = rate_table(80, 12.0)
    for snr_db in np.arange(-1.5, 45.0, 0.5):
        mcs, rate, mean_per = choose_mcs(snr_db, 80, 12.0)
        goodputs = [
            r * (1 - table.all_per[m][table.index(snr_db)]) for m, r in enumerate(STANDARDS["ax"].rates_mbps[80])
        ]
        assert rate * (1 - mean_per) == max(goodputs)
        assert goodputs[mcs] == max(goodputs)


def test_no_link_below_mcs_zero_and_the_top_rate_above() -> None:
    assert choose_mcs(-30.0, 80, 12.0) == (-1, 0.0, 1.0)
    assert choose_mcs(200.0, 80, 12.0)[:2] == (11, 600.5)
    table = rate_table(20, 12.0)
    edge = table.mcs.index(0)
    assert table.all_per[0][edge] <= NO_LINK_PER < table.all_per[0][edge - 1]


def test_basic_rates_have_curves_of_their_own_or_of_the_next_above() -> None:
    for rate, wanted in ((1.0, 6.0), (6.0, 6.0), (6.5, 12.0), (9.0, 12.0), (12.0, 12.0), (53.0, 54.0), (54.0, 54.0)):
        assert group_curve(rate) is LEGACY_CURVES[wanted]
    halves_db = [curve.snr_db(0.5, 334) for curve in LEGACY_CURVES.values()]
    assert halves_db == sorted(halves_db)
    assert all(legacy > he.snr_db(0.5, 334) for legacy, he in zip(halves_db, CURVES, strict=False))  # no LDPC


def test_a_rate_table_is_read_at_the_nearest_of_its_points() -> None:
    table = rate_table(80, 12.0)
    for snr_db in (-7.013, 0.026, 3.0, 11.349, 29.874):
        at_db = -20.0 + 0.05 * snr_index(snr_db)
        assert abs(at_db - snr_db) <= 0.025 + 1e-9
        assert table.at(snr_db) == table.at(at_db)
    assert (snr_index(-500.0), snr_index(500.0)) == (0, len(table.mcs) - 1)
