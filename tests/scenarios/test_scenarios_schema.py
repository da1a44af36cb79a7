"""The schema of scenarios: what one section says against another, at both sides of each bound."""

from __future__ import annotations

import json
import math
from itertools import product
from typing import Any

import pytest

from sortie.scenarios.reading.load import ScenarioError, build, dump, loads
from sortie.scenarios.schema import Airframe, DescriptorForm, Scenario, Steering, Viewpoints, json_schema
from sortie.scenarios.schema.base import models_of_the_past


def scenario(text: str) -> Scenario:
    return loads(f"name: a\nduration_s: 9\n{text}")


MAKE = "fleet: {makes: [{name: m, drones: [1], %s}]}"
LEG = "groups: [{drones: [1], legs: [{to_m: [9, 9], altitude_m: 390}]}]"
OLD = "makes: [{name: old, drones: [1], battery: {life_cycles: 40}}]"
CYCLES = f"fleet: {{{OLD}, overrides: [{{drone: %s, cycles: %s}}]}}"
OFFSET = f"fleet: {{{LEG}, makes: [{{name: high, drones: [1], altitude_offset_m: %s}}]}}"
STATION = "fleet: {ground: [{drone: 1, mains: %s}]}\nevents: [{kind: %s, drone: 1, at_s: 1%s}]"
RESERVE = "fleet: {ground: [{drone: 1}]}\nmission: {groups: [{drones: [0, 1, 2], phases: [{}], reserve: [%s]}]}"
GROUP = "mission: {%s groups: [{drones: [1, 2], phases: [{}], reserve: [%s]}]}"
ON_GO = "policy: {changes: [{command: go, name: worked}], commands: [{at_s: %s, command: go, drones: [1, %s]}]}"
TARGETS = "mission: {target: {waypoints_m: [[1, 1]]}, %s groups: [{drones: [1], phases: [{target: 1}]}]}"
PHASES = "mission: {phases: [{at_s: 0}, {at_s: 2, phase: track}, {at_s: %s, phase: search}]}"
DETECTORS = "perception: {detector: %s}\nfleet: {makes: [{name: own, drones: [1], detector: %s, %s}]}"
WINDOW = "radio: {edca: {best_effort: {cw_min: 31, cw_max: %s}}}"
EXPECT = "expect: [{metric: policy, equals: %s, tolerance: 0.1}]"
DECIDED = "expect_decisions: [{drone: 0, from_s: 3, until_s: %s}]"
LAND = "fleet: {groups: [{drones: [1], legs: [%s]}]}"
LEFT_OUT = "must be left out where"
FAULT = STATION % ("%s", "battery_fault", ", lost_fraction: 0.5")
AGES = "context: {degraded_after_periods: %s, detached_after_periods: %s}"
CAMERA = DETECTORS % ("%s", "%s", "camera: {width_px: 320}")
FUSION = "perception: {detector: %s, fusion: 'own.py:F'}"
EVENT = "events: [{%s, at_s: 2, until_s: %s}]"
EVENTS = (
    "kind: gnss_loss",
    "kind: jam, position_m: [0, 0, 9]",
    *(f"kind: {k}, drone: 1" for k in ("link_drop", "spoof", "lie")),
)

