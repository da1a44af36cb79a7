"""`sortie import`: logs of real flights as a context trace, and a scenario that flies it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from sortie.fleet.energy.cell import MEAN_CELL_V
from sortie.fleet.logs.geodesy import Origin, geodetic, local_enu
from sortie.scenarios.errors import SortieError
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Battery
from sortie.sim.cli.console import out
from sortie.sim.export.origin import parse_origin
from sortie.sim.folders import RunError, ensure_folder, write_text, writing

if TYPE_CHECKING:
    from sortie.fleet.logs.flightlog import FlightLog

Array = np.ndarray[Any, Any]

TRACE, SCENARIO = "trace.parquet", "scenario.yaml"
MADE = "made by `sortie import`"
"""By which its scenarios are known."""
LONGEST_S = 7200.0
LEAST_SOC = 0.001
"""What a flight's charge is held at least at: an estimate of nothing left grounds a drone, and it flew on."""
LOWEST_M = 2.0
"""Default height of the flight's lowest point above the flat ground of the simulator's town."""


def import_log(
    logs: Annotated[
        list[Path],
        typer.Argument(
            help="ArduPilot's .bin, MAVLink telemetry (.tlog) or PX4's .ulg; several files become one fleet."
        ),
    ],
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
            help="With one log: MAVLink system id of a vehicle to take; repeat it for more. Default: every vehicle.",
            min=1,
            max=255,
        ),
    ] = None,
    together: Annotated[
        bool, typer.Option("--together", help="Let all logs begin at the same time, whatever their clocks say.")
    ] = False,
    ground: Annotated[
        list[str] | None,
        typer.Option(
            help="Add a ground station at LATITUDE,LONGITUDE[,ALTITUDE]; repeat it for more. Without an altitude its antenna is 2 m above the ground."
        ),
    ] = None,
) -> None:
    """Turn flight logs into one context trace (pose, velocity, battery, signal) and a scenario that flies it.

    Telemetry of several vehicles becomes several drones, by ascending system id; several logs become several drones, in
    the order in which they are named. Their clocks are joined by the UTC of their GNSS, or of the ground computer that
    wrote the telemetry. Gaps, restarts, damaged and missing messages are reported and skipped. Gaps are empty cells of
    the trace.
    """
    from sortie.fleet.logs.logtrace import write_trace

    folder = out_dir or Path(slug(logs[0]))
    ensure_folder(folder, SCENARIO, "flight", {TRACE, SCENARIO})
    if (folder / SCENARIO).is_file() and MADE not in (folder / SCENARIO).read_text("utf-8", "replace"):
        raise RunError(f"{folder}: its {SCENARIO} is none that sortie import wrote; choose another folder or move it")
    flights, columns, text = flown_log(
        logs, folder, rate, from_s, until_s, lift, system or (), together=together, ground=ground or ()
    )
    with writing(folder) as new:
        new.mkdir()
        write_trace(new / TRACE, columns)
        write_text(new / SCENARIO, text)
    rows, first = len(columns["t_s"]), flights[0]
    kinds = " and ".join(dict.fromkeys(flight.kind for flight in flights))
    out.print(f"{kinds}, {first.duration_s:.1f} s; {rows} rows at {rate:g} Hz of {described(columns)}", soft_wrap=True)
    if len(flights) > 1:
        who = ", ".join(f"drone {drone} is {_called(flight, flights)}" for drone, flight in enumerate(flights))
        out.print(f"{len(flights)} vehicles: {who}", soft_wrap=True)
    for line in told(flights, columns):
        out.print(f"  {line}", style="yellow", soft_wrap=True)
    out.print(f"sortie fly {folder / SCENARIO}", soft_wrap=True)


def flown_log(
    logs: Sequence[Path],
    folder: Path,
    rate: float = 10.0,
    from_s: float = 0.0,
    until_s: float | None = None,
    lift: float | None = None,
    systems: Sequence[int] = (),
    *,
    together: bool = False,
    ground: Sequence[str] = (),
) -> tuple[Sequence[FlightLog], dict[str, Array], str]:
    """The logs' flights, their trace, and the scenario that flies it from `folder`; nothing is written.

    Raises:
        SortieError: a log cannot be read or flown; the message names it.
    """
    from sortie.fleet.logs.flightlog import read_logs  # here: scipy's rotations and pyarrow are for this command alone
    from sortie.fleet.logs.logtrace import beside, context_trace, on_one_clock

    if twice := [log for k, log in enumerate(logs) if log in logs[:k]]:
        raise RunError(f"{twice[0]}: is named twice")
    if systems and len(logs) > 1:
        raise RunError("--system chooses from one log, and several are named")
    log = logs[0]
    found = [flight for each in logs for flight in read_logs(each)]
    here = {flight.system: flight for flight in found if flight.system is not None}
    if missing := [number for number in systems if number not in here]:
        has = f"it has {', '.join(map(str, here))}" if here else f"a {found[0].kind} log has no systems"
        raise RunError(f"{log}: no vehicle with system id {missing[0]}, {has}")
    chosen = [here[number] for number in sorted(set(systems))] or found
    flights = beside(on_one_clock(chosen, together=together) if len(logs) > 1 else chosen)
    until = flights[0].duration_s if until_s is None else until_s
    if until - from_s > LONGEST_S:
        raise RunError(f"{log}: {until - from_s:.0f} s to fly, must be at most {LONGEST_S:g}: name --from and --until")
    columns = context_trace(flights, rate, from_s, until)
    if "soc" in columns:
        columns["soc"] = np.maximum(columns["soc"], LEAST_SOC)  # NaN stays
    lifted_m = 0.0
    if "z_m" in columns:
        lifted_m = LOWEST_M - float(np.nanmin(columns["z_m"])) if lift is None else lift
        columns["z_m"] += lifted_m
    zero = _zero(flights, lifted_m) if "x_m" in columns else None
    stations = len(ground)
    if stations:
        if zero is None:
            raise RunError(f"{log}: has no place on the globe, so that --ground cannot be placed beside it")
        columns = _with_stations(columns, ground, zero)
    cells = next((flight.cells for flight in flights if flight.cells is not None), None)
    capacities_ah = [flight.capacity_ah for flight in flights if flight.capacity_ah is not None]
    source = " and the ".join(f"{next(f.kind for f in flights if f.path == each)} log {each.name!r}" for each in logs)
    text = scenario_text(
        slug(log), columns, cells, capacities_ah, folder / TRACE, source, origin=zero, stations=stations
    )
    try:
        loads(text, str(folder / SCENARIO))  # an impossible log is refused before anything is written
    except SortieError as error:
        raise RunError(f"{log}: cannot be flown: {error}") from None
    return flights, columns, text


