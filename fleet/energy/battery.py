"""What the packs of a fleet still give, and where their energy went.

`FleetBatteries` drains every pack once a frame. A pack's state is the energy left in it, in joules at open circuit;
charge and voltage are read off it. So the ledger's sum and what left the pack are one number, up to rounding. The
cells' chemistry is in `sortie.fleet.energy.cell`, what the rotors draw in `sortie.fleet.flight.rotor`.

Proportion, wherever energy is claimed: hovering draws some 210 W electric, a Wi-Fi radio 2 to 6 W. So what is shared
moves flight time mainly through the duty cycle of perception, hardly through airtime.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence

from sortie.fleet.energy.cell import (
    COOLING_TIME_S,
    LIPO,
    REFERENCE_C,
    STEPS,
    ageing,
    cell_curve,
    current_a,
    heat_capacity_jpk,
    resistance_factor,
)
from sortie.fleet.energy.recorded import BatteryTrace
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.schema import Battery, DroneOverride

CAUSES = ("rotor", "avionics", "compute", "radio", "ohmic", "fault")
"""Ledger of energy: climb is part of rotor, ohmic is lost in the pack's resistance (polarisation's included), fault is
lost at once."""
RECORDED = "recorded"
"""The cause of what a traced drone spent; in the ledger only where a drone is traced."""


def overridden(packs: Sequence[Battery], overrides: Sequence[DroneOverride]) -> list[Battery]:
    """Each drone's pack, with what `fleet.overrides` says of it."""
    own = list(packs)
    for override in overrides:
        changes = override.model_dump(exclude={"drone", "payload_kg"}, exclude_none=True)
        own[override.drone] = own[override.drone].model_copy(update=changes)
    return own


