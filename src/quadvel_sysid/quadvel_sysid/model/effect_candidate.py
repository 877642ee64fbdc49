"""Effects as the identification sees them: what it needs to know to find an effect in a log.

`quadvel_actuator` holds the physics of an effect: parameters, stage and torque. An `EffectCandidate`
stands next to it and holds starting values, linear parameters, and what the effect is confounded
with. The defaults suit an effect of another package that has no candidate class of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Protocol

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, JOINT, EffectModel, Parameter, Stage
from quadvel_actuator.effects.numerics import distinct_indices
from quadvel_description.arrays import Array, Bools

from ..data.signals import Samples, Signals

InitialGuess = Mapping[str, Any]
"""Guess of every parameter that is not linear: a number, or one per joint (J,)."""


class FormContext(Protocol):
    """What an effect may know of a log to choose the forms to try."""

    @property
    def samples(self) -> Samples:
        """Rows of all logs."""

    @property
    def signals(self) -> Signals:
        """Signals at the delays of the model that the effect would extend."""

    @property
    def lost_commands(self) -> list[tuple[Array, Array]]:
        """Probabilities that commands were lost: in each row (N, J, M), and their mean (M,)."""

    def strongest_neighbours(self) -> tuple[str, ...]:
        """Find for each joint the signal of another joint that its residual correlates with most.

        Returns:
            Names `joint/signal`, one for each joint; empty for a single joint.
        """


@attrs.frozen(eq=False)
class EffectCandidate:
    """One form of an effect, as a candidate to explain a log.

    Attributes:
        effect: Physics of the effect.
        shifts: Whether it resembles a delay.
        acts_between_rows: Whether it also depends on what happens between the rows of a log.
        all_joints_together: Whether it happens to all joints of a robot at the same time.
        possible_on_one_joint: Whether one of several joints can have it alone.
        motion: Motion to record in order to distinguish it from other effects.
        settings_to_try: Settings of the forms to try on a log.
        places: Where an added torque is tried.
        guesses: Starting points of the parameters.
    """

    effect: EffectModel
    shifts: ClassVar[bool] = False
    acts_between_rows: ClassVar[bool] = False
    all_joints_together: ClassVar[bool] = False
    possible_on_one_joint: ClassVar[bool] = True
    motion: ClassVar[str] = "richer motion"
    settings_to_try: ClassVar[Sequence[Mapping[str, str]]] = ({},)
    places: ClassVar[Sequence[str]] = (DRIVE, JOINT)
    guesses: ClassVar[Sequence[InitialGuess]] = ({},)

    @property
    def depends_on_commands(self) -> bool:
        """Whether the torque depends on more than angle and speed of the joint.

        It then depends on commands, on the torque of the drive, or on accelerations.
        """
        return True

    @property
    def confounded_with_gain(self) -> bool:
        """Whether the effect on all joints equals a deviation of a gain or of delays.

        At least one joint has to be free of it.
        """
        return False

    @property
    def confounded_with_delays(self) -> bool:
        """Whether another split into input and output delay resembles the effect.

        An output delay d changes the torque by kp d dq + kd d ddq: by damping and by inertia.
        """
        return self.shifts or self.confounded_with_gain

    @property
    def shared_by_joints(self) -> bool:
        """Whether it has one cause for all joints, so that they share its values."""
        return False

    @property
    def reads_total_torque(self) -> bool:
        """Whether it reads the torque of all other effects and is evaluated after them."""
        return False

    @property
    def linear(self) -> tuple[str, ...]:
        """Names of the parameters that the added torque is proportional to, term by term."""
        return ()

    @property
    def signal(self) -> str:
        """Signal over which the residual shows the shape of the effect."""
        return "tau"

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    @property
    def stage(self) -> Stage:
        """Place in the drive where it acts."""
        return self.effect.stage

    @property
    def at(self) -> str:
        """Where an added torque acts: `DRIVE` or `JOINT`."""
        return self.effect.at

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in order."""
        return self.effect.parameters

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return self.effect.names

    @property
    def has_memory(self) -> bool:
        """Whether a row depends on the rows before."""
        return self.effect.has_memory

    @property
    def key(self) -> tuple[str, ...]:
        """Key by which candidates count as the same."""
        return (self.name,)

    @property
    def penalty(self) -> Array | None:
        """Matrix of the quadratic penalty on the parameters in a fit, (P, P); None without one."""
        return None

    @property
    def replaces_law(self) -> bool:
        """Whether it can stand for the gains of the PD law: a filter of angles is a speed, for example."""
        return False

    @property
    def indistinguishable_forms(self) -> tuple[EffectCandidate, ...]:
        """Forms that no log distinguishes from this one.

        How far the parameters move between forms widens their intervals.
        """
        return ()

    def complexity(self, memory_cost: float) -> float:
        """Return the cost in the criterion.

        Args:
            memory_cost: Further parameters that an effect with memory, or one like a delay, counts as.

        Returns:
            Equivalent number of parameters per joint.
        """
        return len(self.parameters) + (memory_cost if self.shifts or self.has_memory else 0.0)

    @classmethod
    def forms(cls, effect: type[EffectModel], context: FormContext) -> Sequence[EffectCandidate]:
        """List the forms to try on a log.

        Args:
            effect: Class of the effect, as the registry names it.
            context: Data of the log.

        Returns:
            Forms of the effect; empty where it cannot act.
        """
        places = cls.places if effect.stage == Stage.ADDED else (DRIVE,)
        return [cls(effect(**settings, at=at)) for settings in cls.settings_to_try for at in places]

    def initial_guesses(self, s: Signals, torque: Array, residual: Array) -> Sequence[InitialGuess]:
        """List starting points for a search of the parameters.

        Args:
            s: Signals of the log, (N, J).
            torque: Prediction without the effect, (N, J), N m.
            residual: Measured torque minus `torque`, (N, J), N m; 0 in rows that are not to be
                explained.

        Returns:
            Guesses; a parameter that is left out starts from its scale.
        """
        return self.guesses

    def special_case(self, p: Mapping[str, Array]) -> tuple[EffectCandidate, Mapping[str, Array]] | None:
        """Return the effect with fewer parameters that this one becomes in a limit.

        Args:
            p: Parameters, (J,) each.

        Returns:
            The simpler effect and its parameters (J,), or None.
        """
        return None

    def restricted_to(self, active: Bools) -> EffectCandidate:
        """Return the form that remains on some of the joints.

        Args:
            active: Joints that keep the effect, (J,) bool.

        Returns:
            The form for these joints.
        """
        return self

    def allowed_joints(self, joints: Sequence[str]) -> Bools:
        """Return the joints that the effect may act on.

        Args:
            joints: Names of the J joints.

        Returns:
            Mask (J,).
        """
        return np.ones(len(joints), dtype=bool)

    def excited_joints(self, p: Mapping[str, Array], s: Signals) -> Bools:
        """Find the joints whose motion shows the effect; on the others it passes for another one.

        Args:
            p: Parameters, (J,) each.
            s: Signals of the log.

        Returns:
            (J,) bool.
        """
        return np.ones(s.q.shape[-1], dtype=bool)

    def sampling_error(self, p: Mapping[str, Array], s: Signals) -> dict[str, Array]:
        """Return half widths of 95 % intervals of parameters that count random events.

        Args:
            p: Parameters, (J,) each.
            s: Signals of the log.

        Returns:
            Half widths (J,) by parameter; empty for effects without such parameters.
        """
        return {}

    def predictive(self) -> EffectCandidate:
        """Return the form without anything inferred from the measured torque, for prediction.

        Returns:
            The predictive form.
        """
        return self

    def record_statistics(self) -> dict[str, float]:
        """Return figures about this log that are no parameters.

        Returns:
            Figures by name.
        """
        return {}

    def evaluate(self, x: Any, s: Signals, values: Array) -> Any:
        """Apply the effect to all rows, for a batch of parameter values.

        Args:
            x: Values before the effect, (N, J) or (B, N, J); a pair of errors at stage ERRORS.
            s: Signals of the rows.
            values: Parameter values, (B, P, J).

        Returns:
            The values in place of `x`; at stage ADDED the torque to add, N m.
        """
        if self.stage != Stage.ERRORS or self.has_memory or max(part.ndim for part in x) > 2:
            return self.effect.series(x, s, self._by_name(values))
        # Equal errors for the whole batch: compute each distinct set of parameters once.
        first, which = distinct_indices(values)
        after = self.effect.series(x, s, self._by_name(values[first]))
        return tuple(part[which] if part.ndim > 2 else part for part in after)

    def _by_name(self, values: Array) -> dict[str, Array]:
        """Parameters (B, 1, J) by name, or (J,) where all entries of the batch (B, P, J) are equal."""
        found = {}
        for k, name in enumerate(self.names):
            column = values[:, k]
            found[name] = column[0] if len(column) == 1 or (column == column[0]).all() else column[:, None]
        return found

    def regressors(self, x: Array, s: Signals, values: Array) -> Array:
        """Compute the added torque per unit of each linear parameter.

        The other parameters keep their values, so that the torque is the weighted sum of the
        regressors.

        Args:
            x: Input torque of the effect, (N, J), N m.
            s: Signals of the rows.
            values: Parameter values, (P, J).

        Returns:
            Regressors, (L, N, J).
        """
        linear = [self.names.index(name) for name in self.linear]
        unit = np.repeat(values[None], len(linear), axis=0)
        unit[:, linear] = 0.0
        unit[np.arange(len(linear)), linear] = 1.0
        return np.broadcast_to(self.evaluate(x, s, unit), (len(linear), *x.shape))
