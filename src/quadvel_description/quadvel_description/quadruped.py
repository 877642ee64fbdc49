"""What all robots here share: names and order of legs and joints, the side of each leg, gravity.

FR is the front right leg, FL front left, RR rear right, RL rear left. Robot files, messages,
recordings and shipped networks have the same names in the same order: a change here breaks them.
"""

from __future__ import annotations

from collections.abc import Sequence

LEGS = ("FR", "FL", "RR", "RL")
KINDS = ("hip", "thigh", "calf")
JOINT_NAMES = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in KINDS)
FRONT = {"FR": 1, "FL": 1, "RR": -1, "RL": -1}  # sign of x, which points forward
LEFT = {"FR": -1, "FL": 1, "RR": -1, "RL": 1}  # sign of y, which points to the left

GRAVITY = 9.81  # m/s^2


def joint_index(names: Sequence[str]) -> list[int]:
    """Find joints in JOINT_NAMES.

    Args:
        names: Joint names, with or without `_joint`.

    Returns:
        Index of each joint.

    Raises:
        ValueError: A name is unknown; the message names it.
    """
    index = {name: i for i, name in enumerate(JOINT_NAMES)}
    found = []
    for name in names:
        full = name if name.endswith("_joint") else f"{name}_joint"
        if full not in index:
            raise ValueError(f"joint names: found {name!r}, expected one of {', '.join(JOINT_NAMES)}")
        found.append(index[full])
    return found
