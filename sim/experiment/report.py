"""A campaign's report, Markdown with figures. Fixed rules write it, so equal rows give equal text."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from sortie.scenarios.intervals import Estimate, Floats, Paired, mean_interval, paired
from sortie.scenarios.report_text import ALL_EQUAL, NONE, number, prefixed, table
from sortie.sim.experiment.by_torch import FOLDER, answers, depends_on_detector, read_torch
from sortie.sim.experiment.drive import Stop
from sortie.sim.experiment.figures import costs, draw_pareto, draw_varied, drawn, on_front, with_values
from sortie.sim.experiment.rows import CampaignRows, is_accuracy, read_rows, winner_metrics
from sortie.sim.experiment.sensitivity import COLUMNS, MEANING, sensitivity
from sortie.sim.experiment.store import TABLE, CampaignTable
from sortie.sim.experiment.winners import other_winners, rule, winner
from sortie.sim.folders import RunError, write_text
from sortie.sim.results.outcome_fields import possible

REPORT, VARIED, PARETO = "report.md", "varied.png", "pareto.png"
MAX_FAILED = 20
NO_INTERVALS = {
    "morris": "The draws are Morris' levels, for the elementary effects below: means over them are not of the distributions, "
    "and have no intervals.",
    "saltelli": "The draws are Saltelli's blocks, for the Sobol' indices below: draws of a block share values and are not "
    "independent, so means over them have no intervals.",
}


def write_report(folder: Path) -> Path:
    """Write report.md, figures and the Parquet table into a campaign's folder; returns the report's path.

    Raises:
        RunError: no campaign there, nothing finished, or the disk refuses.
        ImportError: matplotlib is missing.
    """
    rows = read_rows(folder)
    with closing(CampaignTable(folder)) as store:
        store.export()
    try:
        pictures = {VARIED: False, PARETO: False}
        if _independent(rows):
            pictures = {VARIED: draw_varied(rows, folder / VARIED), PARETO: draw_pareto(rows, folder / PARETO)}
    except OSError as error:
        raise RunError(f"{folder}: cannot be written: {error.strerror}") from error
    write_text(folder / REPORT, "\n".join(_lines(rows, folder, pictures)) + "\n")
    return folder / REPORT


def _lines(rows: CampaignRows, folder: Path, pictures: dict[str, bool]) -> Iterator[str]:
    plan = rows.plan
    yield f"# {plan.campaign.campaign}"
    if plan.campaign.description:
        yield f"\n{plan.campaign.description.strip()}"
    failed = len(_failures(rows))
    shape = [_count(plan.units, plan.unit)]
    shape += [_count(len(plan.grid), "grid point")] * (len(plan.grid) > 1)
    shape += [_count(plan.campaign.replications, "replication")] * (plan.unit == "draw")
    shape += [f"{len(plan.policies)} policies on the same draws" if len(plan.policies) > 1 else "1 policy"]
    yield (
        f"\n{rows.all.num_rows} of {plan.runs} runs: {' × '.join(shape)}; {failed} failed. Base scenario `{plan.campaign.base}`, "
        f"seed {plan.campaign.seed}, Sortie {plan.code}. {_intervals(rows)}"
    )
    if (stop := plan.campaign.stop_when) is not None and _stopped(rows):
        yield (
            f"`stop_when` ended it: the interval of {stop.metric} is narrow enough. It is a little too narrow, because stopping "
            "there favours samples that look less spread than they are, the more so the smaller `at_least` is (here "
            f"{stop.at_least})."
        )
    if left := rows.all.num_rows - rows.table.num_rows:
        yield f"{left} of the runs are left out of all that follows: their {plan.unit} is not finished at every grid point."
    yield from _lost(rows)
    if plan.campaign.sample.method in ("latin_hypercube", "sobol") and len(plan.points) > 1:
        yield "Draws of this design are spread more evenly than independent ones, so the intervals are on the wide side."
    yield from _by_policy(rows)
    if _independent(rows):
        yield from _by_torch(rows, folder)
        yield from _varied(rows, pictures[VARIED])
        yield from _pareto(rows, pictures[PARETO])
    yield from _sensitivity(rows)
    if _independent(rows):
        yield from _winners(rows)
    yield from _failed(rows, folder)
    yield "\n## The rows\n"
    yield f"""```python
sortie.open_campaign("{folder}").rows
polars.read_parquet("{folder}/{TABLE}")
pandas.read_parquet("{folder}/{TABLE}")
duckdb.sql("from '{folder}/{TABLE}'")
```"""


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' * (number != 1)}"


def _lost(rows: CampaignRows) -> Iterator[str]:
    """Units that failed runs remove from the means, counted by policy."""
    plan, lost = rows.plan, rows.lost()
    if units := int(lost.any(axis=1).sum()):
        whose = ", ".join(f"{label} {n}" for label, n in zip(plan.policies, lost.sum(axis=0), strict=True) if n)
        at = "all runs of a policy at a grid point" if len(plan.grid) > 1 else "a policy's runs"
        yield (
            f"{units} of the {plan.unit}s {'is' if units == 1 else 'are'} left out of all means, where {at} failed ({whose}): "
            "policies are compared on the same draws."
        )
    if none := [p for i, p in enumerate(plan.policies) if not rows.done[rows.policy == i].any()]:
        yield f"No run of {', '.join(none)} finished."


def _by_policy(rows: CampaignRows) -> Iterator[str]:
    labels, metrics = rows.plan.policies, rows.plan.campaign.metrics
    some = {metric: _some(rows, metric) for metric in metrics}
    yield "\n## Metrics by policy\n"
    yield from table(
        ("metric", *labels),
        ((metric + some[metric], *(_mean(rows, metric, m) for m in rows.by_unit(metric).T)) for metric in metrics),
    )
    if any(some.values()):
        yield (
            f"\nA scene is one replication{' of a draw' * (rows.plan.unit == 'draw')} at a grid point. It counts for a metric where every policy "
            "that ever has a value of the metric has one, so that policies are compared on the same scenes."
        )
    valued = with_values(rows)
    if missing := [m for m in metrics if m not in valued]:
        yield f"\nNo scene can be compared by {', '.join(missing)}: left out of what follows."
    if len(labels) > 1 and _independent(rows):
        yield f"\nDifferences from **{labels[0]}**, paired; × says how many times as many runs it would have taken unpaired.\n"
        others = range(1, len(labels))
        yield from table(
            ("metric", *labels[1:]),
            (
                (metric, *(_difference(paired(means[:, 0], means[:, p], possible(metric))) for p in others))
                for metric in valued
                for means in [rows.by_unit(metric)]
            ),
        )


def _by_torch(rows: CampaignRows, folder: Path) -> Iterator[str]:
    """Means by the torch detector, where it flew some of the units."""
    if (torch := read_torch(folder, rows)) is None:
        return
    units, unit = len(np.unique(torch.unit)), rows.plan.unit
    yield "\n## By the torch detector\n"
    yield (
        f"The torch detector flew the first {units} {unit}s as well; all figures above are the surrogate's. *Torch alone* is the "
        f"mean over these {units}. *With the surrogate* also uses what the surrogate found in the other {unit}s, as a control "
        "variate. That adds no bias, however wrong the surrogate is, and makes an interval narrower where the two detectors "
        f"correlate from {unit} to {unit}, but a little wider where they do not. × says how many times as many {unit}s torch alone "
        f"would need for the interval with the surrogate. Rows: `{folder / FOLDER / TABLE}`."
    )
    metrics = list(depends_on_detector(rows, torch))
    for differences in (False, True)[: len(rows.plan.policies)]:
        if differences:
            yield f"\nDifferences from **{rows.plan.policies[0]}**, paired:"
        yield ""
        yield from table(
            ("metric", "policy", "torch alone", "with the surrogate", "correlation", "×"),
            (
                (
                    a.metric,
                    a.policy,
                    _interval(a.alone, signed=differences),
                    _interval(a.with_surrogate, signed=differences),
                    number(a.correlation, ".2f"),
                    number(a.worth, ".3g"),
                )
                for metric in metrics
                for a in answers(rows, torch, metric, differences=differences)
            ),
        )
    if same := [metric for metric in rows.plan.campaign.metrics if metric not in metrics]:
        yield f"\nBoth detectors gave the same values of {', '.join(same)}."


def _varied(rows: CampaignRows, picture: bool) -> Iterator[str]:
    valued = with_values(rows)
    own = [metric for metric in valued if metric.startswith("metrics.")]
    metrics = list(dict.fromkeys([*winner_metrics(valued), *own])) or valued[:1]
    if not rows.plan.campaign.vary or not metrics:
        return
    yield "\n## By varied field\n"
    if picture:
        yield f"![metrics over varied fields]({VARIED})\n"
        in_it = {name for names in drawn(rows) for name in names}
        if missing := [name for name in (*valued, *rows.plan.campaign.vary) if name not in in_it]:
            yield f"Not in the figure, which has no more room: {', '.join(missing)}.\n"
    for metric in metrics:
        yield from table(
            (metric, "part", *rows.plan.policies),
            (
                (
                    field,
                    label + _some(rows, metric, mask),
                    *(_interval(mean_interval(m, possible(metric))) for m in rows.by_unit(metric, mask).T),
                )
                for field in rows.plan.campaign.vary
                for label, _, mask in rows.bins(field)
            ),
        )
        yield ""


def _pareto(rows: CampaignRows, picture: bool) -> Iterator[str]:
    metrics = with_values(rows)
    accuracies, prices = [m for m in metrics if is_accuracy(m)], costs(metrics)
    if not accuracies or not prices:
        return
    yield "\n## Accuracy against cost\n"
    if picture:
        yield f"![accuracy against cost]({PARETO})\n"
    for accuracy in accuracies:
        for price in prices:
            x, y = ([mean_interval(c).mean for c in rows.by_unit(m).T] for m in (price, accuracy))
            front = [label for label, on in zip(rows.plan.policies, on_front(x, y), strict=True) if on]
            yield f"- {accuracy} against {price}: no policy is better in both than {', '.join(front)}"


def _sensitivity(rows: CampaignRows) -> Iterator[str]:
    results = [
        s
        for metric in rows.plan.campaign.metrics
        for p in range(len(rows.plan.policies))
        if (s := sensitivity(rows, metric, p)) is not None
    ]
    if not results:
        return
    method = results[0].method
    yield f"\n## Sensitivity\n\n{MEANING[method]}\n"
    if method == "other":
        if texts := [f for f in rows.plan.campaign.vary if f not in results[0].fields]:
            yield f"Fields of text have no ranks and are left out: {', '.join(texts)}.\n"
        yield from table(
            ("metric", "policy", *results[0].fields),
            ((s.metric, s.policy, *(number(v, "+.2f") for v in s.figures[:, 0])) for s in results),
        )
        return
    yield from table(
        ("metric", "policy", "field", *COLUMNS[method]),
        (
            (s.metric, s.policy, field, *(prefixed(v)[0] for v in row))
            for s in results
            for field, row in zip(s.fields, s.figures.tolist(), strict=True)
        ),
    )


def _winners(rows: CampaignRows) -> Iterator[str]:
    metrics = winner_metrics(with_values(rows))
    if len(rows.plan.policies) < 2 or not rows.plan.campaign.vary or not metrics:
        return
    yield "\n## Where the winner changes\n"
    for metric in metrics:
        best, other = winner(rows, metric), other_winners(rows, metric)
        yield f"\n**{metric}**: {best} has the best mean over everything."
        if not other:
            yield "No other policy has a better mean in any part of a varied field."
        for c in other:
            sure = "surely" if c.sure else "not surely"
            yield f"- {c.field} {c.part}: {c.winner}, {sure}: {_interval(c.gain, signed=True)} over {best}"
        if (best_rule := rule(rows, metric)) is not None:
            yield (
                f"\nBest one-threshold rule: {best_rule.field} below {best_rule.threshold:.3g} → {best_rule.below}, above → "
                f"{best_rule.above}. Rules found on one half of the {rows.plan.unit}s gained {_interval(best_rule.gain, signed=True)} over "
                "the best fixed policy on the other half."
            )
    yield "\nIntervals of parts are widened for all parts looked at (Bonferroni)."


def _failed(rows: CampaignRows, folder: Path) -> Iterator[str]:
    failed = _failures(rows)
    if not failed:
        return
    yield "\n## Failed runs\n"
    if len(failed) > MAX_FAILED:
        yield f"The first {MAX_FAILED} of {len(failed)}; the table's column `error` has all.\n"
    for row in failed[:MAX_FAILED]:
        yield (
            f"- run {row['run']} ({row['policy']}, seed {row['seed']}): {row['error']}  \n"
            f"  `sortie fly --from-campaign {folder} --run {row['run']}`"
        )


def _failures(rows: CampaignRows) -> list[dict[str, Any]]:
    failed: list[dict[str, Any]] = rows.all.filter(pc.equal(rows.all["status"], "failed")).to_pylist()
    return failed


def _independent(rows: CampaignRows) -> bool:
    return rows.plan.campaign.sample.independent


def _intervals(rows: CampaignRows) -> str:
    """What the intervals are, or why there are none."""
    unit = rows.plan.unit
    if not _independent(rows):
        return NO_INTERVALS[rows.plan.campaign.sample.method]
    if rows.plan.units == 1:
        return (
            f"One {unit} gives no interval: ask for more, by `{'sample.count' if unit == 'draw' else 'replications'}`."
        )
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


def _some(rows: CampaignRows, metric: str, mask: NDArray[np.bool_] | None = None) -> str:
    """How many of the scenes count for a metric, where not all do."""
    runs, scenes = rows.counted(metric, mask)
    count = int(runs.reshape(-1, len(rows.plan.policies)).any(axis=1).sum())
    return f" ({count} of {scenes} scenes)" if 0 < count < scenes else ""


def _mean(rows: CampaignRows, metric: str, values: Floats) -> str:
    result = mean_interval(values, possible(metric))
    return _interval(result) if _independent(rows) else prefixed(result.mean)[0]


def _difference(compared: Paired) -> str:
    saved = "" if math.isnan(compared.saved) else f" ×{compared.saved:.3g}"
    return _interval(compared.difference, signed=True) + saved


def _interval(e: Estimate, *, signed: bool = False) -> str:
    if math.isnan(e.mean):
        return NONE
    plus = "+" if signed and e.mean >= 0 else ""
    if math.isnan(e.low) or e.low == e.high:
        equal = "" if math.isnan(e.low) else f" {ALL_EQUAL}"
        return f"{plus}{prefixed(e.mean)[0]}{equal}"
    mean, low, high = prefixed(e.mean, e.low, e.high)
    return f"{plus}{mean} [{low}, {high}]"
