"""A ground station by MAVSDK, run as a program of its own: `mavsdk_client.py PORT DRONES` says "ready", then what it reads, as JSON."""

from __future__ import annotations

import json
import math
import sys
import time

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.telemetry import Telemetry


def main(port: int, drones: int) -> None:
    """Wait for every vehicle to tell its pose and charge, then say what they told."""
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    say("ready")
    known: dict[int, Telemetry] = {}
    until_s = time.monotonic() + 600
    while time.monotonic() < until_s:
        for system in sdk.get_systems():
            if system.get_system_id() not in known:
                known[system.get_system_id()] = Telemetry(system)
        told = {i: read(t) for i, t in known.items()}
        if len(told) == drones and all(told.values()):
            say(json.dumps(told))
            return
        time.sleep(0.05)
    say(json.dumps({}))


def read(vehicle: Telemetry) -> dict[str, object] | None:
    """What one vehicle tells; None until it has told all of it."""
    place, turn, pack = vehicle.position(), vehicle.attitude_euler(), vehicle.battery()
    moving = vehicle.position_velocity_ned()
    if math.isnan(place.latitude_deg) or math.isnan(turn.yaw_deg) or math.isnan(pack.voltage_v) or not vehicle.in_air():
        return None
    return {
        "position": [place.latitude_deg, place.longitude_deg, place.absolute_altitude_m, place.relative_altitude_m],
        "ned": [moving.position.north_m, moving.position.east_m, moving.position.down_m],
        "velocity": [moving.velocity.north_m_s, moving.velocity.east_m_s, moving.velocity.down_m_s],
        "attitude": [turn.roll_deg, turn.pitch_deg, turn.yaw_deg],
        "battery": [pack.voltage_v, pack.current_battery_a, pack.remaining_percent],
        "mode": [vehicle.armed(), vehicle.in_air()],
    }


def say(text: str) -> None:
    """One line, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
