"""Why a policy cannot be proved, in words that help: what combines what, and how to make it provable."""

from __future__ import annotations

_ADVICE = (
    ("combines", "compare each input with constants, or let z3 follow sums, products and comparisons"),
    ("compares or combines", "use plain numbers of Python in thresholds"),
    ("not plain Python", "keep to the Python that a proof follows (policies/README.md, \"Plain Python\")"),
    ("in a chain of comparisons", "write the parts with `and`"),
    ("hands on ", "call it in a function or a lambda of your own"),
    ("by a call", "decorate a function or a class where it is defined"),
    ("within a function", "import it at the top of the file"),
    ("writes text with", "use an f-string"),
    ("the order of a set", "go through sorted(…) of it"),
    ("are the same (`is`)", "compare ids or values with =="),
    ("makes a view of its own", "decide from the given view"),
    ("_replace of a FleetView", "decide from the given view"),
    ("derives ", "derive classes from nothing, from NamedTuple or from Enum"),
    ("without peers_by_overlap", "rank the peers with peers_by_overlap"),
    ("uses the text of", "put numbers into the reason alone"),
    ("is not a policy of Sortie", "verify it as file.py:function"),
    ("remembers", "decide from the view alone; damping keeps what was decided before"),
    ("changes the global", "decide from the view alone, and keep functions that change globals in another file"),
    ("so closely", "compare sums and products with < or >, not with =="),
    ("what another decorator", "use this decorator alone, or at the top of the file"),
    ("identity", "compare values with =="),
    ("with sum(…)", "use sortie.scenarios.plain_sum.plain_sum, which rounds alike in every Python"),
    ("keeps results", "leave the cache away"),
    ("for more than arithmetic", "use comparisons, + - * / with constants, min, max, int, floor, ceil or sqrt"),
    ("not in its view", "decide from the view alone"),
    ("calls ", "leave this call away, wherever it is in the file; Python's own functions and math can be followed"),
    ("cannot be searched", "decide by the fields that a proof covers"),
)  # fmt: skip


def advise(why: str) -> str:
    """What a search met, and what would make the policy provable."""
    hint = next((f". To make it provable: {text}" for part, text in _ADVICE if part in why), "")
    return f"Cannot analyse: it {why}{hint}"
