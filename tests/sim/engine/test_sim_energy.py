"""The ledger of a sortie: energy up to the moment of an event, what causes add up to, and what computing costs.

The flights differ from each other in one event, so each test flies its own, most of them two seconds of three drones.
"""

from __future__ import annotations

import functools

import numpy as np
import pyarrow.compute as pc
import pytest
from recorded import recorded
from sim_examples import PATIENT, example

from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.energy.cell import energy_fraction
from sortie.policies.contract import Directive, FleetView
from sortie.scenarios.schema import Battery
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, fly, run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

FULL_J = 130 * 3600 * float(energy_fraction(0.95))


@functools.cache
def flown(events: str = "", *more: str) -> SortieRecord:
    short = ("duration_s=2", "fleet.drones=3", "mission.phases=[{at_s: 0}]")
    return run_sortie(example(*short, f"events=[{events}]", *more), "silence")


def energy_j(record: SortieRecord, drone: int) -> dict[str, float]:
    return {r["cause"]: r["energy_j"] for r in record.tables["energy"].to_pylist() if r["drone"] == drone}


def states(record: SortieRecord, drone: int, name: str) -> np.ndarray:
    rows = record.tables["states"].filter(pc.equal(record.tables["states"]["drone"], drone))
    return rows[name].to_numpy(zero_copy_only=False)


def spent_until_j(at_s: float) -> float:
    plain = flown()
    return float(np.interp(at_s, states(plain, 1, "t_s"), states(plain, 1, "spent_j")))


def test_a_drone_that_is_lost_has_spent_what_it_would_have_by_then() -> None:
    """Within a frame as well: rotors and avionics draw the same from a frame's begin to the event."""
    whole = energy_j(flown(), 1)
    for at_s in (1.0, 1.03, 1.08):
        lost = energy_j(flown(f"{{kind: drone_lost, at_s: {at_s}, drone: 1}}"), 1)
        assert sum(lost.values()) == pytest.approx(spent_until_j(at_s), rel=1e-3)
        assert lost["avionics"] == pytest.approx(8 * at_s)
        assert lost["rotor"] / lost["avionics"] == pytest.approx(whole["rotor"] / whole["avionics"], rel=0.05)


def test_a_fault_takes_its_part_of_what_is_left_at_that_moment_and_nothing_of_a_drone_that_is_gone() -> None:
    for kind, lost, at_s in (
        ("battery_fault, lost_fraction: 0.5", 0.5, 1.07),
        ("cell_failure", 0.25, 1.0),
        ("cell_failure", 0.25, 1.07),
    ):
        fault = f"{{kind: {kind}, drone: 1, at_s: {at_s}}}"
        # what a frame had drawn by then is gone before: half of the rest is half of the rest then; a frame draws 20 J
        assert energy_j(flown(fault), 1)["fault"] == pytest.approx(lost * (FULL_J - spent_until_j(at_s)), abs=0.2)
        gone = outcome(flown(f"{{kind: drone_lost, drone: 1, at_s: 0.9}}, {fault}"))
        assert gone["energy_j"]["fault"] == 0.0
        assert [e["kind"] for e in gone["events"]] == ["drone_lost", "no_effect"]


def test_cells_drop_out_until_the_drone_lands() -> None:
    failures = ", ".join(f"{{kind: cell_failure, at_s: {at}, drone: 1}}" for at in (0.5, 1, 1.3, 1.6))
    record = flown(failures)
    t_s, volts = states(record, 1, "t_s"), states(record, 1, "voltage_v")
    before, after = volts[(t_s > 0.2) & (t_s < 0.45)].mean(), volts[(t_s > 0.65) & (t_s < 0.95)].mean()
    assert after == pytest.approx(before * 3 / 4, rel=0.02)
    events = [(e["kind"], e["text"]) for e in record.tables["events"].to_pylist() if e["drone"] == 1]
    assert ("cell_failure", "3 cells are left") in events
    assert "landed" in {kind for kind, _ in events}
    assert (np.diff(states(record, 1, "soc")) <= 1e-6).all()
    assert states(record, 1, "soc")[-1] == 0.0
    assert energy_j(record, 1)["fault"] > 0.9 * FULL_J


def test_states_have_what_the_ledger_of_a_sortie_to_there_has() -> None:
    """With ohmic loss, polarisation and a fault; a drone that landed spends no more."""
    packs = ("fleet.battery.cell_resistance_mohm=40", "fleet.battery.polarisation.resistance_mohm=20")
    events = "{kind: battery_fault, drone: 1, at_s: 0.5, lost_fraction: 0.01}, {kind: drone_lost, drone: 2, at_s: 0.7}"
    rows = flown(events, *packs).tables["states"].to_pylist()
    for until_s in (0.8, 1.1):
        at = [row["spent_j"] for row in rows if row["t_s"] == pytest.approx(until_s)]
        shorter = outcome(flown(events, *packs, f"duration_s={until_s}"))
        assert at == pytest.approx([d["energy_j"] for d in shorter["drones"].values()], rel=1e-12)
        assert sum(at) == pytest.approx(shorter["energy_j"]["total"], rel=1e-12)
        assert shorter["energy_j"]["ohmic"] > 0


