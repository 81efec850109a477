"""CSV text (UTF-8, one header line, commas) as columns of text, with the line number of each row."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from network_calib.errors import InputError
from network_calib.formats.recording import read_text


@dataclass(frozen=True, slots=True)
class ColumnNames:
    """What a header may hold.

    Attributes:
        required: names that must be there.
        known: names that may be there.
        expected: the same in words.
    """

    required: tuple[str, ...]
    known: tuple[str, ...]
    expected: str


def csv_columns(path: Path, names: ColumnNames) -> tuple[dict[str, list[str]], Sequence[int]]:
    """Columns by name, as text, and the line number of each row.

    Raises:
        InputError: no text, a header that does not fit, uneven rows, or no rows.
    """
    text = read_text(path)
    header, columns, lines = _split_plain(text) or _split_any(path, text, names)
    _check_header(path, header, names)
    if not lines:
        raise InputError(f"{path} has a header but no rows")
    return dict(zip(header, columns, strict=True)), lines


def _split_plain(text: str) -> tuple[list[str], list[list[str]], Sequence[int]] | None:
    """Split a table without quotes, blank lines and uneven rows at once, several times faster than row by row.

    None when it is not so plain.
    """
    rows = text.rstrip("\r\n").replace("\r\n", "\n").split("\n")
    header = [name.strip() for name in rows[0].split(",")]
    if '"' in text or "\r" in rows[0] or {row.count(",") for row in rows} != {len(header) - 1} or len(header) < 2:
        return None
    del rows[0]
    fields = ",".join(rows).split(",") if rows else []
    return header, [fields[k :: len(header)] for k in range(len(header))], range(2, len(rows) + 2)


def _split_any(path: Path, text: str, names: ColumnNames) -> tuple[list[str], list[list[str]], Sequence[int]]:
    """Split any CSV text, and say which line is at fault."""
    lines: list[int] = []
    rows: list[list[str]] = []
    reader = csv.reader(io.StringIO(text), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        _check_header(path, header, names)
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise InputError(f"{path}, line {reader.line_num}: {len(row)} fields, expected {len(header)}")
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {error}") from None
    return header, [list(column) for column in zip(*rows, strict=True)] or [[] for _ in header], lines


def _check_header(path: Path, header: list[str], names: ColumnNames) -> None:
    if not header:
        raise InputError(f"{path} is empty, {names.expected}")
    missing = [name for name in names.required if name not in header]
    if missing:
        raise InputError(f"{path}, line 1: columns {', '.join(missing)} missing in {header}, {names.expected}")
    unknown = [name for name in header if name not in names.known]
    if unknown:
        raise InputError(f"{path}, line 1: unknown columns {unknown}, {names.expected}")
    if len(set(header)) != len(header):
        raise InputError(f"{path}, line 1: a column stands there twice: {header}")
