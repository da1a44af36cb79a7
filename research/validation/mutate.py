"""Mutation testing of the files that decide figures: small changes of code, one at a time, that a test must notice.

    make mutate                                       a sample of every room, in a quarter of an hour or two
    python -m research.validation.mutate --room fleet --sample 0        every change of one room, hours

The changes are those of cosmic-ray's operators: another operator, comparison or number, a condition turned round, a loop
that ends at once. cosmic-ray's own runner changes the files in place and gives all of them one test command. Here the
changes are made in a copy of the tree, each room has its own tests, and a sample is drawn (`--seed`). Changes without a
meaning are left out: those of annotations, of assertions and of caches. So are bitwise operators, which any test notices.

It prints the survival rate by room, and each survivor with its line. CONTRIBUTING.md explains those that are left.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
QUICK = ("-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--tb=line", "--no-header")
LEFT_OUT = (".git", ".venv*", "runs", "docs", "notebooks", "*.egg-info", ".mypy_cache", ".ruff_cache", ".pytest_cache")
CACHES = {"lru_cache", "cache", "cached_property"}
LOUD = ("BitOr", "BitAnd", "BitXor", "Shift")
"""Operators of whole numbers, which fail on the first float that they meet: a test that runs the line notices them."""
SLOWER = 10.0
"""A change after which the tests take so many times as long as without is noticed: it hangs."""


class Room(NamedTuple):
    """Files that decide figures, and the tests that must notice a change of them."""

    files: tuple[str, ...]
    tests: tuple[str, ...]


ROOMS = {
    "scenarios": Room(("scenarios/intervals.py", "scenarios/disc.py", "scenarios/link_state.py"), ("tests/scenarios",)),
    "radio": Room(
        ("radio/rates.py", "radio/goodput.py", "radio/relay.py", "radio/channel/snr.py", "radio/channel/pathloss.py"),
        ("tests/radio",),
    ),
    "fleet": Room(
        ("fleet/energy/battery.py", "fleet/energy/cell.py", "policies/staleness.py", "fleet/trust.py", "fleet/standings.py", "fleet/memory.py"),
        ("tests/fleet/energy", "tests/fleet/flight", *(f"tests/fleet/test_fleet_{t}.py" for t in (
            "clock", "computer", "joints", "plane", "probes", "trust"
        ))),
    ),
    "policies": Room(
        ("policies/damping.py", *(f"policies/catalogue/{f}.py" for f in (
            "worked", "deputies", "adaptive", "baselines", "vantage", "freshness"
        ))),
        ("tests/policies/catalogue", "tests/policies/test_policies_damping.py", "tests/policies/test_policies_joints.py"),
    ),
    "perception": Room(
        ("perception/metrics/ap.py", "perception/joining.py", "perception/lateness.py", "perception/budget.py",
         "perception/surrogate/draws.py"),
        ("tests/perception/metrics", "tests/perception/surrogate", *(f"tests/perception/test_perception_{t}.py" for t in (
            "budget", "joining", "joints", "lateness"
        ))),
    ),
    "sim": Room(
        ("sim/results/outcome.py", "sim/results/mission_outcome.py", "sim/results/regions.py", "sim/engine/scoring.py", "sim/engine/fusing.py"),
        ("tests/sim/results", "tests/sim/engine/test_sim_joints.py", "tests/sim/engine/test_sim_scoring_times.py", "tests/sim/engine/test_sim_fusing.py", "tests/sim/engine/test_sim_engine_handover_joints.py"),
    ),
}  # fmt: skip


class Change(NamedTuple):
    """One change of one file."""

    file: str
    text: str
    """The whole file after it."""

    def where(self, before: str) -> str:
        """`FILE:LINE: old → new` of the first line that differs."""
        pairs = zip(before.splitlines(), self.text.splitlines(), strict=False)
        for number, (old, new) in enumerate(pairs, start=1):
            if old != new:
                return f"{self.file}:{number}: {old.strip()}  →  {new.strip()}"
        return f"{self.file}: lines are gone"


def meaning(text: str) -> str:
    """A file's syntax tree as text, without what no run can notice: annotations, assertions, caches and docstrings."""

    class Strip(ast.NodeTransformer):
        def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
            node.annotation = ast.Constant(None)
            return self.generic_visit(node)

        def visit_arg(self, node: ast.arg) -> ast.AST:
            node.annotation = None
            return node

        def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
            node.returns = None
            node.decorator_list = [d for d in node.decorator_list if not CACHES & {n.id for n in ast.walk(d) if isinstance(n, ast.Name)}]  # fmt: skip
            return self.generic_visit(node)

        def visit_Assert(self, node: ast.Assert) -> ast.AST:
            return ast.Pass()

        def visit_Expr(self, node: ast.Expr) -> ast.AST:
            return ast.Pass() if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    return ast.dump(Strip().visit(ast.parse(text)))