class FleetBatteries:
    """Every drone's pack and its ledger.

    Plain floats in a loop, 2 µs a drone; the same step in numpy took 60 µs for any number, so that it would pay
    from about 33 drones on and save 0.1 ms a frame at 100.

    Attributes, one entry a drone:
        soc: state of charge by charge, 0 … 1.
        voltage_v, current_a: at the terminals during the last step.
        temperature_c: of the pack; it stays at 25 °C unless the scenario gives the air's.
        cells: cells in series that still work.
        landed: on the ground, whether empty, at landing_soc, too weak for its load, cut off, or told to. It draws
            nothing.
        energy_left_j: energy left in the pack, at open circuit.
        energy_j: cause → joules spent so far, per drone.
    """

    def __init__(
        self,
        config: Battery | Sequence[Battery],
        overrides: Sequence[DroneOverride],
        n: int,
        traces: Mapping[int, BatteryTrace] | None = None,
        mains: Container[int] = (),
    ) -> None:
        """Packs of `n` drones at take-off.

        Args:
            config: the fleet's pack, or one for each drone.
            overrides: `fleet.overrides` of the scenario.
            n: number of drones.
            traces: drones whose charge is not modelled but read from a trace.
            mains: members of the fleet that draw from the mains; their packs stay full.
        """
        packs = overridden([config] * n if isinstance(config, Battery) else config, overrides)
        self._mains = {i for i in range(n) if i in mains}
        for i in self._mains:
            packs[i] = packs[i].model_copy(update={"initial_soc": 1.0})
        self._packs, self._now_s = packs, 0.0
        self._loads = [
            (
                p.drivetrain_efficiency,
                p.avionics_w,
                p.compute_idle_w,
                p.compute_active_w - p.compute_idle_w,
                p.radio_idle_w,
                p.radio_tx_w - p.radio_idle_w,
                p.landing_soc,
                p.cutoff_cell_v,
                p.ambient_c is not None,
                p.polarisation.resistance_mohm > 0,
            )
            for p in packs
        ]
        self._traces = {i: trace for i, trace in (traces or {}).items() if i not in self._mains}
        # what a trace says of a charge was turned into energy by the built-in cell
        named = [(pack.cell_model, str(pack.cell_params)) for pack in packs]
        curves = {name: cell_curve(pack) for name, pack in zip(named, packs, strict=True)}
        self._curves = [LIPO if i in self._traces else curves[name] for i, name in enumerate(named)]
        aged = [ageing(pack.cycles, pack.life_cycles) for pack in packs]
        self._full_j = [pack.capacity_wh * 3600.0 * share for pack, (share, _) in zip(packs, aged, strict=True)]
        self._worn = [worse for _, worse in aged]
        self._resistance_ohm = [
            pack.cells * pack.cell_resistance_mohm / 1000.0 * worse
            for pack, worse in zip(packs, self._worn, strict=True)
        ]
        self._polarised_v = [0.0] * n
        self._heat_jpk = [heat_capacity_jpk(pack.capacity_wh) for pack in packs]
        self.cells = [pack.cells for pack in packs]
        self.temperature_c = [REFERENCE_C if pack.ambient_c is None else pack.ambient_c for pack in packs]
        self.soc = [self._traces[i].soc_at(0.0) if i in self._traces else p.initial_soc for i, p in enumerate(packs)]
        self.energy_left_j = [
            full * float(curve.energy_fraction(soc))
            for full, curve, soc in zip(self._full_j, self._curves, self.soc, strict=True)
        ]
        causes = CAUSES if not self._traces else (*CAUSES, RECORDED)
        self.energy_j: dict[str, list[float]] = {cause: [0.0] * n for cause in causes}
        self.voltage_v = [
            float(curve.open_circuit_v(soc)) * in_series
            for curve, soc, in_series in zip(self._curves, self.soc, self.cells, strict=True)
        ]
        self.current_a = [0.0] * n
        self.landed = [soc <= pack.landing_soc for soc, pack in zip(self.soc, packs, strict=True)]
        self.landing_reason = [self._charge(i) if down else "" for i, down in enumerate(self.landed)]
        """In words, for whom the pack brought down."""
        self._kept = [1.0] * n  # of what a trace says, after faults

    @property
    def spent_j(self) -> list[float]:
        """Energy that left each drone's pack since take-off, J: the ledger's sum over all causes."""
        return [plain_sum(causes) for causes in zip(*self.energy_j.values(), strict=True)]

    def step(
        self, dt_s: float, rotor_w: Sequence[float], duty: Sequence[float], airtime_share: Sequence[float]
    ) -> None:
        """Drain every flying drone's pack for `dt_s`; packs on the ground take on the temperature of the air.

        Args:
            dt_s: length of the step, s.
            rotor_w: power at the rotors, climb included, before the drivetrain's losses.
            duty: share of the step in which perception runs, 0 … 1.
            airtime_share: share of the step in which the radio sends, 0 … 1.

        A drone whose pack cannot deliver the power lands at once and draws nothing in this step; one that reaches
        landing_soc, falls below cutoff_cell_v, or empties, lands at the step's end.
        """
        loads, left, soc, landed = self._loads, self.energy_left_j, self.soc, self.landed
        full_j, pack_ohm, pack_cells, traces = self._full_j, self._resistance_ohm, self.cells, self._traces
        mains, curves = self._mains, self._curves
        voltage_v, current_a_, polarised_v = self.voltage_v, self.current_a, self._polarised_v
        rotor_j, avionics_j, compute_j = self.energy_j["rotor"], self.energy_j["avionics"], self.energy_j["compute"]
        radio_j, ohmic_j = self.energy_j["radio"], self.energy_j["ohmic"]
        self._now_s += dt_s
        for i, down in enumerate(landed):
            if mains and i in mains:
                continue
            if down:
                if self._packs[i].ambient_c is not None:
                    self._warm(i, 0.0, dt_s)
                continue
            if traces and i in traces:
                self._follow(i, dt_s)
                continue
            full, cells, resistance = full_j[i], pack_cells[i], pack_ohm[i]
            efficiency, avionics, idle, active, listen, send, landing_soc, cutoff_cell_v, thermal, polarises = loads[i]
            warmth = 1.0
            at = left[i] / full * STEPS
            k = int(at)
            soc_table, volt_table = curves[i][:2]
            ocv = cells * (volt_table[k] + (at - k) * (volt_table[k + 1] - volt_table[k]))
            if thermal:
                warmth = resistance_factor(self.temperature_c[i])
                resistance *= warmth
            lag = cells * polarised_v[i]
            rotor = rotor_w[i] / efficiency
            compute = idle + duty[i] * active
            radio = listen + airtime_share[i] * send
            power = rotor + avionics + compute + radio
            current = current_a(power, ocv - lag, resistance)
            if current is None:
                self.land(i, f"the pack cannot give {power:.0f} W")
                continue
            ohmic = current * current * resistance + current * lag
            spent = (power + ohmic) * dt_s
            lasts_s = dt_s
            if spent >= left[i]:  # the pack is empty before the step is over
                lasts_s, spent = dt_s * left[i] / spent, left[i]
            rotor_j[i] += rotor * lasts_s
            avionics_j[i] += avionics * lasts_s
            compute_j[i] += compute * lasts_s
            radio_j[i] += radio * lasts_s
            ohmic_j[i] += ohmic * lasts_s
            left[i] -= spent
            current_a_[i] = current
            voltage_v[i] = voltage = ocv - lag - current * resistance
            if polarises:
                self._polarise(i, current * warmth, dt_s)
            if thermal:
                self._warm(i, ohmic, dt_s)
            at = left[i] / full * STEPS
            k = int(at)
            soc[i] = soc_table[k] + (at - k) * (soc_table[k + 1] - soc_table[k])
            if voltage < cutoff_cell_v * cells and soc[i] > landing_soc:
                self.land(i, f"{voltage / cells:.2f} V a cell, cut off below {cutoff_cell_v:g} V")
            elif soc[i] <= landing_soc:
                self.land(i)

    def fault(self, drone: int, lost_fraction: float) -> None:
        """Lose a fraction of the remaining energy at once; the drone lands if too little is left. The mains lose none.

        Raises:
            ValueError: lost_fraction outside 0 … 1.
        """
        if not 0 <= lost_fraction <= 1:
            raise ValueError(f"lost_fraction is {lost_fraction}, must be in [0, 1]")
        if drone in self._mains:
            return
        self._lose(drone, lost_fraction)
        self._kept[drone] *= 1.0 - lost_fraction
        self._read_off(drone)
        if self.soc[drone] <= self._packs[drone].landing_soc:
            self.land(drone)

    def drop_cell(self, drone: int) -> None:
        """A cell in series fails as a short: its voltage, its energy and its resistance are gone, the others keep
        their charge. Lower voltage draws more current for the same power. The last cell's loss lands the drone."""
        if self.cells[drone] == 1:
            self.fault(drone, 1.0)
            self.land(drone)
            return
        gone = 1.0 / self.cells[drone]
        self._lose(drone, gone)
        self._full_j[drone] *= 1.0 - gone
        self._resistance_ohm[drone] *= 1.0 - gone
        self.cells[drone] -= 1
        self._read_off(drone)

    def land(self, drone: int, reason: str = "") -> None:
        """Take a drone out of the air; its pack is at rest. `reason` is left out where its charge is the reason."""
        self.landed[drone] = True
        self.landing_reason[drone] = reason or self._charge(drone)
        self.current_a[drone] = 0.0
        self._polarised_v[drone] = 0.0
        self._read_off(drone)

    def take_off(self, drone: int) -> None:
        """Put a drone into the air, unless its charge would land it at once."""
        if drone in self._traces:
            self._spend_recorded(drone)
        self.landed[drone] = self.soc[drone] <= self._packs[drone].landing_soc
        self.landing_reason[drone] = self._charge(drone) if self.landed[drone] else ""

    def _charge(self, drone: int) -> str:
        return f"charge {self.soc[drone]:.1%}"

    def _lose(self, drone: int, fraction: float) -> None:
        lost = self.energy_left_j[drone] * fraction
        self.energy_left_j[drone] -= lost
        self.energy_j["fault"][drone] += lost

    def _polarise(self, drone: int, current_a: float, dt_s: float) -> None:
        """One RC element a cell, exact for a constant current; its resistance ages with the rest, and `current_a` has
        the cold in it."""
        config = self._packs[drone]
        towards_v = current_a * config.polarisation.resistance_mohm / 1000.0 * self._worn[drone]
        fades = math.exp(-dt_s / config.polarisation.time_s)
        self._polarised_v[drone] = towards_v + (self._polarised_v[drone] - towards_v) * fades

    def _warm(self, drone: int, lost_w: float, dt_s: float) -> None:
        """What the resistance takes warms the pack, the air cools it."""
        ambient_c, heat = self._packs[drone].ambient_c, self._heat_jpk[drone]
        assert ambient_c is not None  # noqa: S101
        equilibrium_c = ambient_c + lost_w * COOLING_TIME_S / heat
        fades = math.exp(-dt_s / COOLING_TIME_S)
        self.temperature_c[drone] = equilibrium_c + (self.temperature_c[drone] - equilibrium_c) * fades

    def _follow(self, drone: int, dt_s: float) -> None:
        """Charge, voltage and current as the trace has them; what was spent is one cause of the ledger."""
        trace, now_s = self._traces[drone], self._now_s
        spent_j = self._spend_recorded(drone)
        voltage_v = trace.voltage_at(now_s)
        if voltage_v is not None:
            self.voltage_v[drone] = voltage_v
        current = trace.current_at(now_s)
        if current is None:  # a trace may say 0 V, which tells nothing of the current
            current = spent_j / dt_s / self.voltage_v[drone] if self.voltage_v[drone] else 0.0
        self.current_a[drone] = current
        if self.soc[drone] <= self._packs[drone].landing_soc:
            self.land(drone)

    def _spend_recorded(self, drone: int) -> float:
        """Take what the trace says was spent by now, J, since the last call."""
        left_j = self._full_j[drone] * self._kept[drone] * self._traces[drone].energy_fraction_at(self._now_s)
        spent_j = max(0.0, self.energy_left_j[drone] - left_j)
        self.energy_left_j[drone] -= spent_j
        self.energy_j[RECORDED][drone] += spent_j
        self.current_a[drone] = 0.0
        self._read_off(drone)
        return spent_j

    def _read_off(self, drone: int) -> None:
        """Charge, and the voltage at the present current, from the energy left; 0 V where the pack no longer gives it."""
        at = self.energy_left_j[drone] / self._full_j[drone] * STEPS
        k = int(at)
        cells, (soc, volts) = self.cells[drone], self._curves[drone][:2]
        self.soc[drone] = soc[k] + (at - k) * (soc[k + 1] - soc[k])
        open_v = cells * (volts[k] + (at - k) * (volts[k + 1] - volts[k]))
        resistance = self._resistance_ohm[drone] * resistance_factor(self.temperature_c[drone])
        lag_v = cells * self._polarised_v[drone]
        self.voltage_v[drone] = max(0.0, open_v - lag_v - self.current_a[drone] * resistance)
