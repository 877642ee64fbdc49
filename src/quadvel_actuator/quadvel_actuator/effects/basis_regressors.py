"""Basis regressors: generic curves of named signals, for deviations that no effect of the registry explains.

A regressor is a weighted sum of basis functions of one signal (`shapes` has the kinds). It may be
multiplied by the direction of motion, the speed or the torque (`MULTIPLIERS`). Its torque is clipped
to the largest value that it had on the fitted rows. Like effects, regressors run over whole series
and step by step. In a parameter file all regressors form one effect, `learned_residual`, whose
parameter `terms` lists them. The identification, a package of its own, lists which signals,
multipliers and shapes it tries (`regressor_library`).

Signals have the names of the report: `q`, `dq`, `ddq`, `q_des`, `error` (q_des - q), `t`, `tau`
(prediction without regressors), and `FR_thigh_joint/q` for those of another joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools

from .base import DRIVE, Memory, View, reset_memory
from .numerics import smooth_sign
from .shapes import Shape

LEARNED_RESIDUAL = "learned_residual"
"""Name of the effect that all regressors form in reports and parameter files."""

SIGNALS = ("q", "dq", "ddq", "q_des", "tau", "error", "t")
MULTIPLIERS = ("", "direction", "dq", "tau")

_DIRECTION_WIDTH_RAD_S = np.array(0.05)
"""Width w, rad/s, of the smooth direction of motion tanh(dq / w)."""


def read_signal(name: str, view: View, tau: Array, joints: Sequence[str]) -> Array:
    """Read a signal by name.

    Args:
        name: such as `q` or `FR_thigh_joint/q`.
        view: signals of all joints.
        tau: N m, prediction without regressors, (..., J).
        joints: J joint names.

    Returns:
        (..., J), or (..., 1) if all joints share it.
    """
    owner, _, plain = name.rpartition("/")
    if plain == "tau":
        u = tau
    elif plain == "error":
        u = view.q_des - view.q
    else:
        u = np.asarray(getattr(view, plain))
    if not owner:
        return u
    k = list(joints).index(owner)
    return u[..., k : k + 1]


def multiplier(times: str, view: View, tau: Array) -> Array | float:
    """Return the factor that multiplies a shape.

    Args:
        times: one of `MULTIPLIERS`.
        view: signals of all joints.
        tau: N m, prediction without regressors, (..., J).

    Returns:
        Sign of the velocity, velocity (rad/s), torque (N m), or 1.
    """
    if times == "direction":
        return smooth_sign(view.dq, _DIRECTION_WIDTH_RAD_S)
    if times == "dq":
        return view.dq
    return tau if times == "tau" else 1.0


@attrs.frozen(eq=False)
class BasisRegressor:
    """A shape of a signal, times a multiplier, added to the torque of some of J joints.

    Attributes:
        signal: name of the signal.
        times: multiplier, one of `MULTIPLIERS`.
        shape: basis functions of the signal.
        active: (J,), joints that have the regressor.
        weights: (K, J), weight of each basis function.
        bound: (J,), N m, largest torque.
        at: where it is added: in the drive, so that it passes the output delay, or at the joint
            without delay.
    """

    signal: str
    times: str
    shape: Shape
    active: Bools
    weights: Array
    bound: Array
    at: str = DRIVE

    def rest(self, view: View, tau: Array, joints: Sequence[str], dt: float) -> Memory:
        """Return the memory of joints at rest.

        Args:
            view: signals of all joints.
            tau: N m, prediction without regressors, (..., J).
            joints: J joint names.
            dt: s, duration of a step.

        Returns:
            The memory.
        """
        return self.shape.rest(read_signal(self.signal, view, tau, joints), dt)

    def advance(
        self, view: View, tau: Array, joints: Sequence[str], dt: float, memory: Memory
    ) -> tuple[Array, Memory]:
        """Advance by one step.

        Args:
            view: signals of all joints.
            tau: N m, prediction without regressors, (..., J).
            joints: J joint names.
            dt: s, duration of the step.
            memory: memory after the step before.

        Returns:
            N m, torque to add, (..., J), and the new memory.
        """
        torque, memory = self.shape.advance(
            read_signal(self.signal, view, tau, joints), dt, self.weights, memory
        )
        return np.clip(torque * multiplier(self.times, view, tau), -self.bound, self.bound), memory

    @property
    def is_per_joint(self) -> bool:
        """Whether each joint reads its own signal, not one that all share (`t`, or another joint's)."""
        return "/" not in self.signal and self.signal != "t"

    def to_entry(self, joints: Sequence[str]) -> dict[str, Any]:
        """Convert to an entry of a parameter file; `load_regressor` is the inverse.

        Args:
            joints: J joint names.

        Returns:
            The entry, with the joints that have the regressor.
        """
        on = np.flatnonzero(self.active)
        shape = self.shape.for_columns(on) if self.is_per_joint else self.shape
        return {
            "kind": shape.kind,
            "signal": self.signal,
            "times": self.times,
            "at": self.at,
            "joints": [joints[int(j)] for j in on],
            **{k: np.asarray(v).tolist() for k, v in attrs.asdict(shape, recurse=False).items()},
            "weights": self.weights[:, on].T.tolist(),
            "bound": self.bound[on].tolist(),
        }


class RunningRegressors:
    """Basis regressors of a running model, step by step.

    Attributes:
        regressors: the regressors.
        memory: memory of each regressor.
    """

    def __init__(self, regressors: Sequence[BasisRegressor], joints: Sequence[str], dt: float) -> None:
        """Prepare the regressors; the first `step` starts their memory.

        Args:
            regressors: the regressors.
            joints: J joint names of the robot.
            dt: s, duration of a step.
        """
        self.regressors, self._joints, self._dt = regressors, joints, dt
        self.memory: tuple[Memory, ...] = ()

    def step(self, tau: Array, now: View, new: Bools | None) -> Array | float:
        """Advance all regressors by one step.

        Args:
            tau: N m, prediction without regressors, (..., J).
            now: signals of this step.
            new: environments that start from rest, (...,) bool, or None; all at the first step.

        Returns:
            N m, torque to add, (..., J), or 0 without regressors.
        """
        if not self.regressors:
            return 0.0
        if new is not None:
            memories = self.memory or ((),) * len(self.regressors)
            self.memory = tuple(
                reset_memory(kept, one.rest(now, tau, self._joints, self._dt), new)
                for one, kept in zip(self.regressors, memories, strict=True)
            )
        total, memory = np.zeros_like(tau), []
        for one, kept in zip(self.regressors, self.memory, strict=True):
            torque, after = one.advance(now, tau, self._joints, self._dt, kept)
            total += torque
            memory.append(after)
        self.memory = tuple(memory)
        return total
