"""How small the descriptor can be: AP against context bytes, one knob at a time and together (`make figures FIGURE=context_forms`).

Policies that read the context (`deputies` and `who2com-style`) fly the same sorties with descriptors of several
forms. Bytes are those that went on the air, authentication included; AP is by the surrogate detector.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from research.validation.pairs_of_records import pair_up
from research.validation.stored import Column, Table, points
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.scenarios.reading.load import load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SCENARIO = "track_target"
POLICIES = ("deputies", "who2com-style")
FORMS: dict[str, tuple[str, ...]] = {
    "the paper's": (),
    "grid 8 × 8": ("context.form=grid_8",),
    "grid 4 × 4": ("context.form=grid_4",),
    "no grid": ("context.form=no_grid",),
    "1 bit a cell": ("context.form=cells_1_bit",),
    "16 bits a number": ("context.form=numbers_16_bit",),
    "12 bits a number": ("context.form=numbers_12_bit",),
    "8 bits a number": ("context.form=numbers_8_bit",),
    "5 Hz": ("context.publish_every=2",),
    "2 Hz": ("context.publish_every=5",),
    "1 Hz": ("context.publish_every=10",),
    "8 × 8, 1 bit, 16 bits, 2 Hz": ("context.form=small", "context.publish_every=5"),
}  # fmt: skip
"""By name, and what it sets."""


@dataclass(frozen=True, slots=True)
class ContextRow:
    """One policy under one form."""

    policy: str
    form: str
    context_bytes_per_s: float
    """Descriptors of the whole fleet."""
    data_bytes_per_s: float
    difference: Difference
    """AP@0.5 under the paper's form (a) and this one (b), paired, by blocks of `BLOCK_S` of a sortie."""


def measure(
    seeds: Sequence[int], duration_s: float, policies: Sequence[str] = POLICIES, forms: Sequence[str] = tuple(FORMS)
) -> Iterator[ContextRow]:
    """One row a policy and form; the paper's form is flown first for each policy."""
    for policy in policies:
        first = [_flown(policy, seed, duration_s, ()) for seed in seeds]
        for form in forms:
            records = [_flown(policy, seed, duration_s, FORMS[form]) for seed in seeds] if FORMS[form] else first
            figures = [outcome(r)["bytes"] for r in records]
            over_s = duration_s * len(seeds)
            yield ContextRow(
                policy,
                form,
                sum(f["context_descriptors"] for f in figures) / over_s,
                sum(f["data_sent"] for f in figures) / over_s,
                compare(*pair_up(first, records, mission=False)),
            )


def _flown(policy: str, seed: int, duration_s: float, settings: Sequence[str]) -> SortieRecord:
    fixed = [f"duration_s={duration_s:g}", "perception.detector=surrogate", "expect=[]", "expect_decisions=[]"]
    return run_sortie(load(SCENARIO, [*fixed, *settings]), policy, seed)


def table(rows: Sequence[ContextRow], about: str = "") -> Table:
    """A row a policy and form; differences in AP points."""
    return Table(
        [
            Column("policy"),
            Column("descriptor"),
            Column("context", ".2f", " kB/s", 1e-3),
            Column("data", ".1f", " MB/s", 1e-6),
            Column("AP@0.5", ".3f"),
            Column("against the paper's", "+.1f", factor=100),
        ],
        [
            [
                r.policy, r.form, r.context_bytes_per_s, r.data_bytes_per_s, r.difference.ap_b,
                points(r.difference) if FORMS[r.form] else None,
            ]
            for r in rows
        ],
        about,
    )  # fmt: skip
