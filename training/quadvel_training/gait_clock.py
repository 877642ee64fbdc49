"""Clock of the teacher's trot: when each foot is planned to be on the ground.

Diagonal feet have the same phase, the two pairs half a cycle apart. Step frequency and duty factor
are functions of the command. Touchdowns correct the phase, so that the clock follows the robot, and
a student without a clock, which imitates the teacher, does not drift away from it.

Source of rewards with a clock: Siekmann et al., Sim-to-Real Learning of All Common Bipedal Gaits
via Periodic Reward Composition (2021); Margolis and Agrawal, Walk These Ways (2022).
"""

from __future__ import annotations

import numpy as np

FOOT_PHASES = np.array([0.0, 0.5, 0.5, 0.0])  # cycles, in the order of quadruped.LEGS: FR with RL, FL with RR
FREQUENCY = (1.9, 0.55, 4.2)  # Hz at rest, increase in Hz per m/s, highest Hz
DUTY = (0.68, 0.07, 0.36)  # share of a cycle on the ground at rest, decrease per m/s, least
START_PHASE = 0.6  # cycles since touchdown of the pair FR and RL in stance: it lifts off first
CORRECTION = 0.25  # of a touchdown's phase error; the two feet of a pair correct half of it
SHORTEST_SWING_S = 0.06  # a foot that was in the air for less has not stepped
YAW_RADIUS_M = 0.3  # yaw rate times this counts as speed of the feet


def foot_pace(command: np.ndarray) -> np.ndarray:
    """Speed at which a command moves the feet.

    Args:
        command: (n, 4), vx, vy (m/s), yaw rate (rad/s), 1 to stand.

    Returns:
        (n,), m/s.
    """
    return np.asarray(np.hypot(command[:, 0], command[:, 1]) + YAW_RADIUS_M * np.abs(command[:, 2]))


def step_frequency(command: np.ndarray) -> np.ndarray:
    """Planned steps of a foot per second.

    Args:
        command: (n, 4).

    Returns:
        (n,), Hz.
    """
    rest, slope, highest = FREQUENCY
    return np.minimum(rest + slope * foot_pace(command), highest)


def duty_factor(command: np.ndarray) -> np.ndarray:
    """Planned share of a cycle that a foot is on the ground.

    Args:
        command: (n, 4).

    Returns:
        (n,).
    """
    rest, slope, least = DUTY
    return np.maximum(rest - slope * foot_pace(command), least)


class GaitClock:
    """Phase of the trot of `n` robots.

    Attributes:
        phase: (n,), cycles since the planned touchdown of the feet FR and RL, 0 to 1.
    """

    def __init__(self, n: int) -> None:
        """Create the clocks of standing robots.

        Args:
            n: number of robots.
        """
        self.phase = np.full(n, START_PHASE)

    def reset(self, ids: np.ndarray) -> None:
        """Set the clocks of some robots to the start of a walk.

        Args:
            ids: their indices.
        """
        self.phase[ids] = START_PHASE

    def advance(self, command: np.ndarray, stepped: np.ndarray, period: float) -> None:
        """Advance the clocks of walking robots; those of standing ones wait at the start of a walk.

        Args:
            command: (n, 4), command that was in force.
            stepped: (n, 4) bool, feet that touched the ground after `SHORTEST_SWING_S` or more.
            period: s.
        """
        # phase <- phase + f dt - CORRECTION sum_i e_i,  e_i = phase of foot i at its touchdown,
        # within -0.5 and 0.5
        phase = self.phase + step_frequency(command) * period
        error = (phase[:, None] + FOOT_PHASES + 0.5) % 1.0 - 0.5
        phase = (phase - CORRECTION * (error * stepped).sum(axis=1)) % 1.0
        self.phase = np.where(command[:, 3] < 0.5, phase, START_PHASE)

    def foot_phases(self, ahead: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the phase of each foot.

        Args:
            ahead: (n,), cycles added.

        Returns:
            (n, 4), cycles since its planned touchdown, 0 to 1.
        """
        return np.asarray(((self.phase + ahead)[:, None] + FOOT_PHASES) % 1.0)

    def swing_share(self, command: np.ndarray, ahead: np.ndarray | float = 0.0) -> np.ndarray:
        """Return how much of each foot's planned swing is over.

        Args:
            command: (n, 4).
            ahead: (n,), cycles added to the phase.

        Returns:
            (n, 4), 0 at lift-off to 1 at touchdown; negative while the foot is planned to be down.
        """
        duty = duty_factor(command)[:, None]
        return np.asarray((self.foot_phases(ahead) - duty) / (1.0 - duty))

    def observation(self, command: np.ndarray) -> np.ndarray:
        """Return what the teacher sees of its clock.

        A mirrored robot has the clock half a cycle later: both numbers change sign.

        Args:
            command: (n, 4).

        Returns:
            (n, 2): sine and cosine of the phase; 0 while standing.
        """
        angle = 2.0 * np.pi * self.phase
        return np.stack([np.sin(angle), np.cos(angle)], axis=1) * (command[:, 3:] < 0.5)
