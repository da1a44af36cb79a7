"""What is printed and drawn of one sortie, every figure in its own place.

The outcome has another number in each place, so that a figure that is printed under another's name is found. Figures
over time are those of the record of a few rows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from record_by_hand import record, rows, tables_of, told_outcome
from rich.table import Table

from sortie.scenarios.schema import Fleet
from sortie.sim.results import report, report_figures, summary
from sortie.sim.results.record import SortieRecord


def cells(table: Table) -> list[list[str]]:
    """Its rows as they are printed."""
    return [list(row) for row in zip(*(map(str, column.cells) for column in table.columns), strict=True)]


def test_the_summary_has_every_figure_under_its_own_name() -> None:
    made = told_outcome()
    assert str(summary.outcome_table(made).title) == "by_hand · worked · seed 1"
    assert dict(cells(summary.outcome_table(made))) == {
        "flown": "91.1 % of drone-seconds",
        "AP@0.5": "0.401 full scene, 0.502 mission (scored at 2 Hz, 17 fusions; the surrogate abc, no network)",
        "  grounded drones blind": "0.303 full scene, 0.204 mission",
        "  AP of trucks": "0.601 full scene, 0.602 mission",
        "  AP of people": "0.701 full scene, – mission",
        "  search 0–2 s": "0.500 full, – mission, 0.0 Mb/s, 2.0 kB a payload, 33.3 % missed",
        "  track 2–4 s": "0.500 full, 0.667 mission, 0.0 Mb/s, 3.0 kB a payload, 100.0 % missed",
        "people": "31.5 % of those in a drone's region located, 21.6 % by the drone's own camera",
        "mission": "81.2 % of the region in view; target in view 71.3 % of the time, longest gap 1.2 s; "
        "target detected 61.4 % of the time, longest gap 2.8 s",
        "context plane": "1.1 kB (4.8 % of all bytes), age 0.141 s median, 0.452 s p99",
        "descriptors lost": "11.1 % of receptions (5.0 % collisions with payloads, 3.0 % collisions with descriptors, "
        "2.0 % own transmissions, 1.0 % hidden senders)",
        "data plane": "22.0 kB sent: 14.0 kB delivered, 5.0 kB lost, 2.6 kB expired, 400 B in flight",
        "deadlines": "12.2 % missed; medium busy 13.3 %",
        "energy": "11.6 kJ (rotor 8.1, radio 1.2, compute 2.3)",
        "charge left": "0: 91.0 %  1: 62.0 % down  2: 73.0 %",
        "descriptors refused": "2 replay, 1 bad_tag",
        "switches": "3.25 a link-minute",
        "decision": "21 µs median, 83 µs p99",
        "wall time": "1.60 s, 2.5 × real time",
        "disagreement": "4.4 % of link-time, 3.3 % about whether to send; 12 episodes, mean 0.25 s, p99 0.75 s, "
        "longest 1.5 s; by cause: age 60.0 %, descriptor 30.0 %, trust 10.0 %",
        "own files": "own.py f00d",
        "fingerprint": "0123456789abcdef",
    }


def test_rows_without_anything_to_say_are_left_out_and_custom_metrics_are_added() -> None:
    own = told_outcome() | {"metrics": {"first_s": 1.25, "none": None}}
    shown = dict(cells(summary.outcome_table(own)))
    assert (shown["metrics.first_s"], shown["metrics.none"]) == ("1.25", "–")
    tiles = [("metrics.first_s", "1.25", "a metric of your own"), ("metrics.none", "–", "a metric of your own")]
    assert report._tiles(own)[-2:] == tiles
    made = told_outcome() | {"descriptor_drops": {}, "own_files": {}}
    nothing = dict.fromkeys(("region_observed_share", "target_detected_share", "target_in_view_share"))
    made["mission"] |= {"flown_share": 1.0, **nothing}
    made["people"]["located_share"] = made["disagreement"]["share"] = None
    made["ap50"]["detector"] = "none"
    left = "context plane, descriptors lost, data plane, deadlines, energy, charge left, switches, decision, wall time"
    assert [name for name, _ in cells(summary.outcome_table(made))] == [*left.split(", "), "fingerprint"]


def test_a_large_fleet_and_a_slow_flight_are_shown_as_such() -> None:
    made = told_outcome() | {"wall_s": 73.0, "realtime_factor": 0.0274}
    drone = made["drones"]["0"]
    made["drones"] = {str(i): drone | {"soc": 0.5 + i / 100, "airborne": i != 3} for i in range(25)}
    made["drones"]["7"] |= {"soc": 0.2}
    shown = dict(cells(summary.outcome_table(made)))
    assert shown["charge left"] == "lowest 20.0 % (drone 7), median 62.0 %; 1 of 25 drones down"
    assert shown["wall time"] == "73.00 s, 0.027 × real time"


LOST_TO = (
    "5.0 % collisions with payloads, 3.0 % collisions with descriptors, 2.0 % own transmissions, 1.0 % hidden senders"
)


def test_the_page_s_tiles_are_the_outcome_s() -> None:
    made = told_outcome()
    assert report._tiles(made) == [
        ("Flown", "91.1 %", "of drone-seconds"),
        ("Accuracy, mission disc", "0.502", "0.204 with grounded drones blind"),
        ("Accuracy, full scene", "0.401", "0.303 with grounded drones blind"),
        ("Accuracy, trucks", "0.601", "full scene, AP@0.5"),
        ("Accuracy, people", "0.701", "full scene, by distance"),
        ("People located", "31.5 %", "in drones' regions, 21.6 % by own cameras"),
        ("Region in view", "81.2 %", "of its area, mean over time"),
        ("Target in view", "71.3 %", "of the time, longest gap 1.2 s"),
        ("Target detected", "61.4 %", "of the time, longest gap 2.8 s"),
        ("Data delivered", "14.0 kB", "of 22.0 kB sent"),
        ("Deadlines missed", "12.2 %", "channel busy 13.3 %"),
        ("Context plane", "1.1 kB", "4.8 % of all bytes"),
        ("Descriptors lost", "11.1 %", LOST_TO),
        ("Energy", "11.6 kJ", "least charge left 62.0 %"),
    ]
    made["mission"]["flown_share"] = 1.0
    for calibration, by in (("abc", "the surrogate abc"), (None, "the surrogate detector")):
        made["ap50"]["calibration"] = calibration
        assert report._tiles(made)[:2] == [
            ("Accuracy, mission disc", "0.502", f"AP@0.5, {by}"),
            ("Accuracy, full scene", "0.401", "17 fusions scored"),
        ]


def test_the_page_s_tables_of_phases_and_drones_are_the_outcome_s() -> None:
    made = told_outcome()
    for k, phase in enumerate(made["phases"]):
        phase |= {"data_rate_mbps": 7.5 + k, "ap50": {"full_scene": 0.2 + k / 10, "mission": 0.6 + k / 10}}
    fleet = Fleet.model_validate({"drones": 3, "ground": [{"drone": 2}]})
    read = [list(row) for table in report._numbers(made, fleet) for row in table.rows]
    assert read == [
        ["search, 0–2 s", "0.200", "0.600", "7.5 Mb/s", "33.3 %", "37.5 %"],
        ["track, 2–4 s", "0.300", "0.700", "8.5 Mb/s", "100.0 %", "66.7 %"],
        ["drone 0", "91.0 %", "4.4 kJ", "15.25 V", "0.410", "0.620", "flying"],
        ["drone 1", "62.0 %", "7.2 kJ", "14.50 V", "0.430", "–", "down"],
        ["station 2", "mains", "", "", "–", "–", "on"],
    ]
    on_battery = Fleet.model_validate({"drones": 3, "ground": [{"drone": 1, "mains": False}]})
    station = ["station 1", "62.0 %", "7.2 kJ", "14.50 V", "0.430", "–", "off"]
    assert station in report._numbers(made, on_battery)[1].rows


# --- figures over time ----------------------------------------------------------------------------------------------


def test_the_matrix_of_links_is_the_table_s_a_row_later() -> None:
    """A row of the table tells of the time before it: what is heard in the first second stands at 1 s."""
    told = [(0.0, 0, 1, math.nan), (1.0, 0, 1, 0.5), (2.0, 0, 1, 0.25), (2.0, 1, 0, 1.0)]
    columns = dict(zip(("t_s", "sender", "receiver", "delivered"), map(list, zip(*told, strict=True)), strict=True))
    axes = Figure().add_subplot()
    flown = record()
    report_figures._links(axes, replace(flown, tables={**flown.tables, "links": pa.table(columns)}))
    (mesh,) = axes.collections
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0 → 1", "1 → 0"]
    assert mesh.get_array().filled(-1.0).tolist() == [[0.5, 0.25, -1.0], [-1.0, 1.0, -1.0]]


def curves(draw: Any, flown: SortieRecord) -> dict[str, list[tuple[float, float]]]:
    """The curves of a figure by their labels, without gaps."""
    axes: Axes = Figure().add_subplot()
    draw(axes, flown)
    return {
        str(line.get_label()): [
            (round(float(x), 9), round(float(y), 9))
            for x, y in zip(*line.get_data(), strict=True)
            if not math.isnan(float(y))
        ]
        for line in axes.get_lines()
    }


def with_rows(**given: list[dict[str, Any]]) -> SortieRecord:
    return replace(record(), tables=tables_of(rows() | given))


def test_batteries_are_drawn_in_percent_drone_by_drone() -> None:
    drawn = curves(report_figures._battery, record())
    assert drawn == {
        "drone 0": [(0, 90), (1, 89), (2, 88), (3, 87)],
        "drone 1": [(0, 80), (1, 79), (2, 78), (3, 77)],
    }


def test_goodput_is_the_mean_over_links_that_were_measured_and_over_each_second() -> None:
    """Drone 1 never measured anything in the third second, and drone 0 was silent in the fourth."""
    three = record().scenario.model_copy(update={"fleet": record().scenario.fleet.model_copy(update={"drones": 3})})
    published = {
        0: {0.2: [10.0, 30.0], 0.7: [40.0, 0.0], 1.0: [2.0, 4.0], 2.6: [8.0, 8.0]},
        1: {0.9: [5.0, 7.0], 2.5: [0.0, 0.0], 3.999: [9.0, 0.0]},
    }
    said = sorted((t_s, d, links) for d, each in published.items() for t_s, links in each.items())
    descriptors = [{"t_s": t_s, "drone": d, "goodput_mbps": links} for t_s, d, links in said]
    flown = replace(with_rows(descriptors=descriptors), scenario=three)
    assert curves(report_figures._goodput, flown) == {
        "drone 0": [(1, 30.0), (2, 3.0), (3, 8.0)],
        "drone 1": [(1, 6.0), (4, 9.0)],
        "drone 2": [],
    }


def test_traffic_is_drawn_in_the_second_in_which_it_ended_by_kind_and_fate() -> None:
    """Mb/s: of 125,000 B in one second, 1. The payload that came in part is what arrived and what was lost."""
    ended = [  # when, what, fate, bytes, and how many of them arrived
        (0.5, "features", "delivered", 125_000, 125_000),
        (0.9, "features", "lost", 250_000, 0),
        (1.0, "features", "delivered", 500_000, 500_000),
        (1.5, "features", "partial", 375_000, 250_000),
        (2.5, "detections", "delivered", 12_500, 12_500),
        (math.nan, "features", "in_flight", 999_999, 0),
    ]
    names = ("t_done_s", "representation", "status", "payload_bytes", "arrived_bytes")
    sent = [dict(zip(names, row, strict=True), drone=0, peer=1) for row in ended]
    for row in sent:
        row["reason"] = "fragment_lost" if row["status"] in ("lost", "partial") else ""
    flown = with_rows(transmissions=sent)
    assert curves(report_figures._traffic, flown) == {
        "features delivered": [(1, 1.0), (2, 6.0), (3, 0.0), (4, 0.0)],
        "features lost": [(1, 2.0), (2, 1.0), (3, 0.0), (4, 0.0)],
        "detections delivered": [(1, 0.0), (2, 0.0), (3, 0.1), (4, 0.0)],
    }
    assert report_figures.delivered_mbps(flown) == pytest.approx(np.array([(1, 1.0), (2, 6.0), (3, 0.1), (4, 0.0)]))
    assert report_figures.arrived(flown) == [(0, 0.0, 2.0, "features"), (0, 2.0, 3.0, "detections")]


def test_the_age_of_a_second_is_that_of_its_rows() -> None:
    ages = [
        {"t_s": t_s, "drone": 0, "age_s": age_s} for t_s, age_s in ((0.0, 0.1), (0.99, 0.3), (1.0, 0.5), (3.5, 0.7))
    ]
    (drawn,) = curves(report_figures._age, with_rows(ages=ages)).values()
    assert drawn == [(1, 298.0), (2, 500.0), (4, 700.0)]


def test_accuracy_is_drawn_of_the_whole_scene_and_of_the_disc() -> None:
    """By 1 s the fusion at 0.5 s alone: of two cars one is found, before a false box. By 3 s also those at 2.5 s."""
    drawn = curves(report_figures._accuracy, record())
    assert drawn["full scene"][0] == (1.0, pytest.approx(0.5))
    assert [t_s for t_s, _ in drawn["full scene"]] == [1, 2, 3, 4]
    assert drawn["full scene"][3][1] == pytest.approx(2.5 / 6)
    assert drawn["mission disc"] == [(3.0, 0.5), (4.0, round(2 / 3, 9))]


def test_the_map_shows_each_drone_s_own_way_and_where_it_ended() -> None:
    drawn: dict[str, list[tuple[float, float]]] = {}
    axes: Axes = Figure().add_subplot()
    states = [
        r | {"x_m": 100.0 * r["drone"] + r["t_s"], "y_m": -10.0 * r["drone"] - r["t_s"]} for r in rows()["states"]
    ]
    report_figures._map(axes, with_rows(states=states))
    ends = []
    for line in axes.get_lines():
        way = list(zip(*np.array(line.get_data()).tolist(), strict=True))
        if str(line.get_label()).startswith("drone"):
            drawn[str(line.get_label())] = way
        elif line.get_marker() == "o" and len(way) == 1:
            ends.append((way[0], line.get_color()))
    assert drawn == {f"drone {d}": [(100.0 * d + k, -10.0 * d - k) for k in range(4)] for d in (0, 1)}
    assert ends == [((100.0 * d + 3, -10.0 * d - 3), report_figures.colour(d)) for d in (0, 1)]


def test_a_lane_shows_the_richest_of_a_drone_s_links_until_it_is_down() -> None:
    """Drone 1 sends boxes to drone 0 from 0.5 s and features to nobody; it is down from 3 s on."""
    usual = {"rho": 0.1, "roi_radius_m": math.nan, "rate_hz": 10.0}
    ordered = [
        {"t_s": t_s, "drone": drone, "peer": 1 - drone, "representation": what, **usual}
        for t_s, drone, what in ((0.5, 1, "detections"), (1.5, 0, "features"), (2.5, 0, "nothing"))
    ]
    axes: Axes = Figure().add_subplot()
    report_figures._lanes(axes, with_rows(directives=ordered, transmissions=[]))
    bars = []
    for bar in axes.collections:
        box = bar.get_datalim(bar.axes.transData)  # type: ignore[union-attr]
        bars.append((round((box.y0 + box.y1) / 2), round(box.x0, 6), round(box.x1, 6)))
    assert sorted(bars) == [(0, 0.0, 1.5), (0, 1.5, 2.5), (0, 2.5, 4.0), (1, 0.0, 0.5), (1, 0.5, 3.0), (1, 3.0, 4.0)]
