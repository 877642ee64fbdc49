"""Reader of LeRobot data sets: Parquet files of episodes, with joint names in `meta/info.json`.

The angles are `observation.state`, the commands `action`. Their unit is that of the robot's
recorder; LeRobot states none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..log import LogError
from . import parquet
from .raw import MAX_VALUES, ColumnChooser, RawArrays

EPISODE_GAP_S = 1.0
"""s between two episodes, each of which starts at time 0; this is a gap, after which memories
restart.
"""
EPISODE, TIME = "episode_index", "timestamp"
STATE, ACTION = "observation.state", "action"
FIELD_OF_SUFFIX = {
    "pos": STATE,
    "vel": "observation.velocity",
    "effort": "observation.effort",
    "torque": "observation.effort",
}
"""Field of a state's component by the suffix of its name (`knee.pos`, `knee.vel`, ...)."""


def find_root(path: Path) -> Path | None:
    """Find the root folder of a LeRobot data set.

    Args:
        path: A folder, or a file in a data set.

    Returns:
        The folder with `meta/info.json`, or None.
    """
    near = (path, *path.absolute().parents[:4])
    return next((folder for folder in near if (folder / "meta" / "info.json").is_file()), None)


def read_lerobot(path: Path, choose: ColumnChooser) -> RawArrays:
    """Read all episodes of a data set, or those of one of its files, one after the other.

    Args:
        path: Folder of the data set, or one of its Parquet files.
        choose: Selects the columns to read.

    Returns:
        One column for each joint and quantity.

    Raises:
        LogError: There are no episodes, they have different columns, or they are too large.
    """
    root = find_root(path) or path
    files = sorted((path / "data").glob("**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise LogError(
            f"{path}: data: found no .parquet file in it, expected the episodes of a LeRobot data set"
        )
    joints = _read_joint_names(root / "meta" / "info.json")
    parts = [parquet.read_parquet(one, lambda names: _needed_columns(names, joints, choose)) for one in files]
    total = sum(np.size(values) for part in parts for values in part.arrays.values())
    if total > MAX_VALUES:
        raise LogError(f"{path}: found {total} values in {len(files)} files, expected {MAX_VALUES} at most")
    try:
        arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays}
    except (KeyError, ValueError):
        raise LogError(
            f"{path}: found episodes with other columns than the first one, expected all alike"
        ) from None
    remarks = _join_episodes(arrays)
    others = [name for name in parts[0].others if name != EPISODE]
    split = dict(_split_by_joint(path, arrays, joints))
    chosen = choose([*split, *others])
    return RawArrays(
        {name: values for name, values in split.items() if name in chosen},
        (*others, *(name for name in split if name not in chosen)),
        remarks=remarks,
    )


def _needed_columns(
    names: Sequence[str], joints: Mapping[str, list[str]], choose: ColumnChooser
) -> dict[str, str]:
    """Columns to read: those of the log, the named states and actions, and the episode index."""
    return {name: name for name in names if name in (EPISODE, *joints)} | dict(choose(names))


def _read_joint_names(path: Path) -> dict[str, list[str]]:
    """Names of the components of each column, from `info.json`; raises LogError."""
    try:
        features = json.loads(path.read_text())["features"]
        named = {name: features[name].get("names") for name in (STATE, ACTION) if name in features}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OSError):
        raise LogError(
            f"{path}: features: found no names of columns, expected those of a LeRobot data set"
        ) from None
    lists = {
        name: next(iter(one.values()), None) if isinstance(one, dict) else one for name, one in named.items()
    }
    return {name: [str(joint) for joint in one] for name, one in lists.items() if isinstance(one, list)}


def _join_episodes(arrays: dict[str, Any]) -> tuple[str, ...]:
    """Shift the times of the episodes so that they follow each other; return a remark."""
    episode, time = arrays.pop(EPISODE, None), arrays.get(TIME)
    if episode is None or time is None:
        return ()
    begins = np.flatnonzero(np.diff(episode)) + 1
    ends = time[begins - 1] - time[begins] + EPISODE_GAP_S
    time[:] += np.concatenate([[0.0], np.cumsum(ends)])[
        np.searchsorted(begins, np.arange(len(time)), side="right")
    ]
    return (
        (f"t: {len(begins) + 1} episodes follow each other, {EPISODE_GAP_S:g} s apart",)
        if len(begins)
        else ()
    )


def _split_by_joint(
    path: Path, arrays: Mapping[str, Any], joints: Mapping[str, list[str]]
) -> Iterator[tuple[str, Any]]:
    """Yield one column for each joint of states and actions, and all other columns unchanged."""
    for name, values in arrays.items():
        if name not in joints:
            yield name, values
            continue
        if values.ndim != 2 or values.shape[1] != len(joints[name]):
            raise LogError(
                f"{path}: {name}: found shape {values.shape}, expected {len(joints[name])} columns as info.json names"
            )
        for k, joint in enumerate(joints[name]):
            plain, _, ending = joint.rpartition(".")
            kind = FIELD_OF_SUFFIX.get(ending, name) if name == STATE and plain else name
            yield f"{kind}/{plain if ending in FIELD_OF_SUFFIX and plain else joint}", values[:, k]
