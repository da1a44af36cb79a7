"""From a drone's radio to those that hear it: the work of a broadcast is done once, and none where nothing is heard."""

from __future__ import annotations

from collections import Counter

import pytest

from sortie.fleet.messages import auth
from sortie.scenarios.reading.load import load
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, fly, run_sortie

NO_DETECTOR = ("perception.detector=none", "mission.phases=[{at_s: 0, phase: search}]")


def test_a_datagram_is_opened_and_decoded_once_however_many_hear_it(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded, opened = Counter[bytes](), Counter[bytes]()
    decode, check = auth.decode_descriptor, auth._tag_of

    def counted(data: bytes) -> object:
        decoded[data] += 1
        return decode(data)

    monkeypatch.setattr(auth, "decode_descriptor", counted)
    monkeypatch.setattr(auth, "_tag_of", lambda key, data: (opened.update([data]), check(key, data))[1])
    scenario = load("track_target", [*NO_DETECTOR, "fleet.drones=9", "duration_s=1"])
    record = run_sortie(scenario)
    assert record.totals["receptions"] > 5 * record.totals["broadcasts"]
    assert set(decoded.values()) == {1}
    assert decoded.total() == 9 * scenario.frames
    assert set(opened.values()) == {2}, "by its sender, and once for all that hear it"


def test_drones_out_of_earshot_are_not_touched() -> None:
    """Forty in a line so long that each hears a few neighbours: nothing is kept of, or worked out for, any other pair."""
    wide = "fleet.formation={shape: line, spacing_m: 60, altitude_m: 60}"
    scenario = load("track_target", [*NO_DETECTOR, wide, "fleet.drones=40", "radio.tx_power_dbm=5", "duration_s=1.5"])
    parts = build(scenario, plan_for(scenario), 1)
    fly(parts)
    memories = [agent.memory for agent in parts.agents]
    table = memories[0].table
    assert 80 < sum(len(memory.ids) for memory in memories) < 800
    for drone, memory in enumerate(memories):
        known = memory.ids.tolist()
        assert all(abs(peer - drone) < 15 for peer in known)
        strangers = [i for i in range(table.heard_s.shape[1]) if i not in known]
        for array in (table.heard_s, table.stamps_s, table.busy, table.at_rest, table.bits[..., 0]):
            assert not array[drone, strangers].any()
        assert set(memory.view(1.5).age_s) == set(known)
