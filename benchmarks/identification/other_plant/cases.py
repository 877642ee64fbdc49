"""Cases of the second generator: a log, perhaps a second one of the same robot, and the truth.

`make_case(kind, index, seed)` is reproducible. The truth has the form of the first generator's, so
that `benchmarks.identification.verdicts` scores both.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.identification.hidden.cases import Case
from benchmarks.identification.other_plant.machine import TICK_S, Machine, Run, run

Array = NDArray[np.float64]

SECONDS = 6.0
RATES_HZ = (50, 100, 200, 250, 500, 1000)
"""Rates of the states; commands come at one that is not higher."""
JOINTS = (2, 3, 4, 6, 8, 12)
STAMPS = ("exact", "jitter", "bursts")
EFFECT_TO_NOISE = (0.5, 6.0)
"""Range of the torque variance of an effect that no PD law explains, over that of the noise."""

GROUP_OF = {
    "none": "none",
    **dict.fromkeys(
        (
            *("coulomb_friction", "viscous_friction", "quadratic_drag", "torque_offset"),
            *("parallel_spring", "cogging", "torque_saturation", "first_order_lag", "armature"),
            *("neighbour_drag", "two_logs"),
        ),
        "alone",
    ),
    "pair": "together",
    "triple": "together",
    "cubic_spring": "outside",
    "torque_wave": "outside",
}


@dataclass
class Part:
    """One effect of a machine: how the truth names it, and its parameters there."""

    name: str
    joints: list[int]
    params: dict[str, float]
    accepted: list[str]
    signals: dict[str, list[Any]]


def make_case(kind: str, index: int, seed: int) -> Case:
    """Make one log, or two of one robot, with the truth.

    Args:
        kind: Kind of log, a key of `GROUP_OF`.
        index: Number of the log.
        seed: Seed of the benchmark.

    Returns:
        The case.
    """
    rng = np.random.default_rng([zlib.crc32(kind.encode()), index, seed])
    names = [f"axis_{k}" for k in range(int(rng.choice(JOINTS)))]
    machine = _machine(rng, len(names))
    parts = _add_effects(kind, machine, names, rng)
    rate = int(rng.choice(RATES_HZ))
    command_rate = int(rng.choice([one for one in RATES_HZ if one <= rate]))
    logs, floors, variance = [], [], None
    for _ in range(2 if kind == "two_logs" else 1):
        sent, targets = _motion(rng, len(names), command_rate)
        made = run(machine, sent, targets, SECONDS)
        variance = _noise_variance(made, rng) if variance is None else variance
        log, floor = _log(machine, made, sent, targets, rate, variance, rng)
        logs.append(log | {"joint_names": np.array(names)})
        floors.append(floor)
    truth = {
        "kind": kind,
        "group": GROUP_OF[kind],
        "motion": str(logs[0].pop("stamps")),
        "joints": [f"{name}_joint" for name in names],
        "rate": rate,
        "floor": floors[-1],
        "noise_var": variance,
        "input_delay_ms": 1e3 * machine.input_s,
        "output_delay_ms": 1e3 * machine.output_ticks * TICK_S,
        "effects": [_truth_of(part, names) for part in parts],
    }
    for log in logs[1:]:
        log.pop("stamps")
    return Case(f"{kind}-{index:03d}", logs[0], truth, logs[1] if len(logs) > 1 else None)


def _machine(rng: Generator, joints: int) -> Machine:
    """A random machine without effects."""
    inertia = rng.uniform(0.02, 0.15, joints)
    stiffness = float(rng.uniform(15.0, 80.0))
    damping_ratio = float(rng.uniform(0.4, 0.9))
    kd = 2.0 * damping_ratio * float(np.sqrt(stiffness * inertia.mean()))
    return Machine(
        inertia=inertia,
        weight=rng.uniform(0.0, 2.0, joints),
        damping=rng.uniform(0.0, 0.1, joints),
        armature=np.zeros(joints),
        gains=(round(stiffness, 1), round(0.5 * kd, 2)),
        drive_ticks=int(rng.choice([1, 2, 5])),
        input_s=float(rng.uniform(0.001, 0.008)),
        output_ticks=int(rng.integers(0, 8)),
    )


def _motion(rng: Generator, joints: int, rate: int) -> tuple[Array, Array]:
    """Times and targets of commands: smooth passages between random points, with a tremor on top."""
    sent = np.arange(0.0, SECONDS, 1.0 / rate)
    targets = np.empty((len(sent), joints))
    for j in range(joints):
        knots = np.cumsum(rng.uniform(0.25, 0.8, 40))
        points = rng.uniform(-0.6, 0.6, 41)
        at = np.searchsorted(knots, sent)
        begin = np.concatenate([[0.0], knots])[at]
        share = np.clip((sent - begin) / (0.7 * (knots[at] - begin)), 0.0, 1.0)
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)  # minimum jerk
        targets[:, j] = points[at] + (points[at + 1] - points[at]) * smooth
        targets[:, j] += rng.uniform(0.02, 0.08) * np.sin(2.0 * np.pi * rng.uniform(1.0, 4.0) * sent)
    return sent, targets


def _add_effects(kind: str, machine: Machine, names: list[str], rng: Generator) -> list[Part]:
    """Add the effects of a kind to a machine."""
    if kind == "none":
        return []
    if kind in ("pair", "triple"):
        count = 2 if kind == "pair" else 3
        groups = [GROUPS[k] for k in rng.permutation(len(GROUPS))[:count]]
        chosen = [str(rng.choice(group)) for group in groups]
    else:
        chosen = ["armature" if kind == "two_logs" else kind]
    return [MAKERS[one](machine, names, rng) for one in chosen]


GROUPS = (
    ("coulomb_friction", "quadratic_drag"),
    ("torque_saturation", "first_order_lag", "armature"),
    ("torque_offset", "parallel_spring", "cogging"),
)
"""Effects that may come together, one of each group."""


def _some(rng: Generator, joints: int) -> list[int]:
    """All joints, or half of them."""
    if rng.random() < 0.5:
        return list(range(joints))
    return sorted(rng.choice(joints, max(joints // 2, 1), replace=False).tolist())


def _simple(name: str, values: dict[str, tuple[str, float, float]], *accepted: str) -> Callable[..., Part]:
    """Maker of an effect whose parameters are shared by its joints.

    `values` maps a parameter of the truth to the machine's parameter and the range of its value.
    """

    def make(machine: Machine, names: list[str], rng: Generator) -> Part:
        joints, params = _some(rng, len(names)), {}
        for given, (inner, low, high) in values.items():
            params[given] = float(rng.uniform(low, high))
            value = np.zeros(len(names))
            value[joints] = params[given]
            machine.effects[inner] = value
        return Part(name, joints, params, [name, *accepted], {})

    return make


def _coulomb(machine: Machine, names: list[str], rng: Generator) -> Part:
    """Friction that saturates linearly, in another form than the registry's."""
    values = {"c": ("friction", 0.2, 1.0), "width": ("friction_width", 0.02, 0.08)}
    part = _simple("coulomb_friction", values, "stribeck_friction")(machine, names, rng)
    machine.effects["friction_width"] = np.full(len(names), part.params.pop("width"))
    return part