BOUNDS: list[tuple[str, str, str | None]] = [
    # parameters that belong to no model
    ("fleet: {sensor_params: {a: 1}}", f"fleet.sensor_params: {{'a': 1}}, {LEFT_OUT} there is no sensor", None),
    ("radio: {link_params: {a: 1}}", f"radio.link_params: {{'a': 1}}, {LEFT_OUT} there is no link", None),
    ("radio: {path_loss: two_ray, path_loss_params: {a: 1}}", f"{LEFT_OUT} path_loss is two_ray", None),
    ("fleet: {airframe: {power_params: {a: 1}}}", f"{LEFT_OUT} power_model is level", None),
    (MAKE % "battery: {cell_params: {a: 1}}", f"fleet.makes.0.battery.cell_params: {{'a': 1}}, {LEFT_OUT}", None),
    ("fleet: {groups: [{drones: [1], mobility_params: {a: 1}}]}", f"{LEFT_OUT} mobility is formation", None),
    ("fleet: {mobility_params: {a: 1}}", LEFT_OUT, "fleet: {mobility: gauss_markov, mobility_params: {alpha: 0.5}}"),
    ("perception: {detector: none, detector_params: {a: 1}}", f"{LEFT_OUT} detector is none", None),
    ("perception: {fusion_params: {temperature: 2}}", f"{LEFT_OUT} fusion is disconet", None),
    (MAKE % "policy_params: {rho: 1}", "fleet.makes.0.policy_params", MAKE % "policy: worked, policy_params: {rho: 1}"),
    # drones, stations and groups
    (CYCLES % (1, 81), "fleet.overrides.0.cycles: 81, must be at most twice", CYCLES % (1, 80)),
    (CYCLES % (0, 601), "fleet.overrides.0.cycles: 601", CYCLES % (0, 600)),
    (OFFSET % 11, "fleet.makes.0.altitude_offset_m: 11", OFFSET % 10),
    ("fleet: {groups: [{drones: [1]}, {drones: [2, 1]}]}", "1, must be named once", None),
    ("fleet: {groups: [{drones: [1]}], ground: [{drone: 1}]}", "1, must be named once", None),
    ("fleet: {ground: [{drone: 1}, {drone: 1}]}", "1, must be named once", None),
    ("fleet: {groups: [{drones: [1, 1]}]}", "1, must be named once", "fleet: {groups: [{drones: [1]}, {drones: [2]}]}"),
    (STATION % ("true", "drone_leaves", ""), "events.0.drone: 1, must be a drone that flies", None),
    (STATION % ("false", "drone_leaves", ""), "events.0.drone: 1, must be a drone that flies", None),
    (FAULT % "true", "on mains power", FAULT % "false"),
    (GROUP % ("", "2, 1"), "mission.groups.0.reserve: [2, 1], must be some of the group's drones", GROUP % ("", "2")),
    (RESERVE % 2, "mission.groups.0.drones.1: 1", RESERVE % ""),
    (GROUP % ("", "2, 2"), "named once", None),
    (GROUP % ("", "3"), "one of the group's drones", None),
    (GROUP % ("handover_soc: 1,", ""), f"1, {LEFT_OUT} no group has a reserve", GROUP % ("handover_soc: 0.5,", "2")),
    # every drone that is named is one of the fleet, every instant within the flight
    ("events: [{kind: link_drop, drone: 0, peer: 5, at_s: 1}]", "events.0.peer: 5", None),
    ("expect_decisions: [{drone: 0, peer: 6, from_s: 1, until_s: 2}]", "expect_decisions.0.peer: 6", None),
    ("policy: {replays: [{at_s: 1, drone: 7, view: '{}'}]}", "policy.replays.0.drone: 7", None),
    (ON_GO % (1, 5), "policy.commands.0.drones.1: 5", ON_GO % (1, 4)),
    ("mission: {groups: [{drones: [0, 9], phases: [{}]}]}", "mission.groups.0.drones.1: 9", None),
    (TARGETS % "", "below 1, the number of targets", TARGETS % "more_targets: [{waypoints_m: [[2, 2]]}],"),
    ("policy: {replays: [{at_s: 9, drone: 1, view: '{}'}]}", "replays.0.at_s: 9, must be below duration_s", None),
    (ON_GO % (9, 4), "policy.commands.0.at_s: 9, must be below duration_s = 9", None),
    ("policy: {changes: [{at_s: 9, name: worked}]}", "policy.changes.0.at_s: 9, must be below duration_s = 9", None),
    ("events: [{kind: drone_lost, drone: 1, at_s: 9}]", "events.0.at_s: 9, must be below duration_s = 9", None),
    *((PHASES % at_s, ", must be above 2", PHASES % 2.001) for at_s in ("2", "2.0", "1.5")),
    # bounds may meet and may not cross
    (AGES % (3, 3), "context.detached_after_periods: 3", AGES % (3, 4)),
    (AGES % (4, 3), "context.detached_after_periods: 3", None),
    ("expect: [{metric: a, at_least: 0.5, at_most: 0.4}]", "0.4", "expect: [{metric: a, at_least: 0.5, at_most: 0.5}]"),
    (DECIDED % 2.9, "until_s: 2.9", DECIDED % 3),
    (WINDOW % 30, "must be at least cw_min = 31", WINDOW % 31),
    (EXPECT % "worked", f"expect.0.tolerance: 0.1, {LEFT_OUT} equals is 'worked'", EXPECT % 3),
    (EXPECT % "true", f"expect.0.tolerance: 0.1, {LEFT_OUT} equals is True", None),
    (LAND % "{action: land}, {to_m: [2, 2]}", "legs.0.action", LAND % "{to_m: [1, 1]}, {action: land}"),
    # detectors, networks and fusions
    (DETECTORS % ("surrogate", "none", "weights: w"), ".weights", DETECTORS % ("surrogate", "torch", "weights: w")),
    (CAMERA % ("torch", "surrogate"), ".camera.width_px: 320, must be 160", CAMERA % ("surrogate", "torch")),
    (
        "fleet: {makes: [{name: none, drones: [1], detector: torch}]}\nperception: {detector: surrogate}",
        "fleet.makes.0.feature_space: 'none', must be another name than that of drones without a network",
        None,
    ),
    (FUSION % "surrogate", "built in where detector is", FUSION % "torch"),
    (FUSION % "recorded, recording: a.npz", "built in where detector is", FUSION % "none"),
    ("policy: {shield: true, invariants: ' '}", "shield", "policy: {shield: true, invariants: 'rate_hz <= 5'}"),
    # presets and keys of long ago
    ("context: {form: papers}", "context.form: 'papers', must be paper, grid_8", "context: {form: paper}"),
    ("context: {form: 3}", "context.form: 3, must be a section", "context: {form: {grid_cells: 4}}"),
    ("fleet: {airframe: {mass: 3}}", "fleet.airframe.mass: unknown key, did you mean mass_kg?", None),
    ("context: {grid_cells: 8}", "context.grid_cells: unknown key, it belongs in context.form", None),
    ("fleet: {battery: {polarisation_mohm: 5}}", "unknown key, did you mean polarisation?", None),
    # events end after they begin
    *((EVENT % (e, 2), "events.0.until_s: 2, must be above at_s = 2", EVENT % (e, 2.001)) for e in EVENTS),
]
"""What is refused, in which words, and its neighbour that is accepted."""


