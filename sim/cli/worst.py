"""`sortie campaign worst`: a campaign's worst runs by one of its metrics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sortie.sim.cli.console import out
from sortie.sim.cli.fly import fly as fly_again


def worst(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(help="A campaign's folder.")],
    metric: Annotated[str, typer.Argument(help="One of the campaign's metrics.")],
    count: Annotated[int, typer.Option(help="How many runs to show; at least those of --fly.", min=1)] = 10,
    policy: Annotated[str | None, typer.Option(help="Runs of this policy alone.")] = None,
    most: Annotated[
        bool | None,
        typer.Option("--most/--least", help="Whether high or low values are worse; default: by the metric."),
    ] = None,
    fly: Annotated[
        int, typer.Option(help="Fly this many of them again, into folders below the campaign's.", min=0)
    ] = 0,
) -> None:
    """Show the worst runs by a metric, and the commands that fly them again."""
    from sortie.sim.experiment.worst import worst as find

    found = find(folder, metric, max(count, fly), policy, more_is_worse=most)
    table = Table(
        "run", "policy", *found.varied, metric, title="the most first" if found.more_is_worse else "the least first"
    )
    for row in found.rows:
        varied = (f"{row[name]:.4g}" if isinstance(row[name], float) else str(row[name]) for name in found.varied)
        table.add_row(str(row["run"]), row["policy"], *varied, f"{row[metric]:.4g}")
    out.print(table)
    if found.rows:
        first = found.rows[0]["run"]
        out.print(
            f"see the first with: sortie fly --from-campaign {folder} --run {first} --view",
            soft_wrap=True,
        )
    for row in found.rows[:fly]:
        fly_again(context, campaign=folder, run=row["run"], out_dir=folder / "worst" / f"run-{row['run']}")
