"""Time-stepped plant: legs under drives of the paper's actuator model (Eq. 1), with effects.

Each tick and joint: arrived command -> error and speed -> requested torque -> effects in the drive
-> output delay -> effects at the joint -> acceleration. Plain floats are faster than small arrays.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Step = Callable[[int, float], float]

GRAVITY = 9.81
THIGH_MOMENT = (0.771 * 0.04 + 0.267 * 0.25) * GRAVITY  # N m, of the straight thigh held out
CALF_MOMENT = 0.267 * 0.1667 * GRAVITY
THIGH_INERTIA, CALF_INERTIA, COUPLING = 0.0332, 0.0101, 0.0111  # kg m^2
ROTOR = (0.015, 0.015, 0.023)
HIP_INERTIA = 0.045


@dataclass(frozen=True)
class Drive:
    """True gains (N m/rad, N m s/rad) and delays (ticks) of the drives."""

    kp: float
    kd: float
    input_ticks: int
    output_ticks: int


@dataclass
class State:
    """State that effects can read, one float for each joint; torques are of the tick before."""

    q: list[float]
    dq: list[float]
    ddq: list[float]
    asked: list[float]
    tau: list[float]
    target: list[float]
    past_tau: list[list[float]] = field(default_factory=list)


@dataclass(frozen=True)
class Body:
    """Scale of each leg's inertia, and joint damping (N m s/rad) outside the drive, (J,) each."""

    scale: Array
    damping: Array


@dataclass(frozen=True)
class Trace:
    """Simulated series, (K, J) each: rad, rad/s, rad/s^2, N m; `asked` is Eq. 1 without delays."""

    q: Array
    dq: Array
    ddq: Array
    asked: Array
    tau: Array


def arrivals(ticks: NDArray[np.int64], delay: NDArray[np.int64] | int, steps: int) -> NDArray[np.int64]:
    """Find the command in force at each tick.

    Args:
        ticks: Ticks at which commands are sent, (M,).
        delay: Delay of each command, ticks.
        steps: Number of ticks K.

    Returns:
        Index of the newest arrived command, (K,); the first one before any arrival.
    """
    newest = np.full(steps + 1, 0)
    when = np.minimum(ticks + delay, steps)
    np.maximum.at(newest, when, np.arange(len(ticks)))
    return np.maximum.accumulate(newest)[:steps]


def simulate(
    drive: Drive,
    body: Body,
    hooks: dict[str, list[list[Callable[[State, int, float], Step]]]],
    armature: Array,
    targets: Array,
    load: Array,
    dt: float,
    replay: Trace | None = None,
) -> Trace:
    """Simulate the joints.

    Args:
        drive: Gains and delays.
        body: Inertia and damping.
        hooks: Step makers of each joint, by stage: `error`, `speed`, `drive`, `joint`.
        armature: Added inertia, (J,), kg m^2.
        targets: Targets as they arrive, (K, J), rad.
        load: Joint torque of the ground, (K, J), N m.
        dt: Tick, s.
        replay: Motion to impose, instead of the motion that the torque causes.

    Returns:
        Series of all ticks.
    """
    joints = targets.shape[1]
    state = State(*([0.0] * joints for _ in range(6)))
    state.q[:] = targets[0].tolist() if replay is None else replay.q[0].tolist()
    made = {
        stage: [[make(state, j, dt) for make in row[j]] for j in range(joints)]
        for stage, row in hooks.items()
    }
    in_drive = [
        (j, *row)
        for j, row in enumerate(zip(made["error"], made["speed"], made["drive"], strict=True))
        if any(row)
    ]
    at_joint = [(j, row) for j, row in enumerate(made["joint"]) if row]
    heavy = [(j, inertia) for j, inertia in enumerate(armature.tolist()) if inertia]
    integrate = _integrator(body, armature, dt) if replay is None else _follower(replay)
    q, dq, kp, kd, lag = state.q, state.dq, drive.kp, drive.kd, drive.output_ticks
    everyone = range(joints)
    out: list[list[float]] = []
    kept = [array("d") for _ in range(5)]
    keep_q, keep_dq, keep_ddq, keep_asked, keep_tau = (row.extend for row in kept)
    for k, (target, push) in enumerate(zip(targets.tolist(), load.tolist(), strict=True)):
        state.target[:] = target
        sent = [kp * (target[j] - q[j]) - kd * dq[j] for j in everyone]
        state.asked[:] = sent
        for j, on_error, on_speed, on_drive in in_drive:
            error, speed = target[j] - q[j], dq[j]
            for step in on_error:
                error = step(k, error)
            for step in on_speed:
                speed = step(k, speed)
            torque = kp * error - kd * speed
            for step in on_drive:
                torque = step(k, torque)
            sent[j] = torque
        out.append(sent)
        tau = out[k - lag][:] if k > lag else out[0][:]
        for j, on_joint in at_joint:
            for step in on_joint:
                tau[j] = step(k, tau[j])
        keep_q(q)
        keep_dq(dq)
        keep_asked(state.asked)
        state.ddq[:] = integrate(state, tau, push)
        for j, inertia in heavy:
            tau[j] -= inertia * state.ddq[j]
        state.tau[:] = tau
        state.past_tau.append(tau)
        keep_ddq(state.ddq)
        keep_tau(tau)
    series = [np.frombuffer(row).reshape(targets.shape) for row in kept]
    return Trace(q=series[0], dq=series[1], ddq=series[2], asked=series[3], tau=series[4])


