"""The campaign: each fault in each mode where it matters, from random seeds, against what has to follow and how soon."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import attrs
import numpy as np

from quadvel_description.robot import LOWER, TORQUE_LIMIT, UPPER, VELOCITY_LIMIT
from quadvel_description.state import MODE_DAMPING
from quadvel_estimator.learned import LearnedEstimator
from quadvel_policy.policy_file import PolicyFile
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import DT, Simulator

from ..pool import Call, in_parallel
from .cases import CASES, Case
from .injection import injection
from .stack import Array, Stack

SCHEMA = 1
AFTERWARDS = 2.5  # s that a run goes on after the fault began
VELOCITIES = (
    (0.5, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (-0.5, 0.0, 0.0),
    (0.0, 0.4, 0.0),
    (0.5, 0.0, 0.8),
    (0.0, 0.0, 1.0),
)
STANDS, TURNS_NOT = 0.1, 0.3  # m/s, rad/s, slower than which a robot stands


@attrs.define
class Run:
    """What came of one fault from one seed. Times in s since the fault began, None where it did not come."""

    component: str
    kind: str
    mode: str
    seed: int
    fault: str = ""
    """the name of what made the robot stop"""
    findings: list[str] = attrs.Factory(list)
    """every name that was found, in order"""
    named_after: float | None = None
    """until one of the right names was found"""
    safe_after: float | None = None
    """until the robot was as it has to end: damped, or standing"""
    ended: str = ""
    fell: bool = False
    torque: float = 0.0
    """largest torque, as a share of the drive's limit"""
    speed: float = 0.0
    """largest speed of a joint that its drive moves on, as a share of what it can do"""
    too_fast: float = 0.0
    """longest time in which a drive moved a joint on that was beyond MAX_SPEED, s"""
    beyond: float = 0.0
    """how far a joint was beyond its mechanical range, rad"""
    wrong: list[str] = attrs.Factory(list)
    """what is against the oracle, as sentences"""


def campaign(
    seeds: int, only: str | None = None, progress: Callable[[int, int], None] = lambda done, of: None
) -> list[Run]:
    """Every component and kind from seeds 0, 1, ..., which take turns in its modes.

    only: those cases whose "component kind mode" holds this text. ValueError where none does.
    """
    cases = [case for case in CASES if only is None or only in case.name]
    if not cases:
        words = [dict.fromkeys(case.name.split()[i] for case in CASES) for i in range(3)]
        components, kinds_of_fault, modes = (", ".join(column) for column in words)
        raise ValueError(
            f"no case holds '{only}'; components: {components}; kinds: {kinds_of_fault}; modes: {modes}"
        )
    kinds: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        kinds.setdefault((case.component, case.kind), []).append(case)
    calls: list[Call] = [
        (run, modes[seed % len(modes)], seed) for modes in kinds.values() for seed in range(seeds)
    ]
    runs: list[Run | None] = [None] * len(calls)
    for done, (i, answer) in enumerate(in_parallel(calls), 1):
        runs[i] = answer
        progress(done, len(calls))
    return [one for one in runs if one is not None]


@cache
def _networks() -> tuple[PolicyFile, LearnedEstimator]:
    return PolicyFile(), LearnedEstimator()


def run(case: Case, seed: int) -> Run:
    """One fault from one seed."""
    rng = np.random.default_rng([seed, *map(ord, case.name)])
    stack = _prepared(case.mode, rng, seed)
    result = Run(case.component, case.kind, case.mode, seed)
    healthy = [*stack.supervisor.findings]
    if healthy or stack.supervisor.fault:
        result.wrong.append(f"before the fault: {stack.supervisor.fault or healthy[0].name}")
    injection(case.component, case.kind).begin(stack, rng)
    began, too_fast = stack.now, np.zeros(12)  # ms; s by joint
    for _ in range(round(AFTERWARDS / DT)):
        try:
            stack.step()
        except FloatingPointError as error:
            result.wrong.append(str(error))
            break
        too_fast = _observe(stack, case, (stack.now - began) * DT, result, too_fast)
    result.ended, result.fell = stack.supervisor.mode, stack.simulator.fallen
    result.wrong += _judge(case, result)
    return result


def _prepared(mode: str, rng: np.random.Generator, seed: int) -> Stack:
    """A robot in the midst of `mode`, at a random instant of it."""
    simulator = Simulator(SimulatorConfig(seed=seed))
    simulator.reset("lie" if mode == "stand_up" else "stand")
    policy, estimator = _networks()
    policy.reset()
    estimator.reset()
    stack = Stack(simulator, policy, estimator)
    _let(stack, 0.05)
    _request(stack, "stand_up" if mode == "stand_up" else "stance")
    _let(stack, 0.6)
    if mode == "stand_up":
        _let(stack, rng.uniform(0.0, 1.0))
    elif mode == "stance":
        _let(stack, rng.uniform(0.0, 0.5))
    elif mode == "lie_down":
        _request(stack, "lie_down")
        _let(stack, rng.uniform(0.2, 0.7))
    else:
        stack.velocity = np.array(VELOCITIES[int(rng.integers(len(VELOCITIES)))])
        _let(stack, rng.uniform(1.2, 2.0))
    return stack


