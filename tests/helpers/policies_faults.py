"""Strategies for small policies with a planted fault, and for correct ones.

Each entry is a template with drawn constants, inputs and shapes. That a faulty one has a view which breaks the line is
known from how it is made. A correct one keeps the line on every view.
"""

from __future__ import annotations

from string import Template

from hypothesis import strategies as st
from policies_corpus import LINE, source

WHOLE_INPUTS = {"first": 99000, "me.goodput_to(view.peers[-1])": 99000, "view.age_s[view.peers[0]]": 3000}
"""Numbers with wholes inside their range, and up to where."""
SHARES = ("soc", "me.cpu_headroom", "me.gpu_headroom", "view.descriptors[view.peers[-1]].battery_soc")
"""Numbers of 0 … 1."""

BETWEEN = (
    "bad = $a < $x <= $b",
    "bad = not ($x <= $a or $x > $b)",
    "bad = ($x > $a) + ($x > $b) == 1",
    "bad = [False, True, False][($x > $a) + ($x > $b)]",
    "bad = min(max($x, $a), $b) == $x and $x != $a",
    "bad = sorted([$a, $x, $b])[1] == $x and $x != $a",
    "bad = sum($x > c for c in ($a, $b)) == 1",
    "bad = (lambda x: $a < x <= $b)($x)",
    "if $x <= $a:\n    pass\nelif $x <= $b:\n    bad = True",
    "for c, answer in (($a, False), ($b, True)):\n    if $x <= c:\n        bad = answer\n        break",
    "x = $x\nwhile x > $a:\n    bad = x <= $b\n    break",
    "def band(x, low=$a, high=$b):\n    return low < x <= high\nbad = band($x)",
    "def over(c):\n    return lambda x: x > c\nbad = over($a)($x) and not over($b)($x)",
    "bad = ($a, 9) < ($x, 0) and ($x, 0) <= ($b, 9) and $x != $a",
    "low, high = -$x >= -$a, -$x < -$b\nbad = not low and not high",
    "bad = $x * 2 > $a * 2 and $x * 2 <= $b * 2",
    "def climb(x, cs):\n    return 0 if not cs or x <= cs[0] else 1 + climb(x, cs[1:])\nbad = climb($x, [$a, $b]) == 1",
    "bad = max([($x > $a, 'a'), ($x > $b, 'b')])[1] == 'a' and $x > $a",
    "class Band:\n    def __contains__(self, x):\n        return $a < x <= $b\nbad = $x in Band()",
    "bad = functools.reduce(lambda n, c: n + ($x > c), ($a, $b), 0) == 1",
)
"""Each is true for x exactly in (a, b], in one way of writing it."""
POINTS = (
    "bad = $x == $k",
    "bad = round($x) == $k",
    "bad = $x // 7 == $k // 7",
    "bad = $x * 3 == $k * 3",
    "bad = $x in ($k, $k + 1)",
    "match $x:\n    case $k:\n        bad = True",
    "bad = ($x >= $k) and not ($x > $k)",
    "bad = -$x == -$k and +$x == $k",
    "bad = int($x) & 1023 == $k & 1023",
    "bad = np.float64($k) == $x",
)
"""Each is true somewhere, and nowhere but within 7 of the whole number k, or of k and all that differ by 1024."""
LARGE_FAULTS = (
    ("bad = len(view.peers) >= 11", LINE),
    ("bad = sum(1 for p in view.peers) // 40 >= 1", LINE),
    ("bad = view.full_sharing_maps in range(25, 250)", LINE),
    ("bad = view.ego == 90", LINE),
    ("bad = list(range(len(me.peer_goodput_mbps)))[18:] != []", LINE),
    ("try:\n    list(range(len(view.peers)))[16]\n    bad = True\nexcept IndexError:\n    pass", LINE),
    ("bad = False", "count_links(representation > none) <= 13"),
    ("bad = False", "sum_links(rate_hz) <= 30"),
    ("bad = False", "when peers >= 60: every_link(representation >= features)"),
    ("bad = len(view.peers) > 3000", LINE),
    ("bad = any(p > 4000 for p in view.peers)", LINE),
    ("bad = len(view.peers) == 777", LINE),
    ("bad = me.roster is not None and len(me.roster.members) < 60 < len(view.peers)", LINE),
)
"""Faults of fleets that are larger than those that are searched by default, up to the largest: a body and its line."""


def _filled(text: str, **values: object) -> str:
    return source(Template(text).substitute(values))


@st.composite
def whole_faults(draw: st.DrawFn) -> str:
    """A fault behind whole-number constants."""
    x = draw(st.sampled_from([*WHOLE_INPUTS, "soc"]))
    if x == "soc":
        a, b = draw(st.sampled_from([(0, 1), (0, 0.001), (0.999999, 1), (-1, 0)]))
        return _filled(draw(st.sampled_from(BETWEEN)), x=x, a=a, b=b)
    if draw(st.booleans()):
        a = draw(st.integers(0, WHOLE_INPUTS[x]))
        return _filled(draw(st.sampled_from(BETWEEN)), x=x, a=a, b=a + draw(st.sampled_from([1, 2, 3, 10])))
    return _filled(draw(st.sampled_from(POINTS)), x=x, k=draw(st.integers(1, 3000)))


@st.composite
def slivers(draw: st.DrawFn) -> str:
    """A fault in a few floats, however it is written."""
    a = draw(st.sampled_from([0.1, 0.123, 0.25, 0.4, 0.6, 0.777, 0.9]))
    b = a + draw(st.sampled_from([1e-3, 1e-6, 1e-9, 2e-16]))
    return _filled(draw(st.sampled_from(BETWEEN)), x=draw(st.sampled_from(SHARES)), a=a, b=b)


@st.composite
def unreached(draw: st.DrawFn) -> str:
    """No fault: the same shapes beyond what an input can be."""
    x = draw(st.sampled_from([*WHOLE_INPUTS, *SHARES]))
    top = 1 if x in SHARES else 2**32 if "age" in x else 100000
    a, b = draw(st.sampled_from([(top, top + 5), (top + 1, top + 2), (-5, -1), (-2, -0.5)]))
    return _filled(draw(st.sampled_from(BETWEEN)), x=x, a=a, b=b)
