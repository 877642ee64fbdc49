"""Plan of the teacher's trot: its velocity, and when each foot is on the ground.

Diagonal feet have the same phase, the two pairs half a cycle apart. The planned velocity follows
the command with a bounded acceleration; step frequency and duty factor are functions of it.
Touchdowns correct the phase, so that the clock follows the robot, and a student without a clock,
which imitates the teacher, does not drift away from it. A robot that is commanded to stand
steps until it is at rest on four feet; one that is pushed while it stands steps again.

The numbers hold for a robot of the reference size; those of others follow by `similarity`.

Source of rewards with a clock: Siekmann et al., Sim-to-Real Learning of All Common Bipedal Gaits
via Periodic Reward Composition (2021); Margolis and Agrawal, Walk These Ways (2022).
"""

from __future__ import annotations

import numpy as np

from .similarity import REFERENCE, Size

FOOT_PHASES = np.array([0.0, 0.5, 0.5, 0.0])  # cycles, in the order of quadruped.LEGS: FR with RL, FL with RR
FREQUENCY = (2.0, 0.95, 4.4)  # Hz at rest, increase in Hz per m/s, highest Hz
DUTY = (0.75, 0.0914, 0.349)  # share of a cycle on the ground at rest, decrease per m/s, least
START_PHASE = 0.6  # cycles since touchdown of the pair FR and RL in stance: it lifts off first
CORRECTION = 0.25  # of a touchdown's phase error; the two feet of a pair correct half of it
SHORTEST_SWING_S = 0.06  # a foot that was in the air for less has not stepped
YAW_RADIUS_M = 0.3  # yaw rate times this counts as speed of the feet
ACCELERATION = np.array([2.5, 1.75, 18.0])  # m/s^2, m/s^2, rad/s^2, of the planned velocity
REST_SPEED = 0.2  # m/s; a slower trunk may stop on four feet
PUSHED_SPEED = 0.4  # m/s; a standing robot whose trunk is faster steps


def foot_pace(velocity: np.ndarray) -> np.ndarray:
    """Speed at which a velocity moves the feet of a robot of the reference size.

    Args:
        velocity: (n, 3), vx, vy (m/s), yaw rate (rad/s).

    Returns:
        (n,), m/s.
    """
    return np.asarray(np.hypot(velocity[:, 0], velocity[:, 1]) + YAW_RADIUS_M * np.abs(velocity[:, 2]))


def step_frequency(velocity: np.ndarray) -> np.ndarray:
    """Planned steps of a foot per second, of a robot of the reference size.

    Args:
        velocity: (n, 3), planned vx, vy (m/s) and yaw rate (rad/s).

    Returns:
        (n,), Hz.
    """
    rest, slope, highest = FREQUENCY
    return np.minimum(rest + slope * foot_pace(velocity), highest)


def duty_factor(velocity: np.ndarray) -> np.ndarray:
    """Planned share of a cycle that a foot is on the ground, of a robot of the reference size.

    Args:
        velocity: (n, 3), planned vx, vy (m/s) and yaw rate (rad/s).

    Returns:
        (n,).
    """
    rest, slope, least = DUTY
    return np.maximum(rest - slope * foot_pace(velocity), least)


class GaitClock:
    """Plan of the trot of `n` robots.

    Attributes:
        size: size of the robots.
        phase: (n,), cycles since the planned touchdown of the feet FR and RL, 0 to 1.
        velocity: (n, 3), planned: vx, vy (m/s), yaw rate (rad/s).
        walking: (n,) bool, whether the plan has steps.
    """

    def __init__(self, n: int, size: Size = REFERENCE) -> None:
        """Create the plans of standing robots.

        Args:
            n: number of robots.
            size: their size.
        """
        self.size = size
        self.phase, self.velocity = np.full(n, START_PHASE), np.zeros((n, 3))
        self.walking = np.zeros(n, bool)

    def reset(self, ids: np.ndarray) -> None:
        """Let some robots stand.

        Args:
            ids: their indices.
        """
        self.phase[ids], self.velocity[ids], self.walking[ids] = START_PHASE, 0.0, False

    def advance(self, command: np.ndarray, speed: np.ndarray, stepped: np.ndarray, period: float) -> None:
        """Advance the plans; those of standing robots wait at the start of a walk.

        Args:
            command: (n, 4), command that was in force.
            speed: (n,), m/s, horizontal speed of the trunk.
            stepped: (n, 4) bool, feet that touched the ground after `shortest_swing` or more.
            period: s.
        """
        # ACCELERATION is that of the reference: (m/s^2) * 1, (rad/s^2) / length
        reach = ACCELERATION / [1.0, 1.0, self.size.length] * period
        self.velocity = self.velocity + np.clip(command[:, :3] - self.velocity, -reach, reach)
        # phase <- phase + f dt - CORRECTION sum_i e_i,  e_i = phase of foot i at its touchdown,
        # within -0.5 and 0.5
        phase = self.phase + self.frequency * period
        error = (phase[:, None] + FOOT_PHASES + 0.5) % 1.0 - 0.5
        phase = (phase - CORRECTION * (error * stepped).sum(axis=1)) % 1.0
        self.phase = np.where(self.walking, phase, START_PHASE)
        slow, pushed = REST_SPEED * self.size.speed, PUSHED_SPEED * self.size.speed
        at_rest = (speed < slow) & ~self.velocity.any(axis=1) & (self.swing_share() < 0.0).all(axis=1)
        self.walking = np.where(self.walking, ~at_rest, speed > pushed) | (command[:, 3] < 0.5)

    @property
    def shortest_swing(self) -> float:
        """Time after which a foot that touches the ground has stepped, s."""
        return SHORTEST_SWING_S * self.size.time

    @property
    def frequency(self) -> np.ndarray:
        """Planned steps of a foot per second, (n,), Hz."""
        return step_frequency(self.size.as_reference(self.velocity)) / self.size.time

    @property
    def duty(self) -> np.ndarray:
        """Planned share of a cycle that a foot is on the ground, (n,)."""
        return duty_factor(self.size.as_reference(self.velocity))

    def foot_phases(self, ahead: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the phase of each foot.

        Args:
            ahead: (n,), cycles added.

        Returns:
            (n, 4), cycles since its planned touchdown, 0 to 1.
        """
        return np.asarray(((self.phase + ahead)[:, None] + FOOT_PHASES) % 1.0)

    def swing_share(self, ahead: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how much of each foot's planned swing is over.

        Args:
            ahead: (n,), cycles added to the phase.

        Returns:
            (n, 4), 0 at lift-off to 1 at touchdown; negative while the foot is planned to be down.
        """
        duty = self.duty[:, None]
        return np.asarray((self.foot_phases(ahead) - duty) / (1.0 - duty))

    def observation(self) -> np.ndarray:
        """Return what the teacher sees of its plan.

        A mirrored robot has the clock half a cycle later: sine and cosine change sign.

        Returns:
            (n, 5): sine and cosine of the phase, 0 while standing; planned velocity of a robot of
            the reference size that moves alike.
        """
        angle = 2.0 * np.pi * self.phase
        phase = np.stack([np.sin(angle), np.cos(angle)], axis=1) * self.walking[:, None]
        return np.concatenate([phase, self.size.as_reference(self.velocity)], axis=1)
