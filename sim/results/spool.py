"""Rows that leave memory while a sortie flies: Arrow record batches, one behind the other in one file without a name.

A short sortie's batches stay in memory. A killed flight leaves nothing that could be taken for a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sortie.scenarios import scratch

BATCH_BYTES = 512 << 10
"""About the size of a batch: as Python objects its rows are some eight times as large."""
FIRST_ROWS = 32
"""Of a table of which nothing is known yet."""
_READ_BYTES = 8 << 20
"""After so much was read, what was read leaves memory."""
_ROW_GROUP_BYTES = 4 << 20
_ALIGNED = 64  # as in Arrow's own files

Unfold = Callable[[Sequence[tuple[Any, ...]]], Sequence[Any]]
"""Some rows to a table's columns."""


class Spool:
    """Batches of several tables, in the order in which they come."""

    def __init__(self) -> None:
        self._tape = scratch.Tape()
        self._schemas: dict[str, pa.Schema] = {}
        self._places: dict[str, list[tuple[int, int]]] = {}

    def define(self, name: str, columns: Mapping[str, pa.DataType]) -> None:
        """A table, which may stay empty."""
        self._schemas[name] = pa.schema(list(columns.items()))
        self._places[name] = []

    def schema(self, name: str) -> pa.Schema:
        """A table's columns."""
        return self._schemas[name]

    def batch(self, name: str, values: Sequence[Any] | None) -> pa.RecordBatch:
        """Rows of a table from the values of its columns; None makes none."""
        schema = self.schema(name)
        each = [()] * len(schema) if values is None else values
        arrays = [pa.array(v, field.type) for v, field in zip(each, schema, strict=True)]
        return pa.RecordBatch.from_arrays(arrays, schema=schema)

    def add(self, name: str, batch: pa.RecordBatch) -> None:
        """Append rows to a table.

        Raises:
            ScratchError: the disk refuses.
        """
        message = batch.serialize()
        self._places[name].append((self._tape.append(message), len(message)))
        self._tape.append(bytes(-len(message) % _ALIGNED))

    def add_table(self, name: str, table: pa.Table) -> None:
        """A whole table that was not defined before.

        Raises:
            ScratchError: the disk refuses.
        """
        self._schemas[name], self._places[name] = table.schema, []
        for batch in table.to_batches():
            self.add(name, batch)

    def finish(self) -> SpooledTables:
        """The tables; nothing can be added any more.

        Raises:
            ScratchError: the disk refuses.
        """
        return SpooledTables(pa.py_buffer(self._tape.finish()), self._schemas, self._places)


class SpooledTables(Mapping[str, pa.Table]):
    """The tables of a spool. Their values lie in the file and come to memory where they are read."""

    def __init__(
        self, data: pa.Buffer, schemas: Mapping[str, pa.Schema], places: Mapping[str, Sequence[tuple[int, int]]]
    ) -> None:
        self._data, self._schemas, self._places = data, schemas, places

    def __getitem__(self, name: str) -> pa.Table:
        return pa.Table.from_batches(list(self.batches(name)), self._schemas[name])

    def __contains__(self, name: object) -> bool:
        return name in self._schemas  # without reading it

    def __iter__(self) -> Iterator[str]:
        return iter(self._schemas)

    def __len__(self) -> int:
        return len(self._schemas)

    def __reduce__(self) -> Any:
        return dict, (dict(self),)

    def schema(self, name: str) -> pa.Schema:
        """A table's columns."""
        return self._schemas[name]

    def batches(self, name: str) -> Iterator[pa.RecordBatch]:
        """A table, batch after batch."""
        schema = self._schemas[name]
        for at, size in self._places[name]:
            yield pa.ipc.read_record_batch(self._data.slice(at, size), schema)


def schema_of(tables: Mapping[str, pa.Table], name: str) -> pa.Schema:
    """The columns of a table of a record, spooled or not."""
    return tables.schema(name) if isinstance(tables, SpooledTables) else tables[name].schema


def batches(
    tables: Mapping[str, pa.Table], name: str, columns: Sequence[str] | None = None
) -> Iterator[pa.RecordBatch]:
    """A table in pieces that memory has room for; what was read before may leave it.

    Args:
        tables: of a record, spooled or not.
        name: of the table.
        columns: those that are wanted; None is all.
    """
    pieces = tables.batches(name) if isinstance(tables, SpooledTables) else tables[name].to_batches()
    read_bytes = 0
    for piece in pieces:
        yield piece if columns is None else piece.select(columns)
        read_bytes += piece.nbytes
        if read_bytes > _READ_BYTES:
            read_bytes = 0
            scratch.release()
    scratch.release()


def write_parquet(tables: Mapping[str, pa.Table], name: str, path: Path) -> None:
    """A table as Parquet, a few megabytes of it at a time."""
    schema = schema_of(tables, name)
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        held, held_bytes = [], 0
        for batch in batches(tables, name):
            held.append(batch)
            held_bytes += batch.nbytes
            if held_bytes >= _ROW_GROUP_BYTES:
                writer.write_table(pa.Table.from_batches(held))
                held, held_bytes = [], 0
        if held:
            writer.write_table(pa.Table.from_batches(held, schema))


def in_blocks(tables: Mapping[str, pa.Table], name: str, columns: Sequence[str], rows: int) -> Iterator[pa.Table]:
    """A table in pieces of exactly so many rows; the last may have fewer. Arguments as for `batches`."""
    schema = schema_of(tables, name)
    held = pa.schema([schema.field(column) for column in columns]).empty_table()
    for piece in batches(tables, name, columns):
        held = pa.concat_tables([held, pa.Table.from_batches([piece])])
        while held.num_rows >= rows:
            yield held.slice(0, rows)
            held = held.slice(rows)
    if held.num_rows:
        yield held


class InTime:
    """A table in order of time, part after part."""

    def __init__(self, tables: Mapping[str, pa.Table], name: str, column: str = "t_s") -> None:
        """Args: `column` has the time; rows without one are with those before them."""
        self._pieces, self._column = batches(tables, name), column
        self._held: pa.Table = schema_of(tables, name).empty_table()

    def before(self, end_s: float) -> pa.Table:
        """The next rows, up to the first of this time or later."""
        parts = [self._held]
        while not (later := self._later(parts[-1], end_s)).any():
            piece = next(self._pieces, None)
            if piece is None:
                break
            parts.append(pa.Table.from_batches([piece]))
        whole = pa.concat_tables(parts)
        end = len(whole) - len(later) + (int(later.argmax()) if later.any() else len(later))
        self._held = whole.slice(end)
        return whole.slice(0, end)

    def _later(self, rows: pa.Table, end_s: float) -> NDArray[np.bool_]:
        return np.asarray(rows[self._column].to_numpy() >= end_s)
