"""Small policies: with a fault that the search must find, with one that no proof follows, and correct ones.

A body is the inside of `decide`, after `me`, `soc` and `first` (the goodput to the first peer) are set. It sets `bad`,
and a bad decision is sent at 20 Hz where 10 Hz is allowed.
"""

from __future__ import annotations

LINE = "rate_hz <= 10"
HEAD = """
import functools, itertools, math, operator, random, time, zlib, os, helper
import numpy as np
from helper import LEAST, rate
from sortie import Directive, FleetView, LinkState, Representation, Reposition, TaskPhase
from sortie import boxes_across_networks, looks_from
from sortie.policies import contract
from sortie.policies.geometry import peers_by_overlap
RATES = {0: 2.0}
SEEN = []
BEGIN = time.time()
TABLE = [(0.6, 10.0), (0.3, 5.0), (0.0, 2.0)]
"""
START = """def decide(view):
    me = view.me
    if me is None or not view.peers:
        return []
    bad = False
    soc, first = me.battery_soc, me.goodput_to(view.peers[0])
"""
END = """
    rate_hz = 20.0 if bad else 2.0
    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=rate_hz, reason="r") for p in view.peers]
"""
HELPER = """
LEAST = 0.3
NOW = [0]
def rate(soc, least=LEAST):
    return 2.0 if soc < least else 8.0
"""
"""A module beside every policy, under the name helper."""
FIRST_LINE = HEAD.count("\n") + 1
"""Where `def decide` stands."""


def source(body: str) -> str:
    """The whole file of a body."""
    return HEAD + START + "".join(f"    {line}\n" for line in body.splitlines()) + END


FOUND = (
    "bad = 2 < first <= 5",
    "bad = first == 7",
    "bad = soc >= 1",
    "bad = 0 < soc < 1e-320",
    "bad = 0.1 + 0.2 <= soc < 0.3000000000000001",
    "bad = 0.3 < soc * 3 < 0.3000000001",
    "bad = soc + 0.1 == 0.7",
    "bad = 1 - soc == 0.9",
    "bad = first // 10 == 3",
    "bad = math.floor(first) == 13",
    "bad = min(first, 5) == 5 and max(first, 6) == 6",
    "bad = abs(soc - 1) == 0.5",
    "bad = first * 9007199254740993 >= 9.007199254740992e20",
    "bad = soc * 1e-320 == 0 and soc > 1e-6",
    "bad = 0.55 < view.age_s[view.peers[0]] < 0.5500001",
    "bad = view.age_s[view.ego] > 7300",
    "bad = view.descriptors[view.peers[0]].battery_soc == 0.31",
    "bad = view.descriptors[view.peers[0]].novelty_flags & 96 == 64",
    "bad = len(me.priority_target_ids) > 15",
    "bad = me.region is not None and me.region.radius_m < 1e-300",
    "bad = me.region is not None and 10 < me.region.x_m < 10.0000001",
    "bad = me.link_state(view.peers[0]) is LinkState.PROBED",
    "bad = len(view.peers) > 1 and peers_by_overlap(view)[0] == view.peers[-1]",
    "bad = not view.shares_features_with(view.peers[0])",
    "bad = len(view.attached.peers) < len(view.peers) and soc == 0.5",
    "bad = (first > 5) + (first > 7) == 1",
    "bad = [False, True, False][(soc > 0.4) + (soc > 0.4000001)]",
    "bad = sorted([0.4, soc, 0.4000001])[1] == soc and soc != 0.4",
    "bad = min(max(me.cpu_headroom, 0.1), 0.1001) == me.cpu_headroom and me.cpu_headroom != 0.1",
    "bad = sum(first > c for c in (5, 7)) == 1",
    "for c, answer in ((5, False), (7, True)):\n    if first <= c:\n        bad = answer\n        break",
    "x = first\nwhile x > 5:\n    bad = x <= 7\n    break",
    "if (x := soc) > 0.4:\n    bad = x <= 0.4000001",
    "bad = (0.4, 9) < (soc, 0) and [soc] <= [0.4000001] and soc != 0.4",
    "def up(x, c):\n    return 0 if not c or x <= c[0] else 1 + up(x, c[1:])\nbad = up(first, [5, 7]) == 1",
    "bad = 'lmh'[(first > 5) + (first > 7)] == 'm'",
    "bad = max([(soc > 0.4, 'a'), (soc > 0.4000001, 'b')])[1] == 'a' and soc > 0.4",
    "match soc:\n    case x if 0.4 < x <= 0.4000001:\n        bad = True",
    "limit = 0.4\ndef near(x):\n    return limit <= x < limit + 1e-9\nbad = near(soc)",
    "bad = rate(soc) > 2 and soc < LEAST + 1e-9",
    "bad = list(view.descriptors)[0] == view.peers[-1] and soc == 0.4",
    "bad = next(iter(view.age_s)) != min(view.age_s) and soc == 0.4",
    "bad = soc < me.cpu_headroom < soc + 1e-9",
    "rate_hz = soc * 10.000001\nreturn [Directive(view.ego, p, rate_hz=rate_hz, reason='r') for p in view.peers]",
    "return {p: Directive(view.ego, p, reason='r') for p in view.peers}",
)
"""Plain Python: the search finds the fault, in however few floats it lies."""

