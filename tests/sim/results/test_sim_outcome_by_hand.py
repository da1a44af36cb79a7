"""The outcome of a record of a few rows, every figure worked out by hand.

The rows stand in `record_by_hand`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from record_by_hand import CAR, SCENARIO, record, rows, tables_of

from sortie.scenarios.reading.load import loads
from sortie.sim.results.accuracy import Pool
from sortie.sim.results.accuracy_table import accuracy_table, windowed_ap
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.regions import Regions


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return outcome(record())


def test_bytes_go_to_their_fates_and_a_cut_payload_to_two(result: dict[str, Any]) -> None:
    """10,600 B in all; of the 2,000 B that were cut short 1,200 B came, and 800 B missed their deadline."""
    assert result["bytes"] == {
        "context_sent": 808,
        "context_descriptors": 700,
        "context_directives": 108,
        "data_sent": 10_600,
        "handshakes_sent": 100,
        "data_delivered": 2300,
        "data_lost": 3000,
        "data_expired": 1300,
        "data_in_flight": 4000,
    }
    assert result["context_share"] == pytest.approx(808 / 11_408)
    assert result["data_rate_mbps"] == pytest.approx(10_600 * 8e-6 / 4)
    assert result["deadline_miss_rate"] == pytest.approx(2 / 4)  # what is in flight has no fate yet
    fates = ("delivered", "expired/deadline_queued", "in_flight", "lost/fragment_lost", "partial/deadline_in_service")
    assert result["payload_fates"] == dict.fromkeys(fates, 1), "the handshake is no payload"


def test_percentiles_lie_between_the_values(result: dict[str, Any]) -> None:
    """Of 0.1, 0.2, 0.3 and 0.4 the median lies half-way between the middle two, p99 at 2.97 of 3 steps."""
    assert result["age_s"] == pytest.approx({"p50": 0.5, "p99": 0.794})
    assert result["data_age_s"] == pytest.approx({"p50": 0.25, "p99": 0.397})
    assert result["data_age_mean_s"] == pytest.approx(0.25)


def test_each_drone_s_accuracy_is_of_its_own_fusions() -> None:
    """At 2.5 s drone 0 has two of four cars, with a false alarm between them; the disc is there from 2 s on."""
    made = accuracy_table(record()).to_pandas()
    counts = made.drop(columns=["ap50", "mission_ap50"])
    assert counts.to_numpy().tolist() == [
        [0.5, 0, 2, 1, 1, 0, 0, 0],
        [2.5, 0, 2, 1, 0, 1, 1, 0],
        [2.5, 1, 1, 0, 0, 1, 0, 0],
        [3.5, 0, 1, 1, 0, 1, 1, 0],
    ]
    assert made.ap50.tolist() == pytest.approx([0.5, 1 / 4 + 1 / 6, 0.0, 0.5])
    assert made.mission_ap50.tolist() == pytest.approx([np.nan, 1.0, 0.0, 1.0], nan_ok=True)


def test_accuracy_is_of_the_five_seconds_up_to_each_moment() -> None:
    """At 0 s one of one is found, at 4 s none of one, at 5 s and 7 s one of one; 5 s after a fusion it is out of the window."""
    hits = np.array([True, True, True])
    found = Pool(
        np.array([0.0, 4.0, 5.0, 7.0]),
        np.zeros(4, np.int32),
        np.array([0, 1, 1, 2, 3]),
        np.ones(3),
        hits,
        np.ones(4, int),
    )
    assert windowed_ap(found).tolist() == pytest.approx([1.0, 1 / 2, 1 / 2, 2 / 3])


def test_energy_is_added_up_by_cause_by_drone_and_in_all(result: dict[str, Any]) -> None:
    assert result["energy_j"] == {"rotor": 150.0, "radio": 5.0, "fault": 20.0, "total": 175.0}
    assert {d: v["energy_j"] for d, v in result["drones"].items()} == {"0": 105.0, "1": 70.0}
    first = {"soc": pytest.approx(0.87), "voltage_v": 13.0, "airborne": True, "energy_j": 105.0}
    first |= {"ap50": {"full_scene": 0.5, "mission": 1.0}}
    assert result["drones"]["0"] == first
    assert result["drones"]["1"]["airborne"] is False
    assert result["battery"] == pytest.approx({"0": 0.87, "1": 0.77})


def test_average_precision_of_four_fusions(result: dict[str, Any]) -> None:
    """Six cars; by score: hit, miss, hit, hit. Precision 1, then 3/4 from the second hit on: (1 + 3/4 + 3/4) / 6.

    In the disc, from 2 s on: three cars, two hits and nothing false. The drone that is gone misses one more car.
    """
    ap = result["ap50"]
    assert (ap["full_scene"], ap["mission"]) == pytest.approx((2.5 / 6, 2 / 3))
    assert ap["grounded_blind"] == pytest.approx({"full_scene": 2.5 / 7, "mission": 2 / 4})
    assert ap["scored_fusions"] == 4


def test_phases_take_what_was_captured_in_them(result: dict[str, Any]) -> None:
    search, track = result["phases"]
    assert (search["phase"], search["begin_s"], search["end_s"]) == ("search", 0.0, 2.0)
    assert (track["phase"], track["begin_s"], track["end_s"]) == ("track", 2.0, 4.0)
    assert search["ap50"] == {"full_scene": pytest.approx(0.5), "mission": None}
    assert track["ap50"] == pytest.approx({"full_scene": 0.5, "mission": 2 / 3})
    assert search["data_rate_mbps"] == pytest.approx(4500 * 8e-6 / 2)
    assert track["data_rate_mbps"] == pytest.approx(6100 * 8e-6 / 2)
    assert (search["deadline_miss_rate"], track["deadline_miss_rate"]) == pytest.approx((1 / 3, 1.0))
    assert (search["feature_payload_bytes"], track["feature_payload_bytes"]) == (2000.0, 3000.0)
    assert (search["context"]["lost"], track["context"]["lost"]) == pytest.approx((3 / 8, 2 / 3))


def test_receptions_are_shares_of_all_that_could_have_heard(result: dict[str, Any]) -> None:
    assert result["context"]["lost"] == pytest.approx(5 / 11)
    lost = {"collision_context": 1, "collision_data": 0, "hidden": 1, "weak_signal": 2, "half_duplex": 1}
    assert result["context"]["lost_to"] == pytest.approx({cause: n / 11 for cause, n in lost.items()})


def test_a_disc_that_moves_is_no_switch(result: dict[str, Any]) -> None:
    """Two changes on two links in a fifteenth of a minute."""
    assert result["switches"] == pytest.approx(2 / (2 * 4 / 60))
    features, boxes = "features ρ=0.25 at 10 Hz in 10 m", "detections at 2 Hz in 10 m"
    assert result["transitions"] == [
        {"t_s": 0.5, "drone": 0, "from": "nothing", "to": features, "reason": "a", "peers": [1]},
        {"t_s": 2.5, "drone": 0, "from": features, "to": boxes, "reason": "c", "peers": [1]},
    ]


def test_the_mission_is_observed_while_somebody_flies_over_it_and_looks(result: dict[str, Any]) -> None:
    """Seven of eight drone seconds are flown. The region is in view for one of its two seconds. There is no target."""
    mission = result["mission"]
    assert mission["flown_share"] == pytest.approx(7 / 8)
    assert mission["region_observed_share"] == pytest.approx(1 / 2)
    assert mission["target_in_view_share"] is None
    assert mission["target_detected_share"] is None


def test_a_target_is_detected_where_it_is_at_the_fusion() -> None:
    """It drives 10 m/s, and fusions come half a second after their frames: its place in the frame is 5 m behind."""
    target = "mission: {target: {waypoints_m: [[0, 0], [100, 0]], speed_mps: 10}, phases: [{at_s: 0, phase: track}]}\n"
    perception = "perception: {detector: surrogate, sample_rate_hz: 1, fusion_delay_s: 0.5}\n"
    scenario = loads(SCENARIO.split("mission:")[0] + target + perception)
    for places_m, found in (((5.0, 15.0, 25.0, 35.0), 4), ((0.0, 10.0, 20.0, 30.0), 0), ((5.0, 16.0, 55.0), 2)):
        given = rows()
        tracked = {"phase": "track", "target": 0, "target_y_m": 0.0}
        given["mission"] = [{**r, **tracked, "target_x_m": 10.0 * r["t_s"]} for r in given["mission"]]
        given["detections"] = [
            {"t_s": k + 0.5, "drone": k % 2, "x_m": x_m, "y_m": 0.0, **CAR, "yaw_rad": 0.0, "score": 0.5}
            for k, x_m in enumerate(places_m)
        ]
        mission = outcome(record(scenario=scenario, tables=tables_of(given)))["mission"]
        assert mission["target_detected_share"] == pytest.approx(found / 4)
        assert mission["target_longest_undetected_s"] == pytest.approx(4 - found)


@pytest.mark.parametrize("last_s", [1.0, 0.5])
@pytest.mark.parametrize("x_m", [2.0, 60.0])
def test_a_person_in_the_region_is_known_from_the_decision_of_a_frame_on(x_m: float, last_s: float) -> None:
    """The region is there in the last two frames, and drone 1 flies in the first of them: three drone seconds, less
    where the sortie ends within the last frame.

    Drone 0 knows of somebody from 2.3 s to 3.2 s: from its decision in the first of these frames until that in the
    second. A drone that is gone counts nowhere, though it knew of somebody when it left. With the person 60 m off, what
    was known was wrong.
    """
    given = rows()
    given["people"] = [{"t_s": float(k), "person": 0, "x_m": x_m, "y_m": 0.0} for k in range(4)]
    given["alerts"] = [
        {"t_s": t_s, "drone": drone, "known": known}
        for t_s, drone, known in ((2.3, 0, True), (2.9, 1, True), (3.2, 0, False))
    ]
    scenario = SCENARIO.replace("sample_rate_hz: 1}", f"sample_rate_hz: 1, people: [{{waypoints_m: [[{x_m}, 0]]}}]}}")
    scenario = scenario.replace("duration_s: 4", f"duration_s: {3 + last_s}")
    people = outcome(record(scenario=loads(scenario), tables=tables_of(given)))["people"]
    is_there = x_m < 10
    assert people["in_region_drone_s"] == (2.0 + last_s if is_there else 0.0)
    assert people["unknown_share"] == (pytest.approx(last_s / (2 + last_s)) if is_there else None)
    assert people["unknown_longest_s"] == (last_s if is_there else None)
    assert people["false_alert_share"] == (None if is_there else pytest.approx(2 / (2 + last_s)))


def met(*drones: str, more: Sequence[tuple[str, dict[str, Any]]] = ()) -> SortieRecord:
    """A record of one car at rest, with a letter for each drone and second.

    x: the car and a box of it. m: the car, and no box. f: a box, and no car. -: neither, at a fusion all the same.
    g: the car about a drone that is gone and does not fuse. A blank: nothing at all.

    Args:
        more: further rows of tables, of other classes.
    """
    given: dict[str, list[dict[str, Any]]] = {"fusions": [], "truths": [], "detections": []}
    for k in range(max(map(len, drones))):
        for drone, letters in enumerate(drones):
            what, row = letters[k : k + 1] or " ", {"t_s": k + 0.5, "drone": drone, "x_m": 0.0, "y_m": 0.0, **CAR}
            given["fusions"] += [row] * (what in "xmf-")
            given["truths"] += [{**row, "car": 0}] * (what in "xmg")
            given["detections"] += [{**row, "score": 0.9}] * (what in "xf")
    scenario = loads(f"name: met\nduration_s: 60\nfleet: {{drones: {len(drones)}}}\nperception: {{sample_rate_hz: 1}}")
    tables = tables_of(given)
    for name in ("truths", "detections"):
        both = sorted([*given[name], *(row for of, row in more if of == name)], key=lambda r: (r["t_s"], r["drone"]))
        tables[name] = pa.table(
            {f.name: pa.array([r[f.name] for r in both], f.type) for f in tables[name].schema}
            | {"kind": pa.array([r.get("kind", 0) for r in both], pa.int8())}
        )
    return record(scenario=scenario, tables=tables)


TRACKED: list[tuple[list[str], int, int, int]] = [
    # it is confirmed with the third box, and is a detection from then on
    (["xxxxx"], 3, 2, 0),
    # it coasts without a box, and is no detection then, whether the car is there or not
    (["xxxmxx"], 3, 3, 0),
    (["xxx-xx"], 3, 2, 0),
    (["xxxmm"], 1, 4, 0),
    # three boxes in four seconds are enough, in five they are not, and then it begins anew
    (["xmxx"], 1, 3, 0),
    (["xmxmxxx"], 1, 6, 0),
    # boxes of no car are wrong once there are three of them
    (["xxxff"], 1, 2, 2),
    (["ff---xx"], 0, 2, 0),
    # a drone without a fusion has not looked, and one that is gone misses nothing
    (["xxxxxxx", "x x x x"], 7, 4, 0),
    (["xxxx", "xxxg"], 3, 4, 0),
]
"""Letters of each drone, and how many cars are found, missed, and found where there is none."""


def test_a_track_is_a_detection_when_it_is_confirmed_and_has_a_box() -> None:
    """Boxes lie exactly on the car, so DetA is the share of right detections in all cars and detections."""
    wrong = {}
    for drones, right, missed, false in TRACKED:
        found, share = outcome(met(*drones))["tracking"], pytest.approx(right / (right + missed + false))
        parts = ("det_a", "ass_a", "hota") if len(drones) == 1 else ("det_a",)  # one track and one car: all are equal
        if any(found[part] != share for part in parts):
            wrong[" | ".join(drones)] = found
    assert wrong == {}


def test_tracks_of_two_drones_are_two_and_so_are_their_cars() -> None:
    """Five of seven and two of four: AssA is the mean over all seven."""
    found = outcome(met("xxxxxxx", "x x x x"))["tracking"]
    ass_a = (5 * 5 / 7 + 2 * 2 / 4) / 7
    assert found == pytest.approx({"det_a": 7 / 11, "ass_a": ass_a, "hota": (7 / 11 * ass_a) ** 0.5})


def test_people_have_no_part_in_tracking() -> None:
    """Neither one who is there and is found, nor one who stands where the car is."""
    row = {"drone": 0, "y_m": 0.0, "length_m": 4.0, "width_m": 2.0, "yaw_rad": 0.0, "car": 1, "score": 0.9, "kind": 2}
    more = [
        (of, {**row, "t_s": k + 0.5, "x_m": x_m})
        for of in ("truths", "detections")
        for k in range(5)
        for x_m in (0.3, 40.0)
    ]
    found = outcome(met("xxxmx", more=more))["tracking"]
    assert found == pytest.approx({"det_a": 2 / 5, "ass_a": 2 / 5, "hota": 2 / 5})


def test_people_are_located_by_boxes_of_people_in_the_region_of_a_drone_that_flies() -> None:
    """Drone 1 is a ground station: what it knows of people does not count.

    Of three people in drone 0's region two have a box within 2 m after sharing; its own camera found the third alone.
    """
    scenario = SCENARIO.replace("fleet: {drones: 2}", "fleet: {drones: 2, ground: [{drone: 1}]}")
    scenario = scenario.replace("sample_rate_hz: 1}", "sample_rate_hz: 1, people: [{waypoints_m: [[2, 0]]}]}")
    given = rows()
    given["people"] = [{"t_s": float(k), "person": 0, "x_m": 2.0, "y_m": 0.0} for k in range(4)]
    given["alerts"] = [{"t_s": 2.1, "drone": 1, "known": True}]
    sighted = ((2.0, 0, -6.0, 1.0), (2.0, 1, 2.0, 0.0), (1.0, 0, 2.0, 0.0), (3.0, 0, 2.0, 0.0))
    given["sightings"] = [{"t_s": t_s, "drone": d, "x_m": x_m, "y_m": y_m} for t_s, d, x_m, y_m in sighted]
    tables = tables_of(given)
    # time, drone, place and class: outside the region, a car, of a drone that is gone, and before the region
    there = [(2.5, 0, 2.0, 2), (2.5, 0, 9.0, 2), (2.5, 0, -6.0, 2), (2.5, 0, 30.0, 2), (2.5, 0, 5.5, 0)]
    there += [(2.5, 1, 2.0, 2), (3.5, 1, 2.0, 2), (0.5, 0, 2.0, 2)]
    found = [(2.5, 0, 2.0, 2), (2.5, 0, 7.1, 2), (2.5, 0, -8.1, 2), (2.5, 0, -6.0, 0), (2.5, 1, 50.0, 2)]
    for name, each in (("truths", there), ("detections", found)):
        part = [
            {"t_s": t_s, "drone": d, "x_m": x_m, "y_m": 0.0, **CAR, "car": k, "score": 0.5, "kind": kind}
            for k, (t_s, d, x_m, kind) in enumerate(sorted(each))
        ]
        schema = {f.name: f.type for f in tables[name].schema} | {"kind": pa.int8()}
        tables[name] = pa.table({c: pa.array([r[c] for r in part], t) for c, t in schema.items()})
    people = outcome(record(scenario=loads(scenario), tables=tables))["people"]
    assert (people["located_share"], people["located_alone_share"]) == pytest.approx((2 / 3, 1 / 3))
    assert people["in_region_drone_s"] == 2.0
    assert people["unknown_share"] == 1.0


def test_counts_and_ratios(result: dict[str, Any]) -> None:
    assert result["distrusted_by"] == {"1": 1}
    assert result["descriptor_drops"] == {"replay": 2, "bad_tag": 1}
    assert result["policies"]["decisions"] == {"worked": 8}
    assert result["realtime_factor"] == pytest.approx(2.0)
    assert result["medium_busy_fraction"] == 0.125


def test_people_and_trucks_are_no_cars_in_any_average_precision_of_cars(result: dict[str, Any]) -> None:
    """Also not among what a drone that is gone would have had to find."""
    full = record()
    tables = dict(full.tables)
    for name in ("truths", "detections"):
        table = tables[name].append_column("kind", pa.array([0] * tables[name].num_rows, pa.int8()))
        more = []
        for t_s, drone in ((2.5, 0), (3.5, 1)) if name == "truths" else ((2.5, 0),):
            for kind, x_m in ((1, 1.0), (2, 4.0)):
                row = {"t_s": t_s, "drone": drone, "x_m": x_m, "y_m": 0.0, **CAR, "kind": kind, "car": 9, "score": 0.95}
                more.append({c: row[c] for c in table.column_names})
        both = [*table.to_pylist(), *more]
        both.sort(key=lambda r: (r["t_s"], r["drone"]))
        tables[name] = pa.table({f.name: pa.array([r[f.name] for r in both], f.type) for f in table.schema})
    assert outcome(replace(full, tables=tables))["ap50"] == result["ap50"]


def test_a_disc_holds_from_the_instant_of_its_row() -> None:
    """In a frame that is scored at its begin, the frame's own disc counts."""
    full = record()
    at = Regions(full.tables["mission"], full.scenario.mission).at([1.0, 1.999, 2.0, 2.5, 9.0], [0, 1, 0, 1, 0])
    assert np.isnan(at[:2]).all()
    assert at[2:].tolist() == [[0.0, 0.0, 10.0]] * 3


def test_nothing_has_no_ratios() -> None:
    """Of a record without traffic and fusions every ratio is null, and every amount 0."""
    full = record()
    names = ("transmissions", "receptions", "ages", "fusions", "truths", "detections")
    result = outcome(replace(full, tables={**full.tables, **{name: full.tables[name].slice(0, 0) for name in names}}))
    assert result["bytes"]["data_sent"] == 0
    assert result["data_rate_mbps"] == 0.0
    for name in ("deadline_miss_rate", "data_age_mean_s"):
        assert result[name] is None
    assert result["context"]["lost"] is None
    assert result["age_s"] == result["data_age_s"] == {"p50": None, "p99": None}
    assert (result["ap50"]["full_scene"], result["ap50"]["mission"]) == (None, None)
