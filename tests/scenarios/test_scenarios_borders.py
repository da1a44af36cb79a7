"""Values on a border: two instants that are one, a station of a make, whole numbers at the ends of a spread."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sortie.scenarios.reading.campaign import extremes
from sortie.scenarios.reading.load import ScenarioError, loads
from sortie.scenarios.schema.campaign import Integers, Linspace, Normal, Uniform
from sortie.scenarios.traces import TraceError, check_increasing


def scenario(text: str) -> Any:
    return loads(f"name: borders\nduration_s: 9\n{text}")


@pytest.mark.parametrize("second_s", [2, 2.0, 1.5])
def test_of_two_phases_the_later_begins_later(second_s: float) -> None:
    phases = "mission: {{phases: [{{at_s: 0}}, {{at_s: 2, phase: track}}, {{at_s: {}, phase: search}}]}}"
    with pytest.raises(ScenarioError, match=r"mission\.phases\.2\.at_s: [\d.]+, must be above 2"):
        scenario(phases.format(second_s))
    assert len(scenario(phases.format(2.001)).mission.phases) == 3


@pytest.mark.parametrize("t_s", [[0, 1, 1], [0, 2, 1]])
def test_the_time_of_a_trace_never_stands(t_s: list[float]) -> None:
    check_increasing(Path("t.csv"), np.array([0, 1, 2.0]), np.arange(3), "drone 0")
    with pytest.raises(TraceError, match=r"t_s in row 3 of drone 0 is 1, must increase"):
        check_increasing(Path("t.csv"), np.array(t_s, float), np.arange(3), "drone 0")


def test_a_station_stands_where_it_stands_whatever_its_make_adds() -> None:
    """Its make says how much higher its drones fly; a station does not fly."""
    fleet = scenario(
        "fleet: {drones: 3, ground: [{drone: 1, position_m: [0, 0, 7]}], "
        "makes: [{name: high, drones: [1, 2], altitude_offset_m: 20}]}"
    ).fleet
    assert fleet.altitudes_m == (60.0, 7.0, 80.0)


@pytest.mark.parametrize(
    ("spread", "ends"),
    [
        (Linspace(kind="linspace", low=2, high=6, count=3), [2, 6]),
        (Linspace(kind="linspace", low=0.5, high=6, count=3), [0.5, 6]),
        (Integers(kind="integers", low=2, high=6), [2, 6]),
        (Uniform(kind="uniform", low=0.5, high=1.5), [0.5, 1.5]),
        (Normal(kind="normal", mean=3, sd=1), [3]),
        (Normal(kind="normal", mean=3, sd=1, high=5), [5]),
    ],
)
def test_a_field_is_held_against_the_ends_of_its_spread_as_they_are_flown(spread: Any, ends: list[float]) -> None:
    """Whole numbers as whole numbers, since some fields take no others."""
    found = list(extremes(spread, ()))
    assert found == ends
    whole = isinstance(spread, Linspace | Integers)
    assert [isinstance(v, int) for v in found] == [whole and v == int(v) for v in ends]
