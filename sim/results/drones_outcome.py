"""Each drone at the end: its charge, the energy that it spent, and how well it saw."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow.compute as pc

from sortie.perception.classes import CAR
from sortie.sim.results.accuracy import FULL_SCENE, MISSION, Accuracy, scored
from sortie.sim.results.section import Flown, Joules, OutcomeSection, Share, Volts, figure


class Drone(OutcomeSection):
    soc: Share = figure("State of charge.")
    voltage_v: Volts = figure("At the pack's terminals.")
    airborne: bool = figure("Whether it still flew; of a ground station, whether it was on.")
    energy_j: Joules = figure("Spent to the very end, all causes.")
    ap50: Accuracy = figure("Over this drone's own scored fusions; null where it had none, or no car was there.")


def drones(flown: Flown) -> dict[str, dict[str, Any]]:
    """The section `drones`."""
    energy, spent = flown.tables["energy"], np.zeros(flown.scenario.fleet.drones)
    np.add.at(spent, energy["drone"].to_numpy(), energy["energy_j"].to_numpy())
    return {
        str(row["drone"]): {
            **{name: row[name] for name in ("soc", "voltage_v", "airborne")},
            "energy_j": float(spent[row["drone"]]),
            "ap50": {area: scored(flown).pools[CAR, area].ap_of(row["drone"]) for area in (FULL_SCENE, MISSION)},
        }
        for row in _last_states(flown)
    }


def battery(flown: Flown) -> dict[str, float]:
    """Each drone's state of charge."""
    return {str(row["drone"]): row["soc"] for row in _last_states(flown)}


def energy_j(flown: Flown) -> dict[str, float]:
    """The energy that all drones spent, by cause, and its total."""
    table = flown.tables["energy"]
    by_cause = table.group_by("cause", use_threads=False).aggregate([("energy_j", "sum")])
    return {
        **{row["cause"]: row["energy_j_sum"] for row in by_cause.to_pylist()},
        "total": float(pc.sum(table["energy_j"]).as_py() or 0.0),
    }


def _last_states(flown: Flown) -> list[dict[str, Any]]:
    """The states of all drones as the last frame begins."""
    states = flown.tables["states"]
    return list(states.slice(max(0, states.num_rows - flown.scenario.fleet.drones)).to_pylist())
