"""Generators of small policies with a planted fault, and of correct ones, drawn from a seed.

Each entry is a template with drawn constants, inputs, operators and shapes. That a faulty one has a view which breaks the
line is known from how it is made. A correct one keeps the line on every view.
"""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

from policies_corpus import source

WHOLE_INPUTS = {
    "first": (0, 99000), "me.goodput_to(view.peers[-1])": (0, 99000), "view.age_s[view.peers[0]]": (0, 3000),
    "view.age_s[view.ego]": (0, 3000),
}  # fmt: skip
"""Numbers with wholes inside their range."""
SHARE_INPUTS = ("soc", "me.cpu_headroom", "me.gpu_headroom", "view.descriptors[view.peers[-1]].battery_soc")
"""Numbers of 0 … 1."""

# Each shape is true for x exactly in (a, b], in one way of writing it.
BETWEEN = (
    "bad = A < X <= B",
    "bad = not (X <= A or X > B)",
    "bad = not X <= A and not X > B",
    "bad = (X > A) + (X > B) == 1",
    "bad = (X > A) ^ (X > B)",
    "bad = (X > A) is not (X > B)",
    "bad = (X > A) != (X > B)",
    "bad = [False, True, False][(X > A) + (X > B)]",
    "bad = {0: False, 1: True, 2: False}[int(X > A) + int(X > B)]",
    "bad = min(max(X, A), B) == X and X != A",
    "bad = max(A, X) > A and min(X, B) == X",
    "bad = sorted([A, X, B])[1] == X and X != A",
    "bad = bisect.bisect_left([A, B], X) == 1",
    "bad = sum(X > c for c in (A, B)) == 1",
    "bad = all((X > A, not X > B))",
    "bad = any(A < x <= B for x in [X])",
    "bad = (lambda x: A < x <= B)(X)",
    "bad = True if X > A and X <= B else False",
    "if X > A:\n    if not X > B:\n        bad = True",
    "if X <= A:\n    pass\nelif X <= B:\n    bad = True",
    "match X:\n    case x if A < x <= B:\n        bad = True",
    "match (X > A, X > B):\n    case (True, False):\n        bad = True",
    "for low, high in ((A, B), (-2, -1)):\n    bad = bad or low < X <= high",
    "for c, answer in ((A, False), (B, True)):\n    if X <= c:\n        bad = answer\n        break",
    "n = 0\nfor c in (A, B):\n    if X > c:\n        n += 1\nbad = n == 1",
    "if (x := X) > A:\n    bad = x <= B",
    "x = X\nwhile x > A:\n    bad = x <= B\n    break",
    "def band(x, low=A, high=B):\n    return low < x <= high\nbad = band(X)",
    "def over(c):\n    return lambda x: x > c\nbad = over(A)(X) and not over(B)(X)",
    "class Band:\n    def __contains__(self, x):\n        return A < x <= B\nbad = X in Band()",
    "class Band:\n    def __eq__(self, x):\n        return A < x <= B\nbad = X == Band()",
    "class Band:\n    def __eq__(self, x):\n        return A < x <= B\n    __hash__ = None\nbad = Band() in [X]",
    "class Band:\n    def __lt__(self, x):\n        return A < x <= B\nbad = X > Band()",
    "@dataclasses.dataclass(order=True, frozen=True)\nclass Box:\n    x: float\nbad = Box(A) < Box(X) <= Box(B)",
    "Pair = namedtuple('Pair', 'x y')\nbad = Pair(A, 0) < Pair(X, 0) <= Pair(B, 0)",
    "bad = (A, 9) < (X, 0) and (X, 0) <= (B, 9) and X != A",
    "bad = [A] < [X] <= [B]",
    "try:\n    assert not A < X <= B\nexcept AssertionError:\n    bad = True",
    "try:\n    [0][1 if A < X <= B else 0]\nexcept IndexError:\n    bad = True",
    "import contextlib\nbad = True\nwith contextlib.suppress(ZeroDivisionError):\n    1 / (0 if X <= A or X > B else 1)\n    raise SystemError if not A < X <= B else ZeroDivisionError",
    "bad = next((True for x in [X] if A < x <= B), False)",
    "def steps():\n    yield X > A\n    yield X > B\nbad = list(steps()) == [True, False]",
    "bad = functools.reduce(lambda n, c: n + (X > c), (A, B), 0) == 1",
    "bad = len([c for c in (A, B) if c < X]) == 1",
    "bad = next(itertools.compress('nyn', [X <= A, A < X <= B, X > B])) == 'y'",
    "bad = list(itertools.takewhile(lambda c: c < X, (A, B))) == [A]",
    "bad = operator.and_(operator.gt(X, A), operator.le(X, B))",
    "bad = functools.partial(operator.lt, A)(X) and functools.partial(operator.ge, B)(X)",
    "low, high = -X >= -A, -X < -B\nbad = not low and not high",
    "bad = X - A > 0 and X - B <= 0",
    "bad = 0 < X - A <= B - A",
    "bad = X * 2 > A * 2 and X * 2 <= B * 2",
    "bad = abs(X - (A + B) / 2) <= (B - A) / 2 and X > A",
    "bad = heapq.nsmallest(1, [X, B])[0] == X and X > A",
    "def climb(x, cs):\n    return 0 if not cs or x <= cs[0] else 1 + climb(x, cs[1:])\nbad = climb(X, [A, B]) == 1",
    "x = X\nx -= A\nbad = 0 < x <= B - A",
    "kinds = {True: 'over', False: 'under'}\nbad = kinds[X > A] == 'over' and kinds[X > B] == 'under'",
    "class Level(enum.IntEnum):\n    LOW = 0\n    MID = 1\n    HIGH = 2\nbad = Level((X > A) + (X > B)) is Level.MID",
    "bad = 'lmh'[(X > A) + (X > B)] == 'm'",
    "bad = (X > A) & ~(X > B) == 1",
    "bad = divmod((X > A) + (X > B), 2)[1] == 1",
    "bad = bool(X > A and not X > B)",
    "def deep(n):\n    return A < X <= B if n == 0 else deep(n - 1)\nbad = deep(5)",
    "bad = max([(X > A, 'a'), (X > B, 'b')])[1] == 'a' and X > A",
    "bad = not min(X > A, not X > B) == False",
)  # fmt: skip

