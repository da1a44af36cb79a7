"""Drones that start late, and drones that come back after their process was killed."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from dds_domains import domain
from sim_examples import example

from sortie.fleet.messages.auth import Opened
from sortie.fleet.staleness import LinkHealth
from sortie.policies.contract import Descriptor
from sortie.sim.export.topics import CONTEXT
from sortie.sim.folders import RunError
from sortie.sim.live import session
from sortie.sim.live.bus import Bus
from sortie.sim.live.result import LiveResult
from sortie.sim.live.seals import Seals
from sortie.sim.live.sentences import describe_changes
from sortie.sim.live.session import fly_live

POLICY = "policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3}"


def healths(result: LiveResult, drone: int, peer: int) -> list[LinkHealth]:
    """What became of a drone's context about a peer, without what a busy host skips."""
    seen = [c.health for c in result.health if (c.drone, c.peer) == (drone, peer)]
    return [h for h in seen if h != LinkHealth.DEGRADED]


def test_a_drone_that_starts_late_is_shared_with_and_shares() -> None:
    result = fly_live(example("fleet.drones=2", POLICY), duration_s=4.0, start=(1, 2.0), domain=domain(__name__))
    first, late = result.each
    assert (first.drone, late.drone) == (0, 1)
    assert late.published < 25 < first.published
    assert healths(result, 0, 1) == healths(result, 1, 0) == [LinkHealth.FRESH]
    assert all(c.t_s > 1.9 for c in result.health)
    assert first.payloads_arrived > 3
    assert late.payloads_arrived > 3
    assert "drone 1: its process started" in "\n".join(describe_changes(result))


@pytest.mark.slow
def test_a_drone_that_was_killed_comes_back_and_is_believed() -> None:
    """Its counters begin above those that it used before."""
    result = fly_live(
        example("fleet.drones=2", POLICY), duration_s=5.0, kill=(1, 1.5), start=(1, 3.5), domain=domain(__name__ + ".1")
    )
    assert [d.drone for d in result.each] == [0, 1, 1]
    assert all(set(d.refused) <= {"payload late"} for d in result.each)  # a busy host is late
    assert healths(result, 0, 1) == [LinkHealth.FRESH, LinkHealth.DETACHED, LinkHealth.FRESH]
    assert [gone.drone for gone in result.lost] == [1]
    assert result.noticed[0].by == 1


def test_rosters_on_the_bus_follow_who_starts_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read off the bus by somebody else, whom the flight waits for here."""
    heard: list[Descriptor] = []
    over = threading.Event()
    bus, open_descriptor = Bus(domain(__name__ + ".2")), Seals(None).open_descriptor
    reader = bus.reader(CONTEXT, depth=10)
    wait_until_connected = session._wait_until_connected

    def wait_for_the_listener_too(*of: Any) -> None:
        wait_until_connected(*of)
        until_s = time.monotonic() + 60.0
        while not reader._reader.get_subscription_matched_status().current_count and time.monotonic() < until_s:
            time.sleep(0.01)

    def listen() -> None:
        while not over.is_set():
            bus.wait(0.1)
            heard.extend(found.descriptor for cdr in reader.take() if isinstance(found := open_descriptor(cdr), Opened))

    monkeypatch.setattr(session, "_wait_until_connected", wait_for_the_listener_too)
    listener = threading.Thread(target=listen)
    listener.start()
    sets = ("fleet.drones=2", POLICY, "context.roster=true", "context.authentication=false")
    try:
        fly_live(example(*sets), duration_s=4.0, start=(1, 2.0), domain=domain(__name__ + ".2"))
    finally:
        over.set()
        listener.join()
    by_drone = {i: [d.roster for d in heard if d.agent_id == i and d.roster is not None] for i in (0, 1)}
    assert len(heard) == sum(map(len, by_drone.values())) > 20
    assert by_drone[0][0].members == (0,)
    assert by_drone[0][-1].members == by_drone[1][-1].members == (0, 1)
    assert all((d.goodput_to(1) > 0.0) == d.counts(1) for d in heard if d.agent_id == 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": (7, 1.0)}, "start 7@1: must be a drone below 5 and a time in the flight"),
        ({"start": (1, 9.0)}, "start 1@9: must be a drone below 5 and a time in the flight"),
        ({"start": (1, 1.0), "kill": (1, 2.0)}, "start 1@1: must be after the kill at 2 s"),
    ],
)
def test_a_start_that_does_not_fit_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(RunError) as error:
        fly_live(example(), **options)
    assert str(error.value) == message
