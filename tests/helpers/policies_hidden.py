"""Policies with a fault that only real objects, another process or a later decision show, and correct ones beside them.

A body is as in `policies_corpus`. K is a charge at which the fault shows.
"""

from __future__ import annotations

K = "0.4123457"
LATER = 1_000_003

TEXTS = (
    "bad = f'{soc:.7f}' in 'K'", "bad = operator.contains('K', f'{soc:.7f}')", "bad = ascii(soc) == 'K'", "bad = f'{soc!a}' == 'K'",
    "bad = ascii([soc]) == '[K]'", "bad = '%a' % {0: soc} == '{0: K}'", "bad = operator.mod('%a', {0: soc}) == '{0: K}'",
    "bad = repr([f'{soc:.7f}']) == \"['K']\"",
    "bad = '%.12s' % {0: soc} == '{0: 0.412345'", "bad = f'{[soc]!s:.10}' == '[K'", "bad = '{!s:.10}'.format([soc]) == '[K'",
    "bad = bytes(f'{soc:.7f}', 'utf8') == b'K'", "bad = bytearray(str(soc), 'utf8') == b'K'", "bad = not 'K'.replace(str(soc), '')",
    "bad = not 'K'.removeprefix(str(soc))", "bad = str.startswith(str(soc), 'K')", "bad = any(map(str.endswith, [str(soc)], ['4123457']))",
    "try:\n    bad = complex(str(soc)) == K\nexcept ValueError:\n    pass", "try:\n    bad = int(f'{soc * 1e7:.0f}', 16) == 0x4123457\nexcept ValueError:\n    pass",
    "class T(str):\n    pass\nbad = T(soc) == 'K'", "e = ValueError(str(soc))\nbad = repr(e) == \"ValueError('K')\"", "bad = soc <= 0 and f'{soc}' == '-0.0'",
    "try:\n    '{:d}'.format(soc)\nexcept ValueError:\n    bad = 0.4 < soc < 0.4000001", "try:\n    '%c' % soc\nexcept TypeError:\n    bad = 0.4 < soc < 0.4000001",
    "try:\n    bad = not f\"{'x':.{int(soc * 1e7) - 4123457}}\"\nexcept ValueError:\n    pass",
    "try:\n    bad = not format('x', f'.{int(soc * 1e7) - 4123457}')\nexcept ValueError:\n    pass",
    "try:\n    bad = not '{:.{}}'.format('x', int(soc * 1e7) - 4123457)\nexcept ValueError:\n    pass",
    "bad = not '%.*s' % (int(soc * 1e7) - 4123457, 'x') and 0.41 < soc < 0.4124", "try:\n    bad = bool('{0[20]}'.format(str(soc)))\nexcept IndexError:\n    pass",
    "bad = me.novelty_flags == 129.0 and soc == K", "out = []\nclass C:\n    x: out.append(soc.hex() == (K).hex()) = 1\nbad = out[0]",
)  # fmt: skip
"""The text of a number, read by compiled code; and two other things that a stand-in answered otherwise."""

