"""The study's report, written by rule from its rows: Markdown, and the section of the page on the flip. Pure text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from research.benchmark.dataset import SIZES
from research.flip.measure import StudyRow
from research.flip.plan import StudyPlan, Variant
from research.paper.results import TAU
from sortie.scenarios.report_text import NONE, interval, listed, picture, signed, table

BEGIN, END = "<!-- study:begin -->", "<!-- study:end -->"
UNSENT: Mapping[str, str] = {"zero": "Zero fill, as in the paper", "masked": "Masked fusion"}


@dataclass(frozen=True, slots=True)
class FixedSettings:
    """What is held fixed while one quantity is looked at."""

    variant: str
    seed: int
    unsent: str = "zero"
    cells_by: str = "confidence"
    tau_name: str = "model"
    density: str = "default"


class StudyRows:
    """Rows of the study, looked up one at a time."""

    def __init__(self, rows: Iterable[StudyRow]) -> None:
        self.rows = tuple(rows)
        self._by = {
            (
                FixedSettings(r.variant, r.seed, r.unsent, r.cells_by, r.tau_name, r.density),
                r.quantity,
                _key(r.received_budget),
            ): r
            for r in self.rows
        }

    def get(self, view: FixedSettings, quantity: str, budget: float = math.nan) -> StudyRow | None:
        """The row, or None where that was not measured."""
        return self._by.get((view, quantity, _key(budget)))

    def networks(self) -> list[tuple[str, int]]:
        """Variant and seed of every network measured, in the rows' order."""
        return list(dict.fromkeys((r.variant, r.seed) for r in self.rows))


def sign(row: StudyRow | None) -> int:
    """+1 or −1 where the interval leaves zero out, else 0."""
    if row is None or not (row.low > 0 or row.high < 0):
        return 0
    return 1 if row.value > 0 else -1


def flips(found: StudyRows, view: FixedSettings, budgets: Sequence[float]) -> bool:
    """Whether two peers beat four at some budget and four beat two at a larger one, both significantly."""
    signs = [sign(found.get(view, "contrast", budget)) for budget in sorted(budgets)]
    return any(a > 0 and min(signs[i:]) < 0 for i, a in enumerate(signs))


def report(plan: StudyPlan, rows: Sequence[StudyRow], figures: Sequence[tuple[str, str]] = ()) -> str:
    """The whole report; `figures` are file names beside it and what they show."""
    found = StudyRows(rows)
    missing = [v.job(s) for v, s in plan.jobs() if (v.name, s) not in found.networks()]
    lines = ["# Do trained networks show the flip? An experiment", "", "## The question", "", *_quoted(plan.paper), ""]
    lines += ["Hypothesis, written down before the networks were trained:", "", *_quoted(plan.hypothesis), ""]
    lines += ["## The answer", "", *answers(plan, found), f"- {on_frames(rows)}", ""]
    lines += [_BY_INTERVENTION, ""]
    for name, caption in figures:
        lines += picture(name, caption)
    first, seed = plan.variants[0], plan.variants[0].seeds[0]
    lines += ["## Every network", "", networks(plan, found)]
    lines += [f"## The score threshold ({first.job(seed)})", "", thresholds(plan, found)]
    for title, others in _others(plan, first.name, seed):
        if table := _table(plan, found, "network", others):
            lines += [f"## {title}", "", *table, ""]
    lines += ["## The variants", ""]
    lines += [f"- `{v.name}` (seeds {', '.join(map(str, v.seeds))}): {v.reason}" for v in plan.variants]
    if missing:
        lines += [
            "",
            f"Not trained yet, so not in these tables: {', '.join(missing)}. `python -m research study train` trains them.",
        ]
    return "\n".join(lines) + "\n"


