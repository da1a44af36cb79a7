"""The files of a run, read as those of anybody: bounded, plain files, in which every value is checked.

A run may come from somebody else, and may be damaged. All errors are `ValueError`, in one line that names the file, the
column or field, and the value.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sortie.policies.verification.enforced import CAUSES
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.base import models_of_the_past
from sortie.sim.results import accuracy_table, beliefs, disagreement, links, rosters, views
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import CLASS_COLUMN, OF_CLASSES, TABLES, VIOLATIONS_OF, SortieRecord
from sortie.sim.results.run_checks import LARGEST, MOST_CHARACTERS, Checks, ensure_boxes, ensure_each_once

OUTCOME, SCENARIO, RECORD, RECORDING = "outcome.json", "scenario.yaml", "record.json", "sortie.rrd"
RECORDING_MARK = "\n\x06sortie"
"""Near the begin of a Rerun recording that Sortie wrote: the name of the application."""
PAGE, TLOG, PCAP, BAG = "report.html", "sortie.tlog", "sortie.pcap", "bag"
_TABLES = (*TABLES, *views.TABLES, disagreement.TABLE, rosters.TABLE, beliefs.TABLE, links.TABLE)
WRITTEN = {
    OUTCOME,
    SCENARIO,
    RECORD,
    RECORDING,
    PAGE,
    TLOG,
    PCAP,
    BAG,
    *(f"{name}.parquet" for name in (*_TABLES, accuracy_table.TABLE)),
}
"""All that commands write into a run's folder."""
WRITTEN |= {".DS_Store"}  # a desktop that looked in
MOST_BYTES = 64 << 20
"""Of a file that is no table."""
_TOTALS = (
    "context_descriptor_bytes",
    "context_directive_bytes",
    "medium_busy_fraction",
    "policy_changes",
    "shield_interventions",
    "invariant_violations",
    "violated_ticks",
    *(f"{VIOLATIONS_OF}{cause}" for cause in CAUSES),
)
"""Those that the outcome needs."""

Text = Annotated[str, Field(max_length=MOST_CHARACTERS)]
Count = Annotated[float, Field(ge=0, le=LARGEST)]


