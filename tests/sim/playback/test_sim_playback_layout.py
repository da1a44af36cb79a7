"""The map of a playback, and its layout: what is drawn where, and which drones and plots it begins with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from played_flight import Kept
from record_by_hand import record, tables_of
from sim_examples import example

from sortie.sim.playback import layout
from sortie.sim.playback.canvas import packed
from sortie.sim.playback.comparison import SHARED, comparison, roots
from sortie.sim.playback.ground_map import GroundMap
from sortie.sim.playback.recording import spread_m
from sortie.sim.results import palette


def told(part: Any) -> Any:
    return part.as_arrow_array().to_pylist()


# --- the map ----------------------------------------------------------------------------------------------


def ground_map(rate_hz: float = 2.0) -> tuple[GroundMap, Kept]:
    """Of one drone over a scene of 400 m by 300 m whose south-west corner is at (100, 50)."""
    kept, scene = Kept(), SimpleNamespace(rect=(100.0, 50.0, 500.0, 350.0), targets=())
    scenario = example("fleet.drones=1", f"context.rate_hz={rate_hz}")
    return GroundMap(kept, scenario, scene), kept  # type: ignore[arg-type]


def test_houses_stand_on_the_map_with_north_up_and_are_cut_at_its_edges() -> None:
    made, kept = ground_map()
    ground = np.zeros((300, 400, 3), np.uint8)
    ground[0] = 9  # the south edge
    houses = np.array([[110.0, 60.0, 130.0, 70.0, 8.0], [90.0, 340.0, 105.0, 360.0, 8.0]])
    made.begin(ground, houses)
    (buffer,) = told(kept.still["map/ground"].buffer)
    image = np.array(buffer, np.uint8).reshape(300, 400, 3)
    house = (image == np.array((128, 124, 120))).all(axis=2)
    assert image[299, 50].tolist() == [9, 9, 9]
    assert image[0, 50].tolist() == [0, 0, 0]
    assert house[280:290, 10:30].all()
    assert house[:10, :5].all()
    assert house.sum() == 200 + 50


def test_a_trail_is_of_the_last_minute() -> None:
    made, kept = ground_map()
    t_s = np.arange(0, 150) / 2
    position = np.column_stack([100.0 + t_s, np.full(150, 50.0), np.full(150, 60.0)])[:, None]
    empty = tables_of({})["mission"]
    up = np.ones((150, 1), bool)
    made.add(t_s[:75], position[:75], up[:75], empty)
    made.add(t_s[75:], position[75:], up[75:], empty)
    trails = kept.rows["map/trails strips"]
    assert [t for t, _ in trails] == [float(k) for k in range(75)]
    (last,) = trails[-1][1]
    assert [x for x, _ in last] == pytest.approx([float(k) for k in range(15, 75)])
    assert {y for _, y in last} == {300.0}


def test_a_drone_is_grey_while_it_is_down_and_its_trail_begins_anew_where_it_takes_off() -> None:
    """At 2 Hz: in the air until 2 s, and from 4 s on, 100 m further."""
    made, kept = ground_map()
    t_s = np.arange(0, 12) / 2
    x_m = np.where(t_s < 2, 100.0 + t_s, np.where(t_s < 4, 101.5, 200.0 + t_s))
    position = np.column_stack([x_m, np.full(12, 50.0), np.full(12, 60.0)])[:, None]
    up = ((t_s < 2) | (t_s >= 4))[:, None]
    for part in (slice(0, 5), slice(5, 12)):
        made.add(t_s[part], position[part], up[part], tables_of({})["mission"])
    own, grey = (packed(np.array([c], np.uint8))[0] for c in (palette.drone_colour(0), palette.FALLEN))
    assert [c for _, (c,) in kept.rows["map/drones colors"]] == [own] * 4 + [grey] * 4 + [own] * 4
    trails = {t: [x for x, _ in strip] for t, (strip,) in kept.rows["map/trails strips"]}
    assert trails[3.0] == pytest.approx([0.0, 1.0, 1.5, 1.5])
    assert trails[5.0] == pytest.approx([104.0] * 5 + [105.0])


def test_regions_are_drawn_twice_a_second_through_all_slices() -> None:
    """At 10 Hz every fifth frame, also where a slice begins between two."""
    made, kept = ground_map(10.0)
    centre = {"region_x_m": 120.0, "region_y_m": 60.0}
    flies = [{"t_s": k / 10, **centre, "region_radius_m": 10.0 if k < 8 else math.nan} for k in range(16)]
    mission = tables_of({"mission": flies})["mission"]
    for part in (slice(0, 3), slice(3, 16)):
        count = part.stop - part.start
        t_s, up = np.arange(part.start, part.stop) / 10, np.ones((count, 1), bool)
        made.add(t_s, np.zeros((count, 1, 3)), up, mission.slice(part.start, count))
    rings = kept.rows["map/mission strips"]
    assert [(t, len(strips)) for t, strips in rings] == [(0.0, 1), (0.5, 1), (1.0, 0), (1.5, 0)]
    assert {round(math.hypot(x - 20.0, y - 290.0), 4) for x, y in rings[0][1][0]} == {10.0}


# --- layouts ----------------------------------------------------------------------------------------------


def spread_of(*ground: int, **columns: Callable[[int, int], Any]) -> float:
    """Of three drones in 41 frames that stand at the origin, in the air, but for these columns by frame and drone."""
    rows = [
        {"t_s": float(k), "drone": d, "airborne": True, **{name: of(k, d) for name, of in columns.items()}}
        for k in range(41)
        for d in range(3)
    ]
    stations = ", ".join(f"{{drone: {drone}}}" for drone in ground)
    fleet = example("fleet.drones=3", f"fleet.ground=[{stations}]").fleet
    scenario = record().scenario.model_copy(update={"fleet": fleet})
    return spread_m(replace(record(), scenario=scenario, tables=tables_of({"states": rows})))


def test_drones_fly_as_far_apart_as_the_farthest_of_those_in_the_air() -> None:
    """In 19 of 20 frames, from their middle. Neither who is down nor a ground station counts."""
    twenty = lambda k, d: 1000.0 + (d == 1) * (100.0 if k == 0 else 20.0)  # noqa: E731
    often = lambda k, d: 1000.0 + (d == 1) * (100.0 if k < 4 else 20.0)  # noqa: E731
    far = {"y_m": lambda k, d: 500.0 * (d == 2)}
    assert spread_of(x_m=twenty, airborne=lambda k, d: d < 2, **far) == pytest.approx(10.0)
    assert spread_of(2, x_m=twenty, **far) == pytest.approx(10.0)
    assert spread_of(x_m=often, airborne=lambda k, d: d < 2, **far) == pytest.approx(50.0)
    assert spread_of(x_m=lambda k, d: (0.0, 30.0, 90.0)[d]) == pytest.approx(50.0)


def test_the_scene_begins_with_what_drone_0_sees() -> None:
    view = layout.scene_view(example("fleet.drones=3"), "/root")
    assert set(view.visualizer_overrides) == {
        f"/root/world/{what}/{i}" for what in ("seen", "received") for i in (1, 2)
    }


def test_the_eye_sees_what_flies_in_the_formation_and_its_widest_footprint() -> None:
    """A ground station of 2 m flies in no formation and sees no wide circle: the view is that of the drone alone."""

    def at(*overrides: str, **options: float) -> list[float]:
        view = layout.scene_view(example(*overrides), **options)  # type: ignore[arg-type]
        return told(view.properties["EyeControls3D"].position)[0]  # type: ignore[no-any-return]

    alone, two = at("fleet.drones=1"), at("fleet.drones=2")
    assert two[2] > alone[2] + 5.0
    assert at("fleet.drones=2", "fleet.ground=[{drone: 1, position_m: [0, 0, 2]}]") == alone
    assert at("fleet.drones=1", spread_m=500.0)[2] == pytest.approx(alone[2] + 0.95 * 500.0, abs=1e-3)


def test_lanes_are_of_the_first_drones_and_of_every_group() -> None:
    scenario = example("fleet.drones=10", "mission.groups=[{drones: [1], phases: [{phase: search}]}]")
    lanes = layout.lanes_view(scenario).contents
    assert list(lanes) == ["/lanes/events", "/lanes/phase", "/lanes/phase_1", *(f"/lanes/drone_{i}" for i in range(8))]


def test_the_legend_tells_of_boxes_and_of_turns_where_there_are_any() -> None:
    surrogate, trucks = "perception.detector=surrogate", "perception.scene.trucks=0.1"
    boxes, classes, turns = "**Boxes**", "**trucks**", "2 of 5 at a time"
    for overrides, told_of in (
        (("perception.detector=none",), set()),
        ((surrogate,), {boxes}),
        ((surrogate, trucks), {boxes, classes}),
        ((trucks,), set()),
        (("perception={detector: surrogate, egos: 2}",), {boxes, turns, "turns"}),
        (("perception={detector: surrogate, egos: 5}",), {boxes}),
        (("perception={detector: none, egos: 2}",), set()),
    ):
        (text,) = told(layout.legend(example(*overrides)).text)
        assert {word for word in (boxes, classes, turns, "turns") if word in text} == told_of, overrides


def test_labels_of_a_comparison_have_roots_plots_and_names_of_their_own() -> None:
    assert roots(["silence", "§"]) == ["silence", "policy"]
    labels = ["best-2(k=1)", "best-2(k:1)", "worked"]
    assert roots(labels) == ["best-2_k_1", "best-2_k_1_1", "worked"]
    for detector, shared in (("none", SHARED[1:]), ("surrogate", SHARED)):
        sheet = comparison(example(f"perception.detector={detector}"), labels)
        plots = sheet.root_container.contents[1].contents
        assert [plot.name for plot in plots] == [name for name, _, _ in shared]
        entity = shared[-1][1]
        assert list(plots[-1].contents) == [f"/{root}/plots/{entity}" for root in roots(labels)]
        names = [told(plots[-1].visualizer_overrides[path].names) for path in plots[-1].contents]
        assert names == [[label] for label in labels]
