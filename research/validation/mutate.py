"""Mutation testing of the code that decides figures: small changes, one at a time, that a test must notice.

    make mutate                                                    80 changes over all rooms, hours; it can be resumed
    python -m research.validation.mutate --suite OTHER --log L     the same changes, with the tests of another checkout
    python -m research.validation.mutate --pairs OLD NEW           two logs side by side

The changes are those of cosmic-ray's operators: another operator, comparison or number, a condition turned round, a loop
that ends at once. cosmic-ray's own runner changes the files in place and gives all of them one test command. Here the
changes are made in a copy of the tree, and a sample is drawn (`--seed`): each room gives as many, each file in proportion
to its places. Changes without a meaning are left out: those of annotations, of assertions and of caches. So are bitwise
operators, which any test notices.

A change is first tried with the tests of its own folder, then with those of its room, then with the whole short suite, and
each ends at the first test that fails. A line of the log has the change, and the test that noticed it.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
QUICK = (
    "-n0",
    "-x",
    "-q",
    "-m",
    "not slow and not pages",
    "-p",
    "no:cacheprovider",
    "--tb=line",
    "--no-header",
    "-W",
    "ignore::ResourceWarning",
)
CACHES = {"lru_cache", "cache", "cached_property"}
LOUD = ("BitOr", "BitAnd", "BitXor", "Shift")
"""Operators of whole numbers, which fail on the first float that they meet: a test that runs the line notices them."""
STAGES = 3
"""A change is tried with the tests of its own folder, of its room, and with all others."""
LIMIT_S = 3600.0
"""A change after which the tests of one folder take so long is noticed: it hangs."""
SEED = "57"
CHANGES = 80

ROOMS: dict[str, tuple[str, ...]] = {
    "scenarios": ("intervals.py", "disc.py", "link_state.py", "formation.py", "control_variates.py", "streams.py", "schema/*.py"),
    "radio": ("*.py", "channel/*.py", "mac/*.py"),
    "fleet": ("*.py", "energy/*.py", "flight/*.py", "messages/*.py"),
    "policies": ("*.py", "catalogue/*.py", "catalogue/prior/*.py"),
    "perception": ("*.py", "metrics/*.py", "network/*.py", "network/fusion/*.py", "scene/*.py", "surrogate/*.py", "tracking/*.py"),
    "sim": ("engine/*.py", "results/*outcome*.py", "results/accuracy.py", "results/transitions.py", "results/regions.py", "results/disagreement.py",
            "results/traffic.py", "results/link_traffic.py", "campaign/spread.py", "campaign/rows.py", "campaign/sensitivity.py"),
}  # fmt: skip
"""The files of each room that decide figures: not its reading, errors, pages and command line."""


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


def files(tree: Path, room: str) -> dict[str, str]:
    """The texts of a room's files that decide figures, by their paths in the tree."""
    found = sorted({path for pattern in ROOMS[room] for path in (tree / room).glob(pattern)})
    return {str(path.relative_to(tree)): path.read_text("utf-8") for path in found}


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


def stages(tree: Path, file: str) -> list[list[str]]:
    """The tests that a change of a file is tried with, one stage after the other: its folder's, its room's, all others."""
    folder, room = Path(file).parent, Path(file).parts[0]
    own = folder if (tree / "tests" / folder).is_dir() else Path(room)
    inner = [f"--ignore=tests/{own.as_posix()}"]
    return [
        [f"tests/{own.as_posix()}"],
        [f"tests/{room}", *inner] if own != Path(room) else [],
        ["tests", *inner, f"--ignore=tests/{room}"],
    ]


FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


def noticed_by(tree: Path, tests: Sequence[str]) -> str | None:
    """The first test that fails in a copy of the tree; None where all pass, or there are none."""
    if not tests:
        return None
    env = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", *QUICK, *tests]
    process = subprocess.Popen(
        command, cwd=tree, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    try:
        text, _ = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)
        process.communicate()
        return "no end"
    if process.returncode in {0, 5}:  # 5: a folder without tests of its own
        return None
    first = FAILED.search(text)
    return first[1] if first else text.strip().splitlines()[-1]


def tried(tree: Path, change: Change, first: int, until: int) -> str | None:
    """The test of some stages that notices a change, None if it survives. The file is as before afterwards, its time too."""
    path = tree / change.file
    before, stat = path.read_bytes(), path.stat()
    path.write_text(change.text, "utf-8")
    try:
        return next((by for tests in stages(tree, change.file)[first:until] if (by := noticed_by(tree, tests))), None)
    finally:
        path.write_bytes(before)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # compiled loops are kept by it


