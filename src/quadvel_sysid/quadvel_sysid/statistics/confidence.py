"""95 % confidence intervals of all fitted parameters, with a cluster-robust covariance.

The wider of two covariances counts: that of white residuals, and the sandwich estimator on cluster
sums over all joints (Liang and Zeger), which is valid for any correlation within a cluster. Gains
and delays are among the unknowns. Where another form of an effect explains the log equally well, the
interval contains its parameter values too. Intervals grow with the error that no effect explains,
relative to the noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs
import numpy as np
from scipy import stats

from quadvel_description.arrays import Array, Bools, Indices

from ..data.split import DataSplit
from ..model.delays import delay_flatness
from ..model.fit import fit, normal_equations, squared_error
from ..model.jacobian import Unknowns, jacobian
from ..model.torque_model import MAX_DELAYS_S, Model
from .reading_error import CLOCK_ERROR_S

CONFIDENCE_LEVEL = 0.95
"""Coverage of the intervals."""
_SYSTEMATIC_FRACTION, _SYSTEMATIC_GAIN_FRACTION = 0.01, 0.005
"""Systematic error relative to an effect's value, and to a gain: motion samples are noisy."""
_EQUIVALENT_ERROR_RATIO = 1.003
"""Ratio of squared errors below which another form of an effect explains the log equally well."""
_INSEPARABLE_CORRELATION = 0.95
"""Correlation of two estimates from which a log does not separate the parameters."""
_OUTPUT_DELAY_CHANGES_S = 0.5e-3 * np.array([-6, -4, -3, -2, -1, 1, 2, 3, 4, 6])
"""Changes of the output delay, s, at which effects are fitted again for their intervals."""
_COHERENT_SHARE = 0.1
"""Share of the reading error that a wrong parameter may make up for: the rest changes sign from row to row."""


@attrs.frozen
class InseparablePair:
    """Two parameters that the log does not separate: an error of one is made up for by the other.

    Attributes:
        names: `delta_kp`, `delta_kd`, `input_delay`, `output_delay`, or `effect.parameter`.
        joint: Index of the joint with the smallest correlation.
        correlation: Correlation of the two estimates, -1 to 1.
    """

    names: tuple[str, str]
    joint: int
    correlation: float

    @property
    def conditional(self) -> float:
        """Half width of the first parameter if the second one is known, divided by that if it is not."""
        return float(np.sqrt(max(1.0 - self.correlation**2, 0.0)))


@attrs.frozen(eq=False)
class Intervals:
    """Half widths of the 95 % confidence intervals, in the units of the parameters.

    Attributes:
        gains: Gain ratios, (2, J).
        effects: Values of each effect, (P, J) each.
        delays: Input and output delay, (2, J), s.
        total_delay: Sum of both delays, (J,), s.
        at_bound: Names of parameters that lie on a bound, whose intervals are not valid.
        inseparable: Pairs of parameters that the log does not separate.
    """

    gains: Array
    effects: tuple[Array, ...]
    delays: Array
    total_delay: Array
    at_bound: tuple[str, ...]
    inseparable: tuple[InseparablePair, ...]


