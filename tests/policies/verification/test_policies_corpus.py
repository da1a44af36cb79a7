"""No wrong proof: policies with a planted fault are never proved, correct ones are, whatever they are made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from policies_corpus import FAULTY, HELPER, LINE, RIGHT, UNPLAIN, source

from sortie.policies.registry import resolve
from sortie.policies.verification.invariants import parse
from sortie.policies.verification.proof import PROVED, ProofVerdict, prove

pytestmark = pytest.mark.slow

Verify = Callable[..., list[ProofVerdict]]
FOUND = ("whole: ", "sliver: ", "returns: ")
"""Kinds in which the search itself finds a view, not only declines to prove."""
DECLINED = {
    "sliver: division by a zero charge", "sliver: match of a class", "returns: list that changes", "returns: quiet list",
    "returns: swallows", "returns: lying subclass", "returns: lying item", "returns: quiet subclass", "returns: lying rate",
    "returns: array of one number", "returns: changes an age", "returns: removes a drone", "returns: alias",
}  # fmt: skip
"""Entries of these kinds that the search cannot follow."""
LONG = {"correct: file with wrapped catalogue"}
"""Three drones take ten times as long as two here."""


@pytest.fixture
def verify(tmp_path: Path) -> Verify:
    """The verdicts on a source, by the search alone: drawn views might hide a wrong proof."""

    def act(source: str, max_drones: int = 3) -> list[ProofVerdict]:
        path = tmp_path / "policy.py"
        path.write_text(source)
        (tmp_path / "helper.py").write_text(HELPER)
        return prove(resolve(f"{path}:decide"), parse(LINE), max_drones=max_drones, views=0)

    return act


@pytest.mark.filterwarnings("ignore::SyntaxWarning")  # `is` with a number, as planted
@pytest.mark.parametrize("name", FAULTY)
def test_no_planted_fault_is_proved(name: str, verify: Verify) -> None:
    verdicts = verify(FAULTY[name])
    outcomes = [v.outcome for v in verdicts]
    assert set(outcomes) - set(PROVED), "every property is called proved"
    if name.startswith(FOUND) and name not in DECLINED:
        assert "refuted" in outcomes
        refuted = next(v for v in verdicts if v.outcome == "refuted")
        assert refuted.counterexample is not None
        assert refuted.what
    elif outcomes[-1] == "drawn":
        assert verdicts[-1].what.startswith("Cannot analyse: it ")


@pytest.mark.parametrize(
    ("name", "drones"),
    [*((n, 2 if n in LONG else 3) for n in RIGHT), *(pytest.param(n, 3, marks=pytest.mark.slow) for n in LONG)],
)
def test_correct_policies_are_proved(name: str, drones: int, verify: Verify) -> None:
    assert [(v.outcome, v.what) for v in verify(RIGHT[name], drones) if v.outcome != "proved"] == []


@pytest.mark.parametrize("name", UNPLAIN)
def test_correct_policies_in_other_python_are_drawn_and_told_why(name: str, verify: Verify) -> None:
    verdicts = verify(source(UNPLAIN[name]))
    assert {v.outcome for v in verdicts} == {"drawn"}
    assert all(v.what.startswith("Cannot analyse: it ") and "To make it provable: " in v.what for v in verdicts)


def test_the_corpus_is_as_large_as_promised() -> None:
    assert len(FAULTY) >= 150
    assert len(RIGHT) >= 40
