"""Drones that start late, and drones that come back after their process was killed."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
from dds_domains import domain
from live_flights import PATIENT, Seen, fly_until
from sim_examples import example

from sortie.fleet.messages.auth import Opened
from sortie.policies.contract import Descriptor
from sortie.policies.staleness import LinkHealth
from sortie.sim.export.topics import CONTEXT, PAYLOADS
from sortie.sim.folders import RunError
from sortie.sim.live import session
from sortie.sim.live.bus import Bus
from sortie.sim.live.seals import Seals
from sortie.sim.live.sentences import describe_changes
from sortie.sim.live.session import fly_live

pytestmark = pytest.mark.slow

POLICY = "policy={name: all-4, params: {received_budget: 0.03125}, dwell_s: 0.3}"


def test_a_drone_that_starts_late_is_shared_with_and_shares() -> None:
    def shared(seen: Seen) -> bool:
        reports = seen.last(0), seen.last(1, late=True)
        return all(r is not None and sum(r.received[kind].samples for kind in PAYLOADS) > 3 for r in reports)

    result = fly_until(shared, "fleet.drones=2", POLICY, PATIENT, start=(1, 2.0), domain=domain(__name__))
    assert [d.drone for d in result.each] == [0, 1]
    assert [(c.drone, c.peer, c.health) for c in sorted(result.health, key=lambda c: c.drone)] == [
        (0, 1, LinkHealth.FRESH), (1, 0, LinkHealth.FRESH),
    ]  # fmt: skip
    assert all(c.t_s > 1.9 for c in result.health)
    assert "drone 1: its process started" in "\n".join(describe_changes(result))


def test_a_drone_that_was_killed_comes_back_and_is_believed() -> None:
    """Its counters begin above those that it used before."""
    result = fly_until(
        lambda seen: seen.healths(0, 1)[1:] == [LinkHealth.DETACHED, LinkHealth.FRESH] and seen.last(1, late=True),
        "fleet.drones=2", POLICY, "context={degraded_after_periods: 59, detached_after_periods: 60}",
        kill=(1, 8.0), start=(1, 22.0), domain=domain(__name__ + ".1"),
    )  # fmt: skip
    assert [d.drone for d in result.each] == [0, 1, 1]
    assert all(set(d.refused) <= {"payload late"} for d in result.each)  # a busy host is late
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
        until_s = time.monotonic() + 600.0
        while not reader._reader.get_subscription_matched_status().current_count and time.monotonic() < until_s:
            time.sleep(0.01)

    def listen() -> None:
        while not over.is_set():
            bus.wait(0.1)
            heard.extend(found.descriptor for cdr in reader.take() if isinstance(found := open_descriptor(cdr), Opened))

    monkeypatch.setattr(session, "_wait_until_connected", wait_for_the_listener_too)
    listener = threading.Thread(target=listen)
    listener.start()
    sets = ("fleet.drones=2", POLICY, PATIENT, "context.roster=true", "context.authentication=false")

    def rosters(drone: int) -> list[tuple[int, ...]]:
        return [d.roster.members for d in heard if d.agent_id == drone and d.roster is not None]

    try:
        fly_until(
            lambda _: all(rosters(drone)[-1:] == [(0, 1)] for drone in (0, 1)),
            *sets, start=(1, 2.0), domain=domain(__name__ + ".2"),
        )  # fmt: skip
    finally:
        over.set()
        listener.join()
    assert len(heard) == len(rosters(0)) + len(rosters(1))
    assert rosters(0)[0] == (0,)
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
