"""Effects outside the registry. A report cannot name them; it has to name the signals involved.

`key` lists the names of the essential signal, any one of which counts; `all` lists the names of
each signal that takes part.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.identification.hidden.effect import Draw, Effect, smooth
from benchmarks.identification.hidden.plant import State, Step

PAST = ["tau@history", "q_des@history", "q@history", "dq@history", "ddq@history"]
SPEED = ["dq", "dq@history"]


def _others(draw: Draw, *signals: str) -> list[str]:
    """The names of these signals of the neighbours of the affected joints."""
    return [f"{draw.names[draw.neighbour(j)]}/{signal}" for j in draw.joints for signal in signals]


def structural_resonance(draw: Draw) -> Effect:
    """The link rings after each change of torque."""
    omega, damping = 2 * math.pi * draw.uniform(12, 45), draw.uniform(0.03, 0.12)
    share = draw.strength * draw.uniform(0.1, 0.3)

    def make(state: State, j: int, dt: float) -> Step:
        ring = [0.0, 0.0]

        def step(k: int, u: float) -> float:
            if k == 0:
                ring[0] = u
            ring[1] += dt * (omega**2 * (u - ring[0]) - 2 * damping * omega * ring[1])
            ring[0] += dt * ring[1]
            return u + share * (ring[0] - u)

        return step

    params = {"frequency": omega / 2 / math.pi, "damping": damping, "share": share}
    return Effect(
        "structural_resonance", draw.joints, params, {"joint": make}, signals={"key": PAST, "all": [PAST]}
    )


def rubbing_cable(draw: Draw) -> Effect:
    """Friction in a part of the range."""
    c, sign = draw.strength * draw.uniform(0.8, 1.6), smooth(draw.smooth_sign_width())
    share = draw.uniform(0.3, 0.6)

    def make(state: State, j: int, dt: float) -> Step:
        q, dq = state.q, state.dq
        low, high = np.quantile(draw.nominal.q[:, j], [0.02, 0.98])
        edge, soft = float(high - share * (high - low)), 0.05 * float(high - low)
        return lambda k, u: u - c * sign(dq[j]) * 0.5 * (1 + math.tanh((q[j] - edge) / soft))

    return Effect(
        "rubbing_cable", draw.joints, {"c": c}, {"joint": make}, signals={"key": ["q"], "all": [["q"], SPEED]}
    )


def soft_stop(draw: Draw) -> Effect:
    """A rubber stop that is pressed at one end of the range."""
    stiffness, share, end = draw.strength * draw.uniform(4.0, 12.0), draw.uniform(0.3, 0.6), draw.sign()

    def make(state: State, j: int, dt: float) -> Step:
        q = state.q
        low, high = np.quantile(draw.nominal.q[:, j], [0.02, 0.98])
        edge = float(high - share * (high - low)) if end > 0 else float(low + share * (high - low))
        return lambda k, u: u - end * stiffness * max(end * (q[j] - edge), 0.0)

    params = {"stiffness": stiffness}
    return Effect("soft_stop", draw.joints, params, {"joint": make}, signals={"key": ["q"], "all": [["q"]]})


def neighbour_ripple(draw: Draw) -> Effect:
    """A torque ripple tied to the angle of another joint."""
    height, phase = draw.strength * draw.uniform(0.3, 0.7), draw.uniform(-math.pi, math.pi)
    periods = draw.uniform(1.5, 4.0)

    def make(state: State, j: int, dt: float) -> Step:
        q, other = state.q, draw.neighbour(j)
        low, high = np.quantile(draw.nominal.q[:, other], [0.02, 0.98])
        number = 2 * math.pi * periods / max(float(high - low), 0.05)
        return lambda k, u: u + height * math.sin(number * q[other] + phase)

    key = _others(draw, "q")
    return Effect(
        "neighbour_ripple", draw.joints, {"c": height}, {"joint": make}, signals={"key": key, "all": [key]}
    )


def hardening_stiffness(draw: Draw) -> Effect:
    """The proportional gain grows with the square of the error."""
    typical = draw.torque(0.9) / draw.kp
    cubic = draw.strength * draw.uniform(0.1, 0.25) / typical**2

    def make(state: State, j: int, dt: float) -> Step:
        return lambda k, error: error * (1 + min(cubic * error**2, 1.5))

    key = ["q_des", "q", "tau", "q_des@history", "tau@history"]
    return Effect(
        "hardening_stiffness", draw.joints, {"c": cubic}, {"error": make}, signals={"key": key, "all": [key]}
    )


def mains_hum(draw: Draw) -> Effect:
    """50 or 60 Hz on the torque measurement, or their double."""
    height, omega = (
        draw.strength * draw.uniform(0.2, 0.5),
        2 * math.pi * float(draw.rng.choice([50, 60, 100])),
    )
    phase = draw.uniform(0, 6.28)

    def make(state: State, j: int, dt: float) -> Step:
        return lambda k, u: u + height * math.sin(omega * k * dt + phase)

    params = {"amplitude": height, "frequency": omega / 2 / math.pi}
    return Effect("mains_hum", draw.joints, params, {"joint": make}, signals={"key": ["t"], "all": [["t"]]})


def neighbour_load_friction(draw: Draw) -> Effect:
    """Friction that grows with the load of another joint."""
    mu, sign = draw.strength * draw.uniform(0.1, 0.3), smooth(draw.smooth_sign_width())

    def make(state: State, j: int, dt: float) -> Step:
        dq, tau, other = state.dq, state.tau, draw.neighbour(j)
        return lambda k, u: u - mu * abs(tau[other]) * sign(dq[j])

    key = _others(draw, "tau")
    return Effect(
        "neighbour_load_friction",
        draw.joints,
        {"mu": mu},
        {"joint": make},
        signals={"key": key, "all": [key, SPEED]},
    )


def position_gain(draw: Draw) -> Effect:
    """A gain that goes up and down over the joint's range."""
    share, phase = min(draw.strength * draw.uniform(0.08, 0.2), 0.7), draw.uniform(0, 6.28)
    periods = draw.uniform(0.8, 2.0)

    def make(state: State, j: int, dt: float) -> Step:
        q = state.q
        low, high = np.quantile(draw.nominal.q[:, j], [0.02, 0.98])
        number = 2 * math.pi * periods / max(float(high - low), 0.05)
        return lambda k, u: u * (1 + share * math.sin(number * (q[j] - float(low)) + phase))

    load = ["tau", "q_des", "tau@history", "q_des@history"]
    return Effect(
        "position_gain",
        draw.joints,
        {"share": share},
        {"drive": make},
        signals={"key": ["q"], "all": [["q"], load]},
    )


