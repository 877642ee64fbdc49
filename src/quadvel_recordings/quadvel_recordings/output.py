"""Writes output files atomically, and checks before the work that output paths are writable."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def created_folder(folder: Path) -> Iterator[Path]:
    """Create a folder with its parents, and remove the new empty ones after the block.

    Args:
        folder: The folder.

    Yields:
        The same path.
    """
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    finally:
        for one in missing:
            with suppress(OSError):  # it is not empty
                one.rmdir()


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Write a file atomically: the draft replaces `path` only if the block succeeds.

    A missing folder is created, and removed again if the block fails.

    Args:
        path: File to write.

    Yields:
        Path of the draft in the same folder, with the same suffix.
    """
    draft = _draft_path(path)
    with created_folder(path.parent):
        try:
            yield draft
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)


def output_folder(path: Path) -> Path:
    """Check that files can be written to a folder, without leaving a trace.

    `atomic_write` creates a missing folder later.

    Args:
        path: The folder.

    Returns:
        The same path.

    Raises:
        OSError: The folder is not writable; the message is one sentence.
    """
    _check_writable(path, Path("x"), path, "folder")
    return path


def output_file(path: Path) -> Path:
    """Check that a file can be written by `atomic_write`, without leaving a trace.

    Args:
        path: The file.

    Returns:
        The same path.

    Raises:
        OSError: The file is not writable; the message is one sentence.
    """
    if path.name:  # "." and "/" have none
        _check_writable(path.parent, Path(path.name), path, "file")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, expected a file to write")
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: is a device or a pipe, expected a file to write")
    return path


def output_recording(path: Path) -> Path:
    """Check that a new MCAP file can be written, without leaving a trace.

    Args:
        path: The file.

    Returns:
        The same path.

    Raises:
        ValueError: Its suffix is another one: no command would read it.
        OSError: The file exists, or is not writable; the message is one sentence.
    """
    if path.suffix != ".mcap":
        raise ValueError(f"{path}: the suffix is '{path.suffix}', expected .mcap")
    if path.exists():
        raise FileExistsError(f"{path} exists already; name another file")
    return output_file(path)


def _check_writable(folder: Path, name: Path, requested: Path, kind: str) -> None:
    """Touch and delete a draft in `folder` or in its nearest existing parent.

    `requested` and `kind` appear in the error message.
    """
    try:
        nearest = next(one for one in (folder, *folder.absolute().parents) if one.exists())
        if not nearest.is_dir():
            raise NotADirectoryError(f"{requested}: {nearest} is a file, expected a folder")
        draft = _draft_path(nearest / name)
        draft.touch()
        draft.unlink()
    except OSError as error:
        if error.strerror is None:
            raise
        raise type(error)(f"{requested}: the {kind} can't be written: {error.strerror}") from None


def _draft_path(path: Path) -> Path:
    """Hidden file next to `path`, with the same suffix."""
    return path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
