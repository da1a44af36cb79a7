"""A campaign's report, as Markdown and as one HTML page. Fixed rules write it, so equal rows give equal text."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.scenarios.intervals import Estimate, mean_interval, paired
from sortie.scenarios.report_text import ALL_EQUAL, NONE, number, prefixed
from sortie.sim.experiment.by_torch import FOLDER, answers, depends_on_detector, read_torch
from sortie.sim.experiment.drive import Stop
from sortie.sim.experiment.figures import costs, draw_pareto, draw_varied, drawn, on_front, with_values
from sortie.sim.experiment.rows import CampaignRows, is_accuracy, read_rows, winner_metrics
from sortie.sim.experiment.sensitivity import COLUMNS, MEANING, sensitivity
from sortie.sim.experiment.store import TABLE, CampaignTable
from sortie.sim.experiment.winners import other_winners, rule, winner
from sortie.sim.folders import RunError, write_text
from sortie.sim.results.blocks import Block, Code, Figure, Heading, Items, Paragraph, Table, html_page, markdown
from sortie.sim.results.outcome import possible

REPORT, PAGE = "report.md", "report.html"
FIGURES = {
    "varied.png": ("metrics over varied fields", draw_varied),
    "pareto.png": ("accuracy against cost", draw_pareto),
}
MAX_FAILED = 20
NO_INTERVALS = {
    "morris": "The draws are Morris' levels, for the elementary effects below: means over them are not of the distributions, "
    "and have no intervals.",
    "saltelli": "The draws are Saltelli's blocks, for the Sobol' indices below: draws of a block share values and are not "
    "independent, so means over them have no intervals.",
}


def write_report(folder: Path) -> Path:
    """Write the report, its figures and the Parquet table into a campaign's folder; returns the path of report.md.

    Raises:
        RunError: no campaign there, nothing finished, the disk refuses, or jinja2 is missing.
        ImportError: matplotlib is missing.
    """
    rows = read_rows(folder)
    with closing(CampaignTable(folder)) as store:
        store.export()
    try:
        figures = FIGURES if _independent(rows) else {}
        pictures = [name for name, (_, draw) in figures.items() if draw(rows, folder / name)]
    except OSError as error:
        raise RunError(f"{folder}: cannot be written: {error.strerror}") from error
    blocks = list(report_blocks(rows, folder, pictures))
    write_text(folder / REPORT, markdown(blocks))
    write_text(folder / PAGE, html_page(blocks))
    return folder / REPORT


def report_blocks(rows: CampaignRows, folder: Path, pictures: Collection[str] = ()) -> Iterator[Block]:
    """The report's content, with those of the `FIGURES` that were drawn into the folder."""
    campaign = rows.plan.campaign
    varied, pareto = ([Figure(FIGURES[name][0], folder / name)] * (name in pictures) for name in FIGURES)
    yield Heading(campaign.campaign, 1)
    if campaign.description:
        yield Paragraph(campaign.description.strip())
    yield Paragraph("\n".join(_about(rows)))
    yield from _by_policy(rows)
    if _independent(rows):
        yield from _by_torch(rows, folder)
        yield from _varied(rows, varied)
        yield from _pareto(rows, pareto)
    yield from _sensitivity(rows)
    if _independent(rows):
        yield from _winners(rows)
    yield from _failed(rows, folder)
    yield Heading("The rows")
    table = folder / TABLE
    yield Code(
        f'sortie.open_campaign("{folder}").rows\n'
        f'polars.read_parquet("{table}")\npandas.read_parquet("{table}")\nduckdb.sql("from \'{table}\'")',
        "python",
    )


def _independent(rows: CampaignRows) -> bool:
    return rows.plan.campaign.sample.independent


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' * (number != 1)}"


