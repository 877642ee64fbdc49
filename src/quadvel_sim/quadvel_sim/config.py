"""What may be chosen of a simulated robot. Records only: `simulator` acts on them, `sim_node` fills them."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator import ActuatorParameters
from quadvel_description import robot
from quadvel_sim.checks import number, numbers, whole_number
from quadvel_sim.physics import Physics
from quadvel_sim.terrain import Terrain
from quadvel_sim.world import World


@attrs.frozen
class SensorNoise:
    """Standard deviations of the white noise on what the sensors report, drawn anew for each sample."""

    q: float = attrs.field(default=5e-4, **number(0.0))  # rad
    dq: float = attrs.field(default=0.03, **number(0.0))  # rad/s
    angular_velocity: float = attrs.field(default=0.01, **number(0.0))  # rad/s
    linear_acceleration: float = attrs.field(default=0.1, **number(0.0))  # m/s^2
    orientation: float = attrs.field(default=2e-3, **number(0.0))  # rad, about each body axis

    @classmethod
    def none(cls) -> SensorNoise:
        """Perfect sensors."""
        return cls(*(0.0 for _ in attrs.fields(cls)))


@attrs.frozen(eq=False, kw_only=True)
class SimulatorConfig:
    """One simulated AlienGo; by default the nominal robot on flat ground with the shipped actuator model."""

    actuator: ActuatorParameters = attrs.field(factory=ActuatorParameters.default)
    terrain: Terrain = attrs.field(factory=Terrain)
    world: World | None = None
    """What is around the robot, ground included; without one there is the terrain alone."""
    noise: SensorNoise = attrs.field(factory=SensorNoise)
    seed: int = attrs.field(default=0, **whole_number())
    """Of torque and sensor noise; the ground has its own."""
    friction: NDArray[np.float64] = attrs.field(default=0.8, **numbers(4, low=0.0))
    """Sliding friction coefficient of each foot, (4,), FR FL RR RL."""
    payload: float = attrs.field(default=0.0, **number(-8.0, 50.0))
    """Mass on the trunk, kg; below zero it is taken off the trunk, evenly."""
    payload_position: NDArray[np.float64] = attrs.field(default=(0.0, 0.0, 0.1), **numbers(3))
    """Centre of mass of the payload in the trunk frame, m."""
    armature: NDArray[np.float64] = attrs.field(factory=lambda: robot.ARMATURE, **numbers(12, low=1e-4))
    """Reflected rotor inertia, (12,), kg m^2."""
    joint_friction: NDArray[np.float64] = attrs.field(factory=lambda: robot.FRICTION, **numbers(12, low=0.0))
    """Coulomb friction, (12,), N m."""
    joint_damping: NDArray[np.float64] = attrs.field(factory=lambda: robot.DAMPING, **numbers(12, low=0.0))
    """Viscous friction, (12,), N m s/rad."""
    physics: Physics = attrs.field(factory=Physics)
    """How motion and contact are solved."""
    hung: bool = False
    """Whether the trunk is held in the air, as on a stand."""
    watchdog: float = attrs.field(default=0.02, **number(0.001))
    """Without a command for this long (s) the drives brake, as the robot's board has them do."""
    watchdog_kd: float = attrs.field(default=5.0, **number(0.0, 50.0))
    """Gain of that brake, N m s/rad."""
    fall_tilt: float = attrs.field(default=1.0, **number(0.1, np.pi))
    """Angle of the trunk's z axis to the vertical (rad) beyond which the robot counts as fallen."""

    def __attrs_post_init__(self) -> None:
        if self.world is not None and self.terrain.kind != "flat":
            raise ValueError(
                f"SimulatorConfig.terrain: found {self.terrain.kind!r} in a world, which brings its own ground; expected 'flat'"
            )
