"""What happens between two frames, and over what a figure is: energy up to an event, busy air, clocks told anew, alerts, trucks."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.fleet.clock import Oscillator
from sortie.fleet.plane import DroneStatus
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import ClockDrift, ClockSkew, GnssLoss
from sortie.sim.engine import people as engine_people
from sortie.sim.engine.own_state import OwnState
from sortie.sim.engine.people import People
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import Recorder, SortieRecord


@cache
def flown(events: str = "", duration_s: float = 4) -> SortieRecord:
    return run_sortie(
        example(f"duration_s={duration_s}", f"events=[{events}]", "policy.name=silence", "policy.params={}")
    )


def energy_j(record: SortieRecord, drone: int) -> dict[str, float]:
    rows = record.tables["energy"].to_pylist()
    return {r["cause"]: r["energy_j"] for r in rows if r["drone"] == drone}


def states(record: SortieRecord, drone: int, *names: str) -> list[np.ndarray[Any, Any]]:
    rows = record.tables["states"].filter(pc.equal(record.tables["states"]["drone"], drone))
    return [rows[n].to_numpy(zero_copy_only=False) for n in names]


# --- energy up to the moment of an event ---------------------------------------------------------------------------


@pytest.mark.parametrize("at_s", [1.0, 1.03, 1.08])
def test_a_drone_that_is_lost_has_spent_what_it_would_have_by_then(at_s: float) -> None:
    """Within a frame as well: rotors and avionics draw the same from a frame's begin to the event."""
    whole = energy_j(flown(), 1)
    t_s, spent = states(flown(), 1, "t_s", "spent_j")
    lost = energy_j(flown(f"{{kind: drone_lost, at_s: {at_s}, drone: 1}}"), 1)
    assert sum(lost.values()) == pytest.approx(float(np.interp(at_s, t_s, spent)), rel=1e-3)
    assert lost["avionics"] == pytest.approx(8 * at_s)
    assert lost["rotor"] / lost["avionics"] == pytest.approx(whole["rotor"] / whole["avionics"], rel=0.05)


@pytest.mark.parametrize("at_s", [1.0, 1.07])
@pytest.mark.parametrize("kind", ["battery_fault", "cell_failure"])
def test_a_fault_takes_its_part_of_what_is_left_at_that_moment(kind: str, at_s: float) -> None:
    """What a frame had drawn by then is gone before: half of the rest is half of the rest then."""
    lost = 0.5 if kind == "battery_fault" else 0.25
    fraction = ", lost_fraction: 0.5" if kind == "battery_fault" else ""
    t_s, spent = states(flown(), 1, "t_s", "spent_j")
    full_j = 130 * 3600 * energy_share(0.95)
    left_j = full_j - float(np.interp(at_s, t_s, spent))
    fault_j = energy_j(flown(f"{{kind: {kind}, at_s: {at_s}, drone: 1{fraction}}}"), 1)["fault"]
    assert fault_j == pytest.approx(lost * left_j, abs=0.2)  # a frame draws 20 J


def energy_share(soc: float) -> float:
    from sortie.fleet.energy.cell import energy_fraction

    return float(energy_fraction(soc))


# --- the air ----------------------------------------------------------------------------------------------------------


def test_the_seconds_of_busy_air_add_up_to_all_of_it() -> None:
    """Each row is of the second before it, whatever was busy earlier."""
    busy, t_s = (flown(duration_s=6).tables["medium"][c].to_numpy() for c in ("busy_fraction", "t_s"))
    assert t_s.tolist() == pytest.approx([0, 1, 2, 3, 4, 5])
    for end_s in (2, 4):
        whole = flown(duration_s=end_s).totals["medium_busy_fraction"]  # a shorter flight begins alike
        assert busy[1 : end_s + 1].mean() == pytest.approx(whole, rel=0.02)
    jam = "{kind: drone_lost, at_s: 2, drone: 1}, {kind: drone_lost, at_s: 2, drone: 2}"
    later = flown(jam, 6).tables["medium"]["busy_fraction"].to_numpy()
    assert later[3:] == pytest.approx(busy[3:] * 3 / 5, rel=0.15)  # three publish, in place of five


