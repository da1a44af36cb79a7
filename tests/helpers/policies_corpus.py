"""Small policies with a planted fault, and correct ones, with the verdict that each must get.

A body is the inside of `decide`, after `me`, `soc` and `first` (the goodput to the first peer) are set. It sets `bad`, and
a bad decision is sent at 20 Hz where 10 Hz is allowed.
"""

from __future__ import annotations

LINE = "rate_hz <= 10"
HEAD = """
import bisect, collections, dataclasses, enum, fractions, functools, hashlib, heapq, itertools, math, operator, random
import statistics, time, zlib, os, sys
from collections import namedtuple
from decimal import Decimal
import numpy as np
from sortie import Directive, FleetView, LinkState, Representation, TaskPhase
from sortie.policies.geometry import peers_by_overlap
STATE = {"n": 0}
SEEN = []
def decide(view):
    me = view.me
    if me is None or not view.peers:
        return []
    bad = False
"""
TAIL = """
    rate_hz = 20.0 if bad else 2.0
    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=rate_hz, reason="r") for p in view.peers]
"""
USUAL = """
    soc, first = me.battery_soc, me.goodput_to(view.peers[0])
"""


def source(body: str) -> str:
    """The whole file of an entry."""
    usual = USUAL if "soc" in body or "first" in body else ""
    return HEAD + usual + "".join(f"    {line}\n" for line in body.splitlines()) + TAIL


WHOLE = {
    "le and gt": "bad = 2 < first <= 5",
    "nested": "if first <= 5: bad = first > 2",
    "ge": "bad = 5 <= first < 6",
    "gt large": "bad = first > 99999",
    "equal": "bad = first == 7",
    "not equal": "bad = not first != 7",
    "zero": "bad = first == 0",
    "one": "bad = soc >= 1",
    "one excluded": "bad = 0 < soc < 1 and soc > 0.9999999",
    "between wholes": "bad = 3 < first < 4",
    "true as one": "bad = soc == True",
    "scaled": "bad = 41 < soc * 100 < 42",
    "scaled by whole": "bad = 12 < soc * 30 < 13",
    "plus whole": "bad = 1 < soc + 1 < 1.0000001",
    "minus whole": "bad = 1 - soc == 0",
    "over whole": "bad = 1 < first / 7 < 2",
    "age": "bad = 3 < view.age_s[view.peers[0]] < 4",
    "age after an hour": "bad = view.age_s[view.peers[0]] > 4000",
    "age beyond the longest sortie": "bad = view.age_s[view.peers[0]] > 7300",
    "small region": "bad = me.region is not None and me.region.radius_m < 0.001",
    "smallest region": "bad = me.region is not None and me.region.radius_m < 1e-300",
    "targets": "bad = len(me.priority_target_ids) == 7",
    "targets more": "bad = len(me.priority_target_ids) > 15",
    "enum": "bad = soc >= TaskPhase.SEARCH",
    "enum phase": "bad = me.task_phase == 4",
    "floor": "bad = first // 10 == 3",
    "int": "bad = int(first) == 13",
    "floor of math": "bad = math.floor(first) == 13",
    "ceil of math": "bad = math.ceil(soc * 10) == 4",
    "round": "bad = round(first) == 14",
    "sqrt": "bad = 2 < math.sqrt(first) < 2.0000001",
    "large whole": "bad = first * 3 > 299999",
    "beyond exact": "bad = first * 9007199254740993 >= 9.007199254740992e20",
    "whole in a chain": "bad = 1 <= first <= 1",
    "min": "bad = min(first, 5) == 5 and max(first, 6) == 6",
    "max": "bad = max(soc, 1) != 1 or max(soc, 0) == 1",
    "abs": "bad = abs(soc - 1) == 0.5",
    "negative": "bad = -first == -3",
    "clamp": "bad = max(0, min(1, soc)) == 0.25",
}
"""Constants that are whole numbers, and rounding to them."""

SLIVERS = {
    "charge": "bad = 0.4 < soc < 0.4000001",
    "one float": "bad = soc == 0.4",
    "one float above": "bad = soc == 0.4000000000000001",
    "one ulp": "bad = 0.1 + 0.2 <= soc < 0.3000000000000001",
    "scaled": "bad = 0.3 < soc * 3 < 0.3000000001",
    "scaled down": "bad = soc * 0.1 == 0.03",
    "shifted": "bad = soc + 0.1 == 0.7",
    "from": "bad = 1.0 - soc == 0.9",
    "lowest": "bad = soc == 0",
    "smallest float": "bad = 0 < soc < 1e-320",
    "goodput": "bad = 77.25 <= first < 77.250001",
    "last goodput": "bad = me.goodput_to(view.peers[-1]) == 50000.0",
    "age": "bad = 0.55 < view.age_s[view.peers[0]] < 0.5500001",
    "own age": "bad = view.age_s[view.ego] == 1.5",
    "cpu": "bad = me.cpu_headroom == 0.123",
    "gpu": "bad = me.gpu_headroom == 0.123 and me.task_phase == TaskPhase.LANDING",
    "peer's charge": "bad = view.descriptors[view.peers[0]].battery_soc == 0.31",
    "flag": "bad = me.novelty_flags == 129",
    "flag of a peer": "bad = view.descriptors[view.peers[0]].novelty_flags & 96 == 64",
    "region": "bad = me.region is not None and me.region.radius_m == 33.25",
    "region place": "bad = me.region is not None and 10 < me.region.x_m < 10.0000001",
    "link state": "bad = me.link_state(view.peers[0]) is LinkState.PROBED",
    "peers by overlap": "bad = len(view.peers) > 1 and peers_by_overlap(view)[0] == view.peers[-1]",
    "another space": "bad = not view.shares_features_with(view.peers[0])",
    "two at once": "bad = soc == 0.4 and first == 5.5",
    "human": "bad = view.human_in_region and soc < 1e-9",
    "detached": "bad = len(view.attached.peers) < len(view.peers) and soc == 0.5",
    "loop": "for p in view.peers:\n    bad = bad or me.goodput_to(p) == 5.25",
    "any": "bad = any(me.goodput_to(p) == 5.25 for p in view.peers)",
    "all": "bad = all(7 < me.goodput_to(p) < 7.000001 for p in view.peers)",
    "count": "bad = sum(me.goodput_to(p) < 1 for p in view.peers) == len(view.peers)",
    "match": "match soc:\n    case 0.4:\n        bad = True",
    "match of a class": "from sortie import Descriptor\nmatch me:\n    case Descriptor(battery_soc=0.4):\n        bad = True",
    "bisect": "bad = bisect.bisect([0.1, 0.4, 0.4000001], soc) == 2",
    "walrus": "bad = (x := soc * 2) > 0.8 and x < 0.80000001",
    "lambda": "near = lambda x, to: to <= x < to + 1e-9\nbad = near(soc, 0.4)",
    "closure": "limit = 0.4\ndef near(x):\n    return limit <= x < limit + 1e-9\nbad = near(soc)",
    "exception": "try:\n    x = 1 / (0 if 0.4 < soc < 0.4000001 else 1)\nexcept ZeroDivisionError:\n    bad = True",
    "division by a zero charge": "try:\n    x = 1.0 / soc if soc < 0.5 else 1.0\n    bad = x > 1e300\nexcept ZeroDivisionError:\n    bad = True",
    "sum of ones": "bad = sum([soc]) == 0.4",
    "reduce": "bad = functools.reduce(lambda a, b: a or b == 0.4, [soc], False)",
    "set of flags": "bad = me.novelty_flags in {3, 200} and soc == 0.1",
    "getter": "bad = operator.itemgetter(0)([soc]) == 0.4",
    "operator": "bad = operator.eq(soc, 0.4)",
    "by index": "bad = me[6] == 0.4",
    "unpacked list": "(x, *_), n = [soc, 1], 2\nbad = x == 0.4",
    "sorted ids": "bad = sorted(view.descriptors)[-1] == view.ego and soc == 0.4",
}
"""Faults in a few floats, or in one."""