def networks(plan: StudyPlan, found: StudyRows) -> str:
    """Every network at the model's own threshold, a table a filling."""
    lines = [_LEGEND, ""]
    for unsent in plan.measured.unsent:
        views = {v.job(s): FixedSettings(v.name, s, unsent) for v in plan.variants for s in v.seeds}
        lines += [f"**{UNSENT[unsent]}**, τ = {TAU:g}, cells by confidence:", ""]
        lines += [*_table(plan, found, "network", views), ""]
    return "\n".join(lines)


def thresholds(plan: StudyPlan, found: StudyRows) -> str:
    """The first network at every score threshold, a table a filling."""
    variant, lines = plan.variants[0], []
    for unsent in plan.measured.unsent:
        views = {
            _tau(found, variant.name, variant.seeds[0], str(t)): FixedSettings(
                variant.name, variant.seeds[0], unsent, tau_name=str(t)
            )
            for t in plan.measured.taus
        }
        lines += [f"**{UNSENT[unsent]}**:", "", *_table(plan, found, "τ", views), ""]
    return "\n".join(lines)


def short(plan: StudyPlan, rows: Sequence[StudyRow], link: str) -> str:
    """The page's section between its markers: the findings, and a table of the networks that they compare."""
    found = StudyRows(rows)
    compared = [plan.variants[0], *_dropped(plan)]
    views = {v.job(s): FixedSettings(v.name, s) for v in compared for s in v.seeds}
    whole = f"{on_frames(rows)} The whole study: [{link}]({link})."
    zero = _table(plan, found, "network, zero fill", views)
    masked = _table(plan, found, "network, masked", {n: replace(view, unsent="masked") for n, view in views.items()})
    return "\n".join([BEGIN, "", *answers(plan, found)[:-1], "", *zero, "", *masked, "", _LEGEND, "", whole, "", END])


def _dropped(plan: StudyPlan) -> list[Variant]:
    """The variants that were trained with cells dropped at random."""
    return [v for v in plan.variants if v.recipe.get("cell_dropout")]


def on_frames(rows: Sequence[StudyRow]) -> str:
    """A sentence: how many frames of the test split all this stands on."""
    scenes, per_scene = SIZES["test"]
    of = scenes * per_scene
    measured = [f"all {of}" if n >= of else f"the first {n} of the {of}" for n in sorted({row.frames for row in rows})]
    return f"Measured on {listed(measured)} frames of the test split."


def answers(plan: StudyPlan, found: StudyRows) -> list[str]:
    """What the rows show about the paper's observation and about each part of the hypothesis."""
    m, networks = plan.measured, found.networks()
    views = {(f"{v}-{s}", u): FixedSettings(v, s, u) for v, s in networks for u in m.unsent}
    flipped = [name for (name, _), view in views.items() if flips(found, view, m.budgets)]
    fallen = [name for (name, _), view in views.items() if sign(found.get(view, "starved", m.starved)) < 0]
    swept = [
        f"{name}, {u}, cells by {c}, τ {t}, {d}"
        for (name, u), view in views.items() for t in m.taus for c in m.cells_by for d in m.densities
        if flips(found, replace(view, cells_by=c, tau_name=str(t), density=d), m.budgets)
    ]  # fmt: skip
    lines = [
        f"- **The flip appears in {_of(flipped, networks)}**, at the model's own threshold, under {listed(m.unsent)} filling.",
        f"- At a budget of {m.starved:g}, {_of(fallen, networks)} have a lower AP than a drone alone.",
    ]
    for v in (plan.variants[0], *_dropped(plan)):
        if its := [f"{v.name}-{s}" for s in v.seeds if (v.name, s) in networks]:
            costs = [n for n in its if sign(found.get(views[n, m.unsent[0]], "fill", m.starved)) < 0]
            lines.append(
                f"- Zero fill has a significantly lower AP than masked fusion, at that budget, in {len(costs)} of the "
                f"{len(its)} networks `{v.name}`."
            )
    lines.append(
        "- Over all thresholds, rankings, fillings, densities and networks, the flip appears "
        + (f"in {len(swept)} cases: {'; '.join(swept[:6])}{' …' if len(swept) > 6 else ''}." if swept else "nowhere.")
    )
    lines.append(
        "- The tables say what removes the flip where it appears."
        if flipped
        else "- The effect did not appear, so this experiment cannot say what causes it."
    )
    oracles = [found.get(view, "oracle") for view in views.values()]
    gains = [r for r in oracles if r is not None]
    if gains:
        top = max(gains, key=lambda r: r.value)
        lines.append(
            f"- Choosing the best of {listed(m.policies)} at each budget gains at most {signed(top.value)} AP points over "
            f"the best single one ({top.variant}-{top.seed}, {top.unsent})."
        )
    return lines