# Further shapes with whole numbers: each true somewhere, K a whole number.
POINTS = (
    "bad = X == K",
    "bad = int(X) == K",
    "bad = math.floor(X) == K and X != K",
    "bad = round(X) == K",
    "bad = X // 7 == K // 7",
    "bad = int(X / 3) == K // 3",
    "bad = K - X == 0",
    "bad = X * 3 == K * 3",
    "bad = X in (K, K + 1)",
    "bad = X in {K}",
    "bad = {K: True}.get(X, False)",
    "bad = [K].count(X) == 1",
    "match X:\n    case K:\n        bad = True",
    "bad = X in range(K, K + 1)",
    "bad = math.trunc(X) % 1000 == K % 1000",
    "bad = int(X) & 1023 == K & 1023",
    "bad = int(X) == K and X.is_integer()",
    "bad = math.isclose(X, K)",
    "bad = X ** 2 == K ** 2",
    "bad = math.sqrt(X) == math.sqrt(K)",
    "bad = hash(X) == K",
    "bad = str(X) == 'K.0'",
    "bad = f'{X:.0f}' == 'K'",
    "bad = float(K) == X",
    "bad = (int(X) >> 3 == K >> 3) and int(X) == K",
    "bad = X + K == 2 * K",
    "bad = (X >= K) and not (X > K)",
    "bad = complex(X) == K",
    "bad = fractions.Fraction(K) == X",
    "bad = Decimal(K) == X",
    "bad = np.float64(K) == X",
    "bad = np.isclose(X, K)",
    "bad = bool(np.equal(X, K))",
    "bad = int(X).bit_length() == K.bit_length()",
    "bad = X.__eq__(K)",
    "bad = float.__eq__(X, float(K))",
    "bad = X.__class__(K) == X",
    "bad = type(X)(K) == X",
    "bad = sum([X, -K]) == 0",
    "bad = statistics.median([X, X, X]) == K",
    "bad = X % 5 == K % 5",
    "bad = not X - K",
    "bad = {float(K)} == {X}",
    "bad = {X: 1}.keys() == {K: 1}.keys()",
    "bad = collections.Counter([X])[K] == 1",
    "bad = operator.countOf([X], K) == 1",
    "bad = bytes([int(X) == K]) == b'\\x01'",
    "bad = -X == -K and +X == K",
)  # fmt: skip


def whole(draw: Random) -> str:
    """A fault behind whole-number constants."""
    if draw.random() < 0.7:
        x = draw.choice([*WHOLE_INPUTS, "soc"])
        if x == "soc":
            a, b = draw.choice([("0", "1"), ("0", "0.001"), ("0.999999", "1"), ("-1", "0")])
        else:
            low, high = WHOLE_INPUTS[x]
            a = draw.randrange(low, high)
            a, b = str(a), str(a + draw.choice([1, 1, 2, 3, 10]))
        return source(filled(draw.choice(BETWEEN), x, a, b))
    x = draw.choice(list(WHOLE_INPUTS))
    k = draw.randrange(1, min(3000, WHOLE_INPUTS[x][1]))
    return source(filled(draw.choice(POINTS), x, k=str(k)))


def sliver(draw: Random) -> str:
    """A fault in a few floats, however it is written."""
    x = draw.choice(SHARE_INPUTS)
    a = draw.choice([0.1, 0.123, 0.25, 0.4, 0.6, 0.777, 0.9])
    b = a + draw.choice([1e-3, 1e-6, 1e-9, 2e-16])
    return source(filled(draw.choice(BETWEEN), x, repr(a), repr(b)))


def unreached(draw: Random) -> str:
    """No fault: the same shapes beyond what an input can be."""
    x = draw.choice([*WHOLE_INPUTS, *SHARE_INPUTS])
    top = 1 if x in SHARE_INPUTS else 2**32 if "age" in x else 100000
    a, b = draw.choice([(top, top + 5), (top + 1, top + 2), (-5, -1), (-2, -0.5)])
    if draw.random() < 0.3 and "age" not in x:
        return source(filled(draw.choice(POINTS), x, k=str(top + draw.randrange(1, 50))))
    return source(filled(draw.choice(BETWEEN), x, str(a), str(b)))


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


def filled(text: str, x: str, a: str = "", b: str = "", k: str = "") -> str:
    for letter, value in (("X", x), ("A", a), ("B", b), ("K", k)):
        text = _word(text, letter, value)
    return text


def _word(text: str, letter: str, value: str) -> str:
    # A letter is a placeholder where no letter, digit or underscore is beside it.
    result, rest = "", text
    while letter in rest:
        at = rest.index(letter)
        before, after = (result + rest[:at])[-1:], rest[at + 1 : at + 2]
        alone = not (before.isalnum() or before == "_") and not (after.isalnum() or after == "_")
        result += rest[:at] + (value if alone else letter)
        rest = rest[at + 1 :]
    return result + rest