def one_way_damping(draw: Draw) -> Effect:
    """Viscous friction in one direction of motion only."""
    b, way = draw.strength * draw.uniform(0.15, 0.4), draw.sign()

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - b * dq[j] if dq[j] * way > 0 else u

    return Effect(
        "one_way_damping", draw.joints, {"b": b}, {"joint": make}, signals={"key": ["dq"], "all": [["dq"]]}
    )


def speed_gain(draw: Draw) -> Effect:
    """A gain that falls with the joint's own speed, braking or driving alike."""
    fall = min(draw.strength * draw.uniform(0.1, 0.25), 0.7) / max(draw.speed(0.9), 0.3)

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u * max(1 - fall * abs(dq[j]), 0.1)

    load = ["tau", "q_des", "tau@history", "q_des@history"]
    return Effect(
        "speed_gain",
        draw.joints,
        {"fall": fall},
        {"drive": make},
        signals={"key": ["dq"], "all": [["dq"], load]},
    )


def speed_band_drag(draw: Draw) -> Effect:
    """Drag around one speed, as of a rotor that shakes there."""
    c, centre = draw.strength * draw.uniform(0.5, 1.2), draw.speed(0.6)
    width = 0.25 * centre

    def make(state: State, j: int, dt: float) -> Step:
        dq = state.dq
        return lambda k, u: u - c * math.copysign(math.exp(-(((abs(dq[j]) - centre) / width) ** 2)), dq[j])

    return Effect(
        "speed_band_drag", draw.joints, {"c": c}, {"joint": make}, signals={"key": ["dq"], "all": [["dq"]]}
    )


