"""Logs without their truth, for anybody's identification: what is given away, and what is kept.

`publish` writes two folders. `logs` is given away: arrays in the units and names of
docs/identification.md, with a torque of nan on the rows that an entrant has to predict. `truth` is
kept for the judge.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import BadZipFile

import attrs
import numpy as np

from benchmarks.identification.hidden import cases as first_cases
from benchmarks.identification.hidden.cases import Case
from benchmarks.identification.other_plant import cases as other_cases
from quadvel_description.arrays import Bools
from quadvel_sysid.logs.log import Log
from quadvel_sysid.logs.read_log import read_log

SCHEMA = 1
GENERATORS = {"first": first_cases, "other": other_cases}
PREDICTED_SHARE = 0.3
"""Share of the rows, at the end of a log, whose torque is not given away."""
KINDS: Mapping[str, Mapping[str, Sequence[str]]] = {
    "tiny": {"first": ("none", "coulomb_friction", "backlash", "pair", "soft_stop")},
    "small": {
        "first": [kind for kind in first_cases.GROUP_OF if kind != "table_4"],
        "other": [kind for kind in other_cases.GROUP_OF if kind != "two_logs"],
    },
}
"""Kinds of logs of each generator at each size. Left out: what needs a second log, or names nothing."""


@attrs.frozen(eq=False)
class SharedLog:
    """A log of the contest, as an entrant has it.

    Attributes:
        name: Name of the log.
        log: The log, N rows of J joints; its torque is 0 where it is not known.
        known: Rows with a torque, (N,). The torque of the others is to be predicted.
    """

    name: str
    log: Log
    known: Bools

    @property
    def train(self) -> Log:
        """The rows whose torque is known."""
        return self.log.select_rows(self.known)


def publish(size: str, seed: int, folder: Path, logs_of_each_kind: int = 1) -> list[Path]:
    """Make the logs of a contest, in an order that does not reveal their kind.

    Args:
        size: Key of KINDS.
        seed: Seed of the logs and of their order.
        folder: Folder for `logs` and `truth`.
        logs_of_each_kind: Number of logs.

    Returns:
        Files of the logs.

    Raises:
        FileExistsError: The folder holds a contest already, whose truth and answers belong together.
    """
    if (folder / "truth").exists():
        raise FileExistsError(f"{folder}: holds a contest already; name another folder, or remove this one")
    cases = [
        (generator, kind, index)
        for generator, kinds in KINDS[size].items()
        for kind in kinds
        for index in range(logs_of_each_kind)
    ]
    order = np.random.default_rng(seed).permutation(len(cases))
    paths = []
    for number, k in enumerate(order):
        generator, kind, index = cases[k]
        paths.append(_save(GENERATORS[generator].make_case(kind, index, seed), f"log_{number:03d}", folder))
    settings = {"schema": SCHEMA, "size": size, "seed": seed, "logs": len(paths)}
    (folder / "truth" / "settings.json").write_text(json.dumps(settings))
    return paths


def _save(case: Case, name: str, folder: Path) -> Path:
    """Write a log without the last torques, and its truth with them."""
    arrays = dict(case.log)
    tau = np.array(arrays["tau"], dtype=float)
    first = round(len(tau) * (1.0 - PREDICTED_SHARE))
    truth = {**case.truth, "torque": tau[first:].tolist()}
    tau[first:] = np.nan
    for part in ("logs", "truth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    path = folder / "logs" / f"{name}.npz"
    np.savez_compressed(path, **{**arrays, "tau": tau})
    (folder / "truth" / f"{name}.json").write_text(json.dumps(truth))
    return path


def read_shared(path: Path) -> SharedLog:
    """Read a log of the contest.

    Args:
        path: NPZ file of `publish`.

    Returns:
        The log.

    Raises:
        ValueError: The file is no such log.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Any] = dict(file)
        known: Bools = np.isfinite(arrays["tau"]).all(axis=1)
    except (KeyError, TypeError, ValueError, BadZipFile) as error:
        raise ValueError(f"{path}: is no log of `publish`: {error}") from None
    arrays["tau"] = np.nan_to_num(arrays["tau"], nan=0.0)
    with TemporaryDirectory() as folder:
        filled = Path(folder) / path.name
        np.savez(filled, **arrays)
        return SharedLog(path.stem, read_log(filled), known)


def shared_logs(folder: Path) -> Iterator[SharedLog]:
    """Read all logs of a contest, in the order of their names.

    Args:
        folder: The folder `logs` of `publish`.

    Yields:
        The logs.

    Raises:
        FileNotFoundError: The folder holds no log.
    """
    paths = sorted(folder.glob("log_*.npz"))
    if not paths:
        raise FileNotFoundError(f"{folder}: found no log_*.npz, expected the folder `logs` of a contest")
    yield from map(read_shared, paths)


def read_truth(folder: Path) -> dict[str, dict[str, Any]]:
    """Read the truth of a contest.

    Args:
        folder: The folder `truth` of `publish`.

    Returns:
        Ground truth by name of the log.
    """
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("log_*.json"))}
