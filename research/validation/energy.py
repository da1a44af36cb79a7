"""The energy model against a real flight, and what its effects are worth (`make figures FIGURE=energy`, and `FIGURE=flight`).

The flight is the ArduCopter log `log171.bin` of dronekit-la's test data (CC BY-SA 3.0, not in this repository); the
environment's SORTIE_FLIGHT_LOG names it, else ../shared/flightlogs/log171.bin beside the repository.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from research.validation.identify import (
    electric_power_w,
    hovering,
    identify_pack,
    predicted_voltage,
    stated_pack,
    voltage_error,
)
from research.validation.stored import Column, Table
from sortie.fleet.energy.battery import CAUSES, FleetBatteries
from sortie.fleet.flight.rotor import figure_of_merit, momentum_power_w, rotor_power_w
from sortie.fleet.logs.dataflash import read_dataflash
from sortie.fleet.logs.flightlog import FlightLog, read_log
from sortie.scenarios.schema import Airframe, Battery, Polarisation

ROOT = Path(__file__).resolve().parents[2]
LOG = Path(os.environ.get("SORTIE_FLIGHT_LOG", ROOT.parent / "shared/flightlogs/log171.bin"))

# --- what is known of the flight, and from where ---------------------------------------------------
TAKEOFF_S, SPLIT_S, END_S = 75.0, 118.5, 205.5
"""Since the log's begin: off the ground, end of the stretch to identify on, end of the sound part (from there on the
EKF diverges)."""
CELLS = 4
"""16.54 V at rest. BATT_MONITOR 5 and BATT_CAPACITY 5200 in the log's parameters are the smart battery of a 3DR Solo."""
MASS_KG = 1.49 + 0.39
"""Assumed: the log has no mass. A Solo with battery, and its gimbal with a GoPro (390 g by the maker's developer
guide), which MNT_TYPE 2 in the parameters asks for but does not prove."""
BARE_KG = 1.49
DIAMETER_M = 0.254
PROPELLER_CT, PROPELLER_CP = 0.1213, 0.0500
"""APC Slow Flyer 10 × 4.7 at 5,147 rpm, static, UIUC propeller data site: the nearest measured to the Solo's own
10 × 4.5, whose data are not public. 1.88 kg hover at 5,400 rpm with it."""
TIP_SPEED_MPS = math.pi * DIAMETER_M * 5400 / 60
AIR_C = 22.0
"""Assumed: Canberra on a November morning. The pressure is the log's."""
PRESSURE_PA = 95_125.0
DRIVETRAIN = Battery().drivetrain_efficiency
SENSOR_LAG_S = 0.25
TIME_CONSTANTS_S = (5.0, 10.0, 20.0, 40.0)


def airframe(mass_kg: float) -> Airframe:
    """The vehicle as stated."""
    return Airframe(
        mass_kg=mass_kg,
        disc_area_m2=4 * math.pi * DIAMETER_M**2 / 4,
        figure_of_merit=figure_of_merit(PROPELLER_CT, PROPELLER_CP),
        tip_speed_mps=TIP_SPEED_MPS,
        air_density_kgpm3=PRESSURE_PA / (287.05 * (AIR_C + 273.15)),
        power_model="momentum",
    )


def electronics_w(log: FlightLog) -> float:
    """What the vehicle draws before its motors turn."""
    assert log.battery is not None
    return float(electric_power_w(log)[log.battery.time_s < 60.0].mean())


def hover_w(log: FlightLog, mass_kg: float) -> float:
    """Electric power at hover, predicted."""
    return float(rotor_power_w(0.0, airframe(mass_kg))) / DRIVETRAIN + electronics_w(log)


def voltage_figures(log: FlightLog) -> dict[str, Any]:
    """Relative RMS error of the voltage, of the pack as stated and as identified on the first part."""
    stated = stated_pack(log, CELLS)
    fitted = identify_pack(log, stated, SPLIT_S)
    return {
        "capacity_wh": stated.capacity_wh,
        "stated_mohm": stated.cell_resistance_mohm,
        "stated_whole": voltage_error(log, stated, 0.0, END_S),
        "stated_flight": voltage_error(log, stated, TAKEOFF_S, END_S),
        "fitted_mohm": fitted.cell_resistance_mohm,
        "fitted_polarisation_mohm": fitted.polarisation.resistance_mohm,
        "fitted_first": voltage_error(log, fitted, 0.0, SPLIT_S),
        "fitted_rest": voltage_error(log, fitted, SPLIT_S, END_S),
        "fitted_rest_by_time_constant_s": {
            time_s: voltage_error(log, identify_pack(log, stated, SPLIT_S, time_s), SPLIT_S, END_S)
            for time_s in TIME_CONSTANTS_S
        },
        "curve_low_before_takeoff_v": resting_error_v(log),
    }


