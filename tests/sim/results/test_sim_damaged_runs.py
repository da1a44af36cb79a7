"""Runs of others: each damage is one line that names its place, and no text of a run is obeyed."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from cli_examples import command, refusal
from rich.console import Console

import sortie
from sortie.sim.experiment.compare import Compared, Flown
from sortie.sim.experiment.comparison_page import comparison_page
from sortie.sim.folders import RunError
from sortie.sim.results.run_checks import MOST_CHARACTERS as MOST
from sortie.sim.terminal import Terminal

SHORT = {
    "duration_s": 2,
    "fleet.drones": 3,
    "perception.detector": "surrogate",
    "record": {"views": True, "beliefs": True, "disagreement": True},
    "events": [{"kind": "link_drop", "at_s": 1, "drone": 1, "loss_db": 40, "until_s": 1.5}],
}
Damage = Callable[[Path], object]


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sortie.fly("track_target", SHORT).save(tmp_path_factory.mktemp("kept") / "run", recording=False)


@pytest.fixture
def run(kept: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(kept, tmp_path / "run"))


def text(file: str, new: str | bytes) -> Damage:
    """A file's new content."""
    return lambda run: (run / file).write_bytes(new if isinstance(new, bytes) else new.encode())


def cut(file: str, share: float) -> Damage:
    def damage(run: Path) -> None:
        whole = (run / file).read_bytes()
        (run / file).write_bytes(whole[: int(share * len(whole))])

    return damage


def instead(file: str, old: str, new: str) -> Damage:
    def damage(run: Path) -> None:
        before = (run / file).read_text("utf-8")
        assert old in before
        (run / file).write_text(before.replace(old, new, 1), "utf-8")

    return damage


def field(file: str, value: Any, *path: str) -> Damage:
    """A field of a JSON file, at a path of keys; `...` removes it."""

    def damage(run: Path) -> None:
        whole = json.loads((run / file).read_text("utf-8"))
        at = whole
        for key in path[:-1]:
            at = at[key]
        if value is ...:
            del at[path[-1]]
        else:
            at[path[-1]] = value
        (run / file).write_text(json.dumps(whole), "utf-8")

    return damage


def gone(file: str) -> Damage:
    return lambda run: (run / file).unlink()


def linked(file: str, to: str) -> Damage:
    def damage(run: Path) -> None:
        (run / file).rename(run / "elsewhere")
        (run / file).symlink_to(to)

    return damage


def changed(name: str, change: Callable[[pa.Table], pa.Table]) -> Damage:
    def damage(run: Path) -> None:
        file = run / f"{name}.parquet"
        pq.write_table(change(pq.read_table(file)), file)

    return damage


def cell(name: str, column: str, value: Any, row: int = 0) -> Damage:
    """One cell of a table."""

    def change(table: pa.Table) -> pa.Table:
        values = table[column].to_pylist()
        values[row] = value
        at = table.column_names.index(column)
        return table.set_column(at, column, pa.array(values, table.schema.field(column).type))

    return changed(name, change)


def typed(name: str, column: str, kind: pa.DataType) -> Damage:
    def change(table: pa.Table) -> pa.Table:
        return table.set_column(table.column_names.index(column), column, table[column].cast(kind))

    return changed(name, change)


