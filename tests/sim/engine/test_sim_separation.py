"""Groups, ground stations and models of movement that meet: an event names the pair, once for each meeting."""

from __future__ import annotations

import pytest
from sim_examples import example

from sortie.scenarios.reading.load import build
from sortie.sim.engine.separation import strangers
from sortie.sim.engine.sortie import run_sortie

CALM = "fleet.motion={pose_jitter_m: 0, gust_sigma_mps: 0}"
ROUTE = "fleet.route={waypoints_m: [[-20, 0], [20, 0]], speed_mps: 8, turn_time_s: 1}"
LINE = "formation: {shape: line, spacing_m: 40, altitude_m: 60}"
ONE = "fleet.formation={shape: line, spacing_m: 40, altitude_m: 60}"


def events(*settings: str) -> list[tuple[float, int, str]]:
    """Of the kind `too_near`."""
    rows = run_sortie(example(CALM, ONE, ROUTE, *settings)).tables["events"].to_pylist()
    return [(row["t_s"], row["drone"], row["text"]) for row in rows if row["kind"] == "too_near"]


def crossing(altitude_m: float) -> str:
    at = LINE.replace("60", str(altitude_m))
    return f"fleet.groups=[{{drones: [1], {at}, route: {{waypoints_m: [[20, 0], [-20, 0]], speed_mps: 8, turn_time_s: 1}}}}]"


def test_two_groups_that_fly_head_on_are_named_once() -> None:
    ((t_s, drone, text),) = events("fleet.drones=2", "duration_s=6", crossing(60))
    assert (drone, text.partition(" from ")[2]) == (0, "drone 1, fleet.steering.separation_m is 5")
    assert 2.0 < t_s < 3.5
    assert float(text.partition(" ")[0]) < 5.0


def test_nothing_is_said_of_groups_above_each_other_or_of_a_smaller_separation() -> None:
    assert events("fleet.drones=2", "duration_s=6", crossing(70)) == []
    low = ("fleet.drones=2", "duration_s=6", crossing(63))
    assert len(events(*low)) == 1
    assert events(*low, "fleet.steering.separation_m=2") == []


def test_a_drone_over_a_ground_station_is_named_and_two_stations_are_not() -> None:
    stations = "fleet.ground=[{drone: 1, position_m: [0, 0, 58]}, {drone: 2, position_m: [0, 2, 30]}]"
    assert [text.split(",")[0] for _, _, text in events("fleet.drones=3", "duration_s=5", stations)] == [
        "4.5 m from drone 1"
    ]


@pytest.mark.parametrize(
    ("fleet", "pairs"),
    [
        ({"drones": 3}, set()),
        ({"drones": 3, "groups": [{"drones": [1, 2]}]}, {(0, 1), (0, 2)}),
        ({"drones": 3, "groups": [{"drones": [1, 2], "mobility": "gauss_markov"}]}, {(0, 1), (0, 2), (1, 2)}),
        ({"drones": 3, "mobility": "random_waypoint"}, {(0, 1), (0, 2), (1, 2)}),
        ({"drones": 3, "ground": [{"drone": 1}, {"drone": 2}]}, {(0, 1), (0, 2)}),
    ],
)
def test_who_may_meet(fleet: dict[str, object], pairs: set[tuple[int, int]]) -> None:
    apart = strangers(build({"name": "a", "fleet": fleet}).fleet)
    assert {(int(a), int(b)) for a, b in zip(*apart.nonzero(), strict=True) if a < b} == pairs
