"""Guards: detection of faults of a moving robot. No ROS.

GUARDS lists all guards; `faults` prints their table. The limits have a margin of at least three
over the values of walking on flat and rough ground, on randomised plants, and in logs of a real Go2
(docs/decisions/0046-guards.md).
"""

from __future__ import annotations

from ..guard import Guard
from .legs import (
    DriveDoesNotAnswer,
    EncoderFrozen,
    EncoderInconsistent,
    FootForceFrozen,
    JointOutOfRange,
    JointStuck,
    JointTooFast,
    MotorDroppedOut,
    MotorHot,
)
from .states import (
    AttitudeNotUnit,
    ControllerStopped,
    DuplicatePublisher,
    Overruns,
    StateBackInTime,
    StateFrozen,
    StateNotFinite,
    StateStale,
)
from .trunk import AccelerometerImplausible, ImuFrozen, ImuInconsistent, Tilted
from .velocity import EstimateStale, EstimateWrong, NoVelocity

GUARDS: tuple[type[Guard], ...] = (
    DuplicatePublisher,
    StateNotFinite,
    AttitudeNotUnit,
    StateBackInTime,
    ControllerStopped,
    StateStale,
    StateFrozen,
    Tilted,
    JointOutOfRange,
    JointTooFast,
    EncoderInconsistent,
    EncoderFrozen,
    ImuInconsistent,
    DriveDoesNotAnswer,
    JointStuck,
    MotorDroppedOut,
    ImuFrozen,
    AccelerometerImplausible,
    MotorHot,
    Overruns,
    NoVelocity,
    EstimateStale,
    EstimateWrong,
    FootForceFrozen,
)
"""Guards in priority order: the first active one is reported, so causes precede their consequences.
"""
