"""Exports of a record by hand, in which every value is another one: each stands in its own field, of its own drone."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from record_by_hand import record, tables_of
from rosbags.typesys import Stores, get_typestore

from sortie.fleet.coverage import TARGET_FLAG
from sortie.fleet.energy.cell import MEAN_CELL_V
from sortie.fleet.logs.geodesy import Origin, geodetic
from sortie.fleet.messages.compact import Form, decode_compact, encode_compact
from sortie.fleet.messages.wire import decode_descriptor
from sortie.policies.contract import Directive, Disc, Representation, TaskPhase
from sortie.scenarios.reading.load import loads
from sortie.sim.export import bag
from sortie.sim.export.messages import descriptors, directives
from sortie.sim.export.telemeter import Telemeter
from sortie.sim.export.telemetry import Stream, parameters_of
from sortie.sim.results.flown_scene import houses, jamming, scene_of
from sortie.sim.results.palette import FALSE, FOUND, MISSED, goodput_colours
from sortie.sim.results.record import SortieRecord

SCENARIO = """
name: exported
duration_s: 3
fleet:
  drones: 3
  makes: [{name: big, drones: [1], battery: {capacity_wh: 222, cells: 6}}]
  overrides: [{drone: 2, capacity_wh: 20}]
context: {rate_hz: 1, roster: false}
mission:
  target: {waypoints_m: [[0, 0], [90, 0]], speed_mps: 3}
  more_targets: [{waypoints_m: [[0, 40], [90, 40]], speed_mps: 2}]
  groups: [{drones: [2], phases: [{phase: search, target: 1, region: {centre_m: [7, 8], radius_m: 9}}]}]
  phases: [{phase: track, region: {centre_m: [1, 2], radius_m: 30}}]
