"""Parameters of the nodes `sim_node` and `board`. No ROS.

`sim_node`, `board_node` and `simulation_node` declare and use them.
"""

from __future__ import annotations

import attrs
import numpy as np
from typing_extensions import override

from quadvel_actuator import ActuatorParameters
from quadvel_description.fields import field
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_driver.calibration import Calibration
from quadvel_driver.unitree_dds.bus import MAX_DOMAIN
from quadvel_nodes.scheduling import Scheduling
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.loop import MODES, PublishState, ReportWaiting, SimulationLoop
from quadvel_sim.simulator import Simulator
from quadvel_sim.terrain import DEFAULT_SLOPE_RAD, KINDS, Terrain
from quadvel_sim.world import SHIPPED_WORLDS, World

_NOISE, _TERRAIN, _CONFIG = SensorNoise(), Terrain(), attrs.fields(SimulatorConfig)


@attrs.frozen(kw_only=True, slots=False)  # no slots: a subclass has a second base class
class PlantParameters(Scheduling):
    """Parameters of the simulated robot and its ground.

    Other bounds are checked by the records that these values fill.

    Raises:
        ValueError: `state_rate` is no divisor of 1000 Hz or below 50 Hz.
    """

    robot: str = field(DEFAULT_ROBOT, "a shipped robot, or the path of a robot.yaml")
    keyframe: str = field("lie", "posture at the start: lie or stand")
    state_rate: int = field(200, "rate of the states, Hz: a divisor of 1000, 50 at least")
    publish_tf: bool = field(False, "whether to publish the true transform from odom to base_link")
    seed: int = field(_CONFIG.seed.default, "seed of sensor and torque noise")
    actuator_file: str = field("", "actuator model, YAML; empty: the robot's")
    world: str = field(
        "", f"world around the robot: a YAML file, or {', '.join(SHIPPED_WORLDS)}; empty: none"
    )
    terrain: str = field(_TERRAIN.kind, f"the ground: {', '.join(KINDS)}", one_of=KINDS)
    slope: float = field(
        _TERRAIN.slope, f"inclination of the ground, rad, rising along x; 0 with slope: {DEFAULT_SLOPE_RAD}"
    )
    roughness: float = field(_TERRAIN.roughness, "rough ground: bound of its heights, m")
    wavelength: float = field(_TERRAIN.wavelength, "rough ground: distance from hump to hollow, m")
    terrain_seed: int = field(_TERRAIN.seed, "rough ground: its seed")
    friction: tuple[float, ...] = field(
        4 * (_CONFIG.friction.default,), "sliding friction of the feet: one number, or FR, FL, RR, RL"
    )
    payload: float = field(_CONFIG.payload.default, "mass on the trunk, kg; negative: a lighter trunk")
    payload_position: tuple[float, ...] = field(
        _CONFIG.payload_position.default, "centre of that mass in the trunk frame, m"
    )
    hung: bool = field(_CONFIG.suspended.default, "whether the trunk is held in the air, as on a stand")
    watchdog: float = field(_CONFIG.watchdog.default, "s without a command after which the drives brake")
    watchdog_kd: float = field(_CONFIG.watchdog_kd.default, "gain of that brake, N m s/rad")
    noise_q: float = field(_NOISE.q, "standard deviation of q, rad")
    noise_dq: float = field(_NOISE.dq, "standard deviation of dq, rad/s")
    noise_angular_velocity: float = field(_NOISE.angular_velocity, "of the gyroscope, rad/s")
    noise_linear_acceleration: float = field(_NOISE.linear_acceleration, "of the accelerometer, m/s^2")
    noise_orientation: float = field(_NOISE.orientation, "of the orientation, rad an axis")

    def __attrs_post_init__(self) -> None:
        if not 50 <= self.state_rate <= 1000 or 1000 % self.state_rate:
            raise ValueError(f"state_rate is {self.state_rate} Hz, expected a divisor of 1000, 50 at least")

    @property
    def period(self) -> int:
        """Simulated time between two states, ms."""
        return 1000 // self.state_rate

    def make_loop(
        self, simulator: Simulator, publish: PublishState, report_waiting: ReportWaiting
    ) -> SimulationLoop:
        """Create the loop that runs this robot: in real time, without waiting for a controller.

        Args:
            simulator: The simulated robot.
            publish: Receives states, see `SimulationLoop`.
            report_waiting: Unused here: the UDP protocol of a board has no message for a pause.

        Returns:
            The loop, not yet running.
        """
        return SimulationLoop(simulator, publish, period=self.period, answer_timeout=0.0)

    def config(self) -> SimulatorConfig:
        """Create the configuration of the simulator.

        Returns:
            Configuration with terrain, world, noise and actuator model.

        Raises:
            ValueError: A parameter is out of its range, or a file cannot be read.
        """
        robot = load_robot(self.robot)
        return SimulatorConfig(
            robot=robot,
            actuator=self._actuator(robot),
            terrain=self.make_terrain(self.terrain, self.slope),
            world=World.load(self.world) if self.world else None,
            noise=SensorNoise(
                self.noise_q,
                self.noise_dq,
                self.noise_angular_velocity,
                self.noise_linear_acceleration,
                self.noise_orientation,
            ),
            seed=self.seed,
            friction=np.array(self.friction),
            payload=self.payload,
            payload_position=np.array(self.payload_position),
            suspended=self.hung,
            watchdog=self.watchdog,
            watchdog_kd=self.watchdog_kd,
        )

    def make_terrain(self, kind: str, slope: float) -> Terrain:
        """Create a terrain with the roughness of the parameters.

        Args:
            kind: `flat`, `slope` or `rough`.
            slope: Inclination, rad; 0 with `slope`: `DEFAULT_SLOPE_RAD`.

        Returns:
            The terrain.

        Raises:
            ValueError: The kind is unknown, or a number is out of its range.
        """
        if kind == "slope":
            slope = slope or DEFAULT_SLOPE_RAD
        return Terrain(kind, slope, self.roughness, self.wavelength, seed=self.terrain_seed)

    def _actuator(self, robot: Robot) -> ActuatorParameters:
        if not self.actuator_file:
            return ActuatorParameters.of(robot)
        try:
            return ActuatorParameters.load(robot, self.actuator_file)
        except OSError as error:
            raise ValueError(f"actuator_file: cannot read {self.actuator_file}: {error.strerror}") from error


