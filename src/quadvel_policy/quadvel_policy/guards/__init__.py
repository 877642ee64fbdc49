"""Guards: detection of faults of a moving robot. No ROS.

GUARDS lists all guards; `faults` prints their table. The limits have a margin of at least three
over the values of walking on flat and rough ground, on randomised plants, and in logs of a real Go2
(docs/decisions/0046-guards.md).
"""

from __future__ import annotations

from ..guard import Guard
from . import legs, states, trunk, velocity

GUARDS: tuple[type[Guard], ...] = (
    states.DuplicatePublisher,
    states.StateNotFinite,
    states.AttitudeNotUnit,
    states.StateBackInTime,
    states.ControllerStopped,
    states.StateStale,
    states.StateFrozen,
    trunk.Tilted,
    legs.JointOutOfRange,
    legs.JointTooFast,
    legs.EncoderInconsistent,
    legs.EncoderFrozen,
    trunk.ImuInconsistent,
    legs.DriveDoesNotAnswer,
    legs.JointStuck,
    legs.MotorDroppedOut,
    trunk.ImuFrozen,
    trunk.AccelerometerImplausible,
    legs.MotorHot,
    states.Overruns,
    velocity.NoVelocity,
    velocity.EstimateStale,
    velocity.EstimateWrong,
    legs.FootForceFrozen,
)
"""Guards in priority order: the first active one is reported, so causes precede their consequences.
"""