def late_neighbour_torque(draw: Draw) -> Effect:
    """A share of another joint's torque, some hundredths of a second later."""
    share, late = draw.sign() * min(draw.strength * draw.uniform(0.05, 0.15), 0.5), draw.uniform(0.02, 0.05)

    def make(state: State, j: int, dt: float) -> Step:
        past, other, back = state.past_tau, draw.neighbour(j), round(late / dt)
        return lambda k, u: u + share * past[k - back][other] if k >= back else u

    key = _others(draw, *(name for name in PAST))
    return Effect(
        "late_neighbour_torque",
        draw.joints,
        {"c": share, "late": late},
        {"joint": make},
        signals={"key": key, "all": [key]},
    )


def loaded_ripple(draw: Draw) -> Effect:
    """A ripple over the joint's own angle that grows with its torque."""
    share, phase, periods = (
        min(draw.strength * draw.uniform(0.08, 0.2), 0.8),
        draw.uniform(0, 6.28),
        draw.uniform(3, 6),
    )

    def make(state: State, j: int, dt: float) -> Step:
        q = state.q
        low, high = np.quantile(draw.nominal.q[:, j], [0.02, 0.98])
        number = 2 * math.pi * periods / max(float(high - low), 0.05)
        return lambda k, u: u * (1 + share * math.sin(number * q[j] + phase))

    load = ["tau", "q_des", "tau@history", "q_des@history"]
    return Effect(
        "loaded_ripple",
        draw.joints,
        {"share": share},
        {"joint": make},
        signals={"key": ["q"], "all": [["q"], load]},
    )


def speed_product(draw: Draw) -> Effect:
    """Drag by the product of two joints' speeds."""
    c = draw.strength * draw.uniform(0.05, 0.15) * draw.sign()

    def make(state: State, j: int, dt: float) -> Step:
        dq, other = state.dq, draw.neighbour(j)
        return lambda k, u: u - c * dq[j] * dq[other]

    key = _others(draw, "dq")
    return Effect(
        "speed_product", draw.joints, {"c": c}, {"joint": make}, signals={"key": key, "all": [key, SPEED]}
    )


def slow_wander(draw: Draw) -> Effect:
    """An offset that comes and goes over seconds, tied to nothing but time."""
    height, omega = draw.strength * draw.uniform(0.2, 0.5), 2 * math.pi * draw.uniform(0.25, 0.7)
    phase = draw.uniform(0, 6.28)

    def make(state: State, j: int, dt: float) -> Step:
        return lambda k, u: u + height * math.sin(omega * k * dt + phase)

    return Effect(
        "slow_wander", draw.joints, {"c": height}, {"joint": make}, signals={"key": ["t"], "all": [["t"]]}
    )


def creeping_spring(draw: Draw) -> Effect:
    """A spring and a damper in series across the joint: stiff at first, then it gives way."""
    k_s, constant = draw.strength * draw.uniform(2.0, 5.0), draw.uniform(0.08, 0.3)

    def make(state: State, j: int, dt: float) -> Step:
        q, rest, keep = state.q, [state.q[j]], math.exp(-dt / constant)

        def step(k: int, u: float) -> float:
            rest[0] = q[j] + keep * (rest[0] - q[j])
            return u - k_s * (q[j] - rest[0])

        return step

    key = ["q@history", "dq@history", "ddq@history"]
    return Effect(
        "creeping_spring",
        draw.joints,
        {"k": k_s, "T": constant},
        {"joint": make},
        signals={"key": key, "all": [key]},
    )


OUTSIDE = {
    make.__name__: make
    for make in (
        structural_resonance,
        rubbing_cable,
        soft_stop,
        neighbour_ripple,
        hardening_stiffness,
        mains_hum,
        neighbour_load_friction,
        position_gain,
        one_way_damping,
        speed_gain,
        speed_band_drag,
        late_neighbour_torque,
        loaded_ripple,
        speed_product,
        slow_wander,
        creeping_spring,
    )
}
