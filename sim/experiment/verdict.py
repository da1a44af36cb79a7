"""What verification says of a policy that is ranked, in a few words."""

from __future__ import annotations

from dataclasses import dataclass

from sortie.policies.contract import Policy
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.proof.proof import prove

SEARCH_CELLS = 40_000
"""Cells that the search for views that break the plane's rules may visit."""


@dataclass(frozen=True, slots=True)
class Verified:
    """What `sortie verify` finds, without the properties that a policy states itself."""

    rules: int
    """Rules of the conformance kit, each tried on drawn views."""
    broken: tuple[str, ...]
    """The names of the rules that do not hold."""
    contract: str
    """Whether the decisions keep the contract: one of `WORDS`."""
    monotone: str
    """Whether older descriptors never raise what is sent: likewise."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "broken", tuple(self.broken))
        for name in ("contract", "monotone"):  # results of before 0.3 have further words
            object.__setattr__(self, name, _STORED.get(getattr(self, name), getattr(self, name)))

    @property
    def keeps_all(self) -> bool:
        """Whether no rule is broken and nothing is refuted."""
        return not self.broken and "refuted" not in (self.contract, self.monotone)

    @property
    def text(self) -> str:
        """In a table's cell."""
        if self.broken:
            return f"{len(self.broken)} of {self.rules} broken"
        weakest = next(w for w in (*WORDS, self.contract) if w in (self.contract, self.monotone))
        return weakest


WORDS = ("refuted", "tried", "proved")
"""Verdicts, the weakest first."""
_STORED = {"drawn": "tried", "searched": "tried", "proved over the reals": "proved"}


def verify(policy: Policy, cells: int = SEARCH_CELLS) -> Verified:
    """Try a policy against the conformance kit, and prove the two rules of the plane as far as the budget goes.

    Args:
        cells: how many the search may visit.
    """
    checks = conform(policy)
    contract, monotone = (v.outcome for v in prove(policy, [], cells=cells)[:2])
    return Verified(len(checks), tuple(c.name for c in failing(checks)), contract, monotone)