def _called(flight: FlightLog, flights: Sequence[FlightLog]) -> str:
    """How a flight is called beside others: by its system, and by its file where there are several."""
    if len({each.path for each in flights}) > 1:
        return flight.name
    return f"system {flight.system}"


def _zero(flights: Sequence[FlightLog], lifted_m: float) -> Origin | None:
    """Where on the globe ENU (0, 0, 0) of the trace lies; None where no flight has a place."""
    placed = next((flight for flight in flights if flight.fix is not None), None)
    if placed is None or placed.fix is None:
        return None
    at_s, moved_m = placed.fix.time_s[0], (0.0, 0.0, 0.0)
    if len(flights) == 1 and placed.position is not None:  # the first fix may come after the first place
        at_s = max(at_s, placed.position.time_s[0])
        x, y, z = (float(np.interp(at_s, placed.position.time_s, column)) for column in placed.position.values.T)
        moved_m = (-x, -y, -z)
    latitude, longitude, altitude = (np.interp(at_s, placed.fix.time_s, column) for column in placed.fix.values.T)
    try:
        place = Origin(float(latitude), float(longitude), float(altitude))
        latitude, longitude, altitude = geodetic(moved_m, place)
        return Origin(latitude, longitude, altitude - lifted_m)
    except ValueError:  # at a pole, where damage may lie too
        return None


def _with_stations(columns: dict[str, Array], places: Sequence[str], zero: Origin) -> dict[str, Array]:
    """The columns with a row for each ground station, which are the last drones."""
    first = int(columns["drone"].max()) + 1
    rows = []
    for number, text in enumerate(places):
        place = parse_origin(text)
        x, y, z = local_enu(place.latitude_deg, place.longitude_deg, place.altitude_m, zero)
        z = z if text.count(",") == 2 else LOWEST_M
        rows.append({"t_s": 0.0, "drone": float(first + number), "x_m": x, "y_m": y, "z_m": z})
    return {name: np.concatenate([column, [row.get(name, np.nan) for row in rows]]) for name, column in columns.items()}


def told(flights: Sequence[FlightLog], columns: Mapping[str, Array]) -> list[str]:
    """What was wrong with a log and what its trace lacks; of one of several vehicles, with its system id."""
    each = []
    for drone, flight in enumerate(flights):
        rows = columns["drone"] == drone
        lacks = [text for name, text in LACKING.items() if name not in columns or np.isnan(columns[name][rows]).all()]
        each.append([*flight.problems, *(f"no {text}" for text in lacks)])
    lines = dict.fromkeys(problem for problem in each[0] if all(problem in others for others in each))
    for flight, problems in zip(flights, each, strict=True):
        called = _called(flight, flights)
        lines |= dict.fromkeys(f"{called}: {problem}" for problem in problems if problem not in lines)
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
        "x_m": "position",
        "qx": "attitude",
        "vx_mps": "velocity",
        "soc": "charge",
        "voltage_v": "voltage",
        "current_a": "current",
        "rssi_dbm": "RSSI (dBm)",
        "rssi_percent": "RSSI (percent)",
    }
    return ", ".join(word for name, word in names.items() if name in columns)


def scenario_text(
    name: str,
    columns: Mapping[str, Array],
    cells: int | None,
    capacities_ah: Sequence[float],
    trace: Path,
    source: str,
    *,
    origin: Origin | None = None,
    stations: int = 0,
) -> str:
    """Drones and ground stations that fly the trace, without a detector: the simulator's town is not the flight's place.

    A traced charge never lands one; capacity and cells, where the log tells them, are those of the first pack that can be:
    damage makes capacities of any size.
    """
    battery = []
    if cells is not None:
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
    drones, more = int(columns["drone"].max()) + 1, ""
    if origin is not None:
        more += (
            f"  origin: {{latitude_deg: {origin.latitude_deg:.7f}, longitude_deg: {origin.longitude_deg:.7f}, "
            f"altitude_m: {origin.altitude_m:.2f}}}\n"
        )
    if stations:
        of = ", ".join(f"{{drone: {drone}}}" for drone in range(drones - stations, drones))
        more += f"  ground: [{of}]\n"
    return f"""# A real flight, {MADE} from the {source}.
# The trace holds {described(columns)}; what it lacks is the models'.

name: {name}
duration_s: {columns["t_s"].max():g}

fleet:
  drones: {drones}
  trace: {json.dumps(str(trace.absolute()), ensure_ascii=False)}
  battery: {{{", ".join(battery)}}}
{more}
perception:
  detector: none # the simulator's town is not the place that was flown over
"""
