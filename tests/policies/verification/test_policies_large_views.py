"""Drawn views of fleets of up to 5,000 drones: what is in them, faults that only they show, and policies that are slow there."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from pathlib import Path

import late_calls
import pytest

from sortie.fleet.messages.wire import decode_descriptor, encode_descriptor
from sortie.policies.contract import Directive, FleetView, Policy
from sortie.policies.registry import resolve
from sortie.policies.verification import drawn
from sortie.policies.verification.age_rule import MOST_LISTED, listed
from sortie.policies.verification.invariants import parse
from sortie.policies.verification.own_constants import views_at
from sortie.policies.verification.proof import ProofVerdict, prove
from sortie.policies.verification.single_view import Property, RepeatableView
from sortie.policies.verification.views import LARGEST, draw_view, from_json, shrink, to_json
from sortie.scenarios.disc import LISTED_IDS, LISTED_MEMBERS
from sortie.scenarios.plugins.user_calls import watched
from sortie.scenarios.schema.base import MOST_DRONES

pytestmark = pytest.mark.slow

ALL = draw_view(3, 0, LARGEST, 1.0)
FEW = draw_view(3, 1, LARGEST, 0.02)


@pytest.fixture(autouse=True)
def _without_collections() -> Iterator[None]:
    """hypothesis watches Python's search for garbage by a function, and an interrupt that arrives in it is lost."""
    gc.disable()
    yield
    gc.enable()


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
    sizes = {len(view.descriptors) for view in views_at({0.5, 1000.0, LARGEST - 1.0, 1e6}, 0, 4)}
    assert sizes >= {1000, 1001, 1002, LARGEST - 1, LARGEST}
    assert max(sizes) == LARGEST
    many = {len(view.descriptors) for view in views_at({*range(25, 95, 5), 3000}, 0, 4)}
    assert {26, 91, 3001} <= many, "small ones leave the large one its place"


def test_slowness_in_a_large_fleet_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The verdict says where there was no answer, and the policy can still be asked about other views."""
    late_calls.by_hand(monkeypatch)
    path = tmp_path / "policy.py"
    path.write_text(
        "from late_calls import spin\n"
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    if len(view.peers) > 400:\n"
        "        spin()\n"
        "    return [Directive(view.ego, p, rate_hz=2.0, reason='r') for p in view.peers]\n"
    )
    policy = resolve(f"{path}:decide")
    with watched(60.0):
        found = prove(policy, parse("rate_hz <= 10"), max_drones=1, views=10)
        assert len(policy(FEW.frozen)) == len(FEW.peers)
    for verdict in found:
        assert verdict.outcome != "refuted"
        assert verdict.what.endswith("; a view of 402 drones takes more than 10 s")


def test_slowness_up_to_200_drones_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    late_calls.by_hand(monkeypatch)
    path = tmp_path / "policy.py"
    path.write_text(
        "from late_calls import spin\n"
        "def decide(view):\n"
        f"    if len(view.peers) > {LISTED_IDS // 2}:\n"
        "        spin()\n"
        "    return []\n"
    )
    with watched(0.3):
        contract = prove(resolve(f"{path}:decide"), max_drones=1, views=10)[0]
    assert contract.outcome == "refuted"


def test_a_policy_that_is_slow_with_one_line_is_still_tried_with_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each property ends at the view that takes too long for it, and no earlier."""
    late_calls.by_hand(monkeypatch)
    path = tmp_path / "policy.py"
    path.write_text(
        "from late_calls import spin\n"
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    if len(view.peers) > 4000:\n"
        "        spin()\n"
        "    old = len(view.peers) == 777 and min(view.age_s.values()) > 50\n"
        "    return [Directive(view.ego, p, rate_hz=9.0 if old else 2.0, reason='r') for p in view.peers]\n"
    )
    contract, ages, rates = prove(resolve(f"{path}:decide"), parse("rate_hz <= 10"), max_drones=1, views=10)
    assert contract.what.endswith("; a view of 4,002 drones takes more than 10 s")
    assert rates.what.endswith(contract.what.partition(";")[2])
    assert ages.outcome == "refuted"


def passes_at_the_largest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let time pass, as fast as the machine does, while a property is judged on a view of the largest fleet."""
    late_calls.by_hand(monkeypatch)
    judge = drawn.complaint_of

    def judge_slowly(prop: Property, policy: Policy, view: RepeatableView) -> str | None:
        over = threading.Event()
        ticking = threading.Thread(target=lambda: [late_calls.tick() for _ in iter(over.is_set, True)])
        if len(view.now().descriptors) == LARGEST:
            ticking.start()
        try:
            return judge(prop, policy, view)
        finally:
            over.set()

    monkeypatch.setattr(drawn, "complaint_of", judge_slowly)


def test_a_line_that_takes_long_itself_ends_at_the_large_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """It asks of each link about all links."""
    passes_at_the_largest(monkeypatch)
    line = "when goodput_mbps < 5: count_links(rate_hz > 9) <= 2"
    verdict = prove(resolve("silence"), parse(line), max_drones=1, views=10)[-1]
    assert verdict.outcome == "proved"
    assert verdict.what.endswith(f"; a view of {LARGEST:,} drones takes more than 10 s")


def test_a_registered_policy_is_interrupted_too(monkeypatch: pytest.MonkeyPatch) -> None:
    passes_at_the_largest(monkeypatch)
    contract = prove(resolve("deputies"), max_drones=1, views=2)[0]
    assert contract.outcome == "proved"
    assert contract.what.endswith(f"; a view of {LARGEST:,} drones takes more than 10 s")


def decide(view: FleetView) -> list[Directive]:
    return [Directive(view.ego, p, rate_hz=2.0, reason="r") for p in view.peers]


def test_a_view_of_nobody_can_be_shrunk() -> None:
    nobody = FleetView(0, 0.1, {}, {})
    assert shrink(nobody, lambda _: True) == nobody


def test_a_verdict_names_the_sizes() -> None:
    assert prove(decide, max_drones=1, views=5)[0].what.endswith(
        "5 drawn views of up to 20 drones, 5 at the policy's own constants, 2 of 200 drones and 2 of 5,000 keep it"
    )
    assert prove(decide, max_drones=1, views=0)[0].what.endswith("; no drawn views")
