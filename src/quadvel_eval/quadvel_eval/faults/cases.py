"""The cases of the campaign and their oracles: what has to be named, how the robot has to end, and how soon."""

from __future__ import annotations

import attrs

MODES = ("stand_up", "stance", "walk", "lie_down")


@attrs.frozen
class Case:
    """One component, one kind of fault, one mode.

    named: the names of the table of faults of which one has to be found, none where nothing is to be found; named_within: s.
    ends: "damping", "stance", "stopped" (one of these two: without an IMU not every robot comes to a stand), "stands" (the policy
    stands, as without a command), "goes on" (as if nothing were), or "any" (it may go on or stop, and does not fall without a
    word); safe_within: s until it is there.
    """

    component: str
    kind: str
    mode: str
    named: tuple[str, ...]
    named_within: float
    ends: str
    safe_within: float

    @property
    def name(self) -> str:
        """As one writes it."""
        return f"{self.component} {self.kind} {self.mode}"


def _cases(
    component: str,
    kind: str,
    modes: tuple[str, ...],
    named: tuple[str, ...],
    within: float,
    ends: str,
    safe: float | None = None,
) -> list[Case]:
    return [
        Case(component, kind, mode, named, within, ends, within + 0.01 if safe is None else safe)
        for mode in modes
    ]


WALK = ("walk",)
STALE = ("state_stale",)
UNFIT = ("state_not_finite", "attitude_not_unit", *STALE)
"""What is wrong with states none of which can be used"""
FALLS = ("tilted", "joint_out_of_range", "joint_too_fast", "drive_does_not_answer")
"""What a robot that nobody commands any more, or too late, is seen to do"""
ENCODER = (
    "encoder_inconsistent",
    "encoder_frozen",
    "joint_out_of_range",
    "joint_too_fast",
    "drive_does_not_answer",
)
STOP = 1.3  # s in which the policy brakes and the robot stands

