"""Entrants of the contest: the identification of quadvel, and what others use instead of it.

An entrant is a function from a `SharedLog` to an `Answer`. Only `quadvel` and `friction_pd` name
effects; the others predict torques.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import attrs
import numpy as np

from benchmarks.identification.contest import SharedLog
from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.arrays import Array, Bools, Floats
from quadvel_sysid.data.plain_model import fit_eam
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import Log
from quadvel_sysid.statistics.baselines import LAG_STEP_S, MAX_DELAY_S, baseline_predictions

MODEL_STEP_S = 0.001  # s, of a model that runs step by step
NO_LIMIT_N_M = 1000.0
"""The logs are not of our robot; an identified limit is an effect."""
FRICTION_WIDTH_RAD_S = 0.05  # rad/s, of the smooth sign of the speed
FRICTION_SHARE = 0.05
"""`friction_pd` names friction on a joint if it removes this share of the squared error."""
NETWORK_LAGS_S = (0.0, 0.004, 0.008, 0.012, 0.016)  # s, of the past that the network sees
NETWORK_UNITS, NETWORK_STEPS, NETWORK_RATE = 32, 500, 0.01


@attrs.frozen(eq=False)
class Answer:
    """What an entrant says about one log.

    Attributes:
        torque: Predictions for the rows whose torque is unknown, (n, J), N m.
        effects: Named effects as in report.json: `name`, `joints`, `params`, `indistinguishable`.
        depends_on: Signals that an effect without a name depends on, as in report.json.
    """

    torque: Floats
    effects: list[dict[str, Any]] = attrs.Factory(list)
    depends_on: list[str] = attrs.Factory(list)

    def to_json(self) -> dict[str, Any]:
        """Convert the answer to its entry in the file of answers."""
        return {
            "effects": self.effects,
            "depends_on": self.depends_on,
            "torque": np.round(self.torque, 4).tolist(),
        }


def quadvel(shared: SharedLog) -> Answer:
    """`quadvel identify` with its defaults; its model runs step by step."""
    found = identify([shared.train])
    kept = ("name", "joints", "params", "indistinguishable")
    effects = [{key: entry[key] for key in kept} for entry in found.report["effects"]]
    torque = modelled_torque(found.parameters, shared.log)[~shared.known]
    return Answer(torque, effects, list(found.report["unexplained"]["depends_on"]))


def modelled_torque(parameters: ActuatorParameters, log: Log) -> Array:
    """Run an actuator model on the commands and the motion of a log.

    Args:
        parameters: Parameters of the model.
        log: The log, N rows of J joints.

    Returns:
        Torque, (N, J), N m.
    """
    parameters = attrs.evolve(parameters, torque_noise=0.0, torque_limit=NO_LIMIT_N_M)
    model = ActuatorModel(parameters, (len(log.joints),), MODEL_STEP_S)
    times = np.arange(log.t[0], log.t[-1] + MODEL_STEP_S, MODEL_STEP_S)
    q, dq = (_interpolated(times, log.t, values) for values in (log.q, log.dq))
    sent = log.command_rows(times)
    ones = np.ones_like(log.q_des)
    kp, kd = (ones if gains is None else gains for gains in (log.kp, log.kd))
    rows = zip(q, dq, log.q_des[sent], kp[sent], kd[sent], strict=True)
    torque = np.array([model.step(*row) for row in rows])
    return _interpolated(log.t, times, torque)


def _interpolated(at: Floats, t: Floats, values: Floats) -> Array:
    """Columns of (N, J) values at other times."""
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def plain_eam(shared: SharedLog) -> Answer:
    """The paper's model: gains and two delays, the same for all joints."""
    samples = Samples.of([shared.log])
    rows = np.repeat(shared.known[:, None], len(shared.log.joints), axis=1)
    return Answer(fit_eam(samples, rows).predict(samples)[~shared.known])


def joint_pd(shared: SharedLog) -> Answer:
    """A PD law of each joint, with an offset and a delay of the command."""
    return _baseline(shared, "joint_pd")


def ridge(shared: SharedLog) -> Answer:
    """A linear filter of the commands, angles and speeds of each joint."""
    return _baseline(shared, "ridge")


def _baseline(shared: SharedLog, name: str) -> Answer:
    """One of the baselines in every report."""
    rows = np.repeat(shared.known[:, None], len(shared.log.joints), axis=1)
    return Answer(baseline_predictions(Samples.of([shared.log]), rows)[name][~shared.known])