def _request(stack: Stack, mode: str) -> None:
    taken, sentence = stack.supervisor.request(mode)
    if not taken:
        raise RuntimeError(f"the supervisor refused {mode}: {sentence}")


def _let(stack: Stack, seconds: float) -> None:
    for _ in range(round(seconds / DT)):
        stack.step()


def _observe(stack: Stack, case: Case, time: float, result: Run, too_fast: Array) -> Array:
    """Take down what is seen at one millisecond.

    too_fast: for how long each joint (12,) has been driven beyond MAX_SPEED by the millisecond before, s; returned for this one.
    """
    data, supervisor = stack.simulator.data, stack.supervisor
    result.torque = max(result.torque, float((np.abs(data.ctrl) / TORQUE_LIMIT).max()))
    q, dq = data.qpos[7:], data.qvel[6:]
    driven = np.where(data.ctrl * dq > 0.0, np.abs(dq) / VELOCITY_LIMIT, 0.0)
    result.speed = max(result.speed, float(driven.max()))
    too_fast = np.where(driven > MAX_SPEED, too_fast + DT, 0.0)
    result.too_fast = max(result.too_fast, float(too_fast.max()))
    result.beyond = max(result.beyond, float(np.maximum(LOWER - q, q - UPPER).max()))
    for name in [supervisor.fault, *(finding.name for finding in supervisor.findings)]:
        if name and name not in result.findings:
            result.findings.append(name)
    result.fault = result.fault or supervisor.fault
    if result.named_after is None and set(result.findings) & set(case.named):
        result.named_after = time
    if result.safe_after is None and case.ends != "goes on" and _is_safe(stack, case.ends):
        result.safe_after = time
    return too_fast


def _is_safe(stack: Stack, ends: str) -> bool:
    if ends == "damping":
        return stack.simulator.braking or stack.held_mode == MODE_DAMPING
    if ends == "stance":
        return stack.supervisor.mode == "stance"
    if ends == "stopped":
        return stack.supervisor.mode in ("stance", "fault")
    velocity = stack.simulator.data.qvel
    return float(np.linalg.norm(velocity[:2])) < STANDS and abs(velocity[5]) < TURNS_NOT


def _judge(case: Case, result: Run) -> Iterator[str]:
    """What is against the oracle."""
    if case.named and result.named_after is None:
        found = ", ".join(result.findings) or "nothing"
        yield f"found {found}, expected {' or '.join(case.named)}"
    elif result.named_after is not None and result.named_after > case.named_within:
        yield f"named after {result.named_after:.3f} s, expected {case.named_within:.3f} s"
    if case.ends != "goes on" and case.ends != "any":
        if result.safe_after is None:
            yield f"ended in {result.ended}, expected {case.ends}"
        elif result.safe_after > case.safe_within:
            yield f"{case.ends} after {result.safe_after:.3f} s, expected {case.safe_within:.3f} s"
    if case.ends in ("goes on", "stands") and (result.fault or result.fell):
        yield f"stopped by {result.fault or 'a fall'}, expected to go on"
    if case.ends == "stance" and result.fell:
        yield "fell on the way to a stand"
    if case.ends == "any" and result.fell and not result.fault:
        yield "fell, and no fault was named"
    if result.torque > 1.0 + 1e-6:
        yield f"a torque of {result.torque:.2f} times the drive's limit"
    if result.too_fast > REACTION:
        yield f"a joint driven on beyond {MAX_SPEED} times its drive's speed for {result.too_fast:.3f} s"
    if result.beyond > (MAX_BEYOND_IN_A_FALL if result.fell else MAX_BEYOND):
        yield f"a joint {result.beyond:.2f} rad beyond its mechanical range"


MAX_SPEED = 1.25
"""Speed of a joint, as a share of what its drive can do, beyond which the drive must not move it on"""
REACTION = 0.02
"""s in which it may: until the next tick sees it and the drive has heard of it"""
MAX_BEYOND, MAX_BEYOND_IN_A_FALL = 0.05, 0.2
"""rad that a joint may press into its mechanical stop, which yields; in a fall the ground does it"""


def summary(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One entry a case."""
    entries = []
    for case in CASES:
        own = [
            one
            for one in runs
            if (one.component, one.kind, one.mode) == (case.component, case.kind, case.mode)
        ]
        if own:
            entries.append(_entry(case, own))
    return entries


def _entry(case: Case, runs: list[Run]) -> dict[str, Any]:
    named = [one.named_after for one in runs if one.named_after is not None]
    safe = [one.safe_after for one in runs if one.safe_after is not None]
    return {
        "case": case.name,
        "ends": case.ends,
        "named": sorted({name for one in runs for name in one.findings if name in case.named}),
        "runs": len(runs),
        "as_expected": sum(not one.wrong for one in runs),
        "named_after": [float(np.median(named)), max(named)] if named else None,
        "safe_after": [float(np.median(safe)), max(safe)] if safe else None,
        "falls": sum(one.fell for one in runs),
        "torque": max(one.torque for one in runs),
        "speed": max(one.speed for one in runs),
        "too_fast": max(one.too_fast for one in runs),
        "beyond": max(one.beyond for one in runs),
        "wrong": sorted({sentence for one in runs for sentence in one.wrong}),
    }