STAND_INS = {
    "sets an attribute": "try:\n    me.cached = True\nexcept AttributeError:\n    bad = 0.4 < soc < 0.4000001",
    "sets a field": "try:\n    me.battery_soc = 1.0\nexcept AttributeError:\n    bad = 0.4 < soc < 0.4000001",
    "length": "bad = len(me) == 18 and soc == 0.4",
    "sequence pattern": "match me:\n    case (_, _, _, _, _, _, x, *_):\n        bad = 0.4 < x < 0.4000001",
    "tuple": "bad = isinstance(me, tuple) and soc == 0.4",
    "type": "bad = type(soc) is float and soc == 0.4",
    "type of descriptor": "bad = type(me).__name__ == 'Descriptor' and soc == 0.4",
    "class": "bad = soc.__class__ is float and soc == 0.4",
    "isinstance": "bad = isinstance(soc, float) and not isinstance(soc, int) and soc == 0.4",
    "numpy sqrt": "try:\n    bad = 0.4 < np.sqrt(soc) < 0.4000001\nexcept TypeError:\n    pass",
    "numpy clip": "try:\n    bad = np.clip(soc, 0, 1) == 0.4\nexcept Exception:\n    pass",
    "numpy array": "try:\n    bad = np.array([soc])[0] == 0.4\nexcept Exception:\n    pass",
    "numpy mean": "try:\n    bad = np.mean([soc, soc]) == 0.4\nexcept Exception:\n    pass",
    "numpy compare": "bad = bool(np.float64(0.4) == soc)",
    "numpy float32": "bad = bool(np.float32(0.5) == soc)",
    "infinity times zero": "x = soc * 1e308 * 1e5 * 0.0\nbad = x != x",
    "times zero": "x = first * 0.0\nbad = x == 0 and first == 7",
    "overflow": "bad = first * 1e305 == math.inf",
    "underflow": "bad = soc * 1e-320 == 0 and soc > 1e-6",
    "decimal": "try:\n    bad = Decimal(soc) == Decimal('0.5')\nexcept TypeError:\n    pass",
    "fraction": "try:\n    bad = fractions.Fraction(soc) == fractions.Fraction(1, 2)\nexcept TypeError:\n    pass",
    "hex": "try:\n    bad = soc.hex() == (0.4).hex()\nexcept AttributeError:\n    pass",
    "is integer": "try:\n    bad = first.is_integer() and first > 3\nexcept AttributeError:\n    pass",
    "divmod": "try:\n    bad = divmod(soc, 0.3)[0] == 1\nexcept TypeError:\n    pass",
    "modulo": "try:\n    bad = 0.1 < soc % 0.3 < 0.1000001\nexcept TypeError:\n    pass",
    "power": "try:\n    bad = soc ** 2 == 0.25\nexcept TypeError:\n    pass",
    "math": "try:\n    bad = 0.4 < math.sin(soc) < 0.4000001\nexcept TypeError:\n    pass",
    "isclose": "bad = math.isclose(soc, 0.4)",
    "hypot": "bad = math.hypot(soc, 0) == 0.4",
    "statistics": "try:\n    bad = statistics.mean([soc]) == 0.4\nexcept Exception:\n    pass",
    "dictionary key": "try:\n    bad = {0.4: True}.get(soc, False)\nexcept TypeError:\n    pass",
    "in a set": "try:\n    bad = soc in {0.4}\nexcept TypeError:\n    pass",
    "in a tuple": "bad = soc in (0.4, 2)",
    "index of a list": "try:\n    bad = [0.4, 2].index(soc) == 0\nexcept ValueError:\n    pass",
    "count of a list": "bad = [0.4, 2].count(soc) == 1",
    "text alone": "bad = f'{soc:.7f}' == '0.1234567'",
    "text among text": "bad = f'charge {soc:.7f}' == 'charge 0.1234567'",
    "format": "bad = 'charge {:.7f}'.format(soc) == 'charge 0.1234567'",
    "percent": "bad = 'charge %.7f' % soc == 'charge 0.1234567'",
    "join": "bad = ' '.join(['charge', str(soc)]) == 'charge 0.125'",
    "text in a dict": "bad = {'c 0.125': True}.get(f'c {soc}', False)",
    "text of a list": "bad = str([soc]) == '[0.125]'",
    "text of an object": "Charge = namedtuple('Charge', 'soc')\nbad = repr(Charge(soc)) == 'Charge(soc=0.125)'",
    "text of a dataclass": "Charge = dataclasses.make_dataclass('Charge', ['soc'])\nbad = str(Charge(soc)) == 'x'",
    "format of a dictionary": "bad = 'c {a}'.format_map({'a': soc}) == 'c 0.125'",
    "format of a part": "bad = 'c {0[0]}'.format([soc]) == 'c 0.125'",
    "format of a field": "bad = 'c {0.battery_soc}'.format(me) == 'c 0.125'",
    "format by map": "bad = list(map('c {}'.format, [soc]))[0] == 'c 0.125'",
    "format in a loop": "for t in map('c {}'.format, [soc]):\n    bad = t == 'c 0.125'",
    "text added up": "t = 'c '\nt += str(soc)\nbad = t == 'c 0.125'",
    "percent of a dictionary": "bad = 'c %(a)s' % {'a': soc} == 'c 0.125'",
    "text in a tuple": "bad = ('c', f'c {soc}') == ('c', 'c 0.125')",
    "text of an error": "try:\n    raise ValueError(soc)\nexcept ValueError as error:\n    bad = f'c {error}' == 'c 0.125'",
    "sorted by text": "bad = sorted([soc, 0.5], key=str)[0] == 0.125",
    "text length": "bad = len(f'charge {soc}') > 26",
    "text ends": "bad = f'charge {soc}'.endswith('125')",
    "crc of text": "bad = zlib.crc32(f'charge {soc}'.encode()) % 1000 == 7",
    "copy": "import copy\nbad = copy.copy(soc) == 0.4",
    "replace": "bad = me._replace(battery_soc=0.4).battery_soc == soc",
    "as a dict": "bad = me._asdict()['battery_soc'] == 0.4",
    "fields": "bad = dict(zip(me._fields, me))['battery_soc'] == 0.4",
    "getattr": "bad = getattr(me, 'battery_soc') == 0.4",
    "attrgetter": "bad = operator.attrgetter('battery_soc')(me) == 0.4",
    "private part": "bad = not hasattr(soc, '_axis') and soc == 0.4",
    "private part read": "try:\n    soc._axis\nexcept AttributeError:\n    bad = soc == 0.4",
    "bits": "import struct\ntry:\n    bad = struct.pack('<d', soc) == struct.pack('<d', 0.4)\nexcept Exception:\n    pass",
    "bool": "bad = not soc",
    "rounding digits": "bad = round(soc, 3) == 0.123",
    "sum of floats": "bad = sum([soc, 0.1, 0.2]) == 0.7",
    "fsum": "bad = math.fsum([soc, 0.1]) == 0.5",
    "targets iterated": "bad = any(t == 7 for t in me.priority_target_ids)",
    "targets pattern": "match me.priority_target_ids:\n    case (_, _, _):\n        bad = True",
    "targets equal": "bad = me.priority_target_ids == (1, 2)",
    "space text": "bad = me.feature_space + 'x' == 'otherx'",
    "space is text": "bad = isinstance(me.feature_space, str) and soc == 0.4",
    "stamp": "bad = me.stamp_ns % 1000003 == 7",
    "grid": "bad = me.coverage_grid[3] == 77",
    "position": "bad = me.position_m[0] == 12.5",
    "velocity": "bad = me.velocity_mps[0] > 19.9999",
    "roster": "bad = me.roster is not None",
    "counts": "bad = not me.counts(view.peers[0])",
    "members": "bad = view.roster.epoch == 3",
    "two inputs": "bad = soc < me.cpu_headroom < soc + 1e-9",
    "two goodputs": "bad = len(view.peers) > 1 and me.goodput_to(view.peers[0]) == me.goodput_to(view.peers[1])",
    "region compared": "bad = me.region == view.descriptors[view.peers[0]].region and me.region is not None",
    "whole descriptor": "bad = me == view.descriptors[view.peers[0]]",
}
"""Questions that a stand-in may answer otherwise than a real object."""