CASES: list[Case] = [
    *_cases("low_state", "off", MODES, STALE, 0.08, "damping"),
    *_cases("low_state", "stuck", MODES, ("state_frozen",), 0.04, "damping"),
    *_cases("low_state", "garbage", MODES, (*UNFIT, *ENCODER, "imu_inconsistent"), 0.1, "damping"),
    *_cases("low_state", "wrong", MODES, ("encoder_inconsistent",), 0.02, "damping"),
    *_cases("low_state", "slow", MODES, STALE, 0.2, "damping"),
    *_cases("low_state", "delayed", MODES, STALE, 0.1, "damping"),
    *_cases("low_state", "intermittent", MODES, (), 0.0, "goes on"),
    *_cases("low_state", "duplicated", MODES, (), 0.0, "goes on"),
    *_cases("low_cmd", "off", MODES, FALLS, 1.0, "damping", 0.05),
    *_cases("low_cmd", "stuck", WALK, FALLS, 1.0, "damping", 0.2),
    *_cases("low_cmd", "slow", WALK, FALLS, 1.0, "damping", 0.2),
    *_cases("low_cmd", "delayed", WALK, (), 0.0, "any"),
    *_cases("low_cmd", "intermittent", MODES, (), 0.0, "goes on"),
    *_cases("low_cmd", "duplicated", MODES, (), 0.0, "goes on"),
    *_cases("estimate", "off", WALK, ("estimate_stale",), 0.1, "goes on"),
    *_cases("estimate", "stuck", WALK, (), 0.0, "goes on"),
    *_cases("estimate", "garbage", WALK, ("estimate_stale", "estimate_wrong"), 0.3, "goes on"),
    *_cases("estimate", "wrong", WALK, ("estimate_wrong",), 0.15, "goes on"),
    *_cases("estimate", "slow", WALK, ("estimate_stale",), 0.2, "goes on"),
    *_cases("estimate", "delayed", WALK, ("estimate_stale",), 0.15, "goes on"),
    *_cases("estimate", "intermittent", WALK, (), 0.0, "goes on"),
    *_cases("estimate", "duplicated", WALK, (), 0.0, "goes on"),
    *_cases("command", "off", WALK, ("command_stale",), 0.6, "stands", 1.6),
    *_cases("command", "stuck", WALK, (), 0.0, "goes on"),
    *_cases("command", "garbage", WALK, (), 0.0, "any"),
    *_cases("command", "wrong", WALK, ("command_out_of_range",), 0.1, "any"),
    *_cases("command", "slow", WALK, (), 0.0, "goes on"),
    *_cases("command", "delayed", WALK, (), 0.0, "goes on"),
    *_cases("command", "intermittent", WALK, (), 0.0, "goes on"),
    *_cases("command", "duplicated", WALK, (), 0.0, "goes on"),
    *_cases("encoder", "off", WALK, ENCODER, 0.4, "damping"),
    *_cases("encoder", "stuck", WALK, ENCODER, 0.4, "damping"),
    *_cases("encoder", "garbage", MODES, ENCODER, 0.05, "damping"),
    *_cases("encoder", "wrong", MODES, ENCODER, 0.02, "damping"),
    *_cases("encoder", "slow", WALK, ENCODER, 0.5, "damping"),
    *_cases("encoder", "delayed", WALK, (), 0.0, "any"),
    *_cases("encoder", "intermittent", WALK, (), 0.0, "any"),  # a hip is at zero anyway
    *_cases("imu", "off", MODES, ("attitude_not_unit",), 0.08, "damping"),
    *_cases("imu", "stuck", WALK, ("imu_frozen",), 0.15, "stopped", STOP),
    *_cases("imu", "garbage", MODES, (*UNFIT, "imu_inconsistent", "tilted"), 0.1, "damping"),
    *_cases("imu", "slow", WALK, ("imu_frozen",), 0.25, "any"),
    *_cases("imu", "delayed", WALK, (), 0.0, "any"),
    *_cases("imu", "intermittent", WALK, (), 0.0, "any"),
    *_cases("orientation", "wrong", MODES, ("imu_inconsistent",), 0.02, "damping"),
    *_cases("orientation", "stuck", WALK, (), 0.0, "any"),
    *_cases("gyroscope", "off", WALK, (), 0.0, "any"),
    *_cases("gyroscope", "stuck", WALK, (), 0.0, "any"),
    *_cases("gyroscope", "wrong", MODES, ("imu_inconsistent",), 0.25, "damping"),
    *_cases("gyroscope", "garbage", MODES, ("imu_inconsistent",), 0.5, "damping"),
    *_cases("accelerometer", "stuck", WALK, (), 0.0, "any"),
    *_cases("accelerometer", "off", WALK, (), 0.0, "any"),
    *_cases("accelerometer", "wrong", WALK, ("accelerometer_implausible",), 0.4, "stance", 1.7),
    *_cases("accelerometer", "garbage", WALK, ("accelerometer_implausible",), 0.8, "stance", 2.2),
    *_cases("torque", "wrong", MODES, ("drive_does_not_answer",), 0.15, "damping"),
    *_cases("torque", "garbage", WALK, ("drive_does_not_answer",), 1.5, "damping"),
    *_cases("foot", "off", WALK, ("foot_force_frozen",), 1.1, "goes on"),
    *_cases("foot", "stuck", WALK, ("foot_force_frozen",), 1.1, "goes on"),
    *_cases("foot", "garbage", WALK, (), 0.0, "goes on"),
    *_cases("drive", "off", WALK, (), 0.0, "any"),
    *_cases("drive", "stuck", WALK, (), 0.0, "any"),
    *_cases("network", "off", MODES, STALE, 0.08, "damping", 0.05),
    *_cases("network", "slow", WALK, STALE, 0.2, "damping"),
    *_cases("network", "intermittent", MODES, (), 0.0, "goes on"),
    *_cases("network", "duplicated", MODES, (), 0.0, "goes on"),
    *_cases("network", "delayed", MODES, (), 0.0, "goes on"),
    *_cases("controller", "off", MODES, (), 0.0, "damping", 0.03),
    *_cases("controller", "stuck", MODES, (), 0.0, "damping", 0.03),
    *_cases("controller", "intermittent", WALK, (), 0.0, "any"),
    *_cases("estimator", "off", WALK, ("estimate_stale",), 0.1, "goes on"),
    *_cases("estimator", "stuck", WALK, ("estimate_stale",), 0.1, "goes on"),
    *_cases("estimator", "intermittent", WALK, (), 0.0, "goes on"),
    *_cases("mux", "off", WALK, ("command_stale",), 0.6, "stands", 1.6),
    *_cases("mux", "stuck", WALK, ("command_stale",), 0.6, "stands", 1.6),
    *_cases("planner", "off", WALK, (), 0.0, "stands", 2.0),
    *_cases("planner", "stuck", WALK, (), 0.0, "stands", 2.0),
    *_cases("clock", "wrong", MODES, (), 0.0, "goes on"),
    *_cases("processor", "slow", WALK, ("overruns",), 0.2, "stance", 1.5),
]
