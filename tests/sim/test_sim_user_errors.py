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
from sortie.sim.check import checking
from sortie.sim.check.plugin import ScenarioFile
from sortie.sim.engine import pilot
from sortie.sim.experiment import flight
from sortie.sim.folders import RunError
from sortie.sim.user_errors import as_text, defect, missing, of_user, user_errors

SHIPPED = str(Path(sortie.__file__).parent / "scenarios" / "library" / "gone.yaml")
SHORT = {"name": "x", "duration_s": 1, "perception": {"detector": "none"}}

WHOSE: list[tuple[Exception, str | None]] = [
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
]
"""An error, and the line that the user gets; None is a defect of Sortie, which stays as it is."""


def test_whose_error_it_is() -> None:
    wrong = {}
    for error, line in WHOSE:
        users = of_user(error)
        with pytest.raises(type(error) if line is None else type(users)) as caught, user_errors():
            raise error
        stays = caught.value is error
        if (None if users is None else str(users), stays) != (line, users is None or users is error):
            wrong[repr(error)] = users, stays
    assert wrong == {}


def test_an_extra_without_wheels_is_not_recommended(monkeypatch: pytest.MonkeyPatch) -> None:
    for python, line in (
        ((3, 13, 5), "cyclonedds is missing: pip install 'sortie-sim[dds]'"),
        ((3, 14, 0), "cyclonedds is missing: it has no wheels for Python 3.14; use Python 3.11 to 3.13"),
    ):
        monkeypatch.setattr(sys, "version_info", python)
        assert str(missing(ModuleNotFoundError(name="cyclonedds.domain"))) == line


@pytest.fixture
def wrong(tmp_path: Path) -> Path:
    (tmp_path / "helper.py").write_text("import numpy as np\n\ndef add():\n    return np.zeros(3) + np.zeros(4)\n")
    (tmp_path / "mine.py").write_text("import helper\n\ndef model(*_):\n    return helper.add()\n")
    return tmp_path / "mine.py"


def test_an_error_of_the_users_code_names_its_file_and_line(wrong: Path) -> None:
    with pytest.raises(PluginError, match=r"^ValueError: operands .* \(helper\.py, line 4\)$"), user_errors():
        from_file("metric", f"{wrong}:model")()
    wrong.write_text("\n\ndef model():\n    return []\n")  # no line of it runs: the call does not fit the function
    with pytest.raises(sortie.PolicyError, match=r"takes 0 positional arguments but 1 was given \(mine\.py, line 3\)$"):
        sortie.fly(SHORT, policy=f"{wrong}:model")

    def mine(view: object) -> None:
        raise ValueError("mine")

    with pytest.raises(sortie.PolicyError, match=r"raises ValueError: mine \(test_sim_user_errors\.py, line \d+\)$"):
        sortie.fly(SHORT, policy=mine)


def test_an_error_of_a_built_in_policy_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(view: object) -> None:
        raise ValueError("ours")

    monkeypatch.setattr(pilot, "resolve", lambda name, params: broken)
    with pytest.raises(ValueError, match=r"^ours$") as caught:
        sortie.fly(SHORT, policy="silence")
    assert of_user(caught.value) is None


def broken(*_: object, **__: object) -> None:
    np.zeros(3) + np.zeros(4)


def test_a_report_has_the_traceback_and_the_command_of_a_defect_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="operands") as caught:
        broken()
    text = as_text(caught.value)
    assert text.startswith("Traceback (most recent call last):\n")
    assert text.index("np.zeros(3) + np.zeros(4)") < text.index("This is a defect of Sortie")
    assert sortie.__version__ in text
    assert as_text(RunError("a: is no file")) == "RunError: a: is no file"
    for ran, named in (("/a/bin/sortie", "sortie"), ("/a/research/__main__.py", "python -m research")):
        monkeypatch.setattr("sys.argv", [ran, "fly", "a b"])
        assert defect().endswith(f"what you ran: {named} fly 'a b'")


def test_pytest_shows_the_traceback_of_a_defect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    (tmp_path / "one.yaml").write_text(BASE)
    file = ScenarioFile.from_parent(request.session, path=tmp_path / "one.yaml")
    monkeypatch.setattr(checking, "check_scenario", broken)
    assert "np.zeros(3) + np.zeros(4)" in file._fly().error
    monkeypatch.setattr(checking, "check_scenario", guarded(lambda *_, **__: sortie.load("nothing")))
    assert file._fly().error.startswith("ScenarioError: nothing: no such file")


def test_the_row_of_a_flight_says_that_it_is_a_defect(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "fly", lambda *_, **__: broken())
    row = flight.fly_in_worker(flight.task_of(sortie.load(SHORT), ()))
    assert row.error.startswith("a defect of Sortie (test_sim_user_errors.py, line ")
    assert "ValueError: operands could not be broadcast" in row.error
