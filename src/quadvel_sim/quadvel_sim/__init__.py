"""Simulated AlienGo: MuJoCo physics, actuator model, world, laser, and ROS nodes."""

from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.simulator import Simulator, Truth
from quadvel_sim.terrain import Terrain
from quadvel_sim.world import World

__all__ = ["SensorNoise", "Simulator", "SimulatorConfig", "Terrain", "Truth", "World"]
