"""What kind of gait a walk is: which feet move together, how often they step, and how much the trunk sways."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_description import robot

DIAGONAL_PAIRS = (("FR", "RL"), ("FL", "RR"))
SIDE_PAIRS = (("FR", "RR"), ("FL", "RL"))


def touchdowns(contact: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Samples at which one foot comes down.

    Args:
        contact: (n,) bool.
    """
    return np.flatnonzero(~contact[:-1] & contact[1:]) + 1


def gait_frequency(contact: NDArray[np.bool_], period: float) -> float:
    """Steps of a foot a second, from the times between touchdowns, mean over the feet.

    Args:
        contact: (n, 4) bool.
        period: time between two samples, s.

    Returns:
        Hz; 0 where a foot came down less than twice.
    """
    downs = [touchdowns(contact[:, foot]) for foot in range(4)]
    rates = [(len(d) - 1) / ((d[-1] - d[0]) * period) for d in downs if len(d) > 1]
    return float(np.mean(rates)) if len(rates) == 4 else 0.0


def share_alike(contact: NDArray[np.bool_], pairs: tuple[tuple[str, str], ...]) -> float:
    """Share of the time that both feet of a pair are on the ground or both in the air, mean over the pairs.

    Args:
        contact: (n, 4) bool, feet in the order of robot.LEGS.
        pairs: names of the legs of each pair.

    Returns:
        From 0 to 1.
    """
    columns = [[robot.LEGS.index(leg) for leg in pair] for pair in pairs]
    return float(np.mean([contact[:, one] == contact[:, other] for one, other in columns]))


@attrs.frozen
class GaitKind:
    """Figures of a steady walk. In a trot `diagonal` is near 1, in a pace `side` is; standing makes both 1."""

    diagonal: float
    """Share of the time that diagonal feet are alike in contact."""
    side: float
    """The same of the feet of one side."""
    frequency: float
    """Steps of a foot a second, Hz."""
    contact_ratio: float
    """Share of the time that a foot is on the ground, mean of the four."""
    sway: float
    """Standard deviation of the trunk's sideways velocity, m/s."""

    @classmethod
    def of(cls, contact: NDArray[np.bool_], sideways: NDArray[np.float64], period: float) -> GaitKind:
        """Measure a steady walk.

        Args:
            contact: (n, 4) bool, feet in the order of robot.LEGS, as they are.
            sideways: (n,) velocity of the trunk to its left, m/s, body frame.
            period: time between two samples, s.
        """
        return cls(
            diagonal=share_alike(contact, DIAGONAL_PAIRS),
            side=share_alike(contact, SIDE_PAIRS),
            frequency=gait_frequency(contact, period),
            contact_ratio=float(contact.mean()),
            sway=float(sideways.std()),
        )
