"""The paper's table as Markdown: the whole report, and the short section of the repository's README. Pure text."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from research.paper.claims import Kind
from research.paper.rows import INSTRUMENTS, ClaimRow, effects
from research.paper.sensitivity import Varied
from research.paper.verdict import ClaimVerdict
from sortie.scenarios.report_text import fixed, interval, picture, signed, table

BEGIN, END = "<!-- paper:begin -->", "<!-- paper:end -->"
_DECIMALS = {"AP points": 1, "AP": 3, "MB": 1, "kB/s": 1, "MB/s": 1, "%": 1, "B": 0, "ms": 3, "s": 2, "×": 1, "of 3": 0}


def figure(value: float | None, low: float | None, high: float | None, unit: str, decimals: int | None = None) -> str:
    """A figure with its interval, in its unit; a dash where there is none."""
    if value is None:
        return "–" if low is None or high is None else f"{low:g}–{high:g}{_suffix(unit)}"
    places = _DECIMALS[unit] if decimals is None else decimals
    if unit == "AP points":
        return interval(value, low, high, lambda v: signed(v, places))
    return interval(value, low, high, lambda v: fixed(v, places), _suffix(unit))


def papers(row: ClaimRow) -> str:
    """What the paper prints."""
    text = figure(row.paper_value, row.paper_low, row.paper_high, row.unit, row.digits)
    if row.rule == "no_difference":
        return "n.s." if row.paper_value is None else f"{text} n.s."
    return f"({text})" if row.follows and text != "–" else text


def ours(row: ClaimRow) -> str:
    """What we measured."""
    if row.value is None:
        return "none" if row.verdict == ClaimVerdict.NOT_REPRODUCED else "–"
    difference = row.rule in ("contrast", "no_difference")
    small = not difference and 0 < abs(row.value) < 10.0 ** -_DECIMALS[row.unit]
    text = f"{row.value:.1g}{_suffix(row.unit)}" if small else figure(row.value, row.low, row.high, row.unit)
    contains_zero = row.low is not None and row.high is not None and row.low <= 0 <= row.high
    return f"{text} n.s." if difference and contains_zero else text


def verdict(row: ClaimRow) -> str:
    """The verdict, the margin of a claim of a value, and how the sizes compare."""
    mark = {
        ClaimVerdict.REPRODUCED: "**reproduced**",
        ClaimVerdict.NOT_REPRODUCED: "*not reproduced*",
        ClaimVerdict.OPPOSITE: "*opposite*",
        ClaimVerdict.INCONCLUSIVE: "*inconclusive*",
    }.get(ClaimVerdict(row.verdict), row.verdict)
    if row.margin is not None:
        mark = f"{mark} (±{row.margin:g})"
    return f"{mark}, {row.size}" if row.size and row.rule != "exact" else mark


def tally(rows: Iterable[ClaimRow]) -> str:
    """How many independent effects stand under one instrument, and what is counted apart."""
    rows = list(rows)
    found = effects(rows)
    parts = []
    if found:
        stand = sum(v == ClaimVerdict.REPRODUCED for v in found.values())
        rest = _count(v for v in found.values() if v != ClaimVerdict.REPRODUCED)
        parts.append(f"{stand} of {len(found)} independent effects stand" + (f" ({rest})" if rest else ""))
    for kind, name in _APART.items():
        verdicts = [ClaimVerdict(r.verdict) for r in rows if r.kind == kind]
        if verdicts:
            parts.append(f"{name}: {_count(verdicts)}")
    return "; ".join(parts)


_APART = {
    Kind.COST: "costs of the context plane",
    Kind.ARITHMETIC: "arithmetic and definitions",
    Kind.LEVEL: "absolute APs",
}
"""What is counted apart from effects."""


def _count(verdicts: Iterable[ClaimVerdict]) -> str:
    count = Counter(verdicts)
    return ", ".join(f"{count[v]} {v}" for v in ClaimVerdict if count[v])


def report(
    rows: Sequence[ClaimRow],
    facts: Mapping[str, Any],
    figures: Sequence[tuple[str, str]] = (),
    varied: Sequence[Varied] = (),
) -> str:
    """The whole report; `figures` are file names beside it and what they show, `varied` claims at other settings."""
    shown = [i for i in INSTRUMENTS if any(r.instrument == i for r in rows)]
    lines = ["# The paper's Evaluation, claim by claim", "", _provenance(facts), ""]
    lines += [f"- {INSTRUMENTS[i]}: {tally(r for r in rows if r.instrument == i)}." for i in shown]
    lines += [f"- measured on a flown sortie: {tally(r for r in rows if not r.instrument)}.", "", _RULE, ""]
    for name, caption in figures:
        lines += picture(name, caption)
    for section in dict.fromkeys(r.section for r in rows):
        lines += [f"## {section}", "", *_section([r for r in rows if r.section == section], shown), ""]
    if varied:
        lines += _sensitivity(rows, varied)
    return "\n".join(lines)


def short(rows: Sequence[ClaimRow], facts: Mapping[str, Any], link: str) -> str:
    """The README's section: the headline claims, between its markers."""
    chosen = [r for r in rows if r.headline]
    head = [BEGIN, "", _provenance(facts), ""]
    for i, name in INSTRUMENTS.items():
        if its := [r for r in rows if r.instrument == i]:
            head.append(f"- {name}: {tally(its)}.")
    head += [f"- measured on a flown sortie: {tally(r for r in rows if not r.instrument)}.", ""]
    shown = [i for i in INSTRUMENTS if any(r.instrument == i for r in chosen)]
    lines = []
    for several in _by_claim(chosen):
        first = several.get(shown[0] if shown else "", several.get(""))
        if first is None:
            continue
        other = several.get("masked") if "masked" in shown[1:] else None
        masked = "" if other is None else ours(other)
        lines.append((first.says, papers(first), ours(first), verdict(first), masked))
    tail = [
        "",
        "AP differences in points with 95 % intervals over frames; *ours* is the paper's instrument (cells that were not sent count "
        "as zeros), *masked* leaves them out of the fusion, as sorties do. In brackets: arithmetic on the paper's figures. "
        "±: the margin of an equivalence test. An effect stands when every claim that states it is reproduced.",
        f"All claims, figures, and how each verdict is reached: [{link}]({link}).",
        "",
        END,
    ]
    return "\n".join([*head, *table(("claim", "paper", "ours", "verdict", "masked"), lines), *tail])


