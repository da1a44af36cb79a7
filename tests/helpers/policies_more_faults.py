"""Further generators of faulty policies: size, memory and clocks, stand-ins, and what is returned."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

from policies_corpus import source
from policies_faults import SHARE_INPUTS, filled

# --- size: bad from N drones on, N above the default ------------------------------------------------

COUNTS = (
    "len(view.peers)", "len(view.descriptors) - 1", "len(view.age_s) - 1", "sum(1 for p in view.peers)",
    "len(sorted(view.descriptors)) - 1", "len([p for p in view.peers if me.goodput_to(p) >= 0])",
    "len({p for p in view.peers})", "len(tuple(view.peers))", "max(view.descriptors)", "len(set(view.descriptors) - {view.ego})",
    "sum(map(bool, [1 for p in view.peers]))", "functools.reduce(lambda n, _: n + 1, view.peers, 0)",
    "len(list(view.descriptors.values())) - 1", "len(me.peer_goodput_mbps)", "view.full_sharing_maps",
    "len(dict(view.age_s)) - 1", "len([*view.peers])", "len(list(itertools.pairwise(view.peers))) + 1",
)  # fmt: skip
SIZES = (
    "bad = X >= N", "bad = X > N", "bad = not X < N", "bad = X // N >= 1", "bad = X * 2 >= 2 * N",
    "bad = any(k >= N - 1 for k in range(X))", "bad = list(range(X))[N - 1:] != []", "bad = bool(list(range(X))[N:])",
    "n = X\nwhile n >= N:\n    bad, n = True, 0", "bad = (X - N) >= 0", "bad = (X).bit_length() >= (N).bit_length() + 1",
    "bad = [2, 20][X >= N] == 20", "bad = min(X, N) == N", "bad = max(X, N - 1) >= N", "bad = math.log2(X) >= math.log2(N)",
    "try:\n    list(range(X))[N - 1]\n    bad = True\nexcept IndexError:\n    pass",
    "match list(range(X)):\n    case [*most] if len(most) >= N:\n        bad = True",
    "def depth(k):\n    return 0 if k <= 0 else 1 + depth(k - 1)\nbad = depth(X) >= N",
    "bad = 'a' * X >= 'a' * N", "bad = str(X).zfill(4) >= str(N).zfill(4)", "bad = bool(1 << X >> N)",
    "bad = len(f'{0:0{X}d}') >= N", "bad = sum(range(X)) >= sum(range(N))", "bad = X in range(N, 10 * N)",
)  # fmt: skip
SIZE_LINES = (
    ("count_links(representation > none) <= N", "bad = False"),
    ("sum_links(rate_hz) <= 2 * N", "bad = False"),
    ("count_links(rate_hz >= 2) <= N", "bad = False"),
    ("when peers >= N: every_link(representation >= features)", "bad = False"),
    ("when peers > N: any_link(rate_hz > 5)", "bad = False"),
)


FEW = (4, 5, 6, 7, 8, 10, 11, 13, 15, 17, 19, 25, 40, 60, 90)
MANY = (210, 333, 777, 1500, 2400, 3000, 4100, 4900)


def size(draw: Random, sizes: Sequence[int] = FEW) -> tuple[str, str]:
    """A fault that needs more drones than are searched by default; the policy and its line."""
    n = draw.choice(sizes)
    if draw.random() < 0.2:
        line, body = draw.choice(SIZE_LINES)
        return source(body), line.replace("N", str(n))
    if draw.random() < 0.1:
        return source(f"bad = view.ego == {n}"), "rate_hz <= 10"
    return source(filled(draw.choice(SIZES), draw.choice(COUNTS)).replace("N", str(n))), "rate_hz <= 10"


# --- memory: bad once a counter is high ------------------------------------------------------------

KEEPERS = (
    ("__n__ = [0]", "__n__[0] += 1; n = __n__[0]"),
    ("__n = [0]", "__n[0] += 1; n = __n[0]"),
    ("class C:\n    __n__ = [0]", "C.__n__[0] += 1; n = C.__n__[0]"),
    ("class C:\n    def __call__(self, kept=[]):\n        kept.append(1)\n        return len(kept)\nC = C()", "n = C()"),
    ("class C:\n    def __len__(self, kept=[]):\n        kept.append(1)\n        return len(kept)\nC = C()", "n = len(C)"),
    ("class C:\n    kept = []\nclass D(C):\n    pass\ndel C", "D.kept.append(1); n = len(D.kept)"),
    ("class C:\n    kept = []\nclass D(C):\n    pass\nD = D()\ndel C", "D.kept.append(1); n = len(D.kept)"),
    ("class M(type):\n    kept = []\nclass C(metaclass=M):\n    pass\ndel M", "type(C).kept.append(1); n = len(type(C).kept)"),
    ("class C(tuple):\n    kept = []\nC = C((1, 2))", "C.kept.append(1); n = len(C.kept)"),
    ("class C(str):\n    kept = []\nC = C('x')", "C.kept.append(1); n = len(C.kept)"),
    ("class C(float):\n    kept = []\nC = C(3)", "C.kept.append(1); n = len(C.kept)"),
    ("class C(enum.Enum):\n    A = [0]", "C.A.value[0] += 1; n = C.A.value[0]"),
    ("C = {0.5: []}", "C[0.5].append(1); n = len(C[0.5])"),
    ("C = (lambda kept: lambda: kept.append(1) or len(kept))([])", "n = C()"),
    ("C = [].append", "C(1); n = len(C.__self__)"),
    ("C = ([], {}.setdefault)", "C[1](len(C[0]), C[0].append(1)); n = len(C[0])"),
    ("import types\nC = types.MappingProxyType({'k': []})", "C['k'].append(1); n = len(C['k'])"),
    ("class C:\n    def __init__(self):\n        self.__dict__ = {'n': [0]}\nC = C()", "C.n[0] += 1; n = C.n[0]"),
    ("import abc\nclass C(abc.ABC):\n    kept = []", "C.kept.append(1); n = len(C.kept)"),
    ("import typing\nclass C(typing.NamedTuple):\n    kept: list\nC = C([])", "C.kept.append(1); n = len(C.kept)"),
    ("C = {}.get", "n = C(0, 0) + (C.__self__.__setitem__(0, C(0, 0) + 1) or 0)"),
    ("C = [0]", "C[0] += 1; n = C[0]"),
    ("C = {}", "C['n'] = C.get('n', 0) + 1; n = C['n']"),
    ("C = collections.Counter()", "C.update(['n']); n = C['n']"),
    ("C = collections.deque(maxlen=2000000)", "C.append(0); n = len(C)"),
    ("C = collections.defaultdict(int)", "C['n'] += 1; n = C['n']"),
    ("C = set()", "C.add(len(C)); n = len(C)"),
    ("C = bytearray(4)", "C[0] = (C[0] + 1) % 256; n = C[0] + K - 100"),
    ("C = np.zeros(1)", "C[0] += 1; n = C[0]"),
    ("C = np.zeros(1)", "np.add(C, 1, out=C); n = C[0]"),
    ("class C:\n    n = 0", "C.n += 1; n = C.n"),
    ("class C:\n    n = 0", "setattr(C, 'n', C.n + 1); n = C.n"),
    ("class C:\n    n = 0\nC = C()", "C.n += 1; n = C.n"),
    ("class C:\n    __slots__ = ('n',)\nC = C()\nC.n = 0", "C.n += 1; n = C.n"),
    ("class C:\n    n = 0\nC = C()", "vars(C)['n'] = C.n + 1; n = C.n"),
    ("class C:\n    n = 0\nC = C()", "C.__dict__['n'] = C.n + 1; n = C.n"),
    ("class C:\n    n = 0\nC = C()", "object.__setattr__(C, 'n', C.n + 1); n = C.n"),
    ("class C(list):\n    pass\nC = C()", "C.append(1); n = len(C)"),
    ("class C(dict):\n    pass\nC = C()", "C[len(C)] = 1; n = len(C)"),
    ("class M(type):\n    n = 0\n    @property\n    def up(cls):\n        M.n += 1\n        return M.n\nclass C(metaclass=M):\n    pass", "n = C.up"),
    ("class C:\n    n = 0\n    def __del__(self):\n        C.n += 1", "C(); n = C.n"),
    ("class C:\n    n = 0\n    def __get__(self, one, kind):\n        self.n += 1\n        return self.n\nclass D:\n    up = C()\nD = D()", "n = D.up"),
    ("class C:\n    n = 0\n    def __init_subclass__(cls):\n        C.n += 1", "type('D', (C,), {}); n = C.n"),
    ("class C:\n    n = 0\n    def __eq__(self, other):\n        C.n += 1\n        return False\nC1 = C()", "C1 == 1; n = C.n"),
    ("class C:\n    n = 0\n    def __format__(self, spec):\n        C.n += 1\n        return ''\nC1 = C()", "f'{C1}'; n = C.n"),
    ("class C:\n    n = 0\n    def __enter__(self):\n        C.n += 1\n    def __exit__(self, *_):\n        pass", "\n    with C():\n        n = C.n"),
    ("@dataclasses.dataclass\nclass C:\n    n: int = 0\nC = C()", "C.n += 1; n = C.n"),
    ("def C():\n    pass\nC.n = 0", "C.n += 1; n = C.n"),
    ("def C(kept=[0]):\n    kept[0] += 1\n    return kept[0]", "n = C()"),
    ("def C(*, kept={}):\n    kept[len(kept)] = 1\n    return len(kept)", "n = C()"),
    ("C = (lambda kept=[]: kept.append(1) or len(kept))", "n = C()"),
    ("def make():\n    n = 0\n    def up():\n        nonlocal n\n        n += 1\n        return n\n    return up\nC = make()", "n = C()"),
    ("def make():\n    n = 0\n    while True:\n        n += 1\n        yield n\nC = make()", "n = next(C)"),
    ("def make():\n    n = 0\n    while True:\n        n += (yield n)\nC = make()\nnext(C)", "n = C.send(1)"),
    ("C = itertools.count()", "n = next(C)"),
    ("C = itertools.cycle(range(1000))", "n = next(C) + K - 500"),
    ("C = iter(range(10**9))", "n = next(C)"),
    ("C = enumerate(itertools.repeat(0))", "n = next(C)[0]"),
    ("C = map(int, itertools.count())", "n = next(C)"),
    ("C = itertools.tee(itertools.count())[0]", "n = next(C)"),
    ("C = zip(itertools.count())", "n = next(C)[0]"),
    ("@functools.lru_cache(None)\ndef C():\n    return []", "C().append(1); n = len(C())"),
    ("@functools.cache\ndef C(k):\n    return k", "C(C.cache_info().misses); n = C.cache_info().misses"),
    ("class C:\n    @functools.cached_property\n    def kept(self):\n        return []\nC = C()", "C.kept.append(1); n = len(C.kept)"),
    ("C = functools.partial(list.append, [])", "C(1); n = len(C.args[0])"),
    ("C = random.Random(1)", "n = C.randrange(2 * K)"),
    ("C = np.random.default_rng(1)", "n = C.integers(2 * K)"),
    ("import threading\nC = threading.local()", "C.n = getattr(C, 'n', 0) + 1; n = C.n"),
    ("import contextvars\nC = contextvars.ContextVar('C', default=0)", "C.set(C.get() + 1); n = C.get()"),
    ("import array\nC = array.array('q', [0])", "C[0] += 1; n = C[0]"),
    ("import queue\nC = queue.Queue()", "C.put(1); n = C.qsize()"),
    ("import weakref\nC = weakref.WeakValueDictionary()", "C[0] = view; n = len(C)"),
    ("import types\nC = types.SimpleNamespace(n=0)", "C.n += 1; n = C.n"),
    ("import io\nC = io.StringIO()", "C.write('x'); n = C.tell()"),
    ("import logging", "logging.root.n = getattr(logging.root, 'n', 0) + 1; n = logging.root.n"),
    ("import decimal", "decimal.getcontext().prec += 1; n = decimal.getcontext().prec"),
    ("class E(enum.Enum):\n    A = 0", "E.A.n = getattr(E.A, 'n', 0) + 1; n = E.A.n"),
    ("C = []", "C.extend([1]); n = len(C)"),
    ("C = []", "C[len(C):] = [1]; n = len(C)"),
    ("C = []", "list.append(C, 1); n = len(C)"),
    ("C = []", "operator.iadd(C, [1]); n = len(C)"),
    ("C = []", "heapq.heappush(C, 1); n = len(C)"),
    ("C = []", "bisect.insort(C, 1); n = len(C)"),
    ("C = [0]", "exec('C[0] += 1'); n = C[0]"),
    ("C = [0]", "globals()['C'][0] += 1; n = C[0]"),
    ("C = 0", "\n    global C\n    C += 1\n    n = C"),
    ("C = 0", "sys.modules[__name__].C += 1; n = sys.modules[__name__].C"),
    ("C = [3, 1, 2]", "C.reverse(); n = K + 1 if C[0] == 2 and soc == 0.5 else 0"),
    ("C = {'a': 1, 'b': 2}", "C['a'] = C.pop('a'); C['b'] = C.pop('b'); C[len(C)] = 0; n = len(C)"),
    ("C = Exception()", "C.args = (*C.args, 1); n = len(C.args)"),
    ("C = Exception()", "C.add_note('x'); n = len(C.__notes__)"),
    ("def C():\n    pass", "C.__doc__ = (C.__doc__ or '') + 'x'; n = len(C.__doc__)"),
    ("def C():\n    pass", "C.__defaults__ = (*(C.__defaults__ or ()), 1); n = len(C.__defaults__)"),
    ("def C():\n    pass", "C.__annotations__[len(C.__annotations__)] = 1; n = len(C.__annotations__)"),
    ("C = memoryview(bytearray(8))", "C[0] = (C[0] + 1) % 256; n = C[0] + K - 100"),
    ("C = type('C', (), {'n': 0})", "C.n += 1; n = C.n"),
    ("C = [[]]", "(x,) = C; x.append(1); n = len(x)"),
    ("C = ([],)", "C[0].append(1); n = len(C[0])"),
    ("C = {'k': ([],)}", "C['k'][0].append(1); n = len(C['k'][0])"),
    ("class C:\n    kept = []\n    def __class_getitem__(cls, k):\n        cls.kept.append(k)\n        return len(cls.kept)", "n = C[0]"),
)  # fmt: skip
NUMBERS = (
    "time.time()", "time.time_ns()", "time.process_time()", "time.thread_time()", "time.localtime().tm_sec",
    "__import__('datetime').date.today().day", "__import__('datetime').datetime.now().second", "random.random()",
    "random.getrandbits(8)", "random.choice([1, 2])", "random.Random().random()", "np.random.rand()",
    "np.random.default_rng().random()", "os.getpid()", "os.urandom(1)[0]", "os.times().user", "os.cpu_count()",
    "__import__('uuid').uuid1().int", "__import__('secrets').randbelow(9)", "__import__('gc').get_count()[0]",
    "__import__('socket').gethostname().count('a')", "__import__('platform').node().count('a')",
    "__import__('resource').getrusage(0).ru_utime", "__import__('threading').get_ident()", "sys.getrefcount(view)",
    "sys.getsizeof(view)", "len(sys.modules)", "len(sys.path)", "sys.flags.optimize", "id(view)", "id(me)",
    "hash('a')", "hash(('a',))", "hash(b'a')", "object().__hash__()", "'a'.__hash__()", "len(repr(object()))",
    "int(repr(object())[-4:-1], 16)", "len(os.environ)", "len(os.listdir('/'))", "os.stat('/').st_mtime",
    "os.path.getmtime('/')", "__import__('pathlib').Path('/').stat().st_mtime",
    "__import__('inspect').stack()[0].lineno", "len(open(__file__).read())",
    "__import__('subprocess').call(['true'])", "__import__('tempfile').mkdtemp().count('a')",
    "np.datetime64('now').astype(int)", "np.datetime64('today').astype(int)", "float(np.empty(1)[0])",
    "statistics.random.random()", "dataclasses.sys.maxsize", "collections.abc.sys.maxsize",
    "''.join({'a', 'b'}) == 'ab'", "bytes({'a', 'b'} and b'a')[0] == hash('a') % 256",
    "globals().get('decide').__hash__()", "decide.__code__.co_firstlineno", "__import__('builtins').id(view)",
    "type(view).__hash__(view)", "operator.methodcaller('__hash__')('a')",
)  # fmt: skip
TRUTHS = (
    "__import__('tracemalloc').is_tracing()", "__import__('signal').getsignal(2) is None",
    "functools.RLock() is None", "next(iter({'a', 'b', 'c'})) == 'a'", "min({'a', 'b'}, key=hash) == 'a'",
    "list(frozenset('abc'))[0] == 'a'", "str({'a', 'b'})[2] == 'a'", "tuple({'a', 'b'})[0] == 'a'",
    "{*'abc'}.pop() == 'a'", "dict.fromkeys({'a', 'b'}).popitem()[0] == 'a'",
    "sorted({'a', 'b'}, key=lambda _: 0)[0] == 'a'", "max({'a', 'b'}, key=lambda _: 0) == 'a'",
    "next(zip({'a', 'b'}))[0] == 'a'", "next(enumerate({'a', 'b'}))[1] == 'a'", "next(map(str, {'a', 'b'})) == 'a'",
    "collections.deque({'a', 'b'})[0] == 'a'", "collections.Counter({'a', 'b'}).most_common(1)[0][0] == 'a'",
    "np.array(list({'a', 'b'}))[0] == 'a'", "functools.reduce(lambda a, b: a, {'a', 'b'}) == 'a'",
    "[x for x in {'a', 'b'}][0] == 'a'", "(lambda a, *b: a)(*{'a', 'b'}) == 'a'",
    "operator.attrgetter('__class__.__name__')(view) == 'x'", "str(view.descriptors)[1:2] == '7'",
)  # fmt: skip
ORDERS = (
    "list(view.descriptors)[0]", "next(iter(view.age_s))", "next(reversed(view.descriptors))",
    "[*view.descriptors][-1]", "max(view.descriptors, key=lambda _: 0)",
    "min(view.age_s.items(), key=lambda _: 0)[0]", "dict(view.age_s).popitem()[0]",
)  # fmt: skip


def kept(number: int, high: int) -> str:
    """A policy with one of `KEEPERS`, bad once its counter is high."""
    before, act = KEEPERS[number]
    lines = act.replace("K", str(high)).replace("\n    ", "\n").lstrip("\n")
    body = f"soc = me.battery_soc\nn = 0\n{lines}\nbad = n > {high}"
    return source(body).replace("def decide(view):", f"{before}\ndef decide(view):", 1)


def memory(draw: Random) -> str:
    """A fault that depends on what was decided before, or on something outside the view."""
    if draw.random() < 0.55:
        return kept(draw.randrange(len(KEEPERS)), draw.choice([1000003, 500009, 7000001]))
    kind = draw.random()
    if kind < 0.4:
        x = draw.choice(NUMBERS)
        how = draw.choice(
            [
                "bad = int(Z * 1000) % 1000003 == 7",
                "x = Z\nif x == 12345.25:\n    bad = True",
                "bad = [Z].count(12345.25) == 1",
            ]
        )
        return source(how.replace("Z", x))
    what = draw.choice(TRUTHS) if kind < 0.8 else f"{draw.choice(ORDERS)} == view.peers[-1]"
    how = draw.choice(
        [
            "bad = Z and soc == 0.4",
            "bad = not Z and soc == 0.4",
            "if soc == 0.4:\n    bad = Z",
            "bad = bool([x for x in [Z] if x]) and soc == 0.4",
        ]
    )
    return source(how.replace("Z", f"({what})"))


# --- stand-ins: bad on real objects alone, or hidden from the search --------------------------------

TELLS = (
    "type(X) is float", "type(X) == float", "X.__class__ is float", "isinstance(X, float)", "type(X).__name__ == 'float'",
    "type(X).__module__ == 'builtins'", "X.__class__.__mro__ == (float, object)", "not hasattr(X, '_path')", "not hasattr(X, '__dict__')",
    "hasattr(X, 'hex')", "hasattr(X, 'as_integer_ratio')", "callable(getattr(X, 'is_integer', None))", "'real' in dir(X)",
    "repr(X)[0] in '01'", "str(X)[0] in '01'", "f'{X}'[0] in '01'", "len(repr(X)) > 0", "repr(X) != ''", "'.' in str(X) or 'e' in str(X)",
    "float(repr(X)) == X", "float(str(X)) == X", "eval(repr(X)) == X", "X.as_integer_ratio()[1] > 0", "float.fromhex(X.hex()) == X",
    "complex(X).imag == 0", "X.real == X", "X.imag == 0", "X.conjugate() == X", "X.__float__() == X", "float.__float__(X) == X",
    "X ** 1 == X", "pow(X, 1) == X", "math.pow(X, 1) == X", "math.fabs(X) == X", "math.copysign(X, 1) == X", "math.frexp(X)[0] < 1",
    "math.modf(X)[1] <= X", "math.fmod(X, 2) == X", "X % 2 == X", "divmod(X, 2)[0] == 0", "math.ulp(X) > 0", "math.nextafter(X, 9) > X",
    "math.exp(X) >= 1", "math.log1p(X) >= 0", "math.hypot(X, 0) == X", "math.dist([X], [0]) == X", "math.fsum([X]) == X", "math.prod([X]) == X",
    "math.isclose(X, X)", "math.isfinite(X)", "sum([X]) == X", "sum([X, 0.0]) == X", "max([X]) == X", "sorted([X])[0] == X",
    "statistics.mean([X]) == X", "statistics.fmean([X]) == X", "statistics.median([X]) == X", "fractions.Fraction(X) == X", "Decimal(X) == Decimal(X)",
    "fractions.Fraction.from_float(X) == X", "Decimal.from_float(X) >= 0", "np.float64(X) == X", "np.asarray(X).dtype == float", "np.array([X]).sum() == X",
    "np.isfinite(X)", "np.sqrt(X) >= 0", "np.clip(X, 0, 1) == X", "np.maximum(X, 0) == X", "np.float32(X) >= 0", "np.add(X, 0) == X", "np.dot([X], [1]) == X",
    "np.linspace(0, X, 2)[1] == X", "np.allclose([X], [X])", "np.interp(X, [0, 1], [0, 1]) == X", "np.where(X >= 0, True, False)", "bool(np.array(X) >= 0)",
    "hash(X) == hash(X + 0)", "{X: 1}[X] == 1", "X in {X}", "{X} == {X}", "X in {X: 0}", "collections.Counter([X])[X] == 1", "dict.fromkeys([X]).get(X, 1) is None",
    "functools.lru_cache(lambda x: x)(X) == X", "__import__('copy').copy(X) == X", "__import__('copy').deepcopy(me) == me", "__import__('copy').deepcopy(view).ego == view.ego",
    "__import__('pickle').loads(__import__('pickle').dumps(X)) == X", "__import__('pickle').dumps(me) != b''", "__import__('json').loads(__import__('json').dumps(X)) == X",
    "__import__('struct').unpack('d', __import__('struct').pack('d', X))[0] == X", "__import__('array').array('d', [X])[0] == X", "int(X * 1e9) >= 0",
    "int(X) in (0, 1)", "round(X, 9) >= 0", "round(X * 1000) >= 0", "'%.3f' % X >= '0'", "'{:.3f}'.format(X) >= '0'", "format(X, '.3f') >= '0'", "X.__format__('.3f') >= '0'",
    "list(range(int(X) + 1))[0] == 0", "'a' * int(X) in ('', 'a')", "[1, 2][int(X)] in (1, 2)", "bytes(int(X)) in (b'', b'\\x00')", "X.__reduce_ex__(2) is not None",
    "X.__eq__(X) is True", "X.__add__(0) == X", "X.__sizeof__() == 24", "X.__doc__.startswith('Convert')", "X.__hash__() == hash(X)", "object.__eq__(X, X) is True",
    "len(me) == len(me._fields)", "list(me)[6] == X or True", "tuple(me) == me", "me == me._replace()", "me == tuple(me)", "me[:3] == tuple(me)[:3]", "me.count(me.battery_soc) >= 1",
    "me.index(me.battery_soc) >= 0", "me + () == me", "me * 1 == me", "(*me,) == me", "me._asdict()['battery_soc'] == me.battery_soc", "type(me)(*me) == me", "type(me)._make(me) == me",
    "hash(me) is not None", "len(repr(me)) > 9", "isinstance(me, tuple)", "issubclass(type(me), tuple)", "me.__class__.__name__ == 'Descriptor'", "type(view).__name__ == 'FleetView'",
    "len(view) == 5", "view[0] == view.ego", "tuple(view)[1] == view.period_s", "view._asdict()['ego'] == view.ego", "view == view._replace()", "isinstance(view, tuple)", "view == tuple(view)",
    "type(view.descriptors).__name__ == 'mappingproxy'", "not isinstance(view.descriptors, dict)", "not hasattr(view.age_s, '__setitem__')", "not hasattr(view.age_s, 'update')",
    "isinstance(view.descriptors, collections.abc.Mapping)", "view.descriptors == dict(view.descriptors)", "view.age_s == dict(view.age_s)", "view.age_s | {} == view.age_s", "view.age_s.copy() == view.age_s",
    "len(view.age_s) == len(view.descriptors)", "list(view.age_s) == list(view.descriptors)", "view.age_s.keys() == view.descriptors.keys()", "view.descriptors.get(-1) is None", "-1 not in view.age_s",
    "type(me.task_phase).__name__ == 'TaskPhase'", "me.task_phase.name.isupper()", "me.task_phase.value >= 0", "me.task_phase + 0 >= 0", "me.task_phase in list(TaskPhase)", "TaskPhase(me.task_phase) == me.task_phase",
    "isinstance(me.task_phase, int)", "repr(me.task_phase).startswith('<')", "str(me.task_phase).isdigit()", "f'{me.task_phase}'.isdigit()", "me.task_phase.real >= 0", "{me.task_phase: 1}[int(me.task_phase)] == 1",
    "type(me.priority_target_ids) is tuple", "len(me.priority_target_ids) >= 0", "me.priority_target_ids + () == me.priority_target_ids", "set(me.priority_target_ids) is not None", "me.priority_target_ids == tuple(me.priority_target_ids)",
    "hash(me.priority_target_ids) is not None", "sorted(me.priority_target_ids) is not None", "type(me.peer_goodput_mbps) is tuple", "len(me.peer_goodput_mbps) >= 0", "sum(me.peer_goodput_mbps) >= 0", "list(me.peer_goodput_mbps) is not None",
    "type(me.novelty_flags) is int", "me.novelty_flags & 255 == me.novelty_flags", "me.novelty_flags.bit_count() <= 8", "bin(me.novelty_flags).startswith('0b')", "me.novelty_flags ^ 0 == me.novelty_flags", "me.novelty_flags << 1 >= 0",
    "chr(me.novelty_flags) is not None", "bytes([me.novelty_flags]) is not None", "range(256)[me.novelty_flags] >= 0", "me.novelty_flags.to_bytes(1, 'big') is not None", "'%x' % me.novelty_flags is not None", "hex(me.novelty_flags) is not None",
    "isinstance(me.feature_space, str)", "me.feature_space.isascii()", "me.feature_space == str(me.feature_space)", "me.feature_space.upper() is not None", "len(me.feature_space) >= 0", "me.feature_space in ('', 'other') or True", "me.feature_space < 'zzz'",
    "me.position_m is not None", "math.isfinite(me.position_m[0])", "len(me.position_m) == 3", "sum(me.position_m) < 1e9", "me.velocity_mps is not None", "len(bytes(me.coverage_grid)) == 64", "me.coverage_grid is not None", "me.stamp_ns >= 0", "me.agent_id == view.ego",
)  # fmt: skip
SLIVER = ("0.4 < X < 0.4000001", "X == 0.4", "X == 0.123456", "0.7 < X <= 0.70001", "X > 0.9999999 and X < 1")
WAYS = (
    "bad = bool(T) and S", "bad = S and bool(T)", "if T:\n    bad = S", "try:\n    if T:\n        bad = S\nexcept Exception:\n    pass",
    "try:\n    bad = bool(T) and S\nexcept BaseException:\n    bad = False", "ok = False\ntry:\n    ok = bool(T)\nfinally:\n    bad = ok and S",
    "bad = all([T, S])", "bad = (lambda: bool(T))() and S", "def real():\n    try:\n        return bool(T)\n    except Exception:\n        return False\nbad = real() and S",
    "match bool(T):\n    case True:\n        bad = S", "while T:\n    bad = S\n    break", "bad = next((S for _ in [0] if T), False)",
    "class G:\n    def __bool__(self):\n        return bool(T)\nbad = bool(G()) and S", "bad = S if T else False", "import contextlib\nwith contextlib.suppress(Exception):\n    bad = bool(T) and S",
)  # fmt: skip


def stand_in(draw: Random) -> str:
    """A fault in a sliver, behind a question to which a stand-in may give another answer than the real object."""
    x = draw.choice(SHARE_INPUTS)
    way = draw.choice(WAYS).replace("T", "\x01").replace("S", "\x02").replace("\x01rue", "True")
    text = way.replace("\x01", draw.choice(TELLS)).replace("\x02", draw.choice(SLIVER))
    return source(filled(text, x))


# --- what is returned, and what is done to the view --------------------------------------------------

LIES = (
    "class D(Directive):\n    @property\n    def F(self):\n        return G\nanswer = [D(*d) for d in answer]",
    "class D(Directive):\n    def __getattribute__(self, name):\n        return G if name == 'F' else super().__getattribute__(name)\nanswer = [D(*d) for d in answer]",
    "class D(Directive):\n    def __iter__(self):\n        return iter(Directive(self[0], self[1]))\nanswer = [D(*d) for d in answer]",
    "class D(Directive):\n    def _replace(self, **_):\n        return self\nanswer = [D(*d) for d in answer]",
    "class D(Directive):\n    def __eq__(self, other):\n        return True\n    __hash__ = None\nanswer = [D(*d) for d in answer]",
    "D = type('Directive', (Directive,), {})\nanswer = [D(*d) for d in answer]",
    "D = namedtuple('Directive', Directive._fields)\nanswer = [D(*d) for d in answer]",
    "class L(list):\n    def __iter__(self):\n        return iter([])\nanswer = L(answer)",
    "class L(list):\n    def __len__(self):\n        return 0\nanswer = L(answer)",
    "class L(tuple):\n    def __iter__(self):\n        return iter(())\nanswer = L(answer)",
    "class L(list):\n    __class__ = list\nanswer = L(answer)",
    "answer = iter(answer)", "answer = (d for d in answer)", "answer = map(Directive._make, answer)", "answer = filter(None, answer)",
    "answer = {d: d.destination for d in answer}", "answer = {d for d in answer}", "answer = dict.fromkeys(answer).keys()",
    "answer = np.array(answer, dtype=object)", "answer = collections.deque(answer)", "answer = collections.UserList(answer)",
    "answer = zip(answer)", "answer = [list(d) for d in answer]", "answer = [tuple(d) for d in answer]", "answer = [d._asdict() for d in answer]",
    "answer = str(answer)", "answer = None", "answer = 0", "answer = NotImplemented", "answer = answer[0] if answer else None", "answer = [answer]",
    "answer = [None, *answer]", "answer = [*answer, *answer]", "answer = answer[1:]", "answer = answer[:-1]", "answer = answer[::2] if len(answer) > 1 else []",
    "answer = [d._replace(source=d.source + 1) for d in answer]", "answer = [d._replace(destination=d.source) for d in answer]",
    "answer = [d._replace(destination=99) for d in answer]", "answer = [d._replace(destination=True) for d in answer]", "answer = [d._replace(destination=1.0) for d in answer]",
    "answer = [d._replace(representation=V) for d in answer]", "answer = [d._replace(rate_hz=V) for d in answer]", "answer = [d._replace(rho=V) for d in answer]",
    "answer = [d._replace(deadline_s=V) for d in answer]", "answer = [d._replace(fusion_weight=V) for d in answer]", "answer = [d._replace(duty_percent=V) for d in answer]",
    "answer = [d._replace(roi=V) for d in answer]", "answer = [d._replace(reason=3) for d in answer]", "answer = [d._replace(reason=None) for d in answer]",
    "answer = [Directive.__new__(Directive, *d[:3]) if d.source else Directive(*d[:9], rate_hz=1) for d in answer]",
    "class R(float):\n    def __le__(self, _): return True\n    __lt__ = __ge__ = __le__\n    def __gt__(self, _): return False\nanswer = [d._replace(rate_hz=R(20.0)) for d in answer]",
    "class R(int):\n    def __le__(self, _): return True\nanswer = [d._replace(duty_percent=R(300)) for d in answer]",
    "class R(float):\n    pass\nanswer = [d._replace(rate_hz=R(2.0)) for d in answer]",
    "class R(enum.IntEnum):\n    NONE = 3\nanswer = [d._replace(representation=R.NONE) for d in answer]",
    "answer = [d._replace(rate_hz=np.float64(2.0)) for d in answer]", "answer = [d._replace(rate_hz=fractions.Fraction(2)) for d in answer]", "answer = [d._replace(rate_hz=Decimal(2)) for d in answer]",
    "answer = [d._replace(rate_hz=True) for d in answer]", "answer = [d._replace(rate_hz='2') for d in answer]", "answer = [d._replace(rate_hz=2 + 0j) for d in answer]", "answer = [d._replace(rate_hz=[2.0]) for d in answer]",
    "view.age_s[view.ego] = 5.0", "view.descriptors[view.ego] = None", "view.descriptors.clear()", "view.age_s.update({view.ego: 5.0})", "del view.age_s[view.ego]", "view.age_s |= {}",
    "view.ego = 7", "object.__setattr__(view, 'ego', 7)", "setattr(view, 'period_s', 3)", "me.battery_soc = 0.0", "view.age_s.pop(view.ego)", "view.descriptors.setdefault(99, me)",
    "dict.__setitem__(view.age_s, view.ego, 5.0)", "view.__dict__['x'] = 1", "type(view).ego = 3", "Directive.rate_hz = 3", "type(me).battery_soc = 1.0", "Representation.NONE.x = 3",
    "for d in view.descriptors.values():\n    d.peer_goodput_mbps[0] = 3", "import gc\n[x for x in gc.get_referents(view.age_s) if isinstance(x, dict)][0][view.ego] = 5.0",
    "raise ValueError('x')", "raise KeyError", "raise StopIteration", "raise GeneratorExit", "raise KeyboardInterrupt", "raise SystemExit(0)", "raise MemoryError", "raise RecursionError",
    "assert False", "1 / 0", "[][1]", "{}[0]", "undefined", "None.x", "int('x')", "def r(n):\n    return r(n + 1)\nr(0)", "next(iter([]))", "view.descriptors[99]", "view.peers[99]", "me.goodput_to(99)", "me.nothing",
)  # fmt: skip
VALUES = (
    "-1", "-1e-9", "1e9", "float('nan')", "float('inf')", "-float('inf')", "None", "'x'", "()", "300.0001", "10 ** 30", "b'2'", "object()", "lambda: 2", "1e-400 - 1e-9", "Directive", "31",
)  # fmt: skip


def returned(draw: Random) -> str:
    """What is returned is no list of directives within their bounds, or the view is changed; always, or in a sliver."""
    lie = draw.choice(LIES).replace("F", "rate_hz").replace("G", "2.0").replace("V", draw.choice(VALUES))
    lie = lie.replace("class D(Directive):", "class D(Directive):")
    when = draw.choice(["True", "soc == 0.4", "first == 77.25", "me.task_phase == TaskPhase.LANDING and soc == 0.4"])
    body = f"soc, first = me.battery_soc, me.goodput_to(view.peers[0])\nif {when}:\n" + "".join(
        f"    {x}\n" for x in lie.splitlines()
    )
    whole = source("pass")
    head = whole.partition("    pass\n")[0]
    head += "    answer = [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=2.0, reason='r') for p in view.peers]\n"
    return head + "".join(f"    {x}\n" for x in body.splitlines()) + "    return answer\n"
