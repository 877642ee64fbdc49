"""Effects of the registry, in the generator's own physics.

Each function draws one effect. Where its law is ambiguous (place, hard or soft), chance decides.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.identification.hidden.effect import Draw, Effect, smooth
from benchmarks.identification.hidden.plant import State, Step


def coulomb_friction(draw: Draw) -> Effect:
    """Friction of constant torque against the motion."""
    c, sign = draw.strength * draw.uniform(0.3, 0.8), smooth(draw.smooth_sign_width())

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - c * sign(dq[j])

    return Effect("coulomb_friction", draw.joints, {"c": c}, {draw.place(): make})


def viscous_friction(draw: Draw) -> Effect:
    """Friction proportional to the speed."""
    b = draw.strength * draw.uniform(0.1, 0.4)

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - b * dq[j]

    return Effect("viscous_friction", draw.joints, {"b": b}, {draw.place(): make})


def stribeck_friction(draw: Draw) -> Effect:
    """Friction that decreases from standstill with the speed."""
    c = draw.strength * draw.uniform(0.2, 0.5)
    c_s, v_s = c * draw.uniform(2.0, 3.5), draw.speed(0.5) * draw.uniform(0.25, 0.6)
    sign, exp = smooth(draw.smooth_sign_width()), math.exp

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - (c + (c_s - c) * exp(-((dq[j] / v_s) ** 2))) * sign(dq[j])

    return Effect("stribeck_friction", draw.joints, {"c": c, "c_s": c_s, "v_s": v_s}, {draw.place(): make})


def quadratic_drag(draw: Draw) -> Effect:
    """Drag proportional to the square of the speed."""
    c = draw.strength * draw.uniform(0.03, 0.1)

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - c * dq[j] * abs(dq[j])

    return Effect("quadratic_drag", draw.joints, {"c": c}, {draw.place(): make})


def load_dependent_friction(draw: Draw) -> Effect:
    """Friction proportional to the torque."""
    mu, sign = min(draw.strength * draw.uniform(0.05, 0.15), 0.5), smooth(draw.smooth_sign_width())

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - mu * abs(u) * sign(dq[j])

    return Effect("load_dependent_friction", draw.joints, {"mu": mu}, {draw.place(): make})


def torque_saturation(draw: Draw) -> Effect:
    """Limit of the torque."""
    bound = draw.torque(1 - min(0.04 * draw.strength, 0.3))

    def make(state: State, j: int, dt: float) -> Step:
        return lambda k, u: min(max(u, -bound), bound)

    return Effect("torque_saturation", draw.joints, {"limit": bound}, {"drive": make})


def torque_speed_limit(draw: Draw) -> Effect:
    """Limit of driving torque, linear from stall torque to no-load speed."""
    stall = draw.torque(1.0) * draw.uniform(1.0, 1.3)
    power = draw.nominal.tau[:, list(draw.joints)] * np.sign(draw.nominal.dq[:, list(draw.joints)])
    speed = np.abs(draw.nominal.dq[:, list(draw.joints)])
    driving = (power > 0.2 * stall) & (speed > 0.2)
    crossing = speed[driving] / (1 - np.minimum(power[driving] / stall, 0.99))
    no_load = (
        float(np.quantile(crossing, 1 - min(0.08 * draw.strength, 0.5)))
        if driving.any()
        else draw.speed(0.95)
    )

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq

        def step(k: int, u: float) -> float:
            forward = stall * min(max(1 - dq[j] / no_load, 0.0), 1.0)
            backward = -stall * min(max(1 + dq[j] / no_load, 0.0), 1.0)
            return min(max(u, backward), forward)

        return step

    return Effect(
        "torque_speed_limit", draw.joints, {"stall_torque": stall, "no_load_speed": no_load}, {"drive": make}
    )


def slew_limit(draw: Draw) -> Effect:
    """Limit of the rate of the torque."""
    change = np.abs(np.diff(draw.nominal.asked[:, list(draw.joints)], axis=0)) / draw.dt
    rate = float(np.quantile(change, 1 - min(0.06 * draw.strength, 0.4)))

    def make(state: State, j: int, dt: float) -> Step:
        held = [state.q[j] * 0.0]

        def step(k: int, u: float) -> float:
            held[0] = u if k == 0 else min(max(u, held[0] - rate * dt), held[0] + rate * dt)
            return held[0]

        return step

    return Effect("slew_limit", draw.joints, {"rate": rate}, {"drive": make})


def first_order_lag(draw: Draw) -> Effect:
    """First-order lag of the torque."""
    constant = min(draw.strength * draw.uniform(0.002, 0.006), 0.015)

    def make(state: State, j: int, dt: float) -> Step:
        keep, held = math.exp(-dt / constant), [0.0]

        def step(k: int, u: float) -> float:
            held[0] = u if k == 0 else u + keep * (held[0] - u)
            return held[0]

        return step

    return Effect("first_order_lag", draw.joints, {"T": constant}, {"drive": make})


def velocity_filter(draw: Draw) -> Effect:
    """Damping of a low-passed or of a delayed speed."""
    constant = min(draw.strength * draw.uniform(0.004, 0.01), 0.03)
    delayed = bool(draw.rng.random() < 0.4)

    def make_filter(state: State, j: int, dt: float) -> Step:
        keep, held = math.exp(-dt / constant), [0.0]

        def step(k: int, speed: float) -> float:
            held[0] = speed + keep * (held[0] - speed)
            return held[0]

        return step

    def make_delay(state: State, j: int, dt: float) -> Step:
        past: list[float] = []
        back = max(round(constant / dt), 1)

        def step(k: int, speed: float) -> float:
            past.append(speed)
            return past[max(k - back, 0)]

        return step

    params = {"delay" if delayed else "T": constant}
    also = ("timestamp_skew",) if delayed else ()
    return Effect(
        "velocity_filter", draw.joints, params, {"speed": make_delay if delayed else make_filter}, also=also
    )


def armature(draw: Draw) -> Effect:
    """Added rotor inertia."""
    inertia = min(draw.strength * draw.uniform(0.004, 0.015), 0.06)
    return Effect("armature", draw.joints, {"J": inertia}, armature=inertia)


def torque_offset(draw: Draw) -> Effect:
    """Constant torque."""
    offset = draw.strength * draw.uniform(0.15, 0.5) * draw.sign()

    def make(state: State, j: int, dt: float) -> Step:
        return lambda k, u: u + offset

    return Effect("torque_offset", draw.joints, {"offset": offset}, {"joint": make}, also=("encoder_bias",))


def parallel_spring(draw: Draw) -> Effect:
    """Spring parallel to the joint."""
    k_s = draw.strength * draw.uniform(1.0, 4.0)
    rest = float(np.mean(draw.nominal.q[:, draw.joints[0]])) + draw.uniform(-0.3, 0.3)

    def make(state: State, j: int, dt: float) -> Step:
        q = state.q
        return lambda k, u: u - k_s * (q[j] - rest)

    return Effect("parallel_spring", draw.joints, {"k": k_s, "q0": rest}, {draw.place(): make})


def cogging(draw: Draw) -> Effect:
    """Sine over the angle, with 1.5 to 5 periods over the travel."""
    height = draw.strength * draw.uniform(0.2, 0.6)
    number = float(min(max(round(2 * math.pi * draw.uniform(1.5, 5.0) / max(draw.travel(), 0.05)), 4), 120))
    phase = draw.uniform(-math.pi, math.pi)

    def make(state: State, j: int, dt: float) -> Step:
        q = state.q
        return lambda k, u: u + height * math.sin(number * q[j] + phase)

    params = {"amplitude": height, "n": number, "phi": phase}
    return Effect("cogging", draw.joints, params, {draw.place(): make})


def deadband(draw: Draw) -> Effect:
    """No torque for small position errors; above the band all of it (hard) or the excess (soft)."""
    width = draw.strength * draw.torque(0.5) / draw.kp * draw.uniform(0.2, 0.6)
    hard = bool(draw.rng.random() < 0.5)

    def make(state: State, j: int, dt: float) -> Step:
        def step(k: int, error: float) -> float:
            if abs(error) <= width:
                return 0.0
            return error if hard else error - math.copysign(width, error)

        return step

    return Effect("deadband", draw.joints, {"width": width}, {"error": make})


def backlash(draw: Draw) -> Effect:
    """The drive's angle follows the joint's with a play of `width` to each side."""
    width = draw.strength * draw.uniform(0.006, 0.02)

    def make(state: State, j: int, dt: float) -> Step:
        q, held = state.q, [state.q[j]]

        def step(k: int, error: float) -> float:
            held[0] = min(max(held[0], q[j] - width), q[j] + width)
            return error + q[j] - held[0]

        return step

    return Effect("backlash", draw.joints, {"width": width}, {"error": make}, also=("hysteresis",))


def hysteresis(draw: Draw) -> Effect:
    """Bouc-Wen hysteresis with exponent 1: a spring that yields over `reach` at the torque `c`."""
    c = draw.strength * draw.uniform(0.3, 0.8)
    reach, shape = draw.travel() * draw.uniform(0.1, 0.3), draw.uniform(0.5, 0.9)

    def make(state: State, j: int, dt: float) -> Step:
        dq, z = state.dq, [0.0]

        def step(k: int, u: float) -> float:
            v = dq[j]
            z[0] += dt / reach * (v - shape * abs(v) * z[0] - (1 - shape) * v * abs(z[0]))
            return u - c * z[0]

        return step

    return Effect("hysteresis", draw.joints, {"c": c, "reach": reach}, {draw.place(): make})


def gain_asymmetry(draw: Draw) -> Effect:
    """Torque gain that differs between directions; half of the drives have the nominal gain in one."""
    share = min(draw.strength * draw.uniform(0.04, 0.12), 0.4) * draw.sign()
    mean = 1.0 / (1.0 - abs(share)) if draw.uniform(0.0, 1.0) < 0.5 else 1.0

    def make(state: State, j: int, dt: float) -> Step:
        return lambda k, u: mean * (u * (1 + share) if u > 0 else u * (1 - share))

    return Effect("gain_asymmetry", draw.joints, {"asymmetry": share}, {"drive": make})


def thermal_drift(draw: Draw) -> Effect:
    """Gain that decreases while the motor warms up; half of the logs contain the temperature."""
    loss = min(draw.strength * draw.uniform(0.08, 0.25), 0.6)
    settling = draw.uniform(0.5, 2.0) * draw.duration

    def warmth(time: np.ndarray) -> np.ndarray:
        return (1 - np.exp(-time / settling)) / (1 - math.exp(-draw.duration / settling))

    def make(state: State, j: int, dt: float) -> Step:
        scale = loss / (1 - math.exp(-draw.duration / settling))
        return lambda k, u: u * (1 - scale * (1 - math.exp(-k * dt / settling)))

    rise = draw.uniform(8, 25)
    logged = bool(draw.rng.random() < 0.5)
    return Effect(
        "thermal_drift",
        draw.joints,
        {"loss_over_log": loss, **({"rise": rise} if logged else {})},
        {"drive": make},
        temperature=(lambda time: 32.0 + rise * warmth(time)) if logged else None,
    )


def supply_sag(draw: Draw) -> Effect:
    """Gain that decreases with the supply voltage under load; half of the logs contain the voltage."""
    power = np.maximum(draw.nominal.tau * draw.nominal.dq, 0).sum(axis=1)
    drop = min(draw.strength * draw.uniform(0.1, 0.25), 0.6) / max(float(np.quantile(power, 0.95)), 1.0)
    settling, supply = draw.uniform(0.005, 0.02), draw.uniform(24, 52)
    logged: list[float] | None = [] if draw.rng.random() < 0.5 else None
    chief = draw.joints[0]
    level = [0.0]

    def make(state: State, j: int, dt: float) -> Step:
        level[0] = 0.0
        if logged is not None:
            logged.clear()

        def step(k: int, u: float) -> float:
            if j == chief:
                power = sum(max(t * v, 0.0) for t, v in zip(state.tau, state.dq, strict=True))
                level[0] += dt / settling * (power - level[0])
                if logged is not None:
                    logged.append(supply * max(1 - drop * level[0], 0.2))
            return u * max(1 - drop * level[0], 0.2)

        return step

    return Effect(
        "supply_sag", draw.joints, {"per_watt": drop, "supply": supply}, {"drive": make}, voltage=logged
    )


def cross_coupling(draw: Draw) -> Effect:
    """Torque proportional to another joint's angle, speed or torque."""
    source = str(draw.rng.choice(["q", "dq", "tau"]))
    share = draw.sign() * draw.strength * draw.uniform(0.6, 1.4) * {"q": 2.0, "dq": 0.15, "tau": 0.07}[source]

    def make(state: State, j: int, dt: float) -> Step:
        other, signal = draw.neighbour(j), getattr(state, source)
        centre = float(np.mean(draw.nominal.q[:, other])) if source == "q" else 0.0
        return lambda k, u: u + share * (signal[other] - centre)

    names = {draw.names[j]: f"{draw.names[draw.neighbour(j)]}/{source}" for j in draw.joints}
    return Effect(
        "cross_coupling", draw.joints, {"c": share}, {"joint": make}, signals={"key": [*names.values()]}
    )


