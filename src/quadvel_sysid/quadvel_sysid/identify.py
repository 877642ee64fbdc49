"""System identification of joint actuators: from measured logs to a corrected model and a report.

The steps, each of which takes what the one before returns:

    Log -> check_logs -> CheckedLog -> Dataset.prepare -> Dataset -> preprocess -> Samples
        -> Search.best -> FittedModel -> refits -> Outcome -> build_identification -> Identification
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.parameters import ActuatorParameters

from .data.clocks import RecordingClock, align_heldout, known_offsets
from .data.dataset import Dataset, Progress, no_progress
from .data.noise import noise_variance
from .data.plain_model import DRIVE_WINDOWS_S
from .data.preparation import Preprocessed, preprocess
from .data.signals import Samples
from .data.split import MIN_BLOCK_S, DataSplit
from .export.replay import Load, Replay, find_load
from .logs.check_log import check_logs
from .logs.findings import Finding
from .logs.log import Log, LogError
from .model.delays import central_equivalent_delay, quantised_delays
from .model.fit import fit, fit_delay_splits
from .model.torque_model import Model
from .options import DEFAULTS, IdentifyOptions, SearchOptions
from .report.identification import Identification
from .report.outcome import Evidence, Outcome, SelectedEffect, build_identification
from .report.sanity_checks import contradictions, implausibilities
from .report.summary_text import leave_one_out, motion_summary, withheld_summary
from .search.fitted_model import FittedModel, ModelEvaluator
from .search.lost_commands import reassign_losses
from .search.regressors import RegressorCandidate
from .search.selection import Search, SearchRecord
from .statistics.baselines import baseline_errors
from .statistics.confidence import intervals
from .statistics.criterion import compare_residuals
from .statistics.reading_error import reading_errors

_SEARCH_VALUES, _MAX_SEARCH_STEP_S = 30_000, 0.002
"""Number of torque values that the search uses, and the maximum step of its rows, s.

