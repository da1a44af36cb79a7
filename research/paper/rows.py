"""The paper's table as rows: each claim under each way of fusing, with its verdict; to and from Parquet. Free of torch."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.special import ndtri

from research.paper.claims import CLAIMS, SECTIONS, Claim, Kind, conditions
from research.paper.measures import ApOf, Elsewhere, Region, Scores
from research.paper.verdict import ClaimVerdict, MeasuredValue
from sortie.perception.errors import InputError
from sortie.perception.evaluation.sharing import Unsent
from sortie.scenarios.intervals import benjamini_hochberg
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.regular import regular

INSTRUMENTS: dict[Unsent, str] = {"zero": "the paper's instrument", "masked": "masked fusion"}
"""How cells that were not sent count, and the heading of that column."""
_NORMAL = ndtri([0.025, 0.975])
_DRAWS = ndtri((np.arange(999) + 0.5) / 999)


@dataclass(frozen=True, slots=True)
class ClaimRow:
    """One claim under one instrument. Missing figures are None."""

    id: str
    section: str
    place: str
    says: str
    unit: str
    headline: bool
    follows: bool
    kind: str
    effect: str
    """The effect that it states, its own id if nothing else states it; empty for other kinds."""
    rule: str
    paper_value: float | None
    paper_low: float | None
    paper_high: float | None
    margin: float | None
    """Within which a figure counts as the claimed value, for claims of no difference or of a size."""
    digits: int
    instrument: str
    """zero or masked; empty for what does not depend on it."""
    value: float | None
    low: float | None
    high: float | None
    low_90: float | None
    high_90: float | None
    p: float | None
    q: float | None
    """p adjusted by Benjamini and Hochberg over the table's contrasts of the same instrument."""
    note: str
    verdict: str
    size: str


@dataclass(frozen=True, slots=True)
class Point:
    """The AP of one way of sharing, for the figures."""

    peers: str
    received_budget: float
    allocation: str
    instrument: str
    region: str
    ap: float
    low: float
    high: float


def points(scores: Mapping[Unsent, Scores]) -> list[Point]:
    """Every condition of the claims in both regions, with its 95 % interval."""
    out = []
    for instrument, its in scores.items():
        for region in get_args(Region):
            for c in conditions():
                m = ApOf(c, region).measure(its)
                low, high = (m.value if bound is None else bound for bound in (m.low, m.high))
                out.append(Point(c.peers, c.received_budget, c.allocation, instrument, region, m.value, low, high))
    return out


def judge(
    scores: Mapping[Unsent, Scores], elsewhere: Mapping[str, MeasuredValue], claims: Sequence[Claim] = CLAIMS
) -> list[ClaimRow]:
    """Measure and judge every claim.

    Args:
        scores: by instrument; each answers for the claims' conditions as they stand there (unsent cells "zero").
        elsewhere: what was measured in other rooms, by the name that `Elsewhere` gives it.
    """
    rows: list[ClaimRow] = []
    for instrument, its in scores.items():
        measured = {c.id: c.measure.measure(its) for c in claims if not isinstance(c.measure, Elsewhere)}
        tested = [i for i, m in measured.items() if m.p is not None]
        adjusted = dict(zip(tested, benjamini_hochberg([measured[i].p or 0.0 for i in tested]), strict=True))
        rows += [_row(c, instrument, measured[c.id], adjusted.get(c.id)) for c in claims if c.id in measured]
    rows += [_row(c, "", elsewhere.get(c.measure.name), None) for c in claims if isinstance(c.measure, Elsewhere)]
    place = {c.id: i for i, c in enumerate(claims)}
    return sorted(rows, key=lambda r: place[r.id])


_WORST_FIRST = (
    ClaimVerdict.OPPOSITE, ClaimVerdict.NOT_REPRODUCED, ClaimVerdict.INCONCLUSIVE, ClaimVerdict.NOT_MEASURABLE,
    ClaimVerdict.REPRODUCED,
)  # fmt: skip


