"""Every claim of the paper's Evaluation section as data: its text, how it is measured here, and the rule that judges it.

AP differences are in points, absolute APs from 0 to 1, both as the paper prints them. Where a policy is "the best
two-peer policy" it is the best of best-2, worst-2 and random-2 at that budget, as in the paper. The paper's conditions:
unsent cells are zeros, cells by confidence, a budget's cells not steered by the mission's region.

Several claims can state one effect: a contrast and its mirror, a contrast told twice, one sentence over four budgets, or a
consequence of other claims. They bear the name of that effect (`Claim.effect`), and the effect is counted once. What
follows from definitions or by arithmetic is no effect (`Claim.kind`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

from research.paper import verdict
from research.paper.measures import (
    ApOf,
    Contrast,
    Crossover,
    Elsewhere,
    FleetFrameBytes,
    Kept,
    MeanLevel,
    Measure,
    Oracle,
    Peak,
    Region,
    UnequalBytes,
    Widest,
    WrongChoice,
)
from research.paper.verdict import Judgement, MeasuredValue, Paper
from research.paper.ways import FULL_SHARING, SINGLE, Sharing

CURVE = (0.01, 0.02, 0.05, 0.1, 0.25, 1.0)
BUDGETS = (0.02, 0.05, 0.1, 0.25)
TWO_PEERS = ("best-2", "worst-2", "random-2")
MARGIN: dict[Region, float] = {"full": 1.2, "mission": 2.8}
"""AP points within which two ways count as equal. Half the width of the narrowest interval by which the paper itself finds no
difference there: smaller differences it could not have told from none. The least differences that it reports as findings are
larger, 1.4 points in the full scene and 5.9 in the mission's disc."""
KEPT_MARGIN = 7.0
"""Per cent of the gain within which two shares of it count as equal: half the width of the paper's interval of a difference
from full sharing, 1.3 points, over its gain of 18.5."""

Rule = Callable[[Paper, MeasuredValue | None], Judgement]


class Kind(StrEnum):
    """What a claim is about; each kind is counted apart."""

    EFFECT = "effect"
    """How AP depends on what is shared: what an experiment can find or not."""
    ARITHMETIC = "arithmetic"
    """Follows from definitions, wire sizes or other figures of the paper."""
    LEVEL = "level"
    """An absolute AP, which is not judged."""
    COST = "cost"
    """A time, a rate or a reaction of the context plane in flight."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim: a number of the paper, or something that it says without one."""

    id: str
    place: str
    """Subsection of the Evaluation, and sentence within it."""
    says: str
    """In our words; short enough for a table."""
    unit: str
    """AP points, AP, %, MB, kB/s, MB/s, B, ms, s, ×."""
    paper: Paper
    measure: Measure
    rule: Rule = verdict.contrast
    headline: bool = False
    """Whether it stands in the README's short table."""
    follows: bool = False
    """Arithmetic on the paper's figures, not a sentence of it."""
    defined: bool = False
    """A sentence of the paper that follows from definitions, wire sizes or its other figures."""
    effect: str = ""
    """The effect that it states; empty: one of its own."""

    @property
    def kind(self) -> Kind:
        """Decides where it is counted."""
        if self.rule is verdict.level:
            return Kind.LEVEL
        if self.follows or self.defined:
            return Kind.ARITHMETIC
        return Kind.COST if isinstance(self.measure, Elsewhere) else Kind.EFFECT


def all_4(budget: float) -> Sharing:
    """Spreading: every peer shares."""
    return Sharing(budget)


def two(budget: float) -> tuple[Sharing, ...]:
    """Concentrating: the two-peer policies at the same bytes."""
    return tuple(Sharing(budget, peers) for peers in TWO_PEERS)


POLICIES = tuple(tuple(Sharing(budget, peers) for budget in BUDGETS) for peers in ("all-4", *TWO_PEERS))
"""The fixed policies that the paper's oracle switches among, by budget."""


def _against_full(budget: float, region: Region = "full") -> Contrast:
    return Contrast((all_4(budget),), (FULL_SHARING,), region)


def _pair(budget: float, a: str, b: str, region: Region = "full") -> Contrast:
    return Contrast((Sharing(budget, a),), (Sharing(budget, b),), region)


def _overlap_against_uniform(budget: float) -> Contrast:
    return Contrast((Sharing(budget, allocation="overlap"),), (all_4(budget),))


POINTS, AP = "AP points", "AP"

SET_UP = (
    Claim(
        "bytes.full", "set-up, 6", "Full sharing sends 13.1 MB a fleet-frame", "MB",
        Paper(13.1), FleetFrameBytes(FULL_SHARING), verdict.exact, defined=True,
    ),
)  # fmt: skip