def resting_error_v(log: FlightLog) -> float:
    """Measured less predicted voltage in the minute before the motors turn."""
    assert log.battery is not None
    early = log.battery.time_s < 60.0
    return float((log.battery.values[:, 0] - predicted_voltage(log, stated_pack(log, CELLS)).values)[early].mean())


def hover_figures(log: FlightLog) -> dict[str, Any]:
    """Measured and predicted power at hover, W."""
    rows = hovering(log, TAKEOFF_S + 10, END_S)
    power = electric_power_w(log)[rows]
    assert log.battery is not None
    return {
        "measured_w": float(power.mean()),
        "measured_std_w": float(power.std()),
        "seconds": float(rows.sum() * np.median(np.diff(log.battery.time_s))),
        "electronics_w": electronics_w(log),
        "figure_of_merit": airframe(MASS_KG).figure_of_merit,
        "air_density_kgpm3": airframe(MASS_KG).air_density_kgpm3,
        "predicted_w": hover_w(log, MASS_KG),
        "predicted_bare_w": hover_w(log, BARE_KG),
    }


def thrust_figures(log: FlightLog, path: Path) -> dict[str, Any]:
    """Power from second to second: what the accelerometer's thrust explains of it.

    Power by momentum theory with the measured specific force as thrust, in still air, at the moment that the current
    sensor shows (its lag was found by trying, here it is stated), each smoothed over 0.5 s. Slope and correlation of
    measured on predicted power.
    """
    assert log.battery is not None
    imu = read_dataflash(path.read_bytes()).tables["IMU"]
    begin_s = read_begin_s(path)
    time_s = imu["TimeMS"] * 1e-3 - begin_s
    width = 25  # 0.5 s at 50 Hz
    up = np.convolve(-imu["AccZ"].astype(float), np.ones(width) / width, "same")
    air = (log.battery.time_s > TAKEOFF_S + 15) & (log.battery.time_s < END_S)
    at = log.battery.time_s[air]
    thrust = np.interp(at - SENSOR_LAG_S, time_s, up)
    push = np.stack([np.zeros_like(thrust), np.zeros_like(thrust), thrust - 9.81], axis=-1)
    predicted = momentum_power_w(np.zeros_like(push), push, airframe(MASS_KG)) / DRIVETRAIN + electronics_w(log)
    measured = np.convolve(electric_power_w(log), np.ones(5) / 5, "same")[air]
    slope = float(np.polyfit(predicted, measured, 1)[0])
    assert log.velocity is not None
    east, north = (np.interp(at, log.velocity.time_s, log.velocity.values[:, axis]) for axis in (0, 1))
    return {
        "slope": slope,
        "correlation": float(np.corrcoef(predicted, measured)[0, 1]),
        "lag_s": SENSOR_LAG_S,
        "ground_speed_correlation": float(np.corrcoef(np.hypot(east, north), measured)[0, 1]),
    }


def read_begin_s(path: Path) -> float:
    """The log's own clock at its first sample of attitude or battery, which `read_log` calls 0."""
    tables = read_dataflash(path.read_bytes()).tables
    return float(min(tables[name]["TimeMS"][0] for name in ("ATT", "CURR", "EKF1")) * 1e-3)


# --- what each effect is worth ---------------------------------------------------------------------


def endurance_min(battery: Battery, airframe_: Airframe | None = None, lost_cell_at_s: float | None = None) -> float:
    """Minutes at hover from the pack's charge to its landing, perception at half duty, 10 % airtime."""
    rotor_w = float(rotor_power_w(0.0, airframe_ or Airframe()))
    packs = FleetBatteries(battery, (), 1)
    flown_s, step_s = 0.0, 0.5
    while not packs.landed[0]:
        if lost_cell_at_s is not None and flown_s <= lost_cell_at_s < flown_s + step_s:
            packs.drop_cell(0)
        packs.step(step_s, [rotor_w], [0.5], [0.1])
        flown_s += step_s
    lost = sum(packs.energy_j[cause][0] for cause in CAUSES)
    assert math.isclose(lost + packs.energy_left_j[0], FleetBatteries(battery, (), 1).energy_left_j[0], rel_tol=1e-9), (
        "the ledger does not add up"
    )
    return flown_s / 60.0