class About(BaseModel):
    """The fields of `record.json`."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    policy: Text
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    replication: Annotated[int, Field(ge=0, lt=2**32)]
    version: Text
    detector: Text
    totals: dict[Text, Count]
    calibration: Text | None = None
    own_files: dict[Text, Text] = {}
    metrics: dict[Text, float | None] = {}
    wall: dict[Text, Count] = {}


def read_run(folder: Path) -> SortieRecord:
    """The record of a run.

    Raises:
        OSError, ValueError: a file is missing or damaged, or belongs to another run.
    """
    if os.path.lexists(folder / RECORDING):
        _ensure_plain(folder / RECORDING)
    about, scenario = _read_about(folder / RECORD), _read_scenario(folder / SCENARIO)
    record = SortieRecord(scenario=scenario, tables=_read_tables(folder, scenario), **about)
    _ensure_together(read_json(folder / OUTCOME), record)
    return record


def read_json(path: Path) -> dict[str, Any]:
    """The fields of a JSON file of a run.

    Raises:
        OSError, ValueError: it cannot be read, or is no JSON object with finite numbers.
    """
    try:
        found = json.loads(_read_file(path), parse_constant=_refuse)
    except RecursionError:
        raise ValueError(f"{path.name}: its values are nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path.name} holds a {type(found).__name__}, must hold fields")
    return found


def _read_file(path: Path) -> bytes:
    """The bytes of a file of a run that is no table.

    Raises:
        OSError, ValueError: it cannot be read, is no plain file, or is far longer than any run's.
    """
    _ensure_plain(path)
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ValueError(f"{path.name} has {size} bytes, must have at most {MOST_BYTES}")
    return path.read_bytes()


def _read_scenario(path: Path) -> Scenario:
    """The scenario of a run. Packages that offered its models need not be installed.

    Raises:
        OSError, ValueError: it cannot be read, or is no scenario.
    """
    text = _read_file(path).decode()
    if text and not text.endswith("\n"):
        raise ValueError(f"{path}: ends within a line")
    with models_of_the_past():
        scenario = loads(text, source=str(path))
    if scenario.takes_turns and not re.search("^  egos:", text, re.MULTILINE):  # of a version in which all were scored
        every = scenario.perception.model_copy(update={"egos": scenario.fleet.drones})
        scenario = scenario.model_copy(update={"perception": every})
    return scenario


def _read_about(path: Path) -> dict[str, Any]:
    """The checked fields of `record.json`.

    Raises:
        OSError, ValueError: as `read_json`; or a field is missing, unknown or has a value that no run has.
    """
    about = read_json(path)
    try:
        About.model_validate(about)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part)[:60] for part in first["loc"])
        value = "" if first["type"] == "missing" else f"{first['input']!r:.60}, "
        raise ValueError(f"{path.name}: {where}: {value}{first['msg'][:1].lower()}{first['msg'][1:]}") from None
    if lacking := [name for name in _TOTALS if name not in about["totals"]]:
        raise ValueError(f"{path.name}: totals.{lacking[0]}: is missing")
    return about


def _ensure_together(read: Mapping[str, Any], record: SortieRecord) -> None:
    """Refuse files that are not of one run: what `outcome.json` has of the record must be the record's.

    The fingerprint is among it, which is computed from all values of the tables.

    Raises:
        ValueError: naming the field that differs.
    """
    known = outcome(record)
    for name in ("scenario", "duration_s", "frame_s", *(n for n in About.model_fields if n in known), "fingerprint"):
        value = known[name]
        if read.get(name, value if name != "fingerprint" else None) != value:
            raise ValueError(f"outcome.json: {name} is {read.get(name)!r:.80}, the other files give {value!r:.80}")


def _read_tables(folder: Path, scenario: Scenario) -> dict[str, pa.Table]:
    """The checked tables of a run.

    Raises:
        OSError, ValueError: one is missing or damaged.
    """
    needed: dict[str, Mapping[str, pa.DataType]] = dict(TABLES)
    if len(scenario.perception.classes) > 1:
        needed |= {name: TABLES[name] | CLASS_COLUMN for name in OF_CLASSES}
    known = dict(needed)
    if scenario.record.views:
        needed |= views.NEEDED
        known |= views.TABLES
    for name, columns, wanted in (
        (disagreement.TABLE, disagreement.COLUMNS, scenario.record.disagreement),
        (rosters.TABLE, rosters.COLUMNS, scenario.publishes_rosters),
        (beliefs.TABLE, beliefs.COLUMNS, scenario.record.beliefs),
        (links.TABLE, links.COLUMNS, (folder / f"{links.TABLE}.parquet").exists()),  # not in runs of 0.2.0
    ):
        if wanted:
            needed[name] = known[name] = columns
    every = scenario.frames * scenario.fleet.drones
    rows = dict.fromkeys(("states", beliefs.TABLE), every)
    tables = {n: _read_table(folder / f"{n}.parquet", needed[n], known[n], rows.get(n)) for n in needed}
    checks = Checks(scenario, {name: len(table) for name, table in tables.items()})
    for name, table in tables.items():
        checks.check(name, table)
    ensure_boxes(tables)
    if scenario.record.views:
        ensure_each_once(tables)
    return tables


def _read_table(path: Path, needed: Collection[str], known: Mapping[str, pa.DataType], rows: int | None) -> pa.Table:
    """A table of a run, with its columns.

    Args:
        path: the Parquet file.
        needed: the columns that it must have.
        known: all that it may have, with their types.
        rows: how many it must have; None is any number.

    Raises:
        OSError, ValueError: it cannot be read, or has other columns, types or rows.
    """
    _ensure_plain(path)
    try:
        with pq.ParquetFile(path) as file:
            names, found = file.schema_arrow.names, file.metadata.num_rows
            again = "another version's, perhaps: fly it again"
            if lacking := [name for name in needed if name not in names]:
                raise ValueError(f"{path.name} has no column {lacking[0]}; {again}")
            if more := [name for k, name in enumerate(names) if name not in known or name in names[:k]]:
                raise ValueError(f"{path.name} has a column {more[0]!r:.80} too many; {again}")
            for field in file.schema_arrow:
                if field.type != known[field.name]:
                    raise ValueError(f"{path.name}: {field.name} is of type {field.type}, must be {known[field.name]}")
            if rows is not None and found != rows:
                raise ValueError(f"{path.name} has {found} rows, must have {rows}")
            table = file.read()
        table.validate(full=True)  # texts are UTF-8, lists end within their values
    except pa.ArrowException as error:
        raise ValueError(f"{path.name}: {error}") from error
    return table


def _ensure_plain(path: Path) -> None:
    """Refuse what is no plain file of the run's folder: it may lead elsewhere, or never end.

    Raises:
        ValueError: naming the file.
    """
    if path.is_symlink():
        raise ValueError(f"{path.name} is a link, must be a file of the run's folder")
    if not path.is_file():
        raise ValueError(f"{path.name} is {'no plain file' if path.exists() else 'missing'}")


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is no number that JSON has")
