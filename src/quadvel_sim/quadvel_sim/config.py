"""Configuration of a simulated robot: sensor noise and `SimulatorConfig`.

Records only: `simulator` applies them, `parameters` fills them from the parameters of a node.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np

from quadvel_actuator import ActuatorParameters
from quadvel_description.arrays import Array
from quadvel_description.fields import field
from quadvel_description.robot import Robot
from quadvel_sim.physics import Physics
from quadvel_sim.terrain import Terrain
from quadvel_sim.world import World


@attrs.frozen
class SensorNoise:
    """Standard deviations of the white sensor noise, drawn independently for each sample.

    Attributes:
        q: Joint positions, rad.
        dq: Joint velocities, rad/s.
        angular_velocity: Gyroscope, rad/s.
        linear_acceleration: Accelerometer, m/s^2.
        orientation: Rotation about each body axis, rad.
    """

    q: float = field(5e-4, at_least=0.0)
    dq: float = field(0.03, at_least=0.0)
    angular_velocity: float = field(0.01, at_least=0.0)
    linear_acceleration: float = field(0.1, at_least=0.0)
    orientation: float = field(2e-3, at_least=0.0)

    @classmethod
    def none(cls) -> SensorNoise:
        """Return the configuration of noise-free sensors.

        Returns:
            Standard deviations that are all zero.
        """
        return cls(*(0.0 for _ in attrs.fields(cls)))


def _of_robot(name: str) -> Any:
    """Declare the value of the robot as a default."""
    return attrs.Factory(lambda config: getattr(config.robot, name), takes_self=True)


@attrs.frozen(eq=False, kw_only=True)
class SimulatorConfig:
    """Configuration of one simulated robot; the default is the nominal robot on flat ground.

    Raises:
        ValueError: A value is out of its range, or a world is combined with a terrain.

    Attributes:
        robot: The robot.
        actuator: Parameters of the actuator model; the default is the robot's.
        terrain: Ground without a world.
        world: Obstacles, ground, people and laser around the robot; None: only `terrain`.
        noise: Sensor noise.
        seed: Seed of torque and sensor noise; the ground has a separate seed.
        friction: Sliding friction coefficient of each foot, (4,), FR FL RR RL.
        payload: Mass on the trunk, kg; a negative value reduces mass and inertia of the trunk.
        payload_position: Centre of mass of the payload in the trunk frame, (3,), m.
        armature: Reflected rotor inertia of each joint, (12,), kg m^2.
        joint_friction: Coulomb friction of each joint, (12,), N m.
        joint_damping: Viscous friction of each joint, (12,), N m s/rad.
        physics: Settings of integration and contact.
        suspended: Whether the trunk is held in the air, as on a stand.
        watchdog: Time without a command after which the drives brake, s.
        watchdog_kd: Damping gain of that brake, N m s/rad.
        fall_tilt: Tilt of the trunk's z axis beyond which the robot counts as fallen, rad.
    """

    robot: Robot
    actuator: ActuatorParameters = attrs.field(
        default=attrs.Factory(lambda config: ActuatorParameters.of(config.robot), takes_self=True)
    )
    terrain: Terrain = attrs.field(factory=Terrain)
    world: World | None = None
    noise: SensorNoise = attrs.field(factory=SensorNoise)
    seed: int = field(0, at_least=0, whole=True)
    friction: Array = field(0.8, size=4, at_least=0.0)
    payload: float = field(0.0, at_least=-8.0, at_most=50.0)
    payload_position: Array = field((0.0, 0.0, 0.1), size=3)
    armature: Array = field(_of_robot("armature"), size=12, at_least=1e-4)
    joint_friction: Array = field(_of_robot("joint_friction"), size=12, at_least=0.0)
    joint_damping: Array = field(_of_robot("joint_damping"), size=12, at_least=0.0)
    physics: Physics = attrs.field(factory=Physics)
    suspended: bool = False
    watchdog: float = field(0.02, at_least=0.001)
    watchdog_kd: float = field(5.0, at_least=0.0, at_most=50.0)
    fall_tilt: float = field(1.0, at_least=0.1, at_most=np.pi)

    def __attrs_post_init__(self) -> None:
        if self.world is not None and self.terrain.kind != "flat":
            raise ValueError(
                f"SimulatorConfig.terrain: found {self.terrain.kind!r} in a world, which brings its own ground; expected 'flat'"
            )
