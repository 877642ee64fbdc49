"""Does a model of the joints move the robot's legs as they moved? Commands replayed over short stretches, joint by joint.

What pushes a walking robot's legs beside their drives, the ground above all, is in no log. But it is the same in the
measurement and in the replay, so that what the two differ by is

    M(q) e'' = tau_model(q + e, dq + e') - tau_measured

with the deviation e of the joints' angles and the inertia M(q) of the legs, the trunk held still. A model that gives the
measured torque moves the legs as measured, e = 0; any other leaves its track as freely as the drives let it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description import mjcf

from .log_signals import as_double
from .logs.log import Log, LogError
from .signals import Array, Bools

STRETCH_S = 0.2
"""s that are replayed from a measured state, whereupon the next stretch begins with another one"""
MIN_BLOCK_S = 0.25
"""s in a row that hold a stretch"""
_WARM_UP_S = 0.04
"""s of the measured motion that the model is led along first, so that its delays and memories are filled"""
_STEP_S = 0.001
"""s of the replay"""
EXPLANATION = (
    "The legs of the robot's description, the trunk held still, pushed by what the model gives beyond the measured torque; "
    "what else pushes them is as measured."
)
_SHIPPED = Path(mjcf.__file__).parent / "robots"


@attrs.frozen(eq=False)
class Legs:
    """The inertia that joints carry, of a description of the robot."""

    model: mujoco.MjModel
    joints: tuple[str, ...]

    @classmethod
    def load(cls, robot: str, joints: Sequence[str]) -> Legs:
        """robot: `aliengo`, `go2`, or a file, MJCF or URDF, that holds `joints`. Raises ValueError, OSError."""
        model = mjcf.load_model() if robot == "aliengo" else _load_robot(robot)
        known = {model.joint(k).name for k in range(model.njnt)}
        for name in joints:
            if name not in known:
                raise ValueError(
                    f"--robot {robot}: joint '{name}' of the log is missing, found {', '.join(sorted(known))}"
                )
        return cls(model, tuple(joints))

    def inertia(self, q: Array) -> Array:
        """(N, J, J) kg m^2 at angles (N, J), the other joints where the description has them and the trunk held still."""
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
        """Root mean square deviations over `rows` (N, J) of all logs; how many stretches there were.

        Raises LogError where no stretch lies within these rows.
        """
        found, first = [], 0
        for log in logs:
            begins = stretch_starts(log, rows[first : first + len(log.t)])
            first += len(log.t)
            if len(begins):
                found.append(replay_deviations(log, parameters, self, begins))
        if not found:
            raise LogError(
                f"{logs[0].name}: no {1e3 * STRETCH_S:.0f} ms in a row are to be replayed, expected longer blocks"
            )
        return {"stretches": sum(one[0].shape[1] for one in found), **_rms_errors(found)}


def _load_robot(robot: str) -> mujoco.MjModel:
    """The model of a shipped description, or of a file."""
    shipped = _SHIPPED / f"{robot}.xml"
    path = shipped if shipped.is_file() else Path(robot)
    if not path.is_file():
        names = ", ".join(["aliengo", *(one.stem for one in sorted(_SHIPPED.glob("*.xml")))])
        raise FileNotFoundError(f"--robot: found {robot}, expected {names} or an MJCF or URDF file")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: no MJCF or URDF that MuJoCo reads: {error}") from None


def stretch_starts(log: Log, rows: Bools) -> Array:
    """The instants (S,) s at which stretches begin that hold none but `rows` (N, J), one after the other."""
    whole: Bools = np.asarray(rows.all(axis=1))
    broken = np.flatnonzero(~whole | log.after_gap)
    edges = np.concatenate([[0], broken, [len(whole)]])
    begins: list[float] = []
    for first, end in pairwise(edges):
        inside = np.flatnonzero(whole[first:end]) + first
        if len(inside):
            start = max(float(log.t[inside[0]]), float(log.t[0]) + _WARM_UP_S)
            begins += np.arange(start, log.t[inside[-1]] - STRETCH_S, STRETCH_S).tolist()
    return np.array(begins)


def replay_deviations(
    log: Log, parameters: ActuatorParameters, legs: Legs, begins: Array
) -> tuple[Array, Array]:
    """What the joints of a replay are off by after each _STEP of the stretches that begin at `begins` (S,) s.

    (T, S, J) of the angles, rad, and of the speeds, rad/s. Raises LogError where the log holds no torque or no gains.
    """
    if log.tau is None or log.kp is None or log.kd is None:
        raise LogError(f"{log.name}: tau, kp, kd: expected all three to replay the commands")
    shape = (len(begins), len(log.joints))
    model = ActuatorModel(attrs.evolve(parameters, torque_noise=0.0), shape, _STEP_S)
    none = np.zeros(log.q_des.shape)
    commands = [
        none if one is None else as_double(one) for one in (log.q_des, log.kp, log.kd, log.dq_des, log.tau_ff)
    ]
    inverse = np.linalg.inv(legs.inertia(_interpolate(log, log.q, begins + 0.5 * STRETCH_S)))
    angle, speed = np.zeros(shape), np.zeros(shape)
    angles, speeds = [], []
    for k in range(-round(_WARM_UP_S / _STEP_S), round(STRETCH_S / _STEP_S)):
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
    """Lines through the rows `values` (N, J) of a log, read at `at` (S,) s: (S, J)."""
    return np.stack([np.interp(at, log.t, one) for one in values.T], axis=1)


def _rms_errors(found: Sequence[tuple[Array, Array]]) -> dict[str, Any]:
    """Root mean squares over all stretches, of all joints and of each."""
    sizes: dict[str, Any] = {}
    for k, name in enumerate(("q_rms_rad", "dq_rms_rad_s")):
        square = np.concatenate([one[k].reshape(-1, one[k].shape[-1]) for one in found]) ** 2
        sizes[name] = float(np.sqrt(square.mean()))
        sizes[f"{name}_per_joint"] = np.sqrt(square.mean(axis=0)).tolist()
    return sizes
