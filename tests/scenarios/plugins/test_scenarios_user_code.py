"""A policy's file imports the modules beside it, two files never share them, and all of them are known by path."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import PolicyError
from sortie.policies.registry import describe_error, resolve
from sortie.scenarios.plugins.reference import code_files
from sortie.scenarios.plugins.user_code import imported_files, imported_packages, load

START = "from sortie.policies.contract import Directive, nothing\n"
DECIDE = "\ndef decide(view):\n    return [nothing(view.ego, p, {}) for p in view.peers]\n"
INSIDE = "\ndef decide(view):\n    {}\n    return [nothing(view.ego, p, why()) for p in view.peers]\n"


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def reason(folder: Path) -> str:
    return resolve(f"{folder / 'mine.py'}:decide")(fleet_of(2))[0].reason


def names(folder: Path) -> list[str]:
    return [path.relative_to(folder.resolve()).as_posix() for path in imported_files(folder / "mine.py")]


BESIDE = "WHY = 'beside'"
CLASS = "from __future__ import annotations\nfrom dataclasses import dataclass\n@dataclass\nclass Why:\n    text: str\n"
CIRCLE = "import helper\ndef why(): return 'beside' if helper.mine.decide else ''"
LATE, TO_MORE = "def why():\n    import second\n    return second.WHY", "from . import more\nWHY = more.WHY"
IMPORTS: list[tuple[str, str, dict[str, str]]] = [
    ("import helper", "helper.WHY", {"helper.py": BESIDE}),
    ("from helper import WHY", "WHY", {"helper.py": BESIDE}),
    ("from helper import *", "WHY", {"helper.py": BESIDE}),
    ("from . import helper", "helper.WHY", {"helper.py": BESIDE}),
    ("from .helper import WHY", "WHY", {"helper.py": BESIDE}),
    ("import helper", "helper.WHY", {"helper.py": "from second import WHY", "second.py": BESIDE}),
    (
        "import kit.deep.t",
        "kit.deep.t.WHY",
        {"kit/__init__.py": "", "kit/deep/__init__.py": "", "kit/deep/t.py": BESIDE},
    ),
    ("from kit import t", "t.WHY", {"kit/__init__.py": "", "kit/t.py": "from ..kit.m import WHY", "kit/m.py": BESIDE}),
    ("import kit.t", "kit.t.WHY", {"kit/__init__.py": "", "kit/t.py": TO_MORE, "kit/more.py": BESIDE}),
    ("import kit.t", "kit.t.WHY", {"kit/t.py": BESIDE}),  # a folder
    ("import sim, policies.t", "sim.WHY", {"sim.py": BESIDE, "policies/__init__.py": "", "policies/t.py": ""}),  # rooms
    (
        "import helper",
        "helper.why()",
        {"helper.py": "import mine, second\nwhy = lambda: second.why()", "second.py": CIRCLE},
    ),
    ("from helper import Why", "Why('beside').text", {"helper.py": CLASS}),
]
FORMS = [(head + DECIDE.format(why), files) for head, why, files in IMPORTS]
FORMS.append((INSIDE.format("from helper import why"), {"helper.py": "def why(): return 'beside'"}))
FORMS.append((INSIDE.format("from .helper import why"), {"helper.py": LATE, "second.py": BESIDE}))
"""The policy's text, and the files beside it."""


def test_a_policy_imports_what_is_beside_it(tmp_path: Path) -> None:
    for k, (source, files) in enumerate(FORMS):
        folder = write(tmp_path / f"form{k}", {"mine.py": START + source, **files})
        before, path = set(sys.modules), list(sys.path)
        assert reason(folder) == "beside", source
        assert sys.path == path
        left = {name for name in set(sys.modules) - before if not name.startswith(("sortie.", "sortie_user_"))}
        assert not left & {"mine", "helper", "second", "kit", "sim", "policies"}
        assert names(folder) == sorted(["mine.py", *files])
        assert not list(folder.rglob("__pycache__"))


@pytest.mark.parametrize("form", ["import helper", "from . import helper", "import helper as other; helper = other"])
def test_two_policies_keep_their_own_helpers(form: str, tmp_path: Path) -> None:
    late = INSIDE.format(f"{form}; why = helper.why")
    for name in ("one", "two"):
        write(tmp_path / name, {"mine.py": START + late, "helper.py": f"def why(): return '{name}'"})
    one, two = (resolve(f"{tmp_path}/{name}/mine.py:decide") for name in ("one", "two"))
    for _ in range(2):
        assert (one(fleet_of(2))[0].reason, two(fleet_of(2))[0].reason) == ("one", "two")