ORDERS = (
    *(f"class C:\n    {name} = {of}\nc = C()\nbad = {use} == '7' and soc == K" for name, of, use in [
        ("__getitem__", "hash", "c['a']"), ("__call__", "id", "c('a')"), ("__class_getitem__", "hash", "C['a']"), ("__getitem__", "str", "c[object()][-4]"),
        ("__getitem__", "staticmethod(str)", "c[object()][-4]"), ("__getitem__", "property(lambda self: str)", "c[object()][-4]"), ("x", "property(str)", "c.x[-4]"),
        ("__contains__", "eval", "('id(1)' in c)"), ("__neg__", "globals", "(-c)"),
    ]),
    "bad = next(map(operator.call, [hash], ['a'])) == 7 and soc == K", "bad = any(map(lambda t: t[-4] == '7', map(str, [object()]))) and soc == K",
    "for t in map(repr, [object()]):\n    bad = t[-4] == '7' and soc == K", "bad = dict(enumerate(map(repr, [object()])))[0][-4] == '7' and soc == K",
    "match 'a':\n    case str(__hash__=h):\n        bad = h() == 7 and soc == K", "try:\n    [].index(object())\nexcept ValueError as e:\n    bad = e.args[0][20] == '7' and soc == K",
    "k = {}.keys()\nk |= {'a', 'b'}\nbad = list(k)[0] == 'b' and soc == K", "d = {0: {}.keys()}\nd[0] |= {'a', 'b'}\nbad = [*d[0]][0] == 'b' and soc == K",
    "s = {0, 16, 1, 2, 3}\ns.discard(1)\nbad = list(s) == [0, 2, 3, 16] and soc == K",
    "def f(n):\n    try:\n        return f(n + 1)\n    except RecursionError:\n        return n\nbad = f(0) == 7 and soc == K",
    "def f():\n    try:\n        return f()\n    finally:\n        return 1\nbad = f() == 7 and soc == K",
    "bad = f\"{ {'a', 'b', 'c'} }\"[2] == 'c' and soc == K", "bad = str([{'a', 'b', 'c'}])[3] == 'c' and soc == K",
    "l = []\nl += {'a', 'b', 'c'}\nbad = l[0] == 'c' and soc == K", "for a, b, c in [{'a', 'b', 'c'}]:\n    bad = a == 'c' and soc == K",
    "bad = list(map(list, [{'a', 'b', 'c'}]))[0][0] == 'c' and soc == K", "def g():\n    yield from {'a', 'b', 'c'}\nbad = next(g()) == 'c' and soc == K",
    "l = [0]\nl[:] = {'a', 'b', 'c'}\nbad = l[0] == 'c' and soc == K", "class T(set):\n    pass\nfor x in T(['a', 'b', 'c']):\n    bad = x == 'c' and soc == K",
    "class E(enum.Enum):\n    A = 1\n    B = 2\nfor e in {E.A, E.B}:\n    bad = e is E.B and soc == K", "bad = max({frozenset('ab'), frozenset('cd')}) == frozenset('ab') and soc == K",
    "bad = list(map(set.pop, [{'a', 'b', 'c'}]))[0] == 'c' and soc == K", "bad = [*map(list, map(set, ['abc']))][0][0] == 'c' and soc == K",
    "bad = list(map(list, [{'a': 1, 'b': 2}.keys() & {'a', 'b'}]))[0][0] == 'b' and soc == K",
    "@repr\ndef f():\n    pass\nbad = f[-3] == '4' and soc == K", "bad = ('%s' % (object(),))[-2] == '0' and soc == K", "bad = 'bad' in __file__",
    "out = []\ndef f(x: out.append(hash('bad') % 1000003 == 1)):\n    pass\nbad = out[0]",
)  # fmt: skip
"""Hashes, addresses and places of files, which differ from process to process."""

