"""What one section of a scenario says against another, and what goes from one figure into the next.

1. Bounds between sections: whose battery, whose detector, whose network, which stations, groups and phases.
2. Bounds that hold also at their ends: equal bounds, windows of an instant, one height.
3. What a campaign's sections ask of each other.
4. Plans of several quantities, differences with ends, and rounding beside an end.
5. Arrays on disk, streams of bytes, and columns that must be whole.
6. Models from outside: their names, their errors, their limits.
"""

from __future__ import annotations

import math
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import stdtrit

from sortie.scenarios import scratch
from sortie.scenarios.control_variates import Controlled, controlled_mean, plan_units, widened
from sortie.scenarios.intervals import AMOUNT, SHARE, Estimate, Range, mean_interval, paired
from sortie.scenarios.plugins import reference
from sortie.scenarios.plugins.reference import Guard, PluginError, checked_array, code_files, resolve
from sortie.scenarios.plugins.user_calls import Guarded
from sortie.scenarios.plugins.user_code import imported_packages, load
from sortie.scenarios.reading.load import ScenarioError, loads
from sortie.scenarios.schema import Expectation, Mission, Perception, PolicySection, Scenario, Steering, Viewpoints
from sortie.scenarios.schema.base import models_of_the_past
from sortie.scenarios.schema.campaign import Campaign
from sortie.scenarios.schema.movement import FlightGroup
from sortie.scenarios.shipped import located
from sortie.scenarios.traces import TraceError, check_increasing, read_columns


def scenario(text: str) -> Scenario:
    return loads(f"name: joints\nduration_s: 9\n{text}")


def refused(text: str, where: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(where)):
        scenario(text)


def campaign(**changes: Any) -> Campaign:
    return Campaign.model_validate({"campaign": "c", "base": "b", "metrics": ["wall_s"], **changes})


# --- sections against each other -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fleet: {sensor_params: {a: 1}}", "fleet.sensor_params: {'a': 1}, must be left out where there is no sensor"),
        ("radio: {link_params: {a: 1}}", "radio.link_params: {'a': 1}, must be left out where there is no link"),
        (
            "radio: {path_loss: two_ray, path_loss_params: {a: 1}}",
            "radio.path_loss_params: {'a': 1}, must be left out where path_loss is two_ray",
        ),
        (
            "fleet: {airframe: {power_params: {a: 1}}}",
            "fleet.airframe.power_params: {'a': 1}, must be left out where power_model is level",
        ),
        (
            "fleet: {makes: [{name: m, drones: [1], battery: {cell_params: {a: 1}}}]}",
            "fleet.makes.0.battery.cell_params: {'a': 1}, must be left out where cell_model is lipo",
        ),
        (
            "fleet: {groups: [{drones: [1], mobility_params: {a: 1}}]}",
            "fleet.groups.0.mobility_params: {'a': 1}, must be left out where mobility is formation",
        ),
        (
            "perception: {detector: none, detector_params: {a: 1}}",
            "perception.detector_params: {'a': 1}, must be left out where detector is none",
        ),
        (
            "perception: {fusion_params: {temperature: 2}}",
            "perception.fusion_params: {'temperature': 2}, must be left out where fusion is disconet",
        ),
    ],
)
def test_parameters_that_belong_to_no_model_are_refused(text: str, said: str) -> None:
    refused(text, said)


def test_parameters_of_built_in_models_that_take_some_and_of_what_flew_once_are_accepted() -> None:
    assert scenario("fleet: {mobility: gauss_markov, mobility_params: {alpha: 0.5}}").fleet.mobility_params
    with models_of_the_past():
        assert scenario("radio: {link_params: {a: 1}}").radio.link_params == {"a": 1}