NAN, INF = float("nan"), float("inf")
OUTCOME, RECORD, SCENARIO = "outcome.json", "record.json", "scenario.yaml"
OTHER_RUN = "outcome.json: fingerprint is "
TWICE = (cell("views", "descriptors", [0, 0]), cell("views", "ages_s", [0.1, 0.1]))
DAMAGES: dict[str, tuple[Damage, str]] = {
    "outcome missing": (gone(OUTCOME), "no run there"),
    "outcome empty": (text(OUTCOME, ""), "outcome.json: Expecting value"),
    "outcome a list": (text(OUTCOME, "[]"), "outcome.json holds a list, must hold fields"),
    "outcome of another run": (field(OUTCOME, "0" * 64, "fingerprint"), f"{OTHER_RUN}'000"),
    "outcome without fingerprint": (field(OUTCOME, ..., "fingerprint"), f"{OTHER_RUN}None"),
    "outcome of another policy": (field(OUTCOME, "silence", "policy"), "outcome.json: policy is 'silence'"),
    "record missing": (gone(RECORD), "record.json is missing"),
    "record not UTF-8": (text(RECORD, b'{"policy": "\xff"}'), "record.json: 'utf-8' codec"),
    "record nested": (text(RECORD, '{"a": ' + "[" * 100_000), "record.json: its values are nested too deeply"),
    "record NaN": (field(RECORD, NAN, "metrics", "a"), "record.json: NaN is no number"),
    "record infinite": (instead(RECORD, '"metrics": {}', '"metrics": {"a": 1e999}'), "metrics.a: inf, "),
    "record a link": (linked(RECORD, "elsewhere"), "record.json is a link"),
    "no seed": (field(RECORD, ..., "seed"), "record.json: seed: field required"),
    "seed a truth value": (field(RECORD, True, "seed"), "record.json: seed: True, "),
    "seed below 0": (field(RECORD, -1, "seed"), "record.json: seed: -1, "),
    "another seed": (field(RECORD, 2, "seed"), "outcome.json: seed is 1, the other files give 2"),
    "policy of half a pair": (instead(RECORD, '"policy": "', r'"policy": "\ud800'), "record.json: policy: "),
    "policy huge": (field(RECORD, "a" * 10**6, "policy"), "record.json: policy: 'aaa"),
    "own_files of numbers": (field(RECORD, {"a.py": 1}, "own_files"), "record.json: own_files.a.py: 1, "),
    "a total missing": (field(RECORD, ..., "totals", "policy_changes"), "totals.policy_changes: is missing"),
    "a total below 0": (field(RECORD, -1, "totals", "policy_changes"), "totals.policy_changes: -1, "),
    "another total": (field(RECORD, 7, "totals", "decisions"), OTHER_RUN),
    "a field too many": (field(RECORD, 1, "evil"), "record.json: evil: 1, extra inputs"),
    "scenario cut": (cut(SCENARIO, 0.5), "scenario.yaml"),
    "scenario with a tag": (text(SCENARIO, "name: !!python/object/apply:os.system [x]\n"), "scenario.yaml:1"),
    "scenario of more drones": (
        instead(SCENARIO, "drones: 3", "drones: 4"),
        "states.parquet has 60 rows, must have 80",
    ),
    "scenario of other classes": (instead(SCENARIO, "trucks: 0.0", "trucks: 0.5"), "no column kind"),
    "scenario of another name": (instead(SCENARIO, "track_target", "evil"), "scenario is 'track_target'"),
    "scenario a link": (linked(SCENARIO, "/dev/zero"), "scenario.yaml is a link"),
    "recording a link": (lambda run: (run / "sortie.rrd").symlink_to("/dev/zero"), "sortie.rrd is a link"),
    "table missing": (gone("energy.parquet"), "energy.parquet is missing"),
    "table cut": (cut("states.parquet", 0.7), "states.parquet: "),
    "table no Parquet": (text("ages.parquet", "PAR1 not really PAR1"), "ages.parquet: "),
    "column missing": (changed("energy", lambda t: t.drop_columns(["cause"])), "energy.parquet has no column cause"),
    "column twice": (
        changed("energy", lambda t: t.append_column("drone", t["drone"])),
        "energy.parquet has a column 'drone' too many",
    ),
    "column of wider numbers": (typed("energy", "drone", pa.int64()), "drone is of type int64, must be int32"),
    "rows missing": (changed("states", lambda t: t.slice(1)), "states.parquet has 59 rows, must have 60"),
    "rows in another order": (
        changed("states", lambda t: t.take([1, 0, *range(2, 60)])),
        "states.parquet: drone must count from 0",
    ),
    "other rows": (changed("energy", lambda t: t.slice(1)), OTHER_RUN),
    "null in a list": (cell("descriptors", "goodput_mbps", [None, 1.0]), "goodput_mbps is missing"),
    "null text": (cell("directives", "reason", None), "directives.parquet: reason in row 0 is missing"),
    "time NaN": (cell("ages", "t_s", NAN, 3), "ages.parquet: t_s in row 3 is nan, must be 0 to 2"),
    "time after the end": (cell("events", "t_s", 1e9), "events.parquet: t_s in row 0 is 1000000000.0, must be 0 to 2"),
    "place infinite": (cell("states", "x_m", -INF), "states.parquet: x_m in row 0 is -inf"),
    "charge above 1": (cell("states", "soc", 2.0), "states.parquet: soc in row 0 is 2.0, must be 0 to 1"),
    "another charge": (cell("states", "soc", 0.5), OTHER_RUN),
    "drone beyond the fleet": (cell("energy", "drone", 3), "energy.parquet: drone in row 0 is 3, must be 0 to 2"),
    "drone below 0": (cell("ages", "drone", -1), "ages.parquet: drone in row 0 is -1, must be 0 to 2"),
    "peer of a fusion": (cell("fusions", "peers", [7], 1), "fusions.parquet: peers is 7, must be 0 to 2"),
    "goodput of too many": (cell("descriptors", "goodput_mbps", [1.0] * 9), "goodput_mbps must have 2 values"),
    "coverage cut": (cell("descriptors", "coverage_grid", b"x"), "coverage_grid must have 64 values"),
    "unknown representation": (cell("directives", "representation", "soul"), "is 'soul', must be one of none"),
    "box missing": (changed("detections", lambda t: t.slice(1)), "detections.parquet: has not the rows that fusions"),
    "truths missing": (changed("truths", lambda t: t.slice(0, 0)), "truths.parquet: has not the rows that fusions"),
    "text huge": (cell("events", "text", "x" * (MOST + 1)), f"must have at most {MOST} characters"),
    "view of no descriptor": (cell("views", "descriptors", [10**6]), "descriptors is 1000000, must be 0 to"),
    "view of one drone twice": (lambda run: [damage(run) for damage in TWICE], "in row 0 has two of one drone"),
    "view without ages": (cell("views", "ages_s", [], 5), "ages_s must have as many values as descriptors"),
    "directive of rho NaN": (cell("view_directives", "rho", NAN), "rho in row 0 is nan, must be 0 to 1"),
}
"""By name: what is done to the folder, and words of the line."""


