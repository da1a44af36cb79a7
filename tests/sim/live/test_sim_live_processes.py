"""The bench and the processes of a live flight: processes that die before it, and processes that hang in it."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from memory_bus import MemoryBus
from sim_examples import example

from sortie.policies.contract import PolicyError
from sortie.sim.folders import RunError
from sortie.sim.live import drone, session
from sortie.sim.live.reports import Home, Ready, Report, SinceLastReport
from sortie.sim.live.session import fly_live


@pytest.fixture
def fly(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """Flies for 0.2 s with processes that have sent these messages already; returns what the result is made of."""

    def fly(*sent: list[object], **options: Any) -> dict[str, Any]:
        theirs: list[Connection] = []
        orders_of: list[session.Orders] = []

        def start(orders: session.Orders) -> session._Drone:
            ours, its = multiprocessing.Pipe()
            for message in sent[orders.drone]:
                its.send(message)
            if sent[orders.drone] == [Ready(orders.drone)]:
                its.close()  # it died
            theirs.append(its)
            orders_of.append(orders)
            process = SimpleNamespace(
                name=f"drone {orders.drone}", exitcode=0, join=lambda _=None: None, is_alive=lambda: False
            )
            return session._Drone(orders, process, ours)  # type: ignore[arg-type]

        monkeypatch.setattr(session, "_start", start)
        monkeypatch.setattr(session, "Bus", lambda domain: MemoryBus())
        monkeypatch.setattr(session, "traces", lambda scenario, progress: [None] * scenario.fleet.drones)
        monkeypatch.setattr(session, "summarise", lambda *of, **more: more)
        monkeypatch.setattr(session, "LAST_REPORT_S", 0.3)
        found = fly_live(example(f"fleet.drones={len(sent)}"), duration_s=0.2, **options)
        assert isinstance(found, dict)
        return {**found, "orders": orders_of}

    return fly


def report(drone: int) -> Report:
    """At 0.125 s."""
    return Report(drone, 0.0, 0.125, 0.0, 1, 1, 0, {}, 0.0, {}, {}, SinceLastReport())


def test_a_process_that_hangs_is_lost_and_the_flight_ends(fly: Callable[..., dict[str, Any]]) -> None:
    result = fly([Ready(0), report(0), Home(0)], [Ready(1), report(1)])
    assert result["lost"] == [(1, 0.125, "does not answer")]
    assert not result["interrupted"]


def test_a_process_that_ends_while_others_start_is_named(fly: Callable[..., dict[str, Any]]) -> None:
    with pytest.raises(RunError, match=r"^drone 0 ended before the flight began$"):
        fly([Ready(0)], [])


def test_a_process_that_begins_within_a_frame_begins_with_it(fly: Callable[..., dict[str, Any]]) -> None:
    """What it replays and its clock would otherwise be up to half a frame apart: its stamps would be of the future."""
    messages = [[Ready(i), report(i), Home(i)] for i in range(2)]
    result = fly(*messages, begin_s=0.36, start=(1, 0.55))
    moments = [(o.begin_s, o.end_s) for o in result["orders"]]
    assert moments == [(pytest.approx(0.3), pytest.approx(0.56)), (pytest.approx(0.5), pytest.approx(0.56))]
    assert result["begin_s"] == pytest.approx(0.3)


def test_what_stops_a_process_is_raised_by_the_flight_as_what_it_is(
    monkeypatch: pytest.MonkeyPatch, fly: Callable[..., dict[str, Any]]
) -> None:
    monkeypatch.setattr(drone.signal, "signal", lambda *_: None)
    for raised, kind in (
        (RunError("no vehicle"), RunError),
        (PolicyError("no policy"), PolicyError),
        (OSError("no port"), RunError),
    ):
        monkeypatch.setattr(drone, "Watchdog", Mock(side_effect=raised))
        ours, its = multiprocessing.Pipe()
        orders: Any = SimpleNamespace(scenario=example(), drone=0, fallback=None, decide_within_s=None)
        drone.fly_one(orders, its)
        with pytest.raises(kind, match=f"^{raised}$") as found:
            fly([ours.recv()], [Ready(1)])
        assert found.type is kind