def test_the_cycles_of_a_drone_are_held_against_the_life_of_its_own_make() -> None:
    make = "makes: [{name: old, drones: [1], battery: {life_cycles: 40}}, {name: new, drones: [2], battery: {life_cycles: 900}}]"
    assert scenario(
        f"fleet: {{{make}, overrides: [{{drone: 1, cycles: 80}}, {{drone: 2, cycles: 1800}}, {{drone: 0, cycles: 600}}]}}"
    )
    refused(
        f"fleet: {{{make}, overrides: [{{drone: 1, cycles: 81}}]}}",
        "fleet.overrides.0.cycles: 81, must be at most twice",
    )
    refused(f"fleet: {{{make}, overrides: [{{drone: 0, cycles: 601}}]}}", "fleet.overrides.0.cycles: 601")


def test_a_make_s_height_holds_on_every_leg_of_its_group() -> None:
    group = "groups: [{drones: [1], legs: [{to_m: [9, 9], altitude_m: 390}]}]"
    make = "makes: [{name: high, drones: [1], altitude_offset_m: %d}]"
    assert scenario(f"fleet: {{{group}, {make % 10}}}")
    refused(f"fleet: {{{group}, {make % 11}}}", "fleet.makes.0.altitude_offset_m: 11")


def test_a_station_s_antenna_stands_where_it_is_written_whatever_its_make() -> None:
    fleet = scenario(
        "fleet: {drones: 3, ground: [{drone: 1, position_m: [0, 0, 7]}], makes: [{name: high, drones: [0, 1], altitude_offset_m: 20}]}"
    ).fleet
    assert fleet.altitudes_m == (80.0, 7.0, 60.0)
    assert fleet.in_formation == (0, 2)


def test_a_drone_flies_in_one_group_or_stands_on_one_station() -> None:
    for apart in (
        "groups: [{drones: [1]}, {drones: [2, 1]}]", "groups: [{drones: [1]}], ground: [{drone: 1}]",
        "ground: [{drone: 1}, {drone: 1}]", "groups: [{drones: [1, 1]}]",
    ):  # fmt: skip
        refused(f"fleet: {{{apart}}}", "1, must be named once")


def test_parameters_of_a_make_s_policy_need_the_policy() -> None:
    make = "fleet: {makes: [{name: own, drones: [1], %s policy_params: {rho: 0.1}}]}"
    assert scenario(make % "policy: worked,")
    refused(make % "", "fleet.makes.0.policy_params")


def test_who_is_sent_home_or_fails_is_no_station_on_the_mains() -> None:
    station = "fleet: {ground: [{drone: 1, mains: %s}]}\nevents: [{kind: %s, drone: 1, at_s: 1%s}]"
    fault = ", lost_fraction: 0.5"
    for mains in ("true", "false"):
        refused(station % (mains, "drone_leaves", ""), "events.0.drone: 1, must be a drone that flies")
    refused(station % ("true", "battery_fault", fault), "on mains power")
    assert scenario(station % ("false", "battery_fault", fault))
    reserve = "fleet: {ground: [{drone: 1}]}\nmission: {groups: [{drones: [0, 1, 2], phases: [{}], reserve: [%s]}]}"
    refused(reserve % "2", "mission.groups.0.drones.1: 1")
    assert scenario(reserve % "")


def test_every_drone_that_is_named_is_one_of_the_fleet() -> None:
    for text, where in (
        ("events: [{kind: link_drop, drone: 0, peer: 5, at_s: 1}]", "events.0.peer: 5"),
        ("expect_decisions: [{drone: 0, peer: 6, from_s: 1, until_s: 2}]", "expect_decisions.0.peer: 6"),
        ("policy: {replays: [{at_s: 1, drone: 7, view: '{}'}]}", "policy.replays.0.drone: 7"),
        ("policy: {changes: [{command: go, name: worked}], commands: [{at_s: 1, command: go, drones: [1, 5]}]}", "policy.commands.0.drones.1: 5"),
        ("mission: {groups: [{drones: [0, 9], phases: [{}]}]}", "mission.groups.0.drones.1: 9"),
    ):  # fmt: skip
        refused(text, where)


