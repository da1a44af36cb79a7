"""The energy model against a real flight: voltage within 2 % RMS, power at hover within 10 %.

The vehicle's data are stated in `energy.py` with where they come from; the log itself is not in this repository, and
without it these tests are skipped.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

from research.validation import energy
from research.validation.identify import hovering, identify_pack, stated_pack, voltage_error
from research.validation.stored import FOLDER
from sortie.fleet.logs.flightlog import FlightLog, read_log
from sortie.scenarios.schema import Airframe

needs_log = pytest.mark.skipif(not energy.LOG.is_file(), reason=f"{energy.LOG} is not here")


@pytest.fixture(scope="module")
def log() -> FlightLog:
    return read_log(energy.LOG)


@needs_log
def test_voltage_from_stated_pack_data_within_2_percent(log: FlightLog) -> None:
    """5,200 mAh and the charge from the log's own parameters and counter, the default curve and resistance: no fit."""
    pack = stated_pack(log, energy.CELLS)
    assert pack.capacity_wh == pytest.approx(79.9, abs=0.1)
    assert voltage_error(log, pack, energy.TAKEOFF_S, energy.END_S) < 0.02
    assert voltage_error(log, pack, 0.0, energy.END_S) < 0.02


@needs_log
def test_voltage_identified_on_the_first_part_tested_on_the_rest(log: FlightLog) -> None:
    pack = identify_pack(log, stated_pack(log, energy.CELLS), energy.SPLIT_S)
    assert 3 < pack.cell_resistance_mohm < 13
    assert voltage_error(log, pack, energy.SPLIT_S, energy.END_S) < 0.01


@needs_log
def test_identification_reads_nothing_of_the_part_under_test(log: FlightLog) -> None:
    battery = log.battery
    assert battery is not None
    later = battery.time_s >= energy.SPLIT_S
    values = battery.values.copy()
    values[later, 0] += 1.0
    tampered = energy.FlightLog(
        **{f: getattr(log, f) for f in log.__dataclass_fields__} | {"battery": type(battery)(battery.time_s, values)}
    )
    stated = stated_pack(log, energy.CELLS)
    assert identify_pack(tampered, stated, energy.SPLIT_S) == identify_pack(log, stated, energy.SPLIT_S)


@needs_log
def test_a_wrong_pack_misses_the_voltage(log: FlightLog) -> None:
    """The test can fail: without resistance, or with a pack of half the size, the error is above 2 %."""
    pack = stated_pack(log, energy.CELLS)
    for changes in (
        {"cell_resistance_mohm": 0.0},
        {"cell_resistance_mohm": 30.0},
        {"capacity_wh": pack.capacity_wh / 4},
    ):
        assert voltage_error(log, pack.model_copy(update=changes), energy.TAKEOFF_S, energy.END_S) > 0.02


@needs_log
def test_power_at_hover_within_10_percent_from_mass_and_rotor_data(log: FlightLog) -> None:
    """1.88 kg on four 0.254 m propellers of CT 0.1213 and CP 0.0500 in air of 95,125 Pa and 22 °C; 80 % drivetrain."""
    found = energy.hover_figures(log)
    assert found["seconds"] > 20
    assert found["predicted_w"] == pytest.approx(found["measured_w"], rel=0.10)
    assert found["predicted_bare_w"] < 0.8 * found["measured_w"]  # mass matters: without the camera it would be far off


@needs_log
def test_hovering_rows_do_not_move(log: FlightLog) -> None:
    rows = hovering(log, energy.TAKEOFF_S, energy.END_S)
    assert log.battery is not None
    assert log.velocity is not None
    up = np.interp(log.battery.time_s[rows], log.velocity.time_s, log.velocity.values[:, 2])
    assert (np.abs(up) < 0.3).all()
    assert rows[log.battery.time_s < energy.TAKEOFF_S].sum() == 0


@needs_log
def test_the_accelerometers_thrust_explains_the_powers_variation(log: FlightLog) -> None:
    """Momentum theory with the measured thrust, in half-seconds: no fit but the sensor's lag."""
    found = energy.thrust_figures(log, energy.LOG)
    assert found["correlation"] > 0.7
    assert found["slope"] == pytest.approx(1.0, abs=0.25)


def test_what_the_effects_are_worth_is_as_written_down() -> None:
    written = json.loads((FOLDER / "energy.json").read_text("utf-8"))["tables"]["energy_effects"]["rows"]
    assert dict(energy.effects()) == pytest.approx(dict(written), abs=0.05)


def test_the_solo_preset_is_the_vehicle_of_the_recorded_flight() -> None:
    preset, stated = Airframe.model_validate("solo"), energy.airframe(energy.MASS_KG)
    for name in ("mass_kg", "disc_area_m2", "figure_of_merit", "tip_speed_mps"):
        assert getattr(preset, name) == pytest.approx(getattr(stated, name), rel=1e-3)
    assert preset.power_model == stated.power_model