def intervals(
    model: Model,
    parts: DataSplit,
    noise: Array,
    reading_error: Array,
    clock_offsets: Sequence[float] = (),
) -> Intervals:
    """Compute confidence intervals of a model that was fitted to the fit and selection rows.

    Args:
        model: The fitted model.
        parts: Data split with the clusters.
        noise: Variance of the torque noise, (J,), N^2 m^2.
        reading_error: Error of the torque that unknown instants of the drive leave, (J,), N^2 m^2.
        clock_offsets: Offsets of the recordings' commands, s; the largest widens the interval of the
            input delay.

    Returns:
        Half widths: random error, plus the error of the effect's form, plus the systematic error.
    """
    # Half width = random error + error of the effect's form + systematic error.
    rows = parts.fit_or_select
    coherent = _COHERENT_SHARE * float((reading_error * rows.sum(axis=0)).sum())
    covariance = _Covariance.of(model, parts, rows, coherent)
    # What no effect explains can hide in any parameter: the random error grows with it.
    error = squared_error(model, rows) / max(float((noise * rows.sum(axis=0)).sum()), 1e-300)
    covariance = attrs.evolve(covariance, quantile=covariance.quantile * np.sqrt(max(error, 1.0)))
    random_error = covariance.half_widths(np.eye(len(covariance.index)))
    split_error = _split_error(model, rows, coherent + covariance.quantile**2 * float(noise.mean()))
    effects, first = [], 2
    for index, effect in enumerate(model.effects):
        own = random_error[first : first + len(effect.values)]
        first += len(effect.values)
        # Some effects compute the random error of their parameters themselves.
        candidate = effect.candidate
        known = candidate.sampling_error(effect.parameters, model.signals)
        sampling = np.array([known.get(name, row) for name, row in zip(candidate.names, own, strict=True)])
        clock = np.array(
            [[CLOCK_ERROR_S if parameter.unit == "s" else 0.0] for parameter in candidate.parameters]
        )
        systematic = np.maximum(clock, _SYSTEMATIC_FRACTION * np.abs(effect.values)) * effect.active
        sampling = np.maximum(sampling, split_error[index])
        effects.append(sampling + _form_error(model, index, rows) + systematic)
    # A half width as large as the gain (or 1) means that any gain from 0 on is possible.
    size = np.abs(model.gains)
    gains = np.minimum(random_error[:2] + _SYSTEMATIC_GAIN_FRACTION * size, np.maximum(1.0, size))
    # The error is flat about the best input delay: the interval holds all of that valley.
    both = covariance.half_widths(np.eye(len(covariance.index))[-2:].sum(axis=0, keepdims=True))
    delays = np.concatenate([random_error[-2:], both]) + CLOCK_ERROR_S
    flat = delay_flatness(model, rows) + CLOCK_ERROR_S
    delays[[0, 2]] = np.maximum(delays[[0, 2]], flat) + max(map(abs, clock_offsets), default=0.0)
    delays = np.minimum(delays, np.append(MAX_DELAYS_S, MAX_DELAYS_S.sum())[:, None])
    return Intervals(
        gains,
        tuple(effects),
        delays[:2],
        delays[2],
        parameters_at_bound(model),
        tuple(_inseparable(model, covariance)),
    )


