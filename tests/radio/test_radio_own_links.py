"""Path losses and link models from outside: they act on every link, and what they may not return is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from wrong_rows import wrong_rows

from sortie.radio.channel.pathloss import free_space_loss_db, path_loss_db, range_m
from sortie.radio.channel.snr import OUT_OF_RANGE_DB, Channel
from sortie.radio.settings import AirSettings
from sortie.scenarios.plugins.reference import PluginError

RNG = np.random.default_rng(1)
DRIFT_M = np.arange(8.0)[:, None, None] * np.array([0.5, 0.2, 0.0])
FIVE = RNG.uniform(-200.0, 200.0, (1, 5, 3)) + DRIFT_M
CROWD = RNG.uniform(-200.0, 200.0, (1, 40, 3)) + DRIFT_M


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
    for flight in (FIVE, CROWD):
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
    assert (channel(CROWD, **weak).snr_db == OUT_OF_RANGE_DB).any()
    good_db = channel(CROWD, **weak, link=Good).snr_db
    assert (good_db[~np.eye(40, dtype=bool)] == 30.0).all()


@pytest.mark.parametrize("flight", [FIVE, CROWD], ids=["five", "forty"])
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

    plain, own = channel(FIVE), channel(FIVE, link=Moves)
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

    plain, own = (channel(FIVE, antenna="dipole", path_loss=loss) for loss in ("free_space", by_kilometres))
    assert_allclose(own.snr_db, plain.snr_db)
    jammer = [((0.0, 0.0, 60.0), 20.0)]
    assert_allclose(own.noise_rise_db(jammer), plain.noise_rise_db(jammer))


def test_its_random_numbers_are_its_own_and_the_same_each_time() -> None:
    class Random(Less):
        def __init__(self, drones: int, frame_s: float, rng: np.random.Generator) -> None:
            self._rng = rng

        def snr_db(self, t_s: float, positions_m: Any, snr_db: Any) -> Any:
            return snr_db + self._rng.normal(size=snr_db.shape)

    one, again, plain = channel(FIVE, link=Random), channel(FIVE, link=Random), channel(FIVE)
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
            channel(FIVE, **settings)

    assert wrong_rows(REFUSED, check) == {}
