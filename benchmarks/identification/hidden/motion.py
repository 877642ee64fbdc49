"""Motions of the legs: foot lifting (Eq. 9 of the paper) and mixed motions, with ground forces.

Motions are made on the plant's ticks. They are no gaits that balance a robot: the ground force is a
given function of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LINK = 0.25  # m, thigh and calf of the AlienGo
HIP_OFFSET = 0.0868  # m
STANCE = (0.0, 0.6435, -1.287)  # rad
LEGS = ("FR", "FL", "RR", "RL")
KINDS = ("hip", "thigh", "calf")


@dataclass(frozen=True)
class Motion:
    """Commands, and the joint torque of the ground.

    Attributes:
        ticks: Ticks at which commands are sent, (M,).
        targets: Commanded angles, (M, J), rad.
        load: Joint torque of the ground, (K, J), N m.
    """

    ticks: NDArray[np.int64]
    targets: Array
    load: Array


def joint_names(legs: tuple[str, ...]) -> list[str]:
    """Return the joint names of some legs."""
    return [f"{leg}_{kind}_joint" for leg in legs for kind in KINDS]


def leg_angles(x: Array, y: Array, z: Array) -> Array:
    """Inverse kinematics of one leg.

    Args:
        x: Forward position of the foot from below the hip, (K,), m.
        y: Left position of the foot from below the hip, (K,), m.
        z: Height of the foot above the hip, negative, (K,), m.

    Returns:
        Angles of hip, thigh and calf, (K, 3), rad.
    """
    hip = np.arctan2(y, -z)
    drop = np.hypot(y, z)
    reach = np.clip(np.hypot(x, drop), 0.1, 2 * LINK - 1e-3)
    calf = -2 * np.arccos(reach / (2 * LINK))
    return np.stack([hip, -calf / 2 - np.arctan2(x, drop), calf], axis=1)


def ground_torque(angles: Array, force: Array) -> Array:
    """Joint torques of a force at the foot, by the transposed Jacobian.

    Args:
        angles: Joint angles, (K, 3), rad.
        force: Force at the foot, (K, 3), N.

    Returns:
        Torques, (K, 3), N m.
    """
    thigh, knee = angles[:, 1], angles[:, 1] + angles[:, 2]
    dx = np.stack([-LINK * (np.cos(thigh) + np.cos(knee)), -LINK * np.cos(knee)], axis=1)
    dz = np.stack([LINK * (np.sin(thigh) + np.sin(knee)), LINK * np.sin(knee)], axis=1)
    sagittal = dx * force[:, :1] + dz * force[:, 2:]
    lateral = force[:, 1] * LINK * (np.cos(thigh) + np.cos(knee)) + force[:, 2] * HIP_OFFSET * 0.3
    return np.concatenate([lateral[:, None], sagittal], axis=1)


def foot_height(k: Array, lift: Array | float = 0.1, ground: float = -0.4) -> Array:
    """Desired foot height of Eq. 9.

    Args:
        k: Phase, in [0, 4).
        lift: Lift, m.
        ground: Height of the ground, m.

    Returns:
        Height, m.
    """
    up = -2 * k**3 + 3 * k**2
    down = 2 * k**3 - 9 * k**2 + 12 * k - 4
    return lift * np.where(k < 1, up, np.where(k < 2, down, 0.0)) + ground


def _levels(
    rng: np.random.Generator, time: Array, hold: tuple[float, float], low: float, high: float
) -> Array:
    """A piecewise constant random signal over `time`."""
    edges = np.cumsum(rng.uniform(*hold, size=int(time[-1] / hold[0]) + 2))
    return rng.uniform(low, high, size=len(edges) + 1)[np.searchsorted(edges, time)]


def _smoothed(signal: Array, time: Array, constant: float) -> Array:
    """First-order lag with time constant `constant` (s)."""
    from scipy.signal import lfilter

    a = np.exp(-(time[1] - time[0]) / constant)
    return lfilter([1 - a], [1, -a], signal - signal[0]) + signal[0]


def _foot_lifting(rng: np.random.Generator, time: Array, first: float, plain: bool) -> tuple[Array, Array]:
    """Angles (K, 3) and ground force (K, 3) of one leg that steps in place; `plain` is the paper's own."""
    ones = np.ones_like(time)
    rate = 8 * ones if plain else _levels(rng, time, (0.8, 2.0), 5.0, 11.0)
    phase = (first + np.cumsum(rate) * (time[1] - time[0])) % 4
    lift = 0.1 if plain else _smoothed(_levels(rng, time, (0.8, 2.0), 0.05, 0.14), time, 0.1)
    z = foot_height(phase, lift)
    x, y = 0 * time, 0 * time
    if not plain:  # without a sideways motion the hip shows nothing
        y = rng.uniform(0.01, 0.05) * np.sin(2 * np.pi * rng.uniform(0.5, 2.0) * time + rng.uniform(0, 6))
        x = rng.uniform(0.0, 0.05) * np.sin(2 * np.pi * rng.uniform(0.4, 1.5) * time + rng.uniform(0, 6))
    stance = np.clip((phase - 2.0) / 0.15, 0, 1) * np.clip((4.0 - phase) / 0.15, 0, 1)
    weight = rng.choice([0.0, rng.uniform(30, 90)])
    force = np.stack([0 * time, 0 * time, stance * weight], axis=1)
    return leg_angles(x, y, z), force


