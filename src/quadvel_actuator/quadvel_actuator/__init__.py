"""Empirical actuator model (EAM) of the joints and its parameter file."""

from quadvel_actuator.model import ActuatorModel
from quadvel_actuator.parameters import ActuatorParameters, DelayPair, Effect

__all__ = ["ActuatorModel", "ActuatorParameters", "DelayPair", "Effect"]
