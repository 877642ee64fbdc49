"""Where results go: places that are known to be writable before the work begins, and files that are replaced whole after it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def made(folder: Path) -> Iterator[Path]:
    """`folder`, made with its parents where they are missing. Of those made here, the empty ones are removed after the block."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    finally:
        for one in missing:
            with suppress(OSError):  # it holds something
                one.rmdir()


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to write in `path`'s place, with its suffix; it takes the place only if the block succeeds.

    The folder is made if it is missing, and removed again if the block fails.
    """
    draft = _draft(path)
    with made(path.parent):
        try:
            yield draft
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)


def output_folder(path: Path) -> Path:
    """Check that files can be written to the folder `path`, which `replacing` makes if it is missing. Nothing is left of the check.

    Raises:
        OSError: nothing can be written there; one sentence.
    """
    _check(path, Path("x"), path, "folder")
    return path


def output_file(path: Path) -> Path:
    """Check that the file `path` can be written by `replacing`. Nothing is left of the check.

    Raises:
        OSError: it cannot; one sentence.
    """
    _check(path.parent, Path(path.name), path, "file")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, expected a file to write")
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: is a device or a pipe, expected a file to write")
    return path


def _check(folder: Path, name: Path, asked: Path, kind: str) -> None:
    """Write a draft named after `name` in `folder`, or in its nearest parent that exists. asked, kind: what the error is about."""
    try:
        nearest = next(one for one in (folder, *folder.absolute().parents) if one.exists())
        if not nearest.is_dir():
            raise NotADirectoryError(f"{asked}: {nearest} is a file, expected a folder")
        draft = _draft(nearest / name)
        draft.touch()
        draft.unlink()
    except OSError as error:
        if error.strerror is None:
            raise
        raise type(error)(f"{asked}: the {kind} can't be written: {error.strerror}") from None


def _draft(path: Path) -> Path:
    return path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
