"""One walk in the loop, from standing: which robot on which ground, what it did, and what that cost.

A walk is a list of velocities with durations; `grid` makes many of them and judges them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_actuator import ActuatorParameters
from quadvel_description import robot
from quadvel_description.kinematics import rotate, yaw
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import SHIPPED_MODEL
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.simulator import Simulator, SimulatorConfig
from quadvel_sim.terrain import Terrain

from .robot_loop import PERIOD, RobotLoop, Sample, make_estimator

Array = NDArray[np.float64]

TERRAINS = ("flat", "rough", "slope")
SLOPE = 0.15  # rad, rising ahead
HEAT = 0.2  # W/(N m)^2, k_r of Table 2: what a drive turns to heat
DIAGONAL = 0.555  # m, l_c of Eq. 10: the distance between two diagonal feet


@attrs.frozen(kw_only=True)
class Setup:
    """What a walk is made with. estimator: the one in the loop. randomised: draw the plant by the seed.
    actuator: file of the robot's actuator model, None for the shipped one.

    plant: fields of `SimulatorConfig` that are as given here, whatever is said or drawn for them elsewhere.
    """

    policy: Path = SHIPPED_POLICY
    estimator: str = "learned"
    estimator_file: Path = SHIPPED_MODEL
    terrain: str = attrs.field(default="flat", validator=attrs.validators.in_(TERRAINS))
    randomised: bool = False
    actuator: Path | None = None
    plant: Mapping[str, Any] = attrs.field(factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As `eval.json` keeps it; `plant` is for studies that say what they changed themselves."""
        fields = attrs.asdict(self, filter=lambda field, _: field.name != "plant")
        return {name: str(value) if isinstance(value, Path) else value for name, value in fields.items()}


def make_simulator(setup: Setup, seed: int) -> Simulator:
    """The robot standing; nominal, or with a plant and actuators drawn by `seed` (Sections 3.1 and 3.4)."""
    terrain = Terrain(kind=setup.terrain, slope=SLOPE if setup.terrain == "slope" else 0.0, seed=seed)
    rng = np.random.default_rng(seed)
    drawn = _draw_plant(rng) if setup.randomised else {}
    if setup.actuator is not None:
        drawn["actuator"] = ActuatorParameters.load(setup.actuator)
    simulator = Simulator(SimulatorConfig(**{"terrain": terrain, "seed": seed, **drawn, **setup.plant}))
    simulator.reset("stand")
    if setup.randomised:
        simulator.actuator.sample(rng=rng)
        simulator.actuator.reset()
    return simulator


def _draw_plant(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "friction": rng.uniform(0.3, 1.0, 4),
        "payload": rng.uniform(0.0, 3.0),
        "payload_position": rng.uniform([-0.1, -0.05, 0.05], [0.1, 0.05, 0.15]),
        "armature": robot.ARMATURE * rng.uniform(0.8, 1.2),
        "joint_friction": robot.FRICTION * rng.uniform(0.2, 1.5),
        "joint_damping": robot.DAMPING * rng.uniform(0.2, 1.5),
    }


def make_loop(setup: Setup, seed: int, beside: Sequence[str] = ("learned", "kalman")) -> RobotLoop:
    """The standing robot under the policy, with the estimators `beside` the one that is followed."""
    simulator = make_simulator(setup, seed)
    loop = RobotLoop(
        simulator,
        Supervisor(PolicyFile(setup.policy), backup=KalmanEstimator()),
        make_estimator(setup.estimator, simulator, setup.estimator_file),
        beside={name: make_estimator(name, simulator, setup.estimator_file) for name in beside},
    )
    loop.start_walking()
    return loop


@attrs.frozen(eq=False)
class Walk:
    """A recorded walk, n ticks; time 0 is the first command. Body frame where not said otherwise."""

    time: Array  # (n,) s
    position: Array  # (n, 3) m, trunk, world
    velocity: Array  # (n, 3) vx, vy (m/s), wz (rad/s), true
    asked: Array  # (n, 3) the same, that the policy was asked for
    heading: Array  # (n,) rad, of the trunk, without jumps
    contact: NDArray[np.bool_]  # (n, 4) whether a foot touches the ground
    targets: Array  # (n, 12) rad, what the joints were asked for
    joint_velocity: Array  # (n, 12) rad/s, measured
    torque: Array  # (n, 12) N m
    power: Array  # (n,) W, of the 12 drives, heat included
    estimate_errors: dict[str, Array]  # (n, 3) m/s, estimate minus truth
    estimate_drifts: dict[str, float]  # m, level, between the end of the walk and where the estimates lead


