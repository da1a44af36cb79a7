"""The way through the rooms: who may import whom, where a library is at home, and what no room does.

`violations` reads one file's syntax tree; the tests run it over every file, and over small planted
sources to show that each rule can fail.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from pathlib import Path

import networkx as nx

ROOT = Path(__file__).resolve().parent.parent

MAY_IMPORT = {
    "sim": {"fleet", "radio", "policies", "perception", "scenarios"},
    "fleet": {"radio", "policies", "perception", "scenarios"},
    "radio": {"scenarios"},
    "policies": {"scenarios"},
    "perception": {"scenarios"},
    "scenarios": set(),
}
"""sim → fleet → radio | policies | perception → scenarios; the three middle rooms do not know each other."""

HOMES = {
    "simpy": ("sim/*", "fleet/agent.py", "radio/mac/medium.py", "radio/air.py", "radio/event_loop.py"),
    "torch": ("perception/*",),
    "rerun": ("sim/playback/*",),
    "pymavlink": ("fleet/logs/ground_station.py", "fleet/logs/mavlink.py", "fleet/logs/tlog.py"),
    "yaml": ("scenarios/reading/strict_yaml.py", "scenarios/reading/top_keys.py"),
    "jinja2": ("sim/results/blocks.py",),
    "distributed": ("sim/experiment/cluster.py",),
    "dask": ("sim/experiment/cluster.py",),
    "SALib": ("sim/experiment/*",),
    "cyclonedds": ("sim/live/*",),
}
"""Third-party libraries with one home each."""

NOT_IMPORTED = {"pickle", "dill", "cloudpickle", "shelve", "marshal"}
NOT_CALLED = {"print", "eval", "exec"}


def violations(source: str, path: str) -> list[str]:
    """What a file does against the rules, as `path:line: what`; `path` is relative to the root."""
    room = path.partition("/")[0]
    found = []
    for node in ast.walk(ast.parse(source)):
        for name in _imported(node):
            top, _, rest = name.partition(".")
            other = rest.partition(".")[0]
            if top in MAY_IMPORT:
                found.append((node, f"import sortie.{top}, never {top} alone"))
            if top == "sortie" and other in MAY_IMPORT and other != room and other not in MAY_IMPORT[room]:
                found.append((node, f"{room} must not import {other}"))
            if top == "sortie" and other not in MAY_IMPORT and not path.startswith("sim/cli/"):
                found.append((node, f"{room} must not import the public API, which stands on it"))
            if room == "radio" and name.startswith("sortie.scenarios.schema"):
                found.append((node, "radio takes plain values, not a section of the schema"))
            if top == "tests":
                found.append((node, f"{room} must not import tests"))
            if top in HOMES and not any(fnmatch(path, home) for home in HOMES[top]):
                found.append((node, f"{top} is at home in {', '.join(HOMES[top])}"))
            if top == "research":
                found.append((node, f"{room} must not import research, which stands outside the product"))
            if top in NOT_IMPORTED:
                found.append((node, f"{top} is not used: it runs what it reads"))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in NOT_CALLED:
            found.append((node, f"{node.func.id}() is not called in a room"))
    return [f"{path}:{getattr(node, 'lineno', 0)}: {what}" for node, what in found]


def _imported(node: ast.AST) -> Iterator[str]:
    """Modules that a node imports, by statement or by name, wherever it stands."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):  # relative ones are ruff's to refuse
        named = node.module in (None, "sortie")
        yield from (f"sortie.{alias.name}" for alias in node.names) if named else [node.module or ""]
    elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if called in ("import_module", "__import__", "find_spec", "importorskip") and isinstance(
            node.args[0].value, str
        ):
            yield node.args[0].value


FILES = sorted(path.relative_to(ROOT).as_posix() for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py"))


def circles(arrows: Mapping[str, set[str]]) -> list[list[str]]:
    """Names that reach one another along the arrows, group by group; empty where imports run one way."""
    graph = nx.DiGraph((a, b) for a, targets in arrows.items() for b in targets)
    return sorted(sorted(group) for group in nx.strongly_connected_components(graph) if len(group) > 1)


def arrows_within(package: Path) -> dict[str, set[str]]:
    """Which entries of a package (files and folders) import which of their siblings."""
    prefix = ".".join(("sortie", *package.relative_to(ROOT).parts)) + "."
    siblings = {path.stem for path in package.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    found: dict[str, set[str]] = {}
    for path in package.rglob("*.py"):
        own = path.relative_to(package).parts[0].removesuffix(".py")
        parts = {name.removeprefix(prefix).partition(".")[0] for name in names_in(path) if name.startswith(prefix)}
        found.setdefault(own, set()).update((parts & siblings) - {own})
    return found


@functools.cache
def names_in(path: Path) -> set[str]:
    """Everything that a file imports, each name of a `from` statement with its module."""
    found = set[str]()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        found.update(_imported(node))
        if isinstance(node, ast.ImportFrom):
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


PACKAGES = sorted(
    path.parent.relative_to(ROOT).as_posix() for room in MAY_IMPORT for path in (ROOT / room).rglob("__init__.py")
)


def test_imports_within_a_package_run_one_way() -> None:
    """No file or folder imports a sibling that imports it, directly or by way of others."""
    assert {package: found for package in PACKAGES if (found := circles(arrows_within(ROOT / package)))} == {}


def test_a_planted_circle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}) == [["a", "b", "c"]]