_RULE = """\
**How verdicts are reached** (`research/paper/verdict.py`, which says what was fixed when).

- A *difference* is significant when its 95 % interval leaves zero out. *Reproduced*: significant here with the paper's
  sign; *opposite*: significant with the other sign; *not reproduced*: not significant. The size is reported separately: the
  *same* when intervals overlap (or ours holds the paper's value where it prints no interval).
- *No difference* (n.s. in the paper) and a claim of a *size* are judged by an equivalence test: two one-sided tests at 5 %.
  *Reproduced*: the 90 % interval lies within the margin (±) around zero, or around the paper's value. *Not reproduced*:
  it does not, and the 95 % interval leaves the value out. *Inconclusive*: anything else. The margins are 1.2 points of AP in
  the full scene and 2.8 in the mission's disc, half the width of the narrowest interval by which the paper finds no
  difference there; and 7 % of the gain, half the width of its interval of a difference from full sharing.
- That *most* of the gain is kept asks for an interval above one half.
- Absolute APs are not comparable between benchmarks, as the paper says itself.
- Counted bytes have to round to the paper's print. Times and rates have to lie within half an order of magnitude, or beyond
  it on the side that makes the claim stronger.

**What is counted.** An *effect* is a dependence of AP on what is shared. A contrast and its mirror, a contrast told twice,
one sentence over four budgets, and consequences of one finding are one effect. It stands when every claim that states it is
reproduced. What follows from definitions, wire sizes or other figures of the paper is counted apart, and so are times, rates
and reactions of the context plane. All effects are measured on the same frames, so their errors are correlated.

Intervals are paired percentile bootstraps over frames, the egos of a frame together; q is the level of
a difference adjusted by Benjamini and Hochberg over the table's differences under the same instrument, for reading
beside the verdict, which goes by the interval as the paper's does. "The best two" is the best of best-2, worst-2 and
random-2 at that budget, chosen on all frames, as the paper does; the choice is in no interval. In brackets: not printed
in the paper, but arithmetic on what it prints."""


