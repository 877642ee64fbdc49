"""Replay logged commands on the legs of a robot's description, before and after a correction.

A walking robot's legs are also pushed by the ground, which no log contains. These forces are the
same in the measurement and in the replay. With the deviation e of the joint angles and the
inertia M(q) of the legs, the trunk held still, what differs is

    M(q) e'' = tau_model(q + e, dq + e') - tau_measured.

A model that yields the measured torque moves the legs as measured, e = 0. Any other model
deviates as far as the drives allow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description import mjcf
from quadvel_description.arrays import Array, Bools
from quadvel_description.robot import is_robot, load_robot
from quadvel_description.robot_name import shipped_robots

from ..data.log_signals import as_double
from ..logs.log import Log, LogError, joint_name

_WARM_UP_S = 0.04
"""s of measured motion before a stretch, which fill the model's delays and memories."""
_STEP_S = 0.001
"""s; time step of the replay."""


@attrs.frozen(eq=False)
class Legs:
    """Inertia of a robot's joints, from a description of the robot.

    Attributes:
        model: The description as a MuJoCo model.
        joints: Names of the joints of the log, all in the description.
    """

    stretch_s: ClassVar = 0.2
    """s that are replayed from a measured state; then the next stretch begins at another one."""

    model: mujoco.MjModel
    joints: tuple[str, ...]

    @classmethod
    def load(cls, robot: str, joints: Sequence[str]) -> Legs:
        """Load a robot's description.

        Args:
            robot: `aliengo`, `go2`, or the path of a robot.yaml, an MJCF or a URDF file.
            joints: Names of the joints, which the description has to hold.

        Returns:
            The legs.

        Raises:
            ValueError: A joint is missing, or MuJoCo cannot read the file.
            FileNotFoundError: There is no such description.
        """
        model = _load_robot(robot)
        known = {joint_name(model.joint(k).name): model.joint(k).name for k in range(model.njnt)}
        for name in joints:
            if name not in known:
                there = ", ".join(sorted(known.values()))
                raise ValueError(f"--robot {robot}: joint '{name}' of the log is missing, found {there}")
        return cls(model, tuple(known[name] for name in joints))

    def inertia(self, q: Array) -> Array:
        """Compute the inertia matrix of the joints, with the trunk held still.

        Args:
            q: (N, J) joint angles, rad; other joints keep the angles of the description.

        Returns:
            (N, J, J) inertia, kg m^2.
        """
        model, data = self.model, mujoco.MjData(self.model)
        joints = [model.joint(name) for name in self.joints]
        at, dofs = [int(one.qposadr[0]) for one in joints], [int(one.dofadr[0]) for one in joints]
        found, full = np.empty((len(q), len(dofs), len(dofs))), np.empty((model.nv, model.nv))
        for n, angles in enumerate(q):
            data.qpos[at] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_crb(model, data)
            mujoco.mj_fullM(model, data, full)
            found[n] = full[np.ix_(dofs, dofs)]
        return found

    def replay_errors(
        self, logs: Sequence[Log], parameters: ActuatorParameters, rows: Bools
    ) -> dict[str, Any]:
        """Replay logs and compute the root mean square deviations from the measured motion.

        Args:
            logs: The logs, one after the other.
            parameters: The actuator model.
            rows: (N, J) rows of all logs that stretches may use.

        Returns:
            Number of stretches; deviations of angles (rad) and speeds (rad/s), of all joints and
            of each.

        Raises:
            LogError: The rows hold no stretch, or a log holds no torque or gains.
        """
        found, first = [], 0
        for log in logs:
            begins = stretch_starts(log, rows[first : first + len(log.t)])
            first += len(log.t)
            if len(begins):
                found.append(replay_deviations(log, parameters, self, begins))
        if not found:
            raise LogError(
                f"{logs[0].name}: no {1e3 * self.stretch_s:.0f} ms in a row are to be replayed, expected longer blocks"
            )
        return {"stretches": sum(one[0].shape[1] for one in found), **_rms_errors(found)}

    def report_section(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
        """Build the section of report.json on the replay.

        Args:
            before: Replay errors of the plain EAM.
            after: Replay errors of the corrected model.

        Returns:
            The section by its name.
        """
        return {
            "replay": {
                "stretch_s": self.stretch_s,
                "before": before,
                "after": after,
                "text": "The legs of the robot's description, the trunk held still, pushed by what the model gives beyond the "
                "measured torque; what else pushes them is as measured.",
            }
        }


def _load_robot(robot: str) -> mujoco.MjModel:
    """Load a shipped description, or a file."""
    if is_robot(robot):
        return mjcf.load_model(load_robot(robot))
    path = Path(robot)
    if not path.is_file():
        names = ", ".join(shipped_robots())
        raise FileNotFoundError(f"--robot: found {robot}, expected {names} or an MJCF or URDF file")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: no MJCF or URDF that MuJoCo reads: {error}") from None


def stretch_starts(log: Log, rows: Bools) -> Array:
    """Find the start times of consecutive stretches.

    Args:
        log: The log.
        rows: (N, J) rows that stretches may use.

    Returns:
        (S,) start times, s.
    """
    whole: Bools = np.asarray(rows.all(axis=1))
    broken = np.flatnonzero(~whole | log.after_gap)
    edges = np.concatenate([[0], broken, [len(whole)]])
    begins: list[float] = []
    for first, end in pairwise(edges):
        inside = np.flatnonzero(whole[first:end]) + first
        if len(inside):
            start = max(float(log.t[inside[0]]), float(log.t[0]) + _WARM_UP_S)
            begins += np.arange(start, log.t[inside[-1]] - Legs.stretch_s, Legs.stretch_s).tolist()
    return np.array(begins)


def replay_deviations(
    log: Log, parameters: ActuatorParameters, legs: Legs, begins: Array
) -> tuple[Array, Array]:
    """Replay stretches of a log and compute the deviations from the measured motion.

    Args:
        log: The log, with torque and gains.
        parameters: The actuator model.
        legs: The inertia of the joints.
        begins: (S,) start times of the stretches, s.

    Returns:
        Deviations after each step of `_STEP_S`: angles (T, S, J), rad, and speeds (T, S, J),
        rad/s.

    Raises:
        LogError: The log holds no torque or no gains.
    """
    if log.tau is None or log.kp is None or log.kd is None:
        raise LogError(f"{log.name}: tau, kp, kd: expected all three to replay the commands")
    shape = (len(begins), len(log.joints))
    model = ActuatorModel(attrs.evolve(parameters, torque_noise=0.0), shape, _STEP_S)
    none = np.zeros(log.q_des.shape)
    commands = [
        none if one is None else as_double(one) for one in (log.q_des, log.kp, log.kd, log.dq_des, log.tau_ff)
    ]
    # M(q) e'' = tau_model(q + e, dq + e') - tau_measured, with M at the middle of each stretch, by
    # semi-implicit Euler steps. During the warm-up e = 0.
    inverse = np.linalg.inv(legs.inertia(_interpolate(log, log.q, begins + 0.5 * legs.stretch_s)))
    angle, speed = np.zeros(shape), np.zeros(shape)
    angles, speeds = [], []
    for k in range(-round(_WARM_UP_S / _STEP_S), round(legs.stretch_s / _STEP_S)):
        t = begins + k * _STEP_S
        q, dq, tau = (
            _interpolate(log, log.q, t),
            _interpolate(log, log.dq, t),
            _interpolate(log, log.tau, t + 0.5 * _STEP_S),
        )
        sent = log.command_rows(t)
        torque = model.step(q + angle, dq + speed, *(one[sent] for one in commands))
        if k >= 0:
            speed = speed + _STEP_S * (inverse @ (torque - tau)[..., None])[..., 0]
            angle = angle + _STEP_S * speed
            angles.append(angle)
            speeds.append(speed)
    return np.array(angles), np.array(speeds)


def _interpolate(log: Log, values: NDArray[np.floating[Any]], at: Array) -> Array:
    """Interpolate rows `values` (N, J) of a log linearly at times `at` (S,), s: (S, J)."""
    return np.stack([np.interp(at, log.t, one) for one in values.T], axis=1)


def _rms_errors(found: Sequence[tuple[Array, Array]]) -> dict[str, Any]:
    """Root mean squares over all stretches, of all joints and of each."""
    sizes: dict[str, Any] = {}
    for k, name in enumerate(("q_rms_rad", "dq_rms_rad_s")):
        square = np.concatenate([one[k].reshape(-1, one[k].shape[-1]) for one in found]) ** 2
        sizes[name] = float(np.sqrt(square.mean()))
        sizes[f"{name}_per_joint"] = np.sqrt(square.mean(axis=0)).tolist()
    return sizes
