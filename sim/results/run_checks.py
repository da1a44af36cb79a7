"""Which values the tables of a run may hold; an error is one line that names the file, the column, the row and the value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sortie.fleet.energy.battery import CAUSES as ENERGY_CAUSES
from sortie.fleet.energy.battery import RECORDED
from sortie.perception.classes import TargetClass
from sortie.policies.contract import COVERAGE_BYTES, DIRECTIVE_BOUNDS, PHASE_OF, Representation, TaskPhase
from sortie.policies.staleness import LinkHealth
from sortie.policies.verification.enforced import CAUSES
from sortie.radio.transmission import Status
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.representation import REPRESENTATION_OF
from sortie.scenarios.schema import Scenario
from sortie.sim.results import beliefs, disagreement, views
from sortie.sim.results.box_rows import columns_of, fusions_of
from sortie.sim.results.record import HANDSHAKE

MOST_CHARACTERS = 20_000
"""Of a text: a reason may name the invariants of a shield, which have 10,000 characters at most."""
LARGEST = 1e12
"""Of any number of a table; far beyond what flies, and small enough to compute with."""


class Checks:
    """The values that the tables of one run may have."""

    def __init__(self, scenario: Scenario, rows: Mapping[str, int]) -> None:
        """Args:
        scenario: what flew.
        rows: of each table.
        """
        last = scenario.fleet.drones - 1
        drones, drones_or_none, number_or_none = (0, last), (-1, last), (-1, 2**31)
        share, instant = (0.0, 1.0), (0.0, scenario.duration_s)
        bounds = {name: (0, bound.high) for name, bound in DIRECTIVE_BOUNDS.items()}
        self._drones = scenario.fleet.drones
        self._ranges: dict[str, tuple[float, float]] = {
            **dict.fromkeys(("drone", "peer", "sender", "receiver", "peers", "cut_drones", "members", "other"), drones),
            **dict.fromkeys(("agent_id", "source", "destination"), drones),
            **dict.fromkeys(
                ("bottleneck_sender", "bottleneck_receiver", "events.drone", "violations.peer"), drones_or_none
            ),
            **dict.fromkeys(("mcs", "target", "car", "person"), number_or_none),
            **dict.fromkeys(
                ("soc", "battery_soc", "cpu_headroom", "gpu_headroom", "busy_fraction", "trust", "delivered"), share
            ),
            **dict.fromkeys(("t_s", "begin_s"), instant),
            **bounds,
            "representation": (0, max(map(int, Representation))),  # the highest number, not the highest fidelity
            "transmissions.deadline_s": (0.0, scenario.duration_s + bounds["deadline_s"][1]),
            "stamp_ns": (-1e16, 1e16),
            "group": (0, len(scenario.mission.groups)),
            "kind": (0, max(TargetClass)),
            "connected_drones": (0, scenario.fleet.drones),
            "task_phase": (0, max(TaskPhase)),
            "views.descriptors": (0, rows.get(views.DESCRIPTORS, 0) - 1),
            "views.directives": (0, rows.get(views.DIRECTIVES, 0) - 1),
            **dict.fromkeys(("fusions.detections", "fusions.truths"), (0, 2**31)),
        }

    def check(self, name: str, table: pa.Table) -> None:
        """Refuse a table with a value that no run has.

        Raises:
            ValueError: naming the file, the column, the row and the value.
        """
        for column in table.column_names:
            row = 0
            for chunk in table[column].chunks:
                for part, values in _parts(column, chunk):
                    fault = self._fault(name, part, values)
                    if fault is not None:
                        at, what = fault
                        where = f" in row {row + at}" if values is chunk else ""
                        raise ValueError(f"{name}.parquet: {part}{where} {what}")
                row += len(chunk)
        self._ensure_shapes(name, table)

    def _fault(self, table: str, name: str, values: pa.Array) -> tuple[int, str] | None:
        """The first wrong value of a column, and what is wrong with it."""
        kind = values.type
        if values.null_count and name not in _MAY_BE_MISSING:
            return pc.index(values.is_null(), True).as_py(), "is missing"
        if pa.types.is_string(kind):
            choices = _CHOICES.get(f"{table}.{name}") or _CHOICES.get(name)
            if choices is not None:
                wrong = pc.invert(pc.is_in(values, pa.array(choices)))
                return _first(values, wrong, f"must be one of {', '.join(filter(None, choices))}")
            wrong = pc.greater(pc.utf8_length(values), MOST_CHARACTERS)
            return _first(values, wrong, f"must have at most {MOST_CHARACTERS} characters")
        if pa.types.is_integer(kind) or pa.types.is_floating(kind):
            leaf = name.rpartition(".")[2]
            whole = pa.types.is_integer(kind)
            low, high = self._ranges.get(f"{table}.{name}") or self._ranges.get(
                leaf, (0, 2**62) if whole else (-LARGEST, LARGEST)
            )
            sound = pc.and_(pc.greater_equal(values, low), pc.less_equal(values, high))  # NaN is not
            if leaf in _MAY_BE_NAN:
                sound = pc.or_(sound, pc.invert(pc.is_finite(values)) if leaf == "snr_db" else pc.is_nan(values))
            return _first(values, pc.invert(sound), f"must be {low:.10g} to {high:.10g}")
        return None

    def _ensure_shapes(self, name: str, table: pa.Table) -> None:
        """Refuse lists of other lengths, and rows that are not those of all drones in their order.

        Raises:
            ValueError: naming the file and the column.
        """
        n = self._drones
        if name in ("states", beliefs.TABLE) and not np.array_equal(
            table["drone"].to_numpy(), np.tile(np.arange(n), len(table) // n)
        ):
            raise ValueError(f"{name}.parquet: drone must count from 0 to {n - 1} in every frame")
        for column, length in _LENGTHS.get(name, {}).items():
            values = table[column]
            lengths = pc.binary_length(values) if pa.types.is_binary(values.type) else pc.list_value_length(values)
            right: Any = length
            if isinstance(length, str):
                right = pc.list_value_length(table[length])
            elif length is None:
                if n > LISTED_IDS:
                    continue
                right = n - 1
            if pc.any(pc.not_equal(lengths, right)).as_py():
                as_long = f"as many values as {length}" if isinstance(length, str) else f"{right} values"
                raise ValueError(f"{name}.parquet: {column} must have {as_long} in every row")


def ensure_boxes(tables: Mapping[str, pa.Table]) -> None:
    """Refuse boxes that are not those that the fusions count; drones that do not fuse have truths alone.

    Raises:
        ValueError: naming the file.
    """
    fusions = tables["fusions"]
    keys = list(zip(fusions["t_s"].to_pylist(), fusions["drone"].to_pylist(), strict=True))
    for name in ("detections", "truths"):
        of = fusions_of(keys, columns_of(tables[name].select(["t_s", "drone"])))
        counts = np.bincount(of[of >= 0], minlength=len(keys))
        if not np.array_equal(counts, fusions[name].to_numpy()) or (name == "detections" and (of < 0).any()):
            raise ValueError(f"{name}.parquet: has not the rows that fusions.parquet counts in `{name}`")


def ensure_each_once(tables: Mapping[str, pa.Table]) -> None:
    """Refuse views with two descriptors of one drone.

    Raises:
        ValueError: naming the row.
    """
    held = tables[views.DECISIONS]["descriptors"].combine_chunks()
    agents = tables[views.DESCRIPTORS]["agent_id"].to_numpy()[held.flatten().to_numpy()]
    of_row = np.repeat(np.arange(len(held)), held.value_lengths().to_numpy())
    pairs = np.sort(of_row * (int(agents.max(initial=0)) + 1) + agents)
    if len(twice := pairs[1:][pairs[1:] == pairs[:-1]]):
        row = int(twice[0]) // (int(agents.max()) + 1)
        raise ValueError(f"{views.DECISIONS}.parquet: descriptors in row {row} has two of one drone")


_MAY_BE_MISSING = frozenset({"region", "roster", "roi", "viewpoint"})
"""Optional parts of what policies read and answer; no other value may be missing."""
_MAY_BE_NAN = frozenset(
    {
        "region_x_m",
        "region_y_m",
        "region_radius_m",
        "roi_x_m",
        "roi_y_m",
        "roi_radius_m",
        "target_x_m",
        "target_y_m",
        "bottleneck_mbps",
        "delivered",
        "t_start_s",
        "t_done_s",
        "snr_db",
    }
)
"""Columns in which NaN says that there is none. A link that carries nothing may have an SNR of minus infinity."""
_CHOICES: dict[str, list[str]] = {
    "representation": [*REPRESENTATION_OF],
    "representations": [*REPRESENTATION_OF],
    "transmissions.representation": [*REPRESENTATION_OF, HANDSHAKE],
    "asked": [*REPRESENTATION_OF],
    "link": [link.name.lower() for link in LinkHealth],
    "status": [*map(str, Status)],
    "phase": [*PHASE_OF],
    "energy.cause": [*ENERGY_CAUSES, RECORDED],
    "interventions.kind": ["policy", "gate"],
    "violations.cause": [*CAUSES],
    "disagreement.episodes.cause": [*disagreement.CAUSES],
}
_LENGTHS: dict[str, dict[str, int | str | None]] = {
    "fusions": {"representations": "peers", "ages_s": "peers", "weights": "peers"},
    "descriptors": {"coverage_grid": COVERAGE_BYTES, "goodput_mbps": None},
    views.DECISIONS: {"ages_s": "descriptors"},
    views.DESCRIPTORS: {
        "coverage_grid": COVERAGE_BYTES,
        "position_m": 3,
        "orientation_xyzw": 4,
        "velocity_mps": 3,
    },
}
"""How many values a cell has: so many, as many as another column, or (None) one for each other drone."""


def _parts(name: str, values: pa.Array) -> Iterator[tuple[str, pa.Array]]:
    """A column, and what its lists and structures hold, each with its name."""
    yield name, values
    if pa.types.is_list(values.type):
        yield from _parts(name, values.flatten())
    elif pa.types.is_struct(values.type):
        there = values.drop_null()
        for k in range(values.type.num_fields):
            yield from _parts(f"{name}.{values.type.field(k).name}", there.field(k))


def _first(values: pa.Array, wrong: pa.Array, must: str) -> tuple[int, str] | None:
    at = pc.index(wrong, True).as_py()
    return None if at < 0 else (at, f"is {values[at].as_py()!r:.60}, {must}")