def _armature(machine: Machine, names: list[str], rng: Generator) -> Part:
    joints, value = list(range(len(names))), float(rng.uniform(0.003, 0.02))
    machine.armature[:] = value
    return Part("armature", joints, {"J": value}, ["armature"], {})


def _cogging(machine: Machine, names: list[str], rng: Generator) -> Part:
    values = {"a": ("cog", 0.1, 0.5), "waves": ("cog_waves", 12.0, 40.0)}
    part = _simple("cogging", values)(machine, names, rng)
    part.params.pop("waves")
    return part


def _outside(name: str, inner: str, low: float, high: float) -> Callable[..., Part]:
    """Maker of an effect that the registry does not hold."""

    def make(machine: Machine, names: list[str], rng: Generator) -> Part:
        part = _simple(name, {"c": (inner, low, high)})(machine, names, rng)
        key = ["t"] if name == "torque_wave" else ["q"]
        part.signals = {"key": key, "all": [key]}
        return part

    return make


MAKERS: dict[str, Callable[..., Part]] = {
    "coulomb_friction": _coulomb,
    "viscous_friction": lambda machine, names, rng: _viscous(machine, names, rng),
    "quadratic_drag": _simple("quadratic_drag", {"c": ("quadratic", 0.02, 0.15)}),
    "torque_offset": _simple("torque_offset", {"c": ("offset", 0.2, 0.8)}),
    "parallel_spring": _simple("parallel_spring", {"k": ("spring", 1.0, 5.0)}),
    "cogging": _cogging,
    "torque_saturation": _simple("torque_saturation", {"limit": ("limit", 2.0, 5.0)}),
    "first_order_lag": _simple("first_order_lag", {"T": ("lag", 0.002, 0.008)}),
    "armature": _armature,
    "cubic_spring": _outside("cubic_spring", "cubic", 4.0, 12.0),
    "neighbour_drag": _simple("neighbour_drag", {"a": ("neighbour_drag", 0.1, 0.5)}, "cross_coupling"),
    "torque_wave": _outside("torque_wave", "wave", 0.1, 0.4),
}


