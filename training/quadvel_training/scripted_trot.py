"""Scripted trot that the teacher's network corrects.

Feet follow the gait clock: swings rise and return, stances sweep at the planned velocity. Feedbacks
of the true state keep robots on their feet: feet are placed by the excess velocity and by the way
that the robot lags behind, the trunk is kept parallel to the ground and at its height, feet turn against a wrong
yaw rate. In curves the feet are placed further out, on slopes further down. The gains were found by a search over walks of
robots drawn as in training, without a network. Lengths, times and speeds hold for a robot of the
reference size; those of others follow by `similarity`.
"""

from __future__ import annotations

import numpy as np

from quadvel_description.kinematics import foot_positions, inverse_kinematics
from quadvel_description.quadruped import GRAVITY

from .env import VelocityEnv
from .past import Past

HEIGHT_M = 0.358  # of the trunk above ground
CROUCH_M = 0.014  # by which the trunk is lower than in the nominal posture: longer steps are in reach
LIFT_M = 0.09  # height of a swing
LONGEST_STEP_M = 0.108  # way of a foot under the trunk in one stance
LEAD_S = 0.05  # joints follow their targets so late, whatever the size
PLACEMENT_S = np.array([0.103, 0.073])  # x, y: feet are placed this time times the excess velocity out,
CATCH_UP = 0.2  # and behind by this share of the way that it lags behind its plan
BEHIND_S = np.array([0.092, 0.037])  # targets of stance feet are this time times the planned velocity behind,
DRAG = np.array([0.0105, 0.0])  # s^2/m, and this times its square: joints push the trunk forward
MAX_BEHIND = np.array([0.46, 2.0])  # m/s, planned velocity that counts
MAX_EXCESS = 0.5  # m/s, excess velocity that counts
SIDEWAYS_S = 0.07  # feet are placed this time times a lasting sideways velocity behind,
CURVE = 1.6  # and in a lasting curve out by this multiple of what its acceleration takes,
MAX_ASIDE_M = 0.11  # both together by this at most: further out, robots fall when they leave the curve
DOWNHILL = 0.8  # share of the way from below the hips to below the trunk on a slope by which feet are placed
TURN_S = 0.064  # feet are turned about the trunk by this time times the excess yaw rate
MAX_YAW_EXCESS = 1.5  # rad/s, excess yaw rate that counts
LEVELLING = np.array([1.68, 0.87])  # roll, pitch: share of the tilt to the ground that stance feet push back
RATE_S = np.array([0.068, 0.112])  # time that a roll or pitch rate is extrapolated
HEIGHT_GAIN = 0.37  # share of the height above HEIGHT_M by which stance feet of a walk give way,
MAX_HEIGHT_ERROR_M = 0.1  # up to this error
LOAD = 1.51  # share of the load of a stance foot that is fed forward
LOADING = 0.16  # cycles in which a stance gains or loses load and push, half before touchdown or lift-off


