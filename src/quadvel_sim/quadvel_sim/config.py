"""Configuration of a simulated robot: sensor noise and `SimulatorConfig`.

Records only: `simulator` applies them, `parameters` fills them from the parameters of a node.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_actuator import ActuatorParameters
from quadvel_description import robot
from quadvel_description.arrays import Array
from quadvel_sim.checks import number, numbers, whole_number
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

    q: float = attrs.field(default=5e-4, **number(0.0))
    dq: float = attrs.field(default=0.03, **number(0.0))
    angular_velocity: float = attrs.field(default=0.01, **number(0.0))
    linear_acceleration: float = attrs.field(default=0.1, **number(0.0))
    orientation: float = attrs.field(default=2e-3, **number(0.0))

    @classmethod
    def none(cls) -> SensorNoise:
        """Return the configuration of noise-free sensors.

        Returns:
            Standard deviations that are all zero.
        """
        return cls(*(0.0 for _ in attrs.fields(cls)))


@attrs.frozen(eq=False, kw_only=True)
class SimulatorConfig:
    """Configuration of one simulated AlienGo; the default is the nominal robot on flat ground.

    Raises:
        ValueError: A value is out of its range, or a world is combined with a terrain.

    Attributes:
        actuator: Parameters of the actuator model; the default is the identified AlienGo (Table 4).
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

    actuator: ActuatorParameters = attrs.field(factory=ActuatorParameters.default)
    terrain: Terrain = attrs.field(factory=Terrain)
    world: World | None = None
    noise: SensorNoise = attrs.field(factory=SensorNoise)
    seed: int = attrs.field(default=0, **whole_number())
    friction: Array = attrs.field(default=0.8, **numbers(4, low=0.0))
    payload: float = attrs.field(default=0.0, **number(-8.0, 50.0))
    payload_position: Array = attrs.field(default=(0.0, 0.0, 0.1), **numbers(3))
    armature: Array = attrs.field(factory=lambda: robot.ARMATURE, **numbers(12, low=1e-4))
    joint_friction: Array = attrs.field(factory=lambda: robot.FRICTION, **numbers(12, low=0.0))
    joint_damping: Array = attrs.field(factory=lambda: robot.DAMPING, **numbers(12, low=0.0))
    physics: Physics = attrs.field(factory=Physics)
    suspended: bool = False
    watchdog: float = attrs.field(default=0.02, **number(0.001))
    watchdog_kd: float = attrs.field(default=5.0, **number(0.0, 50.0))
    fall_tilt: float = attrs.field(default=1.0, **number(0.1, np.pi))

    def __attrs_post_init__(self) -> None:
        if self.world is not None and self.terrain.kind != "flat":
            raise ValueError(
                f"SimulatorConfig.terrain: found {self.terrain.kind!r} in a world, which brings its own ground; expected 'flat'"
            )
