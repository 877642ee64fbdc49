"""Scripted trot that the teacher's network corrects.

Feet follow the gait clock: swings rise and return, stances sweep at the commanded velocity. Two
feedbacks of the true state keep nominal robots on their feet to about 1.5 m/s on level ground.
"""

from __future__ import annotations

import numpy as np

from quadvel_description.kinematics import foot_positions, inverse_kinematics

from .env import VelocityEnv
from .gait_clock import GaitClock, duty_factor, step_frequency

CROUCH_M = 0.03  # by which the trunk is lower than in the nominal posture: longer steps are in reach
LIFT_M = 0.08  # height of a swing
LONGEST_STEP_M = 0.36  # way of a foot under the trunk in one stance
LEAD_S = 0.05  # joints follow their targets so late
PLACEMENT_S = 0.12  # feet are placed this time times the excess velocity further out (Raibert),
BEHIND_S = 0.05  # and this time times the commanded velocity further behind, which drives the robot
MAX_EXCESS = 0.5  # m/s, excess velocity that counts
RATE_S = 0.1  # time that a roll or pitch rate is extrapolated


def joint_offsets(env: VelocityEnv, clock: GaitClock) -> np.ndarray:
    """Return the joint targets of the scripted trot, relative to those of standing.

    Args:
        env: environments.
        clock: gait clock of their robots.

    Returns:
        (n, 12), rad; 0 while standing.
    """
    robot, command = env.robot, env.command
    below = foot_positions(robot, robot.nominal_q) + np.array([0.0, 0.0, CROUCH_M])  # (4, 3), m, trunk frame
    vx, vy, wz, standing = command.T
    duty, frequency = duty_factor(command), step_frequency(command)
    ahead = LEAD_S * frequency
    phases, share = clock.foot_phases(ahead), clock.swing_share(command, ahead)
    swing, down = np.maximum(share, 0.0), share < 0.0  # s: share of the planned swing that is over
    # velocity of the ground under a foot at (x, y): -(vx - wz y, vy + wz x); a stance lasts duty / f
    under = np.stack(
        [vx[:, None] - wz[:, None] * below[:, 1], vy[:, None] + wz[:, None] * below[:, 0]], axis=-1
    )
    way = under * (duty / frequency)[:, None, None]  # (n, 4, 2), m
    way *= np.minimum(1.0, LONGEST_STEP_M / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9))
    # place on the way, from 1 to -1 in stance and back in swing: 1 - 2 phase / duty, -cos(pi s)
    along = np.where(down, 1.0 - 2.0 * phases / duty[:, None], -np.cos(np.pi * swing))
    # x_foot = x_nominal + way along / 2 + PLACEMENT_S (v - v_command) - BEHIND_S v_command
    excess = np.clip(env.velocity[:, :2] - command[:, :2], -MAX_EXCESS, MAX_EXCESS)
    feet = np.broadcast_to(below, (len(command), 4, 3)).copy()
    placed = PLACEMENT_S * excess - BEHIND_S * command[:, :2]
    feet[..., :2] += 0.5 * way * along[..., None] + placed[:, None, :]
    # z_foot = z_nominal + LIFT_M sin^2(pi s); a stance foot on the lower side of the trunk pushes
    # down: z_foot += y roll - x pitch, both extrapolated by RATE_S
    roll, pitch = (env.roll_pitch + RATE_S * env.angular_velocity[:, :2]).T[..., None]
    level = below[:, 1] * roll - below[:, 0] * pitch
    feet[..., 2] += LIFT_M * np.sin(np.pi * swing) ** 2 + level * down
    # a planned stance carries 4 / (number of planned stances) of its load on four feet
    carried = down * 4.0 / np.maximum(down.sum(axis=1, keepdims=True), 1) - 1.0
    load = np.repeat(carried, 3, axis=1) * (env.stand_q - robot.nominal_q)
    return np.asarray((inverse_kinematics(robot, feet) - robot.nominal_q + load) * (standing < 0.5)[:, None])