def _about(rows: CampaignRows) -> Iterator[str]:
    """What was flown, and what means and intervals are of, a sentence each."""
    plan, campaign, flown = rows.plan, rows.plan.campaign, rows.all.num_rows
    shape = [_count(plan.units, plan.unit)]
    shape += [_count(len(plan.grid), "grid point")] * (len(plan.grid) > 1)
    shape += [_count(campaign.replications, "replication")] * (plan.unit == "draw")
    shape += [f"{len(plan.policies)} policies on the same draws" if len(plan.policies) > 1 else "1 policy"]
    yield (
        f"{flown} of {plan.runs} runs: {' × '.join(shape)}; {_failures(rows).num_rows} failed. Base scenario `{campaign.base}`, "
        f"seed {campaign.seed}, Sortie {plan.code}. {_intervals(rows)}"
    )
    if (stop := campaign.stop_when) is not None and _stopped(rows):
        yield (
            f"`stop_when` ended it: the interval of {stop.metric} is narrow enough. It is a little too narrow, because stopping "
            "there favours samples that look less spread than they are, the more so the smaller `at_least` is (here "
            f"{stop.at_least})."
        )
    if left := flown - rows.table.num_rows:
        yield f"{left} of the runs are left out of all that follows: their {plan.unit} is not finished at every grid point."
    lost = rows.lost()
    if units := int(lost.any(axis=1).sum()):
        whose = ", ".join(f"{label} {n}" for label, n in zip(plan.policies, lost.sum(axis=0), strict=True) if n)
        at = "all runs of a policy at a grid point" if len(plan.grid) > 1 else "a policy's runs"
        yield (
            f"{units} of the {plan.unit}s {'is' if units == 1 else 'are'} left out of all means, where {at} failed ({whose}): "
            "policies are compared on the same draws."
        )
    if none := [p for i, p in enumerate(plan.policies) if not rows.done[rows.policy == i].any()]:
        yield f"No run of {', '.join(none)} finished."
    if campaign.sample.method in ("latin_hypercube", "sobol") and len(plan.points) > 1:
        yield "Draws of this design are spread more evenly than independent ones, so the intervals are on the wide side."


def _intervals(rows: CampaignRows) -> str:
    """What the intervals are, or why there are none."""
    unit = rows.plan.unit
    if not _independent(rows):
        return NO_INTERVALS[rows.plan.campaign.sample.method]
    if rows.plan.units == 1:
        asked = "sample.count" if unit == "draw" else "replications"
        return f"One {unit} gives no interval: ask for more, by `{asked}`."
    return (
        f"Intervals are 95 %, Student's, over {unit}s, on a scale in which no rate leaves 0 … 1 and no amount falls below 0; "
        "differences are paired."
    )


def _stopped(rows: CampaignRows) -> bool:
    """Whether the campaign ended because enough was known, as its driver finds out."""
    stop, size, count = Stop(rows.plan), rows.plan.shard, rows.all.num_rows
    enough = False
    for begin in range(0, count, size):
        enough = stop.enough(rows.all.slice(begin, size))
    return enough and rows.all["run"][-1].as_py() + 1 == count < rows.plan.runs


def _by_policy(rows: CampaignRows) -> Iterator[Block]:
    first, *others = labels = rows.plan.policies
    metrics, valued = rows.plan.campaign.metrics, with_values(rows)
    some = {metric: _some(rows, metric) for metric in metrics}
    yield Heading("Metrics by policy")
    yield Table(("metric", *labels), [(metric + some[metric], *_means(rows, metric)) for metric in metrics])
    if any(some.values()):
        yield Paragraph(
            f"A scene is one replication{' of a draw' * (rows.plan.unit == 'draw')} at a grid point. It counts for a metric where every policy "
            "that ever has a value of the metric has one, so that policies are compared on the same scenes."
        )
    if missing := [m for m in metrics if m not in valued]:
        yield Paragraph(f"No scene can be compared by {', '.join(missing)}: left out of what follows.")
    if others and _independent(rows):
        yield Paragraph(
            f"Differences from **{first}**, paired; × says how many times as many runs it would have taken unpaired."
        )
        yield Table(("metric", *others), [(metric, *_differences(rows, metric)) for metric in valued])


