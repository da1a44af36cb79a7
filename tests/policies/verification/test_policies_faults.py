"""Generated policies with a planted fault are never proved, and generated correct ones never refuted.

The suite runs a sample. `pytest -m slow tests/policies/verification/test_policies_faults.py` runs more than a hundred of
each kind.
"""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from policies_corpus import LINE
from policies_faults import sliver, unreached, whole
from policies_more_faults import KEEPERS, MANY, kept, memory, returned, size, stand_in

from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.drawn import views_at
from sortie.policies.verification.kit.single_view import check_property, property_of
from sortie.policies.verification.kit.views import LARGEST, draw_view
from sortie.policies.verification.proof.proof import ProofVerdict, prove

pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),  # a planted `__del__` is refused
    pytest.mark.filterwarnings("ignore::SyntaxWarning"),
    pytest.mark.filterwarnings("ignore:Bitwise inversion:DeprecationWarning"),  # from Python 3.12 on
]
FAULTS = {"whole": whole, "sliver": sliver, "stand in": stand_in, "memory": memory, "returned": returned}
SAMPLE = range(8)
ALL = range(8, 128)


def verdicts(folder: Path, text: str, line: str = LINE, views: int = 0) -> list[ProofVerdict]:
    path = folder / "policy.py"
    path.write_text(text)
    return prove(resolve(f"{path}:decide"), parse(line), max_drones=2, cells=100_000, views=views)


def check_faulty(folder: Path, kind: str, seed: int) -> None:
    text = FAULTS[kind](Random(seed))
    try:
        found = verdicts(folder, text)
    except KeyboardInterrupt:  # raised by the policy: the command ends as if by Ctrl-C, with exit code 130
        assert "raise KeyboardInterrupt" in text
        return
    assert {v.outcome for v in found} != {"proved"}, f"every property is called proved:\n{text}"


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


@pytest.mark.parametrize("number", range(0, len(KEEPERS), 4))
def test_no_memory_is_overlooked(tmp_path: Path, number: int) -> None:
    assert verdicts(tmp_path, kept(number, 1000003))[-1].outcome != "proved"


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", sorted(FAULTS.keys() - {"returned"})
)  # of those some draws are no faults, such as True for 1 Hz
def test_no_generated_fault_is_proved(tmp_path: Path, kind: str) -> None:
    for seed in ALL:
        check_faulty(tmp_path, kind, seed)


@pytest.mark.slow
def test_no_generated_correct_policy_is_refuted(tmp_path: Path) -> None:
    for seed in ALL:
        assert "refuted" not in [v.outcome for v in verdicts(tmp_path, unreached(Random(seed)))]


@pytest.mark.slow
def test_every_memory_is_noticed(tmp_path: Path) -> None:
    for number in range(len(KEEPERS)):
        assert verdicts(tmp_path, kept(number, 1000003))[-1].outcome != "proved", KEEPERS[number]


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


def test_views_lie_at_the_constants_of_a_policy() -> None:
    views = list(views_at({0.4321, 77.25, 40.0}, 0, 60))
    assert any(v.me is not None and v.me.battery_soc == 0.4321 for v in views)
    assert any(v.me is not None and set(v.me.peer_goodput_mbps) == {77.25} for v in views)
    assert any(0.4321 in v.age_s.values() for v in views)
    assert {v.ego for v in views[-6:]} >= {40}
    assert max(max(v.descriptors) for v in views) > 30
    assert list(views_at({0.4321}, 0, 0)) == list(views_at((), 0, 60)) == []


@pytest.mark.parametrize("number", ["Decimal(2)", "Fraction(2)"])
def test_numbers_that_no_table_can_keep_are_refused(tmp_path: Path, number: str) -> None:
    """They compare as they should, but mixing them with floats ends a flight."""
    text = (
        "from decimal import Decimal\nfrom fractions import Fraction\nfrom sortie import Directive\n"
        "def decide(view):\n"
        f"    return [Directive(view.ego, p, rate_hz={number}, reason='r') for p in view.peers]\n"
    )
    assert verdicts(tmp_path, text, views=5)[0].outcome == "refuted"
