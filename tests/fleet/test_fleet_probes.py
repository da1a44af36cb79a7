"""Descriptors as probes: a link without payloads is known by what arrives of its peer."""

from __future__ import annotations

import numpy as np
import pytest
from agent_rig import hear, memory

from sortie.fleet.memory import PeerMemory
from sortie.radio.goodput import Goodput
from sortie.scenarios.link_state import MEASURED_FOR_S, SILENT_MBPS, LinkState, heard_share, state_of


def filled(mine: PeerMemory, goodput_mbps: tuple[float, ...], now_s: float) -> tuple[float, ...]:
    peers = [i for i in range(len(goodput_mbps) + 1) if i != mine.drone]
    return mine.probes.fill(np.array(peers), goodput_mbps, now_s)


def test_probes_count_the_descriptors_heard_and_missed() -> None:
    mine = memory()
    for k in range(30):
        if k % 5:  # every fifth is missed
            hear(mine, 1, 0.003 * (k % 2) + 0.1 * k)

    def share(now_s: float) -> float | None:
        return heard_share(filled(mine, (0.0, 0.0), now_s)[0])

    assert share(2.93) == pytest.approx(0.8)
    assert share(3.42) == pytest.approx(0.5)  # 3.0 and four more are missed by now
    assert filled(mine, (0.0, 0.0), 3.98) == (SILENT_MBPS, 0.0) == filled(mine, (0.0, 0.0), 1e6)


def test_probes_stand_where_nothing_was_measured_and_have_no_rate() -> None:
    mine = memory(1)
    for k in range(10):
        hear(mine, 0, 0.1 * k)
        if k < 5:
            hear(mine, 3, 0.1 * k)
    known = filled(mine, (0.0, 40.0, 0.0, 0.0), 0.95)  # to drones 0, 2, 3 and 4
    assert [state_of(mbps) for mbps in known] == [
        LinkState.PROBED, LinkState.MEASURED, LinkState.PROBED, LinkState.UNKNOWN,
    ]  # fmt: skip
    assert [heard_share(mbps) for mbps in known] == [pytest.approx(1.0), None, pytest.approx(0.5), None]
    later = filled(mine, (0.0, 40.0, 0.0, 0.0), 3.0)
    assert later == (SILENT_MBPS, 40.0, SILENT_MBPS, 0.0)


def test_a_measurement_expires_and_the_next_one_is_taken_as_it_is() -> None:
    links = Goodput(2)
    links.measured(0, 1, 70.0, 1.0)
    assert links.read(0, 1.0 + MEASURED_FOR_S) == {1: 70.0}
    assert links.read(0, 1.01 + MEASURED_FOR_S) == {}
    links.measured(0, 1, 90.0, 10.0)
    assert links.read(0, 10.0) == {1: 90.0}
