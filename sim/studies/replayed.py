"""What a replay found: every decision that differs from the one in flight, as a table, as CSV and in words."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from sortie.scenarios.report_text import percent
from sortie.sim.folders import write_text

if TYPE_CHECKING:
    from rich.table import Table

    from sortie.sim.results.summary import Summary

NO_PEER = -1
"""In the column `peer`: the difference is in the viewpoint."""
MOST = 12
"""Rows of the table of first differences, and of the most frequent ones in each of the others."""
_COLUMNS = {
    "t_s": pa.float64(),
    "drone": pa.int32(),
    "decision": pa.int32(),
    "peer": pa.int32(),
    "fields": pa.list_(pa.string()),
    "flown": pa.string(),
    "replayed": pa.string(),
    "flown_reason": pa.string(),
    "replayed_reason": pa.string(),
}
CSV_HEAD = ",".join(f'"{name}"' for name in _COLUMNS)
"""The first line of a table of differences."""


class Difference(NamedTuple):
    """One link on which a decision differs from the one in flight."""

    t_s: float
    drone: int
    decision: int
    """The number of the decision among this drone's, from 0."""
    peer: int
    """`NO_PEER` where the viewpoint differs."""
    fields: tuple[str, ...]
    """The directive's fields that differ."""
    flown: str
    """Their values in flight."""
    replayed: str
    """Their values now."""
    flown_reason: str
    replayed_reason: str


class Span(NamedTuple):
    """Successive decisions of a drone that differ in the same fields on the same link."""

    begin: Difference
    end_s: float
    """The time of the last of them."""
    decisions: int


@dataclass(frozen=True, eq=False)
class Replay:
    """The policy's decisions over recorded views, beside those in flight; made by `sortie.replay`."""

    flown: str
    """The policies that decided in flight."""
    policy: str
    """The policies that decided now."""
    decisions: int
    directives: int
    """Links decided on, summed over decisions."""
    differences: tuple[Difference, ...]
    """In the order of flight."""
    disagreement: Mapping[str, Any] | None = None
    """How often two drones' views lead this policy to different choices, as `disagreement` in the outcome; None where it
    was not asked for."""

    @property
    def same(self) -> bool:
        """Whether every decision is as it was in flight. Reasons may differ."""
        return not self.differences

    @property
    def table(self) -> pa.Table:
        """A row a difference: `t_s`, `drone`, `peer` (−1: the viewpoint), the fields that differ, values and reasons."""
        columns = zip(*self.differences, strict=True) if self.differences else [()] * len(_COLUMNS)
        return pa.table({name: pa.array(c, _COLUMNS[name]) for name, c in zip(_COLUMNS, columns, strict=True)})

    def save(self, path: str | Path) -> Path:
        """Write the table of differences as CSV; the names of fields are joined by spaces.

        Raises:
            RunError: the file cannot be written.
        """
        table = self.table
        fields = pc.binary_join(table["fields"], " ")
        text = io.BytesIO()
        csv.write_csv(table.set_column(table.column_names.index("fields"), "fields", fields), text)
        write_text(Path(path), text.getvalue().decode())
        return Path(path)

    def summary(self) -> Summary:
        """How many decisions differ, in what and why, and the first differences, as `sortie replay` prints it.

        A notebook shows it, `rich` prints it, and `str` gives plain text.
        """
        from sortie.sim.results.summary import Summary  # not at import: rich draws a random number there

        return Summary(*_parts(self))

    @property
    def spans(self) -> list[Span]:
        """The differences, successive ones of one link with the same fields in one entry; by their begin."""
        found: list[Span] = []
        last: dict[tuple[int, int], tuple[int, int]] = {}  # by link: its last difference's decision and span
        for d in self.differences:
            decision, k = last.get((d.drone, d.peer), (-2, -1))
            if decision + 1 == d.decision and found[k].begin.fields == d.fields:
                found[k] = Span(found[k].begin, d.t_s, found[k].decisions + 1)
            else:
                k = len(found)
                found.append(Span(d, d.t_s, 1))
            last[d.drone, d.peer] = d.decision, k
        return found


def _parts(replayed: Replay) -> Iterable[Table | str]:
    from rich.table import Table

    from sortie.sim.results.summary import titled

    differences = replayed.differences
    total = titled(f"{replayed.policy} over the views of {replayed.flown}", show_header=False)
    total.add_column(style="bold")
    total.add_column()
    total.add_row("decisions", f"{replayed.decisions}, for {replayed.directives} links in all")
    changed = len({(d.drone, d.decision) for d in differences})
    links = sum(d.peer != NO_PEER for d in differences)
    total.add_row("decisions that differ", f"{changed} ({percent(changed / max(1, replayed.decisions))})")
    total.add_row("links that differ", f"{links} ({percent(links / max(1, replayed.directives))})")
    for field, count in Counter(name for d in differences for name in d.fields).most_common():
        total.add_row(f"  in {field}", str(count))
    if replayed.disagreement is not None:
        from sortie.sim.results.summary import disagreement_in_words

        total.add_row("two drones disagree", disagreement_in_words(replayed.disagreement))
    yield total
    if not differences:
        return
    yield "The recorded world does not answer: later views are those of the policy that flew."
    why = Table(title="most frequent differences")
    for column in ("times", "links", "reason in flight", "reason now"):
        why.add_column(column, justify="right" if column == "times" else "left")
    pairs = Counter((d.flown_reason, d.replayed_reason) for d in differences)
    for (flown, again), count in pairs.most_common(MOST):
        at = sorted({_link(d) for d in differences if (d.flown_reason, d.replayed_reason) == (flown, again)})
        shown = "  ".join(at[:4]) + (f" and {len(at) - 4} more" if len(at) > 4 else "")
        why.add_row(str(count), shown, flown, again)
    yield why
    alike: dict[tuple[str, ...], list[str]] = {}  # links that differ alike and at once, in one row
    for begin, end_s, _ in replayed.spans:
        flown, again = _answer(begin.flown, begin.flown_reason), _answer(begin.replayed, begin.replayed_reason)
        alike.setdefault((f"{begin.t_s:.1f}", f"{end_s:.1f}", flown, again), []).append(_link(begin))
    more = f"and {len(alike) - MOST} more" if len(alike) > MOST else None
    first = Table(title="first differences", caption=more)
    for column in ("from (s)", "to (s)", "links", "in flight", "now"):
        first.add_column(column, justify="right" if column.endswith("(s)") else "left")
    for (begin_s, last_s, flown, again), who in list(alike.items())[:MOST]:
        first.add_row(begin_s, last_s, "  ".join(who), flown, again)
    yield first


def _link(d: Difference) -> str:
    return f"{d.drone}→{d.peer}" if d.peer != NO_PEER else f"{d.drone} looks"


def _answer(values: str, reason: str) -> str:
    return values + (f"; {reason}" if reason else "")
