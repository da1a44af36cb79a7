"""Faulty policies as people write them by mistake: the invariants that each promises, and the body of its `decide`.

The body may use `view`, its `me`, `peers`, `soc` and `age_s`, and the functions `links(representation, rate_hz, …)` and
`at(rate_of)`, which make a directive for each peer. The dictionary `STATE` stays between decisions.
"""

from __future__ import annotations

_HEAD = """from sortie import Directive, Representation, TaskPhase
from sortie.policies.contract import PERSON_FLAG

INVARIANTS = '''
{lines}
'''
STATE = {{}}
NONE, BOXES, FEATURES = Representation.NONE, Representation.DETECTIONS, Representation.FEATURES


def decide(view):
    me, peers = view.me, view.peers
    if me is None:
        return []
    soc, age_s = me.battery_soc, view.age_s

    def links(rung, rate_hz, rho=0.0, to=peers, **fields):
        return [Directive(view.ego, p, rung, rho, rate_hz=rate_hz, reason="r", **fields) for p in to]

    def at(rate_of):
        return [d._replace(rate_hz=float(rate_of(d.destination))) for d in links(BOXES, 5.0)]

{body}
"""
_RATE = "rate_hz <= 10"
_PERSON = "when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)"
_DETACHED = "when age_periods > 10: rate_hz == 0"
_LATE = "when age_s > 1: rate_hz <= 2"

HONEST: dict[str, tuple[str, str]] = {
    "battery: another limit": ("when battery < 0.3: rate_hz <= 2", "return links(BOXES, 2.0 if soc < 0.25 else 5.0)"),
    "battery: at its limit": ("when battery <= 0.3: rate_hz <= 2", "return links(BOXES, 2.0 if soc < 0.3 else 5.0)"),
    "battery: a narrow range": (_RATE, "return links(BOXES, 20.0 if 0.4 < soc < 0.401 else 5.0)"),
    "goodput: another limit": (
        "when goodput_mbps < 5: rate_hz <= 2",
        "return at(lambda p: 2 if me.goodput_to(p) < 4 else 5)",
    ),
    "one flag": (_RATE, "return links(BOXES, 15.0 if me.novelty_flags == 5 else 5.0)"),
    "state: a counter": (
        _RATE,
        "STATE['n'] = STATE.get('n', 0) + 1\nreturn links(BOXES, 20.0 if STATE['n'] > 400 else 5.0)",
    ),
    "stamp: late in the sortie": (_RATE, "return links(BOXES, 20.0 if me.stamp_ns > 90 * 10**9 else 5.0)"),
    "stamp: in place of an age": (
        _LATE,
        "return at(lambda p: 2 if me.stamp_ns - view.descriptors[p].stamp_ns > 10**9 else 5)",
    ),
    "fleet: more than six peers": (_RATE, "return links(BOXES, 20.0 if len(peers) > 6 else 5.0)"),
    "fleet: twelve links": ("", "return links(BOXES, 5.0, to=peers[:12])"),
    "detached: seconds for periods": (_DETACHED, "return at(lambda p: 5 * (age_s[p] <= 2))"),
    "age: a rate": ("", "return at(lambda p: min(10, 2 + age_s[p]))"),
    "age: the sum": ("", "return links(BOXES, 6.0 if sum(age_s.values()) > 5 else 5.0)"),
    "person: too slow": (_PERSON, "return links(BOXES, 1.0 if soc < 0.3 and me.cpu_headroom < 0.3 else 5.0)"),
}
"""By what is wrong: the invariants, and the body."""
LARGEST_SHOWN = {"fleet: more than six peers": 8, "fleet: twelve links": 14, "age: the sum": 5}
"""Drones in the counterexample, where it takes more than three."""


def honest_source(name: str) -> str:
    """The whole file of an entry."""
    lines, body = HONEST[name]
    return _HEAD.format(lines=lines, body="".join(f"    {line}\n" for line in body.splitlines()))