events: [{kind: jam, at_s: 1, until_s: 2, position_m: [10, 20, 5], power_dbm: 17}]
perception: {detector: surrogate, sample_rate_hz: 1}
"""
BEGIN_NS = 5_000_000_000
NAN = math.nan
CAR = {"length_m": 4.5, "width_m": 1.9, "yaw_rad": 0.5}
COLUMNS = ("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps", "p_radps", "q_radps", "r_radps")
PACK = ("soc", "voltage_v", "current_a", "spent_j")


def state(frame: int, drone: int) -> dict[str, Any]:
    """Ten times the drone and a hundredth of the frame, by the column."""
    values = {name: 10.0 * drone + k + frame / 100 for k, name in enumerate((*COLUMNS, *PACK))}
    half = 0.1 * (drone + 1) + 0.01 * frame
    turn = {"qx": 0.0, "qy": 0.0, "qz": math.sin(half), "qw": math.cos(half)}
    return {"t_s": float(frame), "drone": drone, "airborne": not (drone == 2 and frame == 2), **values, **turn}


def flies(frame: int, group: int) -> dict[str, Any]:
    """The fleet tracks target 0, and drone 2 searches for target 1 elsewhere."""
    region = dict(
        zip(("region_x_m", "region_y_m", "region_radius_m"), ((1.0, 2.0, 30.0), (7.0, 8.0, 9.0))[group], strict=True)
    )
    target = {"target": group, "target_x_m": (3.0 - group) * frame, "target_y_m": 40.0 * group}
    return {"t_s": float(frame), "group": group, "phase": ("track", "search")[group], **target, **region}


def claims(t_s: float, d: int) -> dict[str, Any]:
    radius_m = 30.0 + d if t_s < 2 else NAN
    return {
        "t_s": t_s,
        "drone": d,
        "stamp_ns": round(t_s * 1e9) - 4_000_000,
        "soc": 0.9 - d / 10,
        "cpu_headroom": 0.5 + d / 10,
        "gpu_headroom": 0.3 + d / 10,
        "goodput_mbps": [10.0 * d + 1, 10.0 * d + 2],
        "coverage_grid": bytes([d]) * 64,
        "novelty_flags": TARGET_FLAG if d else 0,
        "phase": "track" if d < 2 else "search",
        **{"region_x_m": 1.0 + d, "region_y_m": 2.0 + d, "region_radius_m": radius_m},
    }


FIRST = {
    "t_s": 0.5,
    "drone": 1,
    "peer": 2,
    "representation": "features",
    "rho": 0.25,
    "rate_hz": 7.5,
    "deadline_s": 0.35,
}
FIRST |= {
    "roi_x_m": 3.0,
    "roi_y_m": 4.0,
    "roi_radius_m": 5.0,
    "fusion_weight": 0.6,
    "duty_percent": 80,
    "reason": "first",
}
SECOND = {
    "t_s": 1.5,
    "drone": 0,
    "peer": 1,
    "representation": "detections",
    "rho": 0.0,
    "rate_hz": 2.0,
    "deadline_s": 0.1,
}
SECOND |= {"roi_radius_m": NAN, "fusion_weight": 1.0, "duty_percent": 100, "reason": "second"}


def exported() -> SortieRecord:
    published = [(0.004, 0), (0.005, 1), (0.006, 2), (1.004, 1), (2.9, 0)]
    seen = {"t_s": 0.5, "drone": 0, **CAR}
    found = ((0, 2.1, 3.0, 0.9), (0, -9.0, -8.0, 0.5), (2, 40.0, 41.0, 0.25))
    given = {
        "states": [state(frame, drone) for frame in range(3) for drone in range(3)],
        "mission": [flies(frame, group) for frame in range(3) for group in range(2)],
        "descriptors": [claims(t_s, d) for t_s, d in published],
        "directives": [FIRST, SECOND],
        "events": [
            {"t_s": 0.2, "drone": -1, "kind": "jam", "text": "a jammer"},
            {"t_s": 1.0, "drone": 1, "kind": "gnss_loss", "text": "lost GNSS"},
            {"t_s": 1.5, "drone": 1, "kind": "gnss_back", "text": "GNSS again"},
        ],
        "fusions": [
            {"t_s": 0.5, "drone": d, "detections": k, "truths": k if d == 0 else 0} for d, k in ((0, 2), (2, 1))
        ],
        "truths": [{**seen, "x_m": 2.0, "y_m": 3.0, "car": 0}, {**seen, "x_m": 22.0, "y_m": 23.0, "car": 1}],
        "detections": [{**seen, "drone": d, "x_m": x, "y_m": y, "score": score} for d, x, y, score in found],
    }
    return replace(record(), scenario=loads(SCENARIO), tables=tables_of(given))


def where(frame: int, drone: int) -> tuple[float, float, float]:
    """Drone 2 is lost in frame 2: it is on the ground, and the record keeps its last height."""
    s = state(frame, drone)
    return s["x_m"], s["y_m"], s["z_m"] if s["airborne"] else 0.0


def test_a_directive_has_every_field_of_its_row() -> None:
    assert list(directives(exported())) == [
        (0.5, Directive(1, 2, Representation.FEATURES, 0.25, Disc(3.0, 4.0, 5.0), 7.5, 0.35, 0.6, 80, "first")),
        (1.5, Directive(0, 1, Representation.DETECTIONS, 0.0, None, 2.0, 0.1, 1.0, 100, "second")),
    ]
    first = next(iter(directives(exported())))[1]
    assert first.reason == "first"  # equal directives may have other reasons


def test_a_descriptor_has_the_fields_of_its_row_and_the_pose_of_its_frame() -> None:
    made = list(descriptors(exported()))
    assert [(t_s, d.agent_id) for t_s, d in made] == [(0.004, 0), (0.005, 1), (0.006, 2), (1.004, 1), (2.9, 0)]
    for (t_s, d), frame in zip(made, (0, 0, 0, 1, 2), strict=True):
        drone = d.agent_id
        s = state(frame, drone)
        assert d.position_m == (s["x_m"], s["y_m"], s["z_m"])
        assert d.velocity_mps == (s["vx_mps"], s["vy_mps"], s["vz_mps"])
        assert d.orientation_xyzw == (s["qx"], s["qy"], s["qz"], s["qw"])
        assert d.stamp_ns == round(t_s * 1e9) - 4_000_000
        assert (d.battery_soc, d.cpu_headroom, d.gpu_headroom) == (0.9 - drone / 10, 0.5 + drone / 10, 0.3 + drone / 10)
        assert d.peer_goodput_mbps == (10.0 * drone + 1, 10.0 * drone + 2)
        assert d.coverage_grid == bytes([drone]) * 64
        assert d.region == (None if t_s > 2 else Disc(1.0 + drone, 2.0 + drone, 30.0 + drone))
        assert d.task_phase == (TaskPhase.SEARCH if drone == 2 else TaskPhase.TRACK)
        assert d.priority_target_ids == ((), (0,), (1,))[drone]
        assert d.footprint_radius_m == pytest.approx(math.tan(math.radians(35)) * s["z_m"])


def test_a_ground_station_is_blind_and_stays_on_its_mast_when_it_is_off() -> None:
    settings = SCENARIO.replace("  overrides:", "  ground: [{drone: 2, position_m: [20, 21, 22]}]\n  overrides:")
    made = [d for _, d in descriptors(replace(exported(), scenario=loads(settings)))]
    blind = {"footprint_radius_m": 0.0, "feature_space": "none"}
    plain = [d for _, d in descriptors(exported())]
    assert made == [d._replace(**blind) if d.agent_id == 2 else d for d in plain]
    last = list(Telemeter(loads(settings)).add(exported().tables))[-1][1]
    assert (last.landed, last.ground_station) == (True, True)
    assert last.position_m == tuple(state(2, 2)[name] for name in ("x_m", "y_m", "z_m"))


Told = dict[str, list[tuple[float, Any]]]


def told_of(made: SortieRecord) -> Told:
    """The bag's messages by topic."""
    found: Told = {}
    types = bag._makers(get_typestore(Stores.ROS2_HUMBLE).types)
    for stream in bag._streams(made, types, BEGIN_NS, Origin(47.0, 8.0, 400.0)):
        for m in stream:
            found.setdefault(m.topic, []).append((m.t_s, m.value))
    return found


