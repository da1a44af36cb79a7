"""The plots of a playback, of a record of a few rows: every point worked out by hand, also second by second."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from record_by_hand import record, rows, tables_of
from sim_examples import example

from sortie.scenarios.schema import Scenario
from sortie.sim.playback.charts import Charts
from sortie.sim.playback.event_lane import NOTHING, lane_changes, spans_of
from sortie.sim.results.regions import Regions
from sortie.sim.results.sightings import sightings

NAN = math.nan
Series = dict[str, list[tuple[float, float]]]


class Kept:
    """A canvas that keeps the points of plot lines, and the states of lanes."""

    def __init__(self) -> None:
        self.points: Series = {}
        self.states: dict[str, list[tuple[float, str]]] = {}

    def static(self, path: str, *shown: Any) -> None: ...

    def columns(self, path: str, t_s: Any, columns: Any) -> None:
        if path.startswith("lanes/"):
            texts = [text for column in columns for (text,) in column.as_arrow_array().to_pylist()]
            self.states.setdefault(path, []).extend(zip(np.asarray(t_s, float).tolist(), texts, strict=True))

    def scalars(self, path: str, t_s: Any, values: Any) -> None:
        pairs = zip(np.asarray(t_s, float).tolist(), np.asarray(values, float).tolist(), strict=True)
        self.points.setdefault(path, []).extend((round(t, 9), v if v != v else round(v, 9)) for t, v in pairs)


def scenario(drones: int) -> Scenario:
    made = record().scenario
    return made.model_copy(update={"fleet": made.fleet.model_copy(update={"drones": drones})})


def charted(given: dict[str, list[dict[str, Any]]], drones: int = 2, seconds: tuple[float, ...] = (4.0,)) -> Kept:
    """What is drawn of these tables, which come up to each of these seconds."""
    flown = replace(record(), tables=tables_of(rows() | given))
    kept, of = Kept(), scenario(drones)
    charts = Charts(kept, of)  # type: ignore[arg-type]
    charts.begin()
    before = -1.0
    for known_s in seconds:
        new: dict[str, pa.Table] = {}
        for name, table in flown.tables.items():
            stamp = {"transmissions": "t_done_s"}.get(name, "t_s")
            if stamp not in table.column_names:
                continue
            t_s = table[stamp].to_numpy()
            now = (t_s > before) & (t_s <= known_s)  # also what is stamped at this very instant, as in a sortie
            new[name] = table.filter(pa.array(now | (np.isnan(t_s) & (known_s == 4.0))))
        regions = Regions(flown.tables["mission"], flown.scenario.mission)
        charts.add(known_s, new, sightings({k: new[k] for k in ("fusions", "detections", "truths")}, regions))
        before = known_s
    return kept


def drawn(given: dict[str, list[dict[str, Any]]], drones: int = 2, seconds: tuple[float, ...] = (4.0,)) -> Series:
    """What is plotted of these tables."""
    points = charted(given, drones, seconds).points
    return {path: found for path, found in points.items() if found and "marks" not in path}


def traffic(sent: list[dict[str, Any]], seconds: tuple[float, ...]) -> Series:
    ends = {"drone": 0, "peer": 1}
    made = drawn({"transmissions": [ends | each for each in sent]}, seconds=seconds)
    return {path.removeprefix("plots/traffic/"): v for path, v in made.items() if "traffic" in path}


@pytest.fixture(params=[(4.0,), (1.0, 2.0, 3.0, 4.0)], ids=["at once", "by seconds"])
def seconds(request: pytest.FixtureRequest) -> tuple[float, ...]:
    found: tuple[float, ...] = request.param
    return found


def test_batteries_are_in_percent_and_each_drone_s_own(seconds: tuple[float, ...]) -> None:
    made = drawn({}, seconds=seconds)
    assert made["plots/battery/0"] == [(0, 90), (1, 89), (2, 88), (3, 87)]
    assert made["plots/battery/1"] == [(0, 80), (1, 79), (2, 78), (3, 77)]


def test_goodput_is_the_mean_of_the_links_that_were_tried_lately(seconds: tuple[float, ...]) -> None:
    """A probed link reads 2^-9 Mb/s at most, and is left out. A silent one reads 2^-10, and carries nothing."""
    first = [(0.2, 0, [10.0, 30.0]), (0.7, 0, [40.0, 0.0]), (1.2, 0, [60.0, 2.0**-9]), (1.7, 0, [60.0, 2.0**-10])]
    second = [(1.5, 1, [0.0, 2.0**-9]), (2.5, 1, [5.0, 7.0])]
    said = [{"t_s": t_s, "drone": d, "goodput_mbps": links} for t_s, d, links in sorted(first + second)]
    made = drawn({"descriptors": said, "states": []}, drones=3, seconds=seconds)
    assert made["plots/goodput/0"] == [(0.2, 20.0), (0.7, 40.0), (1.2, 60.0), (1.7, pytest.approx(30.0, abs=1e-3))]
    (first_s, gap), later = made["plots/goodput/1"]
    assert (first_s, math.isnan(gap), later) == (1.5, True, (2.5, 6.0))
    assert "plots/goodput/2" not in made


def test_traffic_is_of_the_second_in_which_it_ended(seconds: tuple[float, ...]) -> None:
    """Mb/s: of 125,000 B in one second, 1. A line begins with the first second in which it carries anything."""
    names = ("t_done_s", "representation", "status", "payload_bytes")
    sent = [
        (0.5, "features", "delivered", 125_000),
        (1.0, "features", "delivered", 500_000),
        (1.5, "features", "lost", 375_000),
        (2.5, "detections", "expired", 12_500),
        (NAN, "features", "in_flight", 999_999),
    ]
    assert traffic([dict(zip(names, each, strict=True)) for each in sent], seconds) == {
        "features_delivered": [(1, 1.0), (2, 4.0), (3, 0.0), (4, 0.0)],
        "features_lost": [(2, 3.0), (3, 0.0), (4, 0.0)],
        "detections_expired": [(3, 0.1), (4, 0.0)],
    }


def test_a_payload_that_came_in_part_is_what_arrived_and_what_was_lost_or_expired(seconds: tuple[float, ...]) -> None:
    names = ("t_done_s", "status", "reason", "payload_bytes", "arrived_bytes")
    sent = [
        (0.5, "delivered", "", 125_000, 125_000),
        (0.6, "partial", "deadline_in_service", 500_000, 375_000),
        (1.5, "partial", "fragment_lost", 375_000, 125_000),
    ]
    of_features = [{"representation": "features", **dict(zip(names, each, strict=True))} for each in sent]
    assert traffic(of_features, seconds) == {
        "features_delivered": [(1, 4.0), (2, 1.0), (3, 0.0), (4, 0.0)],
        "features_expired": [(1, 1.0), (2, 0.0), (3, 0.0), (4, 0.0)],
        "features_lost": [(2, 2.0), (3, 0.0), (4, 0.0)],
    }


def test_ages_losses_and_the_channel_are_of_their_second(seconds: tuple[float, ...]) -> None:
    ages = [
        {"t_s": t_s, "drone": 0, "age_s": age_s} for t_s, age_s in ((0.0, 0.1), (0.99, 0.3), (1.0, 0.5), (3.5, 0.7))
    ]
    busy = [{"t_s": float(k), "busy_fraction": 0.125 * k} for k in range(4)]
    made = drawn({"ages": ages, "medium": busy}, seconds=seconds)
    assert made["plots/age/p99_ms"] == [(1, 298.0), (2, 500.0), (4, 700.0)]
    assert made["plots/medium/busy_percent"] == [(0, 0.0), (1, 12.5), (2, 25.0), (3, 37.5)]
    # of the rows of the record: 1 of 4 lost, 2 of 4, 1 of 2, 1 of 1
    assert made["plots/lost/percent"] == [(1, 25.0), (2, 50.0), (3, 50.0), (4, 100.0)]


def test_accuracy_is_of_the_scene_and_of_the_disc(seconds: tuple[float, ...]) -> None:
    """By 1 s one of two cars is found. In the disc, from 2 s on: by 3 s one of two, by 4 s two of three."""
    made = drawn({}, seconds=seconds)
    assert [t_s for t_s, _ in made["plots/ap/full_scene"]] == [1, 2, 3, 4]
    assert made["plots/ap/full_scene"][0][1] == 0.5
    assert made["plots/ap/full_scene"][3][1] == pytest.approx(2.5 / 6)
    assert made["plots/ap/mission"] == [(3, 0.5), (4, pytest.approx(2 / 3))]


def decided(t_s: float, drone: int, peer: int, what: str, **more: float) -> dict[str, Any]:
    ends = {"t_s": t_s, "drone": drone, "peer": peer, "representation": what}
    return ends | {"rate_hz": 2.0, "roi_radius_m": NAN, "reason": ""} | more


def test_a_drone_s_lane_shows_nothing_each_time_that_it_is_down(seconds: tuple[float, ...]) -> None:
    """It joins at 0.5 s, and is lost twice. While it is down the first time, only its peer decides."""
    up = {0.0: False, 0.5: True, 1.0: True, 1.5: False, 2.0: True, 2.5: True, 3.0: False, 3.5: False}
    states = [{"t_s": t_s, "drone": d, "airborne": d == 0 or flies} for t_s, flies in up.items() for d in range(2)]
    said = [(0.6, 1, "detections"), (1.6, 0, "detections"), (2.1, 1, "raw"), (2.6, 1, "tracks"), (3.6, 0, "tracks")]
    directives = [decided(t_s, d, 1 - d, what) for t_s, d, what in said]
    lanes = charted({"states": states, "directives": directives}, seconds=seconds).states
    assert lanes["lanes/drone_1"] == [
        (0.6, "detections at 2 Hz"),
        (1.5, "nothing"),
        (2.0, "detections at 2 Hz"),
        (2.1, "raw at 2 Hz"),
        (2.6, "tracks at 2 Hz"),
        (3.0, "nothing"),
        (4.0, NOTHING),
    ]
    assert lanes["lanes/drone_0"] == [(1.6, "detections at 2 Hz"), (3.6, "tracks at 2 Hz"), (4.0, NOTHING)]


def test_of_links_on_one_rung_a_lane_shows_the_one_that_sends_most() -> None:
    """ρ times rate is 0.5 /s to drone 1; to drone 2 it is first 1 /s, and then 0.02 /s."""
    said = [(0.5, 1, 0.25, 2.0), (1.5, 2, 0.1, 10.0), (2.5, 2, 0.002, 10.0)]
    directives = [decided(t_s, 0, peer, "features", rho=rho, rate_hz=rate_hz) for t_s, peer, rho, rate_hz in said]
    states = [{"t_s": 0.0, "drone": d, "airborne": True} for d in range(3)]
    lanes = charted({"states": states, "directives": directives}, drones=3).states
    first, second, third = (
        (t_s, f"features ρ={of}") for t_s, of in ((0.5, "0.25 at 2 Hz"), (1.5, "0.1 at 10 Hz"), (2.5, "0.25 at 2 Hz"))
    )
    assert lanes["lanes/drone_0"] == [first, second, third, (4.0, NOTHING)]


def test_an_event_s_bar_ends_with_the_event() -> None:
    """A jam lasts as the scenario says, a lost link to the end, a landing for two seconds; the last to begin is shown."""
    scenario = example(
        "duration_s=20",
        "events=[{kind: jam, at_s: 2, until_s: 9, position_m: [0, 0, 60], power_dbm: 0}, {kind: link_drop, at_s: 12, drone: 1, loss_db: 9}]",
    )
    times = [(2.0, "jam", "on"), (4.0, "landed", "down"), (9.0, "jam_over", "off"), (12.0, "link_drop", "weak")]
    spans = spans_of([{"t_s": t_s, "drone": -1, "kind": kind, "text": text} for t_s, kind, text in times], scenario)
    bars = [(2, "on"), (4, "down"), (6, "on"), (9, "off"), (11, NOTHING), (12, "weak")]
    whole = [(t_s, text if text == NOTHING else f"fleet: {text}") for t_s, text in bars]
    assert lane_changes(spans, NOTHING, 0.0, 20.0) == whole
    by_parts, shown = [], NOTHING
    for from_s in range(20):
        for change in lane_changes(spans, shown, float(from_s), from_s + 1.0):
            by_parts.append(change)
            shown = change[1]
    assert by_parts == whole


def test_each_drone_has_its_accuracy_and_its_energy(seconds: tuple[float, ...]) -> None:
    """Together the drones' fusions are those of the plot of the whole fleet."""
    made = drawn({}, seconds=seconds)
    assert made["plots/ap_of/0"][0] == (1, 0.5)
    assert {path for path in made if path.startswith("plots/energy/")} == {"plots/energy/0", "plots/energy/1"}
