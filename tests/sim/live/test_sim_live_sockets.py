"""Which hosts reach a live flight: the sockets of all its processes, as the system lists them while it flies."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import psutil
import pytest
from dds_domains import domain, udp_port
from sim_examples import example

from sortie.sim.folders import RunError
from sortie.sim.live import loopback
from sortie.sim.live.bus import LOOPBACK, Bus
from sortie.sim.live.session import fly_live
from sortie.sim.live.vehicle import CirclingVehicle


def sockets() -> Counter[tuple[str, str]]:
    """The protocols and local addresses of this process and of all that it started."""
    me, found = psutil.Process(), Counter[tuple[str, str]]()
    for process in (me, *me.children(recursive=True)):
        for kind in ("tcp4", "tcp6", "udp4", "udp6"):
            found.update((kind, each.laddr.ip) for each in process.net_connections(kind))
    return found


def test_a_flight_opens_ports_on_loopback_alone(tmp_path: Path) -> None:
    """The bench and two drones with three sockets each, and the two of drone 0's link to its vehicle."""
    (tmp_path / "mine.py").write_text("def decide(view):\n    return []\n")  # in a process of its own, as any policy
    before, opened = sockets(), Counter[tuple[str, str]]()
    vehicle = CirclingVehicle(f"udpout:127.0.0.1:{udp_port(__name__)}")
    try:
        fly_live(
            example("fleet.drones=2", f"policy={{name: '{tmp_path}/mine.py:decide'}}"),
            duration_s=1.0,
            domain=domain(__name__),
            mavlink=[f"udpin:127.0.0.1:{udp_port(__name__)}"],
            begun=lambda _: opened.update(sockets() - before),
        )
    finally:
        vehicle.close()
    assert opened == {("udp4", "127.0.0.1"): 3 * 3 + 2}


def test_the_user_s_own_configuration_is_left_to_cyclone(monkeypatch: pytest.MonkeyPatch) -> None:
    for uri, address in (("", "127.0.0.1"), (LOOPBACK, "0.0.0.0")):  # noqa: S104
        monkeypatch.setenv("CYCLONEDDS_URI", uri)
        before = sockets()
        bus = Bus(domain(__name__ + uri))
        assert (sockets() - before)["udp4", address] >= 2, bus


def test_another_build_of_cyclone_is_an_error_and_opens_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loopback, "_CALLS", loopback._DATA)  # a library without the table of calls
    monkeypatch.setattr(loopback, "_CALLS_BYTES", loopback._DATA_BYTES)
    before = sockets()
    with pytest.raises(RunError, match=r"^Cyclone DDS calls no bind: set CYCLONEDDS_URI to fly with this build of it$"):
        Bus(domain(__name__ + " another build"))
    assert sockets() == before