@pytest.fixture(scope="module")
def told() -> Told:
    return told_of(exported())


def test_a_descriptor_of_a_smaller_form_is_in_the_bag_as_its_peers_read_it() -> None:
    small = replace(exported(), scenario=loads(SCENARIO.replace("roster: false", "roster: false, form: small")))
    form = Form(**small.scenario.context.form.model_dump())
    said = (decode_descriptor(data) for _, data in told_of(small)["/fleet/context"])
    for (_, d), found in zip(descriptors(small), said, strict=True):
        read = decode_compact(encode_compact(d, form)).peer_goodput_mbps
        assert found.peer_goodput_mbps == pytest.approx(read, rel=1e-6)
        assert read != d.peer_goodput_mbps


def xyz(point: Any) -> tuple[float, float, float]:
    return point.x, point.y, point.z


def test_poses_frames_fixes_and_batteries_are_each_drone_s_own(told: Told) -> None:
    frames = {(t_s, m.transforms[0].child_frame_id): m.transforms[0] for t_s, m in told["/tf"]}
    assert len(frames) == len(told["/tf"]) == 9
    for drone, frame in np.ndindex(3, 3):
        s, t_s = state(frame, drone), float(frame)
        at, moved = where(frame, drone), frames[t_s, f"drone_{drone}"]
        assert moved.header.frame_id == "world"
        assert xyz(moved.transform.translation) == at
        r = moved.transform.rotation
        assert (r.x, r.y, r.z, r.w) == tuple(s[q] for q in ("qx", "qy", "qz", "qw"))
        when, pose = told[f"/drone_{drone}/pose"][frame]
        assert (when, pose.header.frame_id, pose.header.stamp.sec) == (t_s, "world", 5 + frame)
        assert xyz(pose.pose.position) == at
        _, fix = told[f"/drone_{drone}/fix"][frame]
        assert (fix.latitude, fix.longitude, fix.altitude) == geodetic(at, Origin(47.0, 8.0, 400.0))
        assert fix.header.frame_id == f"drone_{drone}"
        assert fix.status.status == (-1 if (drone, frame) == (1, 1) else 0)
        _, battery = told[f"/drone_{drone}/battery"][frame]
        assert (battery.voltage, battery.current, battery.percentage) == (s["voltage_v"], -s["current_a"], s["soc"])
        assert battery.header.frame_id == f"drone_{drone}"
    assert [t_s for t_s, _ in told["/clock"]] == [0.0, 1.0, 2.0]