def copy(suite: Path, tree: Path) -> None:
    """The tree of the product that is here, with the tests of a checkout."""
    left_out = (".git", ".venv*", "runs", "build", "*.egg-info", ".mypy_cache", ".ruff_cache", ".pytest_cache")
    shutil.copytree(ROOT, tree, symlinks=True, ignore=shutil.ignore_patterns(*left_out))
    if suite != ROOT:
        shutil.rmtree(tree / "tests")
        shutil.copytree(suite / "tests", tree / "tests", symlinks=True)


def measure(
    suite: Path, log: Path, sample: int, seed: str, rooms: Sequence[str], workers: int, until: int = STAGES
) -> None:
    """Try every drawn change, and write a line for each; what the log has of it already is not tried again."""
    known = {row["change"]: row for row in read(log)}
    todo: list[tuple[str, str, Change, int]] = []
    for k, room in enumerate(ROOMS):
        texts = files(ROOT, room)
        count = sample // len(ROOMS) + (k < sample % len(ROOMS))
        for change in drawn(texts, count, f"{seed}/{room}") if room in rooms else ():
            where = change.where(texts[change.file])
            row = known.get(where)
            first = 0 if row is None else row["stages"] if row["by"] is None else STAGES
            if first < until:
                todo.append((room, where, change, first))
    trees: list[Path] = []
    lock, own = threading.Lock(), threading.local()

    def one(job: tuple[str, str, Change, int]) -> None:
        room, where, change, first = job
        if not hasattr(own, "tree"):
            with lock:
                own.tree = trees.pop()
        by = tried(own.tree, change, first, until)
        with lock, log.open("a", encoding="utf-8") as lines:
            lines.write(
                json.dumps({"room": room, "change": where, "by": by, "stages": until}, ensure_ascii=False) + "\n"
            )
            sys.stdout.write(f"{room}: {'SURVIVED' if by is None else by}  {where}\n")
            sys.stdout.flush()

    with tempfile.TemporaryDirectory(prefix="sortie-mutate-") as folder:
        for k in range(workers):
            copy(suite, Path(folder) / f"tree{k}")
            trees.append(Path(folder) / f"tree{k}")
        with ThreadPoolExecutor(workers) as pool:
            for _ in pool.map(one, todo):
                pass


def read(log: Path) -> list[dict[str, Any]]:
    """The last line of each change in a log; none if it is not there yet."""
    rows = [json.loads(line) for line in log.read_text("utf-8").splitlines()] if log.exists() else []
    return list({row["change"]: row for row in rows}.values())


def table(logs: Sequence[list[dict[str, Any]]]) -> list[str]:
    """Survivors by room in each log, as Markdown."""
    rows = ["| room | changes |" + " survived |" * len(logs), "|---|---|" + "---|" * len(logs)]
    for room in (*ROOMS, "all"):
        of = [[row for row in log if room in {"all", row["room"]}] for log in logs]
        rows.append(f"| {room} | {len(of[0])} | " + " | ".join(f"{sum(r['by'] is None for r in o)}" for o in of) + " |")
    return rows


def differing(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[str]:
    """A line for each change that only one of two logs noticed."""
    before = {row["change"]: row["by"] for row in old}
    lines = []
    for row in new:
        change, by = row["change"], row["by"]
        if change in before and (before[change] is None) != (by is None):
            lines.append(f"{'no longer noticed' if by is None else 'now noticed'}: {change}, by {by or before[change]}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--room", action="append", choices=ROOMS, help="a room; more than once for several; left out, all"
    )
    parser.add_argument("--sample", type=int, default=CHANGES, help="changes over all rooms; 0 takes every one")
    parser.add_argument("--seed", default=SEED, help="of the sample")
    parser.add_argument("--suite", type=Path, default=ROOT, help="a checkout whose tests are run")
    parser.add_argument(
        "--log", type=Path, default=Path("runs/mutate.jsonl"), help="what was tried; a later call goes on"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="changes that are tried at once")
    parser.add_argument(
        "--stages", type=int, choices=(1, 2, 3), default=STAGES, help="1: the tests of its folder; 2: of its room too"
    )
    parser.add_argument("--pairs", type=Path, nargs=2, metavar=("OLD", "NEW"), help="compare two logs, and run nothing")
    asked = parser.parse_args(arguments)
    if asked.pairs:
        old, new = (read(log) for log in asked.pairs)
        lines = [*table([old, new]), *differing(old, new)]
    else:
        asked.log.parent.mkdir(parents=True, exist_ok=True)
        measure(
            asked.suite, asked.log, asked.sample, asked.seed, asked.room or tuple(ROOMS), asked.workers, asked.stages
        )
        log = read(asked.log)
        lines = [*table([log]), *(f"survived in {row['room']}: {row['change']}" for row in log if row["by"] is None)]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
