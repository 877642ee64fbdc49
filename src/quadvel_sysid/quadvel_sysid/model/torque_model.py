"""Forward model of the joint torque, as the identification evaluates it.

It is the empirical actuator model (EAM: PD gains and two delays) with effects. This module only
evaluates; `data.plain_model` fits the EAM, and `search` fits effects, gains and delays together.

The equations, in the order in which a drive computes them:

    tau_asked = g_p kp (q_des - q) + g_d kd (dq_des - dq) + tau_ff    (effects on the errors first)
    tau_drive = tau_asked after the bounds, lags and gains of the effects
    tau       = tau_drive + added torques + weighted regressors of named signals

`g_p` and `g_d` are the ratios of real to commanded gains. Commands act one input delay late, and
the torque of the drive appears one output delay later. Joints with the same group number share a
parameter.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from quadvel_actuator.effects import DRIVE, Stage
from quadvel_description.arrays import Array, Bools, Indices

from ..data.signals import Samples, Signals
from .applied_effect import AppliedEffect
from .effect_candidate import EffectCandidate

MAX_DELAYS_S = np.array([0.020, 0.006])
"""Upper bounds of the input delay and of the output delay, s."""


@attrs.frozen(eq=False)
class Model:
    """Actuator model of all joints: gains, delays and effects, on the samples of the logs.

    Attributes:
        samples: Rows of all logs.
        window: Time over which the drive averages commands, s; 0 for a drive that does not.
        gains: Ratios of real to commanded kp and kd, (2, J). Where no gain is commanded, the gains
            themselves in N m/rad and N m s/rad.
        gain_groups: Group numbers of the joints, (J,); joints with the same number share their
            gains.
        delays: Input and output delay, (2, J), s.
        delay_groups: Group numbers of the joints, (J,), for the delays.
        effects: Effects, in the order in which they were added.
        law_gains: Gains as they were before a learned term was added, (2, J); None without one. A
            learned term can take over a part of the PD law, such as the speed from earlier angles;
            the encoder noise that a model is charged for must not fall because of that.
    """

    samples: Samples
    window: float
    gains: Array
    gain_groups: Indices
    delays: Array
    delay_groups: Indices
    effects: tuple[AppliedEffect, ...] = ()
    law_gains: Array | None = None

    @property
    def holds_gains(self) -> Bools:
        """Joints (J,) whose gains a fit leaves as they are, as a term there could replace the PD law."""
        terms = [effect.active for effect in self.effects if effect.candidate.replaces_law]
        joints = np.any(terms, axis=0) if terms else np.zeros(len(self.gain_groups), dtype=bool)
        held: Bools = np.isin(self.gain_groups, self.gain_groups[joints])
        return held

    @property
    def signals(self) -> Signals:
        """Signals of all rows at the delays of this model, (N, J) each."""
        return self.samples.at(self.delays[0], self.delays[1], self.window)

    def signals_for(self, candidate: EffectCandidate) -> Signals:
        """Return the signals that an added torque depends on.

        Torques at the joint act without the output delay, torques of the drive with it.

        Args:
            candidate: Form of the added effect.

        Returns:
            Signals at the delays of the model for the place where the effect acts.
        """
        if candidate.at == DRIVE:
            return self.signals
        if candidate.depends_on_commands:
            return self.samples.at_joint(self.delays[0], self.delays[1], self.window)
        return self.samples.at(0.0, 0.0, self.window)

    def predict(self) -> Array:
        """Predict the torque of every row.

        Returns:
            Torque, (N, J), N m.
        """
        torque: Array = self.evaluate(self.gains[None], [effect.values[None] for effect in self.effects])[0]
        return torque

    def residual(self) -> Array:
        """Return the measured minus the predicted torque.

        Returns:
            Residual, (N, J), N m.
        """
        residual: Array = self.samples.tau - self.predict()
        return residual

    @property
    def _charged_gains(self) -> Array:
        """Gains (2, J) whose encoder noise the model is charged for."""
        return self.gains if self.law_gains is None else self.law_gains

    def averaged_noise(self) -> Array:
        """Return the variance of encoder noise that interpolation between rows removes from the residual.

        Measured states hold noise that the drive did not act on. A delay halfway between two rows
        averages it, and so has a smaller error than a delay of whole rows, without being better.

        Returns:
            Variance that a fair comparison of delays adds to the squared residual, (N, J), N^2 m^2.
        """
        # tau holds g_p kp e_q + g_d kd e_dq, with the noise e of q and dq.
        s, (q_noise, dq_noise) = self.signals, self.samples.sources.interpolated_noise
        kp, kd = self._charged_gains
        noise: Array = (kp * s.kp) ** 2 * q_noise + (kd * s.kd) ** 2 * dq_noise
        return noise * s.averaging

    def noise_averaged_by_effects(self, rows: Bools) -> Array:
        """Return the variance of encoder noise that the effects remove from the prediction.

        Effects of earlier speeds and of accelerations can combine to a filter of dq: the speed a time h
        earlier, together with an inertia of kd h, predicts dq from the rows around it. It reduces the
        error by noise that the drive did not act on, and describes no property of the drive.

        Args:
            rows: Samples to average over, (N, J) bool.

        Returns:
            Mean variance that a fair comparison adds to the squared residual, (J,), N^2 m^2; 0 for
            effects that add noise.
        """
        # Response of the prediction to further noise e of the encoders, with and without effects:
        #     d = tau(q + e_q, dq + e_dq) - tau(q, dq);   result = mean(d_plain^2 - d^2), at least 0
        if not self.effects:
            return np.zeros(rows.shape[1])
        plain = attrs.evolve(self, effects=(), gains=self._charged_gains)
        noisy = self.samples.noisier
        with_effects, without = (
            attrs.evolve(one, samples=noisy).predict() - one.predict() for one in (self, plain)
        )
        removed = np.sum(without**2 - with_effects**2, axis=0, where=rows) / np.maximum(rows.sum(axis=0), 1)
        variance: Array = np.maximum(removed, 0.0)
        return variance

    def evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """Predict the torque for a batch of parameter values.

        A drive with a step computes at the rows alone. Without a step, effects that act between rows
        are evaluated on upsampled signals.

        Args:
            gains: Gain ratios, (B, 2, J).
            values: For each effect its parameter values, (B, P, J).

        Returns:
            Torque, (B, N, J), N m.
        """
        if self.window == 0.0 and any(effect.candidate.acts_between_rows for effect in self.effects):
            upsampled = attrs.evolve(self, samples=self.samples.upsampled)
            instants = self.samples.instants_per_row
            return upsampled._evaluate(gains, values)[..., instants - 1 :: instants, :]
        return self._evaluate(gains, values)

    def _evaluate(self, gains: Array, values: Sequence[Array]) -> Array:
        """Evaluate the torque at the rows of `samples`, without upsampling."""
        # tau = x + sum_i f_i(x) + sum_k g_k(x + sum_i f_i(x)), with the drive torque x, the added
        # effects f_i, and the added effects g_k that read the total torque.
        x = self._evaluate_drive(gains, values)
        added = [pair for pair in zip(self.effects, values, strict=True) if _is_added(pair[0])]
        total = x
        for effect, value in added:
            if not effect.candidate.reads_total_torque:
                total = total + self.added_torque(effect, x, value)
        total_of_effects = total
        for effect, value in added:
            if effect.candidate.reads_total_torque:
                total = total + self.added_torque(effect, total_of_effects, value)
        batch = max(len(gains), *(len(value) for value in values)) if values else len(gains)
        return np.broadcast_to(total, (batch, *self.signals.q.shape))

    def _evaluate_drive(self, gains: Array, values: Sequence[Array]) -> Array:
        """Torque of the drive (B, N, J), without the added torques."""
        s = self.signals
        stiffness_torque, damping_torque = s.stiffness_torque, s.damping_torque
        in_order = sorted(zip(self.effects, values, strict=True), key=lambda pair: pair[0].candidate.stage)
        on_errors = [pair for pair in in_order if pair[0].candidate.stage == Stage.ERRORS]
        if on_errors:
            error: tuple[Array, Array] = (s.q_des - s.q, s.dq_des - s.dq)
            for effect, value in on_errors:
                error = self._apply_to_errors(effect, error, s, value)
            stiffness_torque, damping_torque = s.kp * error[0], s.kd * error[1]
        # Gains that are the same in all candidates are multiplied once.
        g = gains[:1] if len(gains) > 1 and (gains == gains[0]).all() else gains
        x: Array = (
            g[..., 0, :][..., None, :] * stiffness_torque
            + g[..., 1, :][..., None, :] * damping_torque
            + s.tau_ff
        )
        for effect, value in in_order:
            if Stage.ERRORS < effect.candidate.stage < Stage.ADDED:
                x = _select_active(effect.active, effect.candidate.evaluate(x, s, value), x)
        return x

    def _apply_to_errors(
        self, effect: AppliedEffect, error: tuple[Array, Array], s: Signals, value: Array
    ) -> tuple[Array, Array]:
        """Apply an effect of the stage ERRORS to the errors of position and speed."""
        after = effect.candidate.evaluate(error, s, value)
        position, speed = (
            _select_active(effect.active, new, old) for new, old in zip(after, error, strict=True)
        )
        return position, speed

    def drive_torque(self) -> Array:
        """Predict the torque of the drive, without the added torques.

        Returns:
            Torque, (N, J), N m.
        """
        kept = tuple(effect for effect in self.effects if not _is_added(effect))
        return attrs.evolve(self, effects=kept).predict()

    def input_torque(self, candidate: EffectCandidate) -> Array:
        """Return the torque that an added effect receives as its input.

        Args:
            candidate: Form of an added effect, part of this model or not.

        Returns:
            Torque of the drive, (N, J), N m; with all other added torques if the effect reads the
            total.
        """
        if not candidate.reads_total_torque:
            return self.drive_torque()
        kept = tuple(effect for effect in self.effects if not effect.candidate.reads_total_torque)
        return attrs.evolve(self, effects=kept).predict()

    def added_torque(self, effect: AppliedEffect, x: Array, value: Array) -> Array:
        """Return the torque that an effect of the stage ADDED adds.

        Args:
            effect: The effect.
            x: Input of the effect, (N, J) or (B, N, J), N m; see `input_torque`.
            value: Batch of parameter values, (B, P, J).

        Returns:
            Added torque, (B, N, J), N m; 0 on joints that the effect does not act on.
        """
        return effect.on_active(effect.candidate.evaluate(x, self.signals_for(effect.candidate), value))

    def linear_columns(self, effect: AppliedEffect, x: Array | None = None) -> Array:
        """Return the torque per unit of each linear parameter of an added effect.

        Args:
            effect: The added effect, part of this model or not.
            x: Input of the effect, (N, J), N m; `input_torque` if None.

        Returns:
            Regressors, (L, N, J).
        """
        x = self.input_torque(effect.candidate) if x is None else x
        signals = self.signals_for(effect.candidate)
        return effect.on_active(effect.candidate.regressors(x, signals, effect.values))

    def with_delays(self, delays: Array) -> Model:
        """Return the model with other delays.

        Args:
            delays: Input and output delay, (2, J), s; clipped to [0, `MAX_DELAYS_S`], rounded to
                0.1 us.

        Returns:
            A new model.
        """
        clipped = np.asarray(np.clip(delays, 0.0, MAX_DELAYS_S[:, None]), dtype=float).round(7)
        return attrs.evolve(self, delays=clipped)

    def with_effect(self, applied: AppliedEffect) -> Model:
        """Return the model with one more effect.

        Args:
            applied: The effect to append.

        Returns:
            A new model.
        """
        is_first_learned = applied.candidate.penalty is not None and self.law_gains is None
        return attrs.evolve(
            self,
            effects=(*self.effects, applied),
            law_gains=self.gains if is_first_learned else self.law_gains,
        )

    def with_replaced_effect(self, index: int, applied: AppliedEffect) -> Model:
        """Return the model with one effect replaced.

        Args:
            index: Index of the effect to replace.
            applied: The new effect.

        Returns:
            A new model.
        """
        return attrs.evolve(self, effects=(*self.effects[:index], applied, *self.effects[index + 1 :]))

    def without_effect(self, index: int) -> Model:
        """Return the model without one of its effects.

        Args:
            index: Index of the effect to remove.

        Returns:
            A new model.
        """
        return attrs.evolve(self, effects=(*self.effects[:index], *self.effects[index + 1 :]))

    def predictive(self) -> Model:
        """Return the model with the predictive form of every effect.

        An effect may infer random events, such as lost commands, from the measured torque. Its
        predictive form uses only what is known before the torque is measured.

        Returns:
            A new model.
        """
        return attrs.evolve(
            self,
            effects=tuple(
                attrs.evolve(effect, candidate=effect.candidate.predictive()) for effect in self.effects
            ),
        )


def _is_added(effect: AppliedEffect) -> bool:
    """Whether the effect adds its torque to that of the drive."""
    return effect.candidate.stage == Stage.ADDED


def _select_active(active: Bools, new: Array, old: Array) -> Array:
    """Values after an effect on the active joints, values before it on the others."""
    return new if active.all() else np.where(active, new, old)