@attrs.frozen(kw_only=True)
class SimParameters(PlantParameters):
    """Parameters of the node `sim_node`: the simulation may wait for commands.

    Raises:
        ValueError: A mode or a timeout is out of its range.
    """

    mode: str = field(
        "realtime", f"how time passes: {', '.join(MODES)}; lockstep waits for each LowCmd", one_of=MODES
    )
    answer_timeout: float = field(
        1.0, "s that simulated time waits for an answer; lockstep then sends the state again"
    )

    def __attrs_post_init__(self) -> None:
        super().__attrs_post_init__()
        if not 0.0 < self.answer_timeout < 3600.0:
            raise ValueError(f"answer_timeout is {self.answer_timeout} s, expected a time above 0")

    @override
    def make_loop(
        self, simulator: Simulator, publish: PublishState, report_waiting: ReportWaiting
    ) -> SimulationLoop:
        return SimulationLoop(
            simulator, publish, self.mode, self.period, self.answer_timeout, report_waiting=report_waiting
        )


@attrs.frozen(kw_only=True)
class BoardParameters(PlantParameters, NetworkConfig):
    """Parameters of the node `board`: address and network faults."""

    state_rate: int = field(1000, "rate of the states, Hz: a divisor of 1000, 50 at least")
    address: str = field("127.0.0.1", "IP address on which the board listens")
    port: int = field(8007, "UDP port on which the board listens; 0: any that is free")
    dds_domain: int = field(1, "DDS domain of a Go2", at_least=0, at_most=MAX_DOMAIN, whole=True)
    interface: str = field("lo", "network interface of a Go2; empty: any")
    joint_zeros: tuple[float, ...] = field(12 * (0.0,), "reading of the encoders at zero, rad")
    imu_mounting: tuple[float, ...] = field((0.0, 0.0), "tilt of the IMU about x and y, rad")

    def calibration(self) -> Calibration:
        """Create the calibration errors of the simulated sensors.

        Returns:
            Joint zeros and IMU mounting.

        Raises:
            CalibrationError: A value is out of its range.
        """
        return Calibration(np.array(self.joint_zeros), np.array(self.imu_mounting))
