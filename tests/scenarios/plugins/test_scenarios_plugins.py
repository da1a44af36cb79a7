"""Models by name: built-in, from an installed package, from a file; their errors, and what is said of a wrong name."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from installed_package import installed_package
from numpy.typing import NDArray

from sortie.scenarios.plugins import reference, user_calls
from sortie.scenarios.plugins.reference import (
    Guard,
    PluginError,
    checked_array,
    checked_call,
    name_of,
    package_of,
    resolve,
)
from sortie.scenarios.plugins.user_calls import Guarded, guarded
from sortie.scenarios.reading.load import ScenarioError, build


def plain(distance_m: float, *, db: float = 1.0) -> float:
    return distance_m * db


class Fails:
    name = "fails"

    def snr_db(self) -> float:
        raise KeyError("no such drone")

    def stop(self) -> None:
        sys.exit(0)


@pytest.fixture
def package(tmp_path: Path) -> Iterator[str]:
    """An installed package that offers a path loss, and one that does not load."""
    source = "def wet(distance_m, *, db=2.0):\n    return distance_m * db\n"
    with installed_package(tmp_path, "drizzle", source, {"path_loss": {"wet": "drizzle:wet", "broken": "nowhere:x"}}):
        yield "wet"


def test_a_name_is_a_built_in_model_or_one_of_an_installed_package(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert resolve("path_loss", "plain", {"db": 3.0}, {"plain": plain})(2.0) == 6.0
    assert resolve("path_loss", package, {"db": 0.5})(4.0) == 2.0
    assert build({"name": "a", "radio": {"path_loss": package}}).radio.path_loss == package
    assert resolve("path_loss", package, None, {package: plain}) is plain, "a built-in name is never a package's"
    with pytest.raises(
        PluginError, match=r"^path_loss 'broken' of drizzle does not load: ModuleNotFoundError: .*nowhere"
    ):
        resolve("path_loss", "broken")
    found = {name: EntryPoint(name, "math:sqrt", "sortie.power") for name in ("level", "mine")}
    monkeypatch.setattr(reference, "installed", lambda kind: found)
    assert resolve("power", "level", builtin={"level": plain}) is plain
    assert resolve("power", "mine", builtin={"level": plain})(9.0) == 3.0


def test_the_package_of_a_model_has_a_version_and_a_digest(package: str, tmp_path: Path) -> None:
    named, digest = package_of("path_loss", package) or ("", "")
    assert (named, len(digest)) == ("drizzle 1.2", 16)
    with (tmp_path / "drizzle.py").open("a") as file:
        file.write("# another line\n")
    assert package_of("path_loss", package) != (named, digest)
    assert package_of("path_loss", "free_space") is None
    assert package_of("path_loss", "file.py:wet") is None


# --- wrong names ----------------------------------------------------------------------------------

NAMES = {
    "plane": "unknown path_loss 'plane', did you mean plain? known: plain, or path/to/file.py:Name",
    "x": "unknown path_loss 'x', known: plain, or path/to/file.py:Name",
    "mine.py": "path_loss file 'mine.py' without its name, must be mine.py:Name",
    "gone.py:loss": "path_loss file 'gone.py' not found",
}
SOURCES = {
    "1 / 0": r"mine.py' does not load: ZeroDivisionError: division by zero \(mine.py, line 1\)$",
    "import sys; sys.exit(0)": r"mine.py' does not load: SystemExit: 0 \(mine.py, line 1\)$",
    "loss = 3": r"^path_loss file '.*mine.py' has no function or class 'loss'$",
}
KNOWN = "log_distance, free_space, two_ray or path/to/file.py:Name"
SECTIONS = {
    ("path_loss", "two_rays"): f"radio.path_loss: two_rays, must be {KNOWN}, did you mean two_ray?",
    ("link", "shadow"): "radio.link: shadow, must be path/to/file.py:Name",
    ("link", "shadow.py"): "radio.link: shadow.py, must be path/to/file.py:Name",
}


def test_a_name_that_means_nothing_says_what_it_may_be(tmp_path: Path) -> None:
    for name, message in NAMES.items():
        with pytest.raises(PluginError, match=f"^{re.escape(message)}$"):
            resolve("path_loss", name, {}, {"plain": plain})
    with pytest.raises(PluginError, match=r"^path_loss 'plain' has no parameter 'bd', it has: db$"):
        resolve("path_loss", "plain", {"bd": 1}, {"plain": plain})
    for source, message in SOURCES.items():
        (tmp_path / "mine.py").write_text(source)
        with pytest.raises(PluginError, match=message):
            resolve("path_loss", f"{tmp_path}/mine.py:loss")
    for (field, name), message in SECTIONS.items():
        with pytest.raises(ScenarioError, match=f"{re.escape(message)}$"):
            build({"name": "a", "radio": {field: name}})


# --- errors of a model ----------------------------------------------------------------------------


def test_errors_of_a_model_are_of_one_line_and_name_it(tmp_path: Path) -> None:
    """At the last line of the user's own files."""
    model = Guard("link", Fails(), ("snr_db",))
    where = r"\(test_scenarios_plugins.py, line \d+\)$"
    with pytest.raises(PluginError, match=rf"^link Fails.snr_db: KeyError: 'no such drone' {where}"):
        model.snr_db()  # type: ignore[attr-defined]
    with pytest.raises(PluginError, match=rf"^link Fails.stop: ProgramExitError: exit code 0, must return {where}"):
        model.stop()  # type: ignore[attr-defined]
    assert model.name == "fails"
    with pytest.raises(PluginError, match=r"^link Fails has no 'truth', must have snr_db, truth$"):
        Guard("link", Fails(), ("snr_db", "truth"))
    (tmp_path / "helper.py").write_text("def divide(x):\n    y = x\n    return 1 / y\n")
    (tmp_path / "own.py").write_text("from helper import divide\n\n\ndef model(x):\n    return divide(x)\n")
    with pytest.raises(PluginError, match=r"ZeroDivisionError: .* \(helper\.py, line 3\)"):
        checked_array("power", resolve("power", f"{tmp_path / 'own.py'}:model"), (1,), 0)

    def refuses() -> None:
        raise PluginError("as it is")

    with pytest.raises(PluginError, match=r"^as it is$"):
        checked_call("link", refuses)


