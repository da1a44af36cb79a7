"""Small random policies against brute force: on a grid, and at every boundary and one float to each side of it."""

from __future__ import annotations

import math
import re
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_corpus import HELPER, LINE, source
from policies_examples import fleet_of, written

from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import prove

WHOLE = st.sampled_from([0, 1, 2, 3, 5, 7, 30, 99])
FLOAT = st.sampled_from([0.0, 0.1, 0.25, 0.3, 0.5, 0.7, 1.0, 2.5, 4.99, 5.0, 77.25])
CONSTANT = st.one_of(WHOLE, FLOAT)
FACTOR = st.sampled_from([1, 2, 3, 0.1, -1, 0.5, 10])
INPUT = st.sampled_from(["soc", "first", "me.goodput_to(p)"])
NUMBERS = (
    "{x}",
    "{x} * {f}",
    "({x} + {c})",
    "({c} - {x})",
    "({x} * {f} + {c}) / {g}",
    "min({x}, {c})",
    "max({c}, {x})",
    "abs({x} - {c})",
    "math.floor({x})",
    "{x} // {f}",
)
"""What one input and constants give."""


@st.composite
def conditions(draw: st.DrawFn) -> str:
    """A few comparisons, joined."""
    joined = ""
    for _ in range(draw(st.integers(1, 3))):
        number = draw(st.sampled_from(NUMBERS))
        number = number.format(x=draw(INPUT), f=draw(FACTOR), g=draw(FACTOR), c=draw(CONSTANT))
        part = f"{number} {draw(st.sampled_from(['<', '<=', '>', '>=', '==', '!=']))} {draw(CONSTANT)}"
        joined = f"{joined} {draw(st.sampled_from(['and', 'or', 'and not', 'or not']))} {part}" if joined else part
    return f"any({joined} for p in view.peers)"


def points(condition: str, top: float) -> list[float]:
    """A grid, the constants of a condition, what simple arithmetic makes of them, and the floats beside each."""
    seeds = {float(word) for word in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", condition)}
    near = {x for a in seeds for b in seeds for x in (a, a + b, a - b, b - a, a * b)}
    near |= {x for a in seeds for b in seeds if b for x in (a / b, (a - b) / b)}
    near |= {top * k / 16 for k in range(17)}
    around = {y for x in near for y in (math.nextafter(x, -math.inf), x, math.nextafter(x, math.inf))}
    return sorted(x for x in around if 0 <= x <= top)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("generated")
    (path / "helper.py").write_text(HELPER)
    return path


@settings(max_examples=30)
@given(condition=conditions())
def test_the_search_finds_what_brute_force_finds(folder: Path, condition: str) -> None:
    policy = written(folder, source(f"bad = {condition}"))
    verdict = prove(policy, parse(LINE), max_drones=2, views=0)[-1]
    charges = points(condition, 1.0) if "soc" in condition else [0.5]
    goodputs = points(condition, 1e5) if "first" in condition or "goodput" in condition else [50.0]
    views = (fleet_of(2, soc=soc, goodput=goodput) for soc, goodput in product(charges, goodputs))
    bad = next((view for view in views if any(d.rate_hz > 10 for d in policy(view))), None)
    assert verdict.outcome in ("proved", "refuted"), verdict.what
    assert bad is None or verdict.outcome == "refuted", condition
