"""MAVProxy, a ground station on a terminal, joins a flying fleet; it is heavy, and skipped where it is missing.

`make mavproxy` installs it in an environment of its own, and so does `pipx install MAVProxy`.
"""

from __future__ import annotations

import os
import re
import select
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from dds_domains import udp_port
from places import ROOT
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.export.telemetry import MavlinkEndpoint

MAVPROXY = shutil.which("mavproxy.py") or shutil.which(ROOT / ".venv-mavproxy/bin/mavproxy.py")
pytestmark = pytest.mark.skipif(MAVPROXY is None, reason="MAVProxy is not installed")
PATIENCE_S = 600.0


class Terminal:
    """MAVProxy on a pseudo-terminal."""

    def __init__(self, port: int, folder: Path) -> None:
        import pty

        self._end, other = pty.openpty()
        command = [str(MAVPROXY), f"--master=udpin:127.0.0.1:{port}", f"--state-basedir={folder}"]
        surroundings = {**os.environ, "HOME": str(folder), "TERM": "dumb"}
        self._process = subprocess.Popen(command, stdin=other, stdout=other, stderr=other, cwd=folder, env=surroundings)
        os.close(other)
        self.said = ""

    def type(self, line: str) -> None:
        os.write(self._end, f"{line}\n".encode())

    def until(self, pattern: str, meanwhile: Callable[[], None] = lambda: None) -> re.Match[str]:
        """What it says up to a match; `meanwhile` is called again and again until then."""
        end_s = time.monotonic() + PATIENCE_S
        while (found := re.search(pattern, self.said)) is None:
            assert time.monotonic() < end_s, self.said
            meanwhile()
            if select.select([self._end], [], [], 0.2)[0]:
                self.said += os.read(self._end, 65_536).decode(errors="replace")
        return found

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._end)


def test_mavproxy_follows_a_fleet_without_losing_a_frame(tmp_path: Path) -> None:
    port = udp_port(__name__)
    station = Terminal(port, tmp_path)
    try:
        station.until("Waiting for heartbeat")
        endpoint = MavlinkEndpoint(f"udpout:127.0.0.1:{port}")
        flown = run_sortie(example("duration_s=8", "perception.detector=none"))
        endpoint.begin(flown.scenario, None)  # type: ignore[arg-type]
        whole = dict(flown.tables)
        empty = {name: table.slice(0, 0) for name, table in whole.items()}
        five_s = flown.scenario.fleet.drones * 50
        endpoint.second(5.0, empty | {"states": whole["states"].slice(0, five_s), "directives": whole["directives"]})
        for command in ("link", "wp list", "fence list", "ftp list /", "param show BATT*"):
            station.type(command)
        time.sleep(1.0)
        endpoint.second(8.0, empty | {"states": whole["states"].slice(five_s)})
        packets, lost = map(int, station.until(r"\((\d+) packets, .* (\d+) lost").groups())
        for answer in (
            "Requesting 0 waypoints",
            "Requesting 0 fence items",
            r"LIST: OP .* opcode:129 req_opcode:3",  # refused, and not waited for
            r"BATT_CAPACITY +\d+",
        ):
            station.until(answer, lambda: endpoint.second(8.0, empty))  # a busy host may ask late
        endpoint.close()
    finally:
        station.close()
    assert packets > 1000
    assert lost <= 0.01 * packets
    assert "Detected vehicle 5:1" in station.said
    assert "GPS lock at" in station.said
    assert "AP: drone 0 -> 1, 2: features" in station.said
    assert "fence breach" not in station.said