def _of(names: Sequence[str], networks: Sequence[object]) -> str:
    """Which of the networks."""
    return (
        f"none of the {len(networks)} networks" if not names else f"the networks {listed(list(dict.fromkeys(names)))}"
    )


_BY_INTERVENTION = (
    "What comparing trained networks cannot show, an intervention can: in the "
    "[dose–response study](../doses.md) three of these networks stay as they are, and silent peers draw more weight "
    "when they fuse."
)
_LEGEND = (
    "AP@0.5 of the full scene in points; differences with paired 95 % intervals over frames. *two − four*: two peers minus "
    "four at matched bytes; ▲ two are better, ▼ four are better, · no difference is shown. *starved*: all four at the "
    "least budget minus a drone alone. *fill*: zero fill minus masked fusion, at that same budget."
)


def _others(plan: StudyPlan, name: str, seed: int) -> Iterable[tuple[str, Mapping[str, FixedSettings]]]:
    m = plan.measured
    yield (
        "How cells are ranked",
        {
            f"{v.job(s)}, {unsent}, by {rank}": FixedSettings(v.name, s, unsent, rank)
            for v in plan.variants if not v.begins_from for s in v.seeds for unsent in m.unsent for rank in m.cells_by
        },
    )  # fmt: skip
    yield (
        f"Car density ({name}-{seed})",
        {f"{d}, {unsent}": FixedSettings(name, seed, unsent, density=d) for d in m.densities for unsent in m.unsent},
    )


def _table(plan: StudyPlan, found: StudyRows, head: str, views: Mapping[str, FixedSettings]) -> list[str]:
    """One row a view that was measured; empty where none was."""
    m = plan.measured
    shown = {name: view for name, view in views.items() if found.get(view, "gain") is not None}
    if not shown:
        return []
    contrasts = [f"two − four, budget {budget:g}" for budget in m.budgets]
    lines = []
    for name, view in shown.items():
        alone, full = found.get(view, "level", 0.0), found.get(view, "level", 1.0)
        cells = [_plain(alone), _plain(full), _difference(found.get(view, "starved", m.starved))]
        cells.append(_difference(found.get(view, "fill", m.starved)))
        for budget in m.budgets:
            row = found.get(view, "contrast", budget)
            cells.append(f"{'·▲▼'[sign(row)]} {_difference(row)}")
        cells.append(_difference(found.get(view, "oracle")))
        lines.append((name, *cells))
    return table((head, "alone", "all", f"starved, budget {m.starved:g}", "fill", *contrasts, "oracle"), lines)


def _tau(found: StudyRows, variant: str, seed: int, name: str) -> str:
    row = found.get(FixedSettings(variant, seed, tau_name=name), "gain")
    return (
        name
        if row is None
        else {"model": f"{row.tau:g}, the model's", "f1": f"{row.tau:.2f}, F1-optimal"}.get(name, name)
    )


def _plain(row: StudyRow | None) -> str:
    return NONE if row is None else f"{row.value:.1f}"


def _difference(row: StudyRow | None) -> str:
    return NONE if row is None else interval(row.value, row.low, row.high, signed)


def _quoted(text: str) -> list[str]:
    return [f"> {line}".rstrip() for line in text.splitlines()]


def _key(budget: float) -> float | None:
    return None if math.isnan(budget) else budget
