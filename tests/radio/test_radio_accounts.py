"""A sample's accounts are the same whoever looks at them and whenever: fragments given up and bytes on the air."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from radio_flights import Hover, trace
from wrong_rows import wrong_rows

from sortie.radio import Status
from sortie.radio.settings import AirSettings, BurstSettings

CALM = AirSettings(shadowing_sigma_db=0.0, rician_k_db=40.0)


LONG = replace(CALM, tx_power_dbm=36.0, retry_limit=0, max_ampdu_frames=256, block_ack_window=256, fragment_bytes=64)
"""Many small fragments in each transmission, tried once."""


BYTES = 64 * 20_000


def lossy(folder: Path, loss: float) -> str:
    return trace(folder, f"0,0,1,,{loss},", "0,1,0,,0,")


def test_more_fragments_may_be_given_up_than_a_run_keeps(tmp_path: Path) -> None:
    """Ten to eighteen thousand between two looks: each is counted once, and none of them has arrived."""

    def check(loss: float, looks: int) -> None:
        fleet = Hover(replace(LONG, trace=lossy(tmp_path, loss)))

        def tick(frame: int) -> None:
            if frame == 0:
                fleet.send(0, 1, BYTES, deadline_s=0.95, piece_bytes=64)
                for k in range(looks):
                    fleet.env.timeout(0.01 * (k + 1)).callbacks.append(lambda _: fleet.air.goodput_mbps(0))

        (row,) = fleet.fly(1.0, tick).rows
        assert row.status is Status.PARTIAL
        assert row.fragments_lost + row.arrived_bytes // 64 == row.fragments == 20_000
        assert row.fragments_lost == pytest.approx(loss * 20_000, abs=4 * np.sqrt(loss * (1 - loss) * 20_000))

    assert wrong_rows(product([0.5, 0.9], [0, 3]), check) == {}


@pytest.mark.parametrize("piece_bytes", [1344, None])
def test_fragments_lost_do_not_depend_on_who_looks(piece_bytes: int | None, tmp_path: Path) -> None:
    settings = replace(CALM, trace=lossy(tmp_path, 0.8))
    found = set()
    for looks in (0, 10, 100):
        fleet = Hover(settings)

        def tick(frame: int, fleet: Hover = fleet, looks: int = looks) -> None:
            if frame == 0:
                fleet.send(0, 1, 1344 * 300, deadline_s=0.95, piece_bytes=piece_bytes)
            for k in range(looks):
                fleet.env.timeout(0.1 * k / looks).callbacks.append(lambda _: fleet.air.goodput_mbps(0))

        (row,) = fleet.fly(1.0, tick).rows
        found.add((row.fragments_lost, row.arrived_bytes, row.t_done_s))
    ((lost, arrived, _),) = found
    assert lost > 10
    assert arrived == ((300 - lost) * 1344 if piece_bytes else 0)


def test_a_sample_that_is_cut_short_tells_what_it_lost_until_then(tmp_path: Path) -> None:
    """Replaced in service: half of the fragments that it sent had used up their only try."""
    fleet = Hover(replace(CALM, retry_limit=0, trace=lossy(tmp_path, 0.5)))

    def tick(frame: int) -> None:
        if frame < 2:
            fleet.send(0, 1, 1344 * 6000, deadline_s=0.5)

    first = fleet.fly(0.3, tick).rows[0]
    assert (first.status, first.reason) == (Status.EXPIRED, "replaced")
    sent = first.wire_bytes / (1344 + 58)  # with their headers
    assert 1000 < sent < 6000
    assert 0.5 * (sent - 256) - 150 < first.fragments_lost < 0.5 * sent + 150  # a window of them was not yet answered


def test_what_was_sent_before_a_link_dies_or_its_receiver_goes_stays_counted() -> None:
    for reason, piece_bytes in (("no_link", 1344), ("no_link", None), ("receiver_gone", 1344)):
        fleet = Hover(replace(CALM, bandwidth_mhz=20)).fly(0.1)
        fleet.send(0, 1, 1344 * 2000, deadline_s=0.9, piece_bytes=piece_bytes)
        fleet.env.run(until=0.15)
        if reason == "receiver_gone":
            fleet.air.silence(1)
        for until_s in (0.2, 0.3):
            fleet.air.advance(np.full((2, 2), 200.0))
            fleet.env.run(until=until_s)
        (row,) = fleet.rows
        assert (row.status, row.reason) == (Status.PARTIAL if piece_bytes else Status.LOST, reason)
        assert row.wire_bytes >= max(row.arrived_bytes, 300_000), reason
        assert (row.arrived_bytes > 300_000) == bool(piece_bytes)
        assert fleet.air.counters.data_wire_bytes == row.wire_bytes


LOSSY = AirSettings(shadowing_sigma_db=0.0, retry_limit=0, bursts=BurstSettings(loss_good=0.5))


def test_bytes_that_arrived_are_those_of_the_pieces_that_did() -> None:
    """Of 53 pieces the last is shorter, and counts as what it is, whether it comes or not."""
    flight = Hover(LOSSY, n=2)
    flight.fly(8.0, lambda k: flight.send(0, 1, 52 * 200 + 30, piece_bytes=200))
    cut = [r for r in flight.rows if r.missing]
    assert {52 in r.missing for r in cut} == {True, False}
    for r in cut:
        assert r.arrived_bytes == sum(30 if k == 52 else 200 for k in range(53) if k not in r.missing)