def refusal(text: str) -> str:
    try:
        scenario(text)
    except ScenarioError as error:
        return str(error)
    return ""


def test_what_is_refused_is_named_and_its_neighbour_is_accepted() -> None:
    said = {wrong: refusal(wrong) for wrong, _, _ in BOUNDS}
    assert {wrong: said[wrong] for wrong, words, _ in BOUNDS if words not in said[wrong]} == {}
    assert {right: refusal(right) for _, _, right in BOUNDS if right is not None and refusal(right)} == {}


def test_what_flew_once_is_accepted_again() -> None:
    with models_of_the_past():
        assert scenario("radio: {link_params: {a: 1}}").radio.link_params == {"a": 1}


@pytest.mark.parametrize("field", ["duration_s", "context.rate_hz", "perception.sample_rate_hz", "events.0.rate_hz"])
def test_durations_and_rates_are_no_smaller_than_a_flight_can_count(field: str) -> None:
    text = "name: a\nevents: [{kind: spoof, at_s: 0, drone: 0, rate_hz: 1}]"
    with pytest.raises(ScenarioError, match=f"{field}: 0.00099, must be ≥ 0.001"):
        loads(text, overrides=[f"{field}=0.00099"])


# --- times ----------------------------------------------------------------------------------------


def test_frames_of_every_rate_stand_in_their_periods() -> None:
    for rate_hz, scored_hz, tracked_hz in product((10.0, 7.5, 1.0), (10.0, 3.0, 0.7), (10.0, 3.0, 1.0)):
        perception = {"detector": "none", "sample_rate_hz": scored_hz, "tracking_rate_hz": tracked_hz}
        s = build({"name": "a", "duration_s": 20, "context": {"rate_hz": rate_hz}, "perception": perception})
        assert (s.frames, s.frame_s) == (math.ceil(20 * rate_hz), 1 / rate_hz)
        periods = s.scoring_periods
        assert [f for p in periods for f in p] == list(range(s.frames))
        assert len(periods) == math.ceil(20 * min(rate_hz, scored_hz) - 1e-9)
        for k, (period, frame) in enumerate(zip(periods, s.scored_frames, strict=True)):
            turn = k * (math.sqrt(5) - 1) / 2 % 1.0
            assert frame == period.start + int(turn * len(period))
        each = max(1.0, rate_hz / tracked_hz)
        assert len(s.tracked_frames) == math.ceil(s.frames / each - 1e-9)
        for k, frame in enumerate(s.tracked_frames):
            first, last = math.ceil(k * each - 1e-9), math.ceil((k + 1) * each - 1e-9)
            inside = [f for f in s.scored_frames if first <= f < last]
            assert frame == (inside[0] if inside else first)