def test_what_is_done_at_an_instant_has_its_instant() -> None:
    for text, where in (
        ("policy: {replays: [{at_s: 9, drone: 1, view: '{}'}]}", "policy.replays.0.at_s: 9"),
        ("policy: {changes: [{command: go, name: worked}], commands: [{at_s: 9, command: go}]}", "policy.commands.0.at_s: 9"),
        ("policy: {changes: [{at_s: 9, name: worked}]}", "policy.changes.0.at_s: 9"),
        ("events: [{kind: drone_lost, drone: 1, at_s: 9}]", "events.0.at_s: 9"),
    ):  # fmt: skip
        refused(text, f"{where}, must be below duration_s = 9")


@pytest.mark.parametrize(("degraded", "detached", "is_fine"), [(3, 4, True), (3, 3, False), (4, 3, False)])
def test_a_peer_is_detached_after_it_is_degraded(degraded: int, detached: int, is_fine: bool) -> None:
    text = f"context: {{degraded_after_periods: {degraded}, detached_after_periods: {detached}}}"
    if is_fine:
        assert scenario(text)
    else:
        refused(text, "context.detached_after_periods: 3")


def test_weights_are_of_a_make_s_own_detector() -> None:
    make = "perception: {detector: surrogate}\nfleet: {makes: [{name: own, drones: [1], detector: %s, weights: w.safetensors}]}"
    assert scenario(make % "torch").networks[1][:2] == ("torch", "w.safetensors")
    refused(make % "none", "fleet.makes.0.weights")
    other = scenario(
        "perception: {detector: surrogate, weights: a.safetensors}\nfleet: {makes: [{name: own, drones: [1], detector: torch}]}"
    )
    assert other.networks[0][:2] == ("surrogate", "a.safetensors")
    assert other.networks[1][:2] == ("torch", None)  # the fleet's weights are another detector's
    assert other.feature_spaces[:2] == ("", "own")


def test_pictures_have_the_surrogate_s_width_where_the_surrogate_reads_them() -> None:
    make = (
        "perception: {detector: %s}\nfleet: {makes: [{name: own, drones: [1], detector: %s, camera: {width_px: 320}}]}"
    )
    assert scenario(make % ("surrogate", "torch"))
    refused(make % ("torch", "surrogate"), "fleet.makes.0.camera.width_px: 320, must be 160")


def test_a_station_without_cameras_sends_context_alone_and_one_with_cameras_looks() -> None:
    made = scenario(
        "fleet: {drones: 4, ground: [{drone: 1}, {drone: 2, camera: true}], makes: [{name: blind, drones: [3], detector: none}]}"
    )
    assert made.context_only == (False, True, False, True)
    assert made.feature_spaces == ("", "none", "", "none"), "so that policies send them no maps"
    make = "fleet: {makes: [{name: %s, drones: [1], detector: torch}]}\nperception: {detector: surrogate}"
    bound = "must be another name than that of drones without a network"
    refused(make % "none", f"fleet.makes.0.feature_space: 'none', {bound}")


def test_a_codebook_is_no_part_of_a_feature_space() -> None:
    """Drones with one network and two codebooks fuse each other's features."""
    made = scenario("fleet: {makes: [{name: own, drones: [1], codebook: c.safetensors}]}")
    assert made.feature_spaces == ("",) * 5
    assert [n.codebook for n in made.networks[:2]] == [None, "c.safetensors"]


def test_targets_are_numbered_from_the_mission_s_own() -> None:
    first, second = {"waypoints_m": [(1.0, 1.0)]}, {"waypoints_m": [(2.0, 2.0)]}
    mission = Mission.model_validate({"target": first, "more_targets": [second]})
    assert [t.waypoints_m[0][0] for t in mission.targets] == [1.0, 2.0]
    group = {"drones": [1], "phases": [{"target": 1}]}
    assert Mission.model_validate({"target": first, "more_targets": [second], "groups": [group]})
    with pytest.raises(ValueError, match="below 1, the number of targets"):
        Mission.model_validate({"target": first, "groups": [group]})


def test_reserves_take_over_once_and_phases_follow_each_other() -> None:
    of = {"drones": [1, 2], "phases": [{}]}
    with pytest.raises(ValueError, match="named once"):
        Mission.model_validate({"groups": [of | {"reserve": [2, 2]}]})
    with pytest.raises(ValueError, match="one of the group's drones"):
        Mission.model_validate({"groups": [of | {"reserve": [3]}]})
    with pytest.raises(ValueError, match="above 2, when the phase before begins"):
        Mission.model_validate({"phases": [{}, {"at_s": 2}, {"at_s": 2}]})


