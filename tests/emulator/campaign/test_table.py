"""The table: DuckDB and pyarrow read it, a file is whole or not there."""

import os

import duckdb
import pytest

from emulator.campaign.table import RowUnreadable, done_rows, read_row, read_rows, write_row, write_table

ROWS = [
    {"index": 0, "outcome": "ok", "n": 3, "x": 0.1, "success": True, "result.a": 1.0},
    {"index": 1, "outcome": "crashed", "success": False, "x": None},
    {"index": 2, "outcome": "ok", "n": (1 << 62) + 1, "x": 1e-300, "success": True, "result.a": 2.5, "late": "ä"},
]


@pytest.fixture
def folder(tmp_path):
    for row in ROWS:
        write_row(tmp_path, row)
    return tmp_path


def test_duckdb_reads_single_rows_and_the_whole_table(folder):
    write_table(folder / "all", ROWS)
    columns = 'index, outcome, n, x, success, "result.a"'
    for file, options in ((f"{folder}/*.parquet", ", union_by_name=true"), (f"{folder}/all", "")):
        found = duckdb.sql(f"select {columns} from read_parquet('{file}'{options}) order by index").fetchall()
        assert found == [
            (0, "ok", 3, 0.1, True, 1.0),
            (1, "crashed", None, None, False, None),
            (2, "ok", (1 << 62) + 1, 1e-300, True, 2.5),
        ]


def test_rows_come_back_as_they_were(folder):
    assert read_rows(folder) == ROWS
    assert read_row(folder, 2) == ROWS[2]
    assert done_rows(folder) == {0, 1, 2}


def test_a_row_that_is_written_again_is_there_once(folder):
    write_row(folder, {**ROWS[1], "outcome": "ok"})
    assert [row["outcome"] for row in read_rows(folder)] == ["ok"] * 3


def test_what_is_no_row_is_no_row(folder):
    (folder / ".00000007.parquet.123.part").write_bytes(b"half")
    (folder / "notes.parquet").write_bytes(b"")
    assert done_rows(folder) == {0, 1, 2}
    assert done_rows(folder / "gone") == set()


def test_a_damaged_row_is_named(folder):
    (folder / "00000001.parquet").write_bytes(b"PAR1 no more")
    with pytest.raises(RowUnreadable, match=r"00000001\.parquet is damaged .*: delete it"):
        read_rows(folder)


def test_a_row_without_space_leaves_nothing(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_row(folder, {**ROWS[0], "index": 9})
    assert sorted(path.name for path in folder.iterdir()) == [f"0000000{k}.parquet" for k in range(3)]
