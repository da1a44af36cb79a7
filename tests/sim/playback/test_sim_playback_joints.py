"""What is drawn where: the picture of one frame, the arrows of links, the map's houses and trails, and what a layout shows.

Held: the pose that a grid lies by (the ego's own estimate), which cell and colour each square has, which direction's goodput
an arrow has, whose links are shown, how far drones fly apart, and which drones and plots a layout begins with.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from record_by_hand import record, tables_of
from sim_examples import example

from sortie.scenarios.link_state import SILENT_MBPS
from sortie.sim.playback import layout
from sortie.sim.playback.canvas import packed
from sortie.sim.playback.comparison import SHARED, comparison, roots
from sortie.sim.playback.ground_map import GroundMap
from sortie.sim.playback.links import BROKEN_MBPS, LinkArrows
from sortie.sim.playback.recording import spread_m
from sortie.sim.results import palette

Shown = dict[str, Any]


class Kept:
    """A canvas, and a recording, that keep what is drawn."""

    def __init__(self) -> None:
        self.still: dict[str, Any] = {}
        self.rows: dict[str, list[tuple[float, list[Any]]]] = {}

    def static(self, path: str, *shown: Any) -> None:
        self.still[path] = shown[0]

    def log(self, path: str, *shown: Any, static: bool, strict: bool) -> None:
        self.still[path] = shown[0]

    def send_recording_name(self, name: str) -> None:
        self.name = name

    def columns(self, path: str, t_s: Any, columns: Any) -> None:
        for column in columns:
            name = column.component_descriptor().component.split(":")[1]
            values = column.as_arrow_array().to_pylist()
            known = self.rows.setdefault(f"{path} {name}", [])
            known += zip(np.asarray(t_s, float).tolist(), values, strict=True)


def told(part: Any) -> Any:
    return part.as_arrow_array().to_pylist()


# --- links ----------------------------------------------------------------------------------------------------------


def arrows(n: int, goodput: list[list[float]], up: list[bool], sent: list[tuple[int, int, int]] = []) -> Kept:  # noqa: B006
    """Drones 100 m apart on a line, for a second; each has said its goodput, and payloads came to an end at 0.5 s."""
    kept = Kept()
    links = LinkArrows(kept, n, 10.0)  # type: ignore[arg-type]
    tables = tables_of({
        "descriptors": [{"t_s": 0.1, "drone": d, "goodput_mbps": goodput[d]} for d in range(n)],
        "transmissions": [{"t_done_s": 0.5, "drone": a, "peer": b, "payload_bytes": size} for a, b, size in sent],
    })  # fmt: skip
    position = np.array([[(100.0 * d, 0.0, 60.0) for d in range(n)]] * 11)
    links.add(np.arange(11) / 10, position, np.array([up] * 11), tables)
    return kept


def drawn(kept: Kept) -> dict[tuple[int, int], tuple[int, float]]:
    """Colour and radius by sender and receiver, of the last frame."""
    names = ("origins", "vectors", "colors", "radii")
    origins, vectors, colours, radii = (kept.rows[f"world/links {name}"][-1][1] for name in names)
    found = {}
    for origin, vector, colour, radius in zip(origins, vectors, colours, radii, strict=True):
        step = 1 if vector[0] > 0 else -1
        sender = round((origin[0] - 3.5 * step) / 100)
        found[sender, round((origin[0] + vector[0] + 3.5 * step) / 100)] = (colour, radius)
    return found


def test_an_arrow_is_as_green_as_its_own_direction_and_as_wide_as_its_traffic() -> None:
    kept = arrows(2, [[100.0], [1.0]], [True, True], [(0, 1, 125_000), (1, 0, 375_000)])
    found = drawn(kept)
    for (sender, receiver), mbps, goodput in (((0, 1), 1.0, 100.0), ((1, 0), 3.0, 1.0)):
        colour, radius = found[sender, receiver]
        assert colour == int(packed(palette.goodput_colours(np.array([goodput])))[0])
        assert radius == pytest.approx(-(1.5 + math.log2(1.0 + mbps)))
    idle = drawn(arrows(2, [[100.0], [1.0]], [True, True]))
    assert idle == {
        pair: (int(packed(np.array([palette.IDLE], np.uint8))[0]), pytest.approx(-0.75)) for pair in ((0, 1), (1, 0))
    }


def test_links_are_between_those_in_the_air() -> None:
    assert set(drawn(arrows(3, [[9.0, 9.0]] * 3, [True, False, True]))) == {(0, 2), (2, 0)}


@pytest.mark.parametrize("n", [8, 9])
def test_large_fleets_show_what_carries_something_alone(n: int) -> None:
    found = drawn(arrows(n, [[9.0] * (n - 1)] * n, [True] * n, [(0, 1, 1000)]))
    assert len(found) == (56 if n == 8 else 1)


def test_a_pair_is_crossed_out_by_either_direction_and_not_before_anything_was_tried() -> None:
    weak = BROKEN_MBPS / 2

    def crosses(goodput: list[list[float]], up: list[bool]) -> int:
        shown = arrows(3, goodput, up).rows.get("world/broken strips", [(0.0, [])])
        return len(shown[-1][1]) // 4

    fine, unknown = [9.0, 9.0], [0.0, 0.0]
    assert crosses([fine, fine, fine], [True] * 3) == 0
    assert crosses([[weak, 9.0], fine, fine], [True] * 3) == 1
    assert crosses([fine, [weak, 9.0], fine], [True] * 3) == 1, "what drone 1 says of drone 0"
    assert crosses([[SILENT_MBPS, 9.0], fine, fine], [True] * 3) == 1
    assert crosses([unknown, unknown, unknown], [True] * 3) == 0
    assert crosses([[weak, 9.0], fine, fine], [True, False, True]) == 0
    assert crosses([[weak, 9.0], fine, fine], [False, True, True]) == 0


# --- the map --------------------------------------------------------------------------------------------------------


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
    mission = tables_of({
        "mission": [
            {"t_s": k / 10, "region_x_m": 120.0, "region_y_m": 60.0, "region_radius_m": 10.0 if k < 8 else math.nan} for k in range(16)
        ]
    })["mission"]  # fmt: skip
    t_s = np.arange(16) / 10
    position = np.zeros((16, 1, 3))
    for part in (slice(0, 3), slice(3, 16)):
        made.add(
            t_s[part], position[part], np.ones((16, 1), bool)[part], mission.slice(part.start, part.stop - part.start)
        )
    rings = kept.rows["map/mission strips"]
    assert [(t, len(strips)) for t, strips in rings] == [(0.0, 1), (0.5, 1), (1.0, 0), (1.5, 0)]
    assert [math.hypot(x - 20.0, y - 290.0) for x, y in rings[0][1][0]] == pytest.approx(
        [10.0] * len(rings[0][1][0]), abs=1e-4
    )


# --- layouts --------------------------------------------------------------------------------------------------------


def test_drones_fly_as_far_apart_as_the_farthest_of_those_in_the_air() -> None:
    """Two drones 20 m apart, a third far off on the ground: in 19 of 20 frames the farthest is 10 m from the middle."""
    made = record()
    fleet = made.scenario.fleet.model_copy(update={"drones": 3})
    states = [
        {
            "t_s": float(k), "drone": d, "x_m": 1000.0 + (20.0 + (80.0 if k == 0 else 0.0)) * (d == 1), "y_m": 500.0 * (d == 2),
            "airborne": d < 2,
        }
        for k in range(41)
        for d in range(3)
    ]  # fmt: skip
    flown = replace(
        made, scenario=made.scenario.model_copy(update={"fleet": fleet}), tables=tables_of({"states": states})
    )
    assert spread_m(flown) == pytest.approx(10.0)
    often = [{**s, "x_m": 1000.0 + 100.0 * (s["drone"] == 1)} if s["t_s"] < 4 else s for s in states]
    assert spread_m(replace(flown, tables=tables_of({"states": often}))) == pytest.approx(50.0)
    three = [{**s, "airborne": True, "y_m": 0.0, "x_m": (0.0, 30.0, 90.0)[s["drone"]]} for s in states]
    assert spread_m(replace(flown, tables=tables_of({"states": three}))) == pytest.approx(50.0)


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


def test_the_map_shows_the_middle_of_a_town_that_is_wider_than_high() -> None:
    shown = layout._middle((900.0, 700.0))
    edge = layout.MARGIN_M - layout.MAP_EDGE_M
    assert told(shown.range) == [{"x_range": [edge, 900.0 - edge], "y_range": [edge, 700.0 - edge]}]


def test_the_legend_tells_of_boxes_where_there_are_any() -> None:
    trucks = ("perception.scene.trucks=0.1", "perception.detector=surrogate")
    for overrides, boxes_told, classes_told in (
        (("perception.detector=none",), False, False), (("perception.detector=surrogate",), True, False), (trucks, True, True),
        (("perception.scene.trucks=0.1",), False, False),
    ):  # fmt: skip
        (text,) = told(layout.legend(example(*overrides)).text)
        assert ("**Boxes**" in text, "**trucks**" in text) == (boxes_told, classes_told), overrides


def test_the_legend_tells_of_turns_where_drones_take_them() -> None:
    for overrides, turns in (
        (("perception={detector: surrogate, egos: 2}",), "2 of 5 at a time"),
        (("perception={detector: surrogate, egos: 5}",), None),
        (("perception={detector: none, egos: 2}",), None),
    ):
        (text,) = told(layout.legend(example(*overrides)).text)
        assert ("turns" in text) == (turns is not None)
        assert turns is None or turns in text


def test_labels_of_a_comparison_have_roots_plots_and_names_of_their_own() -> None:
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
