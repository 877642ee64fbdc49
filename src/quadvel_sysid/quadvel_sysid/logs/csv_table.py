"""Tables of text: CSV as spreadsheets, loggers and `numpy.savetxt` write it.

Separators, decimal commas, comments, units and dates are recognised; columns that no log needs are skipped unread.
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

from . import units
from .log import Array, LogError
from .names import TIMES
from .raw import LARGEST, LARGEST_TEXT, LONGEST_LINE, Choose, Raw, opened, type_of

SEPARATORS = (",", ";", "\t", "|")
LINES = 20_000
"""Lines of a table that are read at once."""
SEEN = 100
"""Lines below the head that tell how numbers are written."""
BLOCK = 1 << 23
"""Characters that are read at once."""
MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-")
EXPECTED = "expected t, q/FR_hip_joint, ..."

Line = tuple[int, str]
"""The number of a line, from 1, and its text."""


@attrs.frozen
class _Form:
    """How the cells of a table are written. separator: None for white space."""

    separator: str | None
    columns: Sequence[str]
    decimal_comma: bool = False

    def cells(self, line: str) -> list[str]:
        """The cells of one line, without spaces around and quotes."""
        return next(self.rows([line]))

    def rows(self, lines: Iterator[str] | Sequence[str]) -> Iterator[list[str]]:
        """The same of many; a quoted cell may go over several lines."""
        if self.separator is None:
            return (line.split() for line in lines)
        reader = csv.reader(lines, delimiter=self.separator, skipinitialspace=True)
        return ([cell.strip() for cell in row] for row in reader)

    def number(self, cell: str, time: bool = False) -> Any:
        """The number, truth value, date or list of numbers in a cell. Raises ValueError."""
        plain = cell.lower()
        if plain in MISSING:
            return np.nan
        if plain in ("true", "false"):
            return float(plain == "true")
        if cell.startswith("["):
            return json.loads(cell)
        if time and ":" in cell:
            return _seconds(cell)
        return float(_with_point(cell) if self.decimal_comma else cell)


def _seconds(cell: str) -> float:
    """A date of ISO 8601 as seconds since 1970, a time of the day as seconds since midnight."""
    date = datetime.fromisoformat(cell if re.match(r"\d{4}-?\d\d", cell) else f"1970-01-01T{cell}")
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _with_point(text: str) -> str:
    return text.replace(",", ".")


def _is_number(cell: str) -> bool:
    return (
        re.fullmatch(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?|nan|[+-]?inf", cell, re.IGNORECASE)
        is not None
    )


def read(path: Path, choose: Choose) -> Raw:
    """The columns that `choose` names. Raises LogError, which names the line and the column."""
    with _text(path) as file:
        try:
            return _read(path, file, choose)
        except csv.Error as error:
            raise LogError(f"{path}: no table: {error}") from None


def _read(path: Path, file: IO[str], choose: Choose) -> Raw:
    lines = _lines(path, file)
    form, stated, begin = _head(path, lines)
    chosen = _chosen(path, form.columns, choose)
    first = list(_block(chain(begin, lines), SEEN))
    below = _units_below(form, chosen, first)
    if below:
        stated, first = stated | below, first[1:]
    form = attrs.evolve(form, decimal_comma=_has_decimal_comma(form, first))
    remarks = [f"{next(iter(chosen))}: the row below the head holds units"] if below else []
    blocks = list(_blocks(path, chain(first, lines), form, chosen, remarks))
    if not blocks:
        raise LogError(f"{path}: {next(iter(chosen))}: the table has no rows")
    return Raw(
        {name: np.concatenate([block[i] for block in blocks]) for i, name in enumerate(chosen)},
        tuple(name for name in form.columns if name not in chosen),
        {name: unit for name, unit in stated.items() if name in chosen and unit},
        tuple(remarks),
    )


def _text(path: Path) -> IO[str]:
    with opened(path) as file:
        wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return io.TextIOWrapper(opened(path), encoding="utf-16" if wide else "utf-8-sig", errors="replace")


def _lines(path: Path, file: IO[str]) -> Iterator[Line]:
    """The lines that are not empty. Raises LogError where the text is longer than a log can be."""
    length = number = 0
    while line := file.readline(LONGEST_LINE):
        number += 1
        length += len(line)
        if length > LARGEST_TEXT:
            raise LogError(f"{path}: more than {LARGEST_TEXT} characters, expected fewer; cut the log")
        if number == 1 and ("\0" in line or not line.endswith("\n")):
            raise LogError(f"{path}: the first line is no head, {EXPECTED}")
        if not line.isspace():
            yield number, line


def _head(path: Path, lines: Iterator[Line]) -> tuple[_Form, dict[str, str], list[Line]]:
    """How the table is written, the units that its head states, and the first row where that was read.

    `numpy.savetxt` writes the head as a comment.
    """
    comment, begin = "", (0, "")
    for begin in lines:
        if not begin[1].lstrip().startswith("#") and not re.match(r'"?sep=', begin[1]):
            break
        comment = begin[1].lstrip(" #\t")
    head = begin[1]
    form = _Form(_separator(head), ())
    cells, rows = form.cells(head), []
    if all(map(_is_number, cells)):
        cells, rows = form.cells(comment) if comment else [], [begin]
        if len(cells) != len(form.cells(head)) or all(map(_is_number, cells)):
            found = f"found the numbers {head.strip()[:40]}"
            raise LogError(f"{path}: line {begin[0]}: {found}, but no head above them; {EXPECTED}")
    named = [units.name_and_unit(cell) for cell in cells]
    return attrs.evolve(form, columns=[name for name, _ in named]), dict(named), rows


def _separator(head: str) -> str | None:
    """What stands between the cells of a line, None for white space."""
    bare = re.sub(r'"[^"]*"', "", head)
    for one in SEPARATORS[1:]:
        if one in bare and all(map(_is_number, _Form(one, ()).cells(head))):
            return one
    most = max(SEPARATORS, key=bare.count)
    return most if most in bare or len(head.split()) == 1 else None


def _chosen(path: Path, columns: Sequence[str], choose: Choose) -> Mapping[str, str]:
    """The columns that are needed, each with its field."""
    chosen = choose(columns)
    if not chosen:
        there = ", ".join(columns)[:60]
        raise LogError(f"{path}: t: no such column in the head ({there}); {EXPECTED}")
    for column, times in Counter(columns).items():
        if times > 1 and column in chosen:
            raise LogError(f"{path}: {column}: the column stands there twice")
    return {column: chosen[column] for column in columns if column in chosen}


def _units_below(form: _Form, chosen: Mapping[str, str], first: Sequence[Line]) -> dict[str, str]:
    """The units of the chosen columns, where the row below the head holds units and no number."""
    cells = form.cells(first[0][1]) if first else []
    if len(cells) != len(form.columns):
        return {}
    stated = {
        name: cell.strip("[]() ") for name, cell in zip(form.columns, cells, strict=True) if name in chosen
    }
    known = [unit for unit in stated.values() if units.factor(unit) is not None and not _is_number(unit)]
    return stated if known and not any(map(_is_number, stated.values())) else {}


def _has_decimal_comma(form: _Form, lines: Sequence[Line]) -> bool:
    """Whether numbers are written as 0,5, which with commas between the cells takes quotes."""
    cells = chain.from_iterable(form.cells(line) for _, line in lines)
    return any(re.fullmatch(r"[+-]?\d*,\d+(e[+-]?\d+)?", cell, re.IGNORECASE) for cell in cells)


def _blocks(
    path: Path, lines: Iterator[Line], form: _Form, chosen: Mapping[str, str], remarks: list[str]
) -> Iterator[list[Array]]:
    """The chosen columns, some lines of each."""
    values = (
        max(1, path.stat().st_size // max(1, 2 * len(form.columns))) * len(chosen) // 4
    )  # of eight characters
    rows = 0
    while block := list(_block(lines)):
        found = _plain(form, block, chosen)
        if found is None:
            found = _any(path, form, block, lines, chosen, remarks)
        rows += len(found[0])
        if rows * sum(max(1, part.size // max(1, len(part))) for part in found) > LARGEST:
            raise LogError(f"{path}: more than {LARGEST} values, expected fewer; cut the log")
        yield [
            part.astype(type_of(field, values)) for part, field in zip(found, chosen.values(), strict=True)
        ]


def _block(lines: Iterator[Line], most: int = LINES) -> Iterator[Line]:
    """The next lines, as many as are read at once, without comments."""
    length = count = 0
    for number, line in lines:
        if line.lstrip().startswith("#"):
            continue
        yield number, line
        length, count = length + len(line), count + 1
        if length > BLOCK or count == most:
            return


def _plain(form: _Form, block: Sequence[Line], chosen: Mapping[str, str]) -> list[Array] | None:
    """The chosen columns of lines that hold a number, or nothing, in each of these cells; otherwise None."""
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
        lines = [_with_point(line) for line in lines]
    lines = [line.replace("True", "1").replace("False", "0") for line in lines]
    wanted = [k for k, name in enumerate(form.columns) if name in chosen]
    try:
        return list(np.loadtxt(lines, delimiter=separator, usecols=wanted, ndmin=2, comments=None).T)
    except ValueError:
        return None


def _any(
    path: Path,
    form: _Form,
    block: list[Line],
    lines: Iterator[Line],
    chosen: Mapping[str, str],
    remarks: list[str],
) -> list[Array]:
    """The same of cells of every kind that `_Form.number` reads; a quoted cell may take further lines."""
    rows = _rows(path, form, block, lines, remarks)
    found = []
    for k, name in enumerate(form.columns):
        if name in chosen:
            cells = [_value(path, form, number, name, row[k], chosen[name] in TIMES) for number, row in rows]
            try:
                found.append(np.array(cells, dtype=float))
            except (ValueError, TypeError):
                raise LogError(
                    f"{path}: {name}: found lists of unlike length, expected a number for each joint"
                ) from None
    return found


def _rows(
    path: Path, form: _Form, block: list[Line], lines: Iterator[Line], remarks: list[str]
) -> list[tuple[int, list[str]]]:
    """Number and cells of each row, as many cells as the head has; half a row at the end is left out."""
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
            remarks.append(f"{form.columns[0]}: line {at}, the last one, was cut off and is left out")
        else:
            between = {None: "spaces", ",": "commas", "\t": "tabs"}.get(form.separator, f"'{form.separator}'")
            expected = f"expected {len(form.columns)} as the head has, with {between} between"
            raise LogError(f"{path}: line {at}: found {len(cells)} cells, {expected}")
        if at >= last:
            break
    return rows


def _value(path: Path, form: _Form, line: int, column: str, cell: str, time: bool) -> Any:
    try:
        return form.number(cell, time)
    except (ValueError, RecursionError):
        date = " or a date such as 2026-03-01T10:00:00.005" if time else ""
        expected = f"expected a number with a decimal point{date}"
        raise LogError(f"{path}: line {line}: {column}: found {cell[:60]!r}, {expected}") from None
