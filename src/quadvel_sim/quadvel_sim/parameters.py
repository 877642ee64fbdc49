"""The parameters of the nodes `sim_node` and `board`, and the simulation that they ask for. Knows no ROS."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np

from quadvel_actuator import ActuatorParameters
from quadvel_driver.calibration import Calibration
from quadvel_nodes.scheduling import Scheduling
from quadvel_sim.bad_network import NetworkConfig
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.loop import MODES, Publish, SayWaiting, SimulationLoop
from quadvel_sim.simulator import Simulator
from quadvel_sim.terrain import KINDS, Terrain
from quadvel_sim.world import SHIPPED, World

_NOISE, _TERRAIN, _CONFIG = SensorNoise(), Terrain(), SimulatorConfig()


def _parameter(default: Any, description: str) -> Any:
    return attrs.field(default=default, metadata={"description": description})


@attrs.frozen(kw_only=True, slots=False)  # to stand beside another base
class PlantParameters(Scheduling):
    """The simulated robot and its ground; what each record of the simulation may hold is that record's own matter."""

    keyframe: str = _parameter("lie", "posture at the start: lie or stand")
    state_rate: int = _parameter(200, "rate of the states, Hz: a divisor of 1000, 50 at least")
    publish_tf: bool = _parameter(False, "whether to publish the true transform from odom to base_link")
    seed: int = _parameter(_CONFIG.seed, "seed of sensor and torque noise")
    actuator_file: str = _parameter("", "actuator model, YAML; empty: the shipped AlienGo")
    world: str = _parameter(
        "", f"what is around the robot: a YAML file, or {', '.join(SHIPPED)}; empty: nothing"
    )
    terrain: str = _parameter(_TERRAIN.kind, f"the ground: {', '.join(KINDS)}")
    slope: float = _parameter(_TERRAIN.slope, "inclination of the ground, rad, rising along x")
    roughness: float = _parameter(_TERRAIN.roughness, "rough ground: bound of its heights, m")
    wavelength: float = _parameter(_TERRAIN.wavelength, "rough ground: distance from hump to hollow, m")
    terrain_seed: int = _parameter(_TERRAIN.seed, "rough ground: its seed")
    friction: tuple[float, ...] = _parameter(
        tuple(_CONFIG.friction.tolist()), "sliding friction of the feet: one number, or FR, FL, RR, RL"
    )
    payload: float = _parameter(_CONFIG.payload, "mass on the trunk, kg; below zero it is taken off")
    payload_position: tuple[float, ...] = _parameter(
        tuple(_CONFIG.payload_position.tolist()), "centre of that mass in the trunk frame, m"
    )
    hung: bool = _parameter(_CONFIG.hung, "whether the trunk is held in the air, as on a stand")
    watchdog: float = _parameter(_CONFIG.watchdog, "s without a command after which the drives brake")
    watchdog_kd: float = _parameter(_CONFIG.watchdog_kd, "gain of that brake, N m s/rad")
    noise_q: float = _parameter(_NOISE.q, "standard deviation of q, rad")
    noise_dq: float = _parameter(_NOISE.dq, "standard deviation of dq, rad/s")
    noise_angular_velocity: float = _parameter(_NOISE.angular_velocity, "of the gyroscope, rad/s")
    noise_linear_acceleration: float = _parameter(_NOISE.linear_acceleration, "of the accelerometer, m/s^2")
    noise_orientation: float = _parameter(_NOISE.orientation, "of the orientation, rad an axis")

    def __attrs_post_init__(self) -> None:
        if not 50 <= self.state_rate <= 1000 or 1000 % self.state_rate:
            raise ValueError(f"state_rate is {self.state_rate} Hz, expected a divisor of 1000, 50 at least")

    @property
    def period(self) -> int:
        """Simulated ms from state to state."""
        return 1000 // self.state_rate

    def loop(self, simulator: Simulator, publish: Publish, say_waiting: SayWaiting) -> SimulationLoop:
        """The loop that runs this robot: in real time, and it waits for nobody; nor has a board words for a pause."""
        return SimulationLoop(simulator, publish, period=self.period, answer_timeout=0.0)

    def config(self) -> SimulatorConfig:
        """The simulation asked for. ValueError names what it cannot be."""
        return SimulatorConfig(
            actuator=self._actuator(),
            terrain=self.ground(self.terrain, self.slope),
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
            hung=self.hung,
            watchdog=self.watchdog,
            watchdog_kd=self.watchdog_kd,
        )

    def ground(self, kind: str, slope: float) -> Terrain:
        """Ground of a kind, inclined by `slope` (rad), with the roughness asked for. ValueError names what it cannot be."""
        return Terrain(kind, slope, self.roughness, self.wavelength, seed=self.terrain_seed)

    def _actuator(self) -> ActuatorParameters:
        if not self.actuator_file:
            return ActuatorParameters.default()
        try:
            return ActuatorParameters.load(self.actuator_file)
        except OSError as error:
            raise ValueError(f"actuator_file: cannot read {self.actuator_file}: {error.strerror}") from error


@attrs.frozen(kw_only=True)
class SimParameters(PlantParameters):
    """Those of `sim_node`: time may wait for commands."""

    mode: str = _parameter("realtime", f"how time passes: {', '.join(MODES)}; lockstep waits for each LowCmd")
    answer_timeout: float = _parameter(
        1.0, "s that simulated time stands still for an answer; lockstep then sends the state again"
    )

    def __attrs_post_init__(self) -> None:
        super().__attrs_post_init__()
        if self.mode not in MODES:
            raise ValueError(f"mode is {self.mode!r}, expected one of {', '.join(MODES)}")
        if not 0.0 < self.answer_timeout < 3600.0:
            raise ValueError(f"answer_timeout is {self.answer_timeout} s, expected a time above 0")

    def loop(self, simulator: Simulator, publish: Publish, say_waiting: SayWaiting) -> SimulationLoop:
        """The loop that runs this robot, in the mode that was asked for."""
        return SimulationLoop(
            simulator, publish, self.mode, self.period, self.answer_timeout, say_waiting=say_waiting
        )


@attrs.frozen(kw_only=True)
class BoardParameters(PlantParameters, NetworkConfig):
    """Those of `board`: where it listens, and how bad the network is."""

    state_rate: int = _parameter(1000, "rate of the states, Hz: a divisor of 1000, 50 at least")
    address: str = _parameter("127.0.0.1", "IP address on which the board listens")
    port: int = _parameter(8007, "UDP port on which the board listens; 0: any that is free")
    joint_zeros: tuple[float, ...] = _parameter(12 * (0.0,), "what encoders show at zero, rad")
    imu_mounting: tuple[float, ...] = _parameter((0.0, 0.0), "how the IMU leans: about x and about y, rad")

    def off(self) -> Calibration:
        """What is off with this robot's sensors. CalibrationError names what it cannot be."""
        return Calibration(np.array(self.joint_zeros), np.array(self.imu_mounting))
