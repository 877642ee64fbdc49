"""LeRobot data sets: Parquet files of episodes, with the names of the joints in `meta/info.json`.

The angles are `observation.state`, the commands `action`, in whatever unit the robot's recorder used: LeRobot states none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from . import parquet
from .log import LogError
from .raw import LARGEST, Choose, Raw

PAUSE = 1.0
"""s between two episodes, each of which begins at 0: a gap, over which nothing is remembered."""
EPISODE, TIME = "episode_index", "timestamp"
STATE, ACTION = "observation.state", "action"
KINDS = {
    "pos": STATE,
    "vel": "observation.velocity",
    "effort": "observation.effort",
    "torque": "observation.effort",
}
"""What of a state is called `knee.pos`, `knee.vel` and so on, by the ending of its name."""


def root_of(path: Path) -> Path | None:
    """The folder of the data set that a folder is, or that a file belongs to; None where there is none."""
    near = (path, *path.absolute().parents[:4])
    return next((folder for folder in near if (folder / "meta" / "info.json").is_file()), None)


def read(path: Path, choose: Choose) -> Raw:
    """All episodes of a data set, one after the other, or those of one of its files. Raises LogError."""
    root = root_of(path) or path
    files = sorted((path / "data").glob("**/*.parquet")) if path.is_dir() else [path]
    if not files:
        raise LogError(
            f"{path}: data: found no .parquet file in it, expected the episodes of a LeRobot data set"
        )
    joints = _joints(root / "meta" / "info.json")
    parts = [parquet.read(one, lambda names: _needed(names, joints, choose)) for one in files]
    total = sum(np.size(values) for part in parts for values in part.arrays.values())
    if total > LARGEST:
        raise LogError(f"{path}: found {total} values in {len(files)} files, expected {LARGEST} at most")
    try:
        arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays}
    except (KeyError, ValueError):
        raise LogError(
            f"{path}: found episodes with other columns than the first one, expected all alike"
        ) from None
    remarks = _one_after_the_other(arrays)
    others = [name for name in parts[0].others if name != EPISODE]
    split = dict(_by_joint(path, arrays, joints))
    chosen = choose([*split, *others])
    return Raw(
        {name: values for name, values in split.items() if name in chosen},
        (*others, *(name for name in split if name not in chosen)),
        remarks=remarks,
    )


def _needed(names: Sequence[str], joints: Mapping[str, list[str]], choose: Choose) -> dict[str, str]:
    """The columns to read: what a log needs, the states and actions with names, and which episode a row belongs to."""
    return {name: name for name in names if name in (EPISODE, *joints)} | dict(choose(names))


def _joints(path: Path) -> dict[str, list[str]]:
    """By column the names of what its cells hold. Raises LogError."""
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


def _one_after_the_other(arrays: dict[str, Any]) -> tuple[str, ...]:
    """Lays the episodes out in time, and says how many there are."""
    episode, time = arrays.pop(EPISODE, None), arrays.get(TIME)
    if episode is None or time is None:
        return ()
    begins = np.flatnonzero(np.diff(episode)) + 1
    ends = time[begins - 1] - time[begins] + PAUSE
    time[:] += np.concatenate([[0.0], np.cumsum(ends)])[
        np.searchsorted(begins, np.arange(len(time)), side="right")
    ]
    return (f"t: {len(begins) + 1} episodes follow each other, {PAUSE:g} s apart",) if len(begins) else ()


def _by_joint(
    path: Path, arrays: Mapping[str, Any], joints: Mapping[str, list[str]]
) -> Iterator[tuple[str, Any]]:
    """A column for each joint of states and actions, all other columns as they are."""
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
            kind = KINDS.get(ending, name) if name == STATE and plain else name
            yield f"{kind}/{plain if ending in KINDS and plain else joint}", values[:, k]
