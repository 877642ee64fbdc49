"""Cases of the blind test: a log for the identification, and its ground truth.

`make_case(kind, index, seed)` is reproducible. Robot, motion, gains, delays, noise, joints and
parameters are random. The effect's strength is scaled so that its error is 0.3 to about 5 times the
variance of the torque noise.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification.hidden import worth
from benchmarks.identification.hidden.effect import Draw, Effect
from benchmarks.identification.hidden.known import KNOWN
from benchmarks.identification.hidden.motion import LEGS, Motion, joint_names, make_motion
from benchmarks.identification.hidden.outside import OUTSIDE
from benchmarks.identification.hidden.plant import Body, Drive, Trace, arrivals, simulate

Array = NDArray[np.float64]

COARSE = 0.001  # s, for looking how large an effect is; a case itself is made with 0.25 ms
LEAST, MOST = 0.3, 6.0  # times the noise
FASTEST = 25.0  # rad/s, beyond what such a robot survives
GAINS = ((20.0, 0.5), (30.0, 0.5), (30.0, 0.8), (40.0, 1.0), (60.0, 1.5), (60.0, 2.0))
SHARED = ("supply_sag", "command_hold")  # what no joint has for itself

# What may come together, one of each group: effects of one group hide each other.
GROUPS = (
    ("coulomb_friction", "stribeck_friction", "load_dependent_friction", "quadratic_drag", "hysteresis"),
    ("first_order_lag", "torque_saturation", "deadband", "armature", "slew_limit", "backlash"),
    ("torque_offset", "cogging", "parallel_spring", "cross_coupling"),
    ("thermal_drift", "gain_asymmetry", "supply_sag"),
)

CLOSE = (
    ("parallel_spring", "cogging"),
    ("torque_offset", "cogging"),
    ("coulomb_friction", "quadratic_drag"),
    ("load_dependent_friction", "quadratic_drag"),
    ("coulomb_friction", "load_dependent_friction"),
    ("first_order_lag", "armature"),
    ("first_order_lag", "torque_saturation"),
    ("deadband", "torque_saturation"),
    ("gain_asymmetry", "thermal_drift"),
    ("hysteresis", "quadratic_drag"),
)
"""Pairs of similar effects that are nevertheless distinguishable."""

GROUP_OF = {
    "table_4": "table 4",
    "none": "none",
    **dict.fromkeys(KNOWN, "alone"),
    "pair": "together",
    "close_pair": "together",
    "triple": "together",
    **dict.fromkeys(OUTSIDE, "outside"),
}


@dataclass(frozen=True)
class Case:
    """One case of the blind test.

    Attributes:
        name: Name of the case.
        log: Arrays of the log to fit, by the names of the log format.
        truth: Ground truth, JSON data.
        holdout: Arrays of a held-out log, or None.
    """

    name: str
    log: dict[str, Any]
    truth: dict[str, Any]
    holdout: dict[str, Any] | None = None

    def save(self, folder: Path) -> list[Path]:
        """Write the logs as NPZ files, and the ground truth next to them.

        Args:
            folder: Folder; created if it does not exist.

        Returns:
            Paths of the logs, that of the held-out log last.
        """
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.truth.json").write_text(json.dumps(self.truth, indent=1))
        paths = []
        for suffix, log in (("", self.log), ("-holdout", self.holdout)):
            if log is not None:
                paths.append(folder / f"{self.name}{suffix}.npz")
                np.savez_compressed(paths[-1], **log)
        return paths


@dataclass(frozen=True)
class Setting:
    """Random choices of a case except for its effects; delays in ms, SI units otherwise."""

    names: list[str]
    motion: str
    duration: float
    dt: float
    rate: int
    kp: float
    kd: float
    delta_kp: float
    delta_kd: float
    input_ms: float
    output_ms: float
    noise_var: float
    ratio: float
    joints: list[tuple[int, ...]]
    names_of_effects: tuple[str, ...]
    seed: tuple[int, ...]
    turn: int
    extra: dict[str, Any] = field(default_factory=dict)

    def rng(self, *purpose: int) -> np.random.Generator:
        """Return a random generator for one purpose, independent of the others."""
        return np.random.default_rng([*self.seed, *purpose])

    def stride(self, dt: float) -> int:
        """Return the number of plant ticks (of `dt` s) between two rows of the log."""
        return round(1 / (self.rate * dt))

    def drive(self, dt: float) -> Drive:
        """Return the drives with delays in ticks of `dt` s."""
        return Drive(
            self.kp + self.delta_kp,
            self.kd + self.delta_kd,
            round(self.input_ms / 1000 / dt),
            round(self.output_ms / 1000 / dt),
        )


@dataclass(frozen=True)
class Run:
    """One simulation of a setting with its effects.

    Attributes:
        motion: Commands and loads.
        held: Targets as sent, at each tick, (K, J), rad.
        trace: Simulated series.
        hit: Fraction of ticks at which another command acted than without effects.
        voltage: Supply voltage, (K,), V; empty where it is not measured.
        dt: Tick, s.
    """

    motion: Motion
    held: Array
    trace: Trace
    hit: float
    voltage: Array
    dt: float


def make_case(kind: str, index: int, seed: int = 0) -> Case:
    """Generate a case.

    Args:
        kind: Kind of case, a key of `GROUP_OF`.
        index: Number of the case; even ones lift feet, odd ones use mixed motions.
        seed: Seed of the benchmark.

    Returns:
        The case.

    Raises:
        ValueError: If the kind is unknown.
        RuntimeError: If no draw has an effect of the intended size.
    """
    if kind not in GROUP_OF:
        raise ValueError(f"kind: found {kind!r}, expected one of {', '.join(GROUP_OF)}")
    for attempt in range(12):
        try:
            case = _attempt(kind, index, (seed, zlib.crc32(kind.encode()), index, attempt))
        except OverflowError:  # legs that an effect has made unstable
            continue
        if case is not None:
            return case
    raise RuntimeError(f"{kind} {index}: no draw in twelve is worth {LEAST} to {MOST} times the noise")


def _setting(kind: str, index: int, seed: tuple[int, ...]) -> Setting:
    """Draw everything but the effects."""
    rng = np.random.default_rng(seed)
    paper = kind == "table_4"
    legs = LEGS if paper or index % 10 in (6, 9) else (str(rng.choice(LEGS)),)
    names = joint_names(legs)
    kp, kd = (30.0, 0.5) if paper else GAINS[rng.integers(len(GAINS))]
    dt = 0.00025
    effects = _effects_of(kind, rng)
    return Setting(
        names=names,
        motion="eq9" if paper else ("lifting", "mixed")[index % 2],
        duration=5.0 if len(names) > 3 else float(rng.uniform(5.0, 8.0)),
        dt=dt,
        rate=1000 if paper else int(rng.choice([500, 1000], p=[0.3, 0.7])),
        kp=kp,
        kd=kd,
        delta_kp=-0.706 if paper else float(kp * rng.uniform(-0.05, 0.02)),
        delta_kd=-0.021 if paper else float(kd * rng.uniform(-0.15, 0.05)),
        input_ms=7.0 if paper else float(rng.integers(0, round(0.018 / dt)) * dt * 1000),
        output_ms=1.0 if paper else float(rng.integers(0, round(0.005 / dt)) * dt * 1000),
        noise_var=0.066 if paper else float(np.exp(rng.uniform(np.log(0.03), np.log(0.2)))),
        ratio=float(np.exp(rng.uniform(np.log(0.4), np.log(4.0)))),
        joints=[_scope(name, len(names), rng) for name in effects],
        names_of_effects=effects,
        seed=seed,
        turn=int(rng.integers(1, 3)),
        extra={
            "jitter": bool(rng.random() < 0.3),
            "drops": bool(rng.random() < 0.2),
            "gains": int(rng.integers(3)),
        },
    )


def _effects_of(kind: str, rng: np.random.Generator) -> tuple[str, ...]:
    """Names of the effects of a kind."""
    if kind == "close_pair":
        return CLOSE[rng.integers(len(CLOSE))]
    if kind in ("pair", "triple"):
        groups = rng.permutation(len(GROUPS))[: 2 if kind == "pair" else 3]
        return tuple(str(rng.choice(GROUPS[group])) for group in sorted(groups))
    return (kind,) if kind in KNOWN or kind in OUTSIDE else ()


def _scope(name: str, joints: int, rng: np.random.Generator) -> tuple[int, ...]:
    """Joints of an effect: all, one or two kinds, or some; viscous friction never on all."""
    everywhere = tuple(range(joints))
    draw = rng.random()
    if name in SHARED or (draw < 0.4 and name != "viscous_friction"):
        return everywhere
    if draw < 0.8 or joints == 3:
        kinds = rng.permutation(3)[: int(rng.integers(1, 3))]
        return tuple(j for j in everywhere if j % 3 in kinds)
    return tuple(sorted(int(j) for j in rng.choice(joints, size=int(rng.integers(2, 6)), replace=False)))


def _make_effects(setting: Setting, strengths: list[float], nominal: Trace) -> list[Effect]:
    """Draw the effects' parameters for given strengths."""
    made = []
    for place, (name, joints) in enumerate(zip(setting.names_of_effects, setting.joints, strict=True)):
        draw = Draw(
            rng=setting.rng(2, place),
            strength=strengths[place],
            joints=joints,
            names=setting.names,
            nominal=nominal,
            dt=COARSE,
            duration=setting.duration,
            kp=setting.kp,
            kd=setting.kd,
            turn=setting.turn,
        )
        made.append({**KNOWN, **OUTSIDE}[name](draw))
    return made


