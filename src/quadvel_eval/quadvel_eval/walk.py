"""Records one simulated walk: sets up robot, ground and policy, and computes power and jitter.

A walk is a list of velocity commands with durations. Module `grid` runs and evaluates many.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike

from quadvel_actuator import ActuatorParameters
from quadvel_description.arrays import Array, Bools
from quadvel_description.fields import field
from quadvel_description.kinematics import rotate, yaw
from quadvel_description.quadruped import GRAVITY
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_estimator.kalman import KalmanEstimator
from quadvel_estimator.learned import shipped_estimator
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_policy.policy_file import load_policy, shipped_policy
from quadvel_policy.supervisor import Supervisor
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sim.terrain import Terrain

from .robot_loop import RobotLoop, Sample, make_estimator

TERRAINS = ("flat", "rough", "slope")
SLOPE_ANGLE_RAD = 0.15  # rising ahead
HEATING_COEFFICIENT = 0.2  # k_r of Table 2, W/(N m)^2
DIAGONAL_FOOT_DISTANCE_M = 0.555  # characteristic length l_c of Eq. 10


@attrs.frozen(kw_only=True)
class Setup:
    """Robot, policy and ground of a walk.

    Attributes:
        robot: Name of a shipped robot, or path of a robot.yaml.
        policy: ONNX file of the policy; the default is the shipped one of the robot.
        estimator: Velocity estimator in the loop, one of `robot_loop.ESTIMATORS`.
        estimator_file: ONNX file of the learned estimator; the default is the shipped one of the
            robot, or None if there is none and the loop does not need it.
        terrain: One of TERRAINS.
        randomised: Whether the seed draws plant and actuators.
        actuator: File of an actuator model; None for the robot's.
        plant: Fields of `SimulatorConfig` that override all other settings and draws.
    """

    robot: str = DEFAULT_ROBOT
    policy: Path = attrs.field(
        default=attrs.Factory(lambda setup: shipped_policy(load_robot(setup.robot)), takes_self=True)
    )
    estimator: str = "learned"
    estimator_file: Path | None = attrs.field(
        default=attrs.Factory(lambda setup: _shipped_estimator(setup), takes_self=True)
    )
    terrain: str = field("flat", one_of=TERRAINS)
    randomised: bool = False
    actuator: Path | None = None
    plant: Mapping[str, Any] = attrs.field(factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Convert the setup for `eval.json`, without `plant`.

        Returns:
            Field names and values, paths as strings.
        """
        fields = attrs.asdict(self, filter=lambda field, _: field.name != "plant")
        return {name: str(value) if isinstance(value, Path) else value for name, value in fields.items()}


def _shipped_estimator(setup: Setup) -> Path | None:
    """Return the shipped estimator; None if there is none, unless the loop needs it."""
    try:
        return shipped_estimator(load_robot(setup.robot))
    except FileNotFoundError:
        if setup.estimator == "learned":
            raise
        return None


def make_simulator(setup: Setup, seed: int) -> Simulator:
    """Create a simulator with a standing robot.

    Args:
        setup: Robot and ground.
        seed: Seed of terrain, noise and randomisation (Sections 3.1 and 3.4 of the paper).

    Returns:
        A simulator of the nominal robot, or of a randomised one if the setup says so.
    """
    terrain = Terrain(
        kind=setup.terrain, slope=SLOPE_ANGLE_RAD if setup.terrain == "slope" else 0.0, seed=seed
    )
    robot, rng = load_robot(setup.robot), np.random.default_rng(seed)
    drawn = _draw_plant(robot, rng) if setup.randomised else {}
    if setup.actuator is not None:
        drawn["actuator"] = ActuatorParameters.load(robot, setup.actuator)
    simulator = Simulator(
        SimulatorConfig(**{"robot": robot, "terrain": terrain, "seed": seed, **drawn, **setup.plant})
    )
    simulator.reset("stand")
    if setup.randomised:
        simulator.actuator.sample(rng=rng)
        simulator.actuator.reset()
    return simulator


def _draw_plant(robot: Robot, rng: np.random.Generator) -> dict[str, Any]:
    """Draw friction, payload and joint properties as fields of `SimulatorConfig`."""
    return {
        "friction": rng.uniform(0.3, 1.0, 4),
        "payload": rng.uniform(0.0, 3.0),
        "payload_position": rng.uniform([-0.1, -0.05, 0.05], [0.1, 0.05, 0.15]),
        "armature": robot.armature * rng.uniform(0.8, 1.2),
        "joint_friction": robot.joint_friction * rng.uniform(0.2, 1.5),
        "joint_damping": robot.joint_damping * rng.uniform(0.2, 1.5),
    }


def make_loop(setup: Setup, seed: int, shadow_estimators: Sequence[str] = ("learned", "kalman")) -> RobotLoop:
    """Create the control loop of a standing robot and start the policy.

    Args:
        setup: Robot, policy, estimator and ground.
        seed: Seed of the run.
        shadow_estimators: Kinds of further estimators to measure, see `RobotLoop`; "learned" only if
            the setup has its file.

    Returns:
        A loop whose supervisor is in mode walk.
    """
    simulator = make_simulator(setup, seed)
    robot = simulator.config.robot
    loop = RobotLoop(
        simulator,
        Supervisor(robot, load_policy(robot, setup.policy), backup=KalmanEstimator(robot)),
        make_estimator(setup.estimator, simulator, setup.estimator_file),
        shadow_estimators={
            name: make_estimator(name, simulator, setup.estimator_file)
            for name in shadow_estimators
            if name != "learned" or setup.estimator_file is not None
        },
    )
    loop.start_walking()
    return loop


