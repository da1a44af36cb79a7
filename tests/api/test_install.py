"""The wheel beside a project that has packages of its own called sim, policies, scenarios: nothing of it breaks."""

from __future__ import annotations

import os
import shutil
import site
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from places import ROOT

from sortie.sim.identity import code_version

pytestmark = pytest.mark.slow

NOT_SOURCES = shutil.ignore_patterns(
    ".git", ".venv*", ".*_cache", "__pycache__", "runs", "build", "dist", "*.egg-info", ".hypothesis"
)
OWN = ("sim", "policies", "scenarios", "fleet", "radio", "perception")
"""Names that a project may have for packages of its own."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the sources."""
    sources, out = tmp_path_factory.mktemp("sources") / "sortie", tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, sources, symlinks=True, ignore=NOT_SOURCES)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(out), "."]
    subprocess.run(build, cwd=sources, check=True, capture_output=True)
    (found,) = out.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def project(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with packages of its own, and a new environment that has the wheel; libraries are those of this one."""
    folder = tmp_path_factory.mktemp("project")
    venv.create(folder / "env", symlinks=True)
    (packages,) = (folder / "env").glob("lib/python*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    (packages / "libraries.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    for name in OWN:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(f"MINE = {name!r}\n")
    (folder / "policies" / "contract.py").write_text("LIMIT = 3\n")
    test = "def test_mine():\n    assert (sim.MINE, LIMIT) == ('sim', 3)\n"
    (folder / "test_mine.py").write_text(f"import sim\nfrom policies.contract import LIMIT\n\n\n{test}")
    (folder / "mine.py").write_text(
        "import sortie\nfrom policies.contract import LIMIT\n\n\ndef decide(view):\n"
        "    return [sortie.Directive(view.ego, p, reason=f'at most {LIMIT}') for p in view.peers]\n"
    )
    (folder / "mine.yaml").write_text(
        "name: mine\nduration_s: 1\nperception: {detector: none}\nexpect: [{metric: bytes.data_sent, at_least: 0}]\n"
    )
    return folder


def run(project: Path, *arguments: str) -> str:
    """What a program of the environment prints, run in the project's folder as its user would."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "PYTEST", "COV"))}
    ran = subprocess.run(
        [project / "env/bin/python", *arguments], cwd=project, env=plain, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def test_the_wheel_adds_one_name(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name.partition("/")[0] for name in archive.namelist()}
    assert {name for name in names if not name.endswith(".dist-info")} == {"sortie"}


def test_it_is_the_wheel_that_is_imported_and_its_code_is_this_code(project: Path) -> None:
    told = run(
        project,
        "-c",
        "import sortie; from sortie.sim.identity import code_version; print(sortie.__file__, code_version())",
    )
    assert str(project / "env") in told
    assert told.split()[-1] == code_version()


def test_the_projects_own_tests_run_and_so_do_its_scenarios(project: Path) -> None:
    assert "2 passed" in run(project, "-m", "pytest", "-p", "no:cacheprovider")


def test_a_policy_that_imports_the_projects_own_package_flies(project: Path) -> None:
    done = run(
        project, "-m", "sortie", "fly", "mine.yaml", "--policy", "mine.py:decide", "--no-recording", "--out", "runs/a"
    )
    assert "kept in runs/a" in done
    assert (project / "runs/a/outcome.json").is_file()


def test_the_projects_own_packages_are_what_their_names_say(project: Path) -> None:
    told = run(
        project, "-c", f"import sortie, {', '.join(OWN)}; sortie.fly; print({', '.join(f'{n}.MINE' for n in OWN)})"
    )
    assert told.split() == list(OWN)


def test_outside_the_checkout_the_rooms_have_no_other_name(project: Path) -> None:
    """A plain import of a room fails where the project has none."""
    code = f"""
import os, sys
os.chdir("/")
sys.path[:] = [path for path in sys.path if path]
import sortie
for name in {OWN!r}:
    try:
        __import__(name)
    except ImportError:
        continue
    raise SystemExit(name)
"""
    run(project, "-c", code)
