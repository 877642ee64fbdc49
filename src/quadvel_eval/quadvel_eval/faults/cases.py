"""Cases of the fault campaign with their oracles: expected findings, expected end, and deadlines.

This module only lists them. `injection` makes the faults, and `campaign` runs and judges the cases.
"""

from __future__ import annotations

import attrs

MODES = ("stand_up", "stance", "walk", "lie_down")


@attrs.frozen
class Case:
    """One fault in one mode, with its oracle.

    Attributes:
        component: Faulty component, see `injection.COMPONENTS`.
        kind: Kind of fault, see `injection.KINDS`.
        mode: Mode of the controller at the fault, one of MODES.
        expected_findings: Names in docs/faults.md. At least one of these findings must be reported;
            others may be, too. Empty: none is required.
        finding_deadline: Longest time from the fault to the finding, s.
        expected_end: State that must be reached: "damping"; "stance"; "stopped" (one of these two, because without an IMU some
            robots cannot reach a stand); "stands" (the policy stands, as without a command);
            "goes on" (the fault has no effect); "any" (continue or stop, but no fall without a
            finding).
        safe_deadline: Longest time from the fault to the expected end, s.
    """

    component: str
    kind: str
    mode: str
    expected_findings: tuple[str, ...]
    finding_deadline: float
    expected_end: str
    safe_deadline: float

    @property
    def name(self) -> str:
        """Component, kind and mode, separated by spaces."""
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
    """One case per mode; the safe deadline defaults to 10 ms after the finding."""
    return [
        Case(component, kind, mode, named, within, ends, within + 0.01 if safe is None else safe)
        for mode in modes
    ]


WALK_ONLY = ("walk",)
STALE = ("state_stale",)
UNUSABLE_STATE = ("state_not_finite", "attitude_not_unit", *STALE)
"""Findings for a stream of unusable states."""
UNCOMMANDED_SYMPTOMS = ("tilted", "joint_out_of_range", "joint_too_fast", "drive_does_not_answer")
"""Findings for a robot without commands, or with late ones."""
ENCODER = (
    "encoder_inconsistent",
    "encoder_frozen",
    "joint_out_of_range",
    "joint_too_fast",
    "drive_does_not_answer",
)
STOPPING_TIME_S = 1.3  # in which the policy brakes the robot to a stand

