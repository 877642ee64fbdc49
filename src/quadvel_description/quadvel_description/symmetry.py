"""Table 1 of the paper: what the robot's mirror image (across its sagittal plane) sees and does.

Extended to the command (cx, -cy, -cr, cs) and the previous action. A mirror is a signed permutation of the last axis.
"""

from __future__ import annotations

import attrs
import numpy as np

_LEG_SWAP = (1, 0, 3, 2)  # FR <-> FL, RR <-> RL


@attrs.frozen(eq=False)
class Mirror:
    """y = sign * x[..., index]; its own inverse."""

    index: np.ndarray
    sign: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return x[..., self.index] * self.sign

    def matrix(self) -> np.ndarray:
        """M with mirrored = M x, (n, n)."""
        return np.eye(len(self.index))[self.index] * self.sign[:, None]


def _signs(*signs: float) -> Mirror:
    return Mirror(np.arange(len(signs)), np.array(signs, float))


JOINTS = Mirror(np.array([3 * leg + k for leg in _LEG_SWAP for k in range(3)]), np.tile([-1.0, 1.0, 1.0], 4))
FEET = Mirror(np.array(_LEG_SWAP), np.ones(4))
PARTS = {
    "command": _signs(1, -1, -1, 1),
    "roll_pitch": _signs(-1, 1),
    "q": JOINTS,
    "dq": JOINTS,
    "linear_velocity": _signs(1, -1, 1),
    "angular_velocity": _signs(-1, 1, -1),
    "previous_action": JOINTS,
}
"""Mirror of each part of an observation, by the part's name in the policy file."""


def stack(parts: list[Mirror]) -> Mirror:
    """Mirror of the concatenation of several parts."""
    starts = np.cumsum([0] + [len(p.index) for p in parts[:-1]])
    return Mirror(
        np.concatenate([p.index + s for p, s in zip(parts, starts, strict=True)]),
        np.concatenate([p.sign for p in parts]),
    )


OBSERVATION = stack(list(PARTS.values()))


def mirror_observation(observation: np.ndarray) -> np.ndarray:
    """The paper's 48-vector as the mirrored robot sees it, (..., 48)."""
    return OBSERVATION(observation)


def mirror_joints(x: np.ndarray) -> np.ndarray:
    """Joint quantities of the mirrored robot, (..., 12)."""
    return JOINTS(x)


mirror_action = mirror_joints
"""Actions are joint targets about the symmetric nominal posture, so they mirror as joints do."""
