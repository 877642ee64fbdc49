"""The logs of one identification: checked, with torque, and cut into excerpts where they are long."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import attrs

from ..logs.check_log import CheckedLog
from ..logs.excerpts import cut_excerpts
from ..logs.findings import Finding
from ..logs.log import Log
from .motion import Body, imply_torque

Progress = Callable[[float, str], None]
"""Callback that receives the completed fraction (0 to 1) and the next step."""


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
        findings: Findings of the checks, as (log name, finding).
        body: Load of the joints, where the torque is inferred from the motion; None otherwise.
    """

    train: tuple[Log, ...]
    heldout: tuple[Log, ...]
    findings: tuple[tuple[str, Finding], ...]
    body: Body | None

    @property
    def logs(self) -> tuple[Log, ...]:
        """All logs, those to fit first."""
        return (*self.train, *self.heldout)

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
            max_values: Maximum number of torque values to use, over all logs and joints.
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
        count, rows = len(train), max_values // (len(logs) * len(logs[0].joints))
        # One script may have generated all logs. Excerpts of held-out logs therefore lie between
        # those of the fitted logs in time.
        excerpts = [cut_excerpts(log, rows * log.period, between=k >= count) for k, log in enumerate(logs)]
        findings = tuple(
            (checked.log.name, one) for checked in (*train, *heldout) for one in checked.findings
        )
        return cls(tuple(chain(*excerpts[:count])), tuple(chain(*excerpts[count:])), findings, body)