def budgets() -> dict[str, dict[str, float]]:
    """The default drone's endurance, mean power and where it goes, at 10 % airtime; and what the radio is worth."""
    found = {}
    for name, speed_mps, duty, airtime in (
        ("hover, perception always on", 0.0, 1.0, 0.1),
        ("hover, perception off", 0.0, 0.0, 0.1),
        ("5 m/s, always on", 5.0, 1.0, 0.1),
        ("5 m/s, off", 5.0, 0.0, 0.1),
        ("hover, half duty, radio silent", 0.0, 0.5, 0.0),
        ("hover, half duty, radio always sending", 0.0, 0.5, 1.0),
    ):
        packs, seconds = FleetBatteries(Battery(), (), 1), 0.0
        while not packs.landed[0]:
            packs.step(0.5, [float(rotor_power_w(speed_mps))], [duty], [airtime])
            seconds += 0.5
        spent = {cause: packs.energy_j[cause][0] for cause in CAUSES}
        total = sum(spent.values())
        found[name] = {"min": seconds / 60, "w": total / seconds, **{c: spent[c] / total for c in CAUSES}}
    return found


def effects() -> list[tuple[str, float]]:
    """Endurance with one effect after another, minutes."""
    cut = dict(cutoff_cell_v=3.3)
    return [
        ("default pack and airframe", endurance_min(Battery())),
        ("0.5 kg of payload", endurance_min(Battery(), Airframe(payload_kg=0.5))),
        ("at 2,000 m (1.01 kg/m³)", endurance_min(Battery(), Airframe(air_density_kgpm3=1.01))),
        ("polarisation 5 mΩ a cell, 20 s", endurance_min(Battery(polarisation=Polarisation(resistance_mohm=5)))),
        ("cut-off at 3.3 V a cell", endurance_min(Battery(**cut))),
        ("the same at 25 °C, self-heating on", endurance_min(Battery(ambient_c=25, **cut))),
        ("the same at 0 °C", endurance_min(Battery(ambient_c=0, **cut))),
        ("the same at −15 °C", endurance_min(Battery(ambient_c=-15, **cut))),
        ("the same after 300 cycles, 25 °C", endurance_min(Battery(ambient_c=25, cycles=300, **cut))),
        ("a cell lost after 5 min", endurance_min(Battery(), lost_cell_at_s=300.0)),
    ]


def cold_start() -> dict[str, float]:
    """A fresh pack at −15 °C under the full load of hover: its voltage at once, at its highest, and when."""
    packs, volts = FleetBatteries(Battery(ambient_c=-15), (), 1), []
    for _ in range(900):
        packs.step(1.0, [float(rotor_power_w(0.0))], [0.5], [0.1])
        volts.append(packs.voltage_v[0])
    return {"first_v": volts[0], "highest_v": max(volts), "after_min": volts.index(max(volts)) / 60}


# --- report ----------------------------------------------------------------------------------------


def tables() -> dict[str, Table]:
    """What the default drone spends, and what each effect is worth."""
    parts = ("rotor", "compute", "radio", "ohmic")
    cold = cold_start()
    return {
        "energy_budgets": Table(
            [
                Column(""),
                Column("endurance", ".1f", " min"),
                Column("mean power", ".0f", " W"),
                *(Column(name, ".1f", " %", 100) for name in ("rotors", *parts[1:])),
            ],
            [[name, b["min"], b["w"], *(b[cause] for cause in parts)] for name, b in budgets().items()],
        ),
        "energy_effects": Table([Column("hover until landing"), Column("min", ".1f")], effects()),
        "energy_cold": Table(
            [
                Column("a fresh pack at −15 °C", ".1f", " V at once"),
                Column("highest", ".1f", " V"),
                Column("after", ".0f", " min"),
            ],
            [[cold["first_v"], cold["highest_v"], cold["after_min"]]],
        ),
    }


def flight_tables(path: Path) -> dict[str, Table]:
    """The model beside the real flight."""
    log = read_log(path)
    v, h, t = voltage_figures(log), hover_figures(log), thrust_figures(log, path)
    rms = Column("RMS error of the voltage", ".2f", " %", 100)
    identified = f"{v['fitted_mohm']:.1f} + {v['fitted_polarisation_mohm']:.1f} mΩ a cell identified on the first part"
    return {
        "flight_voltage": Table(
            [Column("pack"), Column("part of the log"), rms],
            [
                [f"as stated, {v['stated_mohm']:g} mΩ a cell", "whole", v["stated_whole"]],
                ["the same", "in flight", v["stated_flight"]],
                [identified, "first", v["fitted_first"]],
                ["the same", "rest", v["fitted_rest"]],
                *(
                    [f"the same, time constant {float(s):g} s", "rest", error]
                    for s, error in v["fitted_rest_by_time_constant_s"].items()
                ),
            ],
        ),
        "flight_power": Table(
            [Column("power at hover"), Column("", ".1f", " W"), Column("of the measured", "+.1f", " %", 100)],
            [
                [f"measured over {h['seconds']:.0f} s", h["measured_w"], None],
                ["its standard deviation", h["measured_std_w"], None],
                [f"predicted for {MASS_KG:.2f} kg", h["predicted_w"], h["predicted_w"] / h["measured_w"] - 1],
                [
                    f"predicted for {BARE_KG:.2f} kg, without the camera",
                    h["predicted_bare_w"],
                    h["predicted_bare_w"] / h["measured_w"] - 1,
                ],
            ],
        ),
        "flight_variation": Table(
            [Column("power explained by"), Column("slope", ".2f"), Column("correlation", ".2f")],
            [
                ["the accelerometer's thrust, in half-seconds", t["slope"], t["correlation"]],
                ["ground speed", None, t["ground_speed_correlation"]],
            ],
        ),
        "flight_rest": Table(
            [Column("the open-circuit curve at rest before take-off", ".2f", " V low")],
            [[v["curve_low_before_takeoff_v"]]],
        ),
    }


