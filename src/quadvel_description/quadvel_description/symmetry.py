"""Left-right symmetry of the robot: mirror image across its sagittal plane (Table 1 of the paper).

Extended to the command (cx, -cy, -cr, cs) and the previous action. A mirror is a signed permutation
of the last axis.
"""

from __future__ import annotations

import attrs
import numpy as np

_LEG_SWAP = (1, 0, 3, 2)  # FR <-> FL, RR <-> RL


@attrs.frozen(eq=False)
class Mirror:
    """Signed permutation y = sign * x[..., index]; its own inverse.

    Attributes:
        index: Permutation, (n,).
        sign: Signs, (n,).
    """

    index: np.ndarray
    sign: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the mirror image of `x`, (..., n)."""
        return x[..., self.index] * self.sign

    def matrix(self) -> np.ndarray:
        """Return the mirror as a matrix.

        Returns:
            M with mirrored = M x, (n, n).
        """
        return np.eye(len(self.index))[self.index] * self.sign[:, None]


def sign_mirror(*signs: float) -> Mirror:
    """Build a mirror that changes signs only.

    Args:
        signs: The signs.

    Returns:
        The mirror.
    """
    return Mirror(np.arange(len(signs)), np.array(signs, float))


JOINTS = Mirror(np.array([3 * leg + k for leg in _LEG_SWAP for k in range(3)]), np.tile([-1.0, 1.0, 1.0], 4))
FEET = Mirror(np.array(_LEG_SWAP), np.ones(4))
MIRRORS = {
    "command": sign_mirror(1, -1, -1, 1),
    "roll_pitch": sign_mirror(-1, 1),
    "q": JOINTS,
    "dq": JOINTS,
    "linear_velocity": sign_mirror(1, -1, 1),
    "angular_velocity": sign_mirror(-1, 1, -1),
    "previous_action": JOINTS,
}
"""Mirror of each part of an observation, by the part's name in the policy file."""


def concatenate_mirrors(parts: list[Mirror]) -> Mirror:
    """Create the mirror of a concatenation.

    Args:
        parts: Mirrors of the parts.

    Returns:
        Mirror of the concatenated parts.
    """
    starts = np.cumsum([0] + [len(p.index) for p in parts[:-1]])
    return Mirror(
        np.concatenate([p.index + s for p, s in zip(parts, starts, strict=True)]),
        np.concatenate([p.sign for p in parts]),
    )


OBSERVATION = concatenate_mirrors(list(MIRRORS.values()))


def mirror_observation(observation: np.ndarray) -> np.ndarray:
    """Mirror an observation.

    Args:
        observation: The paper's observation, (..., 48).

    Returns:
        Observation of the mirrored robot, (..., 48).
    """
    return OBSERVATION(observation)


def mirror_joints(x: np.ndarray) -> np.ndarray:
    """Mirror joint quantities.

    Args:
        x: Joint positions, velocities, torques or actions, (..., 12).

    Returns:
        Those of the mirrored robot, (..., 12).
    """
    return JOINTS(x)


mirror_action = mirror_joints
"""Actions are joint targets about the symmetric nominal posture, so they mirror as joints do."""