UNSEEN = (
    "try:\n    bad = soc < 10**400 and soc == K\nexcept Exception:\n    pass", "super = type\nbad = super(soc) is float and soc == K",
    "def kind(x, super=type):\n    return super(x)\nbad = kind(soc) is float and soc == K",
    "class I(int):\n    def __hash__(self): return 7\nids = [int(x) for x in {I(k) for k in (3, 1, 2, 5, 4)}]\nbad = ids == [3, 1, 2, 5, 4] and soc == K",
    "class G:\n    def __eq__(self, other):\n        self.got = other\n        return True\ng = G()\nmatch g:\n    case soc.__doc__:\n        bad = 'onvert' in g.got and soc == K",
    "class N:\n    m = soc\n    class G:\n        def __eq__(self, other):\n            return True\n    match G():\n        case m.hex:\n            ok = True\nbad = N.ok and soc == K",
    "try:\n    def f(x: soc._axis): pass\nexcept AttributeError:\n    bad = soc == K",
    "try:\n    def f(x: soc[0]): pass\nexcept TypeError:\n    bad = soc == K", "try:\n    def f(x: soc.hex): pass\n    bad = soc == K\nexcept AttributeError:\n    pass",
    "import typing\ndef f(x: 'type(s) is float'): pass\nbad = typing.get_type_hints(f, None, {'s': soc})['x'] and soc == K",
    "match dataclasses:\n    case object(sys=s):\n        bad = 'verify' not in s.argv and soc == K",
    "C = object\nmatch dataclasses:\n    case C(sys=s):\n        bad = 'verify' not in s.argv and soc == K",
    "near = view.attached.age_s\nids = [*dict.keys(near)]\nbad = ids != sorted(ids) and soc == K", "bad = set.pop({'a', 'b', 'c', 'd'}) == 'a' and soc == K",
    "s = {1, 2, 3}\ntry:\n    for x in s:\n        s.discard(3)\nexcept RuntimeError:\n    bad = soc == K",
    "s, seen = {1, 2, 3}, []\nfor x in s:\n    seen.append(x)\n    if x == 1:\n        s.discard(2)\n        s.add(4)\nbad = seen == [1, 3, 4] and soc == K",
    "class N:\n    def __init__(self, x): self.x = x\n    def __repr__(self): return '%.7f' % self.x\nbad = str([N(soc)]) == '[K]'",
    "class N:\n    def __init__(self, x): self.x = x\n    def __str__(self): return f'{self.x:.7f}'\nbad = str(N(soc)) == 'K'",
    "a = dict.fromkeys('abcd').keys()\nbad = list(list(map(operator.and_, [a], [a]))[0])[0] == 'a' and soc == K",
    "a = dict.fromkeys('abcd').keys()\ndef f():\n    yield from map(operator.and_, [a], [a])\nbad = [list(s)[0] for s in f()] == ['a'] and soc == K",
    "class A(list):\n    def __add__(self, hop):\n        self.append(hop)\n        return self\nhops = sum(view.age_s, A())\nbad = hops[0] != min(hops) and soc == K",
    "class A:\n    n = 0\n    def __add__(self, x):\n        self.n += 1\n        return self\na, got = A(), []\nsum((got.append(a.n) or 1 for _ in range(2)), a)\nbad = got == [0, 1] and soc == K",
    "class C: pass\nbad = f'{C}'[19:20] == '7' and soc == K", "bad = 'system' in dir(view) and soc == K",
    # what a search of all 22 causes found in the first version of plain Python
    "bad = not f\"{f'{soc}':.0}\" and soc == K", "class T(str):\n    pass\nbad = T('K') == f'{soc:.7f}'",
    "class E(enum.StrEnum):\n    A = 'K'\nbad = E.A == f'{soc:.7f}'", "N = namedtuple('N', 'x')\nbad = 'K'.startswith(N(f'{soc:.7f}'))",
    "t = ''.join([f'{soc:.7f}'])\nbad = ''.join({0: t}.values()) == 'K'", "t = collections.deque([f'{soc:.7f}'])\nbad = zlib.crc32(''.join(t).encode()) == 7",
    "from sortie.policies.catalogue.worked import worked\nbad = any('goodput 3.1 ' in d.reason for d in worked(view))",
    "bad = str({5}) == '{5}' and soc == K", "bad = f'{frozenset([1])}' == 'frozenset({1})' and soc == K", "l = []\nl.append(set)\nbad = l[0] is set and soc == K",
    "bad = {set: True}.get(set, False) and soc == K", "bad = next(itertools.repeat(str)) is str and soc == K", "bad = functools.partial(lambda k: k is str, str)() and soc == K",
    "d = {}\nit = zip([1], [2])\nd[0] = it\nbad = d[0] is it and soc == K", "d = {}\nd[0] = zip([1], [2])\nbad = type(d[0]) is zip and soc == K",
    "s = {8, 9, 10, 11, 12}\nfor x in (1, 16, 0):\n    s.add(x)\nfor x in (16, 8, 9, 10, 11, 12):\n    s.discard(x)\nbad = list(s) == [0, 1] and soc == K",
    "bad = ''.join(map(str, itertools.chain(view.descriptors))) == '10'", "it = itertools.chain(view.descriptors)\nbad = 1 in it and list(it) == [0]",
    "seen = []\nsum(map(lambda p: seen.append(p) or 0, itertools.chain(view.descriptors)))\nbad = seen == [1, 0]",
    "from sortie.scenarios.plain_sum import plain_sum\nbad = plain_sum(itertools.chain([1e16], view.descriptors)) != 1e16 and soc == K",
    "v = view._replace(age_s={7: 0.0})\nbad = 7 in v.age_s and soc == K", "v = FleetView(view.ego, view.period_s, {}, {})\nbad = v.me is None and soc == K",
    "class D(tuple):\n    def values(self): return [self[1]]\nbad = D((1, 2)).values() == [2] and soc == K", "bad = '0x' in str(hashlib.md5()) and soc == K",
    "class C:\n    x = dataclasses.builtins.property(str)\nbad = C().x[-4] == '7' and soc == K", "C = namedtuple('C', 'x')\nbad = 'call_checks' not in str(C) and soc == K",
    "from sortie.policies.catalogue.baselines import _send_to\nbad = 'f7' in _send_to(view, [], 0.5, decide)[0].reason",
    "class I(int): pass\nclass J(int): pass\nbad = type(statistics.mean([I(1), J(3)])) is I and soc == K",
    "try:\n    bad = not str(10**5000)\nexcept ValueError:\n    bad = soc == K", "safe = False\nassert (safe := True)\nbad = not safe and soc == K",
    "class statistics:\n    StatisticsError = RecursionError\ndef f(n):\n    try:\n        return f(n + 1)\n    except statistics.StatisticsError:\n        return n\nbad = f(0) > 600 and soc == K",
)  # fmt: skip
"""What Python reads where no check stands: patterns, annotations, methods called by their class, sets that change."""

