"""`sortie export`: a run in the formats of other tools."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer

from sortie.scenarios.traces import TraceError
from sortie.sim.cli.console import print_written
from sortie.sim.cli.options import ReplaceOption
from sortie.sim.export.endpoint import read_key
from sortie.sim.export.origin import parse_origin
from sortie.sim.folders import RunError, ensure_files, ensure_folder
from sortie.sim.results import run_folder
from sortie.sim.results.run_files import BAG, PCAP, TLOG

BEGIN = "2026-01-01T00:00:00"
"""When a sortie is said to have begun, where nobody says otherwise: the clock starts at zero, and many tools refuse 1970."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def export(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Write a ROS 2 bag: a folder with metadata.yaml and one .mcap file.")
    ] = False,
    tlog: Annotated[
        bool, typer.Option("--tlog", help="Write a MAVLink telemetry log: one file, one system id per drone.")
    ] = False,
    pcap: Annotated[
        bool, typer.Option("--pcap", help="Write a packet capture for Wireshark: RTPS over UDP, one file.")
    ] = False,
    out_path: Annotated[Path | None, typer.Option("--out", help="Output path; default: in the run's folder.")] = None,
    begin: Annotated[str, typer.Option(help="Start time of the sortie, ISO 8601; UTC without a zone.")] = BEGIN,
    origin: Annotated[
        str | None,
        typer.Option(
            help="With --tlog and --mcap: LATITUDE,LONGITUDE[,ALTITUDE] of the coordinates' origin, ENU (0, 0, 0). Default: fleet.origin; else the place where a trace in latitude and longitude begins; else a field in Zurich."
        ),
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="With --tlog: sign the frames with the key in this file (32 bytes or 64 hex digits)."
        ),
    ] = None,
    drone: Annotated[
        int | None, typer.Option(help="With --tlog: write this drone alone; default: all drones.", min=0)
    ] = None,
    replace: ReplaceOption = False,
) -> None:
    """Write a run for other tools: a ROS 2 bag (also for Foxglove), a log for ground stations, or a packet capture.

    A file that exists and was not written by `sortie export` needs --replace.
    """
    if mcap + tlog + pcap != 1:
        raise typer.BadParameter("name one format: --mcap, --tlog or --pcap")
    if key is not None and not tlog:
        raise typer.BadParameter("--key signs --tlog alone")
    if origin is not None and pcap:
        raise typer.BadParameter("--origin places --tlog and --mcap alone")
    if drone is not None and not tlog:
        raise typer.BadParameter("--drone selects from --tlog alone")
    # ROS counts seconds in 32 bits, signatures from 2015 on; beyond 2096 a log's stamps are no times
    first, end = (1970, 2038) if mcap or pcap else (2015 if key is not None else 1970, 2096)
    began_us = (moment(begin, first, end) - EPOCH) // timedelta(microseconds=1)
    where = None if origin is None else parse_origin(origin)
    if tlog:
        from sortie.sim.export.telemetry import MARK, save_tlog

        path, secret = out_path or run / TLOG, None if key is None else read_key(key)
        ensure_files(path, replace=replace, mark=MARK)
        try:
            frames = save_tlog(run_folder.load(run), path, began_us, where, secret, drone)
        except TraceError as error:
            raise RunError(f"{error}; the log's origin is in it, or --origin names one") from error
        print_written(f"{frames} MAVLink frames, in", path)
        return
    if pcap:
        from sortie.sim.export.pcap import MARK, write_pcap

        path = out_path or run / PCAP
        ensure_files(path, replace=replace, mark=MARK)
        sent = write_pcap(run_folder.load(run), path, began_us * 1000)
        parts = ", ".join(f"{count} {kind}" for kind, count in sent.items())
        print_written(f"{sum(sent.values())} packets ({parts}), in", path)
        return
    from sortie.sim.export.foxglove import LAYOUT

    path = out_path or run / BAG
    path = path if path.name.strip(".") else path.resolve()  # the bag is called as its folder is
    ensure_folder(path, LAYOUT, "bag", {"metadata.yaml", f"{path.name}.mcap", LAYOUT})
    record = run_folder.load(run)
    try:
        from sortie.sim.export.bag import write_bag

        counts = write_bag(record, path, began_us * 1000, where)
    except TraceError as error:
        raise RunError(f"{error}; the bag's origin is in it, or --origin names one") from error
    print_written(f"{sum(counts.values())} messages on {len(counts)} topics, in", path)
    print_written("layout for Foxglove, in", path / LAYOUT)


def moment(text: str, first: int, end: int) -> datetime:
    """A time as ISO 8601, from the first year to before the end's; UTC where it names no zone.

    Raises:
        RunError: it is none, or one that stamps cannot tell, naming it.
    """
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise RunError(f"begin is {text!r}, must be a time as in {BEGIN}") from None
    when = when if when.tzinfo is not None else when.replace(tzinfo=UTC)
    if not datetime(first, 1, 1, tzinfo=UTC) <= when < datetime(end, 1, 1, tzinfo=UTC):
        raise RunError(f"begin is {text!r}, must lie from {first} to before {end}")
    return when