def _run(setting: Setting, effects: list[Effect], dt: float, motion: str, replay: Trace | None = None) -> Run:
    """Simulate a setting with its effects."""
    rng = setting.rng(1)
    legs = tuple(name.split("_")[0] for name in setting.names[::3])
    plan = make_motion(rng, motion, legs, dt, setting.duration, setting.kp)
    drive, joints, steps = setting.drive(dt), len(setting.names), len(plan.load)
    body = Body(
        scale=np.repeat(rng.uniform(0.8, 1.25, size=len(legs)), 3),
        damping=rng.uniform(0.1, 0.35, size=joints) + 0.02 * drive.kd,
    )
    armature = np.zeros(joints)
    for effect in effects:
        armature[list(effect.joints)] += effect.armature
    usual = arrivals(plan.ticks, drive.input_ticks, steps)
    really = _arrivals(setting, effects, plan, drive, dt)
    targets = plan.targets[really]
    trace = simulate(drive, body, _hooks(effects, joints), armature, targets, plan.load, dt, replay)
    held = plan.targets[arrivals(plan.ticks, 0, steps)]
    voltage = np.array([volt for effect in effects for volt in effect.voltage or ()])
    return Run(plan, held, trace, float(np.mean(usual != really)), voltage, dt)


def _arrivals(
    setting: Setting, effects: list[Effect], plan: Motion, drive: Drive, dt: float
) -> NDArray[np.int64]:
    """Command in force at each tick, after losses and late arrivals."""
    through, late = np.ones(len(plan.ticks), dtype=bool), np.zeros(len(plan.ticks))
    for effect in effects:
        if effect.lose is not None:
            through, late = effect.lose(setting.rng(3), len(plan.ticks))
    kept = np.flatnonzero(through)
    delay = drive.input_ticks + np.round(late[kept] / dt).astype(int)
    return kept[arrivals(plan.ticks[kept], delay, len(plan.load))]