def _by_torch(rows: CampaignRows, folder: Path) -> Iterator[Block]:
    """Means by the torch detector, where it flew some of the units."""
    if (torch := read_torch(folder, rows)) is None:
        return
    units, unit = len(np.unique(torch.unit)), rows.plan.unit
    yield Heading("By the torch detector")
    yield Paragraph(
        f"The torch detector flew the first {units} {unit}s as well; all figures above are the surrogate's. *Torch alone* is the "
        f"mean over these {units}. *With the surrogate* also uses what the surrogate found in the other {unit}s, as a control "
        "variate. That adds no bias, however wrong the surrogate is, and makes an interval narrower where the two detectors "
        f"correlate from {unit} to {unit}, but a little wider where they do not. × says how many times as many {unit}s torch alone "
        f"would need for the interval with the surrogate. Rows: `{folder / FOLDER / TABLE}`."
    )
    metrics = list(depends_on_detector(rows, torch))
    for differences in (False, True)[: len(rows.plan.policies)]:
        if differences:
            yield Paragraph(f"Differences from **{rows.plan.policies[0]}**, paired:")
        found = [a for metric in metrics for a in answers(rows, torch, metric, differences=differences)]
        means = [[_interval(e, signed=differences) for e in (a.alone, a.with_surrogate)] for a in found]
        yield Table(
            ("metric", "policy", "torch alone", "with the surrogate", "correlation", "×"),
            [
                (a.metric, a.policy, *both, number(a.correlation, ".2f"), number(a.worth, ".3g"))
                for a, both in zip(found, means, strict=True)
            ],
        )
    if same := [metric for metric in rows.plan.campaign.metrics if metric not in metrics]:
        yield Paragraph(f"Both detectors gave the same values of {', '.join(same)}.")


def _varied(rows: CampaignRows, picture: list[Figure]) -> Iterator[Block]:
    valued, vary = with_values(rows), rows.plan.campaign.vary
    own = [metric for metric in valued if metric.startswith("metrics.")]
    metrics = list(dict.fromkeys([*winner_metrics(valued), *own])) or valued[:1]
    if not vary or not metrics:
        return
    yield Heading("By varied field")
    yield from picture
    in_it = {name for names in drawn(rows) for name in names}
    if picture and (missing := [name for name in (*valued, *vary) if name not in in_it]):
        yield Paragraph(f"Not in the figure, which has no more room: {', '.join(missing)}.")
    parts = [(field, label, mask) for field in vary for label, _, mask in rows.bins(field)]
    for metric in metrics:
        yield Table(
            (metric, "part", *rows.plan.policies),
            [(f, label + _some(rows, metric, mask), *_means(rows, metric, mask)) for f, label, mask in parts],
        )
    yield Paragraph()


def _pareto(rows: CampaignRows, picture: list[Figure]) -> Iterator[Block]:
    metrics = with_values(rows)
    pairs = [(accuracy, price) for accuracy in metrics if is_accuracy(accuracy) for price in costs(metrics)]
    items = []
    for accuracy, price in pairs:
        x, y = ([mean_interval(c).mean for c in rows.by_unit(m).T] for m in (price, accuracy))
        front = [label for label, on in zip(rows.plan.policies, on_front(x, y), strict=True) if on]
        items.append(f"{accuracy} against {price}: no policy is better in both than {', '.join(front)}")
    if items:
        yield Heading("Accuracy against cost")
        yield from picture
        yield Items(items)


def _sensitivity(rows: CampaignRows) -> Iterator[Block]:
    plan = rows.plan
    pairs = [(metric, p) for metric in plan.campaign.metrics for p in range(len(plan.policies))]
    results = [s for metric, p in pairs if (s := sensitivity(rows, metric, p)) is not None]
    if not results:
        return
    method, fields = results[0].method, results[0].fields
    yield Heading("Sensitivity")
    yield Paragraph(MEANING[method])
    if method != "other":
        yield Table(
            ("metric", "policy", "field", *COLUMNS[method]),
            [
                (s.metric, s.policy, field, *(prefixed(v)[0] for v in row))
                for s in results
                for field, row in zip(s.fields, s.figures.tolist(), strict=True)
            ],
        )
        return
    if texts := [field for field in plan.campaign.vary if field not in fields]:
        yield Paragraph(f"Fields of text have no ranks and are left out: {', '.join(texts)}.")
    yield Table(
        ("metric", "policy", *fields),
        [(s.metric, s.policy, *(number(v, "+.2f") for v in s.figures[:, 0])) for s in results],
    )