def test_a_damaged_run_is_one_line(kept: Path, tmp_path: Path) -> None:
    wrong = {}
    for name, (damage, words) in DAMAGES.items():
        run = Path(shutil.copytree(kept, tmp_path / name))
        damage(run)
        try:
            sortie.open_run(run)
        except RunError as error:
            line = str(error)
        else:
            line = "opened"
        if not (line.startswith(f"{run}: ") and words in line and "\n" not in line and len(line) < 700):
            wrong[name] = line
    assert wrong == {}


COMMANDS = (
    "view run --picture a.png",
    "report run --out a.html",
    "export run --mcap",
    "export run --tlog",
    "export run --pcap",
    "replay run",
    "compare run --policies worked",
    "fly run/scenario.yaml",
    "check run/scenario.yaml",
)


def test_each_command_refuses_it(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "record.json").unlink()
    (run / "scenario.yaml").write_text("name: 1", "utf-8")
    for arguments in COMMANDS:
        refusal(run.parent, arguments.split(), capsys)


CANARY = "<script>\"onload='x' [red]a[/red] [/] $x$ {0} \x1b]0;t\x07 \x9b2J \u202e"
"""What a page, a terminal, a figure or a template could obey."""
SHOWN = "[red]a[/red] [/] $x$ {0} \\x1b]0;t\\x07 \\x9b2J \\u202e"
"""How a terminal and a page show the rest of it."""
FREE = {
    "events": ["kind", "text"],
    "directives": ["reason", "policy"],
    "drops": ["reason"],
    "transmissions": ["reason"],
    "trust": ["reason"],
    "violations": ["policy", "line", "text"],
    "interventions": ["policy", "text"],
    "views": ["policy"],
    "view_directives": ["reason"],
    "view_descriptors": ["feature_space", "codebook"],
}
"""Columns of any text."""


