"""A sample's accounts are the same whoever looks at them and whenever: fragments given up, bytes on the air, who replaces whom."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from radio_examples import CROSS_M
from radio_flights import Hover, trace

from sortie.radio import Status
from sortie.radio.channel.earshot import near_pairs
from sortie.radio.settings import AirSettings

CALM = AirSettings(shadowing_sigma_db=0.0, rician_k_db=40.0)
LONG = replace(CALM, tx_power_dbm=36.0, retry_limit=0, max_ampdu_frames=256, block_ack_window=256, fragment_bytes=64)
"""Many small fragments in each transmission, tried once."""
BYTES = 64 * 20_000


def lossy(folder: Path, loss: float) -> str:
    return trace(folder, f"0,0,1,,{loss},", "0,1,0,,0,")


@pytest.mark.parametrize("loss", [0.5, 0.9])
@pytest.mark.parametrize("looks", [0, 3])
def test_more_fragments_may_be_given_up_than_a_run_keeps(loss: float, looks: int, tmp_path: Path) -> None:
    """Ten to eighteen thousand between two looks: each is counted once, and none of them has arrived."""
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


@pytest.mark.parametrize("piece_bytes", [1344, None])
def test_what_was_sent_before_a_link_dies_stays_counted(piece_bytes: int | None) -> None:
    fleet = Hover(replace(CALM, bandwidth_mhz=20))

    def tick(frame: int) -> None:
        if frame == 0:
            fleet.send(0, 1, 1344 * 2000, deadline_s=0.9, piece_bytes=piece_bytes)
            fleet.extra = np.full((2, 2), 200.0)  # from the next frame on

    (row,) = fleet.fly(0.5, tick).rows
    assert row.reason == "no_link"
    assert row.wire_bytes > 1_000_000
    assert row.wire_bytes >= row.arrived_bytes
    assert fleet.air.counters.data_wire_bytes == row.wire_bytes


def test_what_was_sent_before_the_receiver_went_stays_counted() -> None:
    fleet = Hover(replace(CALM, bandwidth_mhz=20))

    def tick(frame: int) -> None:
        if frame == 0:
            fleet.send(0, 1, 1344 * 2000, deadline_s=0.9, piece_bytes=1344)
            fleet.env.timeout(0.05).callbacks.append(lambda _: fleet.air.silence(1))

    (row,) = fleet.fly(0.5, tick).rows
    assert (row.status, row.reason) == (Status.PARTIAL, "receiver_gone")
    assert row.wire_bytes >= row.arrived_bytes > 300_000


# --- large fleets ---------------------------------------------------------------------------------


@pytest.mark.parametrize("drones", [32, 33])
def test_a_traced_link_is_there_however_far_apart_its_ends_are(drones: int, tmp_path: Path) -> None:
    """In fleets of every size: only links within earshot are worked out in large ones, and those of the trace."""
    at = np.array([[1000.0 * i, 0.0, 60.0] for i in range(drones)])
    settings = replace(
        CALM,
        tx_power_dbm=-12.0,
        path_loss_exponent=3.0,
        trace=trace(tmp_path, "0,0,1,30,,", "0,1,0,30,,", "0,2,0,,0,50"),
    )
    fleet = Hover(settings, at, spread=0.0)

    def tick(frame: int) -> None:
        if frame == 0:
            for sender, receiver in ((0, 1), (2, 0), (0, 2)):
                fleet.send(sender, receiver, 10_000, deadline_s=0.05)
            fleet.env.timeout(0.06).callbacks.append(lambda _: fleet.publish(0))

    fleet.fly(0.1, tick)
    fates = {(row.sender, row.receiver): row.status for row in fleet.rows}
    assert fates == {(0, 1): Status.DELIVERED, (2, 0): Status.DELIVERED, (0, 2): Status.LOST}
    assert [ids for _, _, ids in fleet.heard] == [(1,)]


def test_pairs_that_are_always_listed_stand_in_order_among_the_near_ones() -> None:
    at = np.array([[[0.0, 0, 0], [500, 0, 0], [10, 0, 0], [510, 0, 0]]])
    low, high, apart = near_pairs(at, 50.0, [(0, 3), (0, 2), (1, 2)])
    assert list(zip(low.tolist(), high.tolist(), apart[0].tolist(), strict=True)) == [
        (0, 2, 10.0), (1, 2, 490.0), (0, 3, 510.0), (1, 3, 10.0),
    ]  # fmt: skip
    assert near_pairs(at, 5.0, [(0, 1)])[0].tolist() == [0]


# --- relays ---------------------------------------------------------------------------------------

WAYS: Mapping[int, list[int]] = {0: [0, 1, 4, 2, 3], 1: [0, 2, 3]}


class _Ways:
    """Routes by the order in which samples leave drone 0: the first goes a longer way than the second."""

    max_hops = 4

    def __init__(self, ways: Mapping[int, list[int]]) -> None:
        self._ways, self._left = ways, 0

    def renew(self, _: object) -> None: ...

    def next_hop(self, here: int, target: int, hops: int) -> int:
        if target != 3:
            return target
        if here == 0:
            self._left += 1
            return self._ways[self._left - 1][1]
        return next(way[way.index(here) + 1] for way in self._ways.values() if here in way)


def test_an_older_sample_on_a_longer_way_does_not_replace_a_newer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drone 2 has the newer one waiting behind other traffic when the older one comes."""
    fleet = Hover(replace(CALM, relay_max_hops=4), CROSS_M[:5], spread=0.0)
    monkeypatch.setattr(fleet.air, "_routes", _Ways(WAYS))
    numbers = []

    def tick(frame: int) -> None:
        if frame == 0:
            fleet.send(2, 1, 4_000_000, kind="other", deadline_s=0.5)
            fleet.send(1, 2, 1_000_000, kind="other", deadline_s=0.5)  # drone 1 passes the older one on late
            numbers.append(fleet.send(0, 3, 20_000, deadline_s=0.5))
            fleet.env.timeout(8e-3).callbacks.append(lambda _: numbers.append(fleet.send(0, 3, 20_000, deadline_s=0.5)))

    fleet.fly(0.6, tick)
    fates = {row.number: (row.status, row.reason) for row in fleet.rows}
    assert [fates[n] for n in numbers] == [(Status.EXPIRED, "replaced"), (Status.DELIVERED, "")]


@pytest.mark.parametrize("loss", [0.0, 0.4])
def test_a_sample_that_waits_in_a_relay_was_queued_whether_it_was_repaired_before_or_not(
    loss: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    settings = replace(CALM, relay_max_hops=4, retry_limit=0, trace=trace(tmp_path, f"0,0,2,,{loss},", "0,2,0,,0,"))
    fleet = Hover(settings, CROSS_M[:5], spread=0.0)
    monkeypatch.setattr(fleet.air, "_routes", _Ways({0: [0, 2, 3]}))

    def tick(frame: int) -> None:
        if frame == 0:
            fleet.send(0, 3, 20_000, reliable=True, deadline_s=0.25)
            fleet.send(2, 1, 40_000_000, kind="other", deadline_s=0.4)  # the relay has no time for it

    fleet.fly(0.6, tick)
    (row,) = [row for row in fleet.rows if row.kind == "f"]
    assert (row.hops, row.repairs > 0) == (2, loss > 0)
    assert (row.status, row.reason) == (Status.EXPIRED, "deadline_queued")
