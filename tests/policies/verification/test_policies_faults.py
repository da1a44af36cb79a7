"""Policies with a planted fault are never proved, nearly all are refuted, and generated correct ones never are.

The suite runs a sample of the generated ones. `pytest -m slow tests/policies/verification/test_policies_faults.py` runs more
than a hundred of each kind.
"""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from policies_corpus import LINE
from policies_faults import MANY, size, sliver, unreached, whole
from policies_honest_faults import HONEST, honest_source

from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.kit.drawn import views_at_sizes
from sortie.policies.verification.kit.single_view import check_property, property_of
from sortie.policies.verification.kit.views import AT_CONSTANTS, LARGEST, draw_view, draw_views
from sortie.policies.verification.proof.proof import ProofVerdict, prove
from sortie.policies.verification.subject import own_invariants

pytestmark = [
    pytest.mark.filterwarnings("ignore::SyntaxWarning"),
    pytest.mark.filterwarnings("ignore:Bitwise inversion:DeprecationWarning"),  # from Python 3.12 on
]
FAULTS = {"whole": whole, "sliver": sliver}
SAMPLE = range(8)
ALL = range(8, 128)
LARGEST_SHOWN = {
    "fleet: more than six peers": 8,
    "fleet: twelve links": 14,
    "fleet: thirty drones": 2,
    "age: the sum": 5,
}
"""Drones in the counterexample, where it takes more than three."""


def verdicts(folder: Path, text: str, line: str = LINE, views: int = 0) -> list[ProofVerdict]:
    path = folder / "policy.py"
    path.write_text(text)
    return prove(resolve(f"{path}:decide"), parse(line), max_drones=2, cells=100_000, views=views)


@pytest.mark.parametrize(
    "name", [name if k % 4 == 0 else pytest.param(name, marks=pytest.mark.slow) for k, name in enumerate(HONEST)]
)
def test_an_honest_fault_is_refuted_by_a_small_view(tmp_path: Path, name: str) -> None:
    """By views alone, as of a policy that no proof follows."""
    path = tmp_path / "policy.py"
    path.write_text(honest_source(name))
    policy = resolve(f"{path}:decide")
    shown = [check.counterexample for check in failing(conform(policy))]
    shown += [v.counterexample for v in prove(policy, parse(str(own_invariants(policy))), cells=0)]
    drones = [len(view.descriptors) for view in shown if view is not None]
    assert drones
    assert name.startswith("state: ") or min(drones) <= LARGEST_SHOWN.get(name, 3)


def check_faulty(folder: Path, kind: str, seed: int) -> None:
    text = FAULTS[kind](Random(seed))
    assert {v.outcome for v in verdicts(folder, text)} != {"proved"}, f"every property is called proved:\n{text}"


def check_size(folder: Path, seed: int) -> None:
    text, line = size(Random(seed))
    outcomes = [v.outcome for v in verdicts(folder, text, line, views=300)]
    assert "refuted" in outcomes, f"{line}\n{text}"


@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("seed", SAMPLE)
def test_a_generated_fault_is_not_proved(tmp_path: Path, kind: str, seed: int) -> None:
    check_faulty(tmp_path, kind, seed)


@pytest.mark.parametrize("seed", SAMPLE)
def test_a_generated_correct_policy_is_not_refuted(tmp_path: Path, seed: int) -> None:
    assert "refuted" not in [v.outcome for v in verdicts(tmp_path, unreached(Random(seed)))]


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULTS)
def test_no_generated_fault_is_proved(tmp_path: Path, kind: str) -> None:
    for seed in ALL:
        check_faulty(tmp_path, kind, seed)


@pytest.mark.slow
def test_no_generated_correct_policy_is_refuted(tmp_path: Path) -> None:
    for seed in ALL:
        assert "refuted" not in [v.outcome for v in verdicts(tmp_path, unreached(Random(seed)))]


@pytest.mark.slow
def test_faults_of_large_fleets_are_found_by_drawn_views(tmp_path: Path) -> None:
    for seed in ALL:
        check_size(tmp_path, seed)


@pytest.mark.slow
def test_faults_beyond_200_drones_are_found_by_drawn_views(tmp_path: Path) -> None:
    """Of generated ones that show where 5,000 drones all hear each other."""
    everyone = draw_view(8, 0, LARGEST, 1.0).frozen
    found = 0
    for seed in ALL[:12]:
        text, line = size(Random(seed), MANY)
        path = tmp_path / "policy.py"
        path.write_text(text)
        property_ = property_of(parse(line)[0])
        if check_property(property_, resolve(f"{path}:decide"), everyone) is not None:
            assert verdicts(tmp_path, text, line, views=20)[-1].outcome == "refuted", f"{line}\n{text}"
            found += 1
    assert found > 5


def test_a_fault_of_one_drone_among_many_is_found(tmp_path: Path) -> None:
    """Its number stands in the policy: drawn views of fleets that are as large are tried."""
    text = (
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    rate_hz = 20.0 if view.ego == 60 else 2.0\n"
        "    return [Directive(view.ego, p, rate_hz=rate_hz, reason='r') for p in view.peers]\n"
    )
    assert verdicts(tmp_path, text, views=10)[-1].outcome == "refuted"


def test_a_policy_that_takes_long_on_large_fleets_is_tried_on_smaller_ones(tmp_path: Path) -> None:
    """By the lines that it runs, not by time: the verdict is the same on every machine."""
    text = (
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    for a in view.peers:\n"
        "        for b in view.peers:\n"
        "            c = a + b\n"
        "    return [Directive(view.ego, p, reason='r') for p in view.peers]\n"
    )
    assert " views of up to 200 drones" in verdicts(tmp_path, text, views=10)[-1].what


def test_views_lie_at_the_constants_of_a_policy() -> None:
    constants = {0.4321, 77.25, 40.0}
    views = list(draw_views(0, 60 * AT_CONSTANTS, constants))
    assert any(v.me is not None and v.me.battery_soc == 0.4321 for v in views)
    assert any(v.me is not None and set(v.me.peer_goodput_mbps) == {77.25} for v in views)
    assert any(0.4321 in v.age_s.values() for v in views)
    assert any(d.stamp_ns == 40 * 10**9 for v in views for d in v.descriptors.values())
    at_sizes = list(views_at_sizes(constants, 0))
    assert {v.ego for v in at_sizes} >= {40}
    assert max(max(v.descriptors) for v in at_sizes) > 30
    assert list(views_at_sizes({0.4321}, 0)) == []
    assert list(draw_views(0, 60)) == list(draw_views(0, 60, ()))