def test_every_file_keeps_to_the_rules() -> None:
    assert {path.partition("/")[0] for path in FILES} == set(MAY_IMPORT)
    assert [line for path in FILES for line in violations((ROOT / path).read_text("utf-8"), path)] == []


def internals_of(source: str) -> set[str]:
    """The modules of `sortie` that a file imports beyond the public API."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        names = list(_imported(node))
        if isinstance(node, ast.ImportFrom):
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
            inner = [name for name in modules if _is_module(name)]
            names = inner + (names if len(inner) < len(modules) else [])
        found |= {name for name in names if name.startswith("sortie.") and _is_module(name)}
    return found


def _is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def test_the_laboratory_uses_the_internals_that_it_lists() -> None:
    """`research/internals.txt` has a module a line: whoever changes one of them looks into `research` as well."""
    files = [path for path in (ROOT / "research").rglob("*.py") if path.relative_to(ROOT).parts[1] != "tests"]
    used = set[str]().union(*(internals_of(path.read_text("utf-8")) for path in files))
    listed = (ROOT / "research" / "internals.txt").read_text("utf-8").splitlines()
    assert listed == sorted(listed)
    assert used == set(listed)


def test_internals_are_found_wherever_they_are_imported() -> None:
    source = (
        "import sortie\nfrom sortie import Scenario\nfrom sortie.fleet import coverage\nfrom sortie.radio import Air"
    )
    assert internals_of(source) == {"sortie.fleet.coverage", "sortie.radio"}
    assert internals_of("def f():\n    from sortie.sim.folders import RunError") == {"sortie.sim.folders"}


def test_every_package_at_the_root_is_a_room() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages == {*MAY_IMPORT, "sortie", "research"}
    assert {path.name: str(path.readlink()) for path in (ROOT / "sortie").iterdir() if path.is_symlink()} == {
        room: f"../{room}" for room in MAY_IMPORT
    }


FORBIDDEN = [
    ("radio/rates.py", "import sortie.fleet", "radio must not import fleet"),
    ("radio/rates.py", "from sortie.policies.contract import Disc", "radio must not import policies"),
    ("radio/air.py", "from sortie.scenarios.schema import Radio", "radio takes plain values, not a section"),
    ("policies/catalogue/worked.py", "from sortie.perception import ap", "policies must not import perception"),
    ("scenarios/reading/load.py", "import sortie.policies", "scenarios must not import policies"),
    ("fleet/agent.py", "import numpy, sortie.sim.results.record", "fleet must not import sim"),
    ("fleet/agent.py", "def f():\n    from sortie.sim import record", "fleet must not import sim"),
    ("fleet/agent.py", "if TYPE_CHECKING:\n    import sortie.sim", "fleet must not import sim"),
    ("fleet/agent.py", "from sortie import sim", "fleet must not import sim"),
    ("fleet/agent.py", "importlib.import_module('sortie.sim.results.record')", "fleet must not import sim"),
    ("fleet/agent.py", "__import__('sortie.sim')", "fleet must not import sim"),
    ("fleet/agent.py", "from sim import record", "import sortie.sim, never sim alone"),
    ("radio/air.py", "import sortie", "radio must not import the public API"),
    ("sim/engine/sortie.py", "import tests.helpers", "sim must not import tests"),
    ("fleet/flight/motion.py", "import simpy", "simpy is at home in sim/*, fleet/agent.py"),
    ("sim/engine/sortie.py", "from torch import nn", "torch is at home in perception/*"),
    ("sim/engine/sortie.py", "import rerun as rr", "rerun is at home in sim/playback/*"),
    ("scenarios/reading/nodes.py", "import yaml", "yaml is at home in scenarios/reading/strict_yaml.py"),
    ("sim/experiment.py", "import pickle", "pickle is not used: it runs what it reads"),
    ("sim/cli/app.py", "def f():\n    from research.uav3d import convert", "sim must not import research"),
    ("sim/cli/app.py", "print('done')", "print() is not called in a room"),
    ("policies/registry.py", "f = eval(name)", "eval() is not called in a room"),
]
ALLOWED = [
    ("sim/engine/sortie.py", "import sortie.fleet, sortie.radio, sortie.policies, sortie.perception, simpy"),
    ("fleet/agent.py", "import sortie.radio, sortie.policies, sortie.perception, sortie.scenarios, simpy"),
    ("fleet/messages/wire.py", "from sortie.fleet.messages import cdr\nfrom sortie.fleet.messages.cdr import decode"),
    ("perception/network/model.py", "import torch\nmodel.eval()\nconsole.print(x)"),
    ("radio/air.py", "import simpy, numpy, simulator, yamlish"),
]


def test_planted_violations_are_found() -> None:
    for path, source, what in FORBIDDEN:
        found = violations(source, path)
        assert len(found) == 1, source
        assert found[0].startswith(f"{path}:{source.count(chr(10)) + 1}: {what}"), found


def test_what_is_allowed_is_not_found() -> None:
    assert [line for path, source in ALLOWED for line in violations(source, path)] == []