def test_everything_at_once_keeps_the_ledger() -> None:
    """Cold, old, polarising packs with payload under momentum theory, and faults: causes are what left the packs."""
    record = flown(
        "{kind: cell_failure, at_s: 0.6, drone: 1}, {kind: battery_fault, at_s: 1, drone: 2, lost_fraction: 0.3}",
        "fleet.airframe={power_model: momentum, payload_kg: 0.4, air_density_kgpm3: 1.1}",
        "fleet.battery={ambient_c: -5, cycles: 150, polarisation: {resistance_mohm: 5}, cutoff_cell_v: 2.0}",
    )
    assert {"cell_failure", "battery_fault"} <= set(record.tables["events"]["kind"].to_pylist())  # they flew till then
    full_j = 130 * 3600 * 0.9  # 150 of 300 cycles take a tenth
    left_j = sum(
        full_j * (3 / 4 if drone == 1 else 1.0) * float(energy_fraction(states(record, drone, "soc")[-1]))
        for drone in range(3)
    )
    # the last frame's drain comes after its state was written
    spent_j = outcome(record)["energy_j"]["total"]
    assert spent_j + left_j == pytest.approx(3 * full_j * float(energy_fraction(0.95)), rel=2e-4)


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("fleet.airframe.mass_kg=30", "the pack cannot give "),
        ("fleet.battery.cutoff_cell_v=4.1", " V a cell, cut off below 4.1 V"),
        ("fleet.battery.initial_soc=0.1001", "charge 10.0%"),
    ],
)
def test_a_landing_says_what_brought_it_down(override: str, why: str) -> None:
    record = flown("", override, "fleet.airframe.power_model=momentum")
    landed = {row["drone"]: row for row in record.tables["events"].to_pylist() if row["kind"] == "landed"}
    assert sorted(landed) == [0, 1, 2]
    assert all(why in row["text"] for row in landed.values())
    for drone, row in landed.items():
        assert states(record, drone, "soc").min() >= 0
        assert (states(record, drone, "airborne") == (states(record, drone, "t_s") < row["t_s"] - 1e-9)).all()


def test_the_seconds_of_busy_air_add_up_to_all_of_it() -> None:
    """Each row is of the second before it. A shorter flight begins alike."""
    medium = recorded("base").tables["medium"]
    assert medium["t_s"].to_pylist() == pytest.approx([0, 1, 2, 3, 4, 5])
    whole = run_sortie(example("duration_s=2", "mission.phases=[{at_s: 0}]")).totals["medium_busy_fraction"]
    assert medium["busy_fraction"].to_numpy()[1:3].mean() == pytest.approx(whole, rel=0.02)


def test_the_radio_costs_what_it_draws_while_it_sends() -> None:
    scenario = example("duration_s=3", "policy.dwell_s=0")
    flight = build(scenario, plan_for(scenario), 1)
    fly(flight)
    airtime_s = np.array(flight.world.air.airtime_s)
    assert airtime_s.min() > 0.1
    listens_w, more_w = 2.0, 4.0
    radio_j = flight.world.batteries.energy_j["radio"]
    np.testing.assert_allclose(radio_j, listens_w * 3.0 + more_w * airtime_s, atol=more_w * 0.01)


def test_computing_costs_energy_and_headroom_in_the_frames_in_which_perception_ran() -> None:
    """Drones 0, 1 and 2 rest in none, half and all of the frames."""
    duty = (100, 50, 0)

    def resting(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, duty_percent=duty[view.ego], reason="rest") for p in view.peers]

    sets = ("duration_s=6", "fleet.drones=3", "perception.compute_delay_s=0.05", "policy.hysteresis=0", *PATIENT)
    record = run_sortie(example(*sets), resting)
    for drone in range(3):
        ran = states(record, drone, "looks")
        wanted_j = 10.0 * 6.0 + 30.0 * 0.5 * 0.1 * ran[-1]  # idle, and active for half of a frame
        assert energy_j(record, drone)["compute"] == pytest.approx(wanted_j, abs=30.0 * 0.5 * 0.1 * 2 + 1e-6)
        rate_hz = (ran[50] - ran[30]) / 2.0
        assert rate_hz == pytest.approx(duty[drone] / 10, abs=0.6)
        told = record.tables["descriptors"].to_pylist()
        late = [row["gpu_headroom"] for row in told if row["drone"] == drone and row["t_s"] > 4.0]
        assert np.mean(late) == pytest.approx(1 - 0.05 * rate_hz, abs=0.012)


def test_the_mains_lose_nothing_to_a_fault() -> None:
    packs = FleetBatteries(Battery(), (), 2, mains={0})
    for drone in (0, 1):
        packs.fault(drone, 0.5)
    assert packs.energy_j["fault"][0] == 0.0
    assert packs.soc[0] == 1.0
    assert packs.energy_j["fault"][1] > 0.0
    packs.step(1.0, [100.0, 100.0], [1.0, 1.0], [0.1, 0.1])
    assert packs.spent_j[0] == 0.0
    packs.fault(0, 1.0)
    assert not packs.landed[0]
