"""What policies decided: how often, how often that was put right, and each change of what links carry."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np
import pyarrow as pa

from sortie.policies.verification.enforced import CAUSES
from sortie.scenarios.representation import CELL_NAMES
from sortie.sim.results.record import DECISIONS_OF, VIOLATIONS_OF
from sortie.sim.results.section import Count, Flown, OutcomeSection, Seconds, figure, once


class Violations(OutcomeSection):
    policy: Count = figure("The policy's decision, after its shield.")
    staleness: Count = figure("The caps on links to peers with old descriptors.")
    damping: Count = figure("A link that waited for its dwell time.")
    no_peer: Count = figure("No peer was attached, and the line is over all links.")


class PoliciesOutcome(OutcomeSection):
    decisions: dict[str, Count] = figure("By policy.")
    changes: Count = figure("How often a drone's policy was replaced in flight.")
    shield_interventions: Count = figure(
        "Directives that the shield replaced or could not put right, and its changes at gates."
    )
    invariant_violations: Count = figure(
        "Violations of invariants by what gates enforced, after staleness and damping; one that lasts counts once."
    )
    violated_ticks: Count = figure("Decisions of all drones at which the enforced directives broke an invariant.")
    violations_by_cause: Violations = figure("`invariant_violations`, by the step that broke the line.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, Any]:
        totals = flown.record.totals
        return {
            "decisions": {k.removeprefix(DECISIONS_OF): v for k, v in totals.items() if k.startswith(DECISIONS_OF)},
            "changes": totals["policy_changes"],
            **{name: totals[name] for name in ("shield_interventions", "invariant_violations", "violated_ticks")},
            "violations_by_cause": {c.replace(" ", "_"): totals[f"{VIOLATIONS_OF}{c}"] for c in CAUSES},
        }


class Transition(OutcomeSection):
    t_s: Seconds = figure("When.")
    drone: Count = figure("Whose links.")
    peers: list[Count] = figure("To whom; links that change alike share an entry.")
    from_: str = figure("What they carried, in words.", alias="from")
    to: str = figure("What they carry now.")
    reason: str = figure("The reason that decided it.")


@once
def all_transitions(flown: Flown) -> list[dict[str, Any]]:
    """The section `transitions`."""
    return list(transitions(flown.tables["directives"], {}))


def describe(row: dict[str, Any]) -> str:
    """A directive in words: `features ρ=0.25 at 10 Hz in 32 m`."""
    if row["representation"] == "none" or row["rate_hz"] <= 0:
        return "nothing"
    budget = f" ρ={row['rho']:.3g}" if row["representation"] in CELL_NAMES else ""
    roi = "" if np.isnan(row["roi_radius_m"]) else f" in {row['roi_radius_m']:.0f} m"
    return f"{row['representation']}{budget} at {row['rate_hz']:g} Hz{roi}"


def changes(directives: pa.Table, carried: dict[tuple[int, int], str]) -> Iterator[tuple[dict[str, Any], str, str]]:
    """The directives that change what their link carries (a disc that moves is no change), with what before and after.

    `carried` is what each (drone, peer) carried before. It is brought up to date when the next change is asked for.
    """
    for row in chain.from_iterable(batch.to_pylist() for batch in directives.to_batches()):
        link, level = (row["drone"], row["peer"]), describe(row)
        before = carried.get(link, "nothing")
        if level != before:
            yield row, before, level
            carried[link] = level


def transitions(directives: pa.Table, carried: dict[tuple[int, int], str]) -> Iterator[dict[str, Any]]:
    """The `changes` of links; those of a drone that change alike in one entry.

    The same entries as `outcome.json` has, but in slices: `carried` is what each (drone, peer) carried before and is
    brought up to date. Each entry comes before the next one's changes are in `carried`.
    """
    entry: dict[str, Any] | None = None
    for row, before, level in changes(directives, carried):
        change = {"t_s": row["t_s"], "drone": row["drone"], "from": before, "to": level, "reason": row["reason"]}
        if entry is not None and all(entry[k] == v for k, v in change.items()):
            entry["peers"].append(row["peer"])
        else:
            if entry is not None:
                yield entry
            entry = {**change, "peers": [row["peer"]]}
    if entry is not None:
        yield entry