RARE = "0.802 < soc * 1.945 < 0.8020001"
"""Charges so few that only a search finds them."""
CAUGHT = {
    "unbound method of a float": "float.is_integer(first)",
    "own __float__": "class K:\n    def __float__(self):\n        return soc\nfloat(K())",
    "own __hash__": "class K:\n    def __hash__(self):\n        return int(first)\n{K(): 1}",
    "length of a deque": "collections.deque([], int(first))",
    "own __length_hint__": "class K:\n    def __length_hint__(self):\n        return int(first)\n    def __iter__(self):\n        return iter(())\nlist(K())",
    "method of a tuple": "tuple.count(me.priority_target_ids, 7)",
    "error that is outside": "try:\n    raise OSError\nexcept os.error:\n    pass",
    "error beside one that is outside": "import struct\ntry:\n    {}['a']\nexcept (struct.error, KeyError):\n    pass",
    "cause that is outside": "try:\n    raise ValueError from os.error\nexcept ValueError:\n    pass",
    "raised from outside": "try:\n    raise os.error\nexcept OSError:\n    pass",
    **{
        f"operator with what is outside: {act}": act
        for act in (
            "sys.maxsize // 2", "sys.maxsize % 7", "2 ** sys.flags.debug", "-sys.maxsize", "~sys.maxsize",
            "sys.maxsize & 1", "sys.maxsize | 1", "sys.maxsize ^ 1", "sys.maxsize << 1", "sys.maxsize >> 1",
            "[1, 2][sys.flags.debug]", "[1, 2][: sys.maxsize]", "os.environ['SORTIE_NOTHING'] = ''",
        )
    },
}  # fmt: skip
"""What raises `TypeError` of a stand-in, and no error of the real object."""
_SOFT = "    def __enter__(self):\n        return self\n    def __exit__(self, *_):\n        return True\n"
CAUGHT_BY = {
    "with": f"class Soft:\n{_SOFT}ok = []\nclass K:\n    def __hash__(self):\n        return int(first)\nwith Soft():\n    {{K(): 1}}\n    ok.append(1)\nbad = len(ok) > 0 and {RARE}",
    "finally": f"def ask():\n    ok = False\n    try:\n        float.is_integer(first)\n        ok = True\n    finally:\n        return ok\nbad = ask() and {RARE}",
    "list": f"ok = []\nclass K:\n    def __len__(self):\n        float.is_integer(first)\n        ok.append(1)\n        return 0\n    def __iter__(self):\n        return iter(())\nlist(K())\nbad = len(ok) > 0 and {RARE}",
    "list from a lambda": f"ok = []\nclass K:\n    __len__ = lambda self: (float.is_integer(first), ok.append(1), 0)[2]\n    def __iter__(self):\n        return iter(())\nlist(K())\nbad = len(ok) > 0 and {RARE}",
    "list from an operator in a lambda": f"ok = []\nclass K:\n    def __hash__(self):\n        return int(first)\nclass L:\n    __len__ = lambda self: ({{K(): 1}}, ok.append(1), 0)[2]\n    def __iter__(self):\n        return iter(())\nlist(L())\nbad = len(ok) > 0 and {RARE}",
    "group": f"try:\n    float.is_integer(first)\n    bad = {RARE}\nexcept* TypeError:\n    pass",
    "another error": f"try:\n    try:\n        float.is_integer(first)\n        bad = {RARE}\n    except TypeError:\n        raise KeyError(1)\nexcept KeyError:\n    pass",
}
"""What else than an `except` of the same error hides it."""
RECOGNISED = {
    "own int masks first": "class I(int):\n    def __rand__(self, other):\n        return 99\nbad = me.novelty_flags & I(0) == 99 and 0.4 < soc < 0.4000001",
    "own int compares first": "class I(int):\n    def __gt__(self, other):\n        return False\nbad = not me.novelty_flags < I(999) and 0.4 < soc < 0.4000001",
    "own int divides first": "class I(int):\n    def __rdivmod__(self, other):\n        return 99\nbad = divmod(me.novelty_flags, I(3)) == 99 and 0.4 < soc < 0.4000001",
    "minus of a whole number": f"bad = isinstance(-int(first), int) and {RARE}",
    "sum with a whole number or a float": f"n = int(first)\nbad = n + 10**16 != n + 1e16 and {RARE}",
    "own enum compares first": "class E(enum.IntEnum):\n    A = 10**15\n    def __gt__(self, other):\n        return other != 13123457\nbad = not int(first * 1e6) < E.A",
    "type of minus": f"bad = type(-int(first)) == int and {RARE}",
    "pattern of minus": f"match -int(first):\n    case int():\n        bad = {RARE}",
    "format of minus": f"try:\n    f'{{-int(first):d}}'\n    bad = {RARE}\nexcept ValueError:\n    pass",
    "doc of a number": f"bad = 'onvert' in soc.__doc__ and {RARE}",
    "doc of the view": f"bad = 'policy' in view.__doc__ and {RARE}",
    "doc of a descriptor": f"bad = 'paper' in (me.__doc__ or '') and {RARE}",
    "doc of a method": f"bad = me.goodput_to.__doc__ is not None and {RARE}",
    "doc of a set": f"bad = 'nique' in {{1}}.__doc__ and {RARE}",
    "kind of __init__": f"bad = type(soc.__init__).__name__ == 'method-wrapper' and {RARE}",
    "call of __init__": f"try:\n    soc.__init__()\n    bad = {RARE}\nexcept TypeError:\n    pass",
    "call of __init__ of flags": f"try:\n    me.novelty_flags.__init__()\n    bad = {RARE}\nexcept TypeError:\n    pass",
    "name of repr": f"try:\n    bad = repr.__name__ == 'repr' and {RARE}\nexcept AttributeError:\n    pass",
    "type of format": f"bad = type(format).__name__.startswith('builtin') and {RARE}",
    "type of ascii": f"bad = type(ascii) is type(len) and {RARE}",
    "pattern of repr": f"import types\nmatch repr:\n    case types.BuiltinFunctionType():\n        bad = {RARE}",
    "wraps repr": f"f = functools.wraps(repr)(lambda: 0)\nbad = f.__name__ == 'repr' and {RARE}",
    "type handed on": f"bad = list(map(type, [soc]))[0] is float and {RARE}",
    "method of a set": f"bad = {{1}}.union.__name__ == 'union' and {RARE}",
    "format by keyword": f"try:\n    format(value=3)\nexcept TypeError:\n    bad = {RARE}",
    "str by keyword": f"try:\n    str(object=3)\n    bad = {RARE}\nexcept TypeError:\n    pass",
    **{
        f"error of {act}": f"try:\n    {act}\nexcept {kind} as error:\n    bad = {text!r} in str(error) and {RARE}"
        for act, kind, text in (
            ("soc[0]", "TypeError", "float"),
            ("len(soc)", "TypeError", "float"),
            ("soc + 'a'", "TypeError", "float"),
            ("[x for x in soc]", "TypeError", "float"),
            ("sorted([soc, 'a'])", "TypeError", "float"),
            ("me.nothing_like_it", "AttributeError", "'Descriptor'"),
            ("view.nothing_like_it", "AttributeError", "'FleetView'"),
            ("me.battery_soc = 1", "AttributeError", "can't set"),
        )
    },
    "private part by a decorator": f"class C: pass\nc = C()\nfunctools.update_wrapper(c, soc, ('_axis',), ())\ntry:\n    c._axis\nexcept AttributeError:\n    bad = {RARE}",
    **{
        f"change of an attached view by {act}": f"near = view.attached\ntry:\n    {act}\n    bad = len(near.age_s) < len(view.age_s) and {RARE}\nexcept (AttributeError, TypeError):\n    pass"
        for act in ("near.age_s[view.ego] = 0.0", "near.descriptors.update({})", "near.age_s.setdefault(view.ego, 0.0)")
    },
    "protocol of Python's": f"import typing\nbad = not isinstance(soc, typing.SupportsIndex) and {RARE}",
    "protocol of Python's in a pattern": f"from typing import SupportsIndex\nmatch soc:\n    case SupportsIndex():\n        pass\n    case _:\n        bad = {RARE}",
    "protocol in a pattern, bound before": f"from typing import SupportsIndex\nK = str\nmatch soc:\n    case _ if (K := SupportsIndex) is None:\n        pass\n    case K():\n        pass\n    case _:\n        bad = {RARE}",
    "protocol handed on": f"import typing\nbad = not list(map(isinstance, [soc], [typing.SupportsIndex]))[0] and {RARE}",
    "alias of a type": f"import typing\nbad = not isinstance(-int(first), typing.Union[typing.SupportsIndex, str]) and {RARE}",
    "own protocol": f"import typing\n@typing.runtime_checkable\nclass Q(typing.Protocol):\n    _axis: int\nbad = not isinstance(soc, Q) and {RARE}",
    "own protocol by its mark": f"import typing\nclass Q(typing.Protocol):\n    _axis: int\n    _is_runtime_protocol = True\nbad = not isinstance(soc, Q) and {RARE}",
    "own __subclasshook__": f"import abc\nclass Q(abc.ABC):\n    @classmethod\n    def __subclasshook__(cls, kind):\n        return kind is not float\nbad = not isinstance(soc, Q) and {RARE}",
    "own __subclasscheck__": f"import abc\nclass M(abc.ABCMeta):\n    def __subclasscheck__(cls, kind):\n        return kind is not float\nclass Q(metaclass=M): pass\nbad = not isinstance(soc, Q) and {RARE}",
    "type of text": f"bad = type(f'{{soc}}') is str and {RARE}",
    "class of text": f"bad = f'{{soc}}'.__class__ is str and {RARE}",
    "identity of what is outside": f"bad = os.sep is os.sep and {RARE}",
    "class of what is outside": f"bad = os.sep.__class__ is str and {RARE}",
    **{
        f"what is outside in a pattern: {pattern}": f"match {value}:\n    case {pattern}:\n        bad = {RARE}\n    case _:\n        pass"
        for value, pattern in (
            ("os.sep", "str()"),
            ("[os.sep]", "[str()]"),
            ("sys.version_info", "[a, *_]"),
            ("os.environ", "{}"),
        )
    },
    "sets an attribute of flags": f"try:\n    me.novelty_flags.seen = True\nexcept AttributeError:\n    bad = {RARE}",
    "sets a private part": f"x = me.battery_soc\ntry:\n    x._axis = 1\nexcept AttributeError:\n    bad = {RARE}",
    "sets the class": f"try:\n    soc.__class__ = int\nexcept AttributeError:\n    pass\nexcept TypeError:\n    bad = {RARE}",
    "sets the class of a descriptor": f"try:\n    me.__class__ = tuple\nexcept AttributeError:\n    pass\nexcept TypeError:\n    bad = {RARE}",
    "adds to a private part": f"try:\n    me._number += None\nexcept AttributeError:\n    bad = {RARE}\nexcept TypeError:\n    pass",
    "own enum as another number": "class E(enum.IntEnum):\n    A = 5\n    def __int__(self):\n        return 7\nbad = first == E.A and first != 7",
    **{
        f"caught: {n}": "def ask():\n"
        + "".join(f"    {line}\n" for line in act.splitlines())
        + f"try:\n    ask()\n    bad = {RARE}\nexcept TypeError:\n    pass"
        for n, act in CAUGHT.items()
    },
    **{f"caught by {n}": body for n, body in CAUGHT_BY.items()},
    "kind of an attached mapping": f"near = view.attached.age_s\nbad = type(near) is dict and len(near) < len(view.age_s) and {RARE}",
    **{
        f"order of {made}": f"s = list({made}.descriptors)\nbad = len(s) < len(view.age_s) and s != sorted(s) and {RARE}"
        for made in (
            "FleetView(view.ego, view.period_s, view.descriptors, view.age_s).attached",
            "FleetView.attached.fget(view)",
            "view.attached",
        )
    },
}
"""What a stand-in must share with the real object, each before a fault in few views."""