def joint_offsets(env: VelocityEnv, past: Past) -> np.ndarray:
    """Return the joint targets of the scripted trot, relative to those of standing.

    Args:
        env: environments.
        past: their past, with the gait clock and the way that they lag behind.

    Returns:
        (n, 12), rad.
    """
    # All velocities and lengths here are those of a reference robot that moves alike.
    robot, size, clock = env.robot, env.size, past.clock
    planned, velocity = size.as_reference(clock.velocity), size.as_reference(env.planar_velocity)
    steady = past.steady[:, None]
    cruise = planned * steady
    planned[:, 2] += past.turn_correction * size.time
    below = foot_positions(robot, robot.nominal_q) / size.length + [0.0, 0.0, CROUCH_M]  # (4, 3), trunk frame
    duty, frequency = clock.duty, clock.frequency * size.time
    ahead = LEAD_S * clock.frequency
    phases = clock.foot_phases(ahead)
    share = np.where(clock.walking[:, None], clock.swing_share(ahead), -1.0)
    swing, down = np.maximum(share, 0.0), share < 0.0  # s: share of the planned swing that is over
    loaded = np.where(clock.walking[:, None], _load(phases, duty), 1.0)
    excess = np.clip(velocity[:, :2] - planned[:, :2], -MAX_EXCESS, MAX_EXCESS)
    turning = np.clip(velocity[:, 2] - planned[:, 2], -MAX_YAW_EXCESS, MAX_YAW_EXCESS)
    # way of a foot at (x, y) in a stance of duty / f: (vx - w y, vy + w x) duty / f, (n, 4, 2), m
    way = (planned[:, None, :2] + _turned(below, planned[:, 2])) * (duty / frequency)[:, None, None]
    way = _bounded(way, LONGEST_STEP_M)
    # place on the way, from 1 to -1 in stance and back in swing: 1 - 2 phase / duty, -cos(pi s)
    along = np.where(down, 1.0 - 2.0 * phases / duty[:, None], -np.cos(np.pi * swing))
    along *= clock.walking[:, None]
    # x_foot = x_nominal + way along / 2 + PLACEMENT_S (v - v_planned) - CATCH_UP lag
    #     - bound(SIDEWAYS_S v_cruise,y + CURVE (h / g) w x v_cruise) + DOWNHILL h slope
    #     + TURN_S (w_z - w_planned) x (x_nominal)
    #     - loaded (BEHIND_S clip(v_planned) + DRAG |v_planned| v_planned)
    # A trunk at height h above feet that are a distance d aside accelerates by g d / h. The last
    # term acts in stance alone: joints push the trunk forward, and swings end further ahead.
    placed = PLACEMENT_S * excess - CATCH_UP * past.lag[:, :2] / size.length * steady * clock.walking[:, None]
    aside = CURVE * HEIGHT_M / GRAVITY * _turned(cruise[:, None, :2], cruise[:, 2])[:, 0]
    aside[:, 1] += SIDEWAYS_S * cruise[:, 1]
    placed -= _bounded(aside, MAX_ASIDE_M)
    placed += DOWNHILL * HEIGHT_M * env.ground_slope
    behind = BEHIND_S * np.clip(planned[:, :2], -MAX_BEHIND, MAX_BEHIND)
    behind = behind + DRAG * np.abs(planned[:, :2]) * planned[:, :2]
    feet = np.broadcast_to(below, (len(planned), 4, 3)).copy()
    feet[..., :2] += 0.5 * way * along[..., None] + placed[:, None, :] + _turned(below, TURN_S * turning)
    feet[..., :2] -= loaded[..., None] * behind[:, None, :]
    # z_foot = z_nominal + LIFT_M sin^2(pi s); a stance foot on the lower side of the trunk pushes
    # down: z_foot += y roll - x pitch, both extrapolated by RATE_S, times LEVELLING; while walking,
    # z_foot += HEIGHT_GAIN (h - HEIGHT_M)
    tilt = env.roll_pitch - env.ground_lean + RATE_S * size.time * env.angular_velocity[:, :2]
    roll, pitch = (LEVELLING * tilt).T[..., None]
    level = below[:, 1] * roll - below[:, 0] * pitch
    above = (
        np.clip(env.height / size.length - HEIGHT_M, -MAX_HEIGHT_ERROR_M, MAX_HEIGHT_ERROR_M) * clock.walking
    )
    feet[..., 2] += LIFT_M * np.sin(np.pi * swing) ** 2 + (level + HEIGHT_GAIN * above[:, None]) * loaded
    # a planned stance carries 4 / (number of planned stances) of its load on four feet
    carried = loaded * 4.0 / np.maximum(loaded.sum(axis=1, keepdims=True), 1.0) - 1.0
    load = LOAD * np.repeat(carried, 3, axis=1) * (env.stand_q - robot.nominal_q)
    return np.asarray(inverse_kinematics(robot, size.length * feet) - robot.nominal_q + load)


def _load(phases: np.ndarray, duty: np.ndarray) -> np.ndarray:
    """Share (n, 4) of its load that a foot carries, without jumps.

    It grows linearly over `LOADING` cycles around touchdown, at phase 0, and falls around lift-off.
    """
    left = duty[:, None] - phases
    inside = np.where(left > 0.0, np.minimum(phases, left), -np.minimum(-left, 1.0 - phases))  # cycles
    return np.asarray(np.clip(0.5 + inside / LOADING, 0.0, 1.0))


def _bounded(way: np.ndarray, longest: float) -> np.ndarray:
    """Displacements (..., 2) of the same directions, no longer than a length."""
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    return np.asarray(way * np.minimum(1.0, longest / np.maximum(length, 1e-9)))


def _turned(feet: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Displacement of feet (..., 4, 2 or more) that are turned by a small angle (n,) about the trunk."""
    return np.stack([-feet[..., 1], feet[..., 0]], axis=-1) * angle[:, None, None]