KEPT = (
    ("class G:\n    def __eq__(self, other):\n        self.got = other\n        return True\nG = G()", "match G:\n    case decide.__builtins__:\n        pass\nG.got['n'] = n = G.got.get('n', 0) + 1\nG.got = 0"),
    ("import statistics, typing", "def f(x: statistics.mean.__dict__): pass\nkept = typing.get_type_hints(f)['x']\nkept['n'] = n = kept.get('n', 0) + 1"),
    ("__dataclass_fields__ = []", "__dataclass_fields__.append(1)\nn = len(__dataclass_fields__)"),
    ("class C:\n    __doc__ = []", "C.__doc__.append(1)\nn = len(C.__doc__)"),
    ("P = functools.partial(dict, a=1)", "P.keywords['b'] = P.keywords.pop('a', 1)\nn = 1 if 'b' not in P.keywords else 0"),
    ("S = [Decimal('1')]", "n = len(str(S[0]))\nS[0] = Decimal('1.0')"),
    ("S = [range(0)]", "n = S[0].start\nS[0] = range(5, 5)"),
    ("S = [math.sqrt]\nimport cmath", "n = S[0](4).real\nS[0] = cmath.sqrt"),
    ("S = [dict.fromkeys]", "n = len(type(S[0]('a')).__name__)\nS[0] = collections.OrderedDict.fromkeys"),
    ("S = {8, 0}", "n = len(S)\nS.clear()\nS.add(0)\nS.add(8)"),
    ("S = [collections.deque([], 1)]", "n = S[0].maxlen\nS[0] = collections.deque([], 2)"),
    ("PUSH, COPY = (lambda l: (l.append, l.copy))([])", "PUSH(1)\nn = len(COPY())"),
    ("class C(collections.deque):\n    pass\nC = C()", "C.append(1)\nn = len(C)"),
    ("class C(itertools.count):\n    pass\nC = C()", "n = next(C)"),
    ("class C(Exception):\n    pass\nC = C(0)", "C.args = (C.args[0] + 1,)\nn = C.args[0]"),
    ("class C(StopIteration):\n    pass\nC = C(0)", "C.value = C.value + 1\nn = C.value"),
    ("class C(property):\n    pass\nC = C(len)\nC.n = 0", "C.n += 1\nn = C.n"),
    ("class C(functools.partial):\n    pass\nC = C(len)\nC.n = 0", "C.n += 1\nn = C.n"),
    ("import types\nclass C(types.ModuleType):\n    pass\nC = C('x')\nC.n = 0", "C.n += 1\nn = C.n"),
    ("class C(enum.Enum):\n    A = 1\nC.A.n = 0", "C.A.n += 1\nn = C.A.n"),
    ("class C(enum.Flag):\n    A = 1\n    B = 2\n(C.A | C.B).n = 0", "(C.A | C.B).n += 1\nn = (C.A | C.B).n"),
    ("class C(enum.IntFlag):\n    A = 1", "C._value2member_map_[len(C._value2member_map_)] = 0\nn = len(C._value2member_map_)"),
    ("C = collections.defaultdict(functools.partial(next, itertools.count()))", "n = C[0]\ndel C[0]"),
    ("", "import hashlib\nA = hashlib.algorithms_available\nA.add(len(A))\nn = len(A)\nA.discard(n - 1) if n > 9999 else None"),
    ("", "from sortie.policies.contract import PHASE_OF as P\nn = P.get('x', 0) + 1\nP['x'] = n"),
    ("import decimal", "F = decimal.BasicContext.flags\nF[decimal.Clamped] = n = int(F[decimal.Clamped]) + 1"),
    ("class C:\n    __module__ = 'typing'\n    kept = []", "C.kept.append(1)\nn = len(C.kept)"),
    ("C = type('C', (), {'__module__': 'typing', 'kept': []})", "C.kept.append(1)\nn = len(C.kept)"),
    ("__name__ = 'statistics'\ndef C(kept=[0]):\n    kept[0] += 1\n    return kept[0]", "n = C()"),
    ("def __own__(owner, name):\n    return owner", "math.n = n = 1 + (math.n if hasattr(math, 'n') else 0)"),
    ("import statistics\nfrom sortie.policies.contract import looks_from", "try:\n    n = statistics.mean.viewpoint + 1\nexcept AttributeError:\n    n = 1\nlooks_from(n)(statistics.mean)"),
    ("from sortie.policies.contract import looks_from", "C = collections.Counter\ntry:\n    n = C.viewpoint + 1\nexcept AttributeError:\n    n = 1\nlist(map(looks_from(n), [C]))"),
    ("class C:\n    def __rand__(self, other):\n        return []\nA = np.True_ & [C(), C()]", "A[0].append(1)\nn = len(A[0])"),
    ("class C:\n    __dict__ = {}\nS = C()\nS.n = 0", "S.n += 1\nn = S.n"),
    ("class C(np.float64):\n    pass\nS = C(1)\nS.n = 0", "S.n += 1\nn = S.n"),
    ("class M(type):\n    __flags__ = 0\nC = M('C', (), {'__module__': 'typing', 'kept': []})", "C.kept.append(1)\nn = len(C.kept)"),
    ("class E(list, enum.Enum):\n    A = ()", "E.A.append(1)\nn = len(E.A)"),
    ("class E(dict, enum.Enum):\n    A = ()", "E.A[0] = n = E.A.get(0, 0) + 1"),
    ("class B:\n    __slots__ = ('n',)\nclass E(B, enum.Enum):\n    A = 1\nE.A.n = 0", "E.A.n += 1\nn = E.A.n"),
    ("A = [0]\nB = [A]", "n = 1 if B[0] is A else 0\nB[0] = [0]"),
    ("class E(enum.Enum):\n    A = 1", "d = super(E, E)._member_map_\nd['n'] = n = d.get('n', 0) + 1"),
    ("import typing", "typing._cleanups.append(1)\nn = len(typing._cleanups)"),
    ("import types\nclass D(dict):\n    def items(self):\n        return []\nM = types.MappingProxyType(D(k=[0]))", "M['k'][0] += 1\nn = M['k'][0]"),
)  # fmt: skip
"""What is set up when the file is loaded, and how each decision counts."""

