"""The kit's rules one by one, what its drawn views have, and the checks that stand in a policy's source.

1. A rule of the kit fails alone where a policy breaks it alone.
2. Drawn views have every state on which a rule may decide.
3. Source with checks computes what it computes without them.
4. No source says that it is another one, whichever kind of name it uses.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import Directive, FleetView, Reposition, Representation, looks_from
from sortie.policies.registry import resolve
from sortie.policies.verification.confine import Reached
from sortie.policies.verification.conformance import conform
from sortie.policies.verification.instrument import instrumented
from sortie.policies.verification.policy_rules import RULES
from sortie.policies.verification.source_checks import compiled
from sortie.policies.verification.symbols import Refused
from sortie.policies.verification.views import draw_view, draw_views, shrink

VIEW = fleet_of(5)


def _boxes(view: FleetView, **fields: Any) -> list[Directive]:
    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=2.0, reason="r", **fields) for p in view.peers]


def _reorders(view: FleetView) -> list[Directive]:
    first = next(iter(view.descriptors), None)
    if first is not None and isinstance(view.descriptors, dict):
        view.descriptors[first] = view.descriptors.pop(first)
    return _boxes(view)


def _reorders_ages(view: FleetView) -> list[Directive]:
    first = next(iter(view.age_s), None)
    if first is not None and isinstance(view.age_s, dict):
        view.age_s[first] = view.age_s.pop(first)
    return _boxes(view)


def _explains_the_first_alone(view: FleetView) -> list[Directive]:
    return [d._replace(reason="") if k else d for k, d in enumerate(_boxes(view))]


def _sends_codes(view: FleetView) -> list[Directive]:
    return [d._replace(representation=Representation.CODES, rho=0.5) for d in _boxes(view)]


def _fills_one_receiver(view: FleetView, *, received_budget: float = 1.0) -> list[Directive]:
    """Each sender stays within the budget; the drone of the lowest id gets it from all of them."""
    rho = min(1.0, received_budget * view.full_sharing_maps)
    return [
        Directive(
            view.ego, p, Representation.FEATURES, rho if p == min(view.descriptors) else 0.0, None, 2.0, reason="r"
        )
        for p in view.peers
    ]


def _spends_by_link(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    share = min(1.0, rho * 1.5)
    return [Directive(view.ego, p, Representation.FEATURES, share, None, 2.0, reason="r") for p in view.peers]


def _fails_where_nobody_is_heard(view: FleetView) -> list[Directive]:
    return _boxes(view._replace(ego=view.descriptors[view.ego].agent_id))


def _needs_somebody(view: FleetView) -> Reposition | None:
    x_m, y_m, _ = view.descriptors[view.ego].position_m
    return Reposition(x_m, y_m, "r")


@looks_from(_needs_somebody)
def _looks_where_nobody_is(view: FleetView) -> list[Directive]:
    return _boxes(view)


def _jumps(view: FleetView) -> Reposition | None:
    return None if view.me is None else Reposition(1e4, 0.0)


@looks_from(_jumps)
def _looks_too_far(view: FleetView) -> list[Directive]:
    return _boxes(view)


def _first_seen(view: FleetView) -> list[Directive]:
    first = next((i for i in view.descriptors if i != view.ego), -1)
    return [d._replace(rate_hz=4.0) if d.destination == first else d for d in _boxes(view)]


def _rises_with_age(view: FleetView) -> list[Directive]:
    return [d._replace(rate_hz=2.0 + (view.age_s[d.destination] > 0.5)) for d in _boxes(view)]


TWO_CODEBOOKS = VIEW._replace(
    descriptors={i: d._replace(codebook="0" * 14 if i == 2 else "") for i, d in VIEW.descriptors.items()}
)


@pytest.mark.parametrize(
    ("policy", "rule", "view"),
    [
        (_reorders, "input unchanged", VIEW),
        (_reorders_ages, "input unchanged", VIEW),
        (_explains_the_first_alone, "gives reasons", VIEW),
        (_sends_codes, "maps within one network", TWO_CODEBOOKS),
        (_fills_one_receiver, "budget kept", VIEW),
        (_spends_by_link, "budget kept", VIEW),
        (_fails_where_nobody_is_heard, "one drone and empty views", VIEW),
        (_looks_where_nobody_is, "viewpoint kept", VIEW),
        (_looks_too_far, "viewpoint kept", VIEW),
        (_first_seen, "order of drones irrelevant", VIEW),
        (_rises_with_age, "age-monotone", VIEW),
    ],
)
def test_a_rule_finds_what_breaks_it_and_nothing_else_does(policy: Any, rule: str, view: FleetView) -> None:
    copied = view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))
    broken = [name for name, check in RULES.items() if check(policy, _anew(copied)) is not None]
    assert broken == [rule]
    assert [c.name for c in conform(policy, [_anew(view)]) if not c.holds and c.name in RULES] == [rule]


def _anew(view: FleetView) -> FleetView:
    return view._replace(descriptors=dict(view.descriptors), age_s=dict(view.age_s))


@pytest.mark.parametrize("policy", [_boxes, lambda view: _sends_codes(view)])
def test_a_policy_that_breaks_nothing_keeps_every_rule(policy: Callable[[FleetView], list[Directive]]) -> None:
    assert [name for name, check in RULES.items() if check(policy, _anew(VIEW)) is not None] == []


def test_a_rule_that_no_view_could_check_does_not_hold() -> None:
    def broken(view: FleetView) -> list[Directive]:
        raise ValueError

    held = {c.name: c.holds for c in conform(broken, [VIEW])}
    assert not any(held[name] for name in RULES if name not in ("input unchanged", "viewpoint kept"))
    assert not held["no memory"]


# --- drawn views --------------------------------------------------------------------------------------


def test_drawn_views_have_every_state_on_which_a_rule_may_decide() -> None:
    views = list(draw_views(11, 110))
    drones = [d for v in views for d in v.descriptors.values()]
    away_m = [abs(d.region.x_m - d.position_m[0]) for d in drones if d.region is not None]
    assert min(away_m) < 100 < 2900 < max(away_m)
    assert {d.novelty_flags for d in drones} == set(range(8))
    assert any(set(v.me.roster.members) - v.descriptors.keys() for v in views if v.me is not None and v.me.roster)
    assert any(len(v.peers) < len(v.me.peer_goodput_mbps) for v in views if v.me is not None and v.me.roster is None)
    assert any(list(v.descriptors) != sorted(v.descriptors) for v in views)
    assert {v.period_s for v in views} == {0.1, 0.2, 1.0}
    for periods in (1.0, 3.0, 3.1, 10.0, 10.1):
        for period_s in (0.1, 0.2, 1.0):
            assert any(v.period_s == period_s and v.period_s * periods in v.age_s.values() for v in views)
    assert {0.3, 0.6, 0.2999} <= {d.battery_soc for d in drones}
    assert {0.0, 5.0, 4.99} <= {x for d in drones for x in d.peer_goodput_mbps}
    assert all(a != b for k, a in enumerate(views) for b in views[:k])
    assert len(draw_view(11, 0, 40).descriptors) > 20


def test_shrinking_keeps_a_view_whole_and_makes_it_plain() -> None:
    view = next(v for v in draw_views(11, 500) if v.me is not None and v.me.roster is not None and len(v.peers) > 4)

    def fails(candidate: FleetView) -> bool:
        assert candidate.age_s.keys() == candidate.descriptors.keys()
        return len(candidate.peers) >= 2

    small = shrink(view, fails)
    assert len(small.peers) == 2
    assert set(small.age_s.values()) == {0.0}
    for d in small.descriptors.values():
        assert (d.roster, d.battery_soc, d.region, d.novelty_flags) == (None, 1.0, None, 0)
        assert set(d.peer_goodput_mbps) == {100.0}


# --- source with checks ---------------------------------------------------------------------------------

BODIES = (
    "return 3 in (1, 2), 3 not in (1, 2), 'a' in 'abc', view is None, view is not None, 2 in {2: 1}, 2 not in {2: 1}",
    "a, *b = [1, 2, 3]\n    c, d = (4, 5)\n    return [a, b, c, d, *b, *(x * 2 for x in b)]",
    "s = {1, 2, 3}\n    s &= {2, 3, 4}\n    t = s | {9}\n    t -= {2}\n    t ^= {3, 5}\n    return sorted(s), sorted(t), len({1, 1, 2})",
    "d = {'k': 7}\n    d['k'] -= 2\n    k = {1: 2}.keys()\n    k &= {1}\n    n = 6\n    n |= 1\n    n &= 5\n    n -= 2\n    return d['k'], sorted(k), n, 6 ^ 3, 7 - 2",
    "return f'{1.5:.2f} {2!r} {\"a\"!s:>3}', 7 % 4, -7 % 3, '-'.join(['a', 'b'])",
    "try:\n        return 1 / 0\n    except ZeroDivisionError:\n        return 2",
    "n = []\n    for x in 'ab':\n        try:\n            n.append({'a': 1}[x])\n        except (KeyError, IndexError):\n            n.append(0)\n        else:\n            n.append(2)\n    return n",
    "return [x for x in range(9) if x % 2], {k: v for k, v in zip('ab', (1, 2))}, sum([1, 2, 3]), sum([0.5, 0.25], 1.0)",
    "return math.floor(-1.5), math.ceil(-1.5), math.trunc(-1.5), int(-1.5), round(2.5), math.isnan(1.0), math.isinf(1.0), math.isfinite(1.0)",
    "return isinstance(True, int), isinstance(1.0, (int, str)), type(1) is int, type('a') is int, max((3, 1), key=lambda x: -x)",
    "p = C(2)\n    p.n += 3\n    p.n -= 1\n    return p.n, p.twice, C.of(4).n, p == C(4), f'{[1, 2]!r}'",
    "match 3:\n        case 1 | 2:\n            return 'low'\n        case math.pi:\n            return 'pi'\n        case (3 | 4) as x if x > 2:\n            return x\n        case _:\n            return None",
    "out = []\n    for x in (None, True, 1, -2, 'a', 2.5):\n        match x:\n            case None | True:\n                out.append(0)\n            case 1 | -2:\n                out.append(1)\n            case y if y == 'a':\n                out.append(y)\n            case z:\n                out.append((z, 'rest'))\n    return out",
    "def low():\n        yield 1\n        yield from [2, 3]\n    return list(low()), [y := 5, y + 1], (lambda a, b=2: a + b)(1)",
    "x: int = 3\n    y: 'float'\n    return x",
    "def inner(a, /, b, *c, d=4, **e):\n        return a, b, c, d, sorted(e)\n    return inner(1, 2, 3, d=5, f=6)",
    "return sorted({3, 1, 2}), min({4, 2}), any({0, 1}), all({0, 1}), sorted([3, 1], reverse=True), list(map(str, [1, 2]))",
    "return [*reversed([1, 2])], list(enumerate('ab', 1)), list(filter(None, [0, 1])), functools.reduce(lambda a, b: a * b, [1, 2, 3])",
)
HEAD = """
import functools
import math
from dataclasses import dataclass