def test_the_log_names_who_decided_and_what_happened_to_whom(told: Told) -> None:
    assert [(t_s, m.level, m.name, m.msg) for t_s, m in told["/decisions"]] == [
        (0.2, 30, "fleet", "fleet: a jammer"),
        (0.5, 20, "drone_1", "drone 1 → 2: features ρ=0.25 at 7.5 Hz in 5 m, because first"),
        (1.0, 30, "drone_1", "drone 1: lost GNSS"),
        (1.5, 20, "drone_0", "drone 0 → 1: detections at 2 Hz, because second"),
        (1.5, 30, "drone_1", "drone 1: GNSS again"),
    ]
    assert [t_s for t_s, _ in told["/drone_1/to_drone_2/directive"]] == [0.5]
    assert [t_s for t_s, _ in told["/drone_0/to_drone_1/directive"]] == [1.5]
    assert "/drone_2/to_drone_1/directive" not in told


def place(marker: Any) -> tuple[float, float, float]:
    return xyz(marker.pose.position)


def colour(marker: Any) -> tuple[float, ...]:
    c = marker.color
    return tuple(round(255 * part, 6) for part in (c.r, c.g, c.b, c.a))


def test_boxes_are_where_they_were_found_in_the_colour_of_what_they_are(told: Told) -> None:
    ((t_s, message),) = told["/drone_0/boxes"]
    clear, found, missed, false = message.markers
    assert (t_s, clear.action) == (0.5, 3)
    at = {m.ns: place(m) for m in (found, missed, false)}
    assert at == {"found": (2.1, 3.0, 0.9), "missed": (22.0, 23.0, 0.9), "false": (-9.0, -8.0, 0.9)}
    for m, shades, score in ((found, FOUND, 0.9), (missed, MISSED, 1.0), (false, FALSE, 0.5)):
        assert colour(m) == pytest.approx((*shades[0], 60 + 120 * score))
        assert (m.scale.x, m.scale.y, m.scale.z) == (4.5, 1.9, 1.8)
        assert (m.pose.orientation.z, m.pose.orientation.w) == pytest.approx((math.sin(0.25), math.cos(0.25)))
    (_, one), (down_s, cleared) = told["/drone_2/boxes"]
    assert [(m.ns, place(m)) for m in one.markers[1:]] == [("false", (40.0, 41.0, 0.9))]
    assert (down_s, len(cleared.markers)) == (2.0, 1)  # it is down, and its boxes are cleared
    assert "/drone_1/boxes" not in told


