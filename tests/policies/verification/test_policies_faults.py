"""Policies with the faults that people make, and with faults of large fleets: views alone show them."""

from __future__ import annotations

from pathlib import Path

import pytest
from policies_corpus import HELPER, LINE, source
from policies_examples import written
from policies_honest_faults import HONEST, LARGEST_SHOWN, honest_source

from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.conformance import conform, failing
from sortie.policies.verification.proof.proof import ProofVerdict, prove
from sortie.policies.verification.subject import own_invariants

pytestmark = [
    pytest.mark.filterwarnings("ignore::SyntaxWarning"),
    pytest.mark.filterwarnings("ignore:Bitwise inversion:DeprecationWarning"),  # from Python 3.12 on
]

LARGE_FAULTS = (
    ("bad = len(view.peers) >= 11", LINE),
    ("bad = sum(1 for p in view.peers) // 40 >= 1", LINE),
    ("bad = view.full_sharing_maps in range(25, 250)", LINE),
    ("bad = view.ego == 90", LINE),
    ("bad = list(range(len(me.peer_goodput_mbps)))[18:] != []", LINE),
    ("try:\n    list(range(len(view.peers)))[16]\n    bad = True\nexcept IndexError:\n    pass", LINE),
    ("bad = False", "count_links(representation > none) <= 13"),
    ("bad = False", "sum_links(rate_hz) <= 30"),
    ("bad = False", "when peers >= 60: every_link(representation >= features)"),
    ("bad = len(view.peers) > 3000", LINE),
    ("bad = any(p > 4000 for p in view.peers)", LINE),
    ("bad = len(view.peers) == 777", LINE),
    ("bad = me.roster is not None and len(me.roster.members) < 60 < len(view.peers)", LINE),
)
"""Faults of fleets that are larger than those that are searched by default, up to the largest: a body and its line."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("generated")
    (path / "helper.py").write_text(HELPER)
    return path


def verdicts(folder: Path, text: str, line: str = LINE, views: int = 0) -> list[ProofVerdict]:
    return prove(written(folder, text), parse(line), max_drones=2, cells=100_000, views=views)


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