def command_hold(draw: Draw) -> Effect:
    """Commands lost in short bursts, or late by some milliseconds; the log has the commands as sent."""
    share = min(draw.strength * draw.uniform(0.05, 0.2), 0.5)
    longest = int(draw.rng.integers(1, 5))
    late = float(draw.rng.choice([0.0, draw.uniform(0.006, 0.02)]))

    def lose(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Which commands get through (count,), and how late (s)."""
        hit = np.zeros(count, dtype=bool)
        for start in np.flatnonzero(rng.random(count) < share / ((1 + longest) / 2)):
            hit[start : start + int(rng.integers(1, longest + 1))] = True
        hit[0] = False
        if late:
            return np.ones(count, dtype=bool), np.where(hit, late, 0.0)
        return ~hit, np.zeros(count)

    return Effect("command_hold", draw.joints, {"share_of_commands": share}, lose=lose)


def timestamp_skew(draw: Draw) -> Effect:
    """Logged angle or speed of another instant; a positive shift is late."""
    channel = str(draw.rng.choice(["q", "dq"]))
    shift = draw.sign() * min(draw.strength * draw.uniform(0.001, 0.004), 0.012)
    also = ("velocity_filter",) if channel == "dq" and shift < 0 else ()
    return Effect("timestamp_skew", draw.joints, {"shift": shift}, skew=(channel, shift), also=also)


KNOWN = {
    make.__name__: make
    for make in (
        coulomb_friction,
        viscous_friction,
        stribeck_friction,
        quadratic_drag,
        load_dependent_friction,
        torque_saturation,
        torque_speed_limit,
        slew_limit,
        first_order_lag,
        velocity_filter,
        armature,
        torque_offset,
        parallel_spring,
        cogging,
        deadband,
        backlash,
        hysteresis,
        gain_asymmetry,
        thermal_drift,
        supply_sag,
        cross_coupling,
        command_hold,
        timestamp_skew,
    )
}
