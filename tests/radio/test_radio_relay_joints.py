"""What a relay does with other drones' payloads: whose they are, how long they waited with it, what of them has arrived."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from radio_flights import Hover, trace

from sortie.radio import Status
from sortie.radio.settings import AirSettings

ROW_M = np.array([[20.0 * i, 0.0, 60.0] for i in range(4)])


def over_one(folder: Path, *links: tuple[int, int, float]) -> Hover:
    """A fleet of four in the frame 0, with links of these goodputs (sender, receiver, Mb/s) and none else, two hops at most."""
    given = {(i, j): mbps for i, j, mbps in links}
    rows = [f"0,{i},{j},,,{given.get((i, j), 0)}" for i in range(4) for j in range(4) if i != j]
    return Hover(AirSettings(trace=trace(folder, *rows), relay_max_hops=2), ROW_M).fly(0.1)


@pytest.mark.parametrize("lost", [0, 1])
def test_what_a_lost_drone_has_at_hand_dies_with_it_and_what_it_handed_on_does_not(lost: int, tmp_path: Path) -> None:
    """0 sends to 2 over 1, and 1 sends to 3. By the time that one of them is lost, 1 has both."""
    flight = over_one(tmp_path, (0, 1, 80.0), (1, 2, 10.0), (1, 3, 10.0))
    begin_s = flight.env.now
    relayed = flight.send(0, 2, 50_000, kind="relayed", deadline_s=1.0)
    flight.env.run(until=begin_s + 0.02)
    own = flight.send(1, 3, 50_000, kind="own", deadline_s=1.0)
    flight.air.silence(lost)
    at_once = {r.number: r.reason for r in flight.rows}
    assert at_once == ({} if lost == 0 else {relayed: "sender_gone", own: "sender_gone"})
    flight.env.run(until=1.2)
    fates = {r.number: r.status for r in flight.rows}
    assert set(fates) == {relayed, own}
    assert set(fates.values()) == {Status.DELIVERED if lost == 0 else Status.LOST}


def test_a_relay_counts_a_payload_s_wait_from_when_it_came(tmp_path: Path) -> None:
    """It came over a slow hop to a relay that is busy with another link: that says nothing of the link on which it waits."""
    flight = over_one(tmp_path, (0, 1, 4.0), (1, 2, 40.0), (1, 3, 2.0))
    flight.send(1, 2, 40_000, kind="before", deadline_s=1.0)
    flight.env.run(until=0.2)
    known = flight.air.goodput_mbps(1)[1]
    assert known > 20.0
    flight.send(0, 2, 20_000, deadline_s=1.0)  # 40 ms on its first hop, more with 1 on the air
    flight.env.run(until=0.22)
    flight.send(1, 3, 60_000, kind="busy", deadline_s=1.0)
    medium = flight.air.medium
    while not any(s.hops == 2 for s in medium.queued(1)):
        flight.env.run(until=flight.env.now + 1e-4)
        assert flight.env.now < 0.5
    assert flight.air.goodput_mbps(1)[1] == known
    flight.env.run(until=flight.env.now + 0.02)
    assert flight.air.goodput_mbps(1)[1] < 0.5 * known  # now it has waited


@pytest.mark.parametrize("reliable", [False, True])
def test_pieces_that_came_as_far_as_a_relay_have_not_arrived(reliable: bool, tmp_path: Path) -> None:
    """The deadline passes on the first hop, and on the second: only what is at the target counts."""
    flight = over_one(tmp_path, (0, 1, 2.0), (1, 2, 40.0), (3, 1, 40.0))
    flight.send(0, 2, 40_000, piece_bytes=1000, reliable=reliable, deadline_s=0.08)
    flight.env.run(until=0.3)
    flight.send(0, 1, 40_000, piece_bytes=1000, reliable=reliable, deadline_s=0.08)
    flight.env.run(until=0.6)
    relayed, direct = flight.rows
    assert (relayed.status, relayed.arrived_bytes, relayed.missing) == (Status.EXPIRED, 0, ())
    assert direct.status == Status.PARTIAL
    assert 5_000 < direct.arrived_bytes < 30_000
    assert relayed.airtime_s == pytest.approx(direct.airtime_s, rel=0.1)
    expired = flight.air.counters.data_expired_bytes
    assert expired == 40_000 + 40_000 - direct.arrived_bytes
