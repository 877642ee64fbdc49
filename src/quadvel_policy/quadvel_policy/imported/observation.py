"""Observation and action of an imported policy: terms with history, in the network's order of joints."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import override

from quadvel_description.arrays import Array
from quadvel_description.fields import field, refusal
from quadvel_description.kinematics import rotate_inverse
from quadvel_description.state import RobotState

from ..observation import JOINTS, ActionMap, Observer, Vector

DOWN = np.array([0.0, 0.0, -1.0])
MAX_HISTORY = 100
"""Largest number of steps of an observation."""
TERM_SIZES = {
    "command": 3,  # vx, vy (m/s), wz (rad/s); zero while the robot stands
    "linear_velocity": 3,  # m/s, body frame
    "angular_velocity": 3,  # rad/s, body frame
    "gravity": 3,  # unit vector of the gravity in the body frame; (0, 0, -1) if upright
    "q": JOINTS,  # rad
    "dq": JOINTS,  # rad/s
    "previous_action": JOINTS,  # output of the network at its previous step
}
"""Length of each quantity that an observation can contain."""


@attrs.frozen(kw_only=True)
class ImportedTerm:
    """One quantity of the observation: clip((value - offset) * scale, low, high), at some past steps.

    Joints are in the network's order.

    Attributes:
        name: One of TERM_SIZES.
        offset: Offset in the unit of the quantity, one number for each value.
        scale: Scale, one number for each value.
        low: Lower bounds after scaling, one number for each value; None: unbounded.
        high: Upper bounds after scaling, one number for each value; None: unbounded.
        ages: Steps of the history in the network's order; 0 is the newest.
    """

    name: str = field(one_of=tuple(TERM_SIZES))
    offset: tuple[float, ...]
    scale: tuple[float, ...]
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    ages: tuple[int, ...] = (0,)

    def __attrs_post_init__(self) -> None:
        """Refuse wrong lengths, numbers that are not finite, and ages that are no steps."""
        size = TERM_SIZES[self.name]
        for name in ("offset", "scale", "low", "high"):
            found = getattr(self, name)
            if found is not None and (len(found) != size or not np.isfinite(found).all()):
                raise refusal(self, name, found, f"{size} finite numbers for {self.name}")
        if not self.ages or min(self.ages) < 0 or max(self.ages) >= MAX_HISTORY:
            raise refusal(self, "ages", self.ages, f"steps from 0 to {MAX_HISTORY - 1}")

    @property
    def size(self) -> int:
        """Number of values in the observation."""
        return len(self.ages) * TERM_SIZES[self.name]


class ImportedObserver(Observer):
    """Builds the observation of an imported policy, with its history.

    After a reset, all steps of the history are the first observation.
    """

    def __init__(self, terms: Sequence[ImportedTerm], by_step: bool, joint_map: Sequence[int]) -> None:
        """Create an observer.

        Args:
            terms: Terms in order.
            by_step: True: all terms of a step, then the next step; False: all steps of a term, then
                the next term.
            joint_map: Index in `JOINT_NAMES` of each joint of the network, 12.
        """
        self._terms, self._by_step, self._joints = tuple(terms), by_step, list(joint_map)
        self._bounds = [
            (-np.inf if term.low is None else term.low, np.inf if term.high is None else term.high)
            for term in self._terms
        ]
        self._steps = 1 + max(max(term.ages) for term in self._terms)
        self._frames: deque[list[Array]] = deque(maxlen=self._steps)  # newest first

    @override
    def reset(self) -> None:
        self._frames.clear()

    @override
    def observe(
        self, state: RobotState, velocity: ArrayLike, command: ArrayLike, previous_action: ArrayLike
    ) -> NDArray[np.float32]:
        values = {
            "command": np.asarray(command)[:3],
            "linear_velocity": velocity,
            "angular_velocity": state.angular_velocity,
            "gravity": rotate_inverse(state.quaternion, DOWN),
            "q": state.q[self._joints],
            "dq": state.dq[self._joints],
            "previous_action": previous_action,
        }
        frame = [
            np.clip((np.asarray(values[term.name]) - term.offset) * term.scale, *bounds)
            for term, bounds in zip(self._terms, self._bounds, strict=True)
        ]
        self._frames.extendleft([frame] * (1 if self._frames else self._steps))
        if self._by_step:
            parts = [part for age in self._terms[0].ages for part in self._frames[age]]
        else:
            parts = [self._frames[age][i] for i, term in enumerate(self._terms) for age in term.ages]
        return np.concatenate(parts).astype(np.float32)


class ImportedAction(ActionMap):
    """Conversion of the network's output to joint targets: clip(offset + scale * action), rad."""

    def __init__(
        self, offset: Vector, scale: Vector, bounds: tuple[Vector, Vector], joint_map: Sequence[int]
    ) -> None:
        """Create a map.

        Args:
            offset: Joint targets of a zero action, (12,), rad.
            scale: rad per unit of the output, (12,).
            bounds: Lower and upper bounds of the targets, (12,) each, rad.
            joint_map: Index in `JOINT_NAMES` of each joint of the network, 12.
        """
        super().__init__(offset, scale)
        self._from_network = np.argsort(joint_map)
        self._low, self._high = np.array(bounds)

    @override
    def targets(self, action: ArrayLike) -> Array:
        ours = np.asarray(action)[..., self._from_network]
        return np.clip(super().targets(ours), self._low, self._high)
