"""The exact view and answer of every decision of a sortie, kept in few bytes, and read back bit by bit.

Views of one instant differ little: most drones read the same descriptors. So each descriptor that a policy read is
kept once, as it was read: after trust took away what is doubted. A decision names the
rows of the descriptors in its view and their ages. Directives are kept in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import pyarrow as pa
import simpy

from sortie.policies.contract import Descriptor, Directive, FleetView, Reposition
from sortie.sim.results.arrow_types import columns_of, from_table, to_table

DECISIONS, DESCRIPTORS, DIRECTIVES = "views", "view_descriptors", "view_directives"


class Decision(NamedTuple):
    """One decision of one drone: what its policy read, and what it answered before staleness and damping."""

    t_s: float
    drone: int
    policy: str
    """The name of the policy that decided."""
    view: FleetView
    directives: tuple[Directive, ...]
    viewpoint: Reposition | None = None
    """Where it asked to look from; None keeps its slot."""


class _Row(NamedTuple):
    """A decision as it is kept: descriptors and directives by their rows in the other two tables."""

    t_s: float
    drone: int
    policy: str
    period_s: float
    detached_after_periods: float
    descriptors: tuple[int, ...]
    ages_s: tuple[float, ...]
    directives: tuple[int, ...]
    viewpoint: Reposition | None


TABLES: dict[str, dict[str, pa.DataType]] = {
    DECISIONS: columns_of(_Row),
    DESCRIPTORS: columns_of(Descriptor),
    DIRECTIVES: columns_of(Directive),
}
NEEDED = TABLES | {
    DESCRIPTORS: {c: t for c, t in TABLES[DESCRIPTORS].items() if c not in Descriptor._field_defaults},
}
"""The columns that are needed to read them; an optional field is left out by runs from before it came."""
ABOUT = {
    DECISIONS: "A decision: rows of `view_descriptors` that its view held and their ages in the same order, rows of "
    "`view_directives` that the policy answered before staleness and damping, and the viewpoint that it asked for.",
    DESCRIPTORS: "A descriptor as policies read it: after trust took away what is doubted.",
    DIRECTIVES: "A directive that a policy answered.",
}
"""What a row of each table is."""


class Journal:
    """Keeps decisions while a sortie flies."""

    def __init__(self, env: simpy.Environment) -> None:
        self._env = env
        self._rows: list[_Row] = []
        self._descriptors: dict[Descriptor, int] = {}
        self._directives: dict[tuple[Any, ...], int] = {}  # plain tuples: equal directives may have other reasons

    def decided(
        self,
        drone: int,
        policy: str,
        view: FleetView,
        directives: Sequence[Directive],
        viewpoint: Reposition | None,
    ) -> None:
        """Keep one decision, made now."""
        known, answers = self._descriptors, self._directives
        self._rows.append(
            _Row(
                self._env.now,
                drone,
                policy,
                view.period_s,
                view.detached_after_periods,
                tuple([known.setdefault(d, len(known)) for d in view.descriptors.values()]),
                tuple([view.age_s[i] for i in view.descriptors]),
                tuple([answers.setdefault(tuple(d), len(answers)) for d in directives]),
                viewpoint,
            )
        )

    def tables(self) -> dict[str, pa.Table]:
        """All decisions so far as Arrow tables."""
        return {
            DECISIONS: to_table(_Row, self._rows),
            DESCRIPTORS: to_table(Descriptor, list(self._descriptors)),
            DIRECTIVES: to_table(Directive, list(self._directives)),
        }


def decisions(tables: Mapping[str, pa.Table]) -> Iterator[Decision]:
    """The decisions that a run kept, in the order in which they were made."""
    descriptors = from_table(Descriptor, tables[DESCRIPTORS])
    directives = from_table(Directive, tables[DIRECTIVES])
    for d in from_table(_Row, tables[DECISIONS]):
        known = {descriptors[row].agent_id: descriptors[row] for row in d.descriptors}
        ages_s = dict(zip(known, d.ages_s, strict=True))
        view = FleetView(d.drone, d.period_s, known, ages_s, d.detached_after_periods).frozen
        answers = tuple([directives[row] for row in d.directives])
        yield Decision(d.t_s, d.drone, d.policy, view, answers, d.viewpoint)
