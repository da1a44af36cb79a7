"""Faulty policies as people write them by mistake: the invariants that each promises, and the body of its `decide`.

The body may use `view`, its `me`, `peers` and `soc`, the function `links(representation, rate_hz, **fields)`, which makes a
directive for each peer, and the dictionary `STATE`, which stays between decisions.
"""

from __future__ import annotations

_HEAD = """from sortie import Directive, Representation, TaskPhase
from sortie.policies.contract import PERSON_FLAG

INVARIANTS = '''
{lines}
'''
STATE = {{}}
NONE, BOXES, FEATURES = Representation.NONE, Representation.DETECTIONS, Representation.FEATURES


def decide(view{parameters}):
    me, peers = view.me, view.peers
    if me is None:
        return []
    soc = me.battery_soc

    def links(rung, rate_hz, rho=0.0, to=peers, **fields):
        return [Directive(view.ego, p, rung, rho, rate_hz=rate_hz, reason="r", **fields) for p in to]

{body}
"""
_RATE = "rate_hz <= 10"
_PERSON = "when human_in_region and peers >= 1: any_link(representation >= detections and rate_hz >= 2)"
_DETACHED = "when age_periods > 10: rate_hz == 0"

HONEST: dict[str, tuple[str, str]] = {
    "constant: battery": ("when battery < 0.3: rate_hz <= 2", "return links(BOXES, 2.0 if soc < 0.25 else 5.0)"),
    "constant: battery at its bound": ("when battery <= 0.3: rate_hz <= 2", "return links(BOXES, 2.0 if soc < 0.3 else 5.0)"),
    "constant: goodput": (
        "when goodput_mbps < 5: representation <= detections",
        "good = {p: me.goodput_to(p) >= 4 for p in peers}\n"
        "return [Directive(view.ego, p, BOXES, rate_hz=2.0, reason='r') if not good[p] or not view.shares_features_with(p)\n"
        "        else Directive(view.ego, p, FEATURES, 0.1, rate_hz=2.0, reason='r') for p in peers]",
    ),
    "constant: a narrow range": (_RATE, "return links(BOXES, 20.0 if 0.4 < soc < 0.401 else 5.0)"),
    "constant: beyond the contract": ("", "return links(BOXES, 31.0 if soc > 0.95 and me.gpu_headroom > 0.9 else 5.0)"),
    "constant: one flag": (_RATE, "return links(BOXES, 15.0 if me.novelty_flags == 5 else 5.0)"),
    "constant: a deadline": ("deadline_s <= 0.5", "return links(BOXES, 5.0, deadline_s=0.6 if me.cpu_headroom < 0.07 else 0.1)"),
    "constant: a phase": (
        "when phase == landing: representation == none",
        "return links(NONE if me.task_phase == TaskPhase.RETURN else BOXES, 5.0)",
    ),
    "state: a counter": (_RATE, "STATE['n'] = STATE.get('n', 0) + 1\nreturn links(BOXES, 20.0 if STATE['n'] > 400 else 5.0)"),
    "state: every hundredth decision": ("", "STATE['n'] = STATE.get('n', 0) + 1\nreturn links(BOXES, 5.0 + (STATE['n'] % 100 == 0))"),
    "state: the last charge": (
        "",
        "before = STATE.get(view.ego, soc)\nSTATE[view.ego] = soc\nreturn links(BOXES, 2.0 if soc < before else 5.0)",
    ),
    "state: who was heard first": ("", "first = STATE.setdefault('first', peers)\nreturn [d._replace(rate_hz=4.0 + (d.destination in first)) for d in links(BOXES, 5.0)]"),
    "stamp: late in the sortie": (_RATE, "return links(BOXES, 20.0 if me.stamp_ns > 90 * 10**9 else 5.0)"),
    "stamp: every tenth second": (_PERSON, "return links(NONE if me.stamp_ns // 10**9 % 10 == 3 else BOXES, 5.0)"),
    "stamp: in place of an age": (
        "when age_s > 1: rate_hz <= 2",
        "late = {p: (me.stamp_ns - view.descriptors[p].stamp_ns) * 1e-9 > 1 for p in peers}\n"
        "return [d._replace(rate_hz=2.0 if late[d.destination] else 5.0) for d in links(BOXES, 5.0)]",
    ),
    "fleet: more than six peers": (_RATE, "return links(BOXES, 20.0 if len(peers) > 6 else 5.0)"),
    "fleet: twelve links": ("", "return links(BOXES, 5.0, to=peers[:12])"),
    "fleet: a rate for each": ("", "return links(BOXES, 40.0 / max(1, len(peers)))"),
    "fleet: thirty drones": (_RATE, "return links(BOXES, 20.0 if len(me.peer_goodput_mbps) >= 30 else 5.0)"),
    "fleet: without rosters": ("", "return [d._replace(rate_hz=1.0 + (me.peer_goodput_mbps[d.destination - (d.destination > view.ego)] > 5)) for d in links(BOXES, 5.0)]"),
    "detached: a time in place of periods": (_DETACHED, "return [d._replace(rate_hz=5.0 * (view.age_s[d.destination] <= 2.0)) for d in links(BOXES, 5.0)]"),
    "detached: never": (_DETACHED, "return links(BOXES, 5.0)"),
    "detached: if tired": (_DETACHED, "gone = 12 if soc < 0.1 else 10\nreturn [d._replace(rate_hz=5.0 * (view.age_s[d.destination] <= gone * view.period_s)) for d in links(BOXES, 5.0)]"),
    "age: a rate": ("", "return [d._replace(rate_hz=min(10.0, 2.0 + view.age_s[d.destination])) for d in links(BOXES, 5.0)]"),
    "age: features for the old": (
        "",
        "old = {p: view.age_s[p] > 1.5 and view.shares_features_with(p) for p in peers}\n"
        "return [d._replace(representation=FEATURES, rho=0.1) if old[d.destination] else d for d in links(BOXES, 5.0)]",
    ),
    "age: a narrow range": ("", "return [d._replace(rate_hz=6.0 if 0.55 < view.age_s[d.destination] < 0.6 else 5.0) for d in links(BOXES, 5.0)]"),
    "age: the sum": ("", "return links(BOXES, 6.0 if sum(view.age_s.values()) > 5 else 5.0)"),
    "person: when tired": (_PERSON, "return links(NONE if soc < 0.15 else BOXES, 5.0)"),
    "person: a peer's flag": (_PERSON, "person = me.novelty_flags & PERSON_FLAG\nreturn links(BOXES if person or soc > 0.5 else NONE, 5.0)"),
    "person: on the way back": (_PERSON, "return links(NONE if me.task_phase == TaskPhase.RETURN and me.gpu_headroom < 0.2 else BOXES, 5.0)"),
    "person: too slow": (_PERSON, "return links(BOXES, 1.0 if soc < 0.3 and me.cpu_headroom < 0.3 else 5.0)"),
    "person: by link": (_PERSON, "return [d._replace(representation=BOXES if me.goodput_to(d.destination) > 1 else NONE) for d in links(BOXES, 5.0)]"),
}  # fmt: skip
"""By what is wrong: the invariants, and the body."""


def honest_source(name: str) -> str:
    """The whole file of an entry."""
    lines, body = HONEST[name]
    return _HEAD.format(lines=lines, parameters="", body="".join(f"    {line}\n" for line in body.splitlines()))
