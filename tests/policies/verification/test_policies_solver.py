"""Policies that combine inputs: proved by the solver, over the reals where there is arithmetic, and never too much."""

from __future__ import annotations

from pathlib import Path

import pytest

from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import ProofVerdict, prove

pytestmark = pytest.mark.slow

pytest.importorskip("z3")

HEAD = """
from sortie import Directive, Representation
def to(view, p, rate_hz, rho=0.0):
    rung = Representation.FEATURES if rho else Representation.DETECTIONS
    return Directive(view.ego, p, rung, rho, None, rate_hz, reason="r")
def decide(view):
    me = view.me
    if me is None or not view.peers:
        return []
"""
NATURAL = {
    "water-filling": (
        "proved",
        "total = sum(me.goodput_to(p) for p in view.peers)\n"
        "if total <= 0: return [to(view, p, 1.0) for p in view.peers]\n"
        "return [to(view, p, 10.0, me.goodput_to(p) / total) for p in view.peers]",
    ),
    "linear": (
        "proved",
        "score = 0.6 * me.battery_soc + 0.4 * me.cpu_headroom\nreturn [to(view, p, 10.0 * min(1.0, score)) for p in view.peers]",
    ),
    "leader by goodput": (
        "proved",
        "best = max(view.peers, key=me.goodput_to)\nreturn [to(view, p, 10.0 if p == best else 0.0) for p in view.peers]",
    ),
    "two richest": (
        "proved",
        "top = sorted(view.peers, key=lambda p: -view.descriptors[p].battery_soc)[:2]\n"
        "return [to(view, p, 5.0 if p in top else 0.0) for p in view.peers]",
    ),
    "product": (
        "proved",
        "return [to(view, p, min(10.0, me.goodput_to(p) * me.battery_soc)) for p in view.peers]",
    ),
    "a truth as a number": (
        "proved",
        "score = me.battery_soc * me.cpu_headroom + me.battery_soc * (me.task_phase == 2)\nreturn [to(view, p, min(10.0, score)) for p in view.peers]",
    ),
    "mean charge": (
        "proved",
        "mean = sum(d.battery_soc for d in view.descriptors.values()) / len(view.descriptors)\n"
        "return [to(view, p, 10.0 if me.battery_soc >= mean else 2.0) for p in view.peers]",
    ),
    "worst link": (
        "proved",
        "worst = min(me.goodput_to(p) for p in view.peers)\nreturn [to(view, p, max(1.0, min(10.0, worst / 5))) for p in view.peers]",
    ),
    "difference": (
        "proved",
        "near = {p: abs(me.battery_soc - view.descriptors[p].battery_soc) < 0.2 for p in view.peers}\n"
        "return [to(view, p, 10.0 if near[p] else 4.0) for p in view.peers]",
    ),
}
FAULTY = {
    "sliver of a sum": "bad = 1.2 < me.battery_soc + me.cpu_headroom < 1.2000001",
    "sliver of a product": "bad = 0.4 < me.battery_soc * me.cpu_headroom < 0.4000001",
    "equal inputs": "bad = me.battery_soc == me.cpu_headroom",
    "order": "bad = me.battery_soc < me.cpu_headroom < me.gpu_headroom < me.battery_soc + 1e-9",
    "leader": "bad = max(view.peers, key=me.goodput_to) != view.peers[0] and me.goodput_to(view.peers[0]) > 99999.5",
    "quotient": "bad = me.cpu_headroom > 0 and 7 < me.battery_soc / me.cpu_headroom < 7.000001",
}
BEYOND = {
    "sine of a sum": "import math\nbad = math.sin(me.battery_soc + me.cpu_headroom) > 0.99999999",
    "one ulp of rounding": "bad = (me.battery_soc + me.cpu_headroom) - me.cpu_headroom != me.battery_soc",
    "text of a sum": "bad = f'{me.battery_soc + me.cpu_headroom:.6f}' == '1.234567'",
    "modulo of a sum": "bad = (me.battery_soc + me.cpu_headroom) % 0.7 == 0.1",
    "whole part of a sum": "bad = int(me.battery_soc + me.cpu_headroom) == 2",
}


def verdict(tmp_path: Path, body: str, line: str = "rate_hz <= 10") -> ProofVerdict:
    path = tmp_path / "policy.py"
    path.write_text(HEAD + "".join(f"    {row}\n" for row in body.splitlines()))
    return prove(resolve(f"{path}:decide"), parse(line), max_drones=3, views=0)[-1]


@pytest.mark.parametrize("name", NATURAL)
def test_natural_policies_are_proved(name: str, tmp_path: Path) -> None:
    outcome, body = NATURAL[name]
    found = verdict(tmp_path, body)
    assert (found.outcome, found.what.partition(",")[0]) == (outcome, "all views of up to 3 drones")


@pytest.mark.parametrize("name", FAULTY)
def test_faults_where_inputs_are_combined_are_found(name: str, tmp_path: Path) -> None:
    body = f"{FAULTY[name]}\nreturn [to(view, p, 20.0 if bad else 2.0) for p in view.peers]"
    found = verdict(tmp_path, body)
    assert found.outcome == "refuted"
    assert found.counterexample is not None


@pytest.mark.parametrize("name", BEYOND)
def test_what_the_reals_do_not_show_is_not_proved_exactly(name: str, tmp_path: Path) -> None:
    body = f"{BEYOND[name]}\nreturn [to(view, p, 20.0 if bad else 2.0) for p in view.peers]"
    assert verdict(tmp_path, body).outcome in ("tried", "refuted")