@attrs.frozen(eq=False)
class _Covariance:
    """Covariance of the unknowns of a fit.

    Attributes:
        index: Unknown of slot a on joint j, (A, J); -1 where the slot is not fitted.
        white: Covariance for white residuals, (K, K).
        clustered: Cluster-robust covariance, (K, K).
        coherent: Squares and products (K, K) of systematic errors from unknown instants of the drive.
        bias: Largest systematic error (K,) from noise of q and dq that the drive did not act on.
        quantile: Half width of the 95 % interval over the standard deviation.
    """

    index: Indices
    white: Array
    clustered: Array
    coherent: Array
    bias: Array
    quantile: float

    @classmethod
    def of(cls, model: Model, parts: DataSplit, rows: Bools, coherent: float) -> _Covariance:
        """Covariance of a model that was fitted to `rows`; `coherent` errors add to its sum of squares."""
        unknowns = Unknowns.of(model, all_gains=True)
        hessian, _, slopes, residual = normal_equations(model, unknowns, rows)
        degrees_of_freedom = max(int(rows.sum()) - unknowns.count, 1)

        # Inverse of H = J'J, scaled to a unit diagonal because the units of the unknowns differ.
        scale = np.sqrt(np.diagonal(hessian)) + 1e-12
        inverse = np.linalg.pinv(hessian / np.outer(scale, scale), rcond=1e-10, hermitian=True)
        inverse /= np.outer(scale, scale)

        # Two covariances of the form H^-1 M H^-1:
        #     white residuals:   M = sum_j s_j^2 J_j'J_j              (s_j^2: error variance of joint j)
        #     cluster-robust:    M = sum_c g_c g_c',  g_c = sum over the rows of cluster c of J'r
        noise = np.sum(residual**2, axis=0) / np.maximum(rows.sum(axis=0), 1)
        white = unknowns.accumulate(noise[:, None, None] * (slopes @ slopes.transpose(0, 2, 1)))
        sums = np.zeros((len(parts.cluster_starts), unknowns.count))
        for j, moment in enumerate(slopes * residual.T[:, None]):  # (A, N)
            used = unknowns.index[:, j] >= 0
            sums[:, unknowns.index[used, j]] += parts.cluster_sums(moment[used].T)

        # Small-sample corrections: factor 1 + K / (n - K), and Student's t over the clusters.
        cluster_count = int((parts.cluster_sums(rows.any(axis=1).astype(float)) > 0).sum())
        joint_unknowns = int((unknowns.index >= 0).any(axis=1).sum())
        factor = 1.0 + unknowns.count / degrees_of_freedom
        white, clustered = (factor * inverse @ inner @ inverse for inner in (white, sums.T @ sums))
        quantile = stats.t.ppf(0.5 + CONFIDENCE_LEVEL / 2, max(cluster_count - joint_unknowns, 5))
        bias: Array = np.abs(_noise_bias(model, unknowns, rows, hessian, slopes))
        systematic: Array = np.asarray(coherent * inverse)
        return cls(unknowns.index, white, clustered, systematic, bias, float(quantile))

    def half_widths(self, sums: Array) -> Array:
        """Half widths (S, J) of weighted sums (S, A) of the slots; slots that are not fitted are known."""
        # Var(w'x) = w'C w on each joint; the larger one of both covariances counts.
        fitted = self.index >= 0
        weights = np.where(fitted.T[:, None], sums, 0.0)  # (J, S, A)
        at = np.where(fitted, self.index, 0).T  # (J, A)
        variance = [
            np.einsum("jsa,jab,jsb->sj", weights, one[at[:, :, None], at[:, None, :]], weights)
            for one in (self.white, self.clustered, self.coherent)
        ]
        random = self.quantile**2 * np.maximum(variance[0], variance[1])
        half: Array = np.sqrt(np.maximum(random + variance[2], 0.0))
        biases = np.where(fitted.T, self.bias[at], 0.0)  # (J, A)
        return half + np.einsum("jsa,ja->sj", np.abs(weights), biases)

    def correlations(self, joint: int) -> Array:
        """Correlations (A, A) of the slots of a joint, by the white covariance; 0 where not fitted."""
        fitted = self.index[:, joint] >= 0
        at = np.where(fitted, self.index[:, joint], 0)
        covariance = self.white[np.ix_(at, at)] * np.outer(fitted, fitted)
        deviation = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        found: Array = covariance / np.maximum(np.outer(deviation, deviation), 1e-300)
        return found


def _noise_bias(model: Model, unknowns: Unknowns, rows: Bools, hessian: Array, slopes: Array) -> Array:
    """Change (K,) of the unknowns if noise of q and dq, which the fit averages, is no gain.

    A fit prefers parameters that average the noise of the states: late speeds plus an inertia of kd
    times that time predict dq from its neighbours. If the drive acted on other noise than the log
    has, or on none, that lowers the error and is wrong. Weights of learned terms mean nothing alone.
    """
    # With the response d(x) of the prediction to further noise of the states, the error without the
    # noise of the states is |r(x)|^2 - |d(x)|^2 (errors in variables). At the least squares J'r = 0,
    # so that one Gauss-Newton step to its minimum is (J'J - D'D)^-1 D'd, with D the derivatives of d.
    if not model.effects or any(effect.candidate.penalty is not None for effect in model.effects):
        return np.zeros(unknowns.count)
    predicted, noisy_slopes = jacobian(attrs.evolve(model, samples=model.samples.noisier), unknowns)
    response = np.where(rows, predicted - model.predict(), 0.0)
    change = noisy_slopes * rows.T[:, None] - slopes
    gradient = unknowns.accumulate((change @ response.T[:, :, None])[..., 0])
    left = hessian - unknowns.accumulate(change @ change.transpose(0, 2, 1))
    scale = np.sqrt(np.diagonal(hessian)) + 1e-12
    step: Array = np.linalg.pinv(left / np.outer(scale, scale), rcond=1e-10, hermitian=True) @ (
        gradient / scale
    )
    return step / scale


