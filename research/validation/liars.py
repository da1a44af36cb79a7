"""What one liar costs, with and without trust, and whom trust doubts where nobody lies (`make figures FIGURE=liars`).

Each row flies the same sorties three times: everyone honest, one drone lying from the fifth second on, and the same
with trust. AP is of the honest drones alone, from the moment of the lie, and scored by the surrogate detector.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from research.validation.pairs_of_records import pair_up
from research.validation.stored import Column, Table, points
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.policies.registry import resolve, within_budget
from sortie.scenarios.reading.load import library, load
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.compare import BLOCK_S
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SCENARIO, LIAR, SINCE_S = "track_target", 2, 5.0
BUDGET = 0.1
"""Of a map on each link: five drones' links of it fit into the channel."""
POLICIES = ("worked", "who2com-style", "deputies")
LIES = (("coverage", "much"), ("coverage", "little"), ("goodput", "little"), ("battery", "much"))


@dataclass(frozen=True, slots=True)
class LiarRow:
    """One policy and one lie; differences are in AP@0.5 of the honest drones, paired, by blocks of `BLOCK_S` of a sortie."""

    policy: str
    lie: str
    untrusting: Difference
    """Everyone honest (a), one liar and no trust (b)."""
    trusting: Difference
    """Everyone honest (a), one liar and trust (b)."""
    doubting: int
    """How many (sortie, drone) came to doubt the liar, of four a sortie."""
    wronged: int
    """How many came to doubt somebody else."""


def measure(seeds: Sequence[int], duration_s: float, policies: Sequence[str] = POLICIES) -> Iterator[LiarRow]:
    """One row a policy and lie."""
    for policy in policies:
        honest = [_flown(policy, seed, duration_s, "true") for seed in seeds]
        for about, claim in LIES:
            lie = f"events=[{{kind: lie, at_s: {SINCE_S}, drone: {LIAR}, about: {about}, claim: {claim}}}]"
            without, trusting = (
                [_flown(policy, seed, duration_s, trust, lie) for seed in seeds] for trust in ("false", "true")
            )
            doubts = [outcome(r)["distrusted_by"] for r in trusting]
            yield LiarRow(
                policy,
                f"{about}: {claim}",
                _lost(honest, without),
                _lost(honest, trusting),
                sum(d.get(str(LIAR), 0) for d in doubts),
                sum(n for d in doubts for peer, n in d.items() if peer != str(LIAR)),
            )


def false_alarms(seeds: Sequence[int], duration_s: float) -> tuple[int, int]:
    """Doubts among honest drones over the library's scenarios, and drone-pair-minutes flown."""
    alarms, minutes = 0, 0.0
    for name in library():
        for policy in POLICIES:
            for seed in seeds:
                scenario = load(name, ["perception.detector=none", f"duration_s={duration_s:g}", "events=[]"])
                alarms += sum(outcome(run_sortie(scenario, policy, seed))["distrusted_by"].values())
                minutes += scenario.fleet.drones * (scenario.fleet.drones - 1) * duration_s / 60
    return alarms, round(minutes)


def _flown(policy: str, seed: int, duration_s: float, trust: str, *more: str) -> SortieRecord:
    """In a line, where a drone's place decides what it can add, and while searching, so that every cell counts."""
    scenario = load(
        SCENARIO,
        [
            "expect=[]", "expect_decisions=[]", "fleet.formation.shape=line", "mission.phases=[{at_s: 0, phase: search}]",
            f"policy.name={policy}", f"policy.params={within_budget(resolve(policy), BUDGET)}", f"duration_s={duration_s:g}",
            "perception.detector=surrogate", f"context.trust={trust}",
            *more,
        ],
    )  # fmt: skip
    return run_sortie(scenario, None, seed)


def _lost(honest: Sequence[SortieRecord], lied_to: Sequence[SortieRecord]) -> Difference:
    """AP of the others, from when the liar begins."""
    return compare(*pair_up(honest, lied_to, mission=False, begin_s=SINCE_S, leaving_out={LIAR}))


def tables(seeds: Sequence[int], duration_s: float) -> dict[str, Table]:
    """What a liar costs, and how often honest drones are doubted."""
    rows = list(measure(seeds, duration_s))
    alarms, minutes = false_alarms(seeds, duration_s)
    return {
        "liars": Table(
            [
                Column("policy"),
                Column(f"drone {LIAR} claims"),
                Column("AP honest", ".3f"),
                *(Column(name, "+.1f", factor=100) for name in ("change, no trust", "change, trust")),
                *(Column(name, ".0f") for name in ("doubt it", "of", "doubt others")),
            ],
            [
                [
                    r.policy, r.lie, r.untrusting.ap_a, points(r.untrusting), points(r.trusting),
                    r.doubting, 4 * len(seeds), r.wronged,
                ]
                for r in rows
            ],
            f"{len(seeds)} sorties of {duration_s:g} s for each row; change of AP against the honest fleet, in points, with "
            f"intervals over blocks of {BLOCK_S:g} s of the sorties.",
        ),
        "false_alarms": Table(
            [Column("false alarms where nobody lies", ".0f"), Column("minutes of one drone judging another", ",.0f")],
            [[alarms, minutes]],
        ),
    }  # fmt: skip