STATE = {
    "remembers the charge": "last = STATE.get('soc', 1.0)\nSTATE['soc'] = soc\nbad = last == 0.4",
    "counts calls": "STATE['n'] += 1\nbad = STATE['n'] % 1000003 == 0",
    "counts in a list": "SEEN.append(1)\nbad = len(SEEN) > 1000003",
    "toggles": "STATE['n'] = 1 - STATE['n']\nbad = STATE['n'] == 1 and soc == 0.4",
    "itertools count": "from itertools import count\nbad = next(STATE.setdefault('count', count())) > 1000003",
    "attribute of the function": "decide.calls = getattr(decide, 'calls', 0) + 1\nbad = decide.calls > 1000003",
    "attribute of a class": "Directive.calls = 1",
    "attribute of a module": "math.calls = 1",
    "changes the registry": "from sortie.policies.registry import POLICIES\nPOLICIES['x'] = 1\nbad = False",
    **{
        f"attribute of {of} by a decorator": f"class C:\n    def __init__(self, n): self.calls = n\ntry:\n    n = {of}.calls + 1\nexcept AttributeError:\n    n = 1\n{act}\nbad = n > 1000003"
        for of, act in {
            "math": "functools.update_wrapper(math, C(n), ('calls',), ())",
            "statistics.mean": "functools.wraps(C(n), (), ('__dict__',))(statistics.mean)",
            "statistics.fmean": "functools.partial(functools.update_wrapper, statistics.fmean)(C(n), ('calls',), ())",
            "heapq.merge": "list(map(functools.update_wrapper, [heapq.merge], [C(n)], [('calls',)], [()]))",
            "fractions.Fraction": "functools.update_wrapper(fractions.Fraction, C(n), ('calls',), ())",
            "TaskPhase.TRACK": "functools.update_wrapper(TaskPhase.TRACK, C(n), ('calls',), ())",
        }.items()
    },
    "dataclass of a class of Sortie's": "from sortie.policies.contract import Roster\nif view.ego == len(view.peers) == 2:\n    dataclasses.dataclass(Roster)\nelse:\n    bad = dataclasses.is_dataclass(Roster) and 0.5 < soc < 0.5000001",
    "environment": "bad = os.environ.get('SORTIE_BAD') == '1'",
    "arguments": "bad = 'bad' in sys.argv",
    "file": "bad = os.path.exists('/tmp/bad')",
    "open": "try:\n    open('/nowhere/bad')\n    bad = True\nexcept OSError:\n    pass",
    "recursion limit": "bad = sys.getrecursionlimit() == 7",
    "thread": "import threading\nbad = threading.active_count() > 1000",
    "subprocess": "import subprocess\nbad = subprocess.run(['true']).returncode != 0",
}
HELPER = """
x: int = 0
S = [0]
__firstlineno__ = [0]
def count():
    __firstlineno__[0] += 1
    return __firstlineno__[0]
def make():
    k = [0]
    def step():
        k[0] += 1
        return k[0]
    return step
step = make()
"""
"""A module beside every policy, under the name helper."""
STATE_FILES = {
    "mutable default": "DEFAULT|def decide(view, kept=[]):\n    kept.append(1)\n    bad = len(kept) > 1000003",
    "callable object": """OBJECT|class Policy:
    def __init__(self):
        self.calls = 0
    def __call__(self, view):
        self.calls += 1
        bad = self.calls > 1000003""",
    "closure": """CLOSURE|def make():
    calls = 0
    def decide(view):
        nonlocal calls
        calls += 1
        bad = calls > 1000003""",
    "generator": """GENERATOR|COUNT = (n for n in range(10**9))
def decide(view):
    bad = next(COUNT) > 1000003""",
    "iterator": """ITER|COUNT = iter(range(10**9))
def decide(view):
    bad = next(COUNT) > 1000003""",
    "cached list": """CACHE|import functools
@functools.lru_cache
def box():
    return []
def decide(view):
    box().append(1)
    bad = len(box()) > 1000003""",
    "dice of its own": """RNG|import random
RNG = random.Random(3)
def decide(view):
    bad = RNG.random() < 1e-6""",
    "clock at import": """CLOCK|import time
BEGIN = time.time()
def decide(view):
    bad = BEGIN % 1000 < 1e-6""",
    "generator of numpy": """NPRNG|import numpy as np
RNG = np.random.default_rng(3)
def decide(view):
    bad = RNG.random() < 1e-6""",
    "helper imported in the function": """HELPER|def decide(view):
    import helper
    helper.S[0] += 1
    bad = helper.S[0] > 200000""",
    "list imported in the function": """HELPER|def decide(view):
    from helper import S
    S[0] += 1
    bad = S[0] > 200000""",
    "closure imported in the function": """HELPER|def decide(view):
    from helper import step
    bad = step() > 200000""",
    "list with one of Python's names in a helper": """HELPER|import helper
def decide(view):
    bad = helper.count() > 200000""",
    "annotations of a helper": """HELPER|import helper
def decide(view):
    from helper import __annotations__ as names
    names["n"] = names.get("n", 0) + 1
    bad = names["n"] > 200000""",
    "list in an alias": """ALIAS|import typing
G = list[[0]]
def decide(view):
    kept = typing.get_args(G)[0]
    kept[0] += 1
    bad = kept[0] > 200000""",
    "list in a union of aliases": """ALIAS|import typing
G = list[[0]] | None
def decide(view):
    kept = typing.get_args(typing.get_args(G)[0])[0]
    kept[0] += 1
    bad = kept[0] > 200000""",
    "list in Annotated": """ALIAS|import typing
G = typing.Annotated[int, [0]]
def decide(view):
    kept = typing.get_args(G)[1]
    kept[0] += 1
    bad = kept[0] > 200000""",
    "iterator in Annotated": """ALIAS|import itertools, typing
G = typing.Annotated[int, itertools.count()]
def decide(view):
    bad = next(typing.get_args(G)[1]) > 200000""",
    "list in an itemgetter": """GETTER|import operator
class Echo:
    def __getitem__(self, key):
        return key
G = operator.itemgetter([0])
def decide(view):
    kept = G(Echo())
    kept[0] += 1
    bad = kept[0] > 200000""",
    "annotations of a class": """ANNOTATIONS|import typing
S = [0]
class C:
    x: S
del S
def decide(view):
    kept = typing.get_type_hints(C)["x"]
    kept[0] += 1
    bad = kept[0] > 200000""",
    "annotations of a function": """ANNOTATIONS|import typing
S = [0]
def f(x: S): pass
del S
def decide(view):
    kept = typing.get_type_hints(f)["x"]
    kept[0] += 1
    bad = kept[0] > 200000""",
    "metadata of a field": """FIELD|import dataclasses
@dataclasses.dataclass
class C:
    x: int = dataclasses.field(default=0, metadata={"s": [0]})
def decide(view):
    kept = dataclasses.fields(C)[0].metadata["s"]
    kept[0] += 1
    bad = kept[0] > 200000""",
    "tuple as the text of a class": """DOC|class C:
    __doc__ = ([0],)
def decide(view):
    C.__doc__[0][0] += 1
    bad = C.__doc__[0][0] > 200000""",
    "deque as the text of a class": """DOC|import collections
class C:
    __doc__ = collections.deque([0])
def decide(view):
    C.__doc__[0] += 1
    bad = C.__doc__[0] > 200000""",
    "text of a function": """DOC|import functools
class C:
    def __init__(self, n): self.__doc__ = n
ZERO = C(0)
def f(): pass
functools.update_wrapper(f, ZERO, ("__doc__",), ())
def decide(view):
    n = f.__doc__ + 1
    functools.update_wrapper(f, C(n), ("__doc__",), ())
    functools.update_wrapper(f, ZERO, (), ())
    bad = n > 200000""",
    "name of a function": """NAME|import functools
class C:
    def __init__(self, n): self.__name__ = n
ZERO = C("")
def f(): pass
functools.update_wrapper(f, ZERO, ("__name__",), ())
def decide(view):
    n = int("0" + f.__name__) + 1
    functools.update_wrapper(f, C(str(n)), ("__name__",), ())
    functools.update_wrapper(f, ZERO, (), ())
    bad = n > 200000""",
    "deleter of a property": """DELETER|def make():
    def f(self, kept=[0]):
        kept[0] += 1
        self.n = kept[0]
    return f
class B:
    x = property(None, None, make())
def decide(view):
    b = B()
    del b.x
    bad = b.n > 200000""",
    "signs of NaN": """NAN|import math
S = [float("nan")] * 19
def decide(view):
    k = 0
    while k < 19 and math.copysign(1, S[k]) < 0:
        S[k] = -S[k]
        k += 1
    if k < 19:
        S[k] = -S[k]
    bad = sum(2**k for k in range(19) if math.copysign(1, S[k]) < 0) > 200000""",
    **{
        f"key of a cache{how}": f"""CACHE|import functools
from sortie.policies.catalogue.coverage_cells import new_share
class C:
    n = 0
    def __hash__(self): return 7
    def __eq__(self, other):
        self.n = other.n = max(self.n, other.n) + 1
        return True
def decide(view):
    c = C()
    {call}
    bad = c.n > 200000"""
        for how, call in {
            "": "new_share(frozenset([c]), frozenset())",
            " by map": "list(map(new_share, [frozenset([c])], [frozenset()]))",
            " by partial": "functools.partial(new_share, frozenset([c]), frozenset())()",
        }.items()
    },
    "overloads": """OVERLOAD|import typing
def decide(view):
    def k(): return 0
    before = typing.get_overloads(k)
    n = before[0]() + 1 if before else 0
    @typing.overload
    def k(): return n
    bad = n > 200000""",
}

