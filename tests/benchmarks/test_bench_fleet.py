"""What the fleet's hot path costs; `make bench-all` prints it, `make test` only runs it once. No timed assertions."""

from __future__ import annotations

from typing import Any

import pytest
from fleet_examples import DESCRIPTOR, DIRECTIVE

from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.flight.motion import fly
from sortie.fleet.memory import PeerMemory, hear
from sortie.fleet.messages.auth import Sealer, open_datagram
from sortie.fleet.messages.wire import decode_descriptor, decode_directive, encode_descriptor, encode_directive
from sortie.fleet.peers import PeerTable
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.scenarios.schema import Battery, Fleet, Route

pytestmark = pytest.mark.slow

KEY = bytes(range(32))
ROUTE = Route(waypoints_m=((0, 0), (200, 0), (200, 150), (0, 150)))


def test_encode_descriptor(benchmark: Any) -> None:
    assert len(benchmark(encode_descriptor, DESCRIPTOR)) == 180


def test_decode_descriptor(benchmark: Any) -> None:
    assert benchmark(decode_descriptor, encode_descriptor(DESCRIPTOR)) == DESCRIPTOR


def test_encode_directive(benchmark: Any) -> None:
    assert len(benchmark(encode_directive, DIRECTIVE)) == 36


def test_decode_directive(benchmark: Any) -> None:
    assert benchmark(decode_directive, encode_directive(DIRECTIVE)).rho == 0.25


def test_seal(benchmark: Any) -> None:
    assert len(benchmark(Sealer(KEY, 1).seal, encode_descriptor(DESCRIPTOR))) == 208


def test_open_sealed_once_a_broadcast(benchmark: Any) -> None:
    data = Sealer(KEY, 1).seal(encode_descriptor(DESCRIPTOR))
    assert benchmark(open_datagram, data, {1: KEY}).descriptor == DESCRIPTOR


@pytest.mark.parametrize("receivers", [4, 99])
def test_a_descriptor_at_all_that_hear_it(benchmark: Any, receivers: int) -> None:
    rules = FleetRules(0.1, 1000, 3.0, 10.0, 0.3, 0.2, 0.04)
    table = PeerTable(receivers, 10)
    memories = [PeerMemory(i, rules, DroneStatus(), table) for i in range(receivers)]
    opened = open_datagram(encode_descriptor(DESCRIPTOR._replace(agent_id=receivers)), None)
    assert benchmark(hear, memories, opened, 0.01) == []


@pytest.mark.parametrize("drones", [5, 100])
def test_motion_of_1200_frames(benchmark: Any, drones: int) -> None:
    motion = benchmark(fly, Fleet(drones=drones, route=ROUTE), 120.0, 0.1, 1)
    assert motion.position_m.shape == (1200, drones, 3)


@pytest.mark.parametrize("drones", [5, 100])
def test_battery_step(benchmark: Any, drones: int) -> None:
    batteries = FleetBatteries(Battery(capacity_wh=5000), (), drones)
    benchmark(batteries.step, 1e-4, [168.5] * drones, [0.5] * drones, [0.1] * drones)
    assert not any(batteries.landed)