_MORE = "for more than arithmetic with constants and comparisons"
NOT_FOLLOWED = {
    # what stays between decisions
    "SEEN.append(1)": "hands on SEEN",
    "decide.calls = 1": "sets decide.calls",
    "def f(kept=SEEN):\n    return kept\nbad = f()": "hands on SEEN",
    "from helper import NOW\nbad = NOW": "has ImportFrom",
    # clocks, dice, files, identity, hashes and orders
    "bad = time.time() % 1000 < 1e-6": "uses time",
    "bad = BEGIN": "uses BEGIN",
    "bad = random.random() < 1e-7": "uses random",
    "bad = hash('bad') % 1000003 == 0": "uses hash",
    "bad = next(iter({'a', 'b', 'c'})) == 'c'": "has a set",
    "bad = soc is me.battery_soc": "compares by `is` with more than None, a truth value or an enum",
    "import datetime": "has Import",
    # what a stand-in for a number may answer otherwise than a number
    "bad = type(me)": "uses type",
    "bad = isinstance(soc, float) and soc == 0.4": "uses isinstance",
    "bad = me.__class__": "uses .__class__",
    "bad = bool(np.float64(0.4) == soc)": "uses np",
    "bad = sum([soc, 1e16]) == 1e16": "adds with sum(…) in place of sortie.scenarios.plain_sum.plain_sum",
    "me.battery_soc = 1": "sets me.battery_soc",
    "bad = view._replace(age_s={})": "hands age_s to a function",
    "bad = Directive(**{})": "hands ** to a function",
    "match me:\n    case (_, x, *_):\n        bad = x == 1": "has MatchSequence",
    "rate = 1.0": "gives rate another meaning",
    # texts with numbers in them
    "bad = f'{soc}' == '0.5'": "uses an f-string with values for more than `reason` or `why`",
    "why = f'{soc!r}'": "uses an f-string with values for more than `reason` or `why`",
    "why = f'{soc}'\nbad = len(why)": "uses why for more than a reason",
    "bad = Directive(0, 1, reason='a').reason == 'a'": "uses .reason",
    "bad = str(soc) == '0.5'": "uses str(…) for more than a reason",
    "bad = sorted([soc, 0.5], key=str)[0] == 0.125": "hands on str",
    "bad = 'charge %.7f' % soc == 'charge 0.1234567'": "has % on a constant or a text",
    # what hides an error, and what else is no plain Python
    "try:\n    bad = {0.4: True}.get(soc, False)\nexcept TypeError:\n    pass": "has a try statement",
    "class K:\n    pass": "has a class",
    "def f():\n    global NEW\nbad = f()": "has Global",
    "del bad": "has Delete",
    # what cannot be searched
    "bad = me.stamp_ns % 1000003 == 7": "reads stamp_ns, which cannot be searched",
    "bad = me.coverage_grid[3] == 77": "reads coverage_grid, which cannot be searched",
    "bad = me.position_m[0] == 12.5": "reads position_m without peers_by_overlap",
    "bad = me == view.descriptors[view.peers[0]]": "reads a whole descriptor, which cannot be searched",
    "bad = any(t == 7 for t in me.priority_target_ids)": "reads the ids of targets",
    "bad = math.isclose(soc, 0.4)": f"uses battery_soc of drone 0 {_MORE}",
    "bad = int(first) == 13": f"uses goodput of drone 0 to drone 1 {_MORE}",
    "bad = first * 1e305 == math.inf": "computes with goodput of drone 0 to drone 1 beyond what a float can hold",
    "bad = len(me) == 18 and soc == 0.4": "raises TypeError on stand-ins alone",
}
"""More than a proof follows, and why: such a policy is tried on drawn views, and never called proved."""

