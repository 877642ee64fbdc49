"""The stand-in robot: MuJoCo behind the drives of the real one, and the node that speaks for it."""

from quadvel_sim.simulator import SensorNoise, Simulator, SimulatorConfig, Truth
from quadvel_sim.terrain import Terrain
from quadvel_sim.world import World

__all__ = ["SensorNoise", "Simulator", "SimulatorConfig", "Terrain", "Truth", "World"]