def _follower(replay: Trace) -> Callable[[State, Sequence[float], Sequence[float]], list[float]]:
    """Step function that imposes the motion of another run."""
    following = zip(replay.q[1:].tolist(), replay.dq[1:].tolist(), strict=True)
    accelerations = iter(replay.ddq.tolist())

    def follow(state: State, tau: Sequence[float], load: Sequence[float]) -> list[float]:
        state.q[:], state.dq[:] = next(following, (state.q, state.dq))
        return next(accelerations)

    return follow


def _integrator(
    body: Body, armature: Array, dt: float
) -> Callable[[State, Sequence[float], Sequence[float]], list[float]]:
    """Semi-implicit Euler for legs of hip, thigh and calf; thigh and calf are a double pendulum."""
    cos, sin = math.cos, math.sin
    scale, damping, extra = body.scale.tolist(), body.damping.tolist(), armature.tolist()

    def integrate(state: State, tau: Sequence[float], load: Sequence[float]) -> list[float]:
        q, dq = state.q, state.dq
        ddq = []
        for hip in range(0, len(q), 3):
            thigh, calf = hip + 1, hip + 2
            s = scale[hip]
            bend, tilt = q[calf], q[thigh] + q[calf]
            couple = COUPLING * cos(bend)
            m11 = s * (THIGH_INERTIA + 2 * couple) + ROTOR[1] + extra[thigh]
            m12 = s * (CALF_INERTIA + couple)
            m22 = s * CALF_INERTIA + ROTOR[2] + extra[calf]
            turn = s * COUPLING * sin(bend)
            swing = CALF_MOMENT * sin(tilt)
            f1 = tau[thigh] + load[thigh] - damping[thigh] * dq[thigh] - THIGH_MOMENT * sin(q[thigh]) - swing
            f1 += turn * dq[calf] * (2 * dq[thigh] + dq[calf])
            f2 = tau[calf] + load[calf] - damping[calf] * dq[calf] - swing - turn * dq[thigh] ** 2
            determinant = m11 * m22 - m12 * m12
            f0 = tau[hip] + load[hip] - damping[hip] * dq[hip] - 2.0 * sin(q[hip])
            ddq += (
                f0 / (s * HIP_INERTIA + ROTOR[0] + extra[hip]),
                (m22 * f1 - m12 * f2) / determinant,
                (m11 * f2 - m12 * f1) / determinant,
            )
        for j, a in enumerate(ddq):
            dq[j] += a * dt
            q[j] += dq[j] * dt
        return ddq

    return integrate