def record(loop: RobotLoop, commands: Sequence[tuple[ArrayLike, float]]) -> Walk | None:
    """Command each velocity (vx, vy, wz) for its seconds; None where the robot fell.

    A robot that the supervisor put to damping, or whose simulation diverged, counts as fallen.
    """
    samples, stood = _attempt(loop, commands)
    return _walk(samples) if stood else None


def record_to_the_fall(
    loop: RobotLoop, commands: Sequence[tuple[ArrayLike, float]]
) -> tuple[Walk | None, bool]:
    """As `record`, with what there was of the walk where the robot fell, and whether it kept standing."""
    samples, stood = _attempt(loop, commands)
    return (_walk(samples) if samples else None), stood


def _attempt(loop: RobotLoop, commands: Sequence[tuple[ArrayLike, float]]) -> tuple[list[Sample], bool]:
    """The samples until the end or the fall, and whether it was the end."""
    samples: list[Sample] = []
    for velocity, seconds in commands:
        for _ in range(round(seconds / PERIOD)):
            try:
                sample = loop.tick(velocity)
            except FloatingPointError:
                return samples, False
            if sample.fallen or sample.mode != "walk":
                return samples, False
            samples.append(sample)
    return samples, True


def _walk(samples: Sequence[Sample]) -> Walk:
    time = np.array([s.truth.time for s in samples])
    true = np.array([s.truth.linear_velocity for s in samples])
    turning = np.array([s.truth.angular_velocity for s in samples])
    estimates = {name: np.array([s.estimates[name] for s in samples]) for name in samples[0].estimates}
    quaternion = np.array([s.state.quaternion for s in samples])
    position = np.array([s.truth.position for s in samples])
    joint_velocity, torque = (np.array([getattr(s.state, name) for s in samples]) for name in ("dq", "tau"))
    return Walk(
        time=time - time[0],
        position=position,
        velocity=np.column_stack([true[:, :2], turning[:, 2]]),
        asked=np.array([s.asked for s in samples]),
        heading=np.unwrap(yaw(np.array([s.truth.quaternion for s in samples]))),
        contact=np.array([s.truth.contact for s in samples]),
        targets=np.array([s.command.target for s in samples]),
        joint_velocity=joint_velocity,
        torque=torque,
        power=drive_power(torque, joint_velocity),
        estimate_errors={name: velocity - true for name, velocity in estimates.items()},
        estimate_drifts={
            name: dead_reckoning_error(rotate(quaternion, velocity), position)
            for name, velocity in estimates.items()
        },
    )


def dead_reckoning_error(velocity: Array, position: Array) -> float:
    """Level distance (m) from the last of the positions to where the velocities lead from the first, (n, 3) each, world."""
    led = 0.5 * PERIOD * (velocity[1:] + velocity[:-1]).sum(axis=0)
    return float(np.linalg.norm((led - (position[-1] - position[0]))[:2]))


def drive_power(torque: ArrayLike, speed: ArrayLike) -> Array:
    """P of Eq. 10, (...,) W: sum over the joints of max(k_r tau^2 + tau dq, 0); (..., 12) N m, rad/s."""
    torque = np.asarray(torque, float)
    power: Array = np.maximum(HEAT * torque**2 + torque * np.asarray(speed, float), 0.0).sum(axis=-1)
    return power


def cost_of_transport(power: float, mass: float, command: Array, mean: Array) -> float | None:
    """Eq. 10 with the mean power (W): CoT along the commanded direction, CoTu where only a turn is commanded.

    command, mean (3,): vx, vy, wz. None where nothing is commanded, or the robot does not go that way.
    """
    speed = float(np.hypot(*command[:2]))
    if speed > 0.0:
        pace = float(command[:2] @ mean[:2]) / speed
    else:
        pace = DIAGONAL * float(np.sign(command[2]) * mean[2])
    return power / (mass * robot.GRAVITY * pace) if pace > 0.0 else None


def jitter(targets: ArrayLike) -> float:
    """Mean absolute second difference of joint targets (n, 12), rad, over ticks of 5 ms (Figure 9)."""
    return float(np.abs(np.diff(np.asarray(targets, float), n=2, axis=0)).mean())
