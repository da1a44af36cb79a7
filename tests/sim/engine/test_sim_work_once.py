"""Work that is done once, however many peers it is for; and none where nothing is heard.

Each test flies by itself, because it counts calls in flight.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from sim_examples import PATIENT

import sortie.fleet.agent
from sortie.fleet.messages import auth
from sortie.policies.decision_loop import DecisionLoop
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, fly, run_sortie


def scenario(*sets: str) -> Scenario:
    return load("track_target", ["perception.detector=none", "mission.phases=[{at_s: 0, phase: search}]", *sets])


def test_what_goes_to_four_peers_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    plain = sortie.fleet.agent.make_payload

    def counted(*what: Any, **more: Any) -> Any:
        made.append(plain(*what, **more))
        return made[-1]

    monkeypatch.setattr(sortie.fleet.agent, "make_payload", counted)
    sent = run_sortie(scenario("duration_s=2", *PATIENT), "all-4").tables["transmissions"].num_rows
    assert sent > 100
    assert 3.7 * len(made) < sent <= 4 * len(made)


def test_a_directive_that_is_asked_again_is_enforced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worked policy makes new directives in every frame; they are equal to the last ones.

    It has two peers a decision; they are looked at in every frame only while an upgrade waits for its dwell time.
    """
    asked: list[Any] = []
    plain = DecisionLoop._step

    def counted(self: DecisionLoop, *what: Any) -> None:
        asked.append(what[1])
        plain(self, *what)

    monkeypatch.setattr(DecisionLoop, "_step", counted)
    decisions = run_sortie(scenario("duration_s=6"), "worked").totals["decisions"]
    assert decisions == 300
    assert len(asked) < 1.2 * decisions


def test_a_datagram_is_opened_and_decoded_once_however_many_hear_it(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded, opened = Counter[bytes](), Counter[bytes]()
    decode, check = auth.decode_descriptor, auth._tag_of

    def counted(data: bytes) -> object:
        decoded[data] += 1
        return decode(data)

    monkeypatch.setattr(auth, "decode_descriptor", counted)
    monkeypatch.setattr(auth, "_tag_of", lambda key, data: (opened.update([data]), check(key, data))[1])
    flown = scenario("fleet.drones=9", "duration_s=0.5")
    record = run_sortie(flown)
    assert record.totals["receptions"] > 5 * record.totals["broadcasts"]
    assert set(decoded.values()) == {1}
    assert decoded.total() == 9 * flown.frames
    assert set(opened.values()) == {2}, "by its sender, and once for all that hear it"


def test_drones_out_of_earshot_are_not_touched() -> None:
    """Forty in a line so long that each hears a few neighbours: nothing is kept or worked out of any other pair."""
    wide = "fleet.formation={shape: line, spacing_m: 60, altitude_m: 60}"
    line = scenario(wide, "fleet.drones=40", "radio.tx_power_dbm=5", "duration_s=0.6")
    parts = build(line, plan_for(line), 1)
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
        assert set(memory.view(0.6).age_s) == set(known)