def _hooks(effects: list[Effect], joints: int) -> dict[str, list[list[Any]]]:
    """Step makers of each stage and joint."""
    stages: dict[str, list[list[Any]]] = {
        stage: [[] for _ in range(joints)] for stage in ("error", "speed", "drive", "joint")
    }
    for effect in effects:
        for stage, make in effect.hooks.items():
            for joint in effect.joints:
                stages[stage][joint].append(make)
    return stages


@dataclass(frozen=True)
class Worth:
    """Size of the effects: mean squared errors without noise, N^2 m^2.

    Attributes:
        left: Error of the paper's model.
        each: Part of that error due to each effect.
        base: Regressors of the paper's model, (N J, 2).
        scene: Series of the regressions.
    """

    left: float
    each: list[float]
    base: Array
    scene: worth.Scene


def _worth(setting: Setting, run: Run, effects: list[Effect]) -> Worth:
    """Measure the size of each effect in a run."""
    drive = setting.drive(run.dt)
    scene = worth.Scene.of(run.held, _as_logged(run, effects), run.dt, setting.stride(run.dt))
    left, input_ticks, output_ticks = worth.best_model(scene, drive.input_ticks, drive.output_ticks)
    base = scene.pd_columns(input_ticks, output_ticks)
    if len(effects) < 2:
        outside = effects and effects[0].name in OUTSIDE
        each = [worth.beyond(scene, base, worth.rivals(scene, effects[0].joints, base)) if outside else left]
        return Worth(left, each, base, scene)
    without = [_run_without(setting, run, effects, i) for i in range(len(effects))]
    differences = [(run.trace.tau - trace.tau)[scene.rows].ravel() for trace in without]
    each = [
        worth.marginal(d, base, differences[:i] + differences[i + 1 :]) for i, d in enumerate(differences)
    ]
    return Worth(left, each, base, scene)


