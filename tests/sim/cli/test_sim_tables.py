"""What is printed: figures with their intervals, and what users and policies wrote as they wrote it."""

from __future__ import annotations

import io
import math

from rich.table import Table
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.scenarios.report_text import points
from sortie.sim.check.expectations import Verdict
from sortie.sim.cli.tables import verdict_table
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.summary import transitions_table
from sortie.sim.terminal import Terminal

REASON = "as in [roi] and [/roi]"
"""Which the terminal's markup would swallow, or stumble over."""


def printed(table: Table) -> str:
    console = Terminal(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_points_without_an_interval_stand_alone() -> None:
    assert points((0.013, 0.005, 0.02)) == "1.3 [0.5, 2.0]"
    assert points((0.013, math.nan, math.nan), "+.2f") == "+1.30"


def test_brackets_in_a_policys_reason_are_brackets() -> None:
    def decide(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=2.0, reason=REASON) for p in view.peers]

    assert REASON in printed(transitions_table(outcome(run_sortie(example("duration_s=1"), decide))))


def test_brackets_in_an_expectation_are_brackets() -> None:
    verdict = Verdict(
        f"expected {REASON}", f"got {REASON}", False, f"because {REASON}", explanation=f"the record {REASON}"
    )
    said = printed(verdict_table("mine", [verdict]))
    for text in (f"expected {REASON}", f"got {REASON}", f"because {REASON}", f"the record {REASON}"):
        assert text in said
