"""Reader of text tables: CSV as spreadsheets, loggers and `numpy.savetxt` write it.

It recognises separators, decimal commas, comments, units and dates. Columns that no log needs are
not parsed.
"""

from __future__ import annotations

import codecs
import csv
import io
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import IO, Any

import attrs
import numpy as np

from quadvel_description.arrays import Floats
from quadvel_description.name_list import format_names

from ..log import LogError
from . import units
from .names import TIME_FIELDS
from .raw import MAX_LINE_CHARS, MAX_TEXT_CHARS, MAX_VALUES, ColumnChooser, RawArrays, field_dtype, open_bytes

SEPARATORS = (",", ";", "\t", "|")
MAX_BLOCK_LINES = 20_000
"""Lines of a table that are parsed together."""
SAMPLE_LINES = 100
"""Lines below the head from which the decimal mark and a row of units are recognised."""
MAX_BLOCK_CHARS = 1 << 23
"""Characters that are parsed together."""
MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-")
EXPECTED_HEAD = "expected t, q/FR_hip_joint, ..."

Line = tuple[int, str]
"""Number of a line, from 1, and its text."""


@attrs.frozen
class _Dialect:
    """How the cells of a table are written.

    Attributes:
        separator: Character between cells; None for white space.
        columns: Names of the columns.
        decimal_comma: Whether numbers are written as 0,5.
    """

    separator: str | None
    columns: Sequence[str]
    decimal_comma: bool = False

    def cells(self, line: str) -> list[str]:
        """Split one line into cells, without quotes and surrounding spaces."""
        return next(self.rows([line]))

    def rows(self, lines: Iterator[str] | Sequence[str]) -> Iterator[list[str]]:
        """Split lines into rows of cells; a quoted cell may span several lines."""
        if self.separator is None:
            return (line.split() for line in lines)
        reader = csv.reader(lines, delimiter=self.separator, skipinitialspace=True)
        return ([cell.strip() for cell in row] for row in reader)

    def number(self, cell: str, time: bool = False) -> Any:
        """Parse a number, truth value, date or list of numbers; raises ValueError."""
        plain = cell.lower()
        if plain in MISSING:
            return np.nan
        if plain in ("true", "false"):
            return float(plain == "true")
        if cell.startswith("["):
            return json.loads(cell)
        if time and ":" in cell:
            return _seconds(cell)
        return float(_decimal_point(cell) if self.decimal_comma else cell)


def _seconds(cell: str) -> float:
    """Convert an ISO 8601 date to seconds since 1970, a time of day to seconds since midnight."""
    date = datetime.fromisoformat(cell if re.match(r"\d{4}-?\d\d", cell) else f"1970-01-01T{cell}")
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _decimal_point(text: str) -> str:
    """Replace decimal commas by points."""
    return text.replace(",", ".")


