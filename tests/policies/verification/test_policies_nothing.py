"""Policies may use `nothing`, which keeps its directives: proved as others are, and its counters are no input."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.policies.registry import resolve
from sortie.policies.verification.conformance import conform
from sortie.policies.verification.invariants import parse
from sortie.policies.verification.proof import prove

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


def test_how_often_nothing_was_asked_is_no_input(tmp_path: Path) -> None:
    rate = "5.0 if nothing.cache_info().hits < 10**9 else 9.0"
    verdict, _ = outcomes(tmp_path, NAMES["nothing"], LANDS.format(name="nothing"), rate)
    assert verdict == "drawn"


def test_what_few_views_reach_and_no_search_follows_ends_the_search_and_not_the_kit(tmp_path: Path) -> None:
    landing = "rate = 0.0 * random.Random(view.ego).random()\n        return [Directive(view.ego, p, rate_hz=rate, reason='x') for p in view.peers]"
    verdict, kit = outcomes(tmp_path, "import random", landing)
    assert (verdict, all(kit.values())) == ("drawn", True)


def test_other_parts_of_the_policies_package_are_no_input(tmp_path: Path) -> None:
    landing = "return [Directive(view.ego, p, reason=f'{len(registry.POLICIES)}') for p in view.peers]"
    verdict, kit = outcomes(tmp_path, "from sortie.policies import registry", landing)
    assert (verdict, kit["reads only its view"]) == ("drawn", False)