HARMLESS = (
    "class A:\n    def f(self): return 1\nclass B(A):\n    def f(self): return super().f()\nbad = soc > B().f()", "bad = soc > 10**400",
    "match me.task_phase:\n    case TaskPhase.TRACK:\n        bad = soc > 1\n    case _:\n        pass", "class C:\n    HIGH = 3\nmatch len(view.peers):\n    case C.HIGH:\n        bad = soc > 1",
    "def f(p: int, q: tuple[float, int]) -> dict[int, float]:\n    return {p: q[0]}\nbad = f(1, (soc, 2))[1] > 1",
    "seen = set()\nfor p in view.peers:\n    seen |= {p}\nd = {0: 5.0}\nd[0] -= 1\nbad = len(seen) > 9 or d[0] > 4", "for p, q in zip(view.peers, view.peers[1:]):\n    bad = q < p",
    "class L:\n    def __init__(self, least): self.least = least\n    def __call__(self, x): return x < self.least\nbad = L(0.5)(soc) and soc > 0.5",
    "C = collections.namedtuple('C', 'low high')\nbad = soc < C(0.3, 0.7).low and soc > 0.5", "try:\n    bad = {0: True}[len(view.peers)]\nexcept (KeyError, IndexError):\n    pass",
    "kinds = {'a', 'b'}\nbad = 'c' in kinds or soc > 1", "names = {TaskPhase.TRACK, TaskPhase.SEARCH}\nbad = me.task_phase in names and me.task_phase == 4",
    "bad = sorted({'b', 'a'} | {'c'}) != ['a', 'b', 'c'] or soc > 1", "strong = {p for p in view.peers if me.goodput_to(p) > 5}\nfor p in strong:\n    bad = bad or me.goodput_to(p) < 5",
    "d = collections.defaultdict(set)\nfor p in view.peers:\n    d[0].add(p)\nbad = d[0] != set(view.peers) or type(d[0]) is not set", "why = f'{soc:.1%} of {first:.0f}'\nbad = soc > 1",
    "from sortie.policies.catalogue.worked import worked\nbad = any(d.rate_hz > 10 for d in worked(view))", "names = ', '.join(str(p) for p in view.peers)\nbad = not names", "def f(x: float) -> list[float] | None:\n    return None\nbad = f(soc) is not None",
    "import sortie.policies.contract as contract\nbad = contract.PHASE_NAMES[me.task_phase] == 'x'", "bad = me.novelty_flags + 0.5 < 0 or me.novelty_flags == 0.5", "bad = soc not in (soc,)",
)  # fmt: skip
"""The same words in correct policies, which stay proved."""
