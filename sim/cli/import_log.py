"""`sortie import`: a real flight's log as a context trace, and a scenario that flies it."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from sortie.fleet.energy.cell import MEAN_CELL_V
from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Battery
from sortie.sim.cli.console import out
from sortie.sim.folders import RunError, ensure_folder, replacing, write_text
from sortie.sim.user_errors import user_errors

if TYPE_CHECKING:
    from sortie.fleet.logs.flightlog import FlightLog

Array = np.ndarray[Any, Any]

TRACE, SCENARIO = "trace.parquet", "scenario.yaml"
MADE = "made by `sortie import`"
"""By which its scenarios are known."""
FULL_CELL_V = 4.25
LONGEST_S = 7200.0
LEAST_SOC = 0.001
"""What a flight's charge is held at least at: an estimate of nothing left grounds a drone, and it flew on."""
LOWEST_M = 2.0
"""Default height of the flight's lowest point above the flat ground of the simulator's town."""


def import_log(
    log: Annotated[Path, typer.Argument(help="ArduPilot's .bin, MAVLink telemetry (.tlog) or PX4's .ulg.")],
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for the trace and the scenario; default: named after the log.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Rows per second in the trace.", min=0.1, max=1000)] = 10.0,
    from_s: Annotated[float, typer.Option("--from", help="Start, in seconds of the log.", min=0)] = 0.0,
    until_s: Annotated[
        float | None, typer.Option("--until", help="End, in seconds of the log; default: its end.", min=0)
    ] = None,
    lift: Annotated[
        float | None,
        typer.Option(help="Metres added to every height; default: the lowest point is at 2 m.", min=-1e4, max=1e4),
    ] = None,
    system: Annotated[
        list[int] | None,
        typer.Option(
            help="MAVLink system id of a vehicle to take, once for each; default: every vehicle.", min=1, max=255
        ),
    ] = None,
) -> None:
    """Turn a flight log into a context trace (pose, velocity, battery, signal) and a scenario that flies it.

    Telemetry of several vehicles becomes several drones, by ascending system id. Gaps, restarts, damaged and missing
    messages are reported and skipped. Gaps are empty cells of the trace.
    """
    from sortie.fleet.logs.logtrace import write_trace

    folder = out_dir or Path(slug(log))
    ensure_folder(folder, SCENARIO, "flight", {TRACE, SCENARIO})
    if (folder / SCENARIO).is_file() and MADE not in (folder / SCENARIO).read_text("utf-8", "replace"):
        raise RunError(f"{folder}: its {SCENARIO} is none that sortie import wrote; choose another folder or move it")
    with user_errors():
        flights, columns, text = flown_log(log, folder, rate, from_s, until_s, lift, system or ())
    with replacing(folder) as new, user_errors():
        write_trace(new / TRACE, columns)
        write_text(new / SCENARIO, text)
    rows, first = len(columns["t_s"]), flights[0]
    out.print(
        f"{first.kind}, {first.duration_s:.1f} s; {rows} rows at {rate:g} Hz of {described(columns)}", soft_wrap=True
    )
    if len(flights) > 1:
        who = ", ".join(f"drone {drone} is system {flight.system}" for drone, flight in enumerate(flights))
        out.print(f"{len(flights)} vehicles: {who}", soft_wrap=True)
    for line in told(flights, columns):
        out.print(f"  [yellow]{line}[/yellow]", soft_wrap=True)
    out.print(f"sortie fly {folder / SCENARIO}", soft_wrap=True)


