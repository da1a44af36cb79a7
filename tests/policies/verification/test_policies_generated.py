"""Small random policies against brute force: on a grid, and at every boundary and one float to each side of it."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_corpus import LINE, source
from policies_examples import fleet_of

from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import prove

pytestmark = pytest.mark.slow

WHOLE = st.sampled_from([0, 1, 2, 3, 5, 7, 30, 99])
FLOAT = st.sampled_from([0.0, 0.1, 0.25, 0.3, 0.5, 0.7, 1.0, 2.5, 4.99, 5.0, 77.25])
CONSTANT = st.one_of(WHOLE, FLOAT)
FACTOR = st.sampled_from([1, 2, 3, 0.1, -1, 0.5, 10])
INPUT = st.sampled_from(["soc", "first", "me.goodput_to(p)"])


@st.composite
def numbers(draw: st.DrawFn) -> str:
    """A number that one input and constants give."""
    x = draw(INPUT)
    return draw(
        st.sampled_from(
            [
                x,
                f"{x} * {draw(FACTOR)}",
                f"({x} + {draw(CONSTANT)})",
                f"({draw(CONSTANT)} - {x})",
                f"({x} * {draw(FACTOR)} + {draw(CONSTANT)}) / {draw(FACTOR)}",
                f"min({x}, {draw(CONSTANT)})",
                f"max({draw(CONSTANT)}, {x})",
                f"abs({x} - {draw(CONSTANT)})",
                f"math.floor({x})",
                f"{x} // {draw(FACTOR)}",
            ]
        )
    )


@st.composite
def conditions(draw: st.DrawFn) -> str:
    """A few comparisons, joined."""
    parts = [
        f"{draw(numbers())} {draw(st.sampled_from(['<', '<=', '>', '>=', '==', '!=']))} {draw(CONSTANT)}"
        for _ in range(draw(st.integers(1, 3)))
    ]
    joined = parts[0]
    for part in parts[1:]:
        joined = f"{joined} {draw(st.sampled_from(['and', 'or', 'and not', 'or not']))} {part}"
    return f"any({joined} for p in view.peers)"


def points(condition: str, top: float) -> list[float]:
    """A grid, the constants of a condition, what simple arithmetic makes of them, and the floats beside each."""
    seeds = {
        float(word)
        for word in condition.replace("(", " ").replace(")", " ").replace(",", " ").split()
        if _is_number(word)
    }
    near = {
        x for a in seeds for b in seeds for x in (a, a + b, a - b, b - a, a * b, *((a / b, (a - b) / b) if b else ()))
    }
    near |= {top * k / 16 for k in range(17)} | {0.0, top}
    around = {y for x in near for y in (math.nextafter(x, -math.inf), x, math.nextafter(x, math.inf))}
    return sorted(x for x in around if 0 <= x <= top)


def _is_number(word: str) -> bool:
    return word.lstrip("-").replace(".", "", 1).isdigit()


@given(conditions())
@settings(max_examples=60, deadline=None)
def test_the_search_finds_what_brute_force_finds(condition: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "policy.py")
        path.write_text(source(f"bad = {condition}"))
        policy = resolve(f"{path}:decide")
        verdict = prove(policy, parse(LINE), max_drones=2, views=0)[-1]
        bad = None
        for soc in points(condition, 1.0) if "soc" in condition else (0.5,):
            for goodput in points(condition, 1e5) if "first" in condition or "goodput" in condition else (50.0,):
                if any(d.rate_hz > 10 for d in policy(fleet_of(2, soc=soc, goodput=goodput))):
                    bad = soc, goodput
                    break
            if bad:
                break
    assert verdict.outcome in ("proved", "refuted"), verdict.what
    assert (bad is None) or verdict.outcome == "refuted", (condition, bad)
