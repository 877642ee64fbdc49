"""System identification of joint actuators: from measured logs to a corrected model and a report.

The steps: `preparation` builds samples from the logs and splits their rows into fitted, selection
and reported rows; `selection` searches for effects; the selected model is refitted to all rows;
`confidence` computes the intervals; `outcome` builds the report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.parameters import ActuatorParameters
from quadvel_description.arrays import Array, Bools, Indices

from .data.identification_data import MAX_TORQUE_VALUES, IdentificationData, Progress, prepare
from .data.motion import STRETCH_S, Body, Replay, replay_errors
from .data.noise import noise_variance
from .data.plain_model import DRIVE_WINDOWS_S, pd_torque
from .data.preparation import MIN_BLOCK_S, Preprocessed, preprocess
from .data.signals import Samples
from .data.split import DataSplit
from .export.export_parameters import actuator_parameters
from .export.replay import EXPLANATION as LEG_TEXT
from .export.replay import MIN_BLOCK_S as LEG_BLOCK
from .export.replay import STRETCH_S as LEG_STRETCH
from .export.replay import Legs
from .logs.dataset import Dataset
from .logs.log import Log, LogError
from .model.delays import longest_equivalent_delay, quantised_delays
from .model.fit import fit
from .model.torque_model import Model
from .report.identification import Identification
from .report.outcome import Outcome, SelectedEffect, build_identification
from .report.sanity_checks import contradictions
from .search.fitted_model import FittedModel, ModelEvaluator
from .search.lost_commands import reassign_losses
from .search.regressors import RegressorCandidate
from .search.selection import Search, SearchRecord
from .statistics.baselines import baseline_errors
from .statistics.confidence import intervals
from .statistics.criterion import compare_residuals

_SEARCH_VALUES, _MAX_SEARCH_STEP_S = 30_000, 0.002
"""Number of torque values that the search uses, and the maximum step of its rows, s.

