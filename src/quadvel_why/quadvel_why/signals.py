"""Signals of a run that several causes use, computed when they are first needed.

Causes in `links` read them; `run` holds the recorded data, in s, rad, rad/s and N m.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from quadvel_actuator import ActuatorParameters
from quadvel_description.arrays import Array, Bools
from quadvel_description.robot import Robot
from quadvel_description.state import RobotState
from quadvel_estimator.features import previous_action
from quadvel_estimator.learned import LearnedEstimator
from quadvel_policy.policy_file import PolicyFile

from .imu import ImuHypotheses
from .legs import Legs
from .policy_replay import PolicyReplay
from .run import Run
from .torque import TorqueModel

GAP_PERIODS = 1.5  # states further apart than this have lost states between them

PARTS: Mapping[str, str] = {
    "drives": "reported joint torques and servo commands",
    "torque": "reported joint torques while the drives follow targets",
    "imu": "orientation, gyroscope and accelerometer",
    "robot": "a robot whose kinematics are known",
    "ground": "feet that carry the robot, shown by torques and IMU of a robot whose kinematics are known",
    "policy": "a walk from its beginning, with modes, velocity estimate and the policy file",
    "estimate": "the velocity estimate",
    "temperature": "motor_status",
    "command": "the commanded velocity",
    "modes": "controller/state",
}
"""What a cause may need, for people."""


@attrs.frozen
class Trained:
    """Ranges in which the policy was trained.

    Attributes:
        delay: Longest delay from a command to its torque, s.
        payload: Smallest and largest mass on the trunk, kg.
        gains: Ratios of real to commanded stiffness and damping.
    """

    delay: float = 0.011
    payload: tuple[float, float] = (-1.0, 3.0)
    gains: tuple[float, float] = (0.9765, 0.958)

    @classmethod
    def from_policy(cls, robot: Robot, policy: PolicyFile) -> Trained:
        """Read the ranges from the metadata of a policy.

        Args:
            robot: The robot.
            policy: The policy.

        Returns:
            Its ranges; the defaults where the metadata say nothing.
        """
        recipe = policy.metadata.recipe if isinstance(policy.metadata.recipe, dict) else {}
        ranges = recipe.get("configuration", {}).get("randomisation", {})
        drives = ActuatorParameters.of(robot)
        longest = max(p.input_delay_s + p.output_delay_s for p in drives.probable_pairs)
        kp, kd = np.mean(drives.delta_kp), np.mean(drives.delta_kd)
        return cls(
            delay=longest + ranges.get("transmission_delay", (0.0, 0.0))[1],
            payload=tuple(ranges.get("payload", cls().payload)),
            gains=(float(1.0 + kp / drives.kp_ref), float(1.0 + kd / drives.kd_ref)),
        )


class Signals:
    """A run with its policy and everything that the causes derive from both.

    Attributes:
        run: The run.
        policy: The policy; None if it is not known.
        trained: Ranges of the training.
    """

    def __init__(self, run: Run, policy: PolicyFile | None) -> None:
        self.run, self.policy = run, policy
        self.trained = Trained() if policy is None else Trained.from_policy(run.robot, policy)

    @cached_property
    def parts(self) -> frozenset[str]:
        """Keys of PARTS that the run has."""
        run = self.run
        has: dict[str, Any] = {
            "drives": run.tau is not None and bool(np.any(run.tau)) and self.torque.exact.rows > 0,
            "torque": run.tau is not None and bool(np.any(run.tau)) and self.torque.is_usable,
            "imu": run.imu is not None,
            "robot": run.is_own,
            "policy": self.policy is not None and self.replay.is_usable,
            "estimate": run.estimate is not None,
            "temperature": run.temperature is not None,
            "command": run.velocity_command is not None and self.policy is not None,
            "modes": run.modes is not None,
        }
        has["ground"] = has["torque"] and has["imu"] and has["robot"] and not self.legs.hangs
        return frozenset(part for part, there in has.items() if there)

    @cached_property
    def torque(self) -> TorqueModel:
        """PD law of the commands against the reported torque."""
        return TorqueModel(self.run)

    @cached_property
    def legs(self) -> Legs:
        """Forces, velocities and heights of the feet."""
        return Legs(self.run)

    @cached_property
    def estimate(self) -> Array:
        """Estimated velocity at the times of the states, (n, 3), m/s, body frame."""
        run = self.run
        assert run.estimate is not None
        return np.column_stack(
            [np.interp(run.time, run.estimate.time, axis) for axis in run.estimate.value.T]
        )

    @cached_property
    def imu(self) -> ImuHypotheses:
        """Orientation, gyroscope and accelerometer against each other."""
        return ImuHypotheses(self.run)

    @cached_property
    def replay(self) -> PolicyReplay:
        """The policy on what was recorded."""
        assert self.policy is not None
        return PolicyReplay(self.run, self.policy)

    @cached_property
    def slope_over_speed(self) -> Array:
        """Ratio of the slope of each angle to its reported speed, (J,); NaN where the joint hardly moves.

        Trimmed least squares of (q' - q) / dt on the mean of both speeds.
        """
        run = self.run
        dt = np.diff(run.time)[:, None]
        # Repeated states show no motion, and the states after them that of two periods.
        steps = (dt[:, 0] > 0.0) & (dt[:, 0] < 2.5 * run.period) & ~self.repeated[1:] & ~self.repeated[:-1]
        slope = np.diff(run.q, axis=0)[steps] / dt[steps]
        speed = (0.5 * (run.dq[1:] + run.dq[:-1]))[steps]
        found = np.full(len(run.joints), np.nan)
        for j in range(len(run.joints)):
            x, y = speed[:, j], slope[:, j]
            use = np.isfinite(x) & np.isfinite(y)
            if use.sum() < 20 or np.sqrt(np.mean(x[use] ** 2)) < 0.02 or np.std(y[use]) < MOVES_RAD_S:
                continue
            for _ in range(4):
                ratio = float(x[use] @ y[use] / (x[use] @ x[use]))
                off = np.abs(y - ratio * x)
                use = use & (off <= 4.0 * 1.4826 * np.median(off[use]) + 1e-9)
            with np.errstate(invalid="ignore"):  # an encoder that is held shows one speed: no correlation
                correlation = float(np.corrcoef(x[use], y[use])[0, 1])
            found[j] = ratio if correlation**2 > 0.6 else np.nan
        return found

    @cached_property
    def jumps(self) -> Array:
        """Change of each angle that its speeds do not explain, (n - 1, J), rad; 0 across lost states.

        States that a busy computer took late together have stamps that are closer than their samples:
        what a whole period explains is no jump.
        """
        run = self.run
        dt = np.diff(run.time)[:, None]
        # dq_mean = (dq[i] + dq[i+1]) / 2 says little of a gap, in which the speed may turn round
        change, mean = np.diff(run.q, axis=0), 0.5 * (run.dq[1:] + run.dq[:-1])
        unexplained, in_a_period = change - dt * mean, change - run.period * mean
        is_late = (dt < run.period) & (np.abs(in_a_period) < np.abs(unexplained))
        unexplained = np.where(is_late, in_a_period, unexplained)
        return np.asarray(
            np.where(np.isfinite(unexplained) & (dt > GAP_PERIODS * run.period), 0.0, unexplained)
        )

    @cached_property
    def repeated(self) -> Bools:
        """States that repeat the one before bit by bit, (n,)."""
        run = self.run
        same = (np.diff(run.q, axis=0) == 0.0).all(axis=1) & (np.diff(run.dq, axis=0) == 0.0).all(axis=1)
        return np.concatenate([[False], same])

    @cached_property
    def replayed_estimate(self) -> Array:
        """Velocity of the shipped estimator on the recorded states and commands, (n, 3), m/s, body frame."""
        run, commands = self.run, self.run.commands
        assert run.imu is not None
        assert run.tau is not None
        estimator = LearnedEstimator(run.robot)
        found = np.full((len(run.time), 3), np.nan)
        # The action in force when a state is measured is the answer to an earlier state.
        newest = np.searchsorted(commands.answers, np.arange(len(run.time)), side="left") - 1
        for k, row in enumerate(newest):
            state = RobotState(
                float(run.time[k]),
                k,
                run.q[k],
                run.dq[k],
                run.tau[k],
                run.imu.quaternion[k],
                run.imu.angular_velocity[k],
                run.imu.linear_acceleration[k],
                np.zeros(4),
            )
            mode = 10 if row >= 0 and commands.servo[row] else 0
            action = previous_action(run.robot, commands.q[row], mode) if row >= 0 else np.zeros(12)
            try:
                found[k] = estimator.update(state, action)[0]
            except FloatingPointError:
                estimator.reset()
        return found


MOVES_RAD_S = 0.3
"""Standard deviation of the slope of a joint that moves."""
