"""Models by name: built-in, from an installed package, from a file; and what is said where a name means nothing."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from installed_package import installed_package

from sortie.scenarios.plugins.reference import (
    Guard,
    PluginError,
    checked_array,
    checked_call,
    name_of,
    package_of,
    resolve,
)
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


def test_a_built_in_name_comes_with_its_parameters() -> None:
    assert resolve("path_loss", "plain", {"db": 3.0}, {"plain": plain})(2.0) == 6.0


def test_an_installed_package_offers_models(package: str) -> None:
    assert resolve("path_loss", package, {"db": 0.5})(4.0) == 2.0
    assert build({"name": "a", "radio": {"path_loss": package}}).radio.path_loss == package


def test_a_built_in_name_is_never_an_installed_packages(package: str) -> None:
    assert resolve("path_loss", package, None, {package: plain}) is plain


def test_the_package_of_a_model_has_a_version_and_a_digest(package: str, tmp_path: Path) -> None:
    named, digest = package_of("path_loss", package) or ("", "")
    assert (named, len(digest)) == ("drizzle 1.2", 16)
    with (tmp_path / "drizzle.py").open("a") as file:
        file.write("# another line\n")
    assert package_of("path_loss", package) != (named, digest)
    assert package_of("path_loss", "free_space") is None
    assert package_of("path_loss", "file.py:wet") is None


def test_a_package_that_does_not_load_is_named(package: str) -> None:
    with pytest.raises(
        PluginError, match=r"^path_loss 'broken' of drizzle does not load: ModuleNotFoundError: .*nowhere"
    ):
        resolve("path_loss", "broken")


def test_a_file_may_import_what_lies_beside_it(tmp_path: Path) -> None:
    (tmp_path / "beside.py").write_text("DB = 5.0\n")
    (tmp_path / "mine.py").write_text("import beside\ndef loss(d, *, factor=1.0):\n    return d * beside.DB * factor\n")
    assert resolve("path_loss", f"{tmp_path}/mine.py:loss", {"factor": 2.0})(1.0) == 10.0


@pytest.mark.parametrize(
    ("reference", "params", "message"),
    [
        ("plane", {}, r"^unknown path_loss 'plane', did you mean plain\? known: plain, or path/to/file.py:Name$"),
        ("x", {}, r"^unknown path_loss 'x', known: plain, or path/to/file.py:Name$"),
        ("mine.py", {}, r"^path_loss file 'mine.py' without its name, must be mine.py:Name$"),
        ("gone.py:loss", {}, r"^path_loss file 'gone.py' not found$"),
        ("plain", {"bd": 1}, r"^path_loss 'plain' has no parameter 'bd', it has: db$"),
    ],
)
def test_a_name_that_means_nothing(reference: str, params: dict[str, object], message: str) -> None:
    with pytest.raises(PluginError, match=message):
        resolve("path_loss", reference, params, {"plain": plain})


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("1 / 0", r"mine.py' does not load: ZeroDivisionError: division by zero \(mine.py, line 1\)$"),
        ("import sys; sys.exit(0)", r"mine.py' does not load: SystemExit: 0 \(mine.py, line 1\)$"),
        ("loss = 3", r"^path_loss file '.*mine.py' has no function or class 'loss'$"),
    ],
)
def test_a_file_without_the_model(source: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(source)
    with pytest.raises(PluginError, match=message):
        resolve("path_loss", f"{tmp_path}/mine.py:loss")


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"path_loss": "two_rays"}, r"radio.path_loss: two_rays, must be log_distance, free_space, two_ray or path/to/file.py:Name, did you mean two_ray\?$"),
        ({"link": "shadow"}, r"radio.link: shadow, must be path/to/file.py:Name$"),
        ({"link": "shadow.py"}, r"radio.link: shadow.py, must be path/to/file.py:Name$"),
    ],
)  # fmt: skip
def test_a_scenario_says_what_a_field_may_name(section: dict[str, object], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        build({"name": "a", "radio": section})


def test_errors_of_a_model_are_of_one_line_and_name_it() -> None:
    model = Guard("link", Fails(), ("snr_db",))
    with pytest.raises(
        PluginError, match=r"^link Fails.snr_db: KeyError: 'no such drone' \(test_scenarios_plugins.py, line \d+\)$"
    ):
        model.snr_db()  # type: ignore[attr-defined]
    with pytest.raises(
        PluginError, match=r"^link Fails.stop: ProgramExitError: exit code 0, must return \(.*, line \d+\)$"
    ):
        model.stop()  # type: ignore[attr-defined]
    assert model.name == "fails"


def test_a_model_must_have_its_methods() -> None:
    with pytest.raises(PluginError, match=r"^link Fails has no 'truth', must have snr_db, truth$"):
        Guard("link", Fails(), ("snr_db", "truth"))


def test_an_error_of_ones_own_stays_what_it_is() -> None:
    def refuses() -> None:
        raise PluginError("as it is")

    with pytest.raises(PluginError, match=r"^as it is$"):
        checked_call("link", refuses)


def test_names_of_models() -> None:
    assert [name_of(thing) for thing in (plain, Fails, Fails(), Fails().snr_db)] == [
        "plain", "Fails", "Fails", "Fails.snr_db",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("answer", "shown"),
    [
        (None, "None"),
        ("far", "'far'"),
        (1j, "1j"),
        ([[1.0], [2.0, 3.0]], r"\[\[1.0\], \[2.0, 3.0\]\]"),
        ({}, r"\{\}"),
        (["1", "2"], r"\['1', '2'\]"),
        ([1.0, None], r"\[1.0, None\]"),
        ("x" * 90, "str 'x{59}…"),
    ],
)
def test_an_answer_that_is_no_array_of_numbers_is_named(answer: object, shown: str) -> None:
    def loss_db() -> object:
        return answer

    with pytest.raises(PluginError, match=rf"^path_loss loss_db: returns {shown}, must be numbers of shape \(2,\)$"):
        checked_array("path_loss", loss_db, (2,))
