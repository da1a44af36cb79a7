"""Policies that combine inputs: proved by the solver, over the reals where there is arithmetic, and never too much."""

from __future__ import annotations

from pathlib import Path

import pytest
from policies_examples import written

from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.proof.proof import ProofVerdict, prove

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
    "water-filling": """total = sum(me.goodput_to(p) for p in view.peers)
if total <= 0: return [to(view, p, 1.0) for p in view.peers]
return [to(view, p, 10.0, me.goodput_to(p) / total) for p in view.peers]""",
    "a weighted sum": """score = 0.6 * me.battery_soc + 0.4 * me.cpu_headroom
return [to(view, p, 10.0 * min(1.0, score)) for p in view.peers]""",
    "a leader by goodput": """best = max(view.peers, key=me.goodput_to)
return [to(view, p, 10.0 if p == best else 0.0) for p in view.peers]""",
    "the two richest": """top = sorted(view.peers, key=lambda p: -view.descriptors[p].battery_soc)[:2]
return [to(view, p, 5.0 if p in top else 0.0) for p in view.peers]""",
    "a truth as a number": """score = me.battery_soc * me.cpu_headroom + me.battery_soc * (me.task_phase == 2)
return [to(view, p, min(10.0, score)) for p in view.peers]""",
    "a difference": """near = {p: abs(me.battery_soc - view.descriptors[p].battery_soc) < 0.2 for p in view.peers}
return [to(view, p, 10.0 if near[p] else 4.0) for p in view.peers]""",
}
FAULTY = (
    "bad = 1.2 < me.battery_soc + me.cpu_headroom < 1.2000001",
    "bad = 0.4 < me.battery_soc * me.cpu_headroom < 0.4000001",
    "bad = me.battery_soc == me.cpu_headroom",
    "bad = me.battery_soc < me.cpu_headroom < me.gpu_headroom < me.battery_soc + 1e-9",
    "bad = max(view.peers, key=me.goodput_to) != view.peers[0] and me.goodput_to(view.peers[0]) > 99999.5",
    "bad = me.cpu_headroom > 0 and 7 < me.battery_soc / me.cpu_headroom < 7.000001",
)
BEYOND = (
    "import math\nbad = math.sin(me.battery_soc + me.cpu_headroom) > 0.99999999",
    "bad = (me.battery_soc + me.cpu_headroom) - me.cpu_headroom != me.battery_soc",  # one unit of rounding
    "bad = f'{me.battery_soc + me.cpu_headroom:.6f}' == '1.234567'",
    "bad = (me.battery_soc + me.cpu_headroom) % 0.7 == 0.1",
    "bad = int(me.battery_soc + me.cpu_headroom) == 2",
)


def verdict(folder: Path, body: str, max_drones: int) -> ProofVerdict:
    policy = written(folder, HEAD + "".join(f"    {row}\n" for row in body.splitlines()))
    return prove(policy, parse("rate_hz <= 10"), max_drones=max_drones, views=0)[-1]


def faulty(body: str) -> str:
    return f"{body}\nreturn [to(view, p, 20.0 if bad else 2.0) for p in view.peers]"


@pytest.mark.parametrize("drones", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_natural_policies_are_proved(drones: int, tmp_path: Path) -> None:
    found = {name: verdict(tmp_path, body, drones) for name, body in NATURAL.items()}
    said = {name: (v.outcome, v.what.partition(",")[0]) for name, v in found.items()}
    assert said == dict.fromkeys(NATURAL, ("proved", f"all views of up to {drones} drones"))


def test_faults_where_inputs_are_combined_are_found(tmp_path: Path) -> None:
    found = {body: verdict(tmp_path, faulty(body), 3 if "peers[0]" in body else 2) for body in FAULTY}
    assert {body: v.outcome for body, v in found.items() if v.counterexample is None} == {}


def test_what_the_reals_do_not_show_is_not_proved_exactly(tmp_path: Path) -> None:
    found = {body: verdict(tmp_path, faulty(body), 2).outcome for body in BEYOND}
    assert {body for body, outcome in found.items() if outcome not in ("tried", "refuted")} == set()
