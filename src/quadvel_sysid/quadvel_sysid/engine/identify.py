"""From measured logs to a corrected actuator model and a report: the whole of the identification, step by step.

What the steps do stands in their own modules: `eam`, `floor`, `diagnosis`, `learned`, `simplest`, `residual`, `intervals`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from quadvel_actuator.parameters import ActuatorParameters

from ..baselines import baselines
from ..contradictions import contradictions
from ..identification import Identification
from ..logs.dataset import Dataset
from ..logs.excerpts import evened, jitters
from ..logs.findings import Finding
from ..logs.log import Log, LogError
from .delays import fit_with_delays, in_steps, latest
from .diagnosis import Diagnosis, diagnosed
from .eam import WINDOWS, Eam, fit_eam, pd_torque
from .floor import encoder_noise, noise_floor
from .intervals import intervals
from .judging import Judge
from .learned import Learned, beside, longest
from .material import VALUES, Material, Progress, gathered
from .model import Model
from .motion import STRETCH, Body, Replay, replayed
from .outcome import Outcome, identification, parameters
from .ranking import Rejected
from .residual import remainder
from .signals import Samples
from .simplest import Alone, account

Fit = tuple[Samples, Judge, Eam]

_HELD_OUT_EVERY = 3  # one block of three is kept aside where no log is given for it
_BLOCKS = 20  # of a log, at least
_SHORTEST_BLOCK, _LONGEST_BLOCK = 0.2, 2.0  # s
_LEAST_ROWS = 30
_CLEARLY = 0.97  # of the error
_NOISY = 0.01  # of the torque's noise: what encoders' noise may add to it
_STEADY_ROWS = np.array([1, 2, 4, 8])  # to either side, that q and dq may be averaged over
_STEADY_TIME = 0.0081  # s, at most
_AT_REST = np.array([0.02, 0.06, 0.2])  # rad/s, widths of friction's step
_BLURRED_TIME = 0.0021  # s, at most where only friction shows it: bristles and play act on as slow a scale as the longer ones
_STEADIER = 0.005  # of the noise: what each further step has to take off the error


@attrs.frozen
class Options:
    """What a user may ask for."""

    gains: tuple[float, float] | None = None
    """kp (N m/rad) and kd (N m s/rad) of logs that hold none"""
    base: ActuatorParameters | None = None
    """its torque limits go into the corrected model"""
    values: int = VALUES
    """of torque that are looked at, of all logs and joints; longer logs are cut to pieces spread over all of each"""
    cores: int = 1
    """that work side by side; the report is the same"""


def identify(
    train: Sequence[Log],
    heldout: Sequence[Log] = (),
    options: Options | None = None,
    progress: Progress = lambda share, text: None,
) -> Identification:
    """Fit `train`, judge on `heldout`, or on blocks of `train` kept aside where there is none.

    `progress(share, text)` is called now and then. Raises LogError where the logs cannot be used together.
    """
    options = options or Options()
    data = Dataset.of(train, heldout, options.gains)
    material = gathered(data, options.gains, options.values, progress)
    return identified(material, options.base, options.cores, progress)


def identified(
    material: Material,
    base: ActuatorParameters | None = None,
    cores: int = 1,
    progress: Progress = lambda share, text: None,
) -> Identification:
    """The same of `material`: who does not hold the whole of a long log has more memory for it."""
    chosen, body = material.pieces, material.body
    windows = WINDOWS if body is None else (chosen[0].log.period,)
    progress(0.02, "gains and delays")
    samples, judge, eam, remark = _read(material, windows)
    findings = [*material.findings, *remark]
    before = attrs.evolve(_plain(samples, eam, judge), implied=body is not None)
    late = latest(before, judge.fit)
    if material.heldout:  # whose rows may lie otherwise between their commands
        before = late
    noise = noise_floor(samples, judge.fit | judge.judge, samples.tau - before.predict())
    steps = iter(range(10**6))
    alone = Alone(before, judge, noise, cores)

    def tick(text: str) -> None:
        progress(min(0.1 + 0.008 * next(steps), 0.85), text)

    diagnosis = diagnosed(before, judge, noise, tick, alone.says_more, cores)
    progress(0.88, "what no effect explains")
    late_whole = _likely(_whole(before, judge, None), judge, None)
    ideal = pd_torque(samples, np.ones_like(before.gains), 0.0, 0.0, 0.0)

    def told(chosen_one: Diagnosis, learned: Learned | None) -> Outcome:
        model = chosen_one.model
        named = diagnosis.model if chosen_one.findings else before
        final = _whole(model, judge, learned)
        return Outcome(
            eam, late, late_whole,
            attrs.evolve(chosen_one, model=longest(model, learned, judge.fit)),
            _likely(final, judge, learned), learned,
            _worth(named, learned, judge), remainder(model, learned, judge),
            intervals(final, judge, learned, model), ideal, noise, judge,
            chosen, *_reference(samples), base or ActuatorParameters.default(),
        )  # fmt: skip

    outcome = told(*account(alone, diagnosis, judge, noise))
    if body is None:
        found = identification(outcome, findings)
    else:
        progress(0.95, "replays")
        tries = [outcome, told(diagnosis, None), told(_nothing(before, diagnosis), None)]
        outcome, motion = _steadiest(tries, body)
        found = identification(outcome, findings)
        found = attrs.evolve(found, report=_with_motion(found.report, motion, body))
    logs = [one.log for one in samples.logs]
    report = {**found.report, "baselines": baselines(logs, judge.fit, judge.judge)}
    report["warnings"] = [*report["warnings"], *contradictions(report)]
    progress(1.0, "done")
    return attrs.evolve(found, report=report)


def _whole(model: Model, judge: Judge, learned: Learned | None) -> Model:
    """The model, chosen by the rows that judge, fitted to every row that its values are taken from."""
    if judge.every is judge.fit:
        return model
    return attrs.evolve(fit_with_delays(beside(model, learned), judge.every), samples=model.samples)


def _likely(model: Model, judge: Judge, learned: Learned | None) -> Model:
    """A model fitted to every row, with those of the delays that say the same of them which a drive is likely to have."""
    told = in_steps(latest(beside(model, learned), judge.every), judge.every)
    return attrs.evolve(told, samples=model.samples)


def _nothing(before: Model, diagnosis: Diagnosis) -> Diagnosis:
    """No effects at all."""
    reason = "with it the commands replay the motion no better"
    given_up = tuple(Rejected(one.name, one.gain, reason) for one in diagnosis.findings)
    return Diagnosis(before, (), (*given_up, *diagnosis.rejected))


def _steadiest(tries: Sequence[Outcome], body: Body) -> tuple[Outcome, tuple[Replay, Replay]]:
    """The account with which the commands replay the motion best, and the replays before and after.

    The torque that a motion implies holds the encoders' errors, which terms can mistake for an effect; a replay does not.
    """
    logs = [piece.log for piece in tries[0].pieces]

    def replay(o: Outcome, model: Model) -> Replay:
        return replayed(logs, parameters(o, model), body, o.judge.judge)

    before = replay(tries[0], tries[0].before)
    best, after = tries[-1], before
    for one in tries[:-1]:
        found = replay(one, one.model)
        if found["dq_rms_rad_s"] < _CLEARLY * after["dq_rms_rad_s"]:
            best, after = one, found
    return best, (before, after)


def _with_motion(report: Mapping[str, Any], replays: tuple[Replay, Replay], body: Body) -> dict[str, Any]:
    """The report with before and after in rad and rad/s, too."""
    before, after = replays
    motion = {
        "inertia": {"value": body.inertia.tolist(), "unit": "kg m^2"},
        "replayed_s": STRETCH,
        "text": "No torque was logged: the one that the motion implies stands for it, so an armature is part of "
        "the inertia and an encoder bias part of the torque offset.",
    }
    decision = (
        f"From motion alone. {report['decision']} Replayed over {1e3 * STRETCH:.0f} ms, the error of q goes from "
        f"{before['q_rms_rad']:.3g} to {after['q_rms_rad']:.3g} rad."
    )
    return {
        **report,
        "before": report["before"] | {f"heldout_{name}": value for name, value in before.items()},
        "after": report["after"] | {f"heldout_{name}": value for name, value in after.items()},
        "motion": motion,
        "decision": decision,
    }


def _read(
    material: Material, windows: Sequence[float]
) -> tuple[Samples, Judge, Eam, list[tuple[str, Finding]]]:
    """Samples and the EAM, with stamps as logged or as an even sender's, q and dq as logged or averaged over some rows.

    Whichever explains the torque better.
    """
    origins = [piece.origin for piece in material.pieces]

    def tried(logs: Sequence[Log], steady: float = 0.0) -> Fit:
        samples = Samples(logs, material.kp, material.kd, origins, steady)
        judge = _rows(samples, material)
        return samples, judge, fit_eam(samples, judge.fit, windows=windows)

    logs = [piece.log for piece in material.pieces]
    found, notes = tried(logs), []
    if any(jitters(log) for log in logs):
        even = [evened(log) for log in logs]
        other = tried(even)
        if other[2].mse <= _CLEARLY * found[2].mse:
            logs, found = even, other
            text = "the even clock of the sender explains the torque better and was restored"
            notes.append(("t", f"t: the stamps jitter as those of received messages do; {text}"))
    found, steady = _steadied(found, lambda steady: tried(logs, steady))
    if steady:
        text = f"is averaged out over {1e3 * steady:.3g} ms to either side"
        notes.append(("dq", f"q, dq: their noise, on which the drive did not act, {text}"))
    return *found, [(logs[0].name, Finding("note", field, (), text)) for field, text in notes]


def _steadied(found: Fit, tried: Callable[[float], Fit]) -> tuple[Fit, float]:
    """The fit with q and dq averaged over so long (s) to either side as it pays; `tried` makes one.

    Where encoders are noisy and the drive did not act on what they say: whatever filters would be taken for an effect. A
    drive that did has their noise in its torque, and averages explain that worse.
    """
    samples, judge, eam = found
    rows, gains = judge.fit | judge.judge, np.ones(2) if samples.commanded else eam.gains.mean(axis=1)
    noise = noise_floor(samples, rows, samples.tau - _plain(samples, eam, judge).predict()).mean()
    noisy = encoder_noise(samples, rows, *gains * _reference(samples)).mean() >= _NOISY * noise

    def left(fit: Fit) -> float:
        """Error beside dry friction, or how much more than without where the PD law itself is hardly blurred."""
        return _beside_friction(fit) - (0.0 if noisy else fit[2].mse)

    chosen, least = 0.0, left(found)
    widths = _STEADY_ROWS * samples.period
    for steady in widths[widths <= (_STEADY_TIME if noisy else _BLURRED_TIME)]:
        other = tried(steady)
        error = left(other)
        if error < least - _STEADIER * noise:
            found, chosen, least = other, float(steady), error
        elif error > least:
            break
    return found, chosen


def _beside_friction(fit: Fit) -> float:
    """Mean squared error of the EAM with dry friction, whose steps noisy speeds blur most, on each joint beside it."""
    samples, judge, eam = fit
    dq = samples.at(eam.input_delay, eam.output_delay, eam.window).dq
    left, total = samples.tau - eam.predict(samples), 0.0
    for j, rows in enumerate(judge.fit.T):
        steps = np.tanh(dq[rows, j, None] / _AT_REST)
        r = left[rows, j] - steps @ np.linalg.lstsq(steps, left[rows, j], rcond=None)[0]
        total += float(r @ r)
    return total / int(judge.fit.sum())


def _rows(samples: Samples, material: Material) -> Judge:
    """Which rows are fitted and which judge: those of the logs held out, or one block of three where there are none."""
    if material.heldout:
        first = (samples.log_of_row < material.fitted)[:, None]
    else:
        spans = [one.log.duration for one in samples.logs]
        length = float(np.clip(min(spans) / _BLOCKS, _SHORTEST_BLOCK, _LONGEST_BLOCK))
        first = (np.floor(samples.t / length).astype(int) % _HELD_OUT_EVERY != _HELD_OUT_EVERY - 1)[:, None]
    for word, rows in (("fitted", samples.judged & first), ("held out", samples.judged & ~first)):
        if (rows.sum(axis=0) < _LEAST_ROWS).any():
            joint = samples.joints[int(np.argmin(rows.sum(axis=0)))]
            raise LogError(
                f"{samples.logs[0].log.name}: valid/{joint}: {int(rows.sum(axis=0).min())} rows to be {word}, "
                f"expected {_LEAST_ROWS} or more"
            )
    every = None if material.heldout else samples.judged
    return Judge.of(samples, samples.judged & first, samples.judged & ~first, every)


def _plain(samples: Samples, eam: Eam, judge: Judge) -> Model:
    """The EAM as a model that effects can be added to."""
    joints = len(samples.joints)
    one = np.zeros(joints, dtype=np.intp)
    model = Model(
        samples, eam.window, eam.gains, np.array([one, one]), eam.input_delay, eam.output_delay, one
    )
    return fit_with_delays(model, judge.fit, 2)


def _worth(model: Model, learned: Learned | None, judge: Judge) -> tuple[float, float]:
    """Held-out gain of the learned terms over `model`, fitted without them, and its p-value."""
    if learned is None:
        return 0.0, 1.0
    tau = model.samples.tau
    found = judge.compare(tau - model.predict(), tau - learned.model.predict() - learned.torque)
    return found.gain, found.p_any


def _reference(samples: Samples) -> tuple[float, float]:
    """The gains that the deviations are given at: the usual ones of the log."""
    kp, kd = (
        float(np.median(np.concatenate([one.gains[name].ravel() for one in samples.logs])))
        for name in ("kp", "kd")
    )
    return max(kp, 1e-6), max(kd, 1e-6)
