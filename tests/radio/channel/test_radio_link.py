"""Path loss, shadowing, fading and rates against closed forms and independent computations."""

from __future__ import annotations

import numpy as np
import pytest
from radio_examples import CROSS_M, fades_db, still
from scipy import integrate, stats

from sortie.radio.channel.pathloss import free_space_loss_db, log_distance_loss_db
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
)
from sortie.radio.settings import AirSettings


def step(channel: Channel, *args: object) -> np.ndarray:
    """The next frame's SNR, [N, N]."""
    channel.advance(*args)
    return channel.snr_db


@pytest.mark.parametrize(
    ("carrier_ghz", "distance_m", "loss_db"),
    [
        *[(2.437, 1, 40.2), (2.437, 20, 66.2), (2.437, 100, 80.2), (2.437, 300, 89.7)],
        *[(5.2, 1, 46.8), (5.2, 20, 72.8), (5.2, 100, 86.8), (5.2, 300, 96.3)],
    ],
)
def test_free_space_loss_is_friis(carrier_ghz: float, distance_m: float, loss_db: float) -> None:
    assert float(free_space_loss_db(distance_m, carrier_ghz)) == pytest.approx(loss_db, abs=0.06)
    assert float(log_distance_loss_db(distance_m, carrier_ghz, 2.0)) == pytest.approx(loss_db, abs=0.06)


def test_log_distance_adds_ten_times_the_exponent_a_decade_and_stops_at_one_metre() -> None:
    near, far = log_distance_loss_db([10.0, 100.0], 5.2, 2.7)
    assert far - near == pytest.approx(27.0)
    assert log_distance_loss_db(0.0, 5.2, 2.7) == log_distance_loss_db(1.0, 5.2, 2.7)


@pytest.mark.parametrize(("bandwidth_mhz", "dbm"), [(20, -94.0), (40, -91.0), (80, -88.0)])
def test_noise_floor(bandwidth_mhz: int, dbm: float) -> None:
    assert noise_dbm(bandwidth_mhz, 7.0) == pytest.approx(dbm, abs=0.05)


def test_snr_without_shadowing_is_the_link_budget() -> None:
    channel = Channel(AirSettings(shadowing_sigma_db=0.0), still(CROSS_M[:2]), 1, 0, 0.1)
    snr = step(channel)
    assert snr[0, 1] == pytest.approx(20.0 - float(log_distance_loss_db(20.0, 5.2, 2.1)) - noise_dbm(80, 7.0))
    assert np.isnan(np.diag(snr)).all()
    extra = np.array([[0.0, 30.0], [0.0, 0.0]])
    again = step(channel, extra)
    np.testing.assert_allclose((snr - again)[[0, 1], [1, 0]], [30.0, 0.0], atol=1e-9)


def test_a_jammer_adds_its_received_power_to_the_noise() -> None:
    channel = Channel(AirSettings(shadowing_sigma_db=0.0), still(CROSS_M[:2]), 1, 0, 0.1)
    clear = step(channel)
    where = (20.0, 50.0, 60.0)
    received = [20.0 - float(log_distance_loss_db(d, 5.2, 2.1)) for d in (np.hypot(20, 50), 50.0)]
    jammed = step(channel, None, [(where, 20.0)])
    for sender, receiver in ((0, 1), (1, 0)):
        rise = 10 * np.log10(1 + 10 ** ((received[receiver] - channel.noise_dbm) / 10))
        assert clear[sender, receiver] - jammed[sender, receiver] == pytest.approx(rise)


def _shadowing(frames: int) -> np.ndarray:
    channel = Channel(AirSettings(), still(CROSS_M), 3, 0, 0.1)
    rows = []
    for _ in range(frames):
        channel.advance()
        rows.append(channel.shadow_db[np.triu_indices(6, 1)])
    return np.array(rows)


def test_shadowing_is_symmetric_and_has_its_deviation_and_autocorrelation() -> None:
    channel = Channel(AirSettings(), still(CROSS_M), 3, 0, 0.1)
    channel.advance()
    channel.advance()
    np.testing.assert_array_equal(channel.shadow_db, channel.shadow_db.T)
    x = _shadowing(12_000)  # 1200 s × 15 pairs, about 2000 independent values
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


