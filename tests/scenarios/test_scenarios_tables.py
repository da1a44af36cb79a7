"""Tables and traces of users: however programs write them, they are read, or refused with the row and the column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from places import ROOT

from sortie.scenarios.reading.load import load
from sortie.scenarios.shipped import TRACES, located
from sortie.scenarios.tables import TableError, read_numbers
from sortie.scenarios.traces import TraceError, check_increasing, read_columns

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


def test_all_ways_to_write_a_table_are_one_table(tmp_path: Path) -> None:
    wrong = {}
    for name, suffix in [*((name, ".csv") for name in WRITTEN), ("semicolons", ".TSV"), ("tabs", "")]:
        path = tmp_path / f"a{suffix}"
        path.write_bytes(WRITTEN[name])
        columns, _ = read_numbers(path, ["t_s", "x_m", "y_m"])
        found = {column: values.tolist() for column, values in columns.items()}
        if found != {"t_s": [0.0, 1.0], "x_m": [1.5, -2.0]}:
            wrong[name] = found
    assert wrong == {}


def test_empty_cells_hold_no_number(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for cell in ("", " ", "NaN", "nan", "NA", "N/A", "null", '""'):
        path.write_text(f"t_s,x_m\n0,{cell}\n1,2\n")
        np.testing.assert_array_equal(read_numbers(path, ["x_m"])[0]["x_m"], [np.nan, 2.0])


BROKEN = {
    b"t_s,x_m\n0,1\n\n1,abc\n": "x_m in row 2 is 'abc', must be a number",
    b't_s,x_m\n0,1\n1,"1,5"\n': "x_m in row 2 is '1,5', must be a number",
    b"t_s;x_m\n0;1,5\n1;2.5\n": "x_m in row 1 is '1,5', and the column has points too: must be one of them",
    b"t_s;x_m\n0;1\n1;1.000,5\n": "x_m in row 2 is '1.000,5', and the column has points too: must be one of them",
    b"t_s,x_m\n0,1\n1,2,\n": "row 2 has 3 cells, must have 2, as the names",
    b"t_s,x_m\n0\n": "row 1 has 1 cells, must have 2, as the names",
    b"t_s,x_m, X_M\n0,1,2\n": "2 columns x_m, must be one at most",
    b"t_s,x_m\n0,true\n": "x_m in row 1 is 'true', must be a number",
    b"t_s,x_m\n0,2026-01-01\n": "x_m in row 1 is '2026-01-01', must be a number",
    b"t_s,x_m\n0,1\n1,\xb2,3\n": "is not a .csv table: ",
}


def test_what_is_no_table_of_numbers_names_row_and_column(tmp_path: Path) -> None:
    path, wrong = tmp_path / "a.csv", {}
    for text, message in BROKEN.items():
        path.write_bytes(text)
        with pytest.raises(TableError) as error:
            read_numbers(path, ["x_m"])
        if not str(error.value).startswith(f"{path}: {message}"):
            wrong[text] = str(error.value)
    assert wrong == {}


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


def test_a_trace_in_another_encoding_or_with_a_column_twice_is_one_line(tmp_path: Path) -> None:
    path, bounds = tmp_path / "trace.csv", {"t_s": (0.0, 1.0), "x_m": (0.0, 1.0)}
    latin, twice = "t_s,höhe_m\n0,1\n".encode("latin-1"), b"t_s,x_m,x_m,note,note\n0,1,2,3,4\n"
    texts = {
        latin: "names of columns are in another encoding, must be UTF-8",
        twice: "2 columns x_m, must be one at most",
    }
    texts |= {"t_s,x_m\n0,1\n".encode(encoding): "" for encoding in ("utf-16", "utf-16-le", "utf-32", "cp500")}
    for text, message in texts.items():
        path.write_bytes(text)
        with pytest.raises(TraceError) as caught:
            read_columns(path, bounds)
        assert str(caught.value).startswith(f"{path}: {message}")
        assert len(str(caught.value).splitlines()) == 1
    path.write_bytes(twice)
    assert list(read_columns(path, {"t_s": (0.0, 1.0)})) == ["t_s"]


def test_a_cell_that_must_be_there_is_not_empty_and_time_never_stands(tmp_path: Path) -> None:
    path, bounds = tmp_path / "a.csv", {"t_s": (0, 9), "x": (0, 9)}
    path.write_text("t_s,x\n0,1\n,2\n")
    with pytest.raises(TraceError, match="t_s in row 2 is nan"):
        read_columns(path, bounds)
    path.write_text("t_s,x\n0,1\n1,\n")
    assert np.isnan(read_columns(path, bounds)["x"][1])
    rows = np.array([0, 2, 3])
    check_increasing(path, np.array([0.0, 0.0, 1.0, 2.0]), rows, "drone 1")
    for at in ([0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 2.0, 1.0]):
        with pytest.raises(TraceError, match="t_s in row 4 of drone 1 is 1, must increase"):
            check_increasing(path, np.array(at), rows, "drone 1")


def test_an_error_is_one_line_whatever_a_file_holds() -> None:
    assert str(TraceError("a\nb\u2028c\td\udcff")) == "a\\nb\\u2028c\\td\\udcff"
    assert str(TraceError("ρ " * 5000)) == "ρ " * 999 + "ρ…"


def test_a_shipped_trace_is_found_by_its_name_and_one_s_own_stands_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = Path("paper_120s/links.csv")
    monkeypatch.chdir(tmp_path)
    assert located(name) == TRACES / name
    assert located(name).samefile(ROOT / "scenarios/library/traces" / name)
    name.parent.mkdir()
    assert located(name) == TRACES / name  # a folder is no trace
    name.write_text("t_s\n0\n")
    assert located(name) == name
    (tmp_path / "a.yaml").write_text(f"name: a\nfleet: {{trace: {'a' * 400}}}\n")  # it ended in OSError
    assert load(tmp_path / "a.yaml").fleet.trace == "a" * 400
    for missing in (Path("a" * 400), TRACES / "nowhere.csv"):
        with pytest.raises(TraceError, match="no such file"):
            read_columns(missing, {})