def test_the_boxes_of_a_drone_that_waits_for_its_turn_are_cleared() -> None:
    """Three drones, two at a time: drone 0 waits at 1.5 s, and its boxes are of an earlier time."""
    made = exported()
    scenario = loads(SCENARIO.replace("sample_rate_hz: 1", "sample_rate_hz: 1, egos: 2"))
    turns = [(0.5, 0), (0.5, 2), (1.5, 1), (1.5, 2)]
    tables = tables_of(
        {
            "fusions": [{"t_s": t_s, "drone": d, "detections": 1} for t_s, d in turns],
            "detections": [{"t_s": t_s, "drone": d, **CAR, "score": 0.5} for t_s, d in turns],
        }
    )
    of_turns = {name: tables[name] for name in ("fusions", "detections", "truths")}
    told = told_of(replace(made, scenario=scenario, tables={**made.tables, **of_turns}))
    assert [(t_s, len(m.markers) > 1) for t_s, m in told["/drone_0/boxes"]] == [(0.5, True), (1.5, False)]
    assert [t_s for t_s, _ in told["/drone_2/boxes"]] == [0.5, 1.5, 2.0]


def test_regions_targets_and_jammers_are_drawn_where_they_are(told: Told) -> None:
    assert [t_s for t_s, _ in told["/scene/mission"]] == [0.0, 1.0, 2.0]
    for k, (_, message) in enumerate(told["/scene/mission"]):
        discs = [m for m in message.markers if m.ns == "region" and m.type == 3]
        assert [(place(m)[:2], m.scale.x, m.scale.y) for m in discs] == [
            ((1.0, 2.0), 60.0, 60.0),
            ((7.0, 8.0), 18.0, 18.0),
        ]
        rings = [m for m in message.markers if m.ns == "region" and m.type == 4]
        for ring, (x, y, radius) in zip(rings, ((1, 2, 30), (7, 8, 9)), strict=True):
            assert [math.hypot(p.x - x, p.y - y) for p in ring.points] == pytest.approx([radius] * 49)
        arrows = [m for m in message.markers if m.ns == "target"]
        assert [(m.points[0].x, m.points[0].y) for m in arrows] == [(3.0 * k, 0.0), (2.0 * k, 40.0)]
        jammers = [m for m in message.markers if m.ns == "jammer"]
        assert len(jammers) == (2 if k == 1 else 0)
        for m in jammers:
            assert place(m)[:2] == (10.0, 20.0)
        assert [m.text for m in jammers if m.text] == ["jammer 17 dBm"] * (k == 1)


def test_links_run_from_their_senders_in_the_colour_of_their_goodput(told: Told) -> None:
    """In frame 1 drones 0, 1 and 2 have said what their links carry; in frame 2 drone 2 is down."""
    latest = {0: [1.0, 2.0], 1: [11.0, 12.0], 2: [21.0, 22.0]}
    for frame, up in ((1, (0, 1, 2)), (2, (0, 1))):
        (_, message), pairs = told["/scene/links"][frame], [(i, j) for i in up for j in up if i != j]
        (lines,) = message.markers[1:]
        assert len(lines.points) == 2 * len(pairs)
        for k, (i, j) in enumerate(pairs):
            ends = [np.array([p.x, p.y]) for p in lines.points[2 * k : 2 * k + 2]]
            for end, drone in zip(ends, (i, j), strict=True):
                s = state(frame, drone)
                assert math.dist(end, (s["x_m"], s["y_m"])) == pytest.approx(0.9 * math.sqrt(2 / 3))  # they climb
            rgba = goodput_colours(np.array(latest[i][j - (j > i)]))
            for c in lines.colors[2 * k : 2 * k + 2]:
                assert (c.r, c.g, c.b, c.a) == pytest.approx(tuple(rgba / 255))