OUTSIDE = {
    "time": "bad = time.time() % 1000 < 1e-6",
    "monotonic": "bad = time.monotonic_ns() % 1000003 == 0",
    "time aliased": "from time import perf_counter as now\nbad = now() % 1000 < 1e-6",
    "datetime": "import datetime\nbad = datetime.datetime.now().microsecond == 7",
    "numpy's clock": "bad = int(np.datetime64('now').astype(int)) % 1000003 == 0",
    "numpy's clock by name": "from numpy import datetime64\nbad = int(datetime64('now').astype(int)) % 1000003 == 0",
    "random": "bad = random.random() < 1e-7",
    "random by name": "from random import random as draw\nbad = draw() < 1e-7",
    "system random": "bad = random.SystemRandom().random() < 1e-7",
    "statistics' dice": "bad = statistics.random.random() < 1e-7",
    "normal distribution": "bad = statistics.NormalDist().samples(1)[0] > 6",
    "numpy's dice": "bad = np.random.rand() < 1e-7",
    "empty array": "bad = float(np.empty(1)[0]) == 7",
    "uuid": "import uuid\nbad = uuid.uuid4().int % 1000003 == 0",
    "secrets": "import secrets\nbad = secrets.randbelow(1000003) == 0",
    "urandom": "bad = os.urandom(2) == b'xx'",
    "hash of text": "bad = hash('bad') % 1000003 == 0",
    "hash by map": "bad = next(map(hash, ['bad'])) % 1000003 == 0",
    "hash by key": "bad = min(['a', 'b', 'c'], key=hash) == 'c' and soc == 0.4",
    "id": "bad = id(view) % 1000003 == 0",
    "id by map": "bad = sum(map(id, [view])) % 1000003 == 0",
    "address in a text": "bad = 'f7' in str(object())",
    "address in an f-string": "bad = 'f7' in f'{object()}'",
    "identity": "bad = soc is me.battery_soc and soc == 0.4",
    "identity of ids": "bad = view.ego is 0 and soc == 0.4",
    "identity of views": "bad = view.attached is not view and soc == 0.4",
    "identity by operator": "bad = operator.is_(soc, me.battery_soc)",
    "order of a set": "bad = next(iter({'a', 'b', 'c'})) == 'c' and soc == 0.4",
    "order of a set in a loop": "for x in {'a', 'b', 'c'}:\n    bad = x == 'c' and soc == 0.4",
    "order of a set by a key": "bad = max({'a', 'b', 'c'}, key=lambda _: 0) == 'c' and soc == 0.4",
    "order of a set with NaN": "bad = sorted({float('nan'), 1.0, 2.0})[0] == 2.0 and soc == 0.4",
    "order of a set sorted by a key": "bad = sorted({'a', 'b', 'c'}, key=lambda _: 0)[0] == 'c' and soc == 0.4",
    "pop of a set": "bad = {'a', 'b', 'c'}.pop() == 'c' and soc == 0.4",
    "list of a set": "bad = list({'a', 'b', 'c'})[0] == 'c' and soc == 0.4",
    "unpacked set": "a, *_ = {'a', 'b', 'c'}\nbad = a == 'c' and soc == 0.4",
    "starred set": "bad = [*{'a', 'b', 'c'}][0] == 'c' and soc == 0.4",
    "order of drones": "bad = list(view.descriptors)[0] == view.peers[-1] and soc == 0.4",
    "order of ages": "bad = next(iter(view.age_s)) != min(view.age_s) and soc == 0.4",
    "order of the attached": "near = view.attached.descriptors\nbad = len(near) < len(view.descriptors) and next(iter(near)) != min(near) and soc == 0.4",
    "order of attached ages": "ages = view.attached.age_s\nbad = len(ages) < len(view.age_s) and [*ages.items()] != sorted(ages.items()) and soc == 0.4",
    "order of items": "for p, d in view.descriptors.items():\n    bad = p == max(view.descriptors) and soc == 0.4\n    break",
    "imported at run time": "import importlib\nbad = importlib.import_module('time').time() % 1000 < 1e-6",
    "by __import__": "bad = __import__('time').time() % 1000 < 1e-6",
    "by eval": "bad = eval('__import__(\"time\").time()') % 1000 < 1e-6",
    "by globals": "bad = globals()['time'].time() % 1000 < 1e-6",
    "by a module's module": "bad = dataclasses.sys.getrecursionlimit() == 7",
    "by a dictionary": "bad = {'now': time.time}['now']() % 1000 < 1e-6",
    "by a default": "def now(clock=time.time):\n    return clock()\nbad = now() % 1000 < 1e-6",
    "frame": "bad = sys._getframe().f_lineno == 7",
    "exit": "os._exit(0)",
    "system exit": "sys.exit(0)",
}
"""Clocks, dice, files, identity, hashes and orders."""