def _is_number(cell: str) -> bool:
    """Whether a cell holds a number."""
    return (
        re.fullmatch(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?|nan|[+-]?inf", cell, re.IGNORECASE)
        is not None
    )


def _is_value(cell: str) -> bool:
    """Whether a cell holds a number, truth value, date or list of numbers, or marks a missing value."""
    try:
        return _is_number(cell) or _Dialect(None, ()).number(cell, time=True) is not None
    except (ValueError, RecursionError):
        return False


def _is_row(cells: Sequence[str]) -> bool:
    """Whether most of the cells that are not empty hold values, so that they are no head."""
    filled = [cell for cell in cells if cell]
    return 2 * sum(map(_is_value, filled)) > len(filled)


def read(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read the selected columns of a text table.

    Args:
        path: The file.
        choose: Selects the columns to read.

    Returns:
        The selected columns, with the units that the table states.

    Raises:
        LogError: The table has no head or no rows, or a cell is wrong; the message names line and
            column.
    """
    with _open_text(path) as file:
        try:
            return _read(path, file, choose)
        except csv.Error as error:
            raise LogError(f"{path}: no table: {error}") from None


def _read(path: Path, file: IO[str], choose: ColumnChooser) -> RawArrays:
    """Read the table from an open file."""
    lines = _lines(path, file)
    form, stated, begin = _read_head(path, lines, choose)
    chosen = _chosen(path, form.columns, choose)
    first = list(_block(chain(begin, lines), SAMPLE_LINES))
    below = _units_below(form, chosen, first)
    if below:
        stated, first = stated | below, first[1:]
    form = attrs.evolve(form, decimal_comma=_has_decimal_comma(form, first))
    remarks = [f"{next(iter(chosen))}: the row below the head holds units"] if below else []
    blocks = list(_blocks(path, chain(first, lines), form, chosen, remarks))
    if not blocks:
        raise LogError(f"{path}: {next(iter(chosen))}: the table has no rows")
    return RawArrays(
        {name: np.concatenate([block[i] for block in blocks]) for i, name in enumerate(chosen)},
        tuple(name for name in form.columns if name not in chosen),
        {name: unit for name, unit in stated.items() if name in chosen and unit},
        tuple(remarks),
    )


def _open_text(path: Path) -> IO[str]:
    """Open a file as text: UTF-8, or UTF-16 with a byte order mark."""
    with open_bytes(path) as file:
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return io.TextIOWrapper(open_bytes(path), encoding="utf-16" if wide else "utf-8-sig", errors="replace")


def _lines(path: Path, file: IO[str]) -> Iterator[Line]:
    """Yield the lines that are not empty; raises LogError if the text is too long for a log."""
    length = number = 0
    while line := file.readline(MAX_LINE_CHARS):
        number += 1
        length += len(line)
        if length > MAX_TEXT_CHARS:
            raise LogError(f"{path}: more than {MAX_TEXT_CHARS} characters, expected fewer; cut the log")
        if number == 1 and ("\0" in line or not line.endswith("\n")):
            raise LogError(f"{path}: the first line is no head, {EXPECTED_HEAD}")
        if not line.isspace():
            yield number, line


def _read_head(
    path: Path, lines: Iterator[Line], choose: ColumnChooser
) -> tuple[_Dialect, dict[str, str], list[Line]]:
    """Read the head: the dialect, the units it states, and the first row if that was read.

    `numpy.savetxt` writes the head as a comment. pandas numbers columns without a name: a line of
    numbers counts as a head if it names the time, or if a map names one of the numbers.
    """
    comment, begin = "", (0, "")
    for begin in lines:
        if not begin[1].lstrip().startswith("#") and not re.match(r'"?sep=', begin[1]):
            break
        comment = begin[1].lstrip(" #\t")
    head = begin[1]
    form = _Dialect(_separator(head), ())
    cells, rows = form.cells(head), []
    named_fields = choose(cells)
    is_named = any(field in TIME_FIELDS for field in named_fields.values())
    if _is_row(cells) and not is_named and not any(map(_is_number, named_fields)):
        cells, rows = form.cells(comment) if comment else [], [begin]
        if len(cells) != len(form.cells(head)) or _is_row(cells):
            found = f"found the numbers {head.strip()[:40]}"
            raise LogError(f"{path}: line {begin[0]}: {found}, but no head above them; {EXPECTED_HEAD}")
    named = [units.split_unit(cell) for cell in cells]
    return attrs.evolve(form, columns=[name for name, _ in named]), dict(named), rows


def _separator(head: str) -> str | None:
    """Guess the separator of a line; None for white space."""
    bare = re.sub(r'"[^"]*"', "", head)
    for one in SEPARATORS[1:]:
        if one in bare and _is_row(_Dialect(one, ()).cells(head)):
            return one
    most = max(SEPARATORS, key=bare.count)
    return most if most in bare or len(head.split()) == 1 else None


def _chosen(path: Path, columns: Sequence[str], choose: ColumnChooser) -> Mapping[str, str]:
    """The columns that are needed, each with its field, in the order of the table."""
    chosen = choose(columns)
    if not chosen:
        there = format_names(columns, 12)
        raise LogError(
            f"{path}: t: no such column in the head ({there}); {EXPECTED_HEAD}, or --columns MAPFILE for other names"
        )
    for column, times in Counter(columns).items():
        if times > 1 and column in chosen:
            raise LogError(f"{path}: {column}: the column stands there twice")
    return {column: chosen[column] for column in columns if column in chosen}


def _units_below(form: _Dialect, chosen: Mapping[str, str], first: Sequence[Line]) -> dict[str, str]:
    """The units of the chosen columns, if the row below the head holds units and no number."""
    cells = form.cells(first[0][1]) if first else []
    if len(cells) != len(form.columns):
        return {}
    stated = {
        name: cell.strip("[]() ") for name, cell in zip(form.columns, cells, strict=True) if name in chosen
    }
    known = [unit for unit in stated.values() if units.si_factor(unit) is not None and not _is_number(unit)]
    return stated if known and not any(map(_is_number, stated.values())) else {}


def _has_decimal_comma(form: _Dialect, lines: Sequence[Line]) -> bool:
    """Whether numbers are written as 0,5; with commas between the cells such numbers are quoted."""
    cells = chain.from_iterable(form.cells(line) for _, line in lines)
    return any(re.fullmatch(r"[+-]?\d*,\d+(e[+-]?\d+)?", cell, re.IGNORECASE) for cell in cells)


def _blocks(
    path: Path, lines: Iterator[Line], form: _Dialect, chosen: Mapping[str, str], remarks: list[str]
) -> Iterator[list[Floats]]:
    """Yield the chosen columns, block by block of lines."""
    # Expected number of values, if a cell has eight characters.
    values = max(1, path.stat().st_size // max(1, 2 * len(form.columns))) * len(chosen) // 4
    rows = 0
    while block := list(_block(lines)):
        found = _parse_numeric(form, block, chosen)
        if found is None:
            found = _parse_cells(path, form, block, lines, chosen, remarks)
        rows += len(found[0])
        if rows * sum(max(1, part.size // max(1, len(part))) for part in found) > MAX_VALUES:
            raise LogError(f"{path}: more than {MAX_VALUES} values, expected fewer; cut the log")
        yield [
            part.astype(field_dtype(field, values))
            for part, field in zip(found, chosen.values(), strict=True)
        ]


def _block(lines: Iterator[Line], most: int = MAX_BLOCK_LINES) -> Iterator[Line]:
    """Yield the lines of the next block, without comments."""
    length = count = 0
    for number, line in lines:
        if line.lstrip().startswith("#"):
            continue
        yield number, line
        length, count = length + len(line), count + 1
        if length > MAX_BLOCK_CHARS or count == most:
            return


def _parse_numeric(form: _Dialect, block: Sequence[Line], chosen: Mapping[str, str]) -> list[Floats] | None:
    """Parse lines whose chosen cells hold plain numbers or nothing; None if one does not."""
    separator = form.separator
    lines = [line.strip() if separator is None else line.strip("\r\n ") for _, line in block]
    text = "".join(lines)
    if '"' in text or "[" in text or (separator == "," and form.decimal_comma):
        return None
    cells = len(form.columns)
    if any(
        (len(line.split()) if separator is None else line.count(separator) + 1) != cells for line in lines
    ):
        return None
    if separator is not None:
        mark = re.escape(separator)
        empty = re.compile(rf"(?<={mark})[ \t]*(?={mark}|$)" if separator != "\t" else r"(?<=\t) *(?=\t|$)")
        lines = [empty.sub("nan", separator + line)[1:] for line in lines]
    if form.decimal_comma:
        lines = [_decimal_point(line) for line in lines]
    lines = [line.replace("True", "1").replace("False", "0") for line in lines]
    wanted = [k for k, name in enumerate(form.columns) if name in chosen]
    try:
        return list(np.loadtxt(lines, delimiter=separator, usecols=wanted, ndmin=2, comments=None).T)
    except ValueError:
        return None


def _parse_cells(
    path: Path,
    form: _Dialect,
    block: list[Line],
    lines: Iterator[Line],
    chosen: Mapping[str, str],
    remarks: list[str],
) -> list[Floats]:
    """Parse cells of every kind that `_Dialect.number` reads; a quoted one may span lines."""
    rows = _split_rows(path, form, block, lines, remarks)
    found = []
    for k, name in enumerate(form.columns):
        if name in chosen:
            cells = [
                _parse_cell(path, form, number, name, row[k], chosen[name] in TIME_FIELDS)
                for number, row in rows
            ]
            try:
                found.append(np.array(cells, dtype=float))
            except (ValueError, TypeError):
                raise LogError(
                    f"{path}: {name}: found lists of unlike length, expected a number for each joint"
                ) from None
    return found


def _split_rows(
    path: Path, form: _Dialect, block: list[Line], lines: Iterator[Line], remarks: list[str]
) -> list[tuple[int, list[str]]]:
    """Line number and cells of each row; a truncated row at the end is left out, with a remark."""
    at, (last, ending) = 0, block[-1]

    def text() -> Iterator[str]:
        nonlocal at
        for number, line in chain(block, lines):
            at = number
            yield line

    rows: list[tuple[int, list[str]]] = []
    for cells in form.rows(text()):
        if len(cells) == len(form.columns) + 1 and not cells[-1]:
            cells = cells[:-1]
        if len(cells) == len(form.columns):
            rows.append((at, cells))
        elif at == last and not ending.endswith("\n") and len(cells) < len(form.columns):
            remarks.append(f"{form.columns[0]}: line {at}, the last one, is truncated and left out")
        else:
            between = {None: "spaces", ",": "commas", "\t": "tabs"}.get(form.separator, f"'{form.separator}'")
            expected = f"expected {len(form.columns)} as the head has, with {between} between"
            raise LogError(f"{path}: line {at}: found {len(cells)} cells, {expected}")
        if at >= last:
            break
    return rows


def _parse_cell(path: Path, form: _Dialect, line: int, column: str, cell: str, time: bool) -> Any:
    """Parse one cell; raises LogError with the line and the column."""
    try:
        return form.number(cell, time)
    except (ValueError, RecursionError):
        date = " or a date such as 2026-03-01T10:00:00.005" if time else ""
        expected = f"expected a number with a decimal point{date}"
        raise LogError(f"{path}: line {line}: {column}: found {cell[:60]!r}, {expected}") from None