def test_names_of_models() -> None:
    names = [name_of(thing) for thing in (plain, Fails, Fails(), Fails().snr_db)]
    assert names == ["plain", "Fails", "Fails", "Fails.snr_db"]


ANSWERS: list[tuple[object, str]] = [
    (None, "None"),
    ("far", "'far'"),
    (1j, "1j"),
    ([[1.0], [2.0, 3.0]], r"\[\[1.0\], \[2.0, 3.0\]\]"),
    ({}, r"\{\}"),
    (["1", "2"], r"\['1', '2'\]"),
    ([1.0, None], r"\[1.0, None\]"),
    ("x" * 90, "str 'x{59}…"),
]


def test_an_answer_that_is_no_array_of_numbers_is_named() -> None:
    for answer, shown in ANSWERS:

        def loss_db(answer: object = answer) -> object:
            return answer

        words = rf"^path_loss \S*loss_db: returns {shown}, must be numbers of shape \(2,\)$"
        with pytest.raises(PluginError, match=words):
            checked_array("path_loss", loss_db, (2,))


def test_what_is_left_out_need_not_be_finite_and_the_rest_must_be() -> None:
    out = np.eye(2, dtype=bool)
    given = np.array([[np.nan, 1.0], [2.0, np.inf]])
    np.testing.assert_array_equal(checked_array("link", lambda: given, (2, 2), left_out=out), given)
    with pytest.raises(PluginError, match="returns nan, must be finite"):
        checked_array("link", lambda: given[:, ::-1], (2, 2), left_out=out)
    with pytest.raises(PluginError, match="must be finite"):
        checked_array("link", lambda: given, (2, 2))


def test_a_model_gets_arrays_that_it_may_change() -> None:
    given = np.arange(4.0)[None]

    def changes(first: NDArray[np.float64], second: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
        first *= factor
        second[:] = 0.0
        return first

    assert checked_array("power", changes, (4,), given[0], given, 2.0).tolist() == [0.0, 2.0, 4.0, 6.0]
    assert given.tolist() == [[0.0, 1.0, 2.0, 3.0]]


# --- limits of time -------------------------------------------------------------------------------


def test_only_where_calls_are_limited_each_has_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole of it, a call within a call none of its own, and after a call there is none."""
    asked: list[float] = []
    monkeypatch.setattr(user_calls.signal, "setitimer", lambda which, seconds: asked.append(seconds))
    inner = guarded(lambda: 1)
    outer = guarded(lambda: inner())

    def fails() -> None:
        raise KeyError

    outer()
    assert asked == []
    monkeypatch.setattr(user_calls, "_limit_s", 2.0)
    outer()
    with pytest.raises(KeyError):
        guarded(fails)()
    outer()
    assert asked == [2.0, 0.0, 2.0, 0.0, 2.0, 0.0]
    assert guarded(outer) is outer
    assert isinstance(Guard("link", Fails()).stop.args[1], Guarded)
    assert not isinstance(Guard("link", Fails(), timed=False).stop.args[1], Guarded)
