"""The script behind radio/README.md: what it reports stays within what the README claims."""

from __future__ import annotations

import pytest

from research.validation import link
from sortie.radio.settings import AirSettings


def test_the_analytic_model_is_ns3s_within_one_percent() -> None:
    off = {row["case"]: 100 * row["largest off"] for row in link.bianchi()}
    assert {case for case, percent in off.items() if percent > 1.0} == {"11a, 54 Mb/s, as Bianchi counts"}


def test_propagation_is_within_its_closed_forms() -> None:
    assert all(row["largest difference, dB"] < 0.05 for row in link.friis())
    assert all(abs(row["slope beyond, dB a decade (40)"] - 40) < 0.1 for row in link.two_rays())
    assert all(abs(row["standard errors off"]) < 4 for row in link.outage(500))


def test_unequal_senders_take_turns() -> None:
    told = {row["model"]: row["fast over slow, bits"] for row in link.unequal()}
    assert told["the medium"] == pytest.approx(1.0, abs=0.1)  # shares of time would be 8
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
