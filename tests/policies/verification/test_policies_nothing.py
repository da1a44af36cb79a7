"""Policies may use `nothing`, which keeps its directives: proved as others are, and its counters are no input."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.policies.catalogue.coverage_cells import well_cells
from sortie.policies.contract import Coverage, TaskPhase, nothing, nothing_to_all
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.conformance import conform
from sortie.policies.verification.proof.proof import prove

LINE = "when phase == landing: rate_hz == 0"
POLICY = """
{head}
from sortie import Directive, FleetView, Representation, TaskPhase

def decide(view: FleetView):
    if view.me is None:
        return []
    if view.me.task_phase == TaskPhase.LANDING:
        {landing}
    boxes = Representation.DETECTIONS
    return [Directive(view.ego, p, boxes, rate_hz={rate}, reason="boxes") for p in view.peers]
"""
LANDS = 'return [{name}(view.ego, p, "landing") for p in view.peers]'
NAMES = {
    "nothing": "from sortie.policies.contract import nothing",
    "contract.nothing": "from sortie.policies import contract",
    "c.nothing": "import sortie.policies.contract as c",
}


def outcomes(folder: Path, head: str, landing: str, rate: str = "5.0") -> tuple[str, dict[str, bool]]:
    """The verdict on the line, and which rules of the kit hold."""
    path = folder / "mine.py"
    path.write_text(POLICY.format(head=head, landing=landing, rate=rate))
    policy = resolve(f"{path}:decide")
    return prove(policy, parse(LINE), max_drones=2, views=0)[-1].outcome, {
        c.name: c.holds for c in conform(policy, count=40)
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_that_sends_nothing_by_its_name_is_proved(name: str, tmp_path: Path) -> None:
    verdict, kit = outcomes(tmp_path, NAMES[name], LANDS.format(name=name))
    assert verdict == "proved"
    assert all(kit.values())


def test_what_few_views_reach_and_no_search_follows_ends_the_search_and_not_the_kit(tmp_path: Path) -> None:
    landing = "rate = 0.0 * random.Random(view.ego).random()\n        return [Directive(view.ego, p, rate_hz=rate, reason='x') for p in view.peers]"
    verdict, kit = outcomes(tmp_path, "import random", landing)
    assert (verdict, all(kit.values())) == ("tried", True)


def test_equal_arguments_of_other_types_leave_nothing_behind() -> None:
    """What one decision asked for must not change what the next one gets."""
    for other in (901.0, TaskPhase.TRACK):
        same = int(other)
        assert type(nothing(other, 7, "r").source) is type(other)  # type: ignore[arg-type]
        assert type(nothing(same, 7, "r").source) is int
        assert type(nothing_to_all(same, (other,), "r")[0].destination) is type(other)
        assert type(nothing_to_all(same, (same,), "r")[0].destination) is int
    assert type(min(well_cells(bytes([255]), 3.0, 4, Coverage.POOR))[0]) is float  # type: ignore[arg-type]
    assert type(min(well_cells(bytes([255]), 3, 4, Coverage.POOR))[0]) is int
    assert nothing(901, 7, "r") is nothing(901, 7, "r")
