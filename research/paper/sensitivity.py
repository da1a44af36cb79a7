"""How much verdicts depend on what the paper leaves open: the score threshold and the mission's disc. Free of torch.

Nothing is evaluated anew: scores are kept down to the floor, so that any τ is applied afterwards, and boxes are
matched in the disc around the mission's target and in the one around the ego alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from research.paper.claims import CLAIMS, Claim
from research.paper.results import DiscCentre, TableResults
from sortie.perception.evaluation.sharing import Unsent

TAUS = (0.01, 0.1, 0.2, 0.3, 0.5)
DISCS: dict[DiscCentre, str] = {"mission": "around the target", "ego": "around the ego"}
BY_TAU = ("gain", "curve.0.1", "starved", "flip.0.02", "flip.0.05", "flip.0.1", "flip.0.25", "oracle.held-out")
BY_DISC = ("mission.full", "mission.widest", "mission.tenth", "mission.peak", "compose.mission", "compose.spread")
"""Claims that are judged again."""


@dataclass(frozen=True, slots=True)
class Varied:
    """One claim at another setting."""

    id: str
    instrument: str
    knob: str
    """tau or disc."""
    setting: str
    value: float | None
    low: float | None
    high: float | None
    verdict: str


def sensitivity(results: TableResults, claims: Sequence[Claim] = CLAIMS) -> list[Varied]:
    """The claims above over all thresholds and discs, under every instrument that was evaluated."""
    by_id = {c.id: c for c in claims}
    out = []
    for unsent in results.settings.unsent:
        out += [_varied(results, by_id[i], unsent, "tau", f"{tau:g}", tau=tau) for i in BY_TAU for tau in TAUS]
        out += [
            _varied(results, by_id[i], unsent, "disc", name, disc=disc) for i in BY_DISC for disc, name in DISCS.items()
        ]
    return out


def _varied(
    results: TableResults,
    claim: Claim,
    unsent: Unsent,
    knob: str,
    setting: str,
    *,
    tau: float | None = None,
    disc: DiscCentre = "mission",
) -> Varied:
    measured = claim.measure.measure(results.scores(unsent, tau=tau, disc=disc))  # type: ignore[union-attr]
    value = measured.value if measured.value == measured.value else None
    verdict = str(claim.rule(claim.paper, measured).verdict)
    return Varied(claim.id, unsent, knob, setting, value, measured.low, measured.high, verdict)
