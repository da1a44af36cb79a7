"""No wrong proof: a planted fault is found or not followed, and correct policies in plain Python are proved."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import policies_corpus as corpus
import pytest
from policies_examples import written

from sortie.policies.registry import POLICIES, resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.allowed import why_not_provable
from sortie.policies.verification.proof.proof import ProofVerdict, prove

pytestmark = pytest.mark.filterwarnings("ignore::SyntaxWarning")  # `is` with a number, as planted


def verify(folder: Path, text: str, max_drones: int = 2) -> list[ProofVerdict]:
    """The verdicts on a file, by the search alone: drawn views might hide a wrong proof."""
    (folder / "helper.py").write_text(corpus.HELPER)
    return prove(written(folder, text), parse(corpus.LINE), max_drones=max_drones, cells=400_000, views=0)


def outcomes(verdicts: Iterable[ProofVerdict]) -> set[str]:
    return {v.outcome for v in verdicts}


def test_a_fault_in_plain_python_is_found_in_however_few_floats_it_lies(tmp_path: Path) -> None:
    found = {body: verify(tmp_path, corpus.source(body), max_drones=3) for body in corpus.FOUND}
    assert {body: outcomes(verdicts) for body, verdicts in found.items() if "refuted" not in outcomes(verdicts)} == {}
    refuted = [v for verdicts in found.values() for v in verdicts if v.outcome == "refuted"]
    assert all(v.counterexample is not None and v.what for v in refuted)


def test_what_no_proof_follows_is_named_with_its_line_and_never_proved(tmp_path: Path) -> None:
    wrong = {}
    for body, why in corpus.NOT_FOLLOWED.items():
        for verdict in verify(tmp_path, corpus.source(body)):
            _, _, said = verdict.what.partition("; not proved: it ")
            reason, _, line = said.partition(" in line ")
            inside = range(corpus.FIRST_LINE, corpus.FIRST_LINE + corpus.START.count("\n") + body.count("\n") + 2)
            if (verdict.outcome, reason) != ("tried", why) or (line and int(line) not in inside):
                wrong[body] = (verdict.outcome, said)
    assert wrong == {}


def test_state_in_whatever_a_policy_is_made_of_is_not_followed(tmp_path: Path) -> None:
    texts = {name: corpus.HEAD + corpus.USUAL + text for name, text in corpus.FILES.items()}
    found = {name: outcomes(verify(tmp_path, text)) for name, text in texts.items()}
    assert {name: said for name, said in found.items() if said != {"tried"}} == {}


def test_correct_policies_in_plain_python_are_proved(tmp_path: Path) -> None:
    texts = {body: corpus.source(body) for body in corpus.PROVED}
    texts |= {name: corpus.HEAD + corpus.USUAL + text for name, text in corpus.PROVED_FILES.items()}
    found = {name: [(v.outcome, v.what) for v in verify(tmp_path, text)] for name, text in texts.items()}
    assert {name: said for name, said in found.items() if {outcome for outcome, _ in said} != {"proved"}} == {}


def test_the_line_that_is_named_is_the_one_that_is_not_followed(tmp_path: Path) -> None:
    body = "x = 1\nbad = hash(x)\ny = 2"
    at = corpus.FIRST_LINE + corpus.START.count("\n") + 1
    assert verify(tmp_path, corpus.source(body))[0].what.endswith(f"not proved: it uses hash in line {at}")


def test_registered_policies_are_not_walked() -> None:
    assert {name: why for name in POLICIES if (why := why_not_provable(resolve(name)))} == {}


def test_a_file_that_was_edited_is_read_anew(tmp_path: Path) -> None:
    assert why_not_provable(written(tmp_path, "def decide(view):\n    return []\n")) == ""
    edited = written(tmp_path, "def decide(view):\n    return [*{1}]\n")
    assert re.search("line 2$", why_not_provable(edited))