def friction_pd(shared: SharedLog) -> Answer:
    """A PD law of each joint with Coulomb and viscous friction.

    tau = kp q_des(t - d) - kp' q - (kd + b) dq - c tanh(dq / w) + offset, for the best delay d. The
    viscous friction b cannot be separated from kd, so that only Coulomb friction is named.
    """
    log, known = shared.log, shared.known
    laws = [_friction_law(log, j, known) for j in range(len(log.joints))]
    sizes = {joint: law.friction for joint, law in zip(log.joints, laws, strict=True) if law.friction}
    effect: dict[str, Any] = {
        "name": "coulomb_friction",
        "joints": list(sizes),
        "params": {"c": {"value": list(sizes.values())}},
        "indistinguishable": [],
    }
    torque = np.stack([law.torque for law in laws], axis=1)
    return Answer(torque[~known], [effect] if sizes else [])


@attrs.frozen(eq=False)
class _FrictionLaw:
    """PD law with friction of one joint: its torque (N,), N m, and Coulomb friction, 0 if none is seen."""

    torque: Floats
    friction: float
    error: float


def _friction_law(log: Log, j: int, known: Bools) -> _FrictionLaw:
    """Law of joint `j` with the best delay of the command, fitted to the known rows."""
    assert log.tau is not None
    tau, sign = log.tau[:, j], np.tanh(log.dq[:, j] / FRICTION_WIDTH_RAD_S)
    laws = []
    for delay in np.arange(0.0, MAX_DELAY_S + LAG_STEP_S / 2, LAG_STEP_S):
        target = log.q_des[log.command_rows(log.t - delay), j]
        signals = np.stack([target, log.q[:, j], log.dq[:, j], np.ones_like(sign), sign], axis=1)
        _, without = _least_squares(signals[:, :-1], tau, known)
        weights, error = _least_squares(signals, tau, known)
        friction = max(-float(weights[-1]), 0.0)
        seen = without - error > FRICTION_SHARE * without
        laws.append(_FrictionLaw(signals @ weights, friction if seen else 0.0, error))
    return min(laws, key=lambda law: law.error)


def _least_squares(signals: Floats, tau: Floats, rows: Bools) -> tuple[Floats, float]:
    """Weights of a linear regression on some rows, and its mean squared error there."""
    weights: Floats = np.linalg.lstsq(signals[rows], tau[rows], rcond=None)[0]
    return weights, float(np.mean((tau[rows] - signals[rows] @ weights) ** 2))


def network(shared: SharedLog) -> Answer:
    """A small network of position errors and speeds of the past, one for all joints (Hwangbo 2019)."""
    import torch  # only this entrant needs it

    torch.manual_seed(0)
    log, known = shared.log, shared.known
    assert log.tau is not None
    signals = []
    for lag in NETWORK_LAGS_S:
        at = log.t - lag
        error = log.q_des[log.command_rows(at)] - _interpolated(at, log.t, log.q)
        signals += [error, _interpolated(at, log.t, log.dq)]
    x = np.stack(signals, axis=-1)  # (N, J, 2 lags)
    x = (x - x[known].mean(axis=(0, 1))) / (x[known].std(axis=(0, 1)) + 1e-9)
    size = float(log.tau[known].std())
    widths = (x.shape[-1], NETWORK_UNITS, NETWORK_UNITS, 1)
    layers: list[torch.nn.Module] = []
    for inner, outer in itertools.pairwise(widths):
        layers += [torch.nn.Linear(inner, outer), torch.nn.Softsign()]
    model = torch.nn.Sequential(*layers[:-1])
    inputs = torch.as_tensor(x, dtype=torch.float32)
    wanted = torch.as_tensor(log.tau[known] / size, dtype=torch.float32)
    optimizer = torch.optim.Adam(model.parameters(), NETWORK_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, NETWORK_STEPS)
    for _ in range(NETWORK_STEPS):
        optimizer.zero_grad()
        loss = torch.nn.functional.mse_loss(model(inputs[known])[..., 0], wanted)
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return Answer(size * model(inputs[~known])[..., 0].double().numpy())


ENTRANTS: dict[str, Callable[[SharedLog], Answer]] = {
    entrant.__name__: entrant for entrant in (quadvel, plain_eam, joint_pd, friction_pd, ridge, network)
}
"""Our entrants by name."""
