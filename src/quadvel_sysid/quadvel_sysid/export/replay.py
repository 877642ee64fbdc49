"""Replay the logged commands with fitted models, to choose between the models and to report on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypeVar

import attrs
import numpy as np

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.arrays import Bools

from ..data.dataset import Dataset
from ..data.preparation import Preprocessed
from ..logs.log import Log, LogError
from ..model.torque_model import Model
from .export_parameters import actuator_parameters
from .legs import Legs

_ERROR_RATIO = 0.9
"""Ratio of the replay error of a larger to a smaller model below which the larger one is chosen."""
Key = TypeVar("Key")


class Load(Protocol):
    """What the joints move: `data.motion.Body`, fitted to the motion, or `Legs` of a description."""

    @property
    def stretch_s(self) -> float:
        """Duration of a replay from one measured state, s."""

    def replay_errors(
        self, logs: Sequence[Log], parameters: ActuatorParameters, rows: Bools
    ) -> Mapping[str, Any]:
        """Replay the commands of logs and compute the root mean square deviations.

        Args:
            logs: The logs, one after the other.
            parameters: The actuator model.
            rows: (N, J) rows of all logs that count.

        Returns:
            Deviations, among them `q_rms_rad` and `dq_rms_rad_s`.
        """

    def report_section(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
        """Build the section of report.json on the replay.

        Args:
            before: Replay errors of the plain EAM.
            after: Replay errors of the corrected model.

        Returns:
            The section by its name.
        """


def find_load(dataset: Dataset, robot: str | None) -> Load | None:
    """Find the load of the joints.

    Args:
        dataset: The logs.
        robot: Robot whose legs are the load, see `Legs.load`; None for none.

    Returns:
        The legs, or the body that was fitted to the motion; None if neither is known.

    Raises:
        LogError: The torque or the gains are missing, so that legs cannot be replayed.
    """
    if robot is None:
        return dataset.body
    for log in dataset.logs:
        known = {"tau": dataset.body is None, "kp": log.kp is not None, "kd": log.kd is not None}
        for name, there in known.items():
            if not there:
                what = "the torque" if name == "tau" else "the commanded gains (or --gains KP KD)"
                raise LogError(
                    f"{log.name}: {name}: not in the log, expected {what} to replay the commands (--robot)"
                )
    return Legs.load(robot, dataset.logs[0].joints)


@attrs.frozen(eq=False)
class Replay:
    """Replays of fitted models on the load of the joints.

    Attributes:
        load: The load.
        prepared: Samples and data split.
        base: Parameters that the corrected model extends.
    """

    load: Load
    prepared: Preprocessed
    base: ActuatorParameters

    def choose(self, models: Mapping[Key, Model]) -> Key:
        """Choose the model that replays the motion best.

        A later model has to reduce the error of the speed clearly: effects against the plain model,
        regressors against effects, and fewer effects against all. Regressors may fit encoder errors, or
        predict torque only along the recorded motion. An effect may describe how the log was written.
        None of these improves the replayed motion.

        Args:
            models: Models refitted to all rows, in order of preference.

        Returns:
            Key of the chosen model.
        """
        best, least = next(iter(models)), np.inf
        for key, model in models.items():
            error = self._errors(model, self.prepared.parts.fit_or_select)["dq_rms_rad_s"]
            if error < _ERROR_RATIO * least:
                best, least = key, error
        return best

    def section(self, before: Model, after: Model) -> dict[str, Any]:
        """Build the section of the report on the replay of the reported rows.

        Args:
            before: Plain EAM.
            after: Corrected model.

        Returns:
            `{"replay": ...}` or `{"motion": ...}` in the format of report.json.
        """
        rows = self.prepared.parts.report
        return self.load.report_section(self._errors(before, rows), self._errors(after, rows))

    def _errors(self, model: Model, rows: Bools) -> Mapping[str, Any]:
        """Replay errors of a model on some rows."""
        corrected = actuator_parameters(model, self.prepared.parts, self.base)
        return self.load.replay_errors(self.prepared.samples.logs, corrected, rows)