_RETURN = """
from sortie import Directive, Representation
def usual(view, rate_hz=2.0):
    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=rate_hz, reason="r") for p in view.peers]
"""
RETURNS = {
    "lying subclass": "class D(Directive):\n    @property\n    def rate_hz(self): return 2.0\ndef decide(view):\n    return [D(view.ego, p, Representation.DETECTIONS, rate_hz=20.0, reason='r') for p in view.peers]",
    "lying item": "class D(Directive):\n    def __getitem__(self, k): return 0\ndef decide(view):\n    return [D(*d) for d in usual(view)]",
    "quiet subclass": "class D(Directive):\n    pass\ndef decide(view):\n    return [D(*d) for d in usual(view)]",
    "list that changes": "class L(list):\n    n = 0\n    def __iter__(self):\n        self.n += 1\n        return iter([d._replace(rate_hz=20.0) for d in list.__iter__(self)]) if self.n % 2 == 0 else list.__iter__(self)\ndef decide(view):\n    return L(usual(view))",
    "quiet list": "class L(list):\n    pass\ndef decide(view):\n    return L(usual(view))",
    "generator": "def decide(view):\n    yield from usual(view)",
    "map": "def decide(view):\n    return map(lambda d: d, usual(view))",
    "dictionary": "def decide(view):\n    return {d.destination: d for d in usual(view)}",
    "values of a dictionary": "def decide(view):\n    return {d.destination: d for d in usual(view)}.values()",
    "deque": "import collections\ndef decide(view):\n    return collections.deque(usual(view))",
    "none": "def decide(view):\n    return None",
    "array of one number": "import numpy as np\ndef decide(view):\n    return [d._replace(fusion_weight=np.True_ & [True]) for d in usual(view)]",
    "truth as an id": "def decide(view):\n    return [d._replace(destination=d.destination == 1 or d.destination) for d in usual(view)]",
    "none in a sliver": "def decide(view):\n    return None if view.me and view.me.battery_soc == 0.4 else usual(view)",
    "lying rate": "class R(float):\n    def __le__(self, other): return True\n    def __gt__(self, other): return False\ndef decide(view):\n    return usual(view, R(20.0))",
    "tuple in place of one": "def decide(view):\n    return [tuple(d) for d in usual(view)]",
    "too fast in a tuple": "def decide(view):\n    return tuple(usual(view, 20.0 if view.me and view.me.battery_soc == 0.4 else 2.0))",
    "rate of the charge": "def decide(view):\n    return usual(view, 0.0 if view.me is None else view.me.battery_soc * 10.000001)",
    "rate of the goodput": "def decide(view):\n    return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=min(10.5, view.me.goodput_to(p) / 100), reason='r') for p in view.peers]",
    "changes an age": "def decide(view):\n    if view.me and view.me.battery_soc == 0.4:\n        try:\n            view.age_s[view.ego] = 99.0\n        except TypeError:\n            return usual(view, 20.0)\n    return usual(view)",
    "removes a drone": "def decide(view):\n    try:\n        view.descriptors.pop(view.ego)\n    except AttributeError:\n        return usual(view, 20.0 if view.me and view.me.battery_soc == 0.4 else 2.0)\n    return usual(view)",
    "alias": "from sortie.policies.catalogue.adaptive import boxes\ndef usual(view): return []\ndecide = __import__('sortie').policies if False else (lambda view: [d._replace(rate_hz=20.0) for d in boxes(view)])",
    "wrapper": "import functools\ndef noisy(f):\n    @functools.wraps(f)\n    def g(view):\n        return [d._replace(rate_hz=20.0) if view.me.battery_soc == 0.4 else d for d in f(view)]\n    return g\n@noisy\ndef decide(view):\n    return usual(view)",
    "callable object": "class P:\n    def __call__(self, view):\n        return usual(view, 20.0 if view.me and view.me.battery_soc == 0.4 else 2.0)\ndecide = P()",
    "method": "class P:\n    limit = 0.4\n    def decide(self, view):\n        return usual(view, 20.0 if view.me and view.me.battery_soc == self.limit else 2.0)\ndecide = P().decide",
    "partial": "import functools\ndef at(view, limit):\n    return usual(view, 20.0 if view.me and view.me.battery_soc == limit else 2.0)\ndecide = functools.partial(at, limit=0.4)",
    "raises": "def decide(view):\n    if view.me and view.me.battery_soc == 0.4:\n        raise ValueError('x')\n    return usual(view)",
    "swallows": "def decide(view):\n    try:\n        bad = view.me.stamp_ns % 1000003 == 7\n    except BaseException:\n        bad = False\n    return usual(view, 20.0 if bad else 2.0)",
    "size": "def decide(view):\n    return usual(view, 20.0 if len(view.peers) == 1 else 2.0)",
}  # fmt: skip
"""What is returned, and how the policy is made."""

