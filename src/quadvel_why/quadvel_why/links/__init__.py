"""All causes in the order of the chain: the first one found is the answer, so causes precede their consequences."""

from __future__ import annotations

from ..cause import Cause
from . import contract, drives, estimator, ground, sensors, task, timing

CAUSES: tuple[type[Cause], ...] = (
    timing.PolicyRate,
    contract.MemoryReset,
    contract.MemoryKept,
    contract.JointOrder,
    contract.JointSign,
    contract.JointScale,
    contract.QuaternionOrder,
    contract.GyroFrame,
    contract.ObservationScale,
    contract.ObservationOrder,
    contract.ActionScale,
    contract.Gains,
    timing.RepeatedStates,
    timing.Jitter,
    timing.LongDelay,
    timing.LostCommands,
    contract.StaleObservation,
    contract.JointOffset,
    sensors.EncoderHeld,
    sensors.EncoderDropout,
    sensors.ImuHeld,
    sensors.ImuContradicts,
    contract.OtherActions,
    estimator.EstimateBias,
    estimator.EstimateScale,
    estimator.EstimateLag,
    drives.Temperature,
    drives.TorqueLimit,
    drives.SpeedTorqueLimit,
    drives.WeakDrive,
    drives.JammedJoint,
    ground.SteepGround,
    ground.RoughGround,
    ground.Slipping,
    ground.Payload,
    task.CommandOutOfRange,
)
