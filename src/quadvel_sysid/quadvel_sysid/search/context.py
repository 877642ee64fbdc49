"""Model and data of a log, from which candidate effects derive their forms and starting values."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from quadvel_description.arrays import Array

from ..data.split import DataSplit
from ..model.torque_model import Model
from ..options import SEARCH_DEFAULTS, SearchOptions
from .lost_commands import lost_commands


class Context:
    """Model and data from which effects derive their forms and starting values.

    Attributes:
        model: Model that an effect would extend.
        parts: Data split.
        noise: Variance of the torque noise, (J,), N^2 m^2.
        options: Options of the search.
        samples: Rows of all logs.
        signals: Signals at the delays of the model.
        torque: Predicted torque, (N, J), N m.
        residual: Measured minus predicted torque on the fitted rows, 0 elsewhere, (N, J), N m.
    """

    def __init__(
        self, model: Model, parts: DataSplit, noise: Array, options: SearchOptions = SEARCH_DEFAULTS
    ) -> None:
        """Evaluate the model.

        Args:
            model: Model that an effect would extend.
            parts: Data split.
            noise: Variance of the torque noise, (J,), N^2 m^2.
            options: Options of the search.
        """
        self.model, self.parts, self.noise, self.options = model, parts, noise, options
        self.samples, self.signals = model.samples, model.signals
        self.torque = model.predict()
        self.residual = np.where(parts.fit, self.samples.tau - self.torque, 0.0)

    @cached_property
    def lost_commands(self) -> list[tuple[Array, Array]]:
        """Odds that commands were lost, from `lost_commands.lost_commands`."""
        return lost_commands(self.model, self.parts, self.noise, self.options.lost_commands_at_random)

    def strongest_neighbours(self) -> tuple[str, ...]:
        """Find for each joint the signal of another joint that its residual correlates with most.

        The linear effect of the joint's own signals is projected out first (Frisch, Waugh and
        Lovell).

        Returns:
            Names `joint/signal` with q, dq or tau, one for each joint; empty for a single joint.
        """
        joints = self.samples.joints
        if len(joints) < 2:
            return ()
        s = self.signals
        names = [f"{joint}/{signal}" for signal in ("q", "dq", "tau") for joint in joints]
        others = np.concatenate([s.q, s.dq, self.torque], axis=1)
        found = []
        for j in range(len(joints)):
            # For a signal z, orthogonal to the joint's own ones, (z'r)^2 / z'z is the error
            # reduction.
            keep = self.parts.fit[:, j]
            own = np.column_stack([np.ones(keep.sum()), s.q[keep, j], s.dq[keep, j], s.q_des[keep, j]])
            basis, _ = np.linalg.qr(own)
            projected = others[keep] - basis @ (basis.T @ others[keep])
            score = (projected.T @ self.residual[keep, j]) ** 2
            score /= np.einsum("nk,nk->k", projected, projected) + 1e-12
            score[j :: len(joints)] = -1.0
            found.append(names[int(np.argmax(score))])
        return tuple(found)
