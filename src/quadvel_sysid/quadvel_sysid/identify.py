"""From measured logs to a corrected actuator model and a report: the whole of the identification, step by step.

`preparation` makes samples of the logs and divides their rows into those that are fitted, that select and that are reported;
`selection` searches for effects; the chosen model is fitted to all rows, `confidence` says how sure its values are, and
`outcome` makes the report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from quadvel_actuator.parameters import ActuatorParameters

from .baselines import baseline_errors
from .confidence import intervals
from .criterion import DataSplit, noise_variance
from .delays import longest_equivalent_delay, quantised_delays
from .eam import WINDOWS, pd_torque
from .export_parameters import parameters
from .fit import fit
from .fitted_model import FittedModel, ModelEvaluator
from .identification import Identification
from .identification_data import VALUES, IdentificationData, Progress, prepare
from .library import SignalTerm
from .logs.dataset import Dataset
from .logs.log import Log, LogError
from .lost_commands import reassign_losses
from .model import Model
from .motion import STRETCH_S, Body, Replay, replay_errors
from .outcome import Outcome, SelectedEffect, identification
from .preparation import MIN_BLOCK_S, Preprocessed, preprocess
from .replay import EXPLANATION as LEG_TEXT
from .replay import MIN_BLOCK_S as LEG_BLOCK
from .replay import STRETCH_S as LEG_STRETCH
from .replay import Legs
from .sanity_checks import contradictions
from .selection import Search
from .signals import Array, Bools, Samples

_SEARCHED, _COARSEST = 30_000, 0.002
"""Values of torque that are searched, as long as their rows are not farther apart (s); what is found is fitted to all"""
_MOVES = 0.9
"""Of the error of a replay: what a model with more in it has to leave at most"""


def identify(
    train: Sequence[Log],
    heldout: Sequence[Log] = (),
    gains: tuple[float, float] | None = None,
    values: int = VALUES,
    **options: Any,
) -> Identification:
    """Fit `train`, report on `heldout`, or on blocks of `train` kept aside where there is none.

    gains: kp (N m/rad) and kd (N m s/rad) of logs that hold none. values: how many of torque are looked at, of all logs and
    joints; longer logs are cut to pieces spread over all of each. options: as those of `identified`. Raises LogError where
    the logs cannot be used together.
    """
    return identified(prepare(Dataset.inspect_all(train, heldout, gains), values), **options)


def identified(
    material: IdentificationData,
    base: ActuatorParameters | None = None,
    cores: int = 1,
    progress: Progress = lambda share, text: None,
    robot: str | None = None,
) -> Identification:
    """The same of `material`: who does not hold the whole of a long log has more memory for it.

    base: its torque limits go into the corrected model. cores: that work side by side; the report is the same. robot: whose
    legs the reported rows are replayed on, `aliengo`, `go2`, or an MJCF or URDF file. `progress(share, text)` is called now
    and then.
    """
    body = material.body
    legs = None if robot is None else _legs(robot, material)
    progress(0.02, "gains and delays")
    windows = WINDOWS if body is None else (material.logs[0].period,)
    shortest = MIN_BLOCK_S if legs is None or material.heldout else LEG_BLOCK
    reading, notes = preprocess(material, windows, shortest)
    steps = iter(range(10**6))

    def tick(text: str) -> None:
        progress(min(0.1 + 0.04 * next(steps), 0.85), text)

    plain = _plain(reading)
    noise = noise_variance(reading.samples, reading.parts.fit_or_select, plain.residual())
    samples, rows = _searched(reading)
    judge = ModelEvaluator(reading.parts.select_rows(rows), noise, cores)
    plain = attrs.evolve(plain, samples=samples)
    search, before = Search(judge, tick), judge.fit(plain)
    best, of_laws = search.best(plain)
    corrected = base or ActuatorParameters.default()
    replayer = None if body is None and legs is None else _Replayer(body, legs, reading, corrected)
    progress(0.88, "replays" if replayer else "intervals")
    tries = [before, best]
    if replayer:
        laws = of_laws if of_laws is best else search.prune(of_laws)
        tries = [before, laws, best, *search.nested_models(laws)]
    refitted = {one: _refitted(one, reading, noise) for one in dict.fromkeys(tries)}
    chosen = replayer.choose(refitted) if replayer else best
    progress(0.93, "intervals")
    outcome = _outcome(chosen, refitted[before], refitted[chosen], search, reading, material, corrected)
    found = identification(outcome, [*material.findings, *notes])
    parts, samples = reading.parts, reading.samples
    logs = [one.log for one in samples.logs]
    report = {**found.report, "baselines": baseline_errors(logs, parts.fit_or_select, parts.report)}
    if replayer:
        report |= replayer.section(outcome)
    if body is not None:
        report |= _told_of_motion(report)
    report["warnings"] = [*report["warnings"], *contradictions(report)]
    progress(1.0, "done")
    return attrs.evolve(found, report=report)


def _legs(robot: str, material: IdentificationData) -> Legs:
    """The legs that the logs' commands are replayed on. Raises LogError where the logs do not hold what that takes."""
    for log in material.logs:
        known = {"tau": material.body is None, "kp": log.kp is not None, "kd": log.kd is not None}
        for name, there in known.items():
            if not there:
                what = "the torque" if name == "tau" else "the commanded gains (or --gains KP KD)"
                raise LogError(
                    f"{log.name}: {name}: not in the log, expected {what} to replay the commands (--robot)"
                )
    return Legs.load(robot, material.logs[0].joints)


