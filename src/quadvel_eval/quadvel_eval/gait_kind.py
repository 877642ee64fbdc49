"""Classifies the gait of a walk: which feet move together, step frequency and trunk sway.

Its inputs are foot contacts and velocities of any source; `quadvel_eval.walk` records them in
simulation.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices
from quadvel_description.quadruped import LEGS

DIAGONAL_PAIRS = (("FR", "RL"), ("FL", "RR"))
SIDE_PAIRS = (("FR", "RR"), ("FL", "RL"))


def touchdowns(contact: Bools) -> Indices:
    """Find the touchdowns of one foot.

    Args:
        contact: Contact (n,).

    Returns:
        Index of the first sample of each contact.
    """
    return np.flatnonzero(~contact[:-1] & contact[1:]) + 1


def gait_frequency(contact: Bools, period: float) -> float:
    """Return the steps per second of a foot, as mean over the feet.

    Args:
        contact: Contacts (n, 4).
        period: Sampling period, s.

    Returns:
        Frequency, Hz; 0 if a foot has fewer than two touchdowns.
    """
    downs = [touchdowns(contact[:, foot]) for foot in range(4)]
    rates = [(len(d) - 1) / ((d[-1] - d[0]) * period) for d in downs if len(d) > 1]
    return float(np.mean(rates)) if len(rates) == 4 else 0.0


def contact_agreement(contact: Bools, pairs: tuple[tuple[str, str], ...]) -> float:
    """Return the share of time in which both feet of a pair are in the same contact state.

    Args:
        contact: Contacts (n, 4), feet in the order of `LEGS`.
        pairs: Names of the legs of each pair.

    Returns:
        Mean share over the pairs, from 0 to 1.
    """
    columns = [[LEGS.index(leg) for leg in pair] for pair in pairs]
    return float(np.mean([contact[:, one] == contact[:, other] for one, other in columns]))


@attrs.frozen
class GaitKind:
    """Figures of a steady gait. A trot has `diagonal` near 1, a pace `side`; standing has both at 1.

    Attributes:
        diagonal: Contact agreement of diagonal feet, 0 to 1.
        side: Contact agreement of the feet of one side, 0 to 1.
        frequency: Steps per second of a foot, Hz.
        contact_ratio: Share of time in which a foot is on the ground, mean of the feet.
        sway: Standard deviation of the trunk's lateral velocity, m/s.
    """

    diagonal: float
    side: float
    frequency: float
    contact_ratio: float
    sway: float

    @classmethod
    def of(cls, contact: Bools, sideways: Array, period: float) -> GaitKind:
        """Compute the figures of a steady walk.

        Args:
            contact: Unfiltered contacts (n, 4), feet in the order of `LEGS`.
            sideways: Lateral velocity of the trunk (n,), m/s, body frame, positive to the left.
            period: Sampling period, s.

        Returns:
            The figures.
        """
        return cls(
            diagonal=contact_agreement(contact, DIAGONAL_PAIRS),
            side=contact_agreement(contact, SIDE_PAIRS),
            frequency=gait_frequency(contact, period),
            contact_ratio=float(contact.mean()),
            sway=float(sideways.std()),
        )