@dataclass
class C:
    n: int = 0

    @property
    def twice(self):
        return 2 * self.n

    @classmethod
    def of(cls, n):
        return cls(n)

"""


@pytest.mark.parametrize("body", BODIES)
def test_source_with_checks_computes_the_same(body: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(f"{HEAD}def decide(view):\n    {body}\n")
    plain: Any = resolve(f"{file}:decide")
    assert instrumented(file, "decide")(None) == plain.__wrapped__(None)


def test_a_checked_policy_is_given_its_parameters(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def decide(view, *, a=1, b=2):\n    return [a, b]\n")
    assert instrumented(file, "decide")(None, b=5) == [1, 5]


@pytest.mark.parametrize(
    "source",
    [
        "__text__ = 1",
        "def __text__(): pass",
        "class __same__: pass",
        "def f(__own__): pass",
        "import math as __name__",
        "from math import sqrt as __each__",
        "match 1:\n    case __key__: pass",
        "x = __file__",
        "x = f.__globals__",
        "def __init__(self): pass",
        "class C:\n    def __eq__(self, other): return True",
        "class C:\n    __call__ = len",
        "class C:\n    for x in (): pass",
        "class C:\n    @decorated\n    def __init__(self): pass",
        "class C(metaclass=M): pass",
        "class C:\n    x = property(len)",
        "class C:\n    @property\n    @other\n    def x(self): pass",
        "try: pass\nexcept Exception: pass",
        "try: pass\nexcept: pass",
        "try: pass\nexcept (KeyError, kinds): pass",
        "try: pass\nexcept KeyError as error: pass",
        "try: pass\nfinally: pass",
        "try: pass\nexcept* KeyError: pass",
        "KeyError = TypeError",
        "from helper import TypeError as KeyError",
        "def f(super): pass",
        "raise OSError",
        "raise ValueError from None",
        "with f(): pass",
        "match x:\n    case int(): pass",
        "match x:\n    case [a]: pass",
        "match x:\n    case {}: pass",
        "x = yield_from = (yield 1)",
        "x = a @ b",
        "x = 1j",
        "x = f'{a!a}'",
        "x = 1 < 2 in [3]",
        "x = 3\nx %= 2",
        "def f():\n    global x",
        "async def f(): pass",
        "def f():\n    return [x async for x in y]",
        "class C:\n    x: g() = 1",
        "def f(x: g()): pass",
        "from __future__ import division\ndef f(x: g()): pass",
        "def f() -> 1 // 0: pass",
        "x: D['a'] = 1",
        "import dataclasses\nclass C:\n    x: list[dataclasses.sys.argv[1]]",
        "class D: pass\nD = {}\nx: D['a'] = 1",
        "if __name__ == 'other': pass",
    ],
)
def test_a_source_that_no_check_could_follow_is_refused(source: str) -> None:
    ast.parse(source)  # Python itself takes its syntax
    with pytest.raises(SyntaxError):
        compiled(source.encode(), "mine.py")


def test_a_source_that_checks_can_follow_is_compiled() -> None:
    compiled(
        b"f(__name__=1)\nx = 1 < 2 < 3\nif __name__ == '__main__':\n    f()\ndef f(x: list[int]) -> 'g()': y: int | None = x",
        "mine.py",
    )


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("from math import *", Refused),
        ("import time\nX = time.time()", Reached),
        ("X = open('a')", Reached),
        ("try:\n    X = id(1)\nexcept KeyError:\n    X = 1", Reached),
        ("try:\n    X = 1\nexcept BaseException:\n    X = 1", Refused),
        ("from os import getcwd\nX = getcwd()", Reached),
        ("X = list({'a', 'b'})", Reached),
    ],
)
def test_a_file_that_cannot_be_loaded_with_checks_says_so_and_the_next_one_loads(
    body: str, why: type[BaseException], tmp_path: Path
) -> None:
    file, sound = tmp_path / "mine.py", tmp_path / "sound.py"
    file.write_text(f"{body}\ndef decide(view):\n    return []\n")
    sound.write_text("def decide(view):\n    return [1]\n")
    with pytest.raises(why):
        instrumented(file, "decide")
    assert instrumented(sound, "decide")(None) == [1]
    decide = instrumented(sound, "decide")
    assert [decide(None), decide(None)] == [[1], [1]]


def test_what_a_policy_reached_is_raised_though_it_caught_it_and_not_at_the_next_decision(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import time\nLIST = []\n"
        "def decide(view, *, what=''):\n"
        "    if what == 'clock':\n"
        "        try:\n            time.time()\n        except KeyError:\n            pass\n"
        "    if what == 'keeps':\n        LIST.append(1)\n"
        "    return []\n"
    )
    decide = instrumented(file, "decide")
    assert decide(None) == []
    with pytest.raises(Reached, match=r"uses time\.time"):
        decide(None, what="clock")
    assert decide(None) == []
    for _ in range(2):
        with pytest.raises(Reached, match="remembers: changes LIST"):
            decide(None, what="keeps")
    with pytest.raises(Reached, match="remembers: changes LIST"):  # compared with how it was before the first decision
        decide(None)


def test_the_first_places_of_other_python_are_named_in_their_order() -> None:
    source = b"x = 'a %s' % 1\nwith f(): pass\ny = z.__dict__\nw = '{}'.format(1)\nv = 1j\n"
    with pytest.raises(SyntaxError) as caught:
        compiled(source, "mine.py")
    assert str(caught.value) == (
        "has `%` on text (f-strings may be used) in line 1, a with statement in line 2, the name __dict__ in line 3 "
        "and 2 more, which is not plain Python"
    )