GAIN = (
    Claim("single", "gain, 1", "AP of a single drone", AP, Paper(0.185, digits=3), ApOf(SINGLE), verdict.level),
    Claim("full", "gain, 2", "AP at full sharing", AP, Paper(0.371, digits=3), ApOf(FULL_SHARING), verdict.level),
    Claim(
        "gain", "gain, 2", "Cooperation gains", POINTS,
        Paper(18.5, 16.9, 20.3), Contrast((FULL_SHARING,), (SINGLE,)), headline=True,
    ),
    Claim(
        "curve.0.1", "gain, 5", "Budget 0.1 against full sharing", POINTS,
        Paper(-2.0, -3.4, -0.8), _against_full(0.1), headline=True,
    ),
    Claim(
        "kept.0.1", "gain, 5", "Budget 0.1 keeps most of the gain", "%",
        Paper(89.0, digits=0), Kept(all_4(0.1)), verdict.most, headline=True, follows=True,
    ),
    Claim(
        "kept.0.05", "gain, 6", "Budget 0.05 keeps, of the gain", "%",
        Paper(58.0, margin=KEPT_MARGIN, digits=0), Kept(all_4(0.05)), verdict.same_value, headline=True,
    ),
    Claim(
        "curve.0.05", "gain, 6", "Budget 0.05 against full sharing", POINTS,
        Paper(-7.8), _against_full(0.05), follows=True,
    ),
    Claim("curve.0.01", "gain, 7", "Budget 0.01 against full sharing", POINTS, Paper(-24.0, digits=0), _against_full(0.01), headline=True),
    Claim(
        "starved", "gain, 7", "Budget 0.01 is worse than a single drone", POINTS,
        Paper(-5.4), Contrast((all_4(0.01),), (SINGLE,)), headline=True, follows=True,
    ),
    Claim(
        "curve.0.02", "budget, 2", "Budget 0.02 against full sharing", POINTS,
        Paper(-19.1), _against_full(0.02), follows=True,
    ),
    Claim("level.0.01", "gain, 7", "AP at a budget of 0.01", AP, Paper(0.131, digits=3), ApOf(all_4(0.01)), verdict.level, follows=True),
    Claim("level.0.02", "budget, 2", "AP at a budget of 0.02", AP, Paper(0.180, digits=3), ApOf(all_4(0.02)), verdict.level, follows=True),
    Claim("level.0.05", "gain, 6", "AP at a budget of 0.05", AP, Paper(0.293, digits=3), ApOf(all_4(0.05)), verdict.level, follows=True),
    Claim("level.0.1", "gain, 5", "AP at a budget of 0.1", AP, Paper(0.351, digits=3), ApOf(all_4(0.1)), verdict.level, follows=True),
    Claim("level.0.25", "figure, a", "AP at a budget of 0.25 (drawn, not printed)", AP, Paper(), ApOf(all_4(0.25)), verdict.level),
)  # fmt: skip

MISSION = (
    Claim("mission.full", "mission, 2", "Mission AP at full sharing", AP, Paper(0.763, digits=3), ApOf(FULL_SHARING, "mission"), verdict.level),
    Claim("mission.0.05", "mission, 2", "Mission AP at a budget of 0.05", AP, Paper(0.773, digits=3), ApOf(all_4(0.05), "mission"), verdict.level),
    Claim("mission.0.1", "mission, 2", "Mission AP at a budget of 0.1", AP, Paper(0.784, digits=3), ApOf(all_4(0.1), "mission"), verdict.level),
    Claim(
        "mission.widest", "mission, 3", "Mission AP against full sharing, at the budget of 0.05 or 0.1 with the larger difference", POINTS,
        Paper(2.2, -0.5, 5.1, MARGIN["mission"]),
        Widest((_against_full(0.05, "mission"), _against_full(0.1, "mission"))), verdict.no_difference, headline=True,
        effect="mission under a budget",
    ),
    Claim(
        "mission.tenth", "mission, 4", "Mission AP at a budget of 0.1 against full sharing", POINTS,
        Paper(margin=MARGIN["mission"]), _against_full(0.1, "mission"), verdict.no_difference,
        effect="mission under a budget",
    ),
    Claim(
        "mission.peak", "figure, a", "Mission AP peaks at 5–10 % of the bytes", "%",
        Paper(low=5.0, high=10.0, digits=0), Peak(tuple(map(all_4, CURVE)), "mission"), verdict.same_place,
    ),
)  # fmt: skip

