"""No wrong proof: policies with a planted fault are never proved, and correct ones in plain Python are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from policies_corpus import FAULTY, HELPER, LINE, RIGHT, UNPLAIN, source

from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import ProofVerdict, prove

pytestmark = pytest.mark.slow

Verify = Callable[..., list[ProofVerdict]]
FOUND = ("whole: ", "sliver: ", "returns: ")
"""Kinds in which the search itself finds a view, not only declines to prove."""
OTHER_PYTHON = {
    "set of ids", "zlib of an id", "hash of an id", "combinations", "dataclass", "exception", "smallest of none", "own enum",
    "statistics of ids", "functools", "isinstance", "minus of a whole number", "__init__ of a base", "absolute whole number",
    "file with wrapper", "file with callable object", "file with partial", "file with dataclass", "file with protocol for types",
    "file with class variable", "file with most common", "file with numbers of its own",
}  # fmt: skip
"""Correct policies that use more than a proof follows."""
LONG = {"correct: file with wrapped catalogue"}
"""Three drones take ten times as long as two here."""


@pytest.fixture
def verify(tmp_path: Path) -> Verify:
    """The verdicts on a source, by the search alone: drawn views might hide a wrong proof."""

    def act(source: str, max_drones: int = 3) -> list[ProofVerdict]:
        path = tmp_path / "policy.py"
        path.write_text(source)
        (tmp_path / "helper.py").write_text(HELPER)
        return prove(resolve(f"{path}:decide"), parse(LINE), max_drones=max_drones, cells=400_000, views=0)

    return act


@pytest.mark.filterwarnings("ignore::SyntaxWarning")  # `is` with a number, as planted
@pytest.mark.parametrize("name", FAULTY)
def test_no_planted_fault_is_proved(name: str, verify: Verify) -> None:
    verdicts = verify(FAULTY[name])
    outcomes = [v.outcome for v in verdicts]
    assert set(outcomes) != {"proved"}, "every property is called proved"
    for verdict in verdicts:
        assert verdict.outcome != "tried" or "; not proved: it " in verdict.what
    if name.startswith(FOUND) and "tried" not in outcomes:
        refuted = next(v for v in verdicts if v.outcome == "refuted")
        assert refuted.counterexample is not None
        assert refuted.what


@pytest.mark.parametrize(
    ("name", "drones"),
    [*((n, 2 if n in LONG else 3) for n in RIGHT), *(pytest.param(n, 3, marks=pytest.mark.slow) for n in LONG)],
)
def test_correct_policies_are_proved(name: str, drones: int, verify: Verify) -> None:
    wanted = "tried" if name.removeprefix("correct: ") in OTHER_PYTHON else "proved"
    assert [(v.outcome, v.what) for v in verify(RIGHT[name], drones) if v.outcome != wanted] == []


@pytest.mark.parametrize("name", UNPLAIN)
def test_correct_policies_in_other_python_are_tried(name: str, verify: Verify) -> None:
    assert {v.outcome for v in verify(source(UNPLAIN[name]))} == {"tried"}