CASES: list[Case] = [
    *_cases("low_state", "off", MODES, STALE, 0.08, "damping"),
    *_cases("low_state", "stuck", MODES, ("state_frozen",), 0.04, "damping"),
    *_cases("low_state", "garbage", MODES, (*UNUSABLE_STATE, *ENCODER, "imu_inconsistent"), 0.1, "damping"),
    *_cases("low_state", "wrong", MODES, ("encoder_inconsistent",), 0.02, "damping"),
    *_cases("low_state", "slow", MODES, STALE, 0.2, "damping"),
    *_cases("low_state", "delayed", MODES, STALE, 0.1, "damping"),
    *_cases("low_state", "intermittent", MODES, (), 0.0, "goes on"),
    *_cases("low_state", "duplicated", MODES, (), 0.0, "goes on"),
    *_cases("low_cmd", "off", MODES, UNCOMMANDED_SYMPTOMS, 1.0, "damping", 0.05),
    *_cases("low_cmd", "stuck", WALK_ONLY, UNCOMMANDED_SYMPTOMS, 1.0, "damping", 0.2),
    *_cases("low_cmd", "slow", WALK_ONLY, UNCOMMANDED_SYMPTOMS, 1.0, "damping", 0.2),
    *_cases("low_cmd", "delayed", WALK_ONLY, (), 0.0, "any"),
    *_cases("low_cmd", "intermittent", MODES, (), 0.0, "goes on"),
    *_cases("low_cmd", "duplicated", MODES, (), 0.0, "goes on"),
    *_cases("estimate", "off", WALK_ONLY, ("estimate_stale",), 0.1, "goes on"),
    *_cases("estimate", "stuck", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("estimate", "garbage", WALK_ONLY, ("estimate_stale", "estimate_wrong"), 0.3, "goes on"),
    *_cases("estimate", "wrong", WALK_ONLY, ("estimate_wrong",), 0.15, "goes on"),
    *_cases("estimate", "slow", WALK_ONLY, ("estimate_stale",), 0.2, "goes on"),
    *_cases("estimate", "delayed", WALK_ONLY, ("estimate_stale",), 0.15, "goes on"),
    *_cases("estimate", "intermittent", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("estimate", "duplicated", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("command", "off", WALK_ONLY, ("command_stale",), 0.6, "stands", 1.6),
    *_cases("command", "stuck", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("command", "garbage", WALK_ONLY, (), 0.0, "any"),
    *_cases("command", "wrong", WALK_ONLY, ("command_out_of_range",), 0.1, "any"),
    *_cases("command", "slow", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("command", "delayed", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("command", "intermittent", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("command", "duplicated", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("encoder", "off", WALK_ONLY, ENCODER, 0.4, "damping"),
    *_cases("encoder", "stuck", WALK_ONLY, ENCODER, 0.4, "damping"),
    *_cases("encoder", "garbage", MODES, ENCODER, 0.05, "damping"),
    *_cases("encoder", "wrong", MODES, ENCODER, 0.02, "damping"),
    *_cases("encoder", "slow", WALK_ONLY, ENCODER, 0.5, "damping"),
    *_cases("encoder", "delayed", WALK_ONLY, (), 0.0, "any"),
    *_cases(
        "encoder", "intermittent", WALK_ONLY, (), 0.0, "any"
    ),  # an intermittent hip reads 0, near its true value
    *_cases("imu", "off", MODES, ("attitude_not_unit",), 0.08, "damping"),
    *_cases("imu", "stuck", WALK_ONLY, ("imu_frozen",), 0.15, "stopped", STOPPING_TIME_S),
    *_cases("imu", "garbage", MODES, (*UNUSABLE_STATE, "imu_inconsistent", "tilted"), 0.1, "damping"),
    *_cases("imu", "slow", WALK_ONLY, ("imu_frozen",), 0.25, "any"),
    *_cases("imu", "delayed", WALK_ONLY, (), 0.0, "any"),
    *_cases("imu", "intermittent", WALK_ONLY, (), 0.0, "any"),
    *_cases("orientation", "wrong", MODES, ("imu_inconsistent",), 0.02, "damping"),
    *_cases("orientation", "stuck", WALK_ONLY, (), 0.0, "any"),
    *_cases("gyroscope", "off", WALK_ONLY, (), 0.0, "any"),
    *_cases("gyroscope", "stuck", WALK_ONLY, (), 0.0, "any"),
    *_cases("gyroscope", "wrong", MODES, ("imu_inconsistent",), 0.25, "damping"),
    *_cases("gyroscope", "garbage", MODES, ("imu_inconsistent",), 0.5, "damping"),
    *_cases("accelerometer", "stuck", WALK_ONLY, (), 0.0, "any"),
    *_cases("accelerometer", "off", WALK_ONLY, (), 0.0, "any"),
    *_cases("accelerometer", "wrong", WALK_ONLY, ("accelerometer_implausible",), 0.4, "stance", 1.7),
    *_cases("accelerometer", "garbage", WALK_ONLY, ("accelerometer_implausible",), 0.8, "stance", 2.2),
    *_cases("torque", "wrong", MODES, ("drive_does_not_answer",), 0.15, "damping"),
    *_cases("torque", "garbage", WALK_ONLY, ("drive_does_not_answer",), 1.5, "damping"),
    *_cases("foot", "off", WALK_ONLY, ("foot_force_frozen",), 1.1, "goes on"),
    *_cases("foot", "stuck", WALK_ONLY, ("foot_force_frozen",), 1.1, "goes on"),
    *_cases("foot", "garbage", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("drive", "off", WALK_ONLY, (), 0.0, "any"),
    *_cases("drive", "stuck", WALK_ONLY, (), 0.0, "any"),
    *_cases("network", "off", MODES, STALE, 0.08, "damping", 0.05),
    *_cases("network", "slow", WALK_ONLY, STALE, 0.2, "damping"),
    *_cases("network", "intermittent", MODES, (), 0.0, "goes on"),
    *_cases("network", "duplicated", MODES, (), 0.0, "goes on"),
    *_cases("network", "delayed", MODES, (), 0.0, "goes on"),
    *_cases("controller", "off", MODES, (), 0.0, "damping", 0.03),
    *_cases("controller", "stuck", MODES, (), 0.0, "damping", 0.03),
    *_cases("controller", "intermittent", WALK_ONLY, (), 0.0, "any"),
    *_cases("estimator", "off", WALK_ONLY, ("estimate_stale",), 0.1, "goes on"),
    *_cases("estimator", "stuck", WALK_ONLY, ("estimate_stale",), 0.1, "goes on"),
    *_cases("estimator", "intermittent", WALK_ONLY, (), 0.0, "goes on"),
    *_cases("mux", "off", WALK_ONLY, ("command_stale",), 0.6, "stands", 1.6),
    *_cases("mux", "stuck", WALK_ONLY, ("command_stale",), 0.6, "stands", 1.6),
    *_cases("planner", "off", WALK_ONLY, (), 0.0, "stands", 2.0),
    *_cases("planner", "stuck", WALK_ONLY, (), 0.0, "stands", 2.0),
    *_cases("clock", "wrong", MODES, (), 0.0, "goes on"),
    *_cases("processor", "slow", WALK_ONLY, ("overruns",), 0.2, "stance", 1.5),
]
