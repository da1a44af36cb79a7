"""The rosters that drones published: a row where a drone's roster changed. Only where `context.roster` is on."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping

import pyarrow as pa

from sortie.policies.contract import Roster

TABLE = "rosters"
COLUMNS: dict[str, pa.DataType] = dict(
    t_s=pa.float64(), drone=pa.int32(), epoch=pa.int64(), members=pa.list_(pa.int32())
)
ABOUT = (
    "A descriptor whose roster differs from the one before of the same drone: the members that the drone knows, itself "
    "among them. `epoch` counts the changes."
)


class RosterLog:
    """Gathers the table's rows."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, int, int, tuple[int, ...]]] = []
        self._latest: dict[int, Roster] = {}

    def published(self, t_s: float, drone: int, roster: Roster) -> None:
        """A drone published this roster."""
        if roster != self._latest.get(drone):
            self._latest[drone] = roster
            self._rows.append((t_s, drone, *roster))

    def table(self) -> pa.Table:
        """All rows so far, in order of time."""
        columns = zip(*self._rows, strict=True) if self._rows else [()] * len(COLUMNS)
        return pa.table({name: pa.array(c, type_) for (name, type_), c in zip(COLUMNS.items(), columns, strict=True)})


def of(tables: Mapping[str, pa.Table]) -> Callable[[int, float], Roster | None]:
    """The roster that a drone published last, by drone and time; None for all where a record has no rosters."""
    by_drone: dict[int, list[tuple[float, Roster]]] = {}
    for row in tables[TABLE].to_pylist() if TABLE in tables else ():
        by_drone.setdefault(row["drone"], []).append((row["t_s"], Roster(row["epoch"], tuple(row["members"]))))

    def roster_at(drone: int, t_s: float) -> Roster | None:
        rows = by_drone.get(drone, [])
        k = bisect_right(rows, t_s, key=lambda row: row[0])
        return rows[k - 1][1] if k else None

    return roster_at
