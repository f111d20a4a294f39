"""Reads SQLite databases that other programs wrote, without trust in them."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MAGIC = b"SQLite format 3\0"
_MIN_ROW = 4  # bytes that a row takes in a file, at least


class Database:
    """Tables of a database that is open for reading, see `open_database`."""

    def __init__(self, connection: sqlite3.Connection, path: Path, kind: str) -> None:
        self._connection, self.path, self.kind = connection, path, kind
        pages = [connection.execute(f"PRAGMA page_{n}").fetchone()[0] for n in ("count", "size")]
        self._room = math.prod(pages)

    @property
    def user_version(self) -> str:
        """The version that the program gave it: COLMAP 3.11 has 3900, COLMAP 4.2.1 has 4020100."""
        return str(self._connection.execute("PRAGMA user_version").fetchone()[0])

    def columns(self, table: str) -> list[str]:
        """Names of a table's columns, none if there is no such table.

        Raises:
            ValueError: it is a view or has computed columns, which may be endless.
        """
        found = self._connection.execute(
            "SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)
        ).fetchone()
        if found is None:
            return []
        columns = self._connection.execute(f"PRAGMA table_xinfo({table})").fetchall()
        plain = found[0] == "table" and str(found[1]).upper().startswith("CREATE TABLE")
        if not plain or any(hidden for *_, hidden in columns):
            raise ValueError(f"{self.path}: not {self.kind}, as {table} is no plain table")
        return [name for _, name, *_ in columns]

    def rows(self, table: str, columns: str) -> Iterator[tuple[Any, ...]]:
        """The rows of a table, one table at a time, as a join on repeated ids would multiply them.

        Raises:
            ValueError: rows of a malicious file share their bytes, so that they exceed the file.
        """
        names = self.columns(table)
        lacking = [name for name in columns.split(", ") if name not in names]
        if lacking:
            raise ValueError(
                f"{self.path}: not {self.kind}, as "
                + (f"{table} has no column {lacking[0]}" if names else f"it has no table {table}")
            )
        room = self._room
        for row in self._connection.execute(f"SELECT {columns} FROM {table}"):
            room -= _MIN_ROW
            for cell in row:
                if cell.__class__ is bytes or cell.__class__ is str:
                    room -= len(cell)
            if room < 0:
                raise ValueError(f"{self.path}: the rows of {table} exceed the size of the file")
            yield row

    def rows_by_id(
        self, table: str, columns: str, key: str = "id"
    ) -> Iterator[tuple[int, tuple[Any, ...]]]:
        """Ids, which a malicious file may repeat, and the rows of a table.

        Raises:
            ValueError: an id is no whole number, or it occurs twice; or see `rows`.
        """
        ids = set()
        for row_id, *row in self.rows(table, f"{key}, {columns}"):
            if type(row_id) is not int or row_id in ids:
                raise ValueError(
                    f"{self.path}: not {self.kind}, as in {table} the {key} {str(row_id)[:40]!r} "
                    f"{'occurs twice' if row_id in ids else 'is no number'}"
                )
            ids.add(row_id)
            yield row_id, tuple(row)


def blob(cell: Any) -> bytes:
    """The bytes of a cell, none if it is NULL; raises ValueError for anything else."""
    if cell is not None and not isinstance(cell, bytes):
        raise ValueError(f"{str(cell)[:40]!r} is where bytes should be")
    return cell or b""


@contextmanager
def open_database(path: Path, kind: str) -> Iterator[Database]:
    """Open a database for reading; errors of SQLite in the block become ValueErrors.

    Args:
        path: the file.
        kind: what it should be, such as "a COLMAP database".
    """
    # Read-only mode neither creates nor changes a database, which may be open elsewhere. The
    # write-ahead log needs to write files beside it, unless nobody has it open.
    busy = any(path.with_name(path.name + end).exists() for end in ("-wal", "-journal"))
    uri = f"{path.resolve().as_uri()}?mode=ro{'' if busy else '&immutable=1'}"
    try:
        connection = sqlite3.connect(uri, uri=True)
        try:
            yield Database(connection, path, kind)
        finally:
            connection.close()
    except (sqlite3.Error, UnicodeDecodeError) as error:  # of names of tables
        if "locked" in str(error):
            raise ValueError(
                f"{path} is locked: another process writes to it, wait for it"
            ) from None
        raise ValueError(f"{path}: not {kind}, or a broken one ({error})") from None


def has_tables(path: Path, head: bytes, tables: Iterable[str]) -> bool:
    """Whether a file that begins with `head` is a database with these tables."""
    if not head.startswith(MAGIC):
        return False
    try:
        with open_database(path, "a database") as database:
            return all(database.columns(table) for table in tables)
    except ValueError:
        return False
