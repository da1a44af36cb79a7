"""Rows of a sortie's record as the telemetry of its drones."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from sortie.fleet.logs.telemetry import Telemetry
from sortie.scenarios.schema import Scenario

_GNSS = {"gnss_loss": False, "gnss_back": True}
"""Kinds of events, and whether there is GNSS afterwards."""


class Telemeter:
    """Turns rows of the record into telemetry; load, home and GNSS are kept from slice to slice.

    A drone that is not in the air lies on the ground below its recorded position: the record keeps the last height.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._frame_s = scenario.frame_s
        self._load = np.zeros(scenario.fleet.drones)
        self._stations = {station.drone for station in scenario.fleet.ground}
        self._home_m: dict[int, tuple[float, float, float]] = {}
        self._fixed = [True] * scenario.fleet.drones

    def add(self, new: Mapping[str, pa.Table]) -> Iterator[tuple[int, Telemetry]]:
        """Each drone's state in each frame of the tables `states`, `descriptors` and `events`, in order of time."""
        happened = deque(row for row in new["events"].to_pylist() if row["kind"] in _GNSS)
        descriptors = new["descriptors"]
        published = iter(zip(*(descriptors[k].to_pylist() for k in ("t_s", "drone", "cpu_headroom")), strict=True))
        said = next(published, None)
        for row in new["states"].to_pylist():
            while said is not None and said[0] <= row["t_s"] + self._frame_s / 2:
                self._load[said[1]] = 1.0 - said[2]
                said = next(published, None)
            while happened and happened[0]["t_s"] <= row["t_s"]:
                event = happened.popleft()
                self._fixed[event["drone"]] = _GNSS[event["kind"]]
            yield row["drone"], self._telemetry(row)
        while said is not None:
            self._load[said[1]] = 1.0 - said[2]
            said = next(published, None)
        for event in happened:
            self._fixed[event["drone"]] = _GNSS[event["kind"]]

    def _telemetry(self, row: dict[str, Any]) -> Telemetry:
        drone, landed = row["drone"], not row["airborne"]
        station, still = drone in self._stations, (0.0, 0.0, 0.0)
        return Telemetry(
            time_s=row["t_s"],
            position_m=(row["x_m"], row["y_m"], 0.0 if landed and not station else row["z_m"]),
            orientation_xyzw=(row["qx"], row["qy"], row["qz"], row["qw"]),
            velocity_mps=still if landed else (row["vx_mps"], row["vy_mps"], row["vz_mps"]),
            body_rates_radps=still if landed else (row["p_radps"], row["q_radps"], row["r_radps"]),
            soc=row["soc"],
            voltage_v=row["voltage_v"],
            current_a=row["current_a"],
            energy_used_j=row["spent_j"],
            cpu_load=float(np.clip(self._load[drone], 0.0, 1.0)),
            landed=landed,
            ground_station=station,
            home_m=self._home_m.setdefault(drone, (row["x_m"], row["y_m"], 0.0)),
            fixed=self._fixed[drone],
        )