The step has priority: the search uses more values rather than a larger step. The final fit uses all
rows.
"""
_REPLAY_ERROR_RATIO = 0.9
"""Ratio of the replay error of a larger to a smaller model below which the larger one is chosen."""


def identify(
    train: Sequence[Log],
    heldout: Sequence[Log] = (),
    gains: tuple[float, float] | None = None,
    values: int = MAX_TORQUE_VALUES,
    **options: Any,
) -> Identification:
    """Identify the actuators from logs.

    Args:
        train: Logs to fit.
        heldout: Logs to report on; blocks of `train` if empty.
        gains: kp (N m/rad) and kd (N m s/rad) of logs without commanded gains.
        values: Maximum number of torque values to use, over all logs and joints. Longer logs are
            cut into excerpts spread over their whole length.
        **options: Keyword arguments of `identify_prepared`.

    Returns:
        Report, corrected model and series for figures.

    Raises:
        LogError: If the logs cannot be used together.
    """
    return identify_prepared(prepare(Dataset.inspect_all(train, heldout, gains), values), **options)


def identify_prepared(
    data: IdentificationData,
    base: ActuatorParameters | None = None,
    cores: int = 1,
    progress: Progress = lambda share, text: None,
    robot: str | None = None,
) -> Identification:
    """Identify the actuators from prepared data.

    Prepare the data first and pass it here, so that the memory of full logs can be released.

    Args:
        data: Excerpts of the logs; see `identification_data.prepare`.
        base: Parameters whose torque limits the corrected model keeps; the defaults if None.
        cores: Worker processes; the report does not depend on them.
        progress: Receives the completed fraction and the next step.
        robot: Robot whose legs the reported rows are replayed on: `aliengo`, `go2`, or the path of
            an MJCF or URDF file. No replay if None.

    Returns:
        Report, corrected model and series for figures.
    """
    # 1. Samples, data split and plain EAM.
    body = data.body
    legs = None if robot is None else _load_legs(robot, data)
    progress(0.02, "gains and delays")
    windows = DRIVE_WINDOWS_S if body is None else (data.logs[0].period,)
    shortest = MIN_BLOCK_S if legs is None or data.has_heldout else LEG_BLOCK
    preprocessed, notes = preprocess(data, windows, shortest)
    step_numbers = iter(range(10**6))

    def report_step(text: str) -> None:
        progress(min(0.1 + 0.04 * next(step_numbers), 0.85), text)

    # 2. Search for effects on a subset of the rows.
    plain = _plain_model(preprocessed)
    noise = noise_variance(preprocessed.samples, preprocessed.parts.fit_or_select, plain.residual())
    samples, rows = _search_rows(preprocessed)
    evaluator = ModelEvaluator(preprocessed.parts.select_rows(rows), noise, cores)
    plain = attrs.evolve(plain, samples=samples)
    search, before = Search(evaluator, report_step), evaluator.fit(plain)
    searched = search.best(plain)
    best, best_effects = searched.best, searched.best_effects

    # 3. Refit to all rows, and choose between nested models by replays where there is a load.
    corrected = base or ActuatorParameters.default()
    replayer = None if body is None and legs is None else _Replayer(body, legs, preprocessed, corrected)
    progress(0.88, "replays" if replayer else "intervals")
    models = [before, best]
    if replayer:
        effects = best_effects if best_effects is best else search.prune(best_effects)
        models = [before, effects, best, *search.nested_models(effects)]
    refitted = {one: _refit_all_rows(one, preprocessed, noise) for one in dict.fromkeys(models)}
    chosen = replayer.choose(refitted) if replayer else best

    # 4. Intervals and report.
    progress(0.93, "intervals")
    outcome = _outcome(
        chosen, refitted[before], refitted[chosen], search, searched.record, preprocessed, data, corrected
    )
    found = build_identification(outcome, [*data.findings, *notes])
    parts, samples = preprocessed.parts, preprocessed.samples
    logs = [one.log for one in samples.logs]
    report = {**found.report, "baselines": baseline_errors(logs, parts.fit_or_select, parts.report)}
    if replayer:
        report |= replayer.section(outcome)
    if body is not None:
        report |= _motion_sections(report)
    report["warnings"] = [*report["warnings"], *contradictions(report)]
    progress(1.0, "done")
    return attrs.evolve(found, report=report)


def _load_legs(robot: str, data: IdentificationData) -> Legs:
    """The legs for the replay of the commands. Raises LogError if torque or gains are missing."""
    for log in data.logs:
        known = {"tau": data.body is None, "kp": log.kp is not None, "kd": log.kd is not None}
        for name, there in known.items():
            if not there:
                what = "the torque" if name == "tau" else "the commanded gains (or --gains KP KD)"
                raise LogError(
                    f"{log.name}: {name}: not in the log, expected {what} to replay the commands (--robot)"
                )
    return Legs.load(robot, data.logs[0].joints)


def _search_rows(preprocessed: Preprocessed) -> tuple[Samples, Indices]:
    """The samples that the search uses, and their row numbers; without held-out logs."""
    samples = preprocessed.samples.drop_heldout(preprocessed.parts.fit_or_select)
    step = min(round(samples.tau.size / _SEARCH_VALUES), round(_MAX_SEARCH_STEP_S / samples.period))
    if step > 1:
        return samples.thinned(step)
    return samples, np.arange(len(samples.t))


def _plain_model(preprocessed: Preprocessed) -> Model:
    """The EAM as a model that effects can be added to."""
    eam, one = preprocessed.eam, np.zeros(len(preprocessed.samples.joints), dtype=np.intp)
    delays = np.stack([eam.input_delay, eam.output_delay])
    return Model(preprocessed.samples, eam.window, eam.gains, one, delays, one)


def _refit_all_rows(fitted: FittedModel, preprocessed: Preprocessed, noise: Array) -> Model:
    """The model refitted to all rows that fit or select."""
    parts, samples = preprocessed.parts, preprocessed.samples
    model = attrs.evolve(fitted.model, samples=samples)
    if len(samples.t) > len(fitted.model.samples.t):
        model = reassign_losses(model, parts, noise)
    return longest_equivalent_delay(fit(model, parts.fit_or_select), parts.fit_or_select)


def _outcome(
    fitted: FittedModel,
    before: Model,
    model: Model,
    search: Search,
    record: SearchRecord,
    preprocessed: Preprocessed,
    data: IdentificationData,
    base: ActuatorParameters,
) -> Outcome:
    """Collect the results: both models refitted to every row, with errors on the reported rows."""
    parts, samples = preprocessed.parts, preprocessed.samples
    final_rows = parts.fit_or_select if data.has_heldout else parts.all_rows
    before_all_rows, model_all_rows = (
        quantised_delays(longest_equivalent_delay(fit(one, final_rows), final_rows), final_rows)
        for one in (before, model)
    )
    effects = tuple(
        SelectedEffect(*_heldout_gain(model, k, parts), search.indistinguishable_effects(fitted, k, record))
        for k in range(len(model.effects))
    )
    has_regressors = any(isinstance(one.candidate, RegressorCandidate) for one in model.effects)
    correlates = () if fitted.is_white or has_regressors else search.residual_correlates(fitted)
    names = {one.candidate.name for one in model.effects}
    rejected = tuple((name, *why) for name, why in record.rejected.items() if name not in names)
    commanded = np.ones_like(model_all_rows.gains)
    commanded[1] = 0.0 if samples.undamped else 1.0
    return Outcome(
        before=before,
        before_all_rows=before_all_rows,
        model=model,
        model_all_rows=model_all_rows,
        effects=effects,
        rejected=rejected,
        is_white=fitted.is_white,
        residual_correlates=correlates,
        half_widths=intervals(model_all_rows, attrs.evolve(parts, report=parts.report & final_rows)),
        ideal_torque=pd_torque(samples, commanded, 0.0, 0.0, 0.0),
        noise=search.evaluator.noise,
        parts=parts,
        base=base,
    )


def _heldout_gain(model: Model, index: int, parts: DataSplit) -> tuple[float, float]:
    """Error reduction (N^2 m^2) of an effect on the reported rows, and its p-value there."""
    without = fit(model.without_effect(index), parts.fit_or_select)
    comparison = compare_residuals(parts, without.residual(), model.residual(), parts.report)
    return comparison.gain, comparison.p_value


@attrs.frozen(eq=False)
class _Replayer:
    """Replays the commands on the load of the joints, to choose between models.

    Attributes:
        body: Load of joints without measured torque.
        legs: Legs of a robot, from its description.
        preprocessed: Samples and data split.
        base: Parameters that the corrected model extends.
    """

    body: Body | None
    legs: Legs | None
    preprocessed: Preprocessed
    base: ActuatorParameters

    def choose(self, models: Mapping[FittedModel, Model]) -> FittedModel:
        """Choose the model that replays the motion best.

        A later model has to reduce the error of the speed clearly: effects against the plain model,
        regressors against effects, and fewer effects against all. Regressors may fit encoder errors, or
        predict torque only along the recorded motion. An effect may describe how the log was written.
        None of these improves the replayed motion.

        Args:
            models: Models refitted to all rows, by their selected form, in order of preference.

        Returns:
            The chosen model.
        """
        best, least = next(iter(models)), np.inf
        for fitted, model in models.items():
            error = self._replay(model, self.preprocessed.parts.fit_or_select)["dq_rms_rad_s"]
            if error < _REPLAY_ERROR_RATIO * least:
                best, least = fitted, error
        return best

    def section(self, outcome: Outcome) -> dict[str, Any]:
        """Build the section of the report on the replay of the reported rows.

        Args:
            outcome: Results of the identification.

        Returns:
            `{"replay": ...}` or `{"motion": ...}` in the format of report.json.
        """
        rows = self.preprocessed.parts.report
        sizes = {"before": self._replay(outcome.before, rows), "after": self._replay(outcome.model, rows)}
        if self.body is None:
            return {"replay": {"stretch_s": LEG_STRETCH, **sizes, "text": LEG_TEXT}}
        return {
            "motion": {
                "inertia": {"value": self.body.inertia.tolist(), "unit": "kg m^2"},
                "replayed_s": STRETCH_S,
                "text": "No torque was logged. It is inferred from the motion, so that the inertia contains an armature and "
                "the torque offset contains an encoder bias.",
                **sizes,
            }
        }

    def _replay(self, model: Model, rows: Bools) -> Replay:
        """Replay errors of a model on some rows."""
        logs = [one.log for one in self.preprocessed.samples.logs]
        corrected = actuator_parameters(model, self.preprocessed.parts, self.base)
        if self.legs is not None:
            return self.legs.replay_errors(logs, corrected, rows)
        assert self.body is not None
        return replay_errors(logs, corrected, self.body, rows)


def _motion_sections(report: Mapping[str, Any]) -> dict[str, Any]:
    """Sections of the report that differ where the torque is inferred from the motion."""
    before, after = report["motion"]["before"], report["motion"]["after"]
    decision = (
        f"From motion alone. {report['decision']} In replays over {1e3 * STRETCH_S:.0f} ms the error of q changes from "
        f"{before['q_rms_rad']:.3g} to {after['q_rms_rad']:.3g} rad."
    )
    return {
        "before": report["before"] | {f"heldout_{name}": value for name, value in before.items()},
        "after": report["after"] | {f"heldout_{name}": value for name, value in after.items()},
        "decision": decision,
    }