def test_the_town_and_its_cars_have_their_own_places_and_sizes(told: Told) -> None:
    scene = scene_of(exported())
    ((_, town),) = told["/scene/town"]
    built = [m for m in town.markers if m.ns == "buildings"]
    for m, (x, y, u, v, top, _) in zip(built, houses(scene).tolist(), strict=True):
        assert place(m) == pytest.approx(((x + u) / 2, (y + v) / 2, top / 2))
        assert (m.scale.x, m.scale.y, m.scale.z) == pytest.approx((u - x, v - y, top))
    for markers, cars in (
        ([m for m in town.markers if m.ns == "parked"], scene.parked_cars),
        ([m for m in told["/scene/cars"][1][1].markers if m.ns == "moving"], scene.moving_cars(1.0)),
    ):
        there = {tuple(np.round(place(m), 6)): m for m in markers}
        assert len(there) > 3
        known = 0
        for k in range(len(cars)):
            at = tuple(np.round((cars.x_m[k], cars.y_m[k], cars.height_m[k] / 2), 6))
            if at in there:
                m, known = there[at], known + 1
                assert (m.scale.x, m.scale.y, m.scale.z) == (cars.length_m[k], cars.width_m[k], cars.height_m[k])
                assert m.pose.orientation.z == pytest.approx(math.sin(cars.yaw_rad[k] / 2))
                assert colour(m)[:3] == pytest.approx(tuple(map(float, cars.colour[k])))
        assert known == len(there)


# --- telemetry --------------------------------------------------------------------------------------------


def test_telemetry_has_every_column_of_its_drone_s_row() -> None:
    made = list(Telemeter(exported().scenario).add(exported().tables))
    assert [drone for drone, _ in made] == [0, 1, 2] * 3
    for k, (drone, t) in enumerate(made):
        s, down = state(k // 3, drone), (drone, k // 3) == (2, 2)
        still = (0.0, 0.0, 0.0)
        assert t.time_s == k // 3
        assert t.position_m == where(k // 3, drone)
        assert t.orientation_xyzw == (s["qx"], s["qy"], s["qz"], s["qw"])
        assert t.velocity_mps == (still if down else (s["vx_mps"], s["vy_mps"], s["vz_mps"]))
        assert t.body_rates_radps == (still if down else (s["p_radps"], s["q_radps"], s["r_radps"]))
        assert (t.soc, t.voltage_v, t.current_a, t.energy_used_j) == tuple(s[name] for name in PACK)
        assert t.landed == down
        assert t.fixed == ((drone, k // 3) != (1, 1))
        assert t.home_m == (10.0 * drone, 10.0 * drone + 1, 0.0)
        assert t.cpu_load == pytest.approx(0.5 - drone / 10)
        assert not t.ground_station


def test_each_vehicle_says_its_own_pack_and_its_own_texts() -> None:
    made = parameters_of(exported().scenario)
    assert [p["SYSID_THISMAV"] for p in made] == [1.0, 2.0, 3.0]
    assert made[1]["BATT_CAPACITY"] == pytest.approx(1000 * 222 / (6 * MEAN_CELL_V))
    assert made[0]["BATT_CAPACITY"] == pytest.approx(1000 * 130 / (4 * MEAN_CELL_V))
    assert made[2]["BATT_CAPACITY"] == pytest.approx(1000 * 20 / (4 * MEAN_CELL_V))
    stream = Stream(exported().scenario, Origin(47.0, 8.0, 400.0))
    said: dict[tuple[float, int], list[str]] = {}
    for t_s, drone, m in stream.add(exported().tables):
        if m.get_type() == "STATUSTEXT":
            text = m.text.decode() if isinstance(m.text, bytes) else m.text
            said.setdefault((t_s, drone), []).append(text.rstrip("\0"))
    assert list(said) == [(0.2, 0), (0.5, 1), (1.0, 1), (1.5, 0), (1.5, 1)]
    assert said[0.2, 0] == ["fleet: a jammer"]
    assert "".join(said[1.0, 1]) == "drone 1: lost GNSS"


def test_a_jammer_is_on_from_its_begin_to_before_its_end() -> None:
    short = SimpleNamespace(at_s=1.0, until_s=2.0)
    long = SimpleNamespace(at_s=1.5, until_s=None)
    on_at = {0.99: [], 1.0: [short], 1.5: [short, long], 1.999: [short, long], 2.0: [long], 99.0: [long]}
    for t_s, on in on_at.items():
        assert jamming([short, long], t_s) == on  # type: ignore[list-item]