def flown_log(
    log: Path,
    folder: Path,
    rate: float = 10.0,
    from_s: float = 0.0,
    until_s: float | None = None,
    lift: float | None = None,
    systems: Sequence[int] = (),
) -> tuple[Sequence[FlightLog], dict[str, Array], str]:
    """A log's flights, their trace, and the scenario that flies it from `folder`; nothing is written.

    Raises:
        SortieError: the log cannot be read or flown; the message names it.
    """
    from sortie.fleet.logs.flightlog import read_logs  # here: scipy's rotations and pyarrow are for this command alone
    from sortie.fleet.logs.logtrace import beside, context_trace

    found = read_logs(log)
    here = {flight.system: flight for flight in found if flight.system is not None}
    if missing := [number for number in systems if number not in here]:
        has = f"it has {', '.join(map(str, here))}" if here else f"a {found[0].kind} log has no systems"
        raise RunError(f"{log}: no vehicle with system id {missing[0]}, {has}")
    flights = beside([here[number] for number in sorted(set(systems))] or found)
    until = flights[0].duration_s if until_s is None else until_s
    if until - from_s > LONGEST_S:
        raise RunError(f"{log}: {until - from_s:.0f} s to fly, must be at most {LONGEST_S:g}: name --from and --until")
    columns = context_trace(flights, rate, from_s, until)
    if "soc" in columns:
        columns["soc"] = np.maximum(columns["soc"], LEAST_SOC)  # NaN stays
    if "z_m" in columns:
        columns["z_m"] += LOWEST_M - float(np.nanmin(columns["z_m"])) if lift is None else lift
    capacities_ah = [flight.parameters.get("BATT_CAPACITY", 0.0) / 1000 for flight in flights]
    source = f"{flights[0].kind} log {log.name!r}"
    text = scenario_text(slug(log), columns, capacities_ah, folder / TRACE, source)
    try:
        loads(text, str(folder / SCENARIO))  # an impossible log is refused before anything is written
    except SortieError as error:
        raise RunError(f"{log}: cannot be flown: {error}") from None
    return flights, columns, text


def told(flights: Sequence[FlightLog], columns: Mapping[str, Array]) -> list[str]:
    """What was wrong with a log and what its trace lacks; of one of several vehicles, with its system id."""
    each = []
    for drone, flight in enumerate(flights):
        rows = columns["drone"] == drone
        lacks = [text for name, text in LACKING.items() if name not in columns or np.isnan(columns[name][rows]).all()]
        each.append([*flight.problems, *(f"no {text}" for text in lacks)])
    lines = dict.fromkeys(problem for problem in each[0] if all(problem in others for others in each))
    for flight, problems in zip(flights, each, strict=True):
        lines |= dict.fromkeys(f"system {flight.system}: {problem}" for problem in problems if problem not in lines)
    return list(lines)


LACKING = {
    "x_m": "position in it: the drone flies the scenario's route",
    "soc": "charge in it: the battery is the model's",
}


def slug(log: Path) -> str:
    """A scenario's name from a file's."""
    return re.sub(r"[^a-z0-9]+", "_", log.stem.lower()).strip("_")[:64] or "flight"


def described(columns: Mapping[str, Array]) -> str:
    """What a trace has, in words."""
    names = {
        "x_m": "position", "qx": "attitude", "vx_mps": "velocity", "soc": "charge", "voltage_v": "voltage",
        "current_a": "current", "rssi_dbm": "RSSI (dBm)", "rssi_percent": "RSSI (percent)",
    }  # fmt: skip
    return ", ".join(word for name, word in names.items() if name in columns)


def scenario_text(
    name: str, columns: Mapping[str, Array], capacities_ah: Sequence[float], trace: Path, source: str
) -> str:
    """Drones that fly the trace, without a detector: the simulator's town is not the flight's place.

    A traced charge never lands one; capacity and cells, where the log tells them, are those of the first pack that can be:
    damage makes capacities of any size.
    """
    battery = []
    if "voltage_v" in columns:
        cells = min(max(math.ceil(float(np.nanmax(columns["voltage_v"])) / FULL_CELL_V), 1), 24)
        battery.append(f"cells: {cells}")
        capacities_wh = (each * cells * MEAN_CELL_V for each in capacities_ah)
        bounds: list[Any] = Battery.model_fields["capacity_wh"].metadata
        most_wh = next(bound.le for bound in bounds if hasattr(bound, "le"))
        if capacity_wh := next(
            (each for each in capacities_wh if 0.05 <= each <= most_wh), None
        ):  # 0.0 to a digit is none
            battery.append(f"capacity_wh: {capacity_wh:.1f}")
    if "soc" in columns:
        battery.append("landing_soc: 0")
    return f"""# A real flight, {MADE} from the {source}.
# The trace holds {described(columns)}; what it lacks is the models'.

name: {name}
duration_s: {columns["t_s"][-1]:g}

fleet:
  drones: {int(columns["drone"].max()) + 1}
  trace: {json.dumps(str(trace.absolute()), ensure_ascii=False)}
  battery: {{{", ".join(battery)}}}

perception:
  detector: none # the simulator's town is not the place that was flown over
"""