def effects(rows: Iterable[ClaimRow]) -> dict[str, ClaimVerdict]:
    """Every independent effect of one instrument's rows with the worst verdict of the claims that state it.

    None of them is another's mirror or repetition, nor follows from others. They are measured on the same frames, so
    their errors are correlated.
    """
    found: dict[str, ClaimVerdict] = {}
    for row in rows:
        if row.effect:
            its = ClaimVerdict(row.verdict)
            found[row.effect] = min(found.get(row.effect, its), its, key=_WORST_FIRST.index)
    return found


def differ_by_chance(rows: Iterable[ClaimRow], claims: Sequence[Claim] = CLAIMS) -> float:
    """In how many verdicts two tables of the same truth would differ on average, each made on frames of its own: every
    figure is taken to be normal about what it is here, as wide as its interval, which moves along."""
    by_id = {c.id: c for c in claims}
    expected = 0.0
    for row in rows:
        value, low, high, low_90, high_90 = row.value, row.low, row.high, row.low_90, row.high_90
        if value is None or low is None or high is None or low_90 is None or high_90 is None or row.id not in by_id:
            continue
        claim, wide = by_id[row.id], (high - low) / (_NORMAL[-1] - _NORMAL[0])
        drawn = (MeasuredValue(value + d, low + d, high + d, low_90 + d, high_90 + d) for d in (wide * _DRAWS).tolist())
        count = Counter(claim.rule(claim.paper, m).verdict for m in drawn)
        expected += 1.0 - plain_sum((n / len(_DRAWS)) ** 2 for n in count.values())
    return expected


def _row(claim: Claim, instrument: str, ours: MeasuredValue | None, q: float | None) -> ClaimRow:
    judgement = claim.rule(claim.paper, ours)
    shown = MeasuredValue(float("nan")) if ours is None else ours
    section = next((name for name, claims in SECTIONS.items() if claim in claims), "")
    return ClaimRow(
        id=claim.id, section=section, place=claim.place, says=claim.says, unit=claim.unit, headline=claim.headline,
        follows=claim.follows, kind=str(claim.kind), effect=(claim.effect or claim.id) if claim.kind == Kind.EFFECT else "",
        rule=claim.rule.__name__, paper_value=claim.paper.value, paper_low=claim.paper.low,
        paper_high=claim.paper.high, margin=claim.paper.margin, digits=claim.paper.digits,
        instrument=instrument, value=None if shown.value != shown.value else shown.value, low=shown.low,
        high=shown.high, low_90=shown.low_90, high_90=shown.high_90, p=shown.p, q=q, note=shown.note, verdict=str(judgement.verdict), size=str(judgement.size),
    )  # fmt: skip


_TYPES = {"str": pa.string(), "float": pa.float64(), "bool": pa.bool_(), "int": pa.int32()}
SCHEMA = pa.schema([(f.name, _TYPES[str(f.type).split(" |")[0]]) for f in fields(ClaimRow)])


def to_table(rows: Iterable[ClaimRow], facts: Mapping[str, Any]) -> pa.Table:
    """The rows, with what the run was made with as JSON in the schema's metadata."""
    return pa.Table.from_pylist([asdict(r) for r in rows], SCHEMA.with_metadata({"sortie": json.dumps(dict(facts))}))


def from_table(table: pa.Table) -> tuple[list[ClaimRow], dict[str, Any]]:
    """Rows and facts back.

    Raises:
        InputError: a column that is missing.
    """
    missing = sorted(set(SCHEMA.names) - set(table.column_names))
    if missing:
        raise InputError(f"column {missing[0]} is missing")
    facts: dict[str, Any] = json.loads((table.schema.metadata or {}).get(b"sortie", b"{}"))
    return [ClaimRow(**r) for r in table.select(SCHEMA.names).to_pylist()], facts


def read(path: Path) -> tuple[list[ClaimRow], dict[str, Any]]:
    """The table of a report.

    Raises:
        InputError: no such file, or not one of these; the message names it.
    """
    try:
        return from_table(pq.read_table(regular(path)))
    except (OSError, pa.ArrowInvalid, ValueError) as error:
        raise InputError(f"{path}: not the table of a report ({error})") from None
