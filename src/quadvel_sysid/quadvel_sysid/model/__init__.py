"""Torque of the actuator model with effects, its Jacobian, its fit and its delays."""
