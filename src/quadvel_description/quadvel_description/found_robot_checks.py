"""Checks of a robot found in a file: what is turned, missing, asymmetric or of the wrong shape."""

from __future__ import annotations

import re
from collections.abc import Iterator

import attrs
import numpy as np

from .found_robot import FoundRobot
from .inertia import Inertial
from .quadruped import KINDS, LEGS

MAX_OFFSET = 0.01
"""Largest distance of a joint or foot from the straight leg of our kinematics, m."""
MAX_LENGTH_DIFFERENCE = 0.001
"""Largest difference of the lengths of two legs, m."""
_SAME_MASS, _SAME_MOMENTS = 0.01, 0.05  # relative differences of left and right
_SAME_PLACE = 0.001  # m
_MIRROR = np.array([1.0, -1.0, 1.0])


@attrs.frozen
class Finding:
    """A result of a check.

    Attributes:
        code: Name of the check.
        text: What was found, and what to do.
        fatal: Whether no folder can be written from this file.
    """

    code: str
    text: str
    fatal: bool = False


def check_found_robot(found: FoundRobot) -> list[Finding]:
    """Check a robot.

    Args:
        found: The robot.

    Returns:
        What its user should know, in the order of the checks; empty: nothing.
    """
    checks = (_turned, _names, _limits, _feet_and_imu, _shape, _symmetry, _plausible)
    return [finding for check in checks for finding in check(found)]


def _turned(found: FoundRobot) -> Iterator[Finding]:
    """Report joints that turn against our convention."""
    if turned := [joint.source for joint in found.joints if joint.sign < 0]:
        yield Finding(
            "sign",
            f"{', '.join(turned)} turn against our convention (hip +x, thigh and calf +y): the robot's "
            "angles, speeds and torques need the other sign",
        )


def _names(found: FoundRobot) -> Iterator[Finding]:
    """Report names that state another leg than their place."""
    for joint in found.joints:
        if (match := re.match(r"(FR|FL|RR|RL|HR|HL)[_-]", joint.source.upper())) is None:
            continue
        stated = match[1].replace("H", "R", 1)
        if stated != joint.name[:2]:
            yield Finding(
                "names",
                f"{joint.source} is at the place of {joint.name[:2]}: does x of the trunk point forward?",
            )


def _limits(found: FoundRobot) -> Iterator[Finding]:
    """Report limits that the file does not state."""
    kinds = (("range", "lower"), ("torque", "torque"), ("speed", "speed"))
    for kind, attribute in kinds:
        missing = [joint.source for joint in found.joints if not np.isfinite(getattr(joint, attribute))]
        if missing:
            who = "all joints" if len(missing) == len(found.joints) else ", ".join(missing)
            yield Finding(f"{kind}_limit", f"the file states no limit of {kind} for {who}", kind == "range")


def _feet_and_imu(found: FoundRobot) -> Iterator[Finding]:
    """Report missing feet and a missing IMU."""
    missing = [leg for leg, foot in zip(LEGS, found.feet, strict=True) if np.isnan(foot).any()]
    if missing:
        yield Finding(
            "feet",
            f"no collision sphere on the calf, or on the link fixed to it, of {', '.join(missing)}: add one for each foot",
            True,
        )
    elif np.ptp(found.foot_radii) > MAX_LENGTH_DIFFERENCE:
        yield Finding("feet", f"radii {found.foot_radii.tolist()} m differ, expected one radius", True)
    if found.imu is None:
        yield Finding("imu", "no site or link with 'imu' in its name: the middle of the trunk is taken")


def _shape(found: FoundRobot) -> Iterator[Finding]:
    """Report legs that are not straight down at zero angles, or of different lengths."""
    hips, thighs, calves = np.moveaxis(found.anchors, 1, 0)
    places = (
        ("thigh", thighs - hips, (0, 2)),
        ("calf", calves - thighs, (0, 1)),
        ("foot", found.feet - calves, (0, 1)),
    )
    for kind, offsets, zero in places:
        aside = np.abs(offsets[:, list(zero)]).max()
        along = "next to its hip joint" if kind == "thigh" else "straight below the joint before"
        if aside > MAX_OFFSET or (kind != "thigh" and (offsets[:, 2] >= 0).any()):
            yield Finding(
                "zero_posture",
                f"{kind}: found {aside * 1000:.0f} mm away from its line at zero angles, expected it {along}",
                True,
            )
        elif aside > 1e-6:
            yield Finding("zero_posture", f"{kind}: moved by {aside * 1000:.1f} mm, to be {along}")
        if kind != "thigh" and np.ptp(offsets[:, 2]) > MAX_LENGTH_DIFFERENCE:
            lengths = (-offsets[:, 2]).round(4).tolist()
            yield Finding("lengths", f"{kind}: found {lengths} m, expected the same on all legs", True)


def _symmetry(found: FoundRobot) -> Iterator[Finding]:
    """Report masses and inertias that differ between left and right."""
    joints = {joint.name: joint for joint in found.joints}
    for end in ("F", "R"):
        for kind in KINDS:
            right, left = (joints[f"{end}{side}_{kind}_joint"] for side in "RL")
            if np.abs(left.anchor * _MIRROR - right.anchor).max() > _SAME_PLACE:
                yield Finding("symmetry", f"{right.source} and {left.source} are not at mirrored places")
            if difference := _difference(right.inertial, left.inertial):
                yield Finding("symmetry", f"links of {right.source} and {left.source}: {difference}")
    if abs(found.trunk.com[1]) > _SAME_PLACE:
        text = f"centre of mass of the trunk {found.trunk.com[1] * 1000:.1f} mm to the left"
        yield Finding("symmetry", text)


def _difference(right: Inertial, left: Inertial) -> str:
    """Describe how far a link is from the mirror image of its partner; empty: not."""
    if abs(left.mass - right.mass) > _SAME_MASS * right.mass:
        return f"masses {right.mass:.3f} and {left.mass:.3f} kg"
    if (distance := np.abs(left.com * _MIRROR - right.com).max()) > _SAME_PLACE:
        return f"centres of mass differ by {distance * 1000:.1f} mm after mirroring"
    mirrored = left.tensor * np.outer(_MIRROR, _MIRROR)
    share = np.abs(mirrored - right.tensor).max() / np.linalg.eigvalsh(right.tensor)[-1]
    return f"inertias differ by {share:.0%} after mirroring" if share > _SAME_MOMENTS else ""


def _plausible(found: FoundRobot) -> Iterator[Finding]:
    """Report masses and inertias that a rigid link of this robot cannot have."""
    # The radius of gyration sqrt(I / m) of a body is at most its largest distance from its centre.
    reach = float(np.ptp(found.anchors.reshape(-1, 3), axis=0).max())
    links = [(joint.source, joint.inertial) for joint in found.joints]
    for name, inertial in [("trunk", found.trunk), *links]:
        gyration = np.sqrt(np.linalg.eigvalsh(inertial.tensor)[-1] / inertial.mass)
        if gyration > reach or np.linalg.norm(inertial.com) > reach:
            yield Finding(
                "inertia",
                f"link of {name}: radius of gyration {gyration:.2f} m, centre of mass "
                f"{np.linalg.norm(inertial.com):.2f} m away, in a robot of {reach:.2f} m: check the units",
            )
        if name != "trunk" and inertial.mass > found.trunk.mass:
            yield Finding("mass", f"link of {name}: {inertial.mass:.2f} kg, heavier than the trunk")