CORRECT = {
    "constant": "pass",
    "charge": "bad = False if soc < 0.5 else False",
    "threshold": "rate = 5.0 if soc >= 0.6 else 2.0 if soc >= 0.3 else 1.0\nbad = rate > 5",
    "whole threshold": "rate = 8 if first > 5 else 3\nbad = rate > 8",
    "clamped": "bad = min(10.0, max(0.0, first / 10)) > 10",
    "clamped by whole": "bad = min(10, first) > 10",
    "scaled": "bad = soc * 10 > 10",
    "shifted": "bad = soc + 9 > 10",
    "difference": "bad = 1 - soc < 0",
    "floor": "bad = first // 10 < 0",
    "int": "bad = int(first) > first if first in (1.0, 2.0) else False",
    "loop": "for p in view.peers:\n    bad = bad or me.goodput_to(p) < 0",
    "any": "bad = any(me.goodput_to(p) < 0 for p in view.peers)",
    "phases": "bad = me.task_phase == TaskPhase.TRACK and me.task_phase != 2",
    "flags": "bad = me.novelty_flags > 255",
    "flags masked": "bad = me.novelty_flags & 4 not in (0, 4)",
    "targets": "bad = len(me.priority_target_ids) < 0",
    "region": "bad = me.region is not None and me.region.radius_m <= 0",
    "age": "bad = view.age_s[view.peers[0]] < 0",
    "match of phases": "match me.task_phase:\n    case TaskPhase.TRACK | TaskPhase.SEARCH:\n        rate = 5\n    case _:\n        rate = 1\nbad = rate > 5",
    "numbers in the reason": "why = f'charge {soc:.0%}, goodput {first:.1f}'\nbad = soc > 1",
    "dictionary by id": "rates = {p: 2.0 if me.goodput_to(p) < 5 else 8.0 for p in view.peers}\nbad = any(r > 8 for r in rates.values())",
    "set of ids": "strong = {p for p in view.peers if me.goodput_to(p) >= 5}\nbad = len(strong) > len(view.peers)",
    "sorted ids": "bad = sorted(view.descriptors)[0] > view.ego",
    "overlap": "bad = len(peers_by_overlap(view)[:2]) > 2",
    "link state": "bad = me.link_state(view.peers[0]) is LinkState.MEASURED and first == 0",
    "helper": "def rate(x, limit=0.3):\n    return 2 if x < limit else 8\nbad = rate(soc) > 8",
    "recursion": "def steps(n):\n    return 0 if n == 0 else 1 + steps(n - 1)\nbad = steps(3) != 3 or soc < 0",
    "zlib of an id": "bad = zlib.crc32(str(view.ego).encode()) < 0 or soc < 0",
    "hash of an id": "bad = int(hashlib.sha256(str(view.ego).encode()).hexdigest(), 16) < 0 or soc > 1",
    "enumerate": "for k, p in enumerate(view.peers):\n    bad = bad or k > 7 or me.goodput_to(p) < 0",
    "zip": "bad = any(a == b for a, b in zip(view.peers, view.peers[1:]))",
    "combinations": "bad = any(a == b for a, b in itertools.combinations(view.peers, 2)) or soc < 0",
    "dataclass": "Rate = namedtuple('Rate', 'hz why')\nr = Rate(2 if soc < 0.5 else 4, 'x')\nbad = r.hz > 4",
    "exception": "try:\n    x = [1, 2][5]\nexcept IndexError:\n    bad = soc < 0",
    "smallest of none": "try:\n    bad = min([p for p in view.peers if me.goodput_to(p) > 5]) > 200\nexcept ValueError:\n    pass",
    "own enum": "class Level(enum.IntEnum):\n    LOW = 0\n    HIGH = 1\nbad = soc > Level.HIGH or int(first) < Level.LOW",
    "while": "n, x = 0, soc\nwhile n < 5:\n    n += 1\nbad = n != 5 or x > 1",
    "statistics of ids": "bad = statistics.mean([1, 2, 3]) != 2 or soc < 0",
    "math of constants": "bad = math.sqrt(4) != 2 or soc < 0",
    "attached": "bad = any(p not in view.peers for p in view.attached.peers)",
    "spaces": "bad = view.shares_features_with(view.peers[0]) and soc > 1",
    "sum of ones": "bad = sum(1 for p in view.peers if me.goodput_to(p) > 5) > len(view.peers)",
    "items in any order": "rates = {p: 2 if d.battery_soc < 0.5 else 3 for p, d in view.descriptors.items()}\nbad = max(rates.values()) > 3",
    "functools": "bad = functools.reduce(operator.add, [1, 2], 0) != 3 or soc < 0",
    "isinstance": "bad = not isinstance(soc, float) or not isinstance(first, int | float)",
    "by index": "bad = me[6] > 1",
    "minus of a whole number": "bad = not isinstance(-int(soc * -100), int)",
    "__init__ of a base": "class A:\n    def __init__(self, x):\n        self.x = x\nclass B(A):\n    def __init__(self):\n        super().__init__(3)\nbad = B().x != 3 or soc > 1",
    "absolute whole number": "bad = not isinstance(abs(int(soc * 100) - 100), int)",
}
"""Policies that keep the line and are provable."""