def _inseparable(model: Model, covariance: _Covariance) -> Iterator[InseparablePair]:
    """Pairs of parameters that no joint separates, apart from pairs within one effect.

    Weights of a learned term mean nothing alone: the term is a single parameter here.
    """
    names, owners = ["delta_kp", "delta_kd"], ["delta_kp", "delta_kd"]
    for k, effect in enumerate(model.effects):
        term = effect.candidate.name
        learned = effect.candidate.penalty is not None
        names += [term if learned else f"{term}.{name}" for name in effect.candidate.names]
        owners += [str(k)] * len(effect.candidate.names)
    names, owners = [*names, "input_delay", "output_delay"], [*owners, "input_delay", "output_delay"]
    every = np.stack([covariance.correlations(j) for j in range(covariance.index.shape[1])])
    fitted = covariance.index >= 0
    found: dict[tuple[str, str], InseparablePair] = {}
    for a in range(len(names)):
        for b in range(a + 1, len(names)):
            joints = np.flatnonzero(fitted[a] & fitted[b])
            size = np.abs(every[joints, a, b])
            if owners[a] != owners[b] and len(joints) and size.min() >= _INSEPARABLE_CORRELATION:
                joint = int(joints[np.argmin(size)])
                pair = InseparablePair((names[a], names[b]), joint, float(every[joint, a, b]))
                found[pair.names] = max(
                    found.get(pair.names, pair), pair, key=lambda one: abs(one.correlation)
                )
    yield from found.values()


def _form_error(model: Model, index: int, rows: Bools) -> Array:
    """Largest change (P, J) of an effect's values under equivalent forms of it."""
    effect, change = model.effects[index], np.zeros(model.effects[index].values.shape)
    if effect.candidate.indistinguishable_forms:
        bound = _EQUIVALENT_ERROR_RATIO * squared_error(model, rows)
        for form in effect.candidate.indistinguishable_forms:
            other = fit(model.with_replaced_effect(index, attrs.evolve(effect, candidate=form)), rows)
            if squared_error(other, rows) < bound:
                change = np.maximum(change, np.abs(other.effects[index].values - effect.values))
    return change


def _split_error(model: Model, rows: Bools, allowed: float) -> list[Array]:
    """Largest changes (P, J) of each effect's values at other splits of the delays that are nearly as good.

    An inertia, kd and the output delay make up for each other far beyond the linear range, and the
    delay may lie at its bound. `allowed` is the increase of the sum of squares, N^2 m^2.
    """
    changes = [np.zeros(effect.values.shape) for effect in model.effects]
    if any(effect.candidate.confounded_with_delays for effect in model.effects):
        limit, total = squared_error(model, rows) + allowed, model.delays.sum(axis=0)
        for change in _OUTPUT_DELAY_CHANGES_S:
            output = np.clip(model.delays[1] + change, 0.0, np.minimum(total, MAX_DELAYS_S[1]))
            other = fit(model.with_delays(np.stack([total - output, output])), rows, delays=False)
            if squared_error(other, rows) < limit:
                for k, (mine, its) in enumerate(zip(model.effects, other.effects, strict=True)):
                    changes[k] = np.maximum(changes[k], np.abs(its.values - mine.values))
    return changes


def parameters_at_bound(model: Model) -> tuple[str, ...]:
    """List the parameters that lie on one of their bounds.

    Args:
        model: The fitted model.

    Returns:
        Names: `input_delay`, `output_delay`, or `effect.parameter`.
    """
    found = [
        name
        for name, values, most in zip(
            ("input_delay", "output_delay"), model.delays, MAX_DELAYS_S, strict=True
        )
        if (values >= most - 1e-9).any()
    ]
    for effect in model.effects:
        for parameter, values in zip(effect.candidate.parameters, effect.values, strict=True):
            # Relative round-off of the bounds.
            reach = 1e-9 * max(abs(parameter.low), abs(parameter.high))
            at_bound = (values <= parameter.low + reach) | (values >= parameter.high - reach)
            if (at_bound & effect.active).any():
                found.append(f"{effect.candidate.name}.{parameter.name}")
    return tuple(found)
