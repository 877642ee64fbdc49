"""What a robot's past adds to its state: low-passed errors, foot timing and the plan of its steps.

The teacher and the critics see it; the policy, which has a memory, does not.
"""

from __future__ import annotations

import numpy as np

from .env import VelocityEnv
from .gait_clock import GaitClock

STRIDE_S = 0.35  # time constant of stride errors: about a stride
LASTING_S = 1.5  # time constant of lasting errors
MAX_LAG = 0.2  # m, m, rad: a robot that does not follow is not to make up for more later
CATCH_UP_TURN = 1.0  # 1/s: this times the angle that a robot lags behind is added to its teacher's yaw rate
TRANSIENT_S = 1.0  # after the plan has reached a command, not part of lasting errors and scores
STEADY_S = 0.5  # time constant with which a velocity that the plan has reached counts as steady,
STEADY_END_S = 0.1  # and with which it ceases to under a new command
STANDING_S = 0.2  # on four feet; after that, setting off means choosing a side


class Past:
    """Low-passed errors and foot timing of `n` robots.

    Attributes:
        env: environments.
        stride: (n, 3), command minus velocity in vx, vy (m/s) and yaw rate (rad/s), low-passed over
            `STRIDE_S`.
        lasting: (n, 3), the same over `LASTING_S`; set to zero by a new command, it changes while
            the robot is `settled`.
        lag: (n, 3), m, m, rad, body frame, how far the robot is behind its plan: the way from where it
            is to where planned velocities would have taken it, over all commands; 0 once it is to stand.
        air: (n, 4), s since the foot left the ground; 0 on the ground.
        down: (n, 4), s since the foot touched the ground; 0 in the air.
        clock: plan of the steps.
        steady: (n,), 0 under a new command, grows over `STEADY_S` to 1 once the plan has reached it.
        off_hip: (n, 4), m, body frame: of a foot that has just left the ground, how far ahead of
            its hip the middle of its stance was; else 0.
    """

    def __init__(self, env: VelocityEnv) -> None:
        """Create the past of robots that start now.

        Args:
            env: environments.
        """
        n = env.config.n
        self.env, self._hips_ahead = env, env.robot.legs.hips[:, 0]  # m, body frame
        self.stride, self.lasting, self.lag = (np.zeros((n, 3)) for _ in range(3))
        self.air, self.down = np.zeros((n, 4)), np.zeros((n, 4))
        self.off_hip, self.clock = np.zeros((n, 4)), GaitClock(n, env.size)
        self.steady = np.zeros(n)
        self._age = np.zeros(n)  # s, since the plan has the commanded velocity
        self._landed, self._last = np.zeros((n, 4)), np.zeros((n, 4))  # m ahead of the hip: at touchdown, now

    def reset(self, ids: np.ndarray) -> None:
        """Clear the past of some robots.

        Args:
            ids: their indices.
        """
        for array in (
            self.stride,
            self.lasting,
            self.lag,
            self.air,
            self.down,
            self.off_hip,
            self._age,
            self.steady,
        ):
            array[ids] = 0.0
        self.clock.reset(ids)

    def advance(self, command: np.ndarray) -> None:
        """Update everything after a tick of the environment.

        Args:
            command: (n, 4), command that was in force.
        """
        env, period = self.env, self.env.config.period
        # First-order low-pass filters: x <- x + (e - x) dt / T
        error = velocity_error(env, command)
        self.stride += (error - self.stride) * period / STRIDE_S
        reached = (self.clock.velocity == command[:, :3]).all(axis=1)[:, None]
        self._age += period * reached[:, 0]
        taking = np.where(reached[:, 0], STEADY_S, STEADY_END_S) * env.size.time
        self.steady += (reached[:, 0] - self.steady) * period / taking
        settled = self.settled[:, None]
        self.lasting += (error - self.lasting) * settled * period / LASTING_S
        # l <- l + (v_planned - v - w x l) dt, within MAX_LAG; 0 for a robot that is to stand. The way stays
        # where it is in the world while the body turns by w; y follows the new x, so that its length stays.
        turn = env.angular_velocity[:, 2] * period
        self.lag += (self.clock.velocity - env.planar_velocity) * period
        self.lag[:, 0] += turn * self.lag[:, 1]
        self.lag[:, 1] -= turn * self.lag[:, 0]
        self.lag = np.clip(self.lag, -MAX_LAG, MAX_LAG)
        self.lag[command[:, 3] > 0.5] = 0.0
        self.lasting[env.changed] = 0.0
        self._age[env.changed] = 0.0
        self._advance_stances()
        speed = np.hypot(env.velocity[:, 0], env.velocity[:, 1])
        self.clock.advance(command, speed, env.contact & (self.air >= self.clock.shortest_swing), period)
        self.air = np.where(env.contact, 0.0, self.air + period)
        self.down = np.where(env.contact, self.down + period, 0.0)

    def _advance_stances(self) -> None:
        """Record where feet touch down and lift off; `down` is still that of the sample before."""
        contact, ahead = self.env.contact, self.env.foot_position[..., 0] - self._hips_ahead
        was_down = self.down > 0.0
        self._landed = np.where(contact & ~was_down, ahead, self._landed)
        self.off_hip = np.where(was_down & ~contact, 0.5 * (self._landed + self._last), 0.0)
        self._last = np.where(contact, ahead, self._last)

    @property
    def turn_correction(self) -> np.ndarray:
        """Yaw rate that is added to the teacher's command, so that the robot turns as far as commanded.

        Returns:
            (n,), rad/s.
        """
        lag = self.lag[:, 2] * self.steady * self.clock.walking
        return np.asarray(CATCH_UP_TURN / self.env.size.time * lag)

    @property
    def settled(self) -> np.ndarray:
        """Whether the plan has had the commanded velocity for `TRANSIENT_S`, (n,) bool."""
        return np.asarray(self._age > TRANSIENT_S)

    @property
    def standing(self) -> np.ndarray:
        """Whether robots have stood on four feet for `STANDING_S`, (n,) bool."""
        return np.asarray((self.down > STANDING_S).all(axis=1))


def velocity_error(env: VelocityEnv, command: np.ndarray) -> np.ndarray:
    """Command minus velocity in the body frame.

    Args:
        env: environments.
        command: (n, 4).

    Returns:
        (n, 3): vx, vy in m/s, yaw rate in rad/s.
    """
    return np.asarray(command[:, :3] - env.planar_velocity)