def _viscous(machine: Machine, names: list[str], rng: Generator) -> Part:
    """Viscous friction of half of the joints; on all joints it is a deviation of kd."""
    joints = sorted(rng.choice(len(names), max(len(names) // 2, 1), replace=False).tolist())
    value = np.zeros(len(names))
    value[joints] = rng.uniform(0.1, 0.4)
    machine.effects["viscous"] = value
    return Part("viscous_friction", joints, {"b": float(value.max())}, ["viscous_friction"], {})


def _noise_variance(made: Run, rng: Generator) -> float:
    """Variance of the torque noise, in proportion to what the effects leave to a PD law."""
    extra, left = made.tau - made.law, []
    for j in range(extra.shape[1]):
        # What the gains of the law can absorb is projected out.
        basis = np.stack([made.law[:, j], made.dq[:, j]], axis=1)
        fitted = basis @ np.linalg.lstsq(basis, extra[:, j], rcond=None)[0]
        left.append(np.mean((extra[:, j] - fitted) ** 2))
    visible, least = float(np.mean(left)), float((0.01 * made.tau.std()) ** 2)
    return max(visible / rng.uniform(*EFFECT_TO_NOISE), least)


def _log(
    machine: Machine, made: Run, sent: Array, targets: Array, rate: int, variance: float, rng: Generator
) -> tuple[dict[str, Any], float]:
    """Arrays of a log, and the error (N^2 m^2) of the true model on it."""
    rows = np.arange(round(0.05 / TICK_S), len(made.q), round(1.0 / rate / TICK_S))
    true_t: Array = (rows * TICK_S).astype(np.float64)
    shape = len(rows), made.q.shape[1]
    style = str(rng.choice(STAMPS, p=(0.6, 0.3, 0.1)))
    t = _stamps(true_t, style, rate, rng)
    clock = float(rng.uniform(-0.002, 0.002))  # of this recording
    q_noise, dq_noise = rng.uniform(2e-5, 2e-4), rng.uniform(2e-3, 2e-2)
    kp, kd = machine.gains
    log = {
        "t": t,
        "q": made.q[rows] + q_noise * rng.standard_normal(shape),
        "dq": made.dq[rows] + dq_noise * rng.standard_normal(shape),
        "tau": made.tau[rows] + np.sqrt(variance) * rng.standard_normal(shape),
        "t_cmd": sent + clock if machine.input_s + clock > 0.0 else sent,
        "q_des_cmd": targets,
        "kp": np.array(kp),
        "kd": np.array(kd),
        "stamps": style,
    }
    # A wrong stamp reads the command of another time: kp^2 times the mean square of that change. An
    # identification that restores the stamps can be below this floor.
    newest = (np.searchsorted(sent, at - machine.input_s, side="right") - 1 for at in (true_t, t))
    a, b = (targets[np.maximum(one, 0)] for one in newest)
    moved = float(np.mean((kp * (a - b)) ** 2))
    return log, variance + (kp * q_noise) ** 2 + (kd * dq_noise) ** 2 + moved


def _stamps(true_t: Array, style: str, rate: int, rng: Generator) -> Array:
    """Stamps of the rows: when they were measured, received, or read in bursts.

    The microsecond a row that keeps jittering stamps ascending makes their clock drift, by 0.1 % at
    1 kHz.
    """
    period = 1.0 / rate
    if style == "jitter":
        late = np.abs(rng.normal(0.0, 0.15 * period, len(true_t)))
        return np.maximum.accumulate(true_t + late) + 1e-6 * np.arange(len(true_t))
    if style == "bursts":
        # A buffer is read every few rows: its rows follow each other at once.
        size = int(rng.integers(2, 4))
        group = np.arange(len(true_t)) // size
        last = np.minimum((group + 1) * size - 1, len(true_t) - 1)
        within = np.arange(len(true_t)) - group * size
        return true_t[last] + 0.02 * period * within
    return true_t


def _truth_of(part: Part, names: list[str]) -> dict[str, Any]:
    """Ground truth of one effect, as the verdicts read it."""
    return {
        "name": part.name,
        "accepted": part.accepted,
        "joints": [f"{names[j]}_joint" for j in part.joints],
        "params": part.params,
        "signals": part.signals,
    }
