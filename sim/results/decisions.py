"""Which decisions are printed after a flight: what changed and why, with flapping counted in a row of its own."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from sortie.scenarios.frames import frame_at

MAX_ROWS = 25
COARSE_S = 5.0
"""Changes to the same within this share a row where there are too many rows otherwise."""
CAUSED_WITHIN_S = 1.3
"""What a link does so soon after a phase or an event counts as caused by it: a lost drone is detached after 1.1 s."""

Link = tuple[int, int]


class DecisionRow(NamedTuple):
    """One row: a phase, an event, links that change alike, or links that go back and forth."""

    t_s: float
    links: tuple[Link, ...]
    """(drone, peer); empty for a phase or an event."""
    what: str
    why: str
    drone: int = -1
    """Whose event; -1 is the whole fleet's."""

    @property
    def fleet(self) -> bool:
        """Whether it is a phase, or an event of the whole fleet."""
        return not self.links and self.drone < 0


class _Change(NamedTuple):
    """A change of what one link carries."""

    t_s: float
    link: Link
    before: str
    after: str
    reason: str
    caused: bool


def decision_rows(result: dict[str, Any], max_rows: int = MAX_ROWS) -> tuple[list[DecisionRow], int]:
    """The rows to print, in order of time, and how many were left out.

    Where there are too many rows, flapping becomes one row, and changes to the same within five seconds share a row. If that
    is not enough, these are left out, in this order: other changes, the latest first; what phases and events caused; events.

    Args:
        result: an outcome.
        max_rows: no more rows than this.
    """
    phases = [DecisionRow(p["begin_s"], (), "phase", p["phase"]) for p in result["phases"]]
    events = [DecisionRow(e["t_s"], (), e["kind"], e["text"], e["drone"]) for e in result["events"]]
    lasting: list[_Change] = []
    loops: list[list[_Change]] = []
    for changes in _by_link(result, [*phases, *events]):
        path, back = loop_erased(changes)
        lasting += path
        loops += back
    caused, others = _alike(lasting, result["frame_s"])
    flapping = _flapping(loops)
    if len(phases) + len(events) + len(caused) + len(others) + len(flapping) > max_rows:
        caused, others = _alike(lasting, COARSE_S)
        flapping = [_in_one_row(loops)] if loops else []
    kept = [*phases, *flapping, *events, *caused, *others]
    return sorted(kept[:max_rows], key=lambda row: row.t_s), max(0, len(kept) - max_rows)


def loop_erased(changes: Sequence[_Change]) -> tuple[list[_Change], list[list[_Change]]]:
    """A link's changes that last, and its loops: changes that lead back to what the link carried before them.

    A loop of which a phase or an event caused a part is no flapping; its changes are among those that last.
    """
    path: list[_Change] = []
    loops, shown = [], []
    for change in changes:
        path.append(change)
        begin = next((k for k, c in enumerate(path) if c.before == change.after), None)
        if begin is not None:
            loop, path = path[begin:], path[:begin]
            if any(c.caused for c in loop):
                shown += loop
            else:
                loops.append(loop)
    return path + shown, loops


def _by_link(result: dict[str, Any], happened: Sequence[DecisionRow]) -> Iterable[list[_Change]]:
    """Each link's changes, in order of time."""
    links: dict[Link, list[_Change]] = {}
    for t in result["transitions"]:
        for peer in t["peers"]:
            link, t_s = (t["drone"], peer), t["t_s"]
            caused = any(0.0 <= t_s - h.t_s <= CAUSED_WITHIN_S and (h.fleet or h.drone in link) for h in happened)
            links.setdefault(link, []).append(_Change(t_s, link, t["from"], t["to"], t["reason"], caused))
    return links.values()


def _alike(changes: Iterable[_Change], within_s: float) -> tuple[list[DecisionRow], list[DecisionRow]]:
    """Rows of what a phase or an event caused, and other rows; each in order of time.

    Changes to the same in the same `within_s` share a row if their reasons differ in numbers alone.
    """
    rows: dict[tuple[int, str, str], list[_Change]] = {}
    for c in sorted(changes, key=lambda c: (c.t_s, c.link)):
        key = frame_at(c.t_s, within_s), f"{c.before} → {c.after}", re.sub(r"[\d.]+", "#", c.reason)
        rows.setdefault(key, []).append(c)
    caused: list[DecisionRow] = []
    others: list[DecisionRow] = []
    for (_, what, _), alike in rows.items():
        first = alike[0]
        why = first.reason + (", …" if any(c.reason != first.reason for c in alike) else "")
        row = DecisionRow(first.t_s, tuple(sorted({c.link for c in alike})), what, why)
        (caused if any(c.caused for c in alike) else others).append(row)
    return caused, others


def _flapping(loops: Sequence[Sequence[_Change]]) -> list[DecisionRow]:
    """A row for each link and what it goes through, the most frequent first."""
    rows: dict[tuple[Link, frozenset[str]], list[Sequence[_Change]]] = {}
    for loop in loops:
        rows.setdefault((loop[0].link, frozenset(c.before for c in loop)), []).append(loop)
    return [_in_one_row(same) for same in sorted(rows.values(), key=len, reverse=True)]


def _in_one_row(loops: Sequence[Sequence[_Change]]) -> DecisionRow:
    """Loops in one row: what most of them go through, how often, until when, and the most frequent reasons."""
    through = Counter(" ⇄ ".join(dict.fromkeys(c.before for c in loop)) for loop in loops)
    reasons = Counter(re.split(r"[:<≥]", c.reason)[0].strip() for loop in loops for c in loop)
    times = "once" if len(loops) == 1 else f"{len(loops)} times"
    why = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common(3))
    return DecisionRow(
        min(loop[0].t_s for loop in loops),
        tuple(sorted({loop[0].link for loop in loops})),
        through.most_common(1)[0][0] + (", and others" if len(through) > 1 else ""),
        f"back and forth {times} until {max(loop[-1].t_s for loop in loops):.1f} s: {why}",
    )