def test_classes_are_of_trucks_that_drive_and_people_that_a_camera_finds() -> None:
    person = {"waypoints_m": [(0.0, 0.0)]}
    assert Perception.model_validate({"people": [person]}).classes == ("car",)
    assert Perception.model_validate({"thermal": {}}).classes == ("car", "person")
    assert Perception.model_validate({"thermal": {}, "scene": {"trucks": 0.1}}).classes == ("car", "truck", "person")


def test_a_fusion_of_one_s_own_flies_with_the_network_or_with_none() -> None:
    own = {"fusion": "own.py:Fusion"}
    for detector, more in (("torch", {}), ("none", {})):
        assert Perception.model_validate({"detector": detector, **own, **more})
    for detector, more in (("surrogate", {}), ("recorded", {"recording": "a.npz"})):
        with pytest.raises(ValueError, match="built in where detector is"):
            Perception.model_validate({"detector": detector, **own, **more})


def test_a_shield_needs_an_invariant_that_says_something() -> None:
    with pytest.raises(ValueError, match="given where there is a shield"):
        PolicySection.model_validate({"shield": True, "invariants": " \n"})
    assert PolicySection.model_validate({"shield": True, "invariants": "rate_hz <= 5"})


# --- ends ------------------------------------------------------------------------------------------------


def test_bounds_may_meet_and_may_not_cross() -> None:
    assert Expectation(metric="a", at_least=0.5, at_most=0.5)
    with pytest.raises(ValueError, match=r"at_most = 0\.4"):
        Expectation(metric="a", at_least=0.5, at_most=0.4)
    assert scenario("expect_decisions: [{drone: 0, from_s: 3, until_s: 3}]")
    refused("expect_decisions: [{drone: 0, from_s: 3, until_s: 2.9}]", "until_s: 2.9")
    assert Steering(altitude_m=(30.0, 30.0))
    with pytest.raises(ValueError, match="the lowest first"):
        Steering(altitude_m=(30.1, 30.0))


@pytest.mark.parametrize("fence", [(0, 0, 10, -1), (0, 0, -1, 10), (0, 0, 0, 10), (0, 5, 10, 5)])
def test_a_fence_holds_something_both_ways(fence: tuple[float, float, float, float]) -> None:
    for section in (Steering, Viewpoints):
        with pytest.raises(ValueError, match="x_min < x_max and y_min < y_max"):
            section(fence_m=fence)
        assert section(fence_m=(0, 0, 10, 1))


@pytest.mark.parametrize("at", [0, 1])
def test_nothing_is_flown_after_a_landing(at: int) -> None:
    legs: list[dict[str, Any]] = [{"to_m": (1.0, 1.0)}, {"to_m": (2.0, 2.0)}, {"action": "land"}]
    assert FlightGroup.model_validate({"drones": [0], "legs": legs})
    legs[at] = {"action": "land"}
    with pytest.raises(ValueError, match=rf"legs\.{at}\.action"):
        FlightGroup.model_validate({"drones": [0], "legs": legs})


# --- campaigns -------------------------------------------------------------------------------------------


def test_designs_of_powers_of_two_have_such_a_count() -> None:
    vary = {"fleet.battery.initial_soc": {"kind": "uniform", "low": 0.5, "high": 1.0}}
    for method, count, is_fine in (
        ("sobol", 6, False), ("sobol", 8, True), ("saltelli", 6, False), ("saltelli", 8, True), ("random", 6, True), ("morris", 6, True),
    ):  # fmt: skip
        of = {"vary": vary, "sample": {"method": method, "count": count}}
        if is_fine:
            assert campaign(**of)
        else:
            with pytest.raises(ValueError, match="a power of two"):
                campaign(**of)