# --- clocks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gnss", [True, False])
def test_a_clock_drifts_at_the_rate_of_its_event_and_jumps_to_the_offset_of_its_event(gnss: bool) -> None:
    """Whatever its oscillator does of itself, growth included; before and after it goes on without a jump. It follows GNSS no
    more, so a loss of GNSS and its end change nothing."""
    status = DroneStatus()
    own = OwnState(status, Oscillator(0.3, 50.0, 900.0), gnss=gnss)

    def error_s(now_s: float) -> float:
        own.read(now_s)
        return status.clock_skew_s

    of_itself = error_s(60.0)
    assert of_itself == pytest.approx(0.3 if gnss else 0.3 + (50.0 + 450.0) * 60e-6)
    own.begin(ClockDrift(kind="clock_drift", at_s=60.0, drone=0, drift_ppm=-200.0), 0, 60.0)
    for later_s in (0.0, 10.0, 400.0):
        assert error_s(60.0 + later_s) == pytest.approx(of_itself - 200e-6 * later_s)
    own.begin(ClockSkew(kind="clock_skew", at_s=500.0, drone=0, skew_s=2.0), 1, 500.0)
    for later_s in (0.0, 100.0):  # the rate stays
        assert error_s(500.0 + later_s) == pytest.approx(2.0 - 200e-6 * later_s)
    loss = GnssLoss(kind="gnss_loss", at_s=700.0, until_s=760.0, drone=0)
    before = error_s(700.0)
    own.begin(loss, 2, 700.0)
    assert error_s(760.0) == pytest.approx(before - 200e-6 * 60.0)
    own.end(loss, 2, 760.0)
    assert error_s(900.0) == pytest.approx(before - 200e-6 * 200.0)


# --- people -----------------------------------------------------------------------------------------------------------


def test_alerts_are_false_where_there_is_a_region_and_nobody_in_it() -> None:
    """Counted again, frame by frame. Time without a region is no time without a false alert."""
    late = "mission.phases=[{at_s: 0, phase: search}, {at_s: 6, phase: search, region: {radius_m: 12, centre_m: [13, 30]}}]"
    alarms = "perception.thermal={false_alarms_per_min: 200}"
    record = run_sortie(
        load("person_crossing", ["perception.detector=none", "expect=[]", "duration_s=12", "events=[]", late, alarms])
    )
    people = {round(r["t_s"], 6): (r["x_m"], r["y_m"]) for r in record.tables["people"].to_pylist()}
    alone = false = 0
    for drone in range(3):
        changes = [(r["t_s"], r["known"]) for r in record.tables["alerts"].to_pylist() if r["drone"] == drone]
        for t_s, (x_m, y_m) in people.items():
            if t_s < 6.0 - 1e-6 or np.hypot(x_m - 13, y_m - 30) <= 12:
                continue
            alone += 1
            known = [k for at, k in changes if at <= t_s + 0.09]
            false += bool(known and known[-1])
    assert false > 0
    assert outcome(record)["people"]["false_alert_share"] == pytest.approx(false / alone)


@pytest.mark.parametrize("trucks", [0.0, 0.5])
def test_trucks_stand_before_people_where_the_scene_has_any(trucks: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the moment at which the camera looks."""
    given: list[Any] = []
    monkeypatch.setattr(engine_people, "look", lambda *args: given.append(args[-1]) or [])
    scenario = load("person_crossing", ["expect=[]", f"perception.scene.trucks={trucks}"])
    scene = SceneModel(scenario.perception.scene, None, (0.0, 0.0, 20.0, 0.0), people=scenario.perception.people)
    people = People(scenario, scene, Recorder(classes=True), (1, 0))
    people.look(Capture(0, 7.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0), 70)
    (there,) = given
    if not trucks:
        assert there is None
        return
    wanted = scene.trucks(7.0)
    assert len(wanted) > 0
    np.testing.assert_array_equal(there.x_m, wanted.x_m)
    assert not np.array_equal(there.x_m, scene.trucks(0.0).x_m)