@attrs.frozen(eq=False)
class Walk:
    """A recorded walk of n ticks. Vectors are in the body frame unless stated otherwise.

    Attributes:
        time: Time since the first command (n,), s.
        position: Position of the trunk (n, 3), m, world frame.
        velocity: True vx, vy (m/s) and wz (rad/s), (n, 3).
        commanded: Commanded vx, vy (m/s) and wz (rad/s) after the mux, (n, 3).
        heading: Unwrapped yaw of the trunk (n,), rad.
        contact: Whether each foot touches the ground (n, 4).
        targets: Joint targets (n, 12), rad.
        joint_velocity: Measured joint velocity (n, 12), rad/s.
        torque: Measured joint torque (n, 12), N m.
        power: Power of the 12 drives with heat (n,), W.
        estimate_errors: Estimate minus true velocity (n, 3), m/s, by estimator.
        estimate_drifts: Final horizontal dead reckoning error, m, by estimator.
    """

    time: Array
    position: Array
    velocity: Array
    commanded: Array
    heading: Array
    contact: Bools
    targets: Array
    joint_velocity: Array
    torque: Array
    power: Array
    estimate_errors: dict[str, Array]
    estimate_drifts: dict[str, float]


def record_walk(loop: RobotLoop, commands: Sequence[tuple[ArrayLike, float]]) -> Walk | None:
    """Record a walk through a list of velocity commands.

    A robot counts as fallen if the supervisor leaves mode walk or the simulation diverges.

    Args:
        loop: Loop with a robot in mode walk.
        commands: Velocity vx, vy (m/s), wz (rad/s) and duration (s) of each command.

    Returns:
        The walk; None if the robot fell.
    """
    samples, stood = _sample_until_fall(loop, commands)
    return _to_walk(samples) if stood else None


def record_until_fall(
    loop: RobotLoop, commands: Sequence[tuple[ArrayLike, float]]
) -> tuple[Walk | None, bool]:
    """Record a walk up to its end or up to the fall of the robot.

    Args:
        loop: Loop with a robot in mode walk.
        commands: Velocity vx, vy (m/s), wz (rad/s) and duration (s) of each command.

    Returns:
        The walk (None if it has no sample), and whether the robot stayed on its feet.
    """
    samples, stood = _sample_until_fall(loop, commands)
    return (_to_walk(samples) if samples else None), stood


def _sample_until_fall(
    loop: RobotLoop, commands: Sequence[tuple[ArrayLike, float]]
) -> tuple[list[Sample], bool]:
    """Collect samples until the end or the fall, and whether the end was reached."""
    samples: list[Sample] = []
    for velocity, seconds in commands:
        for _ in range(round(seconds / CONTROL_PERIOD_S)):
            try:
                sample = loop.tick(velocity)
            except FloatingPointError:
                return samples, False
            if sample.fallen or sample.mode != "walk":
                return samples, False
            samples.append(sample)
    return samples, True


def _to_walk(samples: Sequence[Sample]) -> Walk:
    """Convert samples to arrays."""
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
        commanded=np.array([s.commanded for s in samples]),
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
    """Return the horizontal error of a position that is integrated from velocities.

    Args:
        velocity: Velocities (n, 3), m/s, world frame, one per tick.
        position: True positions (n, 3), m, world frame.

    Returns:
        Distance between integrated and true final position, m.
    """
    # Trapezoidal rule: p_n - p_0 = sum_i (v_i + v_{i+1}) / 2 dt.
    displacement = 0.5 * CONTROL_PERIOD_S * (velocity[1:] + velocity[:-1]).sum(axis=0)
    return float(np.linalg.norm((displacement - (position[-1] - position[0]))[:2]))


def drive_power(torque: ArrayLike, speed: ArrayLike) -> Array:
    """Return the electrical power of the 12 drives, P in Eq. 10 of the paper.

    Args:
        torque: Joint torques (..., 12), N m.
        speed: Joint velocities (..., 12), rad/s.

    Returns:
        Power (...,), W, without recuperation.
    """
    # Eq. 10: P = sum_j max(k_r tau_j^2 + tau_j dq_j, 0): heat plus mechanical power, per joint.
    torque = np.asarray(torque, float)
    power: Array = np.maximum(HEATING_COEFFICIENT * torque**2 + torque * np.asarray(speed, float), 0.0).sum(
        axis=-1
    )
    return power


def cost_of_transport(power: float, mass: float, command: Array, mean: Array) -> float | None:
    """Return the cost of transport, or the cost of turning for a pure turn (Eq. 10).

    Args:
        power: Mean power of the drives, W.
        mass: Mass of robot and payload, kg.
        command: Commanded vx, vy (m/s) and wz (rad/s), (3,).
        mean: Mean true vx, vy (m/s) and wz (rad/s), body frame, (3,).

    Returns:
        The dimensionless cost; None for a zero command, or if the robot does not move along it.
    """
    # Eq. 10: CoT = P / (m g v), with v the mean velocity along the command. For a pure turn,
    # CoTu = P / (m g l_c w_z), with the distance l_c of diagonal feet.
    speed = float(np.hypot(*command[:2]))
    if speed > 0.0:
        pace = float(command[:2] @ mean[:2]) / speed
    else:
        pace = DIAGONAL_FOOT_DISTANCE_M * float(np.sign(command[2]) * mean[2])
    return power / (mass * GRAVITY * pace) if pace > 0.0 else None


def jitter(targets: ArrayLike) -> float:
    """Return the action jitter: mean absolute second difference of the joint targets (Figure 9).

    Args:
        targets: Joint targets (n, 12), rad, one per tick of 5 ms.

    Returns:
        Jitter, rad.
    """
    return float(np.abs(np.diff(np.asarray(targets, float), n=2, axis=0)).mean())
