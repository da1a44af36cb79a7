"""How well each drone saw: the table `accuracy`, computed from a record, with a row for each ego and scored moment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sortie.perception.classes import CAR
from sortie.perception.metrics.ap import average_precision
from sortie.scenarios.frames import instants
from sortie.sim.results.accuracy import FULL_SCENE, MISSION, Pool, score
from sortie.sim.results.record import SortieRecord

TABLE = "accuracy"
WINDOW_S = 5.0
"""AP is taken over so long before each moment."""
_SCOPES = {FULL_SCENE: "", MISSION: "mission_"}
COLUMNS: dict[str, pa.DataType] = {"t_s": pa.float64(), "drone": pa.int32()}
for _prefix in _SCOPES.values():
    COLUMNS |= {f"{_prefix}{count}": pa.int32() for count in ("truths", "hits", "false_alarms")}
    COLUMNS |= {f"{_prefix}ap50": pa.float64()}
ABOUT = (
    "A scored fusion: how many cars there were within the ego's range (`truths`), how many detections stand for one at IoU 0.5 "
    "(`hits`) and how many for none (`false_alarms`), at any score; and AP@0.5 of the ego's fusions of the last "
    f"{WINDOW_S:g} s, NaN where they had no car. Then the same of the mission disc, 0 and NaN while there is none."
)


class WithAccuracy(Mapping[str, pa.Table]):
    """A record's tables, and `accuracy`, which is computed where it is first read."""

    def __init__(self, record: SortieRecord) -> None:
        self._record = record
        self._made: pa.Table | None = None

    def __getitem__(self, name: str) -> pa.Table:
        if name != TABLE:
            return self._record.tables[name]
        if self._made is None:
            self._made = accuracy_table(self._record)
        return self._made

    def __contains__(self, name: object) -> bool:
        return name == TABLE or name in self._record.tables  # without reading it

    def __iter__(self) -> Iterator[str]:
        return iter([*self._record.tables, TABLE])

    def __len__(self) -> int:
        return len(self._record.tables) + 1


def accuracy_table(record: SortieRecord) -> pa.Table:
    """The table `accuracy` of a record: columns as `COLUMNS`, rows in order of time."""
    pools = score(record, [CAR]).pools
    whole = pools[CAR, FULL_SCENE]
    columns: dict[str, NDArray[np.float64] | NDArray[np.int32]] = {"t_s": whole.t_s, "drone": whole.drone}
    rows = {key: row for row, key in enumerate(zip(whole.t_s.tolist(), whole.drone.tolist(), strict=True))}
    for scope, prefix in _SCOPES.items():
        pool = pools[CAR, scope]
        at = [rows[key] for key in zip(pool.t_s.tolist(), pool.drone.tolist(), strict=True)]
        hits = np.diff(np.concatenate([[0], np.cumsum(pool.hit)])[pool.first])
        for name, values in (
            ("truths", pool.truths),
            ("hits", hits),
            ("false_alarms", np.diff(pool.first) - hits),
        ):
            columns[prefix + name] = np.zeros(len(rows), np.int32)
            columns[prefix + name][at] = values
        columns[f"{prefix}ap50"] = np.full(len(rows), np.nan)
        columns[f"{prefix}ap50"][at] = windowed_ap(pool)
    return pa.table([pa.array(columns[name], kind) for name, kind in COLUMNS.items()], names=list(COLUMNS))


def windowed_ap(pool: Pool) -> NDArray[np.float64]:
    """AP at each fusion, over those of its ego in the `WINDOW_S` before it and itself; NaN without a truth, [n]."""
    found = np.full(len(pool.t_s), np.nan)
    for drone in np.unique(pool.drone):
        own = np.flatnonzero(pool.drone == drone)
        begins = np.searchsorted(instants(pool.t_s[own]), instants(pool.t_s[own] - WINDOW_S) + 1)
        each = pool.fusions(own)
        for k, begin in enumerate(begins.tolist()):
            found[own[k]] = average_precision(each[begin : k + 1])
    return found
