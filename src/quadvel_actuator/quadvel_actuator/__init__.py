"""How the joints answer: the empirical actuator model (EAM) and its parameter file."""

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters, DelayPair, Effect

__all__ = ["ActuatorModel", "ActuatorParameters", "DelayPair", "Effect"]