def _trot(rng: np.random.Generator, time: Array, first: float) -> tuple[Array, Array]:
    frequency, duty = rng.uniform(1.6, 3.2), rng.uniform(0.45, 0.65)
    stride, lift, weight = rng.uniform(0.08, 0.28), rng.uniform(0.05, 0.1), rng.uniform(60, 140)
    phase = (frequency * time + first / 4) % 1.0
    swing = np.clip((phase - duty) / (1 - duty), 0, 1)
    down = np.clip(phase / duty, 0, 1)
    standing = phase < duty
    x = np.where(standing, stride * (0.5 - down), stride * (-0.5 + swing**2 * (3 - 2 * swing)))
    z = -0.4 + lift * np.sin(np.pi * swing) ** 2
    y = rng.uniform(0.0, 0.03) * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 6))
    press = np.where(standing, np.sin(np.pi * down) ** 0.7, 0.0) * weight
    push = np.where(standing, -0.15 * np.sin(2 * np.pi * down), 0.0) * weight
    side = rng.uniform(-0.1, 0.1) * press
    return leg_angles(x, y, z), np.stack([push, side, press], axis=1)


def _chirps(rng: np.random.Generator, time: Array) -> tuple[Array, Array]:
    angles = np.tile(STANCE, (len(time), 1))
    span = time[-1] - time[0]
    for joint in range(3):
        slow, fast = rng.uniform(0.3, 1.0), rng.uniform(3.0, 8.0)
        sweep = slow * (time - time[0]) + (fast - slow) * (time - time[0]) ** 2 / (2 * span)
        angles[:, joint] += rng.uniform(0.1, 0.35) * np.sin(2 * np.pi * sweep + rng.uniform(0, 6))
    return angles, np.zeros((len(time), 3))


def _steps(rng: np.random.Generator, time: Array) -> tuple[Array, Array]:
    angles = np.tile(STANCE, (len(time), 1))
    for joint in range(3):
        levels = _levels(rng, time - time[0], (0.12, 0.5), -0.3, 0.3)
        angles[:, joint] += _smoothed(levels, time, rng.uniform(0.01, 0.04))
    return angles, np.zeros((len(time), 3))


def make_motion(
    rng: np.random.Generator, kind: str, legs: tuple[str, ...], dt: float, duration: float, kp: float
) -> Motion:
    """`kind` is "lifting" (Eq. 9, varied), "eq9" (as the paper has it) or "mixed"."""
    time = np.arange(round(duration / dt), dtype=np.float64) * dt
    parts = [_leg_motion(rng, kind, time, first=0.0 if leg in ("FR", "RL") else 2.0) for leg in legs]
    angles = np.concatenate([angle for angle, _ in parts], axis=1)
    load = np.concatenate([ground_torque(angle, force) for angle, force in parts], axis=1)
    rate = 1000 if kind == "eq9" else rng.choice([200, 500, 1000])
    ticks = np.arange(0, len(time), round(1 / (rate * dt)))
    if kind != "eq9":  # commands are sent a little early or late
        ticks[1:] = ticks[1:] + rng.integers(0, 2, size=len(ticks) - 1)
        ticks = ticks[ticks < len(time)]
    targets = (angles - rng.uniform(0.7, 1.0) * load / kp)[ticks]  # a controller leans against the ground
    if kind == "mixed":
        targets = targets + rng.uniform(0.0, 0.015) * rng.standard_normal(targets.shape)
    return Motion(ticks=ticks, targets=targets, load=load)


def _leg_motion(rng: np.random.Generator, kind: str, time: Array, first: float) -> tuple[Array, Array]:
    if kind != "mixed":
        return _foot_lifting(rng, time, first, plain=kind == "eq9")
    if rng.random() < 0.3:
        return _trot(rng, time, first)
    order = rng.permutation(3)
    parts = []
    for part, span in zip(order, np.array_split(time, 3), strict=True):
        if part == 0:
            parts.append(_trot(rng, span, first))
        else:
            parts.append((_chirps if part == 1 else _steps)(rng, span))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
