"""A MAVLink vehicle of our own, for tests and demonstrations: it flies a circle and tells its telemetry by UDP.

python -m sortie.sim.live.vehicle udpout:127.0.0.1:14550 --system 1
"""

from __future__ import annotations

import math
import threading
import time
from pathlib import Path
from typing import Annotated

import typer

from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.mavlink import STATUS, Transmitter, messages
from sortie.fleet.logs.telemetry import Telemetry
from sortie.sim.export.endpoint import open_address
from sortie.sim.export.origin import ORIGIN
from sortie.sim.folders import RunError
from sortie.sim.live.seals import read_own_key

TELEMETRY_HZ = 20.0


def circle(t_s: float, *, radius_m: float = 30.0, height_m: float = 60.0, speed_mps: float = 8.0) -> Telemetry:
    """The vehicle after `t_s` on a circle about the origin, its nose along its way; its charge falls by 0.2 % a second."""
    rate_radps = speed_mps / radius_m
    angle = rate_radps * t_s
    yaw = angle + math.pi / 2
    return Telemetry(
        time_s=t_s,
        position_m=(radius_m * math.cos(angle), radius_m * math.sin(angle), height_m),
        orientation_xyzw=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
        velocity_mps=(-speed_mps * math.sin(angle), speed_mps * math.cos(angle), 0.0),
        body_rates_radps=(0.0, 0.0, rate_radps),
        soc=max(0.0, 0.8 - 0.002 * t_s),
        voltage_v=22.0,
        current_a=20.0,
        energy_used_j=440.0 * t_s,
        cpu_load=0.3,
        landed=False,
    )


class CirclingVehicle:
    """The vehicle as a thread. `pause` stops its telemetry, not its flight."""

    def __init__(self, address: str, system: int = 1, origin: Origin = ORIGIN, key: bytes | None = None) -> None:
        """Args: `address` is `udpout:HOST:PORT`; with a `key` of 32 B its messages are signed."""
        self._origin = origin
        self._transmitter = Transmitter(system - 1, key, time.time_ns() // 1000)
        self._socket, self._to = open_address(address)
        if self._to is None:
            self._socket.close()
            raise RunError(f"{address}: must be udpout:HOST:PORT")
        self._began_s = time.monotonic()
        self._paused, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._fly, daemon=True)
        self._thread.start()

    def pause(self, paused: bool = True) -> None:
        """Stop or go on with telemetry."""
        self._paused.set() if paused else self._paused.clear()

    def close(self) -> None:
        """End the flight."""
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def _fly(self) -> None:
        second = -1
        while not self._stop.wait(1.0 / TELEMETRY_HZ):
            state = circle(time.monotonic() - self._began_s)
            status, second = int(state.time_s) != second, int(state.time_s)
            if self._paused.is_set():
                continue
            for message in messages(state, self._origin):
                if status or message.get_type() not in STATUS:
                    self._socket.sendto(self._transmitter.pack(message), self._to)  # type: ignore[arg-type]


def main(
    address: Annotated[str, typer.Argument(help="Where to send: udpout:127.0.0.1:14550")],
    system: Annotated[int, typer.Option(help="Its MAVLink system id.", min=1, max=255)] = 1,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Sign messages with this key (32 bytes or 64 hex digits).")
    ] = None,
) -> None:
    """Fly a circle of 30 m at 60 m until Ctrl-C."""
    vehicle = CirclingVehicle(address, system, key=None if key is None else read_own_key(key))
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        vehicle.close()


if __name__ == "__main__":
    typer.run(main)
