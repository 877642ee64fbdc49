"""The logs of one identification: checked, with torque, and cut into excerpts where they are long.

`logs` reads and checks the files; `signals` and `split` make samples and data parts from the
result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain, pairwise

import attrs
import numpy as np

from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import UNNAMED_ROBOT

from ..logs.check_log import CheckedLog
from ..logs.excerpts import cut_excerpts
from ..logs.findings import Finding
from ..logs.log import Log
from .motion import Body, imply_torque

Progress = Callable[[float, str], None]
"""Callback that receives the completed fraction (0 to 1) and the next step."""
_MAX_JUDGED_VALUES = 1_000_000
"""Torque values of the held-out logs that are judged; longer logs are cut, to bound the memory."""


def no_progress(share: float, text: str) -> None:
    """Ignore the progress.

    Args:
        share: Completed fraction.
        text: Next step.
    """


@attrs.frozen(eq=False)
class Dataset:
    """The logs of one identification, all with torque and the same joints.

    Excerpts are copies, so that the full logs can be released.

    Attributes:
        train: Logs or excerpts to fit.
        heldout: Logs or excerpts to report on; empty if blocks of `train` are reported on.
        pieces: For each recording, the indices of its excerpts in `logs`.
        findings: Findings of the checks, as (log name, finding).
        body: Load of the joints, where the torque is inferred from the motion; None otherwise.
    """

    train: tuple[Log, ...]
    heldout: tuple[Log, ...]
    pieces: tuple[tuple[int, ...], ...]
    findings: tuple[tuple[str, Finding], ...]
    body: Body | None

    @property
    def logs(self) -> tuple[Log, ...]:
        """All logs, those to fit first."""
        return (*self.train, *self.heldout)

    @property
    def robot(self) -> Robot:
        """The robot of the logs; UNNAMED_ROBOT if it is unknown."""
        return self.train[0].robot or load_robot(UNNAMED_ROBOT)

    def is_heldout(self, recording: int) -> bool:
        """Return whether a recording is held out.

        Args:
            recording: Index of the recording.

        Returns:
            True if none of its rows are fitted.
        """
        return self.pieces[recording][0] >= len(self.train)

    def hold_out(self, recording: int) -> Dataset:
        """Hold out one of several fitted recordings.

        Args:
            recording: Index of the recording.

        Returns:
            A dataset that fits the others and reports on this one.
        """
        order = [*(k for k in range(len(self.pieces)) if k != recording), recording]
        logs = [tuple(self.train[k] for k in self.pieces[one]) for one in order]
        ends = np.cumsum([0, *map(len, logs)]).tolist()
        return attrs.evolve(
            self,
            train=tuple(chain(*logs[:-1])),
            heldout=logs[-1],
            pieces=tuple(tuple(range(a, b)) for a, b in pairwise(ends)),
        )

    def with_logs(self, logs: Sequence[Log]) -> Dataset:
        """Replace the logs, as after a change of their stamps.

        Args:
            logs: One for each of `logs`, in the same order.

        Returns:
            A new dataset.
        """
        count = len(self.train)
        return attrs.evolve(self, train=tuple(logs[:count]), heldout=tuple(logs[count:]))

    @classmethod
    def prepare(
        cls,
        train: Sequence[CheckedLog],
        heldout: Sequence[CheckedLog],
        max_values: int,
        progress: Progress = no_progress,
    ) -> Dataset:
        """Infer the torque from the motion where none was logged, and cut excerpts from long logs.

        Args:
            train: Checked logs to fit, at least one.
            heldout: Checked logs to report on.
            max_values: Maximum number of torque values to fit, over all fitted logs and joints.
            progress: Receives the completed fraction and the next step.

        Returns:
            The logs of one identification.

        Raises:
            LogError: No torque follows from the motion, or an excerpt has too few rows.
        """
        logs, body = [checked.log for checked in (*train, *heldout)], None
        if logs[0].tau is None:
            progress(0.01, "the torque that the motion implies")
            logs[0], body = imply_torque(logs[0])
            logs[1:] = [imply_torque(log, body)[0] for log in logs[1:]]
        count, joints = len(train), len(logs[0].joints)
        limits = [max_values // (count * joints)] * count
        limits += [_MAX_JUDGED_VALUES // (max(len(heldout), 1) * joints)] * len(heldout)
        excerpts = [cut_excerpts(log, rows * log.period) for log, rows in zip(logs, limits, strict=True)]
        ends = np.cumsum([0, *map(len, excerpts)]).tolist()
        findings = [(checked.log.name, one) for checked in (*train, *heldout) for one in checked.findings]
        for k, (log, cut) in enumerate(zip(logs, excerpts, strict=True)):
            if len(cut) > 1:
                seconds, verb = sum(one.duration for one in cut), "fitted" if k < count else "judged"
                text = f"t: {len(cut)} excerpts, {seconds:.1f} of {log.duration:.1f} s, are {verb}"
                findings.append((log.name, Finding("note", "t", (), text)))
        return cls(
            tuple(chain(*excerpts[:count])),
            tuple(chain(*excerpts[count:])),
            tuple(tuple(range(a, b)) for a, b in pairwise(ends)),
            tuple(findings),
            body,
        )
