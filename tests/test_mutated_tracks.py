"""Thousands of broken tracks files and COLMAP databases: ValueError, or read without harm."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mutation import FILES, SEED, bounded, mutated
from protomark.tracks.database import read_features
from protomark.tracks.file import Tracks
from small_tracks import small_tracks

_JUNK: list[Any] = [
    *(None, True, -1, 0, 0.5, 10**30, 2**63, float("inf"), float("nan"), "", "text", "\ud800"),
    *([], {}, [[]], [1, "a", None], {"model": 3}, {"1": {}}, {"x": 1}, "[" * 30_000, "9" * 5000),
]


def mutated_json(value: Any, rng: np.random.Generator) -> Any:
    """A JSON value with one change."""
    if isinstance(value, dict) and value and rng.integers(0, 4):
        key = list(value)[int(rng.integers(0, len(value)))]
        rest = {k: v for k, v in value.items() if k != key}
        return rest if rng.integers(0, 5) == 0 else rest | {key: mutated_json(value[key], rng)}
    if isinstance(value, list) and value and rng.integers(0, 4):
        at = int(rng.integers(0, len(value)))
        return [*value[:at], mutated_json(value[at], rng), *value[at + 1 :]]
    return _JUNK[int(rng.integers(0, len(_JUNK)))]


def mutated_tracks(data: bytes, rng: np.random.Generator) -> bytes:
    """A safetensors file with a change anywhere, in its arrays, in its header or in our JSON."""
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    match rng.integers(0, 5):
        case 0:
            return mutated(data, rng)
        case 1:
            changed = bytearray(body)
            for at in rng.integers(0, len(body), 3):
                changed[at : at + 8] = rng.choice([b"\xff" * 8, b"\0" * 8, rng.bytes(8)])
            body = bytes(changed[: len(body)])
        case 2:
            header = mutated_json(header, rng)
        case _:
            metadata = header["__metadata__"]
            key = list(metadata)[int(rng.integers(0, len(metadata)))]
            try:
                value = json.dumps(mutated_json(json.loads(metadata[key]), rng))
            except ValueError:
                value = str(_JUNK[int(rng.integers(0, len(_JUNK)))])
            if rng.integers(0, 4) == 0:
                value = mutated(value.encode(errors="replace"), rng).decode(errors="replace")
            metadata[key] = value
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + body


def test_broken_tracks_files_are_refused_or_read(tmp_path: Path) -> None:
    print(f"PROTOMARK_SEED={SEED}")
    rng = np.random.default_rng(SEED)
    path = tmp_path / "a.orb.safetensors"
    small_tracks().save(path)
    whole = path.read_bytes()
    Tracks.load(path)
    refused = 0
    with bounded():
        for _ in range(FILES):
            path.unlink()
            path.write_bytes(mutated_tracks(whole, rng))
            unnamed = False
            try:
                read = Tracks.load(path)
            except ValueError as error:
                unnamed = not str(error).startswith(f"{path}: ")
                refused += 1
                read = None
            assert not unnamed
            if read is None:
                continue
            # What was read is what a tracks file holds, whatever it says.
            assert all(isinstance(name, str) for name in [*read.keyframe_names, read.descriptor])
            assert all(isinstance(c.width, int) and c.width > 0 for c in read.cameras.values())
            assert all(np.isfinite(c.params).all() for c in read.cameras.values())
            assert isinstance(read.info, dict)
            assert sum(len(read.keypoints[read.keypoints_of(i)]) for i in range(2)) == 40
    print(f"{refused} of {FILES} refused")
    assert FILES / 4 < refused < FILES


@pytest.fixture
def database(tmp_path: Path) -> Path:
    path = tmp_path / "database.db"
    rng = np.random.default_rng(0)
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
    for table in ("keypoints", "descriptors"):
        connection.execute(
            f"CREATE TABLE {table} (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, "
            "data BLOB)"
        )
    for i in range(3):
        keypoints = rng.uniform(1, 100, (20, 4)).astype("<f4")
        connection.execute("INSERT INTO images VALUES (?, ?)", (i, f"{i}.png"))
        connection.execute("INSERT INTO keypoints VALUES (?, 20, 4, ?)", (i, keypoints.tobytes()))
        connection.execute("INSERT INTO descriptors VALUES (?, 20, 32, ?)", (i, rng.bytes(640)))
    connection.commit()
    connection.close()
    return path


def read_database(path: Path) -> None:
    for name, features in read_features(path, "orb").items():
        assert isinstance(name, str)
        assert len(features.descriptors) == len(features.keypoints) == len(features.sizes)
        for values in (features.keypoints, features.sizes, features.angles):
            assert np.isfinite(values).all()


def change_cell(path: Path, rng: np.random.Generator) -> None:
    """Any value in any column, as SQLite lets one put it."""
    junk = [None, -1, 0, 1, 2, 3, 4, 6, 7, 2**31, 2**62, 0.5, 1e300, "text", "20", b"", b"\0" * 320]
    nan = np.full((20, 4), rng.choice([np.nan, np.inf, 1e38, -1]), "<f4").tobytes()
    value = ([*junk, nan])[int(rng.integers(0, len(junk) + 1))]
    table, column = [
        ("images", "name"),
        *[(t, c) for t in ("keypoints", "descriptors") for c in ("rows", "cols", "data")],
    ][int(rng.integers(0, 7))]
    row = int(rng.integers(0, 3))
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA synchronous = OFF")
    connection.execute(f"UPDATE {table} SET {column} = ? WHERE image_id = ?", (value, row))
    connection.commit()
    connection.close()


def change_bytes(path: Path, rng: np.random.Generator) -> None:
    path.write_bytes(mutated(path.read_bytes(), rng))


@pytest.mark.parametrize(("change", "files"), [(change_cell, 300), (change_bytes, 1500)])
def test_broken_databases_are_refused_or_read(
    change: Callable[[Path, np.random.Generator], None], files: int, database: Path
) -> None:
    print(f"PROTOMARK_SEED={SEED}")
    rng = np.random.default_rng(SEED)
    whole = database.read_bytes()
    read_database(database)
    refused = 0
    with bounded():
        for _ in range(files):
            database.write_bytes(whole)
            change(database, rng)
            try:
                read_database(database)
            except ValueError:
                refused += 1
    print(f"{refused} of {files} refused")
    assert files / 10 < refused < files


@pytest.mark.parametrize("table", ["images", "keypoints", "descriptors"])
@pytest.mark.parametrize("image_id", [1, None, "1", 0.5])
def test_an_image_has_one_row_in_each_table(table: str, image_id: Any, database: Path) -> None:
    connection = sqlite3.connect(database)
    # A stranger's table needs no primary key.
    connection.execute(f"ALTER TABLE {table} RENAME TO old")
    connection.execute(f"CREATE TABLE {table} AS SELECT * FROM old")
    connection.commit()
    read_database(database)
    connection.execute(f"INSERT INTO {table} SELECT * FROM old WHERE image_id = 1")
    connection.execute(
        f"UPDATE {table} SET image_id = ? WHERE rowid = (SELECT max(rowid) FROM {table})",
        (image_id,),
    )
    connection.commit()
    connection.close()
    with pytest.raises(ValueError, match=rf"database\.db: .*{table}.* image_id"):
        read_database(database)


def test_images_have_names_of_their_own(database: Path) -> None:
    connection = sqlite3.connect(database)
    connection.execute("UPDATE images SET name = '0.png' WHERE image_id = 1")
    connection.commit()
    connection.close()
    with pytest.raises(ValueError, match=r"two images have the name 0\.png"):
        read_database(database)


def test_rows_may_not_share_their_bytes(database: Path) -> None:
    connection = sqlite3.connect(database)
    (page_size,) = connection.execute("PRAGMA page_size").fetchone()
    connection.execute("UPDATE keypoints SET rows = 20000, cols = 2, data = zeroblob(160000)")
    connection.commit()
    connection.execute("VACUUM")
    find_root = "SELECT rootpage FROM sqlite_master WHERE name = 'keypoints'"
    root = (connection.execute(find_root).fetchone()[0] - 1) * page_size
    connection.close()
    data = bytearray(database.read_bytes())
    # A cell of the table's one page ends in the number of the first page of the rest of its blob
    # (https://www.sqlite.org/fileformat2.html#b_tree_pages); here all get the first one's.
    starts = [int.from_bytes(data[root + a : root + a + 2], "big") for a in (8, 10, 12)]
    length = starts[0] - starts[1]
    ends = [root + start + length for start in starts]
    pages = [int.from_bytes(data[end - 4 : end], "big") for end in ends]
    assert root < page_size * pages[0] < page_size * pages[1] < page_size * pages[2] < len(data)
    for end in ends:
        data[end - 4 : end] = pages[0].to_bytes(4, "big")
    data = data[: (pages[1] - 1) * page_size]
    data[28:32] = (len(data) // page_size).to_bytes(4, "big")
    database.write_bytes(data)
    with pytest.raises(ValueError, match="the rows of keypoints exceed the size of the file"):
        read_database(database)


def test_a_small_database_does_not_take_long(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE images (image_id INTEGER, name TEXT)")
    connection.executemany("INSERT INTO images VALUES (1, ?)", [(str(i),) for i in range(500)])
    for table in ("keypoints", "descriptors"):
        connection.execute(
            f"CREATE TABLE {table} (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)"
        )
        connection.execute(
            f"INSERT INTO {table} SELECT 1, 0, {2 if table == 'keypoints' else 32}, x'' FROM images"
        )
    connection.commit()
    connection.close()
    # Joined, it has 125 million rows.
    with bounded(seconds=60), pytest.raises(ValueError, match="image_id '1' occurs twice"):
        read_database(path)


@pytest.mark.parametrize(
    "sql",
    [
        # Never ends.
        "DROP TABLE keypoints; CREATE VIEW keypoints AS WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL "
        "SELECT i + 1 FROM n) SELECT i AS image_id, 0 AS rows, 2 AS cols, NULL AS data FROM n",
        # A gigabyte that the file does not hold.
        "DROP TABLE keypoints; CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER"
        ", data BLOB AS (zeroblob(900000000))); INSERT INTO keypoints VALUES (1, 20, 4)",
    ],
    ids=["view", "computed column"],
)
def test_a_database_may_only_hold_what_it_holds(sql: str, database: Path) -> None:
    connection = sqlite3.connect(database)
    connection.executescript(sql)
    connection.close()
    with bounded(seconds=30), pytest.raises(ValueError, match=r"database\.db: .*keypoints"):
        read_database(database)