PEERS = (
    Claim(
        "matched", "peers, 2", "Matched policies differ in bytes by", "%",
        Paper(0.0), UnequalBytes(POLICIES), verdict.exact, defined=True,
    ),
    Claim(
        "peers.worst-best", "peers, 3", "Budget 0.25: worst-2 − best-2", POINTS,
        Paper(0.8, -0.8, 2.3, MARGIN["full"]), _pair(0.25, "worst-2", "best-2"), verdict.no_difference, headline=True,
    ),
    Claim(
        "peers.worst-random", "peers, 3", "Budget 0.25: worst-2 − random-2", POINTS,
        Paper(0.1, -1.1, 1.3, MARGIN["full"]), _pair(0.25, "worst-2", "random-2"), verdict.no_difference,
    ),
    Claim(
        "peers.best-random", "peers, 3", "Budget 0.25: best-2 − random-2", POINTS,
        Paper(-0.7, margin=MARGIN["full"]), _pair(0.25, "best-2", "random-2"), verdict.no_difference, follows=True,
    ),
    Claim(
        "peers.all", "peers, 6", "Budget 0.25: all four over the best two", POINTS,
        Paper(4.8, 3.8, 5.8), Contrast((all_4(0.25),), two(0.25)), headline=True,
        effect="two or four at a budget of 0.25",
    ),
)  # fmt: skip

_CONCENTRATING = tuple(Contrast(two(budget), (all_4(budget),)) for budget in BUDGETS)
FLIP = (
    Claim(
        "flip.0.02", "budget, 2", "Budget 0.02: the best two over all four", POINTS,
        Paper(7.7, 6.6, 8.9), _CONCENTRATING[0], headline=True,
        effect="two or four at a budget of 0.02",
    ),
    Claim(
        "flip.0.05", "budget, 3", "Budget 0.05: the best two over all four", POINTS,
        Paper(1.4, 0.2, 2.7), _CONCENTRATING[1], headline=True,
        effect="two or four at a budget of 0.05",
    ),
    Claim(
        "flip.0.1", "budget, 5", "Budget 0.1: the best two over all four", POINTS,
        Paper(-4.0, -5.3, -2.8), _CONCENTRATING[2], headline=True,
        effect="two or four at a budget of 0.1",
    ),
    Claim(
        "flip.0.25", "budget, 6", "Budget 0.25: the best two over all four", POINTS,
        Paper(-4.8, -5.8, -3.8), _CONCENTRATING[3], effect="two or four at a budget of 0.25",
    ),
    Claim(
        "flip.crossover", "budget, 7", "The lead changes between 5 and 10 % of the bytes, at", "%",
        Paper(low=5.0, high=10.0, digits=0), Crossover(_CONCENTRATING), verdict.same_place, headline=True,
        defined=True,  # follows from the four contrasts above
    ),
    Claim(
        "wrong.starved", "budget, 9", "The winner at a budget of 0.25, used at 0.02: change of AP", POINTS,
        Paper(-7.7), WrongChoice(POLICIES, chosen_at=3, judged_at=0), headline=True,
        effect="two or four at a budget of 0.02",
    ),
    Claim(
        "wrong.plentiful", "budget, 9", "The winner at a budget of 0.02, used at 0.25: change of AP", POINTS,
        Paper(-4.8), WrongChoice(POLICIES, chosen_at=0, judged_at=3), headline=True,
        effect="two or four at a budget of 0.25",
    ),
    Claim("oracle.level", "budget, 11", "Mean AP of the oracle", AP, Paper(0.320, digits=3), MeanLevel(POLICIES, fixed=False), verdict.level),
    Claim("fixed.level", "budget, 11", "Mean AP of the best fixed policy", AP, Paper(0.299, digits=3), MeanLevel(POLICIES, fixed=True), verdict.level),
    Claim("oracle", "budget, 11", "The oracle over the best fixed policy", POINTS, Paper(2.1), Oracle(POLICIES), headline=True, defined=True),  # the difference of the two levels above
    Claim(
        "oracle.held-out", "budget, 13", "The same, chosen on half of the frames, judged on the rest", POINTS,
        Paper(2.0), Oracle(POLICIES, held_out=True), headline=True, effect="choosing by budget",
    ),
)  # fmt: skip

ALLOCATION = tuple(
    Claim(
        f"allocation.{budget:g}", "budget, 18", f"Budget {budget:g}: allocation by overlap − uniform", POINTS,
        Paper(margin=MARGIN["full"]), _overlap_against_uniform(budget), verdict.no_difference, headline=budget == 0.1,
        effect="allocation",
    )
    for budget in BUDGETS
)  # fmt: skip