def _searched(reading: Preprocessed) -> tuple[Samples, NDArray[np.intp]]:
    """The samples that are searched, and which rows these are: none of a log that is held out, and no more than it takes."""
    samples = reading.samples.drop_heldout(reading.parts.fit_or_select)
    step = min(round(samples.tau.size / _SEARCHED), round(_COARSEST / samples.period))
    if step > 1:
        return samples.thinned(step)
    return samples, np.arange(len(samples.t))


def _plain(reading: Preprocessed) -> Model:
    """The EAM as a model that effects can be added to."""
    eam, one = reading.eam, np.zeros(len(reading.samples.joints), dtype=np.intp)
    delays = np.stack([eam.input_delay, eam.output_delay])
    return Model(reading.samples, eam.window, eam.gains, one, delays, one)


def _refitted(account: FittedModel, reading: Preprocessed, noise: Array) -> Model:
    """The model of an account with values of all rows that fit and select."""
    parts, samples = reading.parts, reading.samples
    model = attrs.evolve(account.model, samples=samples)
    if len(samples.t) > len(account.model.samples.t):
        model = reassign_losses(model, parts, noise)
    return longest_equivalent_delay(fit(model, parts.fit_or_select), parts.fit_or_select)


def _outcome(
    account: FittedModel,
    before: Model,
    model: Model,
    search: Search,
    reading: Preprocessed,
    material: IdentificationData,
    base: ActuatorParameters,
) -> Outcome:
    """The chosen model and the plain one, both refitted, with values of every row, and errors of the rows that chose nothing."""
    parts, samples = reading.parts, reading.samples
    every = parts.fit_or_select if material.heldout else parts.all_rows
    before_whole, whole = (
        quantised_delays(longest_equivalent_delay(fit(one, every), every), every) for one in (before, model)
    )
    effects = tuple(
        SelectedEffect(*_worth(model, k, parts), search.indistinguishable_effects(account, k))
        for k in range(len(model.effects))
    )
    has_terms = any(isinstance(one.law, SignalTerm) for one in model.effects)
    leaning = () if account.is_white or has_terms else search.residual_correlates(account)
    names = {one.law.name for one in model.effects}
    rejected = tuple((name, *why) for name, why in search.rejected.items() if name not in names)
    asked = np.ones_like(whole.gains)
    asked[1] = 0.0 if samples.undamped else 1.0
    ideal = pd_torque(samples, asked, 0.0, 0.0, 0.0)
    return Outcome(
        before, before_whole, model, whole, effects, rejected, account.is_white, leaning,
        intervals(whole, attrs.evolve(parts, report=parts.report & every)), ideal, search.evaluator.noise, parts, base,
    )  # fmt: skip


def _worth(model: Model, index: int, parts: DataSplit) -> tuple[float, float]:
    """What an effect takes off the error of the rows that chose nothing, and its p-value there."""
    without = fit(model.without_effect(index), parts.fit_or_select)
    worth = parts.compare(without.residual(), model.residual(), parts.report)
    return worth.gain, worth.p


@attrs.frozen(eq=False)
class _Replayer:
    """Commands replayed on what the joints carry: of several models the one that moves it as it moved is chosen."""

    body: Body | None
    legs: Legs | None
    reading: Preprocessed
    base: ActuatorParameters

    def choose(self, tries: Mapping[FittedModel, Model]) -> FittedModel:
        """The account with whose model the commands replay the motion best.

        A later one has to replay clearly better than those before it on the rows that fit and select: the laws than the plain
        model, terms than laws, and fewer laws than all. Terms can mistake the errors of encoders for an effect, or foretell a
        torque only where the joint does what it did, and a law can stand for how the log was written; a replay does not take
        that for motion.
        """
        best, least = next(iter(tries)), np.inf
        for account, model in tries.items():
            error = self._replay(model, self.reading.parts.fit_or_select)["dq_rms_rad_s"]
            if error < _MOVES * least:
                best, least = account, error
        return best

    def section(self, outcome: Outcome) -> dict[str, Any]:
        """The section of the report about the replay of the rows that chose nothing."""
        rows = self.reading.parts.report
        sizes = {"before": self._replay(outcome.before, rows), "after": self._replay(outcome.model, rows)}
        if self.body is None:
            return {"replay": {"stretch_s": LEG_STRETCH, **sizes, "text": LEG_TEXT}}
        return {
            "motion": {
                "inertia": {"value": self.body.inertia.tolist(), "unit": "kg m^2"},
                "replayed_s": STRETCH_S,
                "text": "No torque was logged: the one that the motion implies stands for it, so an armature is part of "
                "the inertia and an encoder bias part of the torque offset.",
                **sizes,
            }
        }

    def _replay(self, model: Model, rows: Bools) -> Replay:
        logs = [one.log for one in self.reading.samples.logs]
        corrected = parameters(model, self.reading.parts, self.base)
        if self.legs is not None:
            return self.legs.replay_errors(logs, corrected, rows)
        assert self.body is not None
        return replay_errors(logs, corrected, self.body, rows)


def _told_of_motion(report: Mapping[str, Any]) -> dict[str, Any]:
    """What changes in a report where the torque is what the motion implies."""
    before, after = report["motion"]["before"], report["motion"]["after"]
    decision = (
        f"From motion alone. {report['decision']} Replayed over {1e3 * STRETCH_S:.0f} ms, the error of q goes from "
        f"{before['q_rms_rad']:.3g} to {after['q_rms_rad']:.3g} rad."
    )
    return {
        "before": report["before"] | {f"heldout_{name}": value for name, value in before.items()},
        "after": report["after"] | {f"heldout_{name}": value for name, value in after.items()},
        "decision": decision,
    }
