"""Inertia of rigid bodies, alone and fixed to each other.

`robot` and `found_robot` sum the links of a robot with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import attrs
import numpy as np

from .arrays import Array


def _to_array(value: Sequence[float] | Array) -> Array:
    """Convert to a read-only array."""
    array = np.array(value, float)
    array.flags.writeable = False
    return array


@attrs.frozen(eq=False)
class Inertial:
    """Inertia of a rigid body.

    Attributes:
        mass: Mass, kg.
        com: Centre of mass, (3,), m, link frame.
        tensor: Inertia tensor about the centre of mass, (3, 3), kg m^2, link axes.
    """

    mass: float
    com: Array = attrs.field(converter=_to_array)
    tensor: Array = attrs.field(converter=_to_array)

    def translated(self, offset: Sequence[float]) -> Inertial:
        """Return the same body in a frame in which the link's origin lies at an offset.

        Args:
            offset: Position of the link's origin, (3,), m.

        Returns:
            The inertia in that frame.
        """
        return attrs.evolve(self, com=self.com + np.asarray(offset, float))

    def fullinertia(self) -> list[float]:
        """Return the tensor as MuJoCo's `fullinertia`.

        Returns:
            [ixx, iyy, izz, ixy, ixz, iyz], kg m^2.
        """
        t = self.tensor
        return [t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]]


def combine_inertials(parts: Iterable[Inertial]) -> Inertial:
    """Combine rigid bodies that are fixed to each other.

    Args:
        parts: Inertias in a common frame.

    Returns:
        Inertia of the combined body.
    """
    parts = list(parts)
    # Parallel-axis theorem: I = sum of I_i + m_i (d.d 1 - d d^T), d from the common centre of mass.
    mass = sum(p.mass for p in parts)
    com = sum((p.mass * p.com for p in parts), np.zeros(3)) / mass
    tensor = np.zeros((3, 3))
    for p in parts:
        d = p.com - com
        tensor += p.tensor + p.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Inertial(mass, com, tensor)