def test_a_frame_begins_at_every_multiple_of_its_length_before_the_end() -> None:
    """Though a product such as 4.1 · 10 is a digit above the whole number."""
    for rate_hz, frames in product((10.0, 3.0, 7.0), range(1, 140, 3)):
        sections = {"name": "a", "duration_s": frames / rate_hz, "context": {"rate_hz": rate_hz}}
        assert build({**sections, "perception": {"detector": "none"}}).frames == frames


def test_a_shortened_flight_keeps_what_begins_before_its_end() -> None:
    """Events, changes, commands and replays alike; what begins with the end, at 2 or 4 s, is after it."""
    at = [{"at_s": t} for t in (1.0, 2.0, 4.0)]
    changes = [{"name": "silence", **a} for a in at] + [{"name": "worked", "command": "go"}]
    commands, replays = [{"command": "go", **a} for a in at], [{"drone": 0, "view": "{}", **a} for a in at]
    policy = {"name": "worked", "changes": changes, "commands": commands, "replays": replays}
    events = [{"kind": "drone_lost", "drone": 0, **a} for a in at]
    whole: dict[str, Any] = {"name": "a", "duration_s": 9.0, "events": events, "policy": policy}
    for duration_s, left in ((4.0, 2), (2.0, 1), (2.1, 2), (1.9, 1), (10.0, 3)):
        short = build(whole, {"duration_s": duration_s})
        lists = (short.events, short.policy.changes, short.policy.commands, short.policy.replays)
        wanted = [1.0, 2.0, 4.0][:left]
        assert [[one.at_s for one in each] for each in lists] == [wanted, [*wanted, None], wanted, wanted]
    with pytest.raises(ScenarioError, match="must be below duration_s = 4"):
        build({**whole, "duration_s": 4.0})  # written so, it is a mistake


# --- what a drone's make gives it -----------------------------------------------------------------

OWN = {"weights": "own.w"}
MAKES: list[tuple[dict[str, Any], tuple[str, str | None, str | None], str | None]] = [
    ({}, ("torch", "fleet.w", "fleet.cb"), ""),
    ({"detector": "surrogate"}, ("surrogate", None, None), None),  # weights of another detector are not its own
    (OWN, ("torch", "own.w", None), "one"),  # the fleet's codes are of other features
    ({"detector": "torch"}, ("torch", "fleet.w", "fleet.cb"), ""),
    ({"weights": "fleet.w"}, ("torch", "fleet.w", "fleet.cb"), ""),  # named again, it is the same network
    ({"weights": "fleet.w", "feature_space": "own"}, ("torch", "fleet.w", "fleet.cb"), "own"),
    ({"detector": "torch", **OWN}, ("torch", "own.w", None), "one"),
    ({**OWN, "feature_space": "shared"}, ("torch", "own.w", None), "shared"),
    ({"detector": "surrogate", "feature_space": "other"}, ("surrogate", None, None), "other"),
    ({"codebook": "own.cb"}, ("torch", "fleet.w", "own.cb"), ""),
    ({**OWN, "codebook": "own.cb"}, ("torch", "own.w", "own.cb"), "one"),
]
"""A make, its drone's detector, weights and codebook, and the name of its feature space."""


def test_a_make_s_network_and_codebook_are_its_own_or_the_fleet_s() -> None:
    fleet_s = ("torch", "fleet.w", "fleet.cb")
    perception = {"detector": "torch", "weights": "fleet.w", "codebook": "fleet.cb"}
    for make, network, space in MAKES:
        fleet = {"drones": 3, "makes": [{"name": "one", "drones": [1], **make}]}
        made = build({"name": "a", "perception": perception, "fleet": fleet})
        assert [tuple(n) for n in made.networks] == [fleet_s, network, fleet_s], make
        assert made.feature_spaces[0] == made.feature_spaces[2] == ""
        assert space is None or made.feature_spaces[1] == space, make


