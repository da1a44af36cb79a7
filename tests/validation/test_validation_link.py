"""The script behind radio/README.md: what it reports stays within what the README claims."""

from __future__ import annotations

import link
import pytest
import simpy

from sortie.radio.mac.airtime import BLOCK_ACK_S, Exchanges
from sortie.radio.mac.contention import DIFS_S, SIFS_S, SLOT_S
from sortie.radio.mac.jobs import AirJob, GroupFrame
from sortie.radio.mac.medium import Medium
from sortie.radio.settings import AirSettings


def test_the_analytic_model_is_ns3s_within_one_percent() -> None:
    off = {row["case"]: 100 * row["largest off"] for row in link.bianchi()}
    assert {case for case, percent in off.items() if percent > 1.0} == {"11a, 54 Mb/s, as the medium counts"}


def test_propagation_is_within_its_closed_forms() -> None:
    assert all(row["largest difference, dB"] < 0.05 for row in link.friis())
    assert all(abs(row["slope beyond, dB a decade (40)"] - 40) < 0.1 for row in link.two_rays())
    assert all(abs(row["standard errors off"]) < 4 for row in link.outage(500))


def test_unequal_senders_share_as_the_medium_shares() -> None:
    """Two jobs of a thousand exchanges each, one eight times as long as the other, side by side for 0.2 s."""
    around_s = SIFS_S + BLOCK_ACK_S + DIFS_S + SLOT_S
    asked = [Exchanges(1000, 1000 * s, 1000 * (s + around_s)) for s in (4e-3, 0.5e-3)]
    env = simpy.Environment()
    medium = Medium[AirJob, GroupFrame](
        env, 2, lambda job, _: job.demand(asked[job.sender]), lambda *_: None, lambda *_: None
    )
    jobs = [AirJob(i, i, 10.0) for i in range(2)]
    for job in jobs:
        medium.submit(job)
    env.run(until=0.2)
    medium.sync()
    slow, fast = (1.0 - job.remaining for job in jobs)
    told = {row["model"]: row["fast over slow, bits"] for row in link.unequal()}
    assert told["fluid (equal time)"] == pytest.approx(fast / slow, abs=0.006)
    assert told["CSMA/CA"] == pytest.approx(1.0, abs=0.05)


def test_a_hundred_drones_cost_one_event_a_broadcast() -> None:
    """Counts, not seconds: the clock's events, and the links that are worked out."""
    air, _, events = link.broadcast_all(100, 5.0, link.WEAK)
    assert air.counters.broadcasts == 5000
    assert events < 1.1 * 5000
    near = len(air.channel.links.sender) / 100
    wide, _, _ = link.broadcast_all(225, 0.5, link.WEAK)
    assert near < 60
    assert len(wide.channel.links.sender) / 225 == pytest.approx(near, rel=0.25)  # neighbours, not drones, squared
    assert len(link.broadcast_all(50, 0.2, AirSettings())[0].channel.links.sender) == 50 * 49
