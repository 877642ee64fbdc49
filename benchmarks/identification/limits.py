"""Margins of the log checks on valid logs, the basis of the constants of `logs.response`.

    python -m benchmarks.identification.limits [FOLDER of further logs, .npz]

Evaluates two logs of every kind of the blind test, and those in FOLDER.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.identification.hidden.cases import GROUP_OF, make_case
from quadvel_sysid.logs.check_log import check_log
from quadvel_sysid.logs.checks.response import MAX_LAG_S, Response, measure_response
from quadvel_sysid.logs.log import LogError
from quadvel_sysid.logs.read_log import read_log

SEED, INDICES = 77, (900, 901)
SHARES = (0, 1, 5, 50, 95, 99, 100)


def responses(folder: Path) -> list[Response]:
    """Measure the response of the joints in all logs of a folder.

    Args:
        folder: Folder with NPZ files.

    Returns:
        Responses of the logs that have torque and are not refused.
    """
    found = []
    for path in sorted(folder.glob("*.npz")):
        try:
            checked = check_log(read_log(path))
            checked.raise_refusal()
        except LogError as error:
            print(f"refused: {error}")
            continue
        response = measure_response(checked.log)
        found += [response] if response else []
    return found


def report(found: list[Response]) -> None:
    """Print percentiles over the joints, and those of the lag over the logs.

    Args:
        found: Responses of all logs.
    """
    near = [np.flatnonzero(np.abs(one.lags) <= MAX_LAG_S) for one in found]
    lags = [
        one.lags[k][np.log(one.error_share[k] + 1e-6).mean(axis=1).argmin()]
        for one, k in zip(found, near, strict=True)
    ]
    gains = [one.gain / np.median(one.log.kp, axis=0) for one in found if one.log.kp is not None]
    rows = {
        "unexplained fraction of the torque": np.concatenate([one.min_error_share for one in found]),
        "partial correlation with the command": np.concatenate([one.command_correlation for one in found]),
        "fraction that the position error explains": np.concatenate([one.answered_share for one in found]),
        "ratio of real to commanded gain": np.concatenate(gains),
        "best lag, ms": 1e3 * np.array(lags),
    }
    print(f"{len(found)} logs; percentiles {', '.join(map(str, SHARES))}:")
    for name, values in rows.items():
        print(f"{name} ({len(values)}): {', '.join(f'{x:.3g}' for x in np.percentile(values, SHARES))}")


if __name__ == "__main__":
    with TemporaryDirectory() as name:
        for kind in GROUP_OF:
            for index in INDICES:
                make_case(kind, index, SEED).save(Path(name))
        report([one for folder in (name, *sys.argv[1:]) for one in responses(Path(folder))])