def test_a_design_for_sensitivity_draws_every_field() -> None:
    drawn, grid = {"kind": "uniform", "low": 0.5, "high": 1.0}, {"kind": "grid", "values": [1, 2]}
    with pytest.raises(ValueError, match="every field of vary drawn"):
        campaign(vary={"a.b": drawn, "a.c": grid}, sample={"method": "morris", "count": 4})


def test_a_difference_needs_two_policies() -> None:
    stop = {"metric": "wall_s", "half_width": 1.0, "difference": True}
    with pytest.raises(ValueError, match="false where there is one policy"):
        campaign(stop_when=stop)
    assert campaign(stop_when=stop, policies=["worked", "silence"])


@pytest.mark.parametrize(
    "name", ["seed", "policy.name", "policy.changes.0.at_s", "policy.commands", "policy", "policy.params"]
)
def test_what_the_plan_writes_itself_is_not_varied(name: str) -> None:
    with pytest.raises(ValueError, match=re.escape(name)):
        campaign(vary={name: {"kind": "grid", "values": [1, 2]}})


def test_names_that_begin_like_those_may_be_varied() -> None:
    for name in ("policy.names", "seeds", "policy.params.rho"):
        assert campaign(vary={name: {"kind": "grid", "values": [1, 2]}})


def test_weights_of_a_choice_are_none_below_nothing_and_one_above() -> None:
    for weights, is_fine in (([0.0, 1.0], True), ([0.0, 0.0], False), ([2.0, -1.0], False)):
        spread = {"kind": "choice", "values": [1, 2], "weights": weights}
        if is_fine:
            assert campaign(vary={"a.b": spread})
        else:
            with pytest.raises(ValueError, match="at least 0, and one above it"):
                campaign(vary={"a.b": spread})
    with pytest.raises(ValueError, match="below high"):
        campaign(vary={"a.b": {"kind": "normal", "mean": 0.0, "sd": 1.0, "low": -1.0, "high": -2.0}})


# --- figures ---------------------------------------------------------------------------------------------


def quantity(variance: float, explained: float) -> Controlled:
    return Controlled(Estimate(0.0, -1.0, 1.0, 30), 0.5, 0.9, explained, variance)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_quantity_that_needs_most_decides_a_plan(order: tuple[int, int]) -> None:
    """With and without a cheap measurement, before and after units were measured, whichever stands first."""
    of = (quantity(1.0, 0.9), quantity(9.0, 0.5))
    pilot = [of[i] for i in order]
    alone = plan_units([of[1]], 0.5, 100.0, 1.0, control=False)
    assert plan_units(pilot, 0.5, 100.0, 1.0, control=False) == alone
    assert plan_units(pilot, 0.5, 100.0, 1.0).expensive == plan_units([of[1]], 0.5, 100.0, 1.0).expensive
    measured = plan_units(pilot, 0.5, 100.0, 1.0).expensive + 10
    more = plan_units(pilot, 0.5, 100.0, 1.0, measured=measured)
    assert more.expensive == measured
    assert more.cheap == max(plan_units([q], 0.5, 100.0, 1.0, measured=measured).cheap for q in of) > 0
    assert plan_units(pilot, 0.5, 100.0, 1.0, measured=10_000, control=False).expensive == 10_000


def test_without_a_control_the_mean_is_that_of_the_expensive_measurement() -> None:
    rng = np.random.default_rng(1)
    x, more = rng.normal(size=12), rng.normal(size=50) + 0.3
    y = x + 0.1 * rng.normal(size=12)
    plain, used = (controlled_mean(y, x, more, control=control) for control in (False, True))
    assert (plain.estimate, plain.coefficient) == (mean_interval(y), 0.0)
    assert used.coefficient > 0.5
    assert plain.correlation == used.correlation
    wide = widened(plain.estimate)
    assert wide.half_width == pytest.approx(plain.estimate.half_width * math.sqrt(1 + 3 / 12))


