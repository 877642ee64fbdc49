"""Where results go: folders and files that are known to be writable before the work begins, and replaced whole after it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to write in `path`'s place, with its suffix; it takes the place only if the block succeeds."""
    draft = _draft(path)
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def output_folder(path: Path) -> Path:
    """`path` as a folder that exists and can be written to, which is tried. Raises OSError, one sentence."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise NotADirectoryError(f"{path}: is a file or lies below one, expected a folder") from None
    except OSError as error:
        raise type(error)(f"{path}: the folder can't be made: {error.strerror}") from None
    try:
        with TemporaryFile(dir=path):
            return path
    except OSError as error:
        raise type(error)(f"{path}: the folder can't be written to: {error.strerror}") from None


def output_file(path: Path) -> Path:
    """`path` as a file that can be written, which is tried beside it. Raises OSError, one sentence."""
    output_folder(path.parent)
    draft = _draft(path)
    try:
        draft.touch()
    except OSError as error:
        raise type(error)(f"{path}: the file can't be written: {error.strerror}") from None
    draft.unlink()
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, expected a file to write")
    return path


def _draft(path: Path) -> Path:
    return path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
