"""Tables of users: however spreadsheets and programs write them, they are read, or refused with the row and the column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sortie.scenarios.reading.campaign import load_campaign
from sortie.scenarios.reading.nodes import ScenarioError
from sortie.scenarios.tables import TableError, read_numbers

WRITTEN = {
    "plain": b"t_s,x_m\n0,1.5\n1,-2\n",
    "blanks": b"t_s, x_m\n0, 1.5\n 1 ,-2 \n",
    "case": b"T_S,X_M\n0,1.5\n1,-2\n",
    "mark, CRLF and empty lines": b"\xef\xbb\xbft_s,x_m\r\n\r\n0,1.5\r\n\r\n1,-2\r\n",
    "empty lines first": b"\n\nt_s,x_m\n0,1.5\n  \n1,-2",
    "old line ends": b"t_s,x_m\r0,1.5\r1,-2\r",
    "quotes": b'"t_s", "X_m "\n"0", "1.5"\n"1","-2"\n',
    "semicolons": b"t_s;x_m\n0;1.5\n1;-2\n",
    "decimal commas": b'"t_s";"x_m"\n0;1,5\n1,0;"-2,0"\n',
    "tabs": b"t_s\tx_m\n0\t1,5\n1\t-2\n",
    "a last separator": b"t_s;x_m;\n0;1,5;\n1;-2;\n",
    "other columns": b'note,t_s,note,x_m\n"a,b",0,\xff,1.5\n;,1,,-2.0e0\n',
}


@pytest.mark.parametrize("suffix", [".csv", ".TSV", ""])
@pytest.mark.parametrize("text", WRITTEN.values(), ids=WRITTEN)
def test_all_ways_to_write_a_table_are_one_table(text: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(text)
    columns, _ = read_numbers(path, ["t_s", "x_m", "y_m"])
    assert {name: values.tolist() for name, values in columns.items()} == {"t_s": [0.0, 1.0], "x_m": [1.5, -2.0]}


@pytest.mark.parametrize("cell", ["", " ", "NaN", "nan", "NA", "N/A", "null", '""'])
def test_empty_cells_hold_no_number(cell: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"t_s,x_m\n0,{cell}\n1,2\n")
    np.testing.assert_array_equal(read_numbers(path, ["x_m"])[0]["x_m"], [np.nan, 2.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,x_m\n0,1\n\n1,abc\n", "x_m in row 2 is 'abc', must be a number"),
        ('t_s,x_m\n0,1\n1,"1,5"\n', "x_m in row 2 is '1,5', must be a number"),
        ("t_s;x_m\n0;1,5\n1;2.5\n", "x_m in row 1 is '1,5', and the column has points too: must be one of them"),
        ("t_s;x_m\n0;1\n1;1.000,5\n", "x_m in row 2 is '1.000,5', and the column has points too: must be one of them"),
        ("t_s,x_m\n0,1\n1,2,\n", "row 2 has 3 cells, must have 2, as the names"),
        ("t_s,x_m\n0\n", "row 1 has 1 cells, must have 2, as the names"),
        ("t_s,x_m, X_M\n0,1,2\n", "2 columns x_m, must be one at most"),
        ("t_s,x_m\n0,true\n", "x_m in row 1 is 'true', must be a number"),
        ("t_s,x_m\n0,2026-01-01\n", "x_m in row 1 is '2026-01-01', must be a number"),
    ],
)
def test_what_is_no_table_of_numbers_names_row_and_column(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(TableError) as error:
        read_numbers(path, ["x_m"])
    assert str(error.value) == f"{path}: {message}"


def test_parquet_has_the_same_names(tmp_path: Path) -> None:
    path = tmp_path / "flight"  # by its content
    pq.write_table(pa.table({" X_m ": ["1.5", None], "at": pa.array([0, 1], pa.timestamp("ms"))}), path)
    columns, names = read_numbers(path, ["x_m"])
    np.testing.assert_array_equal(columns["x_m"], [1.5, np.nan])
    assert names == [" X_m ", "at"]
    pq.write_table(pa.table({"x_m": pa.array([b"\xff"]).cast(pa.string(), safe=False)}), tmp_path / "b.parquet")
    with pytest.raises(TableError, match=r"x_m holds texts that are not UTF-8, must hold numbers$"):
        read_numbers(tmp_path / "b.parquet", ["x_m"])
    with pytest.raises(TableError, match=r"flight: at holds timestamp\[ms\], must hold numbers$"):
        read_numbers(path, ["at"])


def test_a_campaign_s_table_is_read_alike(tmp_path: Path) -> None:
    """Its column may hold words too; a value that the scenario refuses is named with its row."""
    (tmp_path / "base.yaml").write_text("name: base\n")
    (tmp_path / "v.csv").write_bytes(b"\xef\xbb\xbfPower; word\r\n10;a,b\r\n\r\n12,5;c\r\n")
    vary = "{radio.tx_power_dbm: {kind: column, file: v.csv, column: power}, "
    vary += "description: {kind: column, file: v.csv, column: Word}}"
    (tmp_path / "c.yaml").write_text(f"campaign: c\nbase: base.yaml\nmetrics: [bytes.data_sent]\nvary: {vary}\n")
    assert load_campaign(tmp_path / "c.yaml").columns == {"radio.tx_power_dbm": (10, 12.5), "description": ("a,b", "c")}
    (tmp_path / "v.csv").write_text("power,word\n10,a\nmuch,b\n")
    with pytest.raises(ScenarioError, match=r"radio.tx_power_dbm: much, must be a number \(v.csv: power in row 2\)$"):
        load_campaign(tmp_path / "c.yaml")


def test_a_row_of_another_width_that_is_no_utf8_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "v.csv"
    path.write_bytes(b"t_s,x_m\n0,1\n1,\xb2,3\n")
    with pytest.raises(TableError, match=r"v\.csv: is not a \.csv table: .*Row #2: Expected 2 columns, got 3"):
        read_numbers(path, ["t_s"])