USUAL = """
def usual(view, bad=False, rho=0.0):
    rung, rate_hz = Representation.FEATURES if rho else Representation.DETECTIONS, 20.0 if bad else 2.0
    return [Directive(view.ego, p, rung, rho, rate_hz=rate_hz, reason="r") for p in view.peers]
"""
_COUNTS = "calls = [0]\n    def decide(view):\n        calls[0] += 1\n        return usual(view, calls[0] > 99999)"
FILES = {
    "a default value": "def decide(view, kept=[]):\n    kept.append(1)\n    return usual(view, len(kept) > 99999)",
    "an object": "class Policy:\n    def __call__(self, view):\n        return usual(view, True)\ndecide = Policy()",
    "a closure": f"def make():\n    {_COUNTS}\n    return decide\ndecide = make()",
    "a generator": "COUNT = (n for n in range(10**9))\ndef decide(view):\n    return usual(view, next(COUNT) > 99999)",
    "a cache": "@functools.lru_cache\ndef box():\n    return []\ndef decide(view):\n    return usual(view, box())",
    "a decorator": "def loud(f):\n    return lambda v: f(v)\n@loud\ndef decide(view):\n    return usual(view, True)",
    "a class": "class D(Directive):\n    rho = 0.0\ndef decide(view):\n    return [D(*d) for d in usual(view, True)]",
}
"""Whole files after `HEAD` and `USUAL`, each with a fault, and none is followed."""

PROVED = (
    "return [contract.nothing(view.ego, p, 'rests') for p in view.peers]",
    "x = 5.0 if soc >= 0.6 else 2.0 if soc >= 0.3 else 1.0\nbad = x > 5",
    "bad = 1 < soc <= 6 or first > 100000 or -2 < soc <= -0.5 or view.age_s[view.ego] > 2**32",
    "bad = soc * 10 > 10 or soc + 9 > 10 or 1 - soc < 0 or first // 10 < 0",
    "bad = int(first) > first if first in (1.0, 2.0) else False",
    "bad = me.task_phase == TaskPhase.TRACK and me.task_phase != 2",
    "bad = me.novelty_flags > 255 or me.novelty_flags & 4 not in (0, 4)",
    "bad = len(me.priority_target_ids) < 0 or view.age_s[view.peers[0]] < 0",
    "match me.task_phase:\n    case TaskPhase.TRACK | TaskPhase.SEARCH:\n        x = 5\n    case _:\n        x = 1",
    "why = f'charge {soc:.0%}, goodput {first:.1f}'\nwhy += ', low'\nx = Directive(0, 1, reason=why + f'{LEAST}')",
    "def reason(p):\n    return f'{p}' if p else 'none'\nx = Directive(0, 1, reason=reason(1))",
    "x = {p: 2.0 if me.goodput_to(p) < 5 else 8.0 for p in view.peers}\nbad = any(r > 8 for r in x.values())",
    "bad = len(peers_by_overlap(view)[:2]) > 2",
    "bad = me.link_state(view.peers[0]) is LinkState.MEASURED and first == 0",
    "bad = rate(soc) > 8 or (RATES[0] + RATES.get(1, 2.0) if 0 in RATES else 20) > 10",
    "bad = next(x for limit, x in TABLE if soc >= limit) > 10",
    "def steps(n):\n    return 0 if n == 0 else 1 + steps(n - 1)\nbad = steps(3) != 3 or soc < 0",
    "bad = any(a == b for a, b in zip(view.peers, view.peers[1:])) or math.sqrt(4) != 2",
    "bad = view.shares_features_with(view.peers[0]) and me[6] > 1",
    "bad = sum(1 for p in view.peers if me.goodput_to(p) > 5) > len(view.peers)",
    "x = {p: 2 if d.battery_soc < 0.5 else 3 for p, d in view.descriptors.items()}\nbad = max(x.values()) > 3",
)
"""Plain Python that keeps the line."""

_NEAR = "def near(view):\n    return None if view.me is None else Reposition(view.me.position_m[0], 0.0)"
_CAPPED = "[d._replace(rate_hz=min(d.rate_hz, 9.0), reason=f'capped: {d.reason}') for d in worked(view)]"
PROVED_FILES = {
    "a catalogue's": f"from sortie.policies.catalogue.worked import worked\ndef decide(view):\n    return {_CAPPED}",
    "a viewpoint": f"{_NEAR}\n@looks_from(near)\ndef decide(view):\n    return usual(view)",
    "a network": "@boxes_across_networks\ndef decide(view: FleetView, *, rho=0.5):\n    return usual(view, rho=rho)",
}
"""Whole files after `HEAD` and `USUAL`, in plain Python that keeps the line."""
