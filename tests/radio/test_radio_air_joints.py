"""What the air passes on to its parts and what it tells: usable links, ways back of traced ones, attitudes, the SNR of a row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import simpy
from radio_flights import Hover, trace

from sortie.radio import Air
from sortie.radio.settings import AirSettings
from sortie.radio.topology import connectivity

ROW_M = np.array([[0.0, 0.0, 60.0], [20.0, 0.0, 60.0], [0.0, 20.0, 60.0]])


def test_a_link_is_usable_by_its_snr_or_by_what_its_trace_says(tmp_path: Path) -> None:
    """Of a traced loss or goodput whatever carries anything, though its SNR be low; of a traced SNR that one."""
    rows = ("0,0,1,,,0", "0,1,0,,,3", "0,0,2,,1,", "0,2,0,,0.5,", "0,1,2,4,,")
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, trace=trace(tmp_path, *rows)), ROW_M).fly(0.2)
    mbps = flight.air.link_mbps()
    assert (mbps[0, 1], mbps[1, 0], mbps[0, 2]) == (0.0, 3.0, 0.0)
    for least_db, modelled, low in ((10.0, True, False), (3.0, True, True), (90.0, False, False)):
        usable = flight.air.usable(least_db)
        wanted = [[False, False, False], [True, False, low], [True, modelled, False]]
        assert usable.tolist() == wanted, least_db


@pytest.mark.parametrize("power_dbm", [20.0, -60.0])
def test_descriptors_over_the_way_back_of_a_traced_link_go_by_its_snr(power_dbm: float, tmp_path: Path) -> None:
    """Its trace says nothing of them: where the model's signal is too weak to be detected none comes."""
    rows = ("0,0,1,,0,",)
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=power_dbm, trace=trace(tmp_path, *rows)), ROW_M[:2])
    flight.fly(2.0, lambda k: [flight.publish(0), flight.publish(1)])
    heard = {sender: [ids for _, who, ids in flight.heard if who == sender] for sender in (0, 1)}
    assert heard[0] == [(1,)] * 20
    assert heard[1] == [(0,) if power_dbm > 0 else ()] * 20


def test_a_new_way_brings_its_attitudes_along() -> None:
    """From the next frame on: dipoles on their sides are blind to each other as if it had been planned so."""
    frames, n = 12, 3
    at = np.broadcast_to(ROW_M, (frames, n, 3))
    level, side = (np.broadcast_to(np.array(v), (frames, n, 3)) for v in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
    later = np.concatenate([level[:4], side[4:]])

    def flown(up: np.ndarray, new: np.ndarray | None) -> list[np.ndarray]:
        air = Air(
            simpy.Environment(), AirSettings(antenna="dipole", shadowing_sigma_db=0.0), at, seed=1, frame_s=0.1, up=up
        )
        found = []
        for frame in range(8):
            if frame == 4 and new is not None:
                air.reroute(at, new)
            air.advance()
            found.append(air.snr_db)
        return found

    planned, rerouted, unchanged = flown(later, None), flown(level, later), flown(level, None)
    np.testing.assert_allclose(rerouted, planned)
    assert planned[5][0, 1] < unchanged[5][0, 1] - 30.0  # both ends look along their axes
    assert planned[5][0, 2] == pytest.approx(unchanged[5][0, 2])


@pytest.mark.parametrize("hops", [1, 2])
def test_the_row_of_a_sample_that_was_never_served_has_the_snr_of_its_link_at_its_sending(hops: int) -> None:
    """Of this frame and not of the one before, which its sender knows; of the first hop."""
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, relay_max_hops=hops), ROW_M)
    flight.air.advance()
    flight.extra = np.array([[0.0, 7.0, 0.0], [0.0] * 3, [0.0] * 3])
    flight.air.advance(flight.extra)
    snr_db = flight.air.snr_db
    flight.send(0, 2, 2_000_000, kind="long", deadline_s=0.05)
    flight.send(0, 1, 1000, kind="waits", deadline_s=0.02)
    flight.env.run(until=0.06)
    (waited,) = [r for r in flight.rows if r.kind == "waits"]
    assert (waited.reason, waited.mcs) == ("deadline_queued", -1)
    assert waited.snr_db == pytest.approx(snr_db[0, 1])
    assert snr_db[0, 1] == pytest.approx(snr_db[1, 0] - 7.0)


def test_a_link_of_just_the_least_quality_holds_a_fleet_together() -> None:
    quality = np.array([[np.nan, 5.0, 1.0], [8.0, np.nan, 9.0], [1.0, 7.0, np.nan]])
    assert connectivity(quality, 5.0) == (True, (), (0, 1, 5.0))
    assert connectivity(quality, 5.1) == (False, (0,), (2, 1, 7.0)) == connectivity(quality, 7.0)
    assert connectivity(quality, 10.0) == (False, (1, 2), None)


def test_a_silenced_drone_answers_nobody(tmp_path: Path) -> None:
    """Also not who asks what has arrived of frames that were sent before."""
    settings = AirSettings(shadowing_sigma_db=0.0, trace=trace(tmp_path, "0,0,1,,0.9,"))
    asked = 0
    for seed in range(12):
        flight = Hover(settings, ROW_M[:2], seed=seed)
        flight.air.advance()
        flight.send(0, 1, 2500, deadline_s=0.09)
        flight.env.run(until=0.002)
        flight.air.silence(1)
        before_s = flight.air.airtime_s[1]
        flight.env.run(until=0.09)
        assert flight.air.airtime_s[1] == before_s, seed
        asked += [row.reason for row in flight.rows] == ["receiver_gone"]
    assert asked > 6
