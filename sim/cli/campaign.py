"""`sortie campaign`: fly thousands of sorties, continue an interrupted campaign, write its report."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bar
from typer.core import TyperGroup

import sortie
from sortie.scenarios.exit_codes import ENDED, FAILED, INTERRUPTED
from sortie.sim.cli.console import err, out, print_written
from sortie.sim.experiment.signals import EndedError, ended_by_sigterm

if TYPE_CHECKING:
    from sortie.scenarios.reading.campaign import Study
    from sortie.sim.experiment.drive import Progress


class _RunIsMeant(TyperGroup):
    """`sortie campaign FILE` is `sortie campaign run FILE`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in {*self.commands, "--help"}:
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunIsMeant,
    no_args_is_help=True,
    help="Monte Carlo: `sortie campaign FILE` flies a campaign, `sortie campaign report DIR` writes its report.",
)


@app.command("run")
def run(
    context: typer.Context,
    campaign: Annotated[str, typer.Argument(help="A campaign file, or a library campaign's name.")],
    workers: Annotated[
        int | None, typer.Option(help="Number of worker processes, at least one; default: one per core.", min=0)
    ] = None,
    scheduler: Annotated[str | None, typer.Option(help="Use a running dask cluster: tcp://host:8786.")] = None,
    security: Annotated[
        tuple[Path, Path, Path] | None,
        typer.Option(
            metavar="CA CERT KEY",
            help="With --scheduler: PEM files of the authority's certificate, your certificate, its key.",
        ),
    ] = None,
    worker_memory: Annotated[
        float | None,
        typer.Option(
            metavar="GB",
            help="Memory that a worker may take; a run that needs more is a failed run. Default: this machine's memory divided "
            "by the workers; on a cluster that is joined, what its workers were started with.",
        ),
    ] = None,
    wait_for_workers: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="With --scheduler: how long to wait while the cluster has no workers.", min=0
        ),
    ] = 300.0,
    by_torch: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Fly the first N draws (replications if nothing is drawn) by the torch detector as well, and estimate its "
            "means over all draws, with the surrogate's sorties as a control variate.",
        ),
    ] = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="The campaign's folder; default: runs/campaign-NAME.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Only continue a campaign; fail if the folder has none.")
    ] = False,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Fly failed runs again.")] = False,
    report_: Annotated[bool, typer.Option("--report/--no-report", help="Write the report at the end.")] = True,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Fly nothing: print how many runs there are, and how long they will take.")
    ] = False,
) -> None:
    """Fly a campaign. After an interruption, the same command continues it and gives the same table."""
    folder = out_dir
    try:
        with ended_by_sigterm():
            from sortie._api import campaign_folder
            from sortie.scenarios.reading.campaign import load_campaign
            from sortie.sim.cli.options import refuse
            from sortie.sim.folders import RunError

            if scheduler is None:
                refuse(context, ("security", "wait_for_workers"), "--scheduler")
            elif workers is not None:
                raise RunError("--workers and --scheduler: name one of them")
            study = load_campaign(campaign)
            if dry_run:
                return _print_plan(study, workers)
            name = study.campaign.campaign
            folder = out_dir or campaign_folder(name)
            with _bar(name) as show:
                done = sortie.campaign(
                    campaign,
                    out=folder,
                    workers=workers,
                    scheduler=scheduler,
                    security=security,
                    worker_memory_gb=worker_memory,
                    wait_for_workers_s=wait_for_workers,
                    by_torch=by_torch,
                    resume=resume,
                    retry_failed=retry_failed,
                    progress=show,
                    notice=_notice,
                )
    except KeyboardInterrupt as end:
        where = "" if folder is None else f" in {folder}"
        what, code = ("ended by SIGTERM", ENDED) if isinstance(end, EndedError) else ("interrupted", INTERRUPTED)
        err.print(f"{what}; what is finished is kept{where}, the same command goes on", soft_wrap=True)
        raise typer.Exit(code) from None
    out.print(_in_words(done), soft_wrap=True)
    if report_:
        report(folder)
    else:
        print_written("kept in", folder)
    if done.failed:
        raise typer.Exit(FAILED)


@app.command("report")
def report(folder: Annotated[Path, typer.Argument(help="A campaign's folder.")]) -> None:
    """Write report.md, report.html and their figures from the finished runs."""
    from sortie.sim.experiment.report import write_report
    from sortie.sim.experiment.store import TABLE

    path = write_report(folder)
    print_written("report written to", path, f", rows in {folder / TABLE}")


def _print_plan(study: Study, workers: int | None) -> None:
    from sortie.sim.experiment import estimate
    from sortie.sim.experiment.plan import make_plan
    from sortie.sim.user_errors import user_errors

    with user_errors():
        plan = make_plan(study)
        seconds = estimate.run_s(plan)
    out.print(estimate.in_words(plan, seconds, workers or len(os.sched_getaffinity(0))), soft_wrap=True)


def _notice(line: str) -> None:
    err.print(line, style="yellow", soft_wrap=True)


def _in_words(done: sortie.CampaignResult) -> str:
    failed = f", {done.failed} failed" if done.failed else ""
    speed = (
        f"; {done.flown} of them now, {60 * done.flown / done.seconds:.1f} a minute"
        if done.flown
        else ", none of them now"
    )
    return f"{done.finished} runs finished{failed}{speed}"


@contextmanager
def _bar(name: str) -> Iterator[Callable[[Progress], None]]:
    """A progress bar with throughput and time left. It prints nothing without a terminal."""
    columns = (
        TextColumn(name, markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Bar(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task("starting", total=None)

        def show(p: Progress) -> None:
            left = "" if math.isinf(p.left_s) else f", {p.left_s / 60:.0f} min left"
            failed = f", {p.failed} failed" if p.failed else ""
            text = f"{'by torch, ' * p.by_torch}{60 * p.per_second:.0f} a minute{left}{failed}"
            bar.update(task, completed=p.finished, total=p.of, description=text)

        yield show
