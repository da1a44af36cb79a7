"""Generated policies: a planted fault is never proved, a correct policy is never refuted, and people's faults are shown."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_corpus import HELPER, LINE, source
from policies_examples import written
from policies_faults import LARGE_FAULTS, slivers, unreached, whole_faults
from policies_honest_faults import HONEST, LARGEST_SHOWN, honest_source

from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.proof.proof import ProofVerdict, prove
from sortie.policies.verification.subject import own_invariants

pytestmark = [
    pytest.mark.filterwarnings("ignore::SyntaxWarning"),
    pytest.mark.filterwarnings("ignore:Bitwise inversion:DeprecationWarning"),  # from Python 3.12 on
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("generated")
    (path / "helper.py").write_text(HELPER)
    return path


def verdicts(folder: Path, text: str, line: str = LINE, views: int = 0) -> list[ProofVerdict]:
    return prove(written(folder, text), parse(line), max_drones=2, cells=100_000, views=views)


@settings(max_examples=100)
@given(text=st.one_of(whole_faults(), slivers()))
def test_a_generated_fault_is_refuted_or_the_policy_is_not_followed(folder: Path, text: str) -> None:
    assert verdicts(folder, text)[-1].outcome in ("refuted", "tried"), text


@settings(max_examples=60)
@given(text=unreached())
def test_a_generated_correct_policy_is_not_refuted(folder: Path, text: str) -> None:
    assert "refuted" not in [v.outcome for v in verdicts(folder, text)], text


@pytest.mark.parametrize(
    "names", [pytest.param(list(HONEST)[::4], id="some"), pytest.param(list(HONEST), id="all", marks=pytest.mark.slow)]
)
def test_an_honest_fault_is_refuted_by_a_small_view(folder: Path, names: list[str]) -> None:
    """By views alone, as of a policy that no proof follows."""
    wrong = {}
    for name in names:
        policy = written(folder, honest_source(name))
        shown = [check.counterexample for check in failing(conform(policy))]
        shown += [v.counterexample for v in prove(policy, parse(str(own_invariants(policy))), cells=0)]
        drones = [len(view.descriptors) for view in shown if view is not None]
        if not drones or not (name.startswith("state: ") or min(drones) <= LARGEST_SHOWN.get(name, 3)):
            wrong[name] = drones
    assert wrong == {}


@pytest.mark.slow
def test_faults_of_large_fleets_are_found_by_drawn_views(folder: Path) -> None:
    found = {of: verdicts(folder, source(of[0]), of[1], views=300) for of in LARGE_FAULTS}
    assert {of for of, said in found.items() if "refuted" not in [v.outcome for v in said]} == set()


def test_a_fault_of_one_drone_among_many_is_found(folder: Path) -> None:
    """Its number stands in the policy: drawn views of fleets that are as large are tried."""
    text = (
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    rate_hz = 20.0 if view.ego == 60 else 2.0\n"
        "    return [Directive(view.ego, p, rate_hz=rate_hz, reason='r') for p in view.peers]\n"
    )
    assert verdicts(folder, text, views=10)[-1].outcome == "refuted"


def test_a_policy_that_takes_long_on_large_fleets_is_tried_on_smaller_ones(folder: Path) -> None:
    """By the lines that it runs, not by time: the verdict is the same on every machine."""
    text = (
        "from sortie import Directive\n"
        "def decide(view):\n"
        "    for a in view.peers:\n"
        "        for b in view.peers:\n"
        "            c = a + b\n"
        "    return [Directive(view.ego, p, reason='r') for p in view.peers]\n"
    )
    assert " views of up to 200 drones" in verdicts(folder, text, views=10)[-1].what