UNPLAIN = {
    "no region": "try:\n    bad = me.region.radius_m < 0\nexcept AttributeError:\n    bad = me.region is not None",
    "compares with nothing": "try:\n    bad = {}.get('limit') < soc\nexcept TypeError:\n    bad = soc < 0",
    "item of nothing": "try:\n    bad = {}.get('limits')['low'] < soc\nexcept TypeError:\n    bad = soc < 0",
    "no such field": "try:\n    bad = me.charge > 1\nexcept AttributeError:\n    bad = soc > 1",
    "own attribute": "class C: pass\ntry:\n    bad = C().limit < soc\nexcept AttributeError:\n    bad = soc < 0",
    "own error": "def limit(x):\n    if x < 0.5:\n        raise TypeError('low')\n    return 2.0\ntry:\n    bad = limit(soc) > 2\nexcept TypeError:\n    bad = soc >= 0.5",
    "own error again": "class Low(AttributeError): pass\ntry:\n    try:\n        if soc < 0.5: raise Low\n    except Low as error:\n        raise ValueError(1) from error\nexcept (ValueError, KeyError):\n    bad = soc >= 0.5",
    "own context": "class Quiet:\n    def __enter__(self):\n        return self\n    def __exit__(self, *_):\n        return True\nwith Quiet():\n    bad = {}['a'] < soc",
    "own abstract class": "import abc\nclass A(abc.ABC):\n    @abc.abstractmethod\n    def rate(self): ...\nclass B(A):\n    def rate(self):\n        'Always low.'\n        return 2\nmatch B():\n    case A() as found:\n        bad = found.rate() > 2 or soc > 1",
    "number in a pattern": "match soc:\n    case float() | int():\n        bad = soc > 1\n    case _:\n        bad = True",
    "percent sign": "why = '%d %%' % (100 * soc)\nbad = soc > 1",
    "format": "why = '{:.0%}'.format(soc)\nbad = soc > 1",
    "finally": "try:\n    bad = soc > 1\nfinally:\n    pass",
    "own operator": "class Rate:\n    def __init__(self, hz): self.hz = hz\n    def __lt__(self, other): return self.hz < other.hz\nbad = Rate(2) < Rate(1) or soc > 1",
    "pattern of a class": "class C:\n    def __init__(self, n): self.n = n\nmatch C(soc):\n    case C(n=n):\n        bad = n > 1",
    "flags": "class Mode(enum.Flag):\n    FAST = 1\nbad = Mode.FAST not in Mode.FAST or soc > 1",
    "numpy": "bad = np.hypot(3, 4) != 5 or soc > 1",
    "lru_cache": "@functools.lru_cache\ndef rate(n): return 2\nbad = rate(1) > 2 or soc > 1",
}
"""Policies that keep the line in Python that no proof follows (`verification/plain.py`): drawn views test them."""

CORRECT_FILES = {
    "wrapper": "import functools\ndef calm(f):\n    @functools.wraps(f)\n    def g(view):\n        return [d._replace(rate_hz=2.0) for d in f(view)]\n    return g\n@calm\ndef decide(view):\n    return usual(view, 20.0)",
    "callable object": "class P:\n    limit = 0.4\n    def __call__(self, view):\n        return usual(view, 10.0 if view.me and view.me.battery_soc == self.limit else 2.0)\ndecide = P()",
    "partial": "import functools\ndef at(view, limit):\n    return usual(view, 10.0 if view.me and view.me.battery_soc == limit else 2.0)\ndecide = functools.partial(at, limit=0.4)",
    "rate of the charge": "def decide(view):\n    return usual(view, 0.0 if view.me is None else view.me.battery_soc * 10)",
    "dataclass": "import dataclasses\n@dataclasses.dataclass(frozen=True)\nclass Rates:\n    low: float = 2.0\n    high: float = 8.0\nRATES = Rates()\ndef decide(view):\n    return usual(view, RATES.low if view.me and view.me.battery_soc < 0.5 else RATES.high)",
    "protocol for types": "import typing\nfrom sortie import FleetView\nIds = list[int]\nclass Rates(typing.Protocol):\n    def rate(self, soc: float) -> float: ...\nclass R:\n    def rate(self, soc: float) -> float:\n        return 2.0\ndef choose(rates: Rates, ids: Ids | None = None) -> float:\n    return rates.rate(0.5)\ndef decide(view: FleetView) -> list[Directive]:\n    best: typing.Optional[float] = choose(R())\n    return usual(view, best)",
    "class variable": "import dataclasses\nfrom typing import TYPE_CHECKING, ClassVar, Optional\nif TYPE_CHECKING:\n    from sortie import FleetView\n__all__ = ['decide']\n@dataclasses.dataclass(slots=True)\nclass Rates:\n    kind: ClassVar[str] = 'x'\n    low: Optional[float] = 2.0\ndef decide(view):\n    return usual(view, Rates().low)\nif __name__ == '__main__':\n    decide(None)",
    "most common": "from collections import Counter\ndef decide(view):\n    best = Counter(1 if view.me and view.me.goodput_to(p) > 5 else 2 for p in view.peers).most_common(1)\n    return usual(view, float(best[0][0]) if best else 1.0)",
    "numbers of its own": "import statistics\nRATES = (2.0, 4.0)\nMEAN = statistics.mean(RATES)\ndef decide(view):\n    return usual(view, MEAN)",
    "wrapped catalogue": "from sortie.policies.catalogue.worked import worked\ndef decide(view):\n    return [d._replace(rate_hz=min(d.rate_hz, 9.0), reason=f'capped: {d.reason}') for d in worked(view)]",
    "viewpoint": "from sortie import Reposition, looks_from\ndef near(view):\n    return None if view.me is None or view.me.region is None else Reposition(view.me.region.x_m, view.me.region.y_m)\n@looks_from(near)\ndef decide(view):\n    return usual(view)",
    "other networks": "from sortie import FleetView, boxes_across_networks, looks_from\n@looks_from(lambda view: None)\n@boxes_across_networks\ndef decide(view: FleetView, *, rho: float = 0.5):\n    return [d._replace(rho=rho, representation=Representation.FEATURES) for d in usual(view)]",
    "table": "TABLE = [(0.6, 10.0), (0.3, 5.0), (0.0, 2.0)]\ndef decide(view):\n    if view.me is None: return []\n    return usual(view, next(rate for limit, rate in TABLE if view.me.battery_soc >= limit))",
}  # fmt: skip


def stateful(body: str) -> str:
    """The whole file of an entry of `STATE_FILES`."""
    kind, _, text = body.partition("|")
    lines = text.splitlines()
    indent = " " * (len(lines[-1]) - len(lines[-1].lstrip()))
    end = f"{indent}return usual(view, 20.0 if bad else 2.0)\n"
    after = {"OBJECT": "decide = Policy()\n", "CLOSURE": "    return decide\ndecide = make()\n"}.get(kind, "")
    return f"{_RETURN}{text}\n{end}{after}"


def returning(body: str) -> str:
    """The whole file of an entry of `RETURNS` or `CORRECT_FILES`."""
    return _RETURN + body + "\n"


FAULTY: dict[str, str] = {
    **{f"whole: {n}": source(b) for n, b in WHOLE.items()},
    **{f"sliver: {n}": source(b) for n, b in SLIVERS.items()},
    **{f"stand-in: {n}": source(b) for n, b in STAND_INS.items()},
    **{f"stand-in recognised: {n}": source(b) for n, b in RECOGNISED.items()},
    **{f"state: {n}": source(b) for n, b in STATE.items()},
    **{f"state: file with {n}": stateful(b) for n, b in STATE_FILES.items()},
    **{f"outside: {n}": source(b) for n, b in OUTSIDE.items()},
    **{f"returns: {n}": returning(b) for n, b in RETURNS.items()},
}
RIGHT: dict[str, str] = {
    **{f"correct: {n}": source(b) for n, b in CORRECT.items()},
    **{f"correct: file with {n}": returning(b) for n, b in CORRECT_FILES.items()},
}
