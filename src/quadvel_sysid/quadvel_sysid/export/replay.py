"""Replay the logged commands with fitted models, to choose between the models and to report on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import attrs
import numpy as np

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.arrays import Bools

from ..data.dataset import Dataset
from ..data.motion import Body
from ..data.preparation import Preprocessed
from ..logs.log import LogError
from ..model.torque_model import Model
from .export_parameters import actuator_parameters

if TYPE_CHECKING:
    from .legs import Legs

_ERROR_RATIO = 0.9
"""Ratio of the replay error of a larger to a smaller model below which the larger one is chosen."""
Key = TypeVar("Key")

Load: TypeAlias = "Body | Legs"
"""What the joints move: a body fitted to the motion, or the legs of a robot's description."""


def find_load(dataset: Dataset, robot: str | None) -> Load | None:
    """Find the load of the joints.

    Args:
        dataset: The logs.
        robot: Robot whose legs are the load, see `Legs.load`; None for none.

    Returns:
        The legs, or the body that was fitted to the motion; None if neither is known.

    Raises:
        LogError: The torque or the gains are missing, so that legs cannot be replayed.
        ValueError: MuJoCo is not installed, or the description does not fit the logs.
    """
    if robot is None:
        return dataset.body
    gains = "the commanded gains (or --gains KP KD)"
    for log in dataset.logs:
        for name, what in (("tau", "the torque"), ("kp", gains), ("kd", gains)):
            if getattr(log, name) is None or (name == "tau" and dataset.body is not None):
                text = f"not in the log, expected {what} to replay the commands (--robot)"
                raise LogError(f"{log.name}: {name}: {text}")
    try:
        from .legs import Legs
    except ModuleNotFoundError:
        raise ValueError(
            "--robot needs mujoco, not installed here: pip install 'quadvel-core[sim]'"
        ) from None
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
            A dict with the key `replay` or `motion`, in the format of report.json.
        """
        rows = self.prepared.parts.report
        return self.load.report_section(self._errors(before, rows), self._errors(after, rows))

    def _errors(self, model: Model, rows: Bools) -> Mapping[str, Any]:
        """Replay errors of a model on some rows."""
        corrected = actuator_parameters(model, self.prepared.parts, self.base)
        return self.load.replay_errors(self.prepared.samples.logs, corrected, rows)