def test_makes_stations_and_overrides_by_hand() -> None:
    blind = "{name: s, drones: [3], detector: none, compute_delay_s: 0}"
    makes = f"makes: [{{name: b, drones: [0, 1], altitude_offset_m: 20}}, {blind}]"
    stations = "ground: [{drone: 1, position_m: [0, 0, 7]}, {drone: 2, camera: true}]"
    made = scenario(f"fleet: {{drones: 4, {makes}, {stations}}}\nperception: {{compute_delay_s: 0.05}}")
    assert made.fleet.altitudes_m[:2] == (80.0, 7.0), "a station stands where it stands"
    assert made.fleet.in_formation == (0, 3)
    assert made.context_only == (False, True, False, True)
    assert made.feature_spaces == ("", "none", "", "none"), "so that policies send them no maps"
    assert made.compute_delays_s[0] == 0.05
    assert made.compute_delays_s[3] == 0.0, "a delay of zero is a delay"
    fleet = scenario(
        "fleet:\n  drones: 3\n  airframe: {mass_kg: 3.0, payload_kg: 0.5}\n"
        "  makes: [{name: small, drones: [1, 2], airframe: {mass_kg: 1.0, disc_area_m2: 0.2}}]\n"
        "  overrides: [{drone: 0, payload_kg: 0.1}, {drone: 1, payload_kg: 0.3}]"
    ).fleet
    found = [(a.mass_kg, a.disc_area_m2, a.payload_kg) for a in fleet.airframes]
    assert found == [(3.0, 0.503, 0.1), (1.0, 0.2, 0.3), (1.0, 0.2, 0.0)]


def test_targets_and_classes_are_counted_from_the_mission_s_own() -> None:
    two = scenario(TARGETS % "more_targets: [{waypoints_m: [[2, 2]]}],").mission.targets
    assert [target.waypoints_m[0][0] for target in two] == [1.0, 2.0]
    person = "perception: {people: [{waypoints_m: [[0, 0]]}]}"
    for text, classes in (
        (person, ("car",)),
        ("perception: {thermal: {}}", ("car", "person")),
        ("perception: {thermal: {}, scene: {trucks: 0.1}}", ("car", "truck", "person")),
    ):
        assert scenario(text).perception.classes == classes


def test_a_fence_holds_something_both_ways_and_a_band_of_heights_has_its_lowest_first() -> None:
    for section, fence in product(
        (Steering, Viewpoints), ((0, 0, 10, -1), (0, 0, -1, 10), (0, 0, 0, 10), (0, 5, 10, 5))
    ):
        with pytest.raises(ValueError, match="x_min < x_max and y_min < y_max"):
            section(fence_m=fence)
        assert section(fence_m=(0, 0, 10, 1))
    assert Steering(altitude_m=(30.0, 30.0))
    with pytest.raises(ValueError, match="the lowest first"):
        Steering(altitude_m=(30.1, 30.0))


# --- presets --------------------------------------------------------------------------------------


def test_a_preset_s_name_stands_for_its_values_and_single_ones_stay_settable() -> None:
    small = DescriptorForm(grid_cells=8, grid_bits=1, number_bits=16)
    made = scenario("context: {form: small}\nfleet: {airframe: solo}")
    assert (made.context.form, made.fleet.airframe.mass_kg) == (small, 1.88)
    assert loads(dump(made)) == made
    assert scenario("context: {form: paper}\nfleet: {airframe: zeng_2019}") == scenario(""), "the first is the default"
    overrides = ["context.form=small", "context.form.number_bits=12", "fleet.airframe.payload_kg=0.3"]
    changed = loads("name: a\n", overrides=overrides)
    assert changed.context.form == small.model_copy(update={"number_bits": 12})
    assert changed.fleet.airframe == Airframe(payload_kg=0.3)
    heavy = "{name: m, drones: [1], airframe: {mass_kg: 5}}"
    text = f"name: a\nfleet: {{makes: [{heavy}, {{name: k, drones: [2], airframe: solo}}]}}"
    _, make = loads(text, overrides=["fleet.makes.1.airframe.payload_kg=0.3"]).fleet.makes
    assert make.airframe == Airframe.model_validate({**Airframe.presets["solo"], "payload_kg": 0.3})


def test_every_preset_is_valid_differs_from_the_others_and_is_known_to_editors() -> None:
    for section in (Airframe, DescriptorForm):
        made = [section.model_validate(name).model_dump_json() for name in section.presets]
        assert len(set(made)) == len(made)
    schema = json_schema()
    form = schema["$defs"]["Context"]["properties"]["form"]
    assert form["anyOf"] == [{"enum": list(DescriptorForm.presets)}, {"$ref": "#/$defs/DescriptorForm"}]
    assert json.dumps(schema)
