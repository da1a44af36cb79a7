"""`sortie live`: the context plane in real time over DDS, one process per drone."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from sortie.scenarios.exit_codes import INTERRUPTED
from sortie.sim.cli.console import err, out, print_written, stages
from sortie.sim.cli.options import PolicyOption, SetOption, loaded, refuse
from sortie.sim.folders import RunError, ensure_files, write_text

if TYPE_CHECKING:
    from sortie.sim.live.result import LiveResult

MAX_DOMAIN = 230
"""Of DDS: above, ports would run out."""
SHOWN = 20
"""So many changes are printed; `--out` keeps all of them."""


def live(
    context: typer.Context,
    scenario: Annotated[str, typer.Argument(help="A scenario file or a library scenario's name.")] = "paper_replay",
    policy: PolicyOption = None,
    begin: Annotated[float, typer.Option(help="Time of the scenario at which the flight begins, s.", min=0)] = 0.0,
    duration: Annotated[
        float | None, typer.Option(help="Length of the flight, s; default: to the scenario's end.")
    ] = None,
    loss: Annotated[float, typer.Option(help="Share of descriptors that are dropped, 0 to 1.", min=0, max=1)] = 0.0,
    kill: Annotated[
        str | None, typer.Option(metavar="DRONE@SECONDS", help="Kill a drone's process at a time of the scenario: 2@70")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="DRONE@SECONDS", help="Start a drone's process later, or again after --kill: 2@80"),
    ] = None,
    domain: Annotated[
        int | None, typer.Option(help="DDS domain; default: ROS_DOMAIN_ID, or 0.", min=0, max=MAX_DOMAIN)
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Master key of the fleet (32 bytes or 64 hex digits; mode 600). Default: SORTIE_KEY, or a random key.",
        ),
    ] = None,
    fallback: Annotated[
        str,
        typer.Option(
            metavar="RUNG@HZ", help="What links carry while a policy does not answer: detections, tracks, none."
        ),
    ] = "detections@2",
    decide_within: Annotated[
        float | None, typer.Option(help="Longest time for one decision, s; default: one frame.")
    ] = None,
    mavlink: Annotated[
        list[str] | None,
        typer.Option(metavar="ADDRESS", help="A vehicle's MAVLink port, once for each drone: udpin:127.0.0.1:14550"),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON[,ALT]",
            help="With --mavlink: where (0, 0, 0) lies; default: fleet.origin; without either, local positions.",
        ),
    ] = None,
    mavlink_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --mavlink: refuse messages that are not signed with this key (32 bytes or 64 hex digits; mode 600).",
        ),
    ] = None,
    set_: SetOption = None,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write all measurements to this JSON file.")] = None,
) -> None:
    """Run the context plane in real time over DDS: one process for each drone, with publisher, policy node and gate.

    Topics, types and QoS are those of ROS 2, so that its nodes can join: /fleet/context, /drone_0/to_drone_1/directive.
    Ctrl-C ends the flight and prints the measurements.
    """
    if not mavlink:
        refuse(context, ("origin", "mavlink_key"), "--mavlink")
    try:
        number = int(os.environ.get("ROS_DOMAIN_ID", "0")) if domain is None else domain
    except ValueError as error:
        raise RunError(f"ROS_DOMAIN_ID is {os.environ['ROS_DOMAIN_ID']!r}, must be a number") from error
    if not 0 <= number <= MAX_DOMAIN:
        raise RunError(f"ROS_DOMAIN_ID is {number}, must be 0 to {MAX_DOMAIN}")
    killed, started = (
        None if text is None else _drone_at(option, text) for option, text in (("--kill", kill), ("--start", start))
    )
    flown = loaded(scenario, set_, policy)
    from sortie.sim.export.origin import given_origin, parse_origin
    from sortie.sim.live.seals import find_key, read_own_key
    from sortie.sim.live.session import fly_live
    from sortie.sim.live.watchdog import parse_fallback

    ensure_files(out_file)
    with stages() as report:
        result = fly_live(
            flown,
            begin_s=begin,
            duration_s=duration,
            loss=loss,
            kill=killed,
            start=started,
            domain=number,
            key=find_key(key),
            fallback=parse_fallback(fallback),
            decide_within_s=decide_within,
            mavlink=mavlink or (),
            origin=given_origin(flown.fleet) if origin is None else parse_origin(origin),
            mavlink_key=None if mavlink_key is None else read_own_key(mavlink_key),
            warn=lambda text: err.print(text, soft_wrap=True),
            progress=lambda what, done, of: report(what, round(done), round(of)),
        )
    _show(result)
    if out_file is not None:
        write_text(out_file, json.dumps(result.as_json(), indent=2) + "\n")
        print_written("kept in", out_file)
    if result.interrupted:
        err.print(f"interrupted after {result.flown_s:.1f} s")
        raise typer.Exit(INTERRUPTED)


def _drone_at(option: str, text: str) -> tuple[int, float]:
    drone, at, t_s = text.partition("@")
    try:
        if not at:
            raise ValueError
        return int(drone), float(t_s)
    except ValueError as error:
        raise RunError(f"{option} {text!r}, must be a drone and a time, as in 2@70") from error


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.1%}"


def _show(result: LiveResult) -> None:
    from sortie.sim.live.result import overhead_rows
    from sortie.sim.live.sentences import describe_changes

    where = f"{result.begin_s:g}–{result.begin_s + result.flown_s:.0f} s"
    losses = f", {result.loss:.0%} of descriptors lost" if result.loss else ""
    table = Table("overhead of the plane", "", title=f"{result.scenario}, {where}, {result.policy}{losses}")
    for row in overhead_rows(result):
        table.add_row(*row)
    out.print(table)
    columns = ("topic", "QoS", "per s", "kB/s", "heard", "arrived")
    table = Table(*columns, title="on the bus, all keep-last-1")
    for t in result.topics:
        table.add_row(
            t.topics.replace("to_drone_*", "…"),
            t.qos.partition(",")[0],
            f"{t.samples_per_s:.1f}",
            f"{t.bytes_per_s / 1e3:.1f}",
            _share(t.heard_share),
            _share(t.delivered_share),
        )
    out.print(table)
    table = Table(
        "drone", "CPU", "published", "heard", "lost", "refused", "fallback", "publishes within", title="processes"
    )
    for d in result.each:
        refused = ", ".join(f"{n} {why}" for why, n in d.refused.items()) or "0"
        table.add_row(
            f"{d.drone}",
            f"{d.cpu_percent:.1f} %",
            f"{d.published}",
            f"{d.heard}",
            f"{d.dropped_by_loss}",
            refused,
            f"{d.fallbacks}",
            f"{1e3 * d.publishes_within_s:.0f} ms",
        )
    out.print(table)
    lines = describe_changes(result)
    for line in lines[:SHOWN]:
        out.print(line, soft_wrap=True)
    if len(lines) > SHOWN:
        out.print(f"… and {len(lines) - SHOWN} more changes; --out keeps all")
    out.print(f"{result.machine}; {result.decisions} decisions", soft_wrap=True)