def test_degrees_of_freedom_of_a_corrected_mean_are_two_less_than_its_units() -> None:
    """Where the other units are many, the interval is Student's with n − 2 of the corrected values."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=6)
    y = x + 0.5 * rng.normal(size=6)
    more = np.tile(np.linspace(-1, 1, 41), 5000)
    found = controlled_mean(y, x, more)
    slopes = [np.polyfit(np.delete(x, i), np.delete(y, i), 1)[0] for i in range(6)]
    corrected = y - np.array(slopes) * (x - more.mean())
    wanted = float(stdtrit(4, 0.975)) * np.std(corrected, ddof=1) / math.sqrt(6)
    assert found.estimate.half_width == pytest.approx(wanted, rel=2e-3)


def test_a_difference_of_rates_stays_between_the_ends_of_differences() -> None:
    a, b = np.zeros(4), np.array([0.9, 0.95, 1.0, 1.0])
    rates = paired(a, b, SHARE).difference
    assert rates == mean_interval(b - a, Range(-1.0, 1.0))
    assert rates.high < 1.0 < paired(a, b).difference.high
    assert Range(0.0, 1.0).of_differences() == (-1.0, 1.0, False)
    assert Range(2.0, 5.0).of_differences() == (-3.0, 3.0, False)
    assert paired(a, b, AMOUNT).difference == mean_interval(b - a)


def test_a_value_that_rounding_has_left_beside_an_end_is_the_end() -> None:
    assert mean_interval([1.0 + 1e-14, -1e-14], SHARE).mean == 0.5
    with pytest.raises(ValueError, match="must be 0 to 1"):
        mean_interval([1.0 + 1e-9, 0.5], SHARE)


# --- bytes and columns -----------------------------------------------------------------------------------


def test_a_tape_that_goes_to_disk_keeps_its_beginning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "TAPE_IN_MEMORY_BYTES", 10)
    tape = scratch.Tape()
    parts = [b"abc", b"defgh", b"ijklmnop", b"q"]
    assert [tape.append(part) for part in parts] == [0, 3, 8, 16]
    assert bytes(tape.finish()) == b"".join(parts)


@pytest.mark.parametrize("rows", [0, 1, 2, 3, 7, 8])
def test_blocks_hold_all_rows_and_none_stands_alone(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "BLOCK_BYTES", 1)
    found = scratch.blocks(rows, 100)
    assert [k for part in found for k in range(part.start, part.stop)] == list(range(rows))
    assert all(part.stop - part.start >= min(2, rows) for part in found)


def test_a_cell_that_must_be_there_is_not_empty(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t_s,x\n0,1\n,2\n")
    with pytest.raises(TraceError, match="t_s in row 2 is nan"):
        read_columns(path, {"t_s": (0, 9), "x": (0, 9)})
    path.write_text("t_s,x\n0,1\n1,\n")
    assert np.isnan(read_columns(path, {"t_s": (0, 9), "x": (0, 9)})["x"][1])


def test_time_that_stands_still_does_not_increase(tmp_path: Path) -> None:
    rows = np.array([0, 2, 3])
    check_increasing(tmp_path, np.array([0.0, 0.0, 1.0, 2.0]), rows, "drone 1")
    with pytest.raises(TraceError, match="t_s in row 4 of drone 1 is 1, must increase"):
        check_increasing(tmp_path, np.array([0.0, 0.0, 1.0, 1.0]), rows, "drone 1")


def test_a_file_of_one_s_own_stands_before_the_shipped_one_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = Path("paper_120s/drones.csv")
    monkeypatch.chdir(tmp_path)
    assert located(shipped) != shipped
    (tmp_path / "paper_120s").mkdir()
    shipped.write_text("t_s\n0\n")
    assert located(shipped) == shipped


# --- models from outside -----------------------------------------------------------------------------------


def test_what_is_left_out_need_not_be_finite_and_the_rest_must_be() -> None:
    out = np.eye(2, dtype=bool)
    given = np.array([[np.nan, 1.0], [2.0, np.inf]])
    np.testing.assert_array_equal(checked_array("link", lambda: given, (2, 2), left_out=out), given)
    with pytest.raises(PluginError, match="returns nan, must be finite"):
        checked_array("link", lambda: given[:, ::-1], (2, 2), left_out=out)
    with pytest.raises(PluginError, match="must be finite"):
        checked_array("link", lambda: given, (2, 2))


def test_a_model_gets_arrays_that_it_may_change() -> None:
    given = np.arange(4.0)[None]

    def changes(first: NDArray[np.float64], second: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
        first *= factor
        second[:] = 0.0
        return first

    assert checked_array("power", changes, (4,), given[0], given, 2.0).tolist() == [0.0, 2.0, 4.0, 6.0]
    assert given.tolist() == [[0.0, 1.0, 2.0, 3.0]]


def test_a_built_in_name_is_never_a_plug_in_s(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {
        "level": EntryPoint("level", "math:sqrt", "sortie.power"),
        "mine": EntryPoint("mine", "math:sqrt", "sortie.power"),
    }
    monkeypatch.setattr(reference, "installed", lambda kind: found)

    def level() -> None: ...

    assert resolve("power", "level", builtin={"level": level}) is level
    assert resolve("power", "mine", builtin={"level": level})(9.0) == 3.0


def test_an_error_is_told_at_the_last_line_of_a_user_s_own_files(tmp_path: Path) -> None:
    (tmp_path / "helper.py").write_text("def divide(x):\n    y = x\n    return 1 / y\n")
    (tmp_path / "own.py").write_text("from helper import divide\n\n\ndef model(x):\n    return divide(x)\n")
    with pytest.raises(PluginError, match=r"ZeroDivisionError: .* \(helper\.py, line 3\)"):
        checked_array("power", resolve("power", f"{tmp_path / 'own.py'}:model"), (1,), 0)


def test_a_guard_counts_no_time_where_it_is_told_not_to() -> None:
    class Model:
        def go(self) -> int:
            return 3

    assert isinstance(Guard("link", Model()).go.args[1], Guarded)
    assert not isinstance(Guard("link", Model(), timed=False).go.args[1], Guarded)


def test_a_module_beside_a_file_hides_the_installed_package_of_its_name(tmp_path: Path) -> None:
    path = tmp_path / "p.py"
    path.write_text("import numpy\nimport yaml\n")
    load(path)
    assert imported_packages(path) == {"numpy", "PyYAML"}
    (tmp_path / "yaml.py").write_text("")
    load(path)
    assert imported_packages(path) == {"numpy"}


def test_imported_files_are_those_beside_the_file_and_in_its_packages(tmp_path: Path) -> None:
    for name, text in {
        "own.py": "from pack import one\nfrom pack.inner import deep\nimport sortie\nimport numpy\nimport json\n",
        "pack/__init__.py": "", "pack/one.py": "", "pack/inner/__init__.py": "from .. import two\n", "pack/inner/deep.py": "from ..three import x\n",
        "pack/two.py": "", "pack/three.py": "x = 1\n", "pack/four.py": "", "sortie.py": "", "numpy/nothing.txt": "", "json.py": "",
    }.items():  # fmt: skip
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = [path.relative_to(tmp_path.resolve()).as_posix() for path in code_files(tmp_path / "own.py")]
    assert found == [
        "own.py", "pack/__init__.py", "pack/inner/__init__.py", "pack/inner/deep.py", "pack/one.py", "pack/three.py", "pack/two.py",
    ]  # fmt: skip


def test_a_group_has_drones_beside_its_reserve_and_a_charge_to_go_home_at_has_a_reserve() -> None:
    groups = "mission: {%s groups: [{drones: [1, 2], phases: [{}], reserve: [%s]}]}"
    refused(groups % ("", "2, 1"), "mission.groups.0.reserve: [2, 1], must be some of the group's drones")
    refused(
        groups % ("handover_soc: 0.5,", ""), "mission.handover_soc: 0.5, must be left out where no group has a reserve"
    )
    assert scenario(groups % ("handover_soc: 0.5,", "2"))


def test_a_tolerance_goes_with_a_number() -> None:
    expect = "expect: [{metric: policy, equals: %s, tolerance: 0.1}]"
    refused(expect % "worked", "expect.0.tolerance: 0.1, must be left out where equals is 'worked'")
    refused(expect % "true", "expect.0.tolerance: 0.1, must be left out where equals is True")
    assert scenario(expect % "3")