@pytest.fixture(scope="module")
def forged(kept: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the canary in every text, and with the fingerprint that goes with it."""
    run = Path(shutil.copytree(kept, tmp_path_factory.mktemp("forged") / "run"))
    one_row = {pa.string(): CANARY, pa.bool_(): False, pa.float64(): 1.0, pa.int32(): 0}
    for name, columns in FREE.items():
        file = run / f"{name}.parquet"
        table = pq.read_table(file)
        if not len(table):
            chosen = {"cause": "policy", "kind": "gate"}
            row = [[chosen.get(field.name, one_row[field.type])] for field in table.schema]
            table = pa.table([pa.array(v, f.type) for v, f in zip(row, table.schema, strict=True)], table.schema)
        for column in columns:
            at = table.column_names.index(column)
            table = table.set_column(at, column, pa.array([CANARY] * len(table)))
        pq.write_table(table, file)
    about = json.loads((run / "record.json").read_text("utf-8"))
    about |= dict.fromkeys(("policy", "version", "calibration", "detector"), CANARY)
    about |= {"own_files": {CANARY: CANARY}, "metrics": {CANARY: 1.0}, "wall": {CANARY: 1.0}}
    about["totals"] |= {CANARY: 1, f"decisions_of {CANARY}": 1}
    (run / "record.json").write_text(json.dumps(about), "utf-8")
    scenario = (run / "scenario.yaml").read_text("utf-8")
    described = re.sub(
        "description: .*?\nseed", lambda _: f"description: {json.dumps(CANARY)}\nseed", scenario, flags=re.S
    )
    (run / "scenario.yaml").write_text(described, "utf-8")
    (run / "outcome.json").write_text(json.dumps({"fingerprint": ""}), "utf-8")
    with pytest.raises(RunError) as found:
        sortie.open_run(run)
    (run / "outcome.json").write_text(
        json.dumps({"fingerprint": re.findall("[0-9a-f]{64}", str(found.value))[0]}), "utf-8"
    )
    return run


def ensure_harmless(page: str) -> None:
    tags: list[str] = []
    marks: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
            tags.append(tag)
            marks.extend(name for name, _ in attributes)

    Reader().feed(page)
    assert "svg" in tags
    assert "script" not in tags
    assert not [name for name in marks if name.startswith("on")]
    assert page.replace("\n", "").isprintable()


def test_no_text_of_a_run_is_obeyed_by_its_page(forged: Path, tmp_path: Path) -> None:
    page = sortie.open_run(forged).report(tmp_path / "a.html").read_text("utf-8")
    ensure_harmless(page)
    assert page.count(SHOWN) >= 10


def test_no_label_of_a_comparison_is_obeyed_by_its_page(forged: Path) -> None:
    opened = sortie.open_run(forged)
    flown = Flown((Compared(CANARY, 1, 1, opened.outcome, {}, lambda: opened.record),), ())
    ensure_harmless(comparison_page(flown))


def test_no_text_of_a_run_is_obeyed_by_a_terminal(forged: Path, tmp_path: Path) -> None:
    opened = sortie.open_run(forged)
    for console in (Terminal(file=StringIO(), width=2000), Console(file=StringIO(), width=2000)):
        for summary in (opened.summary(), opened.decisions(), sortie.replay(opened, "silence").summary()):
            console.print(summary)
        assert isinstance(console.file, StringIO)
        told = console.file.getvalue()
        assert told.replace("\n", "").isprintable()
        assert told.count(CANARY.partition("\x1b")[0] + r"\x1b]0;t") >= 8  # rich leaves out the bell
    assert str(opened.decisions()).replace("\n", "").isprintable()


def test_no_text_of_a_run_is_obeyed_by_commands(
    forged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evil = tmp_path / "[red]\x1b[2J"
    shutil.copytree(forged, evil)
    for arguments in (
        ("replay", evil, "--policy", "silence"),
        ("report", evil),
        ("export", evil, "--pcap"),
        ("export", evil, "--tlog"),
    ):
        assert command(*arguments) == 0
    (evil / "sortie.pcap").write_text("a capture of the user's")
    assert command("export", evil, "--pcap") == 2
    printed = capsys.readouterr()
    assert (printed.out + printed.err).replace("\n", "").isprintable()
    assert r"[red]\x1b[2J" in printed.out.replace("\n", "")
    assert r"[red]\x1b[2J" in printed.err


def test_a_policy_that_a_run_names_is_not_run(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "evil.py").write_text("open('executed', 'w').close()\ndef f(view):\n    return []\n", "utf-8")
    instead("scenario.yaml", "name: worked", f"name: {tmp_path / 'evil.py'}:f")(run)
    assert "decided in flight; name it" in refusal(tmp_path, ("replay", "run"), capsys)
    assert not (tmp_path / "executed").exists()


COMPARE = "compare track_target --policies silence --set duration_s=0.5 --seeds 1"
WRITES = {
    "report run": "run/report.html",
    "report run --out a.html": "a.html",
    "export run --pcap": "run/sortie.pcap",
    "export run --tlog --out a.tlog": "a.tlog",
    "replay run --out a.csv": "a.csv",
    f"{COMPARE} --out a.json": "a.json",
    f"{COMPARE} --report b.html": "b.html",
}
"""A command, and the file that it writes."""


def test_files_that_exist_need_replace(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = "my own notes"
    monkeypatch.chdir(tmp_path)
    for text_of_command, file in WRITES.items():
        arguments, path = text_of_command.split(), tmp_path / file
        path.write_text(mine, "utf-8")
        assert "replace it with --replace" in refusal(tmp_path, arguments, capsys)
        assert path.read_text("utf-8") == mine
        assert command(*arguments, "--replace") == 0
        assert mine.encode() not in path.read_bytes()
        assert command(*arguments) == 0, "what the command wrote itself, it writes again"
        capsys.readouterr()
    (run / "bag").mkdir()
    (run / "bag" / "metadata.yaml").write_text(mine, "utf-8")
    mcap = ("export", "run", "--mcap")
    assert "metadata.yaml, which no bag wrote; choose another folder or move" in refusal(tmp_path, mcap, capsys)
    (run / "bag" / "metadata.yaml").unlink()
    for _ in range(2):
        assert command("export", str(run), "--mcap") == 0
