"""Runs the fault campaign: each fault in each relevant mode with random seeds, against an oracle.

`injection` makes the faults, `stack` simulates robot and nodes, `cases` has the oracles, and
`report` writes the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import attrs
import numpy as np

from quadvel_description.arrays import Array
from quadvel_description.robot import Robot, load_robot
from quadvel_description.state import MODE_DAMPING
from quadvel_estimator.learned import LearnedEstimator
from quadvel_policy.policy_file import PolicyFile
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import DT, Simulator

from ..pool import Call, run_in_parallel
from .cases import CASES, Case
from .injection import make_injection
from .stack import Stack

SCHEMA = 1
OBSERVATION_TIME_S = 2.5  # after the fault
VELOCITIES = (
    (0.5, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (-0.5, 0.0, 0.0),
    (0.0, 0.4, 0.0),
    (0.5, 0.0, 0.8),
    (0.0, 0.0, 1.0),
)
STANDING_SPEED_LIMIT, STANDING_YAW_RATE_LIMIT = 0.1, 0.3  # m/s, rad/s: a slower robot stands


@attrs.define
class FaultRun:
    """Outcome of one fault from one seed. Times are in s since the fault; None: never.

    Attributes:
        component: Faulty component.
        kind: Kind of fault.
        mode: Mode of the controller at the fault.
        seed: Seed of the run.
        fault: Name of the finding that stopped the robot.
        findings: Names of all findings, in order.
        named_after: Time until the first expected finding, s.
        safe_after: Time until the expected end (damped, or standing), s.
        ended: Final mode of the supervisor.
        fell: Whether the robot fell.
        torque: Largest torque over the limit of the drive, as a ratio.
        speed: Largest speed of a joint that its drive accelerates over the drive's limit, as a
            ratio.
        too_fast: Longest time in which a drive accelerated a joint above MAX_SPEED_RATIO, s.
        beyond: Largest overtravel of a joint beyond its mechanical range, rad.
        wrong: Violations of the oracle, one sentence each.
    """

    component: str
    kind: str
    mode: str
    seed: int
    fault: str = ""
    findings: list[str] = attrs.Factory(list)
    named_after: float | None = None
    safe_after: float | None = None
    ended: str = ""
    fell: bool = False
    torque: float = 0.0
    speed: float = 0.0
    too_fast: float = 0.0
    beyond: float = 0.0
    wrong: list[str] = attrs.Factory(list)


def run_campaign(
    robot: str,
    seeds: int,
    only: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[FaultRun]:
    """Run every component and kind of fault from seeds 0, 1, ..., which alternate between its modes.

    Args:
        robot: Name of a shipped robot, or path of a robot.yaml.
        seeds: Number of seeds of each component and kind.
        only: Run only cases whose "component kind mode" contains this text.
        progress: Called with the number of finished runs and the number of all runs.

    Returns:
        The runs, case by case.

    Raises:
        FileNotFoundError: There is no such robot, or it has no policy.
        ValueError: The robot's file is not valid, or no case contains `only`.
    """
    _networks(load_robot(robot))  # fail on a bad robot here, once, before any run
    cases = [case for case in CASES if only is None or only in case.name]
    if not cases:
        words = [dict.fromkeys(case.name.split()[i] for case in CASES) for i in range(3)]
        components, kinds_of_fault, modes = (", ".join(column) for column in words)
        raise ValueError(
            f"no case contains '{only}'; components: {components}; kinds: {kinds_of_fault}; modes: {modes}"
        )
    kinds: dict[tuple[str, str], list[Case]] = {}
    for case in cases:
        kinds.setdefault((case.component, case.kind), []).append(case)
    calls: list[Call] = [
        (run_case, robot, modes[seed % len(modes)], seed) for modes in kinds.values() for seed in range(seeds)
    ]
    runs: list[FaultRun | None] = [None] * len(calls)
    for done, (i, answer) in enumerate(run_in_parallel(calls), 1):
        runs[i] = answer
        progress(done, len(calls))
    return [one for one in runs if one is not None]


@cache
def _networks(robot: Robot) -> tuple[PolicyFile, LearnedEstimator]:
    """Load the shipped networks once per process."""
    return PolicyFile(robot), LearnedEstimator(robot)


def run_case(robot: str, case: Case, seed: int) -> FaultRun:
    """Simulate one fault.

    Args:
        robot: Name of a shipped robot, or path of a robot.yaml.
        case: Fault and oracle.
        seed: Seed of simulator, instant and fault.

    Returns:
        The outcome.
    """
    rng = np.random.default_rng([seed, *map(ord, case.name)])
    stack = _prepare_stack(load_robot(robot), case.mode, rng, seed)
    result = FaultRun(case.component, case.kind, case.mode, seed)
    healthy = [*stack.supervisor.findings]
    if healthy or stack.supervisor.fault:
        result.wrong.append(f"before the fault: {stack.supervisor.fault or healthy[0].name}")
    make_injection(case.component, case.kind).begin(stack, rng)
    began, too_fast = stack.now, np.zeros(12)  # ms; s by joint
    for _ in range(round(OBSERVATION_TIME_S / DT)):
        try:
            stack.step()
        except FloatingPointError as error:
            result.wrong.append(str(error))
            break
        too_fast = _observe(stack, case, (stack.now - began) * DT, result, too_fast)
    result.ended, result.fell = stack.supervisor.mode, stack.simulator.fallen
    result.wrong += _violations(case, result)
    return result


def _prepare_stack(robot: Robot, mode: str, rng: np.random.Generator, seed: int) -> Stack:
    """Bring a robot to a random instant of a mode."""
    simulator = Simulator(SimulatorConfig(robot=robot, seed=seed))
    simulator.reset("lie" if mode == "stand_up" else "stand")
    policy, estimator = _networks(robot)
    policy.reset()
    estimator.reset()
    stack = Stack(simulator, policy, estimator)
    _advance(stack, 0.05)
    _request(stack, "stand_up" if mode == "stand_up" else "stance")
    _advance(stack, 0.6)
    if mode == "stand_up":
        _advance(stack, rng.uniform(0.0, 1.0))
    elif mode == "stance":
        _advance(stack, rng.uniform(0.0, 0.5))
    elif mode == "lie_down":
        _request(stack, "lie_down")
        _advance(stack, rng.uniform(0.2, 0.7))
    else:
        stack.planned_velocity = np.array(VELOCITIES[int(rng.integers(len(VELOCITIES)))])
        _advance(stack, rng.uniform(1.2, 2.0))
    return stack


def _request(stack: Stack, mode: str) -> None:
    """Request a mode from the supervisor. Raises RuntimeError if it refuses."""
    accepted, sentence = stack.supervisor.request(mode)
    if not accepted:
        raise RuntimeError(f"the supervisor refused {mode}: {sentence}")


def _advance(stack: Stack, seconds: float) -> None:
    """Simulate for some seconds."""
    for _ in range(round(seconds / DT)):
        stack.step()


def _observe(stack: Stack, case: Case, time: float, result: FaultRun, too_fast: Array) -> Array:
    """Record what happens in one millisecond.

    Args:
        stack: The stack after the step.
        case: Fault and oracle.
        time: Time since the fault, s.
        result: Outcome to update.
        too_fast: Time for which each joint (12,) has been too fast before this step, s.

    Returns:
        The same times after this step (12,), s.
    """
    robot, data, supervisor = stack.simulator.config.robot, stack.simulator.data, stack.supervisor
    result.torque = max(result.torque, float((np.abs(data.ctrl) / robot.torque_limit).max()))
    # A drive accelerates its joint if torque and speed have the same sign.
    q, dq = data.qpos[7:], data.qvel[6:]
    driven = np.where(data.ctrl * dq > 0.0, np.abs(dq) / robot.velocity_limit, 0.0)
    result.speed = max(result.speed, float(driven.max()))
    too_fast = np.where(driven > MAX_SPEED_RATIO, too_fast + DT, 0.0)
    result.too_fast = max(result.too_fast, float(too_fast.max()))
    result.beyond = max(result.beyond, float(np.maximum(robot.lower - q, q - robot.upper).max()))
    for name in [supervisor.fault, *(finding.name for finding in supervisor.findings)]:
        if name and name not in result.findings:
            result.findings.append(name)
    result.fault = result.fault or supervisor.fault
    if result.named_after is None and set(result.findings) & set(case.expected_findings):
        result.named_after = time
    if result.safe_after is None and case.expected_end != "goes on" and _is_safe(stack, case.expected_end):
        result.safe_after = time
    return too_fast


def _is_safe(stack: Stack, ends: str) -> bool:
    """Return whether the robot has reached the expected end."""
    if ends == "damping":
        return stack.simulator.braking or stack.robot_command_mode == MODE_DAMPING
    if ends == "stance":
        return stack.supervisor.mode == "stance"
    if ends == "stopped":
        return stack.supervisor.mode in ("stance", "fault")
    velocity = stack.simulator.data.qvel
    return (
        float(np.linalg.norm(velocity[:2])) < STANDING_SPEED_LIMIT
        and abs(velocity[5]) < STANDING_YAW_RATE_LIMIT
    )


def _violations(case: Case, result: FaultRun) -> Iterator[str]:
    """Yield one sentence for each violation of the oracle."""
    if case.expected_findings and result.named_after is None:
        found = ", ".join(result.findings) or "nothing"
        yield f"found {found}, expected {' or '.join(case.expected_findings)}"
    elif result.named_after is not None and result.named_after > case.finding_deadline:
        yield f"named after {result.named_after:.3f} s, expected {case.finding_deadline:.3f} s"
    if case.expected_end != "goes on" and case.expected_end != "any":
        if result.safe_after is None:
            yield f"ended in {result.ended}, expected {case.expected_end}"
        elif result.safe_after > case.safe_deadline:
            yield f"{case.expected_end} after {result.safe_after:.3f} s, expected {case.safe_deadline:.3f} s"
    if case.expected_end in ("goes on", "stands") and (result.fault or result.fell):
        yield f"stopped by {result.fault or 'a fall'}, expected to go on"
    if case.expected_end == "stance" and result.fell:
        yield "fell on the way to a stand"
    if case.expected_end == "any" and result.fell and not result.fault:
        yield "fell, and no fault was named"
    if result.torque > 1.0 + 1e-6:
        yield f"a torque of {result.torque:.2f} times the drive's limit"
    if result.too_fast > REACTION_TIME_S:
        yield f"a joint driven on beyond {MAX_SPEED_RATIO} times its drive's speed for {result.too_fast:.3f} s"
    if result.beyond > (MAX_OVERTRAVEL_IN_FALL_RAD if result.fell else MAX_OVERTRAVEL_RAD):
        yield f"a joint {result.beyond:.2f} rad beyond its mechanical range"


MAX_SPEED_RATIO = 1.25
"""Joint speed over the drive's limit above which the drive must not accelerate the joint."""
REACTION_TIME_S = 0.02
"""Time in which it may, s: until the next tick detects it and its command reaches the drive."""
MAX_OVERTRAVEL_RAD, MAX_OVERTRAVEL_IN_FALL_RAD = 0.05, 0.2
"""Overtravel into a compliant mechanical stop, rad; in a fall, the ground presses the joint."""


def summarise_cases(runs: Sequence[FaultRun]) -> list[dict[str, Any]]:
    """Summarise the runs of each case.

    Args:
        runs: All runs.

    Returns:
        One entry per case, for JSON.
    """
    entries = []
    for case in CASES:
        own = [
            one
            for one in runs
            if (one.component, one.kind, one.mode) == (case.component, case.kind, case.mode)
        ]
        if own:
            entries.append(_case_summary(case, own))
    return entries


def _case_summary(case: Case, runs: list[FaultRun]) -> dict[str, Any]:
    """Summarise the runs of one case."""
    named = [one.named_after for one in runs if one.named_after is not None]
    safe = [one.safe_after for one in runs if one.safe_after is not None]
    return {
        "case": case.name,
        "ends": case.expected_end,
        "named": sorted({name for one in runs for name in one.findings if name in case.expected_findings}),
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
