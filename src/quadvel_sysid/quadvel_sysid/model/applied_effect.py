"""An effect with its parameter values on the joints that it acts on.

`search` fits the values; `torque_model.Model` evaluates several effects together.
"""

from __future__ import annotations

import attrs
import numpy as np

from quadvel_description.arrays import Array, Bools, Indices

from ..data.signals import Signals
from .effect_candidate import EffectCandidate


@attrs.frozen(eq=False)
class AppliedEffect:
    """An effect with its parameter values on the joints that it acts on.

    Attributes:
        candidate: Form of the effect.
        active: Joints that the effect acts on, (J,) bool.
        values: Parameter values in the order of `candidate.parameters`, (P, J), in their units.
        groups: Group numbers, (J,). Joints with the same number share their values.
    """

    candidate: EffectCandidate
    active: Bools
    values: Array
    groups: Indices

    @property
    def parameters(self) -> dict[str, Array]:
        """Parameter values by name, (J,) each."""
        return dict(zip(self.candidate.names, self.values, strict=True))

    def is_excited(self, s: Signals) -> bool:
        """Whether the motion excites the effect on at least one joint of every group.

        Args:
            s: Signals of the log at the delays of the model.

        Returns:
            True if every group of active joints holds an excited joint.
        """
        excited = self.candidate.excited_joints(self.parameters, s) & self.active
        return set(self.groups[excited]) == set(self.groups[self.active])

    def on_active(self, torque: Array) -> Array:
        """Set a torque to zero on the joints that the effect does not act on.

        Args:
            torque: Torque, (..., J), N m.

        Returns:
            Torque of the effect, (..., J), N m.
        """
        return torque if self.active.all() else torque * self.active

    def canonical(self) -> AppliedEffect:
        """Return the effect in canonical form: the simplest form, with parameters in unique order.

        Returns:
            An equivalent effect. Two fits of one truth have the same canonical form.
        """
        restricted = self.candidate.restricted_to(self.active)
        none, known = np.zeros_like(self.values[0]), self.parameters
        p = restricted.effect.canonical({name: known.get(name, none) for name in restricted.names})
        values = np.array([p[name] for name in restricted.names])
        return attrs.evolve(self, candidate=restricted, values=values)