def test_what_interferes_in_one_frame_leaves_the_others_as_they_were() -> None:
    clear, disturbed = (Channel(AirSettings(), still(CROSS_M), 4, 0, 0.1) for _ in range(2))
    for frame in range(30):
        expected = step(clear)
        if frame % 3 == 1:
            assert np.nanmax(step(disturbed, np.full((6, 6), 10.0)) - expected) == pytest.approx(-10.0)
        else:
            np.testing.assert_array_equal(step(disturbed), expected)


def test_a_flight_of_many_blocks_is_one_flight() -> None:
    """Blocks hold fewer frames the more drones there are; a drone far off changes nothing but their length."""
    path = np.cumsum(np.full((2100, 2, 3), 0.01), axis=0) + CROSS_M[:2]
    crowd = np.concatenate([path, np.full((2100, 22, 3), 5000.0)], axis=1)
    two, many = Channel(AirSettings(), path, 1, 0, 0.1), Channel(AirSettings(), crowd, 1, 0, 0.1)
    for _ in range(2100):
        np.testing.assert_array_equal(step(two), step(many)[:2, :2])


@pytest.mark.parametrize("distance_m", [None, 30.0])
@pytest.mark.parametrize("antenna", ["isotropic", "dipole"])
def test_a_flight_that_goes_another_way_is_as_if_it_had_been_planned(distance_m: float | None, antenna: str) -> None:
    """From the next frame on; what is drawn stays, within a block and across its end."""
    config = AirSettings(**{"shadowing_distance_m": distance_m, "antenna": antenna})
    planned = still(CROSS_M, 1300)
    other = planned.copy()
    other[700:, 2] += np.linspace(0, 40, 600)[:, None] * np.array([0.6, 0.8, 0.1])
    changed, known = Channel(config, planned, 1, 0, 0.1), Channel(config, other, 1, 0, 0.1)
    for frame in range(1300):
        if frame == 700:
            changed.reroute(other)
        changed.advance()
        known.advance()
        assert np.array_equal(changed.snr_db, known.snr_db, equal_nan=True)
        assert changed.now.rows_db[2][1] == known.now.rows_db[2][1]
    with pytest.raises(ValueError, match=r"positions_m has shape \(1300, 4, 3\), must be \(1300, 6, 3\) and finite"):
        changed.reroute(other[:, :4])


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"positions_m has shape \(3, 3\), must be \(frames, drones, 3\)"):
        Channel(AirSettings(), np.zeros((3, 3)), 1, 0, 0.1)
    with pytest.raises(ValueError, match=r"positions_m has shape \(9, 0, 3\), must be \(frames, drones, 3\)"):
        Channel(AirSettings(), np.zeros((9, 0, 3)), 1, 0, 0.1)
    with pytest.raises(ValueError, match="positions_m holds a value that is not finite"):
        Channel(AirSettings(), np.full((9, 2, 3), np.nan), 1, 0, 0.1)
    with pytest.raises(ValueError, match=r"frame_s is 0\.0, must be > 0"):
        Channel(AirSettings(), np.zeros((9, 1, 3)), 1, 0, 0.0)
    channel = Channel(AirSettings(), np.zeros((1, 2, 3)), 1, 0, 0.1)
    with pytest.raises(ValueError, match=r"extra_loss_db has shape \(3, 3\), must be \(2, 2\)"):
        channel.advance(np.zeros((3, 3)))
    with pytest.raises(IndexError, match="the flight has 1 frames"):
        channel.advance()


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


def test_basic_rates_have_curves_of_their_own() -> None:
    assert [group_curve(rate) for rate in LEGACY_CURVES] == list(LEGACY_CURVES.values())
    assert group_curve(1.0) is LEGACY_CURVES[6.0]
    assert group_curve(9.0) is LEGACY_CURVES[12.0]
    halves_db = [curve.snr_db(0.5, 334) for curve in LEGACY_CURVES.values()]
    assert halves_db == sorted(halves_db)
    assert all(legacy > he.snr_db(0.5, 334) for legacy, he in zip(halves_db, CURVES, strict=False))  # no LDPC
