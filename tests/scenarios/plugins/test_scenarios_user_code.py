"""A policy's file imports the modules beside it, two files never share them, and all of them are known by path."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import PolicyError
from sortie.policies.registry import describe_error, resolve
from sortie.scenarios.plugins.user_code import imported_files

START = "from sortie.policies.contract import Directive, nothing\n"
DECIDE = "\ndef decide(view):\n    return [nothing(view.ego, p, {}) for p in view.peers]\n"


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def reason(folder: Path, file: str = "mine.py") -> str:
    return resolve(f"{folder / file}:decide")(fleet_of(2))[0].reason


def names(folder: Path, file: str = "mine.py") -> list[str]:
    return [path.relative_to(folder.resolve()).as_posix() for path in imported_files(folder / file)]


FORMS = {
    "a module": ("import helper" + DECIDE.format("helper.WHY"), {"helper.py": "WHY = 'beside'"}),
    "a name": ("from helper import WHY" + DECIDE.format("WHY"), {"helper.py": "WHY = 'beside'"}),
    "all names": ("from helper import *" + DECIDE.format("WHY"), {"helper.py": "WHY = 'beside'"}),
    "relative": ("from . import helper" + DECIDE.format("helper.WHY"), {"helper.py": "WHY = 'beside'"}),
    "a relative name": ("from .helper import WHY" + DECIDE.format("WHY"), {"helper.py": "WHY = 'beside'"}),
    "a helper's helper": (
        "import helper" + DECIDE.format("helper.WHY"),
        {"helper.py": "from second import WHY", "second.py": "WHY = 'beside'"},
    ),
    "a package": (
        "import kit.deep.texts as t" + DECIDE.format("t.WHY"),
        {"kit/__init__.py": "", "kit/deep/__init__.py": "", "kit/deep/texts.py": "WHY = 'beside'"},
    ),
    "a package's submodule": (
        "from kit import texts" + DECIDE.format("texts.WHY"),
        {"kit/__init__.py": "", "kit/texts.py": "from ..kit.more import WHY", "kit/more.py": "WHY = 'beside'"},
    ),
    "a package by its first name": (
        "import kit.texts" + DECIDE.format("kit.texts.WHY"),
        {"kit/__init__.py": "", "kit/texts.py": "from . import more\nWHY = more.WHY", "kit/more.py": "WHY = 'beside'"},
    ),
    "a folder": ("import kit.texts" + DECIDE.format("kit.texts.WHY"), {"kit/texts.py": "WHY = 'beside'"}),
    "named like a room": ("import sim, policies.texts" + DECIDE.format("sim.WHY"), {
        "sim.py": "WHY = 'beside'", "policies/__init__.py": "", "policies/texts.py": "",
    }),
    "in a circle": (
        "import helper" + DECIDE.format("helper.why()"),
        {"helper.py": "import mine, second\ndef why(): return second.why()",
         "second.py": "import helper\ndef why(): return 'beside' if helper.mine.decide else ''"},
    ),
    "of a dataclass": (
        "from helper import Why" + DECIDE.format("Why('beside').text"),
        {"helper.py": "from __future__ import annotations\nfrom dataclasses import dataclass\n"
                      "@dataclass\nclass Why:\n    text: str\n"},
    ),
}  # fmt: skip
INSIDE = "\ndef decide(view):\n    {}\n    return [nothing(view.ego, p, why()) for p in view.peers]\n"
FORMS |= {
    "inside the function": (INSIDE.format("from helper import why"), {"helper.py": "def why(): return 'beside'"}),
    "relative, inside the function": (
        INSIDE.format("from .helper import why"),
        {"helper.py": "def why():\n    import second\n    return second.WHY", "second.py": "WHY = 'beside'"},
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_policy_imports_what_is_beside_it(form: str, tmp_path: Path) -> None:
    source, files = FORMS[form]
    write(tmp_path, {"mine.py": START + source, **files})
    before, path = set(sys.modules), list(sys.path)
    policy = resolve(f"{tmp_path}/mine.py:decide")
    assert policy(fleet_of(2))[0].reason == "beside"
    assert sys.path == path
    left = {name for name in set(sys.modules) - before if not name.startswith(("sortie.", "sortie_user_"))}
    assert not left & {"mine", "helper", "second", "kit", "sim", "policies"}
    assert names(tmp_path) == sorted(["mine.py", *files])
    assert not list(tmp_path.rglob("__pycache__"))


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
    write(tmp_path, {
        "mine.py": source, "math.py": "pi = 4", "sortie/__init__.py": "raise RuntimeError", "numpy/data.txt": "",
    })  # fmt: skip
    assert reason(tmp_path) == "3.14 1"
    assert names(tmp_path) == ["mine.py"]


def test_what_was_loaded_counts_but_for_installed_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library of the user's own on the path does, and what only a function will import beside the file."""
    write(
        tmp_path / "lib",
        {
            "shop/__init__.py": "from .tools import a\n",
            "shop/tools/__init__.py": "",
            "shop/tools/a.py": "import cart",
            "cart.py": "",
            "unused.py": "",
        },
    )
    write(tmp_path / "venv/site-packages", {"bought.py": ""})
    source = START + "import shop, bought, numpy, json" + INSIDE.format("from late import why")
    write(
        tmp_path / "own",
        {
            "mine.py": source,
            "late.py": "import later\ndef why(): return ''",
            "later.py": "",
            "cart.py": "",
            "spare.py": "",
        },
    )
    for folder in ("lib", "venv/site-packages"):
        monkeypatch.syspath_prepend(tmp_path / folder)
    importlib.invalidate_caches()
    resolve(f"{tmp_path}/own/mine.py:decide")
    loaded = ["cart.py", "shop/__init__.py", "shop/tools/__init__.py", "shop/tools/a.py"]
    found = [path.relative_to(tmp_path.resolve()).as_posix() for path in imported_files(tmp_path / "own/mine.py")]
    assert found == [*(f"lib/{name}" for name in loaded), "own/late.py", "own/later.py", "own/mine.py"]


@pytest.mark.parametrize(
    ("form", "missing"),
    [("import absent", "absent"), ("from . import absent", "absent"), ("from helper import absent", "absent")],
)
def test_a_missing_module_is_named(form: str, missing: str, tmp_path: Path) -> None:
    write(tmp_path, {"mine.py": form, "helper.py": ""})
    with pytest.raises(
        PolicyError, match=rf"does not load: (ModuleNotFound|Import)Error: .*{missing}.* \(mine\.py, line 1\)"
    ):
        resolve(f"{tmp_path}/mine.py:decide")


def test_a_helpers_error_names_its_line(tmp_path: Path) -> None:
    write(
        tmp_path,
        {
            "mine.py": START + "import helper" + DECIDE.format("helper.why()"),
            "helper.py": "def why():\n    return 1 / 0",
        },
    )
    with pytest.raises(ZeroDivisionError) as caught:
        reason(tmp_path)
    assert describe_error(caught.value).endswith("(helper.py, line 2)")