_SENSITIVITY = """\
The paper names neither its score threshold nor the centre of its mission region. Here are the claims that may depend on
them, over both, from the same detections; a star marks another verdict than above."""


def _section(rows: Sequence[ClaimRow], shown: Sequence[str]) -> list[str]:
    if not any(r.instrument for r in rows):
        cells = ((r.says, r.place, papers(r), ours(r), verdict(r), r.note) for r in rows)
        return table(("claim", "sentence", "paper", "ours", "verdict", ""), cells)
    head = [cell for i in shown for cell in (INSTRUMENTS[i], "q", "verdict")]  # type: ignore[index]
    lines = []
    for several in _by_claim(rows):
        first = next(iter(several.values()))
        its = [several.get(i) for i in shown]
        measured = [cell for r in its for cell in (("", "", "") if r is None else (ours(r), _level(r.q), verdict(r)))]
        notes = list(dict.fromkeys(r.note for r in several.values() if r.note))
        lines.append((first.says, first.place, papers(first), *measured, "; masked: ".join(notes)))
    return table(("claim", "sentence", "paper", *head, ""), lines)


def _sensitivity(rows: Sequence[ClaimRow], varied: Sequence[Varied]) -> list[str]:
    """A table a knob and instrument, its settings in columns; a star where the verdict is not that of the table above."""
    lines = ["## How the verdicts depend on threshold and region", "", _SENSITIVITY, ""]
    first = {(r.id, r.instrument): r for r in rows}
    for knob, title in (("tau", "score threshold τ"), ("disc", "mission disc")):
        for i, name in INSTRUMENTS.items():
            its = [v for v in varied if (v.knob, v.instrument) == (knob, i)]
            if not its:
                continue
            settings = list(dict.fromkeys(v.setting for v in its))
            claims = []
            for claim in dict.fromkeys(v.id for v in its):
                row = first[claim, i]
                cells = {
                    v.setting: ours(replace(row, value=v.value, low=v.low, high=v.high, verdict=v.verdict))
                    + (" *" if v.verdict != row.verdict else "")
                    for v in its
                    if v.id == claim
                }
                claims.append((row.says, *(cells[s] for s in settings)))
            lines += [f"**{title}**, {name}:", "", *table(("claim", *settings), claims), ""]
    return lines


def _by_claim(rows: Iterable[ClaimRow]) -> list[dict[str, ClaimRow]]:
    """Rows of one claim together, by instrument, claims in their order."""
    claims: dict[str, dict[str, ClaimRow]] = {}
    for row in rows:
        claims.setdefault(row.id, {})[row.instrument] = row
    return list(claims.values())


def _provenance(facts: Mapping[str, Any]) -> str:
    """One paragraph: on what, by what, how exactly."""
    return (
        f"Made by `{facts['command']}`: {facts['frames']} frames of {facts['scenes']} scenes of the benchmark's test split "
        f"(seed {facts['seed']}), five egos each; weights `{facts['weights']}` ({facts['fingerprint'][:12]}), cells by "
        f"{facts['cells_by']}, score threshold τ = {facts['tau']:g}; {facts['draws']} resamples. "
        f"Sortie {facts['version']}; {facts['cpu_s']:.0f} CPU-seconds on {facts['machine']}."
    )


def _suffix(unit: str) -> str:
    return {"AP": "", "AP points": "", "×": " ×", "of 3": " of 3"}.get(unit, f" {unit}")


def _level(q: float | None) -> str:
    if q is None:
        return ""
    return "< 0.01" if q < 0.01 else f"{min(q, 1.0):.{2 if q >= 0.1 else 3}f}" if math.isfinite(q) else ""