Place = tuple[str, str, int]
"""A file, an operator of cosmic-ray, and which of the places in the file that it can change."""


def places(file: str, text: str) -> list[Place]:
    """Every place of a file that an operator can change, also those without a meaning."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    nodes, found = list(ast_nodes(get_ast(text))), []
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if not kind.arguments() and not any(word in name for word in LOUD):
            operator = kind()
            count = sum(1 for node in nodes for _ in operator.mutation_positions(node))
            found += [(file, name, k) for k in range(count)]
    return found


def changed(text: str, place: Place) -> Change | None:
    """The file's text with one place changed; None where that has no meaning."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    file, name, k = place
    new = mutate_code(text, get_operator(name)(), k)
    try:
        return None if new is None or meaning(new) == meaning(text) else Change(file, new)
    except SyntaxError:
        return None


def drawn(texts: dict[str, str], sample: int, seed: str) -> Iterator[Change]:
    """So many changes with a meaning, in a random order; 0: every one."""
    every = [place for file, text in texts.items() for place in places(file, text)]
    random.Random(seed).shuffle(every)
    known, count = set(texts.values()), 0
    for place in every:
        change = changed(texts[place[0]], place)
        if change is not None and change.text not in known:
            known.add(change.text)
            yield change
            count += 1
            if count == sample:
                return


def run(tree: Path, tests: Sequence[str], limit_s: float | None = None) -> bool:
    """Whether the tests pass in a copy of the tree; False where they do not end."""
    env = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", *QUICK, *tests]
    process = subprocess.Popen(
        command, cwd=tree, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        return process.wait(limit_s) == 0
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)
        process.wait()
        return False


def survivors(tree: Path, name: str, room: Room, sample: int, seed: int) -> tuple[int, list[str]]:
    """How many changes of a room were tried, and those that no test noticed.

    Raises:
        SystemExit: its tests fail without any change.
    """
    texts = {file: (tree / file).read_text("utf-8") for file in room.files}
    begin_s = time.monotonic()
    if not run(tree, room.tests):
        raise SystemExit(f"{name}: its tests fail without any change; see pytest {' '.join(room.tests)}")
    limit_s = SLOWER * (time.monotonic() - begin_s) + 60.0
    tried, left = 0, []
    for change in drawn(texts, sample, f"{seed}/{name}"):
        path = tree / change.file
        path.write_text(change.text, "utf-8")
        passed = run(tree, room.tests, limit_s)
        path.write_text(texts[change.file], "utf-8")
        where, tried = change.where(texts[change.file]), tried + 1
        if passed:
            left.append(where)
        write(f"{name} {tried}: {'SURVIVED' if passed else 'noticed'}  {where}")
    return tried, left


def write(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def table(results: dict[str, tuple[int, list[str]]]) -> list[str]:
    """The survival rate by room, as Markdown."""
    rows = ["| room | changes | survived | share |", "|---|---|---|---|"]
    for name, (tried, left) in results.items():
        share = f"{len(left) / tried:.0%}" if tried else "–"
        rows.append(f"| {name} | {tried} | {len(left)} | {share} |")
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--room", action="append", choices=ROOMS, help="a room; more than once for several; left out, all"
    )
    parser.add_argument("--sample", type=int, default=15, help="changes a room; 0 takes every one")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    asked = parser.parse_args(arguments)
    results = {}
    with tempfile.TemporaryDirectory(prefix="sortie-mutate-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
        for name in asked.room or ROOMS:
            results[name] = survivors(tree, name, ROOMS[name], asked.sample, asked.seed)
    for name, (_, left) in results.items():
        for where in left:
            write(f"survived in {name}: {where}")
    for line in table(results):
        write(line)


if __name__ == "__main__":
    main()