def _run_without(setting: Setting, run: Run, effects: list[Effect], absent: int) -> Trace:
    """Torque without one of the effects, on the same motion."""
    present = [effect for i, effect in enumerate(effects) if i != absent]
    return _run(setting, present, run.dt, setting.motion, replay=run.trace).trace


def _as_logged(run: Run, effects: list[Effect]) -> Trace:
    """Series as stamped in the log; a skewed channel is shifted in time."""
    series = {name: getattr(run.trace, name) for name in ("q", "dq", "ddq", "asked", "tau")}
    for effect in effects:
        if effect.skew is not None:
            channel, shift = effect.skew
            steps = len(run.held)
            at = np.clip(np.arange(steps) - round(shift / run.dt), 0, steps - 1)
            moved = series[channel].copy()
            moved[:, list(effect.joints)] = series[channel][at][:, list(effect.joints)]
            series[channel] = moved
    return Trace(**series)


def _attempt(kind: str, index: int, seed: tuple[int, ...]) -> Case | None:
    """One draw of a case; None if the effect does not have the intended size."""
    setting = _setting(kind, index, seed)
    if not setting.names_of_effects:
        return _finish(
            kind, index, setting, [], setting.noise_var, _run(setting, [], setting.dt, setting.motion)
        )
    nominal = _run(setting, [], COARSE, setting.motion).trace
    strengths = [1.0] * len(setting.names_of_effects)
    aim = setting.ratio * setting.noise_var
    for _ in range(3):
        effects = _make_effects(setting, strengths, nominal)
        size = _worth(setting, _run(setting, effects, COARSE, setting.motion), effects)
        if aim / 2 < min(size.each) and max(size.each) < aim * 2:
            break
        strengths = [
            s * float(np.clip(np.sqrt(aim / max(each, 1e-9)), 0.2, 5.0))
            for s, each in zip(strengths, size.each, strict=True)
        ]
    if _noise(setting, size, slack=1.3) is None:
        return None
    effects = _make_effects(setting, strengths, nominal)
    run = _run(setting, effects, setting.dt, setting.motion)
    size = _worth(setting, run, effects)
    noise_var = _noise(setting, size)
    if np.abs(run.trace.dq).max() > FASTEST or noise_var is None:
        return None
    return _finish(kind, index, setting, effects, noise_var, run, size)


def _noise(setting: Setting, size: Worth, slack: float = 1.0) -> float | None:
    """Noise variance for the drawn ratio of effect to noise; None if there is no such variance."""
    wanted = max(min(size.each) / setting.ratio, size.left / MOST)
    noise = float(np.clip(wanted, 0.02, 0.4)) if np.isfinite(wanted) else np.inf
    fits = min(size.each) * slack >= LEAST * noise and size.left <= MOST * noise * slack
    return noise if fits else None


