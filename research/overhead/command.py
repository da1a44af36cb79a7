"""`python -m research overhead`: what the plane costs, in bytes and in time, by the size of the fleet."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from research.overhead.overhead import SCENARIO, SECONDS, host_s, measure
from sortie.sim.cli.console import bars, out
from sortie.sim.cli.options import split_policies
from sortie.sim.folders import RunError
from sortie.sim.identity import machine


def overhead(
    policies: Annotated[
        str, typer.Option(help="Policies, separated by commas: worked,best-2(received_budget=0.1).")
    ] = "worked",
    drones: Annotated[str, typer.Option(help="Fleet sizes, separated by commas.")] = "5,25,100",
    seconds: Annotated[
        float, typer.Option(help="Length of each flight, s, without a detector.", min=1, max=7200)
    ] = SECONDS,
) -> None:
    """Measure the cost of the context plane by fleet size: context and data bytes, and CPU time of a decision."""
    try:
        sizes = [int(n) for n in drones.split(",")]
    except ValueError as error:
        raise RunError(f"--drones {drones!r}, must be whole numbers with commas, as in 5,25,100") from error
    columns = (
        "policy",
        "drones",
        "context KB/s",
        "data MB/s",
        "context share",
        "decides in ms, median",
        "99th percentile",
    )
    table = Table(*columns, title=f"{SCENARIO}, {seconds:g} s")
    for name in split_policies(policies):
        for n in sizes:
            with bars() as bar:
                row = measure(name, n, seconds, progress=bar(f"{name}, {n} drones", seconds))
            table.add_row(
                row.policy, f"{n}", f"{row.context_bytes_per_s / 1e3:.1f}", f"{row.data_bytes_per_s / 1e6:.1f}",
                f"{row.context_share:.2%}", f"{row.p50_ms:.4f}", f"{row.p99_ms:.4f}",
            )  # fmt: skip
    out.print(table)
    out.print(
        f"{machine()}; a million additions in a plain loop take {host_s():.3f} s of CPU time here", soft_wrap=True
    )
