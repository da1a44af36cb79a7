"""`pytest my_scenarios/`: every expectation of every scenario file is a test.

A YAML file is a scenario with something to check where it has, on top, a `name` and `expect` or `expect_decisions`, or
a golden outcome beside it, whether in block or in flow style; other YAML files are left alone. The ini option
`sortie_scenarios` names the scenario files instead, by patterns below the root folder:

    [pytest]
    sortie_scenarios = scenarios/*.yaml

A file's sorties are flown once, when its first test runs. Under pytest-xdist one worker flies them, and the others wait
for its verdicts.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from sortie.sim.check.expectations import Verdict
    from sortie.sim.check.once import Flown

WRITTEN = pytest.StashKey[list[str]]()
NAMED = pytest.StashKey[frozenset[Path]]()
"""The files that `sortie_scenarios` names."""
SHARED = pytest.StashKey[Path]()
"""In the process that starts workers: the folder in which they share verdicts."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--sortie-update`, `--sortie-set`, and the ini option `sortie_scenarios`."""
    parser.addini(
        "sortie_scenarios", "Patterns of scenario files, below the root folder; left out, they are recognised.", "args"
    )
    group = parser.getgroup("sortie")
    group.addoption("--sortie-update", action="store_true", help="Write golden outcomes of scenarios anew.")
    group.addoption(
        "--sortie-set", action="append", default=[], metavar="KEY=VALUE", help="Override a field of every scenario."
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse both options together: they would write the outcome of a changed scenario as its golden outcome."""
    if config.getoption("sortie_update") and config.getoption("sortie_set"):
        from sortie.sim.check.checking import ensure_own
        from sortie.sim.folders import RunError

        try:
            ensure_own(config.getoption("sortie_set"), update=True)
        except RunError as error:
            raise pytest.UsageError(str(error)) from None
    patterns = config.getini("sortie_scenarios")
    if patterns:
        config.stash[NAMED] = frozenset(path for each in patterns for path in config.rootpath.glob(each))


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """xdist starts a worker: tell it where verdicts are shared."""
    stash = node.config.stash
    if SHARED not in stash:
        stash[SHARED] = Path(tempfile.mkdtemp(prefix="sortie-check-"))
    node.workerinput["sortie_shared"] = str(stash[SHARED])


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove what workers shared."""
    if SHARED in config.stash:
        shutil.rmtree(config.stash[SHARED], ignore_errors=True)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Which golden outcomes were written."""
    for line in config.stash.get(WRITTEN, []):
        terminalreporter.write_line(line)


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> ScenarioFile | None:
    """A scenario file with expectations."""
    if file_path.suffix not in (".yaml", ".yml"):  # nothing is imported for other projects' files
        return None
    if NAMED in parent.config.stash:
        is_one = file_path in parent.config.stash[NAMED]
    else:
        from sortie.sim.check.discovery import is_scenario

        is_one = is_scenario(file_path)
    return ScenarioFile.from_parent(parent, path=file_path) if is_one else None


class ScenarioFile(pytest.File):
    """One scenario, flown when its first test runs."""

    _flown: Flown | None = None

    def collect(self) -> Iterator[ScenarioItem]:
        """One test an expectation, and one for the golden outcome."""
        from sortie.scenarios.errors import SortieError
        from sortie.scenarios.reading.load import load
        from sortie.sim.check.expectations import in_words
        from sortie.sim.check.golden import golden_path
        from sortie.sim.user_errors import user_errors

        try:
            with user_errors():
                scenario = load(self.path, self.config.getoption("sortie_set"))
        except SortieError as error:
            raise self.CollectError(str(error)) from None
        names = [in_words(e) for e in scenario.expect]
        names += [f"decision {i}" for i in range(len(scenario.expect_decisions))]
        names += ["no other changes"] * scenario.expect_no_other_changes
        if golden_path(self.path).is_file() or self.config.getoption("sortie_update"):
            names.append("golden outcome")
        for i, name in enumerate(names):
            yield ScenarioItem.from_parent(self, name=name, number=i)

    def flown(self) -> Flown:
        """The verdicts, in the order of the tests."""
        from sortie.sim.check.once import flown_once

        if self._flown is None:
            shared = getattr(self.config, "workerinput", {}).get("sortie_shared")
            self._flown = flown_once(None if shared is None else Path(shared), self.path, self._fly)
            if self._flown.written:
                self.config.stash.setdefault(WRITTEN, []).append(self._flown.written)
        return self._flown

    def _fly(self) -> Flown:
        from sortie.sim.check.checking import check_scenario
        from sortie.sim.check.once import Flown
        from sortie.sim.user_errors import as_text

        update, overrides = (self.config.getoption(f"sortie_{n}") for n in ("update", "set"))
        try:
            checked = check_scenario(str(self.path), overrides, update=update)
        except Exception as error:
            return Flown(error=as_text(error))
        return Flown(checked.verdicts, tuple(map(checked.replay, checked.verdicts)), checked.written)


class ScenarioItem(pytest.Item):
    """One expectation."""

    def __init__(self, *, number: int, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.number = number

    def runtest(self) -> None:
        """Fly the scenario if this is its first test, and raise where the verdict is a failure."""
        assert isinstance(self.parent, ScenarioFile)  # noqa: S101
        flown = self.parent.flown()
        if flown.error:
            raise FlightFailed(flown.error)
        if self.number >= len(flown.verdicts):  # the golden outcome
            if not flown.written:
                pytest.skip("not compared under --sortie-set")
            return
        verdict = flown.verdicts[self.number]
        if not verdict.holds:
            raise ExpectationFailed(verdict, flown.replays[self.number])

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """A failed expectation in words; an error of a flight as `user_errors.as_text` has it."""
        if isinstance(excinfo.value, ExpectationFailed):
            whole = excinfo.value.verdict.whole if self.config.get_verbosity() > 0 else ""
            return "\n".join(filter(None, [excinfo.value.in_words(), whole]))
        if isinstance(excinfo.value, FlightFailed):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """The test's file and name."""
        return self.path, None, f"{self.path.name}: {self.name}"


class FlightFailed(Exception):
    """A flight without verdicts. The text has the user's error in one line, or a traceback where it is a defect of Sortie."""


class ExpectationFailed(AssertionError):
    """An expectation that does not hold."""

    def __init__(self, verdict: Verdict, replay: str) -> None:
        super().__init__(f"{verdict.expected}, got {verdict.got}")
        self.verdict, self.replay = verdict, replay

    def in_words(self) -> str:
        """The expected and the actual value, the reason, and the command that shows it."""
        v = self.verdict
        lines = {
            "expected": v.expected,
            "got": v.got,
            "because": v.because,
            "the record": v.explanation,
            "see it": self.replay,
        }
        return "\n".join(f"{name:>10}  {text}" for name, text in lines.items() if text)