def _finish(
    kind: str,
    index: int,
    setting: Setting,
    effects: list[Effect],
    noise_var: float,
    run: Run,
    size: Worth | None = None,
) -> Case:
    """Sample the log, add noise, and collect the ground truth."""
    rng = setting.rng(4)
    log, encoder_var = _log(setting, effects, noise_var, run, rng)
    truth: dict[str, Any] = {
        "kind": kind,
        "group": GROUP_OF[kind],
        "motion": setting.motion,
        "joints": setting.names,
        "rate": setting.rate,
        "kp": setting.kp,
        "kd": setting.kd,
        "delta_kp": setting.delta_kp,
        "delta_kd": setting.delta_kd,
        "input_delay_ms": setting.input_ms,
        "output_delay_ms": setting.output_ms,
        "noise_var": noise_var,
        "floor": noise_var + encoder_var,
        "effects": [_truth_of(effect, setting, run) for effect in effects],
    }
    if size is not None:
        truth["worth"] = {"left": size.left, "each": size.each}
        if len(effects) == 1 and kind in KNOWN:
            laws = worth.rivals(size.scene, effects[0].joints, size.base)
            equal = worth.equals(size.scene, size.base, laws, 0.02 * noise_var)
            truth["effects"][0]["accepted"] += [
                name for name in equal if name not in truth["effects"][0]["accepted"]
            ]
    holdout = None
    if kind == "table_4":
        other = _run(setting, [], setting.dt, "mixed")
        holdout = _log(setting, [], noise_var, other, setting.rng(5))[0]
    return Case(f"{kind}-{index:03d}", log, truth, holdout)


def _truth_of(effect: Effect, setting: Setting, run: Run) -> dict[str, Any]:
    """Ground truth of one effect."""
    return {
        "name": effect.name,
        "accepted": [effect.name, *effect.also],
        "joints": [setting.names[j] for j in effect.joints],
        "params": {**effect.params, **({"share_of_samples": run.hit} if effect.lose is not None else {})},
        "stage": "".join(effect.hooks),
        "signals": effect.signals,
    }


def _log(
    setting: Setting, effects: list[Effect], noise_var: float, run: Run, rng: np.random.Generator
) -> tuple[dict[str, Any], float]:
    """The log, and the error that the encoder noise causes, N^2 m^2."""
    series, dt = _as_logged(run, effects), run.dt
    stride = setting.stride(dt)
    at = np.arange(stride, len(run.held) - stride, stride)
    if setting.extra["jitter"]:
        at = at + rng.integers(-1, 2, size=len(at))
    if setting.extra["drops"]:
        at = at[rng.random(len(at)) > 0.005]
    shape = (len(at), len(setting.names))
    q_noise, dq_noise = (
        (1e-5, 1e-3) if setting.motion == "eq9" else (rng.uniform(1e-5, 8e-5), rng.uniform(1e-3, 8e-3))
    )
    start = float(rng.uniform(0, 50))
    log: dict[str, Any] = {
        "t": start + at * dt,
        "q": series.q[at] + q_noise * rng.standard_normal(shape),
        "dq": series.dq[at] + dq_noise * rng.standard_normal(shape),
        "tau": series.tau[at] + np.sqrt(noise_var) * rng.standard_normal(shape),
        "t_cmd": start + run.motion.ticks * dt,
        "q_des_cmd": run.motion.targets,
        "joint_names": np.array(setting.names),
        **_gains(setting, len(run.motion.ticks)),
    }
    for effect in effects:
        if effect.temperature is not None:
            warm = effect.temperature(at * dt)
            cool = 32.0 + np.zeros(shape)
            cool[:, list(effect.joints)] = warm[:, None]
            log["temperature"] = cool + 0.05 * rng.standard_normal(shape)
    if run.voltage.size:
        log["voltage"] = run.voltage[at] + 0.02 * rng.standard_normal(len(at))
    drive = setting.drive(dt)
    return log, (drive.kp * q_noise) ** 2 + (drive.kd * dq_noise) ** 2


def _gains(setting: Setting, commands: int) -> dict[str, Array]:
    """The commanded gains as scalars, for each joint, or for each command."""
    shape = ((), (len(setting.names),), (commands, len(setting.names)))[setting.extra["gains"]]
    return {"kp": np.full(shape, setting.kp), "kd": np.full(shape, setting.kd)}
