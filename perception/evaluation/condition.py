"""One way of sharing, as the evaluation measures it. Free of torch.

The paper's knobs, each defined in this folder's README: how much (the received budget), from whom (peers), in which parts
(allocation), which cells (rank, region of interest first), and what a cell that was not sent counts as.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from typing import Literal, NamedTuple, get_args

from sortie.perception.errors import InputError

Allocation = Literal["uniform", "overlap"]
CellsBy = Literal["confidence", "norm"]
Unsent = Literal["zero", "masked"]
Absent = Literal["excluded", "zeros"]
Serve = Literal["grid", "region_first"]
_PEERS = re.compile(r"none|(all|best|worst|random)-([1-9]\d?)")
_ALLOWED = {
    "allocation": get_args(Allocation),
    "cells_by": get_args(CellsBy),
    "unsent": get_args(Unsent),
    "absent": get_args(Absent),
}


class Ways(NamedTuple):
    """What an instrument does with peers that were not chosen, and which cells it sends first."""

    absent: Absent = "excluded"
    serve: Serve = "grid"
    """All cells by rank, or those of the mission's disc before all others."""


PAPER_WAYS = Ways()


@dataclass(frozen=True, slots=True)
class Sharing:
    """What every ego of every frame receives.

    Raises:
        InputError: naming the field, its value and what it must be.
    """

    received_budget: float
    """Cells shared to each ego, as a fraction of full sharing (4 peers × 4096 cells in a fleet of five), 0 … 1."""
    peers: str = "all-4"
    """all-k, best-k, worst-k, random-k, or none: a drone alone. All of them share the same total of cells."""
    allocation: Allocation = "uniform"
    """How the total is divided among the peers: equally, or in proportion to their overlap with the ego."""
    cells_by: CellsBy = "confidence"
    """What ranks a sender's cells."""
    unsent: Unsent = "zero"
    """A cell that was not sent takes part in the fusion as zeros, or is left out (masked)."""
    roi: bool = False
    """Whether cells in the mission's disc come before all others."""
    absent: Absent = "excluded"
    """A peer that was not chosen has no part in the fusion, or takes part as zeros wherever its grid reaches."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.received_budget <= 1.0:
            raise InputError(f"received_budget is {self.received_budget}, must be 0 to 1")
        if not _PEERS.fullmatch(self.peers):
            raise InputError(
                f"peers is {self.peers!r}, must be none, or all-k, best-k, worst-k or random-k with k 1 to 99"
            )
        for name, allowed in _ALLOWED.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"{name} is {getattr(self, name)!r}, must be {' or '.join(allowed)}")
        if self.peers == "none" and self.received_budget != 0.0:
            raise InputError(f"received_budget is {self.received_budget} with no peers, must be 0")

    @property
    def rule(self) -> str:
        """all, best, worst, random or none."""
        return self.peers.split("-")[0]

    @property
    def k(self) -> int:
        """How many peers share."""
        return 0 if self.peers == "none" else int(self.peers.split("-")[1])

    @property
    def label(self) -> str:
        """A short name, such as `best-2@0.02` or `all-4@0.1,overlap,norm,masked,roi`; `parse` reads it."""
        if self.peers == "none":
            return "single"
        budget = (
            f"{self.received_budget:g}"
            if float(f"{self.received_budget:g}") == self.received_budget
            else repr(self.received_budget)
        )
        marks = [
            str(getattr(self, f.name))
            for f in fields(self)
            if f.name in _ALLOWED and getattr(self, f.name) != f.default
        ]
        return ",".join([f"{self.peers}@{budget}", *marks, *(["roi"] if self.roi else [])])

    @classmethod
    def parse(cls, label: str) -> Sharing:
        """The condition that a label names.

        Raises:
            InputError: a label that no condition has.
        """
        if label == "single":
            return SINGLE
        head, *marks = label.split(",")
        peers, at, budget = head.partition("@")
        known = {value: name for name, values in _ALLOWED.items() for value in values}
        try:
            if not at:
                raise InputError("no @ in it")
            knobs: dict[str, str] = {known[m]: m for m in marks if m != "roi"}
            return cls(float(budget), peers, roi="roi" in marks, **knobs)  # type: ignore[arg-type]
        except (ValueError, KeyError) as error:
            raise InputError(f"condition is {label!r}, must be like best-2@0.02,masked ({error})") from None

    def plain(self, drones: int = 5) -> Sharing:
        """The simplest condition that gives the same boxes in a fleet of this size; what is equal is computed once.

        Knobs that choose among cells say nothing when every cell goes, nor those that choose among peers when all
        peers share.
        """
        others = drones - 1
        out = self
        if out.k and out.k == others:
            out = replace(out, peers=f"all-{others}")
        if out.k and out.received_budget * others >= out.k:
            out = replace(out, allocation="uniform", cells_by="confidence", roi=False)
        if out.unsent == "masked" or out.k in (0, others):
            out = replace(out, absent="excluded")
        if out.received_budget == 0.0 and out.unsent == "masked":
            return SINGLE
        return out


SINGLE = Sharing(0.0, "none")
"""A drone alone."""
FULL_SHARING = Sharing(1.0)
"""Every peer sends every cell."""
