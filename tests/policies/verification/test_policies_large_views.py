"""Drawn views of fleets of up to 5,000 drones: what is in them, and faults that only they show."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.policies.contract import Directive, FleetView
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import MOST_LISTED, listed, parse
from sortie.policies.verification.kit.drawn import views_at_sizes
from sortie.policies.verification.kit.tried import shrink
from sortie.policies.verification.kit.views import LARGEST, draw_view, from_json, to_json
from sortie.policies.verification.proof.proof import ProofVerdict, prove
from sortie.scenarios.disc import LISTED_MEMBERS
from sortie.scenarios.schema.base import MOST_DRONES

pytestmark = pytest.mark.slow

ALL = draw_view(3, 0, LARGEST, 1.0)
FEW = draw_view(3, 1, LARGEST, 0.02)


def verdicts(folder: Path, code: str, line: str = "rate_hz <= 10") -> list[ProofVerdict]:
    """Of a policy that computes `rate_hz` by some lines of code."""
    path = folder / "policy.py"
    path.write_text(
        "from sortie import Directive\n"
        "def decide(view):\n"
        f"    {code}\n"
        "    return [Directive(view.ego, p, rate_hz=rate_hz, reason='r') for p in view.peers]\n"
    )
    return prove(resolve(f"{path}:decide"), parse(line), max_drones=2, views=10)


def test_the_largest_views_are_of_the_largest_fleet_that_a_scenario_may_have() -> None:
    assert LARGEST == MOST_DRONES == len(ALL.descriptors)
    assert 50 < len(FEW.descriptors) < 150
    assert max(FEW.descriptors) > 4500


@pytest.mark.parametrize("view", [ALL, FEW])
def test_drones_of_a_large_fleet_have_rosters_as_in_flight(view: FleetView) -> None:
    """They fit into a descriptor, and are read again from it."""
    sizes = set()
    for i, d in list(view.descriptors.items())[:200]:
        assert d.roster is not None
        assert i in d.roster.members
        assert len(d.peer_goodput_mbps) == len(d.roster.members) - 1
        sizes.add(len(d.roster.members))
        again = decode_descriptor(encode_descriptor(d._replace(priority_target_ids=())))
        assert (again.agent_id, again.roster) == (i, d.roster)
    assert min(sizes) < 8
    assert max(sizes) <= LISTED_MEMBERS
    rosters = [d.roster for d in view.descriptors.values() if d.roster is not None]
    assert any(set(r.members) - view.descriptors.keys() for r in rosters) or view is ALL
    assert any(len(view.descriptors.keys() & set(r.members)) > 30 for r in rosters)


def test_a_view_of_high_ids_survives_json() -> None:
    assert from_json(to_json(FEW)) == FEW


def test_a_large_view_is_shrunk_by_halves() -> None:
    tried = []

    def fails(view: FleetView) -> bool:
        tried.append(len(view.descriptors))
        return 4321 in view.descriptors

    small = shrink(ALL, fails)
    assert set(small.descriptors) == {ALL.ego, 4321}
    assert len(tried) < 300
    assert small.descriptors[4321].roster == ALL.descriptors[4321].roster, "without it such an id would not be listed"
    large = shrink(ALL, lambda view: len(view.peers) >= 1234)
    assert 1234 <= len(large.peers) < 1300, "of thousands that matter, not each is tried by itself"


@pytest.mark.parametrize(
    "code",
    [
        "rate_hz = 20.0 if len(view.peers) > 3000 else 2.0",
        "rate_hz = 20.0 if any(p > 4000 for p in view.peers) else 2.0",
        "rate_hz = 20.0 if len(view.peers) == 777 else 2.0",
        "rate_hz = 20.0 if view.me and view.me.roster and len(view.me.roster.members) < 60 < len(view.peers) else 2.0",
    ],
)
def test_faults_of_fleets_beyond_200_drones_are_found(tmp_path: Path, code: str) -> None:
    verdict = verdicts(tmp_path, code)[-1]
    assert verdict.outcome == "refuted"
    assert verdict.counterexample is not None
    assert len(verdict.what) < 100


def test_a_complaint_about_thousands_of_links_names_the_first(tmp_path: Path) -> None:
    path = tmp_path / "policy.py"
    path.write_text(
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    said = [Directive(view.ego, p, rate_hz=1.0, reason='r') for p in view.peers]\n"
        "    return said[: len(said) // 1000 * 1000] if len(said) >= 1000 else said\n"
    )
    contract = prove(resolve(f"{path}:decide"), max_drones=2, views=10)[0]
    assert contract.outcome == "refuted"
    assert contract.what.startswith("directives for [")
    assert " more], must be for each of [" in contract.what
    assert len(contract.what) < 1000
    assert listed(range(MOST_LISTED + 2)).endswith(f"{MOST_LISTED - 1} and 2 more")


def test_views_at_constants_reach_the_largest_fleet() -> None:
    sizes = {len(view.descriptors) for view in views_at_sizes({0.5, 1000.0, LARGEST - 1.0, 1e6}, 0)}
    assert sizes >= {1000, 1001, 1002, LARGEST - 1, LARGEST}
    assert max(sizes) == LARGEST
    many = {len(view.descriptors) for view in views_at_sizes({*range(25, 95, 5), 3000}, 0)}
    assert {26, 91, 3001} <= many, "small ones leave the large one its place"


def decide(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, p, rate_hz=2.0, reason="r") for p in view.peers]


def test_a_view_of_nobody_can_be_shrunk() -> None:
    nobody = FleetView(0, 0.1, {}, {})
    assert shrink(nobody, lambda _: True) == nobody


def test_a_verdict_names_the_sizes() -> None:
    assert " views of up to 5,000 drones; not proved" in prove(decide, max_drones=1, views=5)[0].what
    assert "tried on 0 views of up to 0 drones" in prove(decide, max_drones=1, views=0)[0].what
