"""Input data of an identification: checked logs, with excerpts of the long ones."""

from __future__ import annotations

from collections.abc import Callable

import attrs

from ..logs.dataset import Dataset
from ..logs.excerpts import cut_excerpts
from ..logs.findings import Finding
from ..logs.log import Log
from .motion import Body, imply_torque

Progress = Callable[[float, str], None]
"""Callback that receives the completed fraction (0 to 1) and the next step."""

MAX_TORQUE_VALUES = 60_000
"""Maximum number of torque values to use, over all logs and joints."""


@attrs.frozen(eq=False)
class IdentificationData:
    """Logs and excerpts of logs. Excerpts are copies, so that the full logs can be released.

    Attributes:
        logs: Logs or excerpts to fit, then those to report on.
        fitted_count: Number of logs to fit; all of them if there is no held-out log.
        body: Load of the joints, where the torque is inferred from the motion; None otherwise.
        findings: Findings of the checks, as (log name, finding).
    """

    logs: tuple[Log, ...]
    fitted_count: int
    body: Body | None
    findings: tuple[tuple[str, Finding], ...]

    @property
    def has_heldout(self) -> bool:
        """Whether there are held-out logs."""
        return self.fitted_count < len(self.logs)


def prepare(
    data: Dataset,
    values: int = MAX_TORQUE_VALUES,
    progress: Progress = lambda share, text: None,
) -> IdentificationData:
    """Cut excerpts from the logs, and infer the torque from the motion where none was logged.

    Args:
        data: Checked logs.
        values: Maximum number of torque values to use, over all logs and joints.
        progress: Receives the completed fraction and the next step.

    Returns:
        Data for `identify_prepared`.

    Raises:
        LogError: If the logs cannot be used together.
    """
    logs, train = data.logs, len(data.fitted)
    body = None
    if logs[0].tau is None:
        progress(0.01, "the torque that the motion implies")
        first, body = imply_torque(logs[0])
        logs = [first, *(imply_torque(log, body)[0] for log in logs[1:])]
    rows = values // (len(logs) * len(logs[0].joints))
    # One script may have generated all logs. Excerpts of held-out logs therefore lie between those
    # of the fitted logs in time.
    parts = [cut_excerpts(log, rows * log.period, between=k >= train) for k, log in enumerate(logs)]
    chosen = tuple(log for part in parts for log in part)
    fitted = sum(len(part) for part in parts[:train]) if data.heldout else len(chosen)
    return IdentificationData(chosen, fitted, body, data.findings)
