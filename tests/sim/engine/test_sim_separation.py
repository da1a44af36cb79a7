"""Groups, ground stations and models of movement that meet: an event names the pair, once for each meeting."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from sim_examples import example

from sortie.scenarios.reading.load import build
from sortie.sim.engine.separation import Separation, strangers
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
    route = "route: {waypoints_m: [[20, 0], [-20, 0]], speed_mps: 8, turn_time_s: 1}"
    return f"fleet.groups=[{{drones: [1], {at}, {route}}}]"


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


def test_who_may_meet() -> None:
    for fleet, pairs in (
        ({"drones": 3}, set()),
        ({"drones": 3, "groups": [{"drones": [1, 2]}]}, {(0, 1), (0, 2)}),
        ({"drones": 3, "groups": [{"drones": [1, 2], "mobility": "gauss_markov"}]}, {(0, 1), (0, 2), (1, 2)}),
        ({"drones": 3, "mobility": "random_waypoint"}, {(0, 1), (0, 2), (1, 2)}),
        ({"drones": 3, "ground": [{"drone": 1}, {"drone": 2}]}, {(0, 1), (0, 2)}),
    ):
        apart = strangers(build({"name": "a", "fleet": fleet}).fleet)
        assert {(int(a), int(b)) for a, b in zip(*apart.nonzero(), strict=True) if a < b} == pairs


SIX = {"drones": 6, "groups": [{"drones": [1]}, {"drones": [2, 5]}], "ground": [{"drone": 3}, {"drone": 4}]}
"""Drone 0 keeps the fleet's formation, 1 and 2 with 5 those of two groups; 3 and 4 stand on the ground."""
FAR = 100.0


class Places:
    """A motion of which the positions are known."""

    def __init__(self, position_m: np.ndarray) -> None:
        self._position_m = position_m

    def __getitem__(self, frames: slice) -> Any:
        return SimpleNamespace(position_m=self._position_m[frames])


def noted(fleet: dict[str, object], *frames: Sequence[float], down: str = "", descends: str = "") -> list[str]:
    """What is noted of drones on one line, as `FRAME: DRONE-OTHER DISTANCE`.

    Args:
        frames: of each, where the drones are. The separation is 5 m.
        down: `FRAME:DRONE` of each drone that is on the ground in a frame.
        descends: the drones that go home, which fly until they touch down.
    """
    place = np.zeros((len(frames), len(frames[0]), 3))
    place[:, :, 0] = frames
    told: list[str] = []
    frame, drones = 0, [SimpleNamespace(airborne=True) for _ in frames[0]]
    world: Any = SimpleNamespace(
        motion=Places(place),
        drones=drones,
        homebound=set(map(int, descends.split())),
        note=lambda drone, kind, text: told.append(f"{frame}: {drone}-{text.split(',')[0][-1]} {text.split()[0]}"),
    )
    watch = Separation(build({"name": "by_hand", "fleet": fleet}), world)
    for frame in range(len(frames)):
        for number, drone in enumerate(drones):
            drone.airborne = f"{frame}:{number}" not in down.split()
        watch.check(frame)
    return told


PAIR = {"drones": 2, "groups": [{"drones": [1]}]}


MEETINGS: list[tuple[list[float], str, list[str]]] = [
    # nearer than 5 m is a meeting, 5 m are none, and jitter up to 6 m is no second one
    ([9.0, 5.0, 4.9, 5.1, 5.9, 4.9, 3.0], "", ["2: 0-1 4.9"]),
    # from 6 m on the pair has parted: the next meeting is another one, as often as it happens
    ([4.0, 5.9, 4.1, 6.0, 4.2, 9.0, 4.3, 5.0], "", ["0: 0-1 4.0", "4: 0-1 4.2", "6: 0-1 4.3"]),
    # one that parted needs no wider berth than one that never met
    ([4.0, 6.1, 5.1, 5.5], "", ["0: 0-1 4.0"]),
    # either of the two on the ground is no meeting, whichever it is, and both together are none
    ([4.0] * 4, "0:0 1:1 2:0 2:1", ["3: 0-1 4.0"]),
    # who takes off again beside another meets it anew
    ([4.0] * 4, "1:1", ["0: 0-1 4.0", "2: 0-1 4.0"]),
]
"""Frame by frame: how far apart two drones are, who is on the ground, and what is noted."""


def test_a_meeting_of_two_is_noted_once_by_hand() -> None:
    got = [noted(PAIR, *((0.0, x_m) for x_m in apart_m), down=down) for apart_m, down, _ in MEETINGS]
    assert got == [told for *_, told in MEETINGS]


def test_of_many_that_meet_each_pair_is_noted_once_by_its_lower_number() -> None:
    """Members of one group and two stations are no pairs: all but 2 with 5 and 3 with 4 meet."""
    crowd = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    every = [f"{a}-{b} {(b - a) / 10:.1f}" for a in range(6) for b in range(a + 1, 6) if (a, b) not in {(2, 5), (3, 4)}]
    assert noted(SIX, crowd, crowd) == [f"0: {pair}" for pair in every]


def test_a_meeting_of_one_pair_hides_none_of_another() -> None:
    """Drone 1 flies past 0, then past 2, whom it leaves and meets again; 0 keeps drone 3 company all the while."""
    x_m = [
        (0.0, 1.0, FAR, 2.0, -FAR, 2 * FAR),
        (0.0, 97.0, FAR, 2.0, -FAR, 2 * FAR),
        (0.0, 50.0, FAR, 2.0, -FAR, 2 * FAR),
    ]
    told = ["0: 0-1 1.0", "0: 0-3 2.0", "0: 1-3 1.0", "1: 1-2 3.0", "3: 1-2 3.0"]
    assert noted(SIX, *x_m, x_m[1]) == told


def test_a_drone_that_goes_home_meets_others_until_it_touches_down() -> None:
    assert noted(PAIR, (0.0, 9.0), (0.0, 4.0), descends="1") == ["1: 0-1 4.0"]
    assert noted(PAIR, (0.0, 9.0), (0.0, 4.0), descends="1", down="1:1") == []