The step has priority: the search uses more values rather than a larger step. The final fit uses all
rows.
"""
_BLOCK_STRETCHES = 1.25
"""Shortest block of rows that holds a stretch of a replay, over the length of the stretch."""


def identify(
    train: Sequence[Log],
    heldout: Sequence[Log] = (),
    options: IdentifyOptions = DEFAULTS,
    progress: Progress = no_progress,
) -> Identification:
    """Identify the actuators from logs.

        logs = [read_log("walk_1.npz"), read_log("walk_2.npz")]
        found = identify(logs[:1], logs[1:], IdentifyOptions(gains=(35.0, 0.5), cores=2))
        found.report["decision"], found.parameters

    Args:
        train: Logs to fit, at least one, with N state rows of J joints each.
        heldout: Logs to report on, with the same joints; blocks of `train` if empty.
        options: Commanded gains, number of values, base model, robot for the replay, cores.
        progress: Receives the completed fraction (0 to 1) and the next step.

    Returns:
        Report (the content of report.json), corrected model and series for figures.

    Raises:
        LogError: A check refuses a log, or the logs cannot be used together.
    """
    checked = check_logs(train, heldout, options.gains)
    return identify_dataset(Dataset.prepare(*checked, options.max_values, progress), options, progress)


def identify_dataset(
    dataset: Dataset, options: IdentifyOptions = DEFAULTS, progress: Progress = no_progress
) -> Identification:
    """Identify the actuators from checked logs.

    Who prepares the dataset first can release the memory of the full logs. If several logs are
    fitted and none is held out, each of them is held out in turn as well (leave-one-log-out).

    Args:
        dataset: Checked logs, with excerpts of the long ones.
        options: Base model, robot for the replay, cores; gains and number of values are in
            `dataset` already.
        progress: Receives the completed fraction (0 to 1) and the next step.

    Returns:
        Report, corrected model and series for figures.

    Raises:
        LogError: The commands cannot be replayed, or a joint has too few rows.
    """
    count = 0 if dataset.heldout or len(dataset.pieces) == 1 else len(dataset.pieces)

    def progress_of(part: int) -> Progress:
        return lambda share, text: progress((part + share) / (count + 1), text)

    found = _identify_once(dataset, options, progress_of(0))
    if not count:
        return found
    folds = [_identify_once(dataset.hold_out(k), options, progress_of(k + 1)).report for k in range(count)]
    return attrs.evolve(found, report={**found.report, "leave_one_out": leave_one_out(folds)})


def _identify_once(dataset: Dataset, options: IdentifyOptions, progress: Progress) -> Identification:
    """Identify the actuators from one division of the logs."""
    # 1. Samples, data split and plain EAM.
    base = options.base or ActuatorParameters.of(dataset.robot)
    if base.robot != dataset.robot.name:
        raise LogError(f"base: robot is {base.robot!r}, expected {dataset.robot.name!r} as of the logs")
    load = find_load(dataset, options.robot)
    progress(0.02, "gains and delays")
    prepared, notes = _preprocess(dataset, load, options.search)
    parts = prepared.parts

    # 2. Search for effects on a subset of the rows.
    evaluator, plain = _evaluator(prepared, options)
    search, before = Search(evaluator, _step_counter(progress)), evaluator.fit(plain)
    searched = search.best(plain)
    best, best_effects = searched.best, searched.best_effects

    # 3. Refit to all rows that are not reported; replays choose between nested models if there is a load.
    replay = None if load is None else Replay(load, prepared, base)
    progress(0.88, "replays" if replay else "intervals")
    models = [before, best, best_effects]
    if replay:
        effects = best_effects if best_effects is best else search.prune(best_effects)
        models += [effects, *search.nested_models(effects)]
    refitted = {one: _refit_all_rows(one, prepared) for one in dict.fromkeys(models)}
    chosen = replay.choose(refitted) if replay else best

    # 4. Clocks of held-out recordings as each model sees them, intervals and report.
    progress(0.93, "intervals")
    aligned = {one: _aligned(refitted[one], dataset, prepared) for one in {before, chosen, best_effects}}
    after, clocks = aligned[chosen]
    outcome = Outcome(
        before=aligned[before][0],
        after=after,
        effects_alone=aligned[best_effects][0],
        evidence=_evidence(search, searched.record, chosen, after, parts),
        half_widths=intervals(after, parts, evaluator.noise, evaluator.reading_error, known_offsets(clocks)),
        noise=evaluator.noise,
        parts=parts,
        base=base,
        clocks=clocks,
    )
    found = build_identification(outcome, [*dataset.findings, *notes])
    report = {**found.report, **_comparisons(outcome, prepared.samples, replay)}
    if "motion" in report:
        report |= motion_summary(report)
    report |= withheld_summary(report, list(implausibilities(after, parts)), list(contradictions(report)))
    progress(1.0, "done")
    return attrs.evolve(found, report=report)


def _preprocess(
    dataset: Dataset, load: Load | None, options: SearchOptions
) -> tuple[Preprocessed, list[tuple[str, Finding]]]:
    """Samples, data split and plain EAM, and notes on what was corrected."""
    windows = DRIVE_WINDOWS_S if dataset.body is None else (dataset.logs[0].period,)
    shortest = MIN_BLOCK_S
    if load is not None and not dataset.heldout:
        shortest = max(MIN_BLOCK_S, _BLOCK_STRETCHES * load.stretch_s)
    return preprocess(dataset, windows, shortest, options)


def _evaluator(prepared: Preprocessed, options: IdentifyOptions) -> tuple[ModelEvaluator, Model]:
    """The data of the search, and the EAM on them as a model that effects can be added to."""
    eam, one = prepared.eam, np.zeros(len(prepared.samples.joints), dtype=np.intp)
    delays = np.stack([eam.input_delay, eam.output_delay])
    plain = Model(prepared.samples, eam.window, eam.gains, one, delays, one)
    noise = noise_variance(prepared.samples, prepared.parts.fit_or_select, plain.residual())
    reading_error = reading_errors(plain, prepared.parts.fit_or_select)
    # The search uses fewer rows, and none of the held-out logs.
    samples = prepared.samples.drop_heldout(prepared.parts.fit_or_select)
    step = min(round(samples.tau.size / _SEARCH_VALUES), round(_MAX_SEARCH_STEP_S / samples.period))
    samples, rows = samples.thinned(max(step, 1))
    evaluator = ModelEvaluator(
        prepared.parts.select_rows(rows), noise, reading_error, options.cores, options.search
    )
    return evaluator, attrs.evolve(plain, samples=samples)


def _step_counter(progress: Progress) -> Callable[[str], None]:
    """A callback for the steps of the search, whose number is not known in advance."""
    numbers = iter(range(10**6))
    return lambda text: progress(min(0.1 + 0.04 * next(numbers), 0.85), text)


def _refit_all_rows(fitted: FittedModel, prepared: Preprocessed) -> Model:
    """The model refitted to all rows that fit or select; the report judges it, and the file holds it."""
    parts, samples, evaluator = prepared.parts, prepared.samples, fitted.evaluator
    model = attrs.evolve(fitted.model, samples=samples)
    if len(samples.t) > len(fitted.model.samples.t):
        model = reassign_losses(model, parts, evaluator.noise)
    rows = parts.fit_or_select
    model = fit(model, rows)
    if not evaluator.options.central_delays:
        return model
    return quantised_delays(central_equivalent_delay(model, rows), rows)


def _aligned(
    model: Model, dataset: Dataset, prepared: Preprocessed
) -> tuple[Model, tuple[RecordingClock, ...]]:
    """The model on held-out recordings whose commands are shifted as it predicts them best, and all clocks."""
    samples, clocks = model.samples, []
    for clock, pieces in zip(prepared.clocks, dataset.pieces, strict=True):
        if clock.heldout and clock.offset_s is not None:
            mine = np.isin(samples.log_of_row, pieces)[:, None]
            rows = samples.evaluated & mine & ~prepared.parts.report
            samples, shift = align_heldout(
                lambda moved: attrs.evolve(model, samples=moved).predict(), samples, pieces, rows
            )
            clock = clock.shifted_further(shift)
        clocks.append(clock)
    return attrs.evolve(model, samples=samples), tuple(clocks)


def _evidence(
    search: Search, record: SearchRecord, fitted: FittedModel, model: Model, parts: DataSplit
) -> Evidence:
    """Evidence for and against effects; `model` is `fitted`, refitted to all rows."""
    effects = tuple(
        SelectedEffect(*_heldout_gain(model, k, parts), search.indistinguishable_effects(fitted, k, record))
        for k in range(len(model.effects))
    )
    has_regressors = any(isinstance(one.candidate, RegressorCandidate) for one in model.effects)
    names = {one.candidate.name for one in model.effects}
    return Evidence(
        effects=effects,
        rejected=tuple((name, *why) for name, why in record.rejected.items() if name not in names),
        is_white=fitted.is_white,
        correlates=() if fitted.is_white or has_regressors else search.residual_correlates(fitted),
    )


def _comparisons(outcome: Outcome, samples: Samples, replay: Replay | None) -> dict[str, Any]:
    """Sections of the report: errors of the baselines, and of replays where there is a load."""
    parts = outcome.parts
    # Held-out recordings are aligned by three models; each baseline is judged where it is best.
    alignments = dict.fromkeys((samples, outcome.before.samples, outcome.samples))
    each = [baseline_errors(one, parts.fit_or_select, parts.report) for one in alignments]
    baselines = {name: min((one[name] for one in each), key=itemgetter("heldout_mse")) for name in each[0]}
    replays = replay.section(outcome.before, outcome.after) if replay else {}
    return {"baselines": baselines, **replays}


def _heldout_gain(model: Model, index: int, parts: DataSplit) -> tuple[float, float]:
    """Error reduction (N^2 m^2) of an effect on the reported rows, and its p-value there."""
    rows = parts.fit_or_select
    without = fit(model.without_effect(index), rows)
    if model.effects[index].candidate.confounded_with_delays:
        without = fit_delay_splits(without, rows)
    comparison = compare_residuals(parts, without.residual(), model.residual(), parts.report)
    return comparison.gain, comparison.p_value