def draw_flight(log: FlightLog, folder: Path) -> None:
    """Voltage and power of the flight, measured and predicted."""
    plt = plotting()
    if plt is None:
        return
    assert log.battery is not None
    stated = stated_pack(log, CELLS)
    fitted = identify_pack(log, stated, SPLIT_S)
    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 5), sharex=True, constrained_layout=True)
    above.plot(log.battery.time_s, log.battery.values[:, 0], "k", lw=0.8, label="measured")
    for pack, label, colour in ((stated, "pack as stated", "C0"), (fitted, "identified before the line", "C1")):
        predicted = predicted_voltage(log, pack)
        above.plot(predicted.time_s, predicted.values, colour, lw=0.8, label=label)
    above.axvline(SPLIT_S, color="grey", lw=0.8)
    above.set(ylabel="voltage, V", ylim=(15.0, 16.8))
    above.legend(loc="lower left", fontsize="small")
    below.plot(log.battery.time_s, electric_power_w(log), "k", lw=0.5, label="measured")
    below.axhline(hover_w(log, MASS_KG), color="C1", lw=1, label=f"hover, {MASS_KG:.2f} kg")
    below.axhline(hover_w(log, BARE_KG), color="C0", lw=1, ls="--", label=f"hover, {BARE_KG:.2f} kg")
    below.set(xlabel="time, s", ylabel="electric power, W", xlim=(60, END_S), ylim=(0, 360))
    below.legend(loc="lower right", fontsize="small")
    figure.savefig(folder / "energy_flight.png", dpi=110)
    plt.close(figure)


def draw_effects(folder: Path) -> None:
    """Rotor power over air speed, and voltage at hover over time in cold, age and with a lost cell."""
    plt = plotting()
    if plt is None:
        return
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), constrained_layout=True)
    speed = np.linspace(0, 22, 200)
    for payload in (0.0, 0.5, 1.0):
        left.plot(speed, rotor_power_w(speed, Airframe(payload_kg=payload)), label=f"{payload:g} kg of payload")
    climb = np.stack([speed, np.zeros_like(speed), np.full_like(speed, 2.0)], axis=-1)
    left.plot(speed, momentum_power_w(climb, np.zeros_like(climb)), "C0:", label="climbing 2 m/s, momentum theory")
    left.set(xlabel="air speed, m/s", ylabel="power at the rotors, W", ylim=(0, None))
    left.legend(fontsize="small")
    hover = float(rotor_power_w(0.0))
    for label, battery, lost_at in (
        ("new, 25 °C", Battery(ambient_c=25), None),
        ("new, −15 °C", Battery(ambient_c=-15), None),
        ("300 cycles, 25 °C", Battery(ambient_c=25, cycles=300), None),
        ("a cell lost after 5 min", Battery(ambient_c=25), 300.0),
    ):
        packs, minutes, volts = FleetBatteries(battery, (), 1), [], []
        while not packs.landed[0]:
            if lost_at is not None and len(minutes) == lost_at:
                packs.drop_cell(0)
            packs.step(1.0, [hover], [0.5], [0.1])
            if not packs.landed[0]:
                minutes.append(len(minutes) / 60)
                volts.append(packs.voltage_v[0])
        right.plot(minutes, volts, label=label)
    right.set(xlabel="minutes at hover", ylabel="voltage under load, V")
    right.legend(fontsize="small")
    figure.savefig(folder / "energy_effects.png", dpi=110)
    plt.close(figure)


def plotting() -> Any:
    """matplotlib.pyplot without a screen, or None where matplotlib is not installed."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ModuleNotFoundError:
        return None
    return plt