COMPOSITION = (
    Claim("compose.best", "composition, 2", "AP of best-2 at a budget of 0.02", AP, Paper(0.257, digits=3), ApOf(Sharing(0.02, "best-2")), verdict.level),
    Claim("compose.worst", "composition, 2", "AP of worst-2 at a budget of 0.02", AP, Paper(0.257, digits=3), ApOf(Sharing(0.02, "worst-2")), verdict.level),
    Claim(
        "compose.tie", "composition, 2", "Budget 0.02, full scene: best-2 − worst-2", POINTS,
        Paper(0.0, margin=MARGIN["full"]), _pair(0.02, "best-2", "worst-2"), verdict.no_difference, headline=True,
    ),
    Claim("compose.mission.best", "composition, 5", "Mission AP of best-2 at a budget of 0.02", AP, Paper(0.787, digits=3), ApOf(Sharing(0.02, "best-2"), "mission"), verdict.level),
    Claim("compose.mission.worst", "composition, 5", "Mission AP of worst-2 at a budget of 0.02", AP, Paper(0.728, digits=3), ApOf(Sharing(0.02, "worst-2"), "mission"), verdict.level),
    Claim(
        "compose.mission", "composition, 5", "Budget 0.02, mission: best-2 − worst-2", POINTS,
        Paper(5.9, 2.5, 9.4), _pair(0.02, "best-2", "worst-2", "mission"), headline=True,
    ),
    Claim(
        "compose.spread", "composition, 7", "Budget 0.05, mission: all four over the best two", POINTS,
        Paper(3.1, -0.6, 7.0, MARGIN["mission"]), Contrast((all_4(0.05),), two(0.05), "mission"), verdict.no_difference, headline=True,
    ),
)  # fmt: skip

OVERHEAD = (
    Claim("plane.descriptor", "overhead, 3", "A descriptor", "B", Paper(180.0, digits=0), Elsewhere("descriptor_bytes"), verdict.exact, defined=True),
    Claim("plane.counted", "overhead, 3", "Four descriptors at 10 Hz and 80 directives a second, by the wire's sizes", "kB/s", Paper(10.1), Elsewhere("counted_kb_per_s"), verdict.exact, headline=True, defined=True),
    Claim("plane.rate", "overhead, 3", "Context plane as flown", "kB/s", Paper(10.1), Elsewhere("context_kb_per_s"), verdict.same_order),
    Claim("plane.data", "overhead, 4", "Data plane that it steers", "MB/s", Paper(105.0, digits=0), Elsewhere("data_mb_per_s"), verdict.same_order),
    Claim("plane.share", "overhead, 5", "Context over data", "%", Paper(0.01, digits=2), Elsewhere("context_percent"), verdict.at_most, headline=True, defined=True),
    Claim("plane.median", "overhead, 6", "A policy decision, median", "ms", Paper(0.10, digits=2), Elsewhere("policy_ms_p50"), verdict.at_most, headline=True),
    Claim("plane.p99", "overhead, 6", "A policy decision, 99th percentile", "ms", Paper(0.13, digits=2), Elsewhere("policy_ms_p99"), verdict.at_most),
    Claim("plane.deadline", "overhead, 7", "The 100 ms deadline over a decision's median", "×", Paper(1000.0, digits=0), Elsewhere("deadline_over_p50"), verdict.at_least, defined=True),
    Claim("plane.core", "overhead, 8", "Of one core, the ROS 2 prototype uses", "%", Paper(9.0, digits=0), Elsewhere("ros2_core_percent"), verdict.at_most),
    Claim("plane.x86.data", "overhead, 9", "Data plane in an x86 container", "MB/s", Paper(62.0, digits=0), Elsewhere("x86_container_mb_per_s"), verdict.same_order),
    Claim("plane.x86.median", "overhead, 9", "A policy decision on x86, median", "ms", Paper(0.03, digits=2), Elsewhere("x86_policy_ms_p50"), verdict.at_most),
    Claim("plane.roi", "overhead, 11", "A phase change shrinks feature payloads", "×", Paper(10.0, digits=0), Elsewhere("roi_shrinks"), verdict.same_order, headline=True),
    Claim("plane.battery", "overhead, 12", "Battery decay moves agent 1 down the rate ladder, rungs met", "of 3", Paper(3.0, digits=0), Elsewhere("battery_rungs"), verdict.exact),
    Claim("plane.link", "overhead, 12", "A link drop at 60 s leaves drone 2 with detections, after", "s", Paper(0.1), Elsewhere("link_drop_s"), verdict.at_most, headline=True),
)  # fmt: skip

SECTIONS: dict[str, tuple[Claim, ...]] = {
    "Set-up": SET_UP,
    "Cooperative gain and the byte–accuracy frontier": GAIN,
    "Mission context": MISSION,
    "Peer selection": PEERS,
    "Budget sensitivity": FLIP,
    "Allocation": ALLOCATION,
    "Composition of context axes": COMPOSITION,
    "Overhead of the context plane": OVERHEAD,
}
CLAIMS: tuple[Claim, ...] = tuple(claim for claims in SECTIONS.values() for claim in claims)


def conditions(claims: Iterable[Claim] = CLAIMS) -> tuple[Sharing, ...]:
    """What has to be evaluated for the claims, each once, in their order."""
    return tuple(dict.fromkeys(c for claim in claims for c in claim.measure.conditions()))
