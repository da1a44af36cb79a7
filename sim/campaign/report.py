"""What a campaign came to, as Markdown with figures: told by rule from its rows, so that equal rows tell the same."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from sim.campaign.contexts import contexts, rule, winner
from sim.campaign.figures import costs, draw_pareto, draw_varied, on_front, with_values
from sim.campaign.rows import Rows, figure, judged, read_rows
from sim.campaign.sensitivity import COLUMNS, MEANING, sensitivity
from sim.campaign.statistics import Estimate, estimate, paired
from sim.folders import RunError, write_text

REPORT, VARIED, PARETO = "report.md", "varied.png", "pareto.png"
MAX_FAILED = 20


def write_report(folder: Path) -> Path:
    """Write report.md and figures into a campaign's folder; returns the report's path.

    Raises:
        RunError: no campaign there, nothing finished, or the disk refuses.
        ImportError: matplotlib is missing.
    """
    rows = read_rows(folder)
    try:
        drawn = {VARIED: draw_varied(rows, folder / VARIED), PARETO: draw_pareto(rows, folder / PARETO)}
    except OSError as error:
        raise RunError(f"{folder}: cannot be written: {error.strerror}") from error
    write_text(folder / REPORT, "\n".join(_lines(rows, folder, drawn)) + "\n")
    return folder / REPORT


def _lines(rows: Rows, folder: Path, drawn: dict[str, bool]) -> Iterator[str]:
    plan = rows.plan
    yield f"# {plan.campaign.campaign}"
    if plan.campaign.description:
        yield f"\n{plan.campaign.description.strip()}"
    failed = int((~rows.done).sum())
    shape = f"{plan.units} {'draws' if len(plan.points) > 1 else 'replications'}"
    grid = f" at {len(plan.grid)} grid points" if len(plan.grid) > 1 else ""
    yield (
        f"\n{rows.table.num_rows} of {plan.runs} runs: {shape}{grid}, {plan.campaign.replications} replication(s), "
        f"{len(plan.policies)} policies on the same draws; {failed} failed. Base scenario `{plan.campaign.base}`, "
        f"seed {plan.campaign.seed}, Sortie {plan.code}. Intervals are 95 %, Student's, over "
        f"{'draws' if len(plan.points) > 1 else 'replications'}; differences are paired."
    )
    if plan.campaign.sample.method in ("latin_hypercube", "sobol") and len(plan.points) > 1:
        yield "Draws of this design are spread more evenly than independent ones, so the intervals are on the wide side."
    yield from _by_policy(rows)
    yield from _varied(rows, drawn[VARIED])
    yield from _pareto(rows, drawn[PARETO])
    yield from _sensitivity(rows)
    yield from _winners(rows)
    yield from _failed(rows, folder)
    yield "\n## The rows\n"
    yield f"""```python
polars.read_parquet("{folder}/runs/*.parquet")
pandas.read_parquet("{folder}/runs")
duckdb.sql("from '{folder}/runs/*.parquet'")
```"""


def _by_policy(rows: Rows) -> Iterator[str]:
    labels = rows.plan.policies
    yield "\n## Metrics by policy\n"
    yield _header("metric", *labels)
    for metric in rows.plan.campaign.metrics:
        means = rows.by_unit(metric)
        yield _row(metric, *(_interval(estimate(means[:, p])) for p in range(len(labels))))
    valued = with_values(rows)
    if missing := [m for m in rows.plan.campaign.metrics if m not in valued]:
        yield f"\nNo run has a value of {', '.join(missing)}: left out of what follows."
    if len(labels) > 1:
        yield f"\nDifferences from **{labels[0]}**, paired; × says how many times as many runs it would have taken unpaired.\n"
        yield _header("metric", *labels[1:])
        for metric in valued:
            found = [paired(*rows.pair(metric, 0, p)) for p in range(1, len(labels))]
            yield _row(
                metric,
                *(
                    f"{_interval(f.difference, signed=True)}" + ("" if math.isnan(f.saved) else f" ×{f.saved:.3g}")
                    for f in found
                ),
            )


def _varied(rows: Rows, drawn: bool) -> Iterator[str]:
    metrics = judged(with_values(rows))
    if not rows.plan.campaign.vary or not metrics:
        return
    yield "\n## By varied field\n"
    if drawn:
        yield f"![metrics over varied fields]({VARIED})\n"
    for metric in metrics:
        yield _header(metric, "part", *rows.plan.policies)
        for field in rows.plan.campaign.vary:
            for label, _, mask in rows.bins(field):
                means = rows.by_unit(metric, mask)
                yield _row(field, label, *(_interval(estimate(means[:, p])) for p in range(means.shape[1])))
        yield ""


def _pareto(rows: Rows, drawn: bool) -> Iterator[str]:
    metrics = with_values(rows)
    accuracies, prices = [m for m in metrics if m.startswith("ap50.")], costs(metrics)
    if not accuracies or not prices:
        return
    yield "\n## Accuracy against cost\n"
    if drawn:
        yield f"![accuracy against cost]({PARETO})\n"
    for accuracy in accuracies:
        for price in prices:
            x, y = ([estimate(c).mean for c in rows.by_unit(m).T] for m in (price, accuracy))
            front = [label for label, on in zip(rows.plan.policies, on_front(x, y), strict=True) if on]
            yield f"- {accuracy} against {price}: no policy is better in both than {', '.join(front)}"


def _sensitivity(rows: Rows) -> Iterator[str]:
    found = [
        s
        for metric in rows.plan.campaign.metrics
        for p in range(len(rows.plan.policies))
        if (s := sensitivity(rows, metric, p)) is not None
    ]
    if not found:
        return
    method = found[0].method
    yield f"\n## Sensitivity\n\n{MEANING[method]}\n"
    if method == "other":
        yield _header("metric", "policy", *found[0].fields)
        for s in found:
            yield _row(s.metric, s.policy, *(f"{v:+.2f}" if not math.isnan(v) else "–" for v in s.figures[:, 0]))
        return
    yield _header("metric", "policy", "field", *COLUMNS[method])
    for s in found:
        for field, figures in zip(s.fields, s.figures.tolist(), strict=True):
            yield _row(s.metric, s.policy, field, *(figure(v) for v in figures))


def _winners(rows: Rows) -> Iterator[str]:
    metrics = judged(with_values(rows))
    if len(rows.plan.policies) < 2 or not rows.plan.campaign.vary or not metrics:
        return
    yield "\n## Where the winner changes\n"
    for metric in metrics:
        best, other = winner(rows, metric), contexts(rows, metric)
        yield f"\n**{metric}**: {best} has the best mean over everything."
        if not other:
            yield "It has it in every part of every varied field, too."
        for c in other:
            sure = "surely" if c.sure else "not surely"
            yield f"- {c.field} {c.part}: {c.winner}, {sure}: {_interval(c.gain, signed=True)} over {best}"
        if (found := rule(rows, metric)) is not None:
            yield (
                f"\nBest one-threshold rule: {found.field} below {found.threshold:.3g} → {found.below}, above → "
                f"{found.above}. Rules found on one half of the cells gained {_interval(found.gain, signed=True)} over "
                "the best fixed policy on the other half."
            )
    yield "\nIntervals of parts are widened for all parts looked at (Bonferroni)."


def _failed(rows: Rows, folder: Path) -> Iterator[str]:
    table = rows.table.filter(~rows.done).slice(0, MAX_FAILED).to_pylist()
    if not table:
        return
    yield "\n## Failed runs\n"
    for row in table:
        yield (
            f"- run {row['run']} ({row['policy']}, seed {row['seed']}): {row['error']}  \n"
            f"  `sortie fly --from-campaign {folder} --run {row['run']}`"
        )


def _interval(e: Estimate, *, signed: bool = False) -> str:
    if math.isnan(e.mean):
        return "–"
    plus = "+" if signed and e.mean >= 0 else ""
    return f"{plus}{figure(e.mean)}" + (
        "" if math.isnan(e.low) or e.low == e.high else f" [{figure(e.low)}, {figure(e.high)}]"
    )


def _header(*cells: str) -> str:
    return f"{_row(*cells)}\n|{'---|' * len(cells)}"


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
