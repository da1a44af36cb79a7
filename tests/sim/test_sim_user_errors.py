"""Which errors are the user's, as one line, and which are defects of Sortie."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from sim_examples import BASE

import sortie
from sortie.perception.errors import InputError
from sortie.scenarios.plugins.reference import PluginError, from_file
from sortie.scenarios.plugins.user_calls import guarded
from sortie.sim.campaign.work import _result
from sortie.sim.check import checking
from sortie.sim.check.plugin import ScenarioFile
from sortie.sim.engine import pilot
from sortie.sim.folders import RunError
from sortie.sim.user_errors import as_text, defect, missing, of_user, user_errors

SHIPPED = str(Path(sortie.__file__).parent / "scenarios" / "library" / "gone.yaml")


@pytest.mark.parametrize(
    ("python", "told"),
    [
        ((3, 13, 5), "cyclonedds is missing: pip install 'sortie-sim[dds]'"),
        ((3, 14, 0), "cyclonedds is missing: it has no wheels for Python 3.14; use Python 3.11 to 3.13"),
    ],
)
def test_an_extra_without_wheels_is_not_recommended(
    python: tuple[int, int, int], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "version_info", python)
    assert str(missing(ModuleNotFoundError(name="cyclonedds.domain"))) == told


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (InputError("tau is 2, must be 0 to 1"), "tau is 2, must be 0 to 1"),
        (ModuleNotFoundError(name="torch.nn"), "torch is missing: pip install 'sortie-sim[torch]'"),
        (ModuleNotFoundError(name="nothing"), None),
        (FileNotFoundError(errno.ENOENT, "No such file", "mine.csv"), "mine.csv: No such file"),
        (FileNotFoundError(errno.ENOENT, "No such file", SHIPPED), None),
        (OSError(errno.ENOSPC, "full"), f"{os.strerror(errno.ENOSPC)}; free some and run the command again"),
        (BrokenPipeError(errno.EPIPE, "broken"), None),
        (ValueError("operands could not be broadcast together"), None),
        (KeyError("ap50"), None),
        (MemoryError(), "the memory is used up; free some, or fly a smaller fleet or a shorter flight"),
    ],
)
def test_whose_error_it_is(error: Exception, line: str | None) -> None:
    users = of_user(error)
    assert (None if users is None else str(users)) == line
    with pytest.raises(type(error) if users is None else type(users)) as caught, user_errors():
        raise error
    assert (caught.value is error) == (users is None or users is error)


@pytest.fixture
def wrong(tmp_path: Path) -> Path:
    (tmp_path / "helper.py").write_text("import numpy as np\n\ndef add():\n    return np.zeros(3) + np.zeros(4)\n")
    (tmp_path / "mine.py").write_text("import helper\n\ndef model(*_):\n    return helper.add()\n")
    return tmp_path / "mine.py"


def test_an_error_of_the_users_code_names_its_file_and_line(wrong: Path) -> None:
    with pytest.raises(PluginError, match=r"^ValueError: operands .* \(helper\.py, line 4\)$"), user_errors():
        from_file("metric", f"{wrong}:model")()


def test_an_error_without_a_line_names_where_the_function_is(wrong: Path) -> None:
    """Sortie's call does not fit the user's function, so that no line of it ran."""
    wrong.write_text("\n\ndef model():\n    return []\n")
    with pytest.raises(sortie.PolicyError, match=r"takes 0 positional arguments but 1 was given \(mine\.py, line 3\)$"):
        sortie.fly({"name": "x", "duration_s": 1, "perception": {"detector": "none"}}, policy=f"{wrong}:model")


def test_an_error_of_a_function_in_python_names_its_line() -> None:
    def mine(view: object) -> None:
        raise ValueError("mine")

    with pytest.raises(sortie.PolicyError, match=r"raises ValueError: mine \(test_sim_user_errors\.py, line \d+\)$"):
        sortie.fly({"name": "x", "duration_s": 1, "perception": {"detector": "none"}}, policy=mine)


def test_an_error_of_a_built_in_policy_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(view: object) -> None:
        raise ValueError("ours")

    monkeypatch.setattr(pilot, "resolve", lambda name, params: broken)
    with pytest.raises(ValueError, match=r"^ours$") as caught:
        sortie.fly({"name": "x", "duration_s": 1, "perception": {"detector": "none"}}, policy="silence")
    assert of_user(caught.value) is None


def broken(*_: object, **__: object) -> None:
    np.zeros(3) + np.zeros(4)


def test_a_report_has_the_traceback_of_a_defect_alone(wrong: Path) -> None:
    with pytest.raises(ValueError, match="operands") as caught:
        broken()
    text = as_text(caught.value)
    assert text.startswith("Traceback (most recent call last):\n")
    assert text.index("np.zeros(3) + np.zeros(4)") < text.index("This is a defect of Sortie")
    assert sortie.__version__ in text
    assert as_text(RunError("a: is no file")) == "RunError: a: is no file"


@pytest.mark.parametrize(
    ("ran", "told"), [("/a/bin/sortie", "sortie"), ("/a/research/__main__.py", "python -m research")]
)
def test_a_defect_says_what_was_run(ran: str, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", [ran, "fly", "a b"])
    assert defect().endswith(f"what you ran: {told} fly 'a b'")


def test_pytest_shows_the_traceback_of_a_defect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    (tmp_path / "one.yaml").write_text(BASE)
    file = ScenarioFile.from_parent(request.session, path=tmp_path / "one.yaml")
    monkeypatch.setattr(checking, "check_scenario", broken)
    assert "np.zeros(3) + np.zeros(4)" in file._fly().error
    (tmp_path / "one.yaml").write_text(BASE)
    monkeypatch.setattr(checking, "check_scenario", guarded(lambda *_, **__: sortie.load("nothing")))
    assert file._fly().error.startswith("ScenarioError: nothing: no such file")


def test_the_row_of_a_run_says_that_it_is_a_defect() -> None:
    row = _result(0, "", broken, ())  # type: ignore[arg-type]
    assert row.status == "failed"
    assert row.error.startswith("a defect of Sortie (test_sim_user_errors.py, line ")
    assert "ValueError: operands could not be broadcast" in row.error
