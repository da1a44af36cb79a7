"""`python -m research study`: train, measure and report the study of why the flip exists."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from sortie.scenarios.regular import regular
from sortie.sim.cli.console import out, print_written, stages
from sortie.sim.cli.options import DeviceOption, WorkersOption
from sortie.sim.folders import RunError, ensure_folder, write_text, writing
from sortie.sim.readme import with_section

if TYPE_CHECKING:
    from research.flip.measure import StudyRow

study = typer.Typer(
    no_args_is_help=True,
    help="The study of the flip (does the best choice of peers change with the budget?): train, measure, report.",
)
TABLE, REPORT = "study.parquet", "README.md"
WorkOption = Annotated[Path, typer.Option("--work", help="Folder for weights, checkpoints and finished frames.")]
NetworkOption = Annotated[
    list[str] | None,
    typer.Option("--network", help="Measure this network of the plan. Can be given several times. Default: all."),
]
BenchOption = Annotated[Path, typer.Option("--bench", help="Folder of benchmarks.")]


@study.command("train")
def study_train(
    jobs: Annotated[list[str] | None, typer.Argument(help="Networks, for example dropout-1; default: all.")] = None,
    work: WorkOption = Path("runs/study"),
    bench_dir: BenchOption = Path("runs/bench"),
) -> None:
    """Train the networks that have no weights yet, one after the other. Each continues from its checkpoint."""
    from research.flip.plan import read_plan
    from research.flip.run import SHIPPED, train_job

    plan = read_plan()
    for job in jobs or [v.job(s) for v, s in plan.jobs()]:
        with stages(f"{job}: ") as progress:
            result = train_job(plan, job, work, bench_dir, shipped=SHIPPED, progress=progress)
        if result is None:
            out.print(f"{job} has its weights")
        else:
            gain = result.validation
            out.print(f"{job} AP@0.5 alone {gain.ap_a:.3f}, all five {gain.ap_b:.3f}")


@study.command("run")
def study_run(
    work: WorkOption = Path("runs/study"),
    bench_dir: BenchOption = Path("runs/bench"),
    frames: Annotated[int, typer.Option(help="Use this many frames of the test split, from the first.", min=2)] = 80,
    network: NetworkOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = None,
) -> None:
    """Measure the networks that have weights, and write the rows."""
    from research.flip.measure import StudyRow, to_table
    from research.flip.plan import read_plan
    from research.flip.run import SHIPPED, measure
    from research.train.devices import measuring_device

    plan, rows = read_plan(), list[StudyRow]()
    with stages() as progress:
        where = measuring_device(device)
        cores = workers or os.cpu_count() or 1
        measured = measure(
            plan,
            work,
            bench_dir,
            shipped=SHIPPED,
            frames=frames,
            networks=network,
            workers=cores,
            device=where,
            progress=progress,
        )
        for job, some in measured:
            rows += some
            out.print(f"{job} measured")
    if not rows:
        raise RunError(f"{work}: no network of the study has weights yet; `python -m research study train` makes them")
    path = work / TABLE
    _write_table(to_table(rows), path)
    print_written("kept in", path, f", write the report with: python -m research study report {path}")


@study.command("report")
def study_report(
    table: Annotated[Path, typer.Argument(help="Rows of `python -m research study run`.")] = Path("runs/study") / TABLE,
    out_dir: Annotated[Path, typer.Option("--out", help="Folder for README.md, figures and the rows.")] = Path(
        "research/pages/study"
    ),
    readme: Annotated[
        Path | None, typer.Option(help="Write the study's sentences between the markers of this Markdown file.")
    ] = None,
) -> None:
    """Write the study's report as Markdown with figures, and its rows as Parquet."""
    from research.flip import figures, report
    from research.flip.measure import to_table
    from research.flip.plan import read_plan
    from research.paper import figures as common

    plan = read_plan()
    drawn: list[tuple[str, str]] = []
    ensure_folder(out_dir, TABLE, "report", {REPORT, TABLE, *figures.CAPTIONS})
    if readme is not None:
        with_section(readme, report.BEGIN + report.END, report.BEGIN, report.END)  # its errors come first
    rows = _read_rows(table)
    with writing(out_dir) as folder:
        folder.mkdir()
        _write_table(to_table(rows), folder / TABLE)
        if common.available():
            drawn = figures.draw_all(plan, rows, folder)
        (folder / REPORT).write_text(report.report(plan, rows, drawn), encoding="utf-8")
    if readme is not None:
        link = Path(os.path.relpath(out_dir.resolve() / REPORT, readme.resolve().parent)).as_posix()
        section = report.short(plan, rows, link)
        write_text(readme, with_section(readme, section, report.BEGIN, report.END))
        print_written("the study's sentences in", readme, " written")
    for line in report.answers(plan, report.StudyRows(rows)):
        out.print(line)
    if not drawn:
        out.print("no figures: they need matplotlib, as in pip install 'sortie-sim[report]'")
    print_written("kept in", out_dir)


@study.command("doses")
def study_doses(
    work: WorkOption = Path("runs/study"),
    bench_dir: BenchOption = Path("runs/bench"),
    frames: Annotated[
        list[str] | None,
        typer.Option(
            help="Benchmark seed, first and last frame of its test split: 7:0-239. Can be given several times. Default: the plan's."
        ),
    ] = None,
    network: NetworkOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = None,
) -> None:
    """Measure whether the paper's flip appears when peers that sent nothing get more weight in the fusion."""
    from research.flip import dose_figure, doses
    from research.flip.dose_run import measure
    from research.flip.run import chosen
    from research.paper import figures as common
    from research.train.devices import measuring_device
    from sortie.scenarios.report_text import interval, signed

    plan, rows = doses.read_plan(), list[doses.DoseRow]()
    plan = replace(plan, networks=tuple(chosen(plan.networks, network)))
    budgets = [f"two − four, {budget:g}" for budget in (0.0, *plan.budgets)]
    heads = ("network", "dose", "weight on zeros", f"starved, {plan.starved:g}", *budgets)
    where = measuring_device(device)
    ranges = None if frames is None else [doses.FrameRange.parse(text) for text in frames]
    with stages() as progress:
        cores = workers or os.cpu_count() or 1
        for row in measure(plan, work, bench_dir, frames=ranges, workers=cores, device=where, progress=progress):
            rows.append(row)
    table = Table(*heads, title=f"{rows[0].frames} frames; AP points with 95 % intervals over frames")
    for row in rows:
        effects = [interval(e.value, e.low, e.high, signed) for e in (row.starved, row.silent, *row.contrasts)]
        table.add_row(row.network, row.dose.label, f"{row.weight_on_zeros:.2f}", *effects)
    out.print(table)
    found = doses.verdicts(rows)
    for k, hypothesis in enumerate(plan.hypotheses):
        holds = [name for name, several in found.items() if several[k]]
        print_written(hypothesis, f"Holds in {len(holds)} of {len(found)}", f": {', '.join(holds) or 'none'}.")
    if common.available():
        path = work / "doses.png"
        common.save(dose_figure.draw(plan, rows), path)
        print_written("figure:", path)


def _read_rows(path: Path) -> list[StudyRow]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from research.flip.measure import from_table

    try:
        return from_table(pq.read_table(regular(path)))
    except (OSError, pa.ArrowInvalid, TypeError) as error:
        raise RunError(f"{path}: not the rows of a study ({error})") from None


def _write_table(table: object, path: Path) -> None:
    import pyarrow.parquet as pq

    with writing(path) as partial:
        pq.write_table(table, partial)