def _winners(rows: CampaignRows) -> Iterator[Block]:
    metrics = winner_metrics(with_values(rows))
    if len(rows.plan.policies) < 2 or not rows.plan.campaign.vary or not metrics:
        return
    yield Heading("Where the winner changes")
    yield Paragraph()
    for metric in metrics:
        best, other = winner(rows, metric), other_winners(rows, metric)
        lead = f"**{metric}**: {best} has the best mean over everything."
        if not other:
            lead += "\nNo other policy has a better mean in any part of a varied field."
        changes = [
            f"{c.field} {c.part}: {c.winner}, {'surely' if c.sure else 'not surely'}: {_interval(c.gain, signed=True)} over {best}"
            for c in other
        ]
        yield Items(changes, lead)
        if (best_rule := rule(rows, metric)) is not None:
            yield Paragraph(
                f"Best one-threshold rule: {best_rule.field} below {best_rule.threshold:.3g} → {best_rule.below}, above → "
                f"{best_rule.above}. Rules found on one half of the {rows.plan.unit}s gained {_interval(best_rule.gain, signed=True)} over "
                "the best fixed policy on the other half."
            )
    yield Paragraph("Intervals of parts are widened for all parts looked at (Bonferroni).")


def _failed(rows: CampaignRows, folder: Path) -> Iterator[Block]:
    if not (count := _failures(rows).num_rows):
        return
    yield Heading("Failed runs")
    if count > MAX_FAILED:
        yield Paragraph(f"The first {MAX_FAILED} of {count}; the table's column `error` has all.")
    yield Items(
        [
            f"run {row['run']} ({row['policy']}, seed {row['seed']}): {row['error']}  \n"
            f"  `sortie fly --from-campaign {folder} --run {row['run']}`"
            for row in _failures(rows).slice(0, MAX_FAILED).to_pylist()
        ]
    )


def _failures(rows: CampaignRows) -> pa.Table:
    return rows.all.filter(pc.equal(rows.all["status"], "failed"))


def _some(rows: CampaignRows, metric: str, mask: NDArray[np.bool_] | None = None) -> str:
    """How many of the scenes count for a metric, where not all do."""
    runs, scenes = rows.counted(metric, mask)
    count = int(runs.reshape(-1, len(rows.plan.policies)).any(axis=1).sum())
    return f" ({count} of {scenes} scenes)" if 0 < count < scenes else ""


def _means(rows: CampaignRows, metric: str, mask: NDArray[np.bool_] | None = None) -> Iterator[str]:
    """A policy's mean each; with intervals where the draws are independent."""
    for values in rows.by_unit(metric, mask).T:
        result = mean_interval(values, possible(metric))
        yield _interval(result) if _independent(rows) else prefixed(result.mean)[0]


def _differences(rows: CampaignRows, metric: str) -> Iterator[str]:
    """Of each policy but the first, from the first."""
    first, *others = rows.by_unit(metric).T
    for values in others:
        compared = paired(first, values, possible(metric))
        saved = "" if math.isnan(compared.saved) else f" ×{compared.saved:.3g}"
        yield _interval(compared.difference, signed=True) + saved


def _interval(e: Estimate, *, signed: bool = False) -> str:
    if math.isnan(e.mean):
        return NONE
    plus = "+" if signed and e.mean >= 0 else ""
    if math.isnan(e.low) or e.low == e.high:
        equal = "" if math.isnan(e.low) else f" {ALL_EQUAL}"
        return f"{plus}{prefixed(e.mean)[0]}{equal}"
    mean, low, high = prefixed(e.mean, e.low, e.high)
    return f"{plus}{mean} [{low}, {high}]"