def test_each_resolving_reads_the_files_anew(tmp_path: Path) -> None:
    """Same size, same second: a compiled file beside it would not have noticed."""
    late = (
        "\ndef decide(view):\n    import helper, second\n    return [nothing(view.ego, 1, helper.WHY + second.WHY)]\n"
    )
    write(tmp_path, {"mine.py": START + "import helper" + late, "helper.py": "WHY = 'a'", "second.py": "WHY = 'x'"})
    assert reason(tmp_path) == "ax"
    write(tmp_path, {"helper.py": "WHY = 'b'", "second.py": "WHY = 'y'"})
    assert reason(tmp_path) == "by"


def test_python_and_sortie_come_first(tmp_path: Path) -> None:
    source = START + "import math\nimport numpy" + DECIDE.format("f'{math.pi:.2f} {numpy.ones(1)[0]:g}'")
    others = {"math.py": "pi = 4", "sortie/__init__.py": "raise RuntimeError", "numpy/data.txt": ""}
    write(tmp_path, {"mine.py": source, **others})
    assert reason(tmp_path) == "3.14 1"
    assert names(tmp_path) == ["mine.py"]


def test_what_was_loaded_counts_but_for_installed_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library of the user's own on the path does, and what only a function will import beside the file."""
    shop = {"__init__.py": "from .tools import a\n", "tools/__init__.py": "", "tools/a.py": "import cart"}
    write(tmp_path / "lib/shop", shop)
    write(tmp_path / "lib", {"cart.py": "", "unused.py": ""})
    write(tmp_path / "venv/site-packages", {"bought.py": ""})
    source = START + "import shop, bought, numpy, json" + INSIDE.format("from late import why")
    write(tmp_path / "own", {"mine.py": source, "late.py": "import later\ndef why(): return ''", "later.py": ""})
    write(tmp_path / "own", {"cart.py": "", "spare.py": ""})
    for folder in ("lib", "venv/site-packages"):
        monkeypatch.syspath_prepend(tmp_path / folder)
    importlib.invalidate_caches()
    resolve(f"{tmp_path}/own/mine.py:decide")
    loaded = ["cart.py", "shop/__init__.py", "shop/tools/__init__.py", "shop/tools/a.py"]
    found = [path.relative_to(tmp_path.resolve()).as_posix() for path in imported_files(tmp_path / "own/mine.py")]
    assert found == [*(f"lib/{name}" for name in loaded), "own/late.py", "own/later.py", "own/mine.py"]


def test_files_are_those_beside_the_file_and_packages_those_that_are_installed(tmp_path: Path) -> None:
    """A module beside a file hides the installed package of its name."""
    inner = {"pack/inner/__init__.py": "from .. import two\n", "pack/inner/deep.py": "from ..three import x\n"}
    plain = dict.fromkeys(
        ("pack/__init__.py", "pack/one.py", "pack/two.py", "pack/four.py", "sortie.py", "json.py"), ""
    )
    own = "from pack import one\nfrom pack.inner import deep\nimport sortie\nimport numpy\nimport json\n"
    write(tmp_path, {"own.py": own, "pack/three.py": "x = 1\n", **plain, **inner, "numpy/nothing.txt": ""})
    found = [path.relative_to(tmp_path.resolve()).as_posix() for path in code_files(tmp_path / "own.py")]
    pack = ["__init__.py", "inner/__init__.py", "inner/deep.py", "one.py", "three.py", "two.py"]
    assert found == ["own.py", *(f"pack/{name}" for name in pack)]
    path = write(tmp_path / "b", {"p.py": "import numpy\nimport yaml\n"}) / "p.py"
    load(path)
    assert imported_packages(path) == {"numpy", "PyYAML"}
    write(tmp_path / "b", {"yaml.py": ""})
    load(path)
    assert imported_packages(path) == {"numpy"}


def test_a_missing_module_and_a_helpers_error_are_named_with_their_line(tmp_path: Path) -> None:
    for form in ("import absent", "from . import absent", "from helper import absent"):
        write(tmp_path, {"mine.py": form, "helper.py": ""})
        words = r"does not load: (ModuleNotFound|Import)Error: .*absent.* \(mine\.py, line 1\)"
        with pytest.raises(PolicyError, match=words):
            resolve(f"{tmp_path}/mine.py:decide")
    source = START + "import helper" + DECIDE.format("helper.why()")
    write(tmp_path, {"mine.py": source, "helper.py": "def why():\n    return 1 / 0"})
    with pytest.raises(ZeroDivisionError) as caught:
        reason(tmp_path)
    assert describe_error(caught.value).endswith("(helper.py, line 2)")
