"""Causes in timing: late, repeated or missing states and commands, and a wrong rate of the policy.

Each class measures one number on a run; `cause.Cause` explains `unit`, `least`, `needs` and
`remedy`. The limits are in limits.yaml; `diagnosis` compares numbers and limits, and `report` draws
the traces.
"""

from __future__ import annotations

import numpy as np
from typing_extensions import override

from quadvel_description.arrays import Array, Indices
from quadvel_policy.observation import RATE_HZ

from ..cause import Cause, Link, Measurement, Trace, worst_span
from ..signals import Signals
from .contract import joint_trace

MAX_COMMANDS_LATE = 4
"""Largest number of state periods by which a drive may be behind to be tried."""
LOST_ERROR = 6.0
"""Mean square error of the torques, in variances of the fit, from which a state is suspicious."""
VISIBLE = 2.0
"""Change of the torque between two commands, by LOST_ERROR, from which a lost command shows."""
LOST_BETTER = 6.0
"""Factor by which an older command must reduce the error of a suspicious state."""
MIN_TICKS = 20
"""Fewest ticks of walking that give a rate or a jitter."""
MAX_UNEXPLAINED_SHARE = 0.2
"""Share of the torque's variance that its command leaves; above it, no delay is determined."""


def _walk_ticks(signals: Signals) -> Indices:
    """Return the rows of the commands that the walking policy computed, without repetitions."""
    run = signals.run
    commands = run.commands
    walking = run.walking[commands.answers] & commands.servo
    changed = np.concatenate([[True], (np.diff(commands.target, axis=0) != 0.0).any(axis=1)])
    return np.flatnonzero(walking & changed)


class PolicyRate(Cause):
    """The policy runs at another rate than it was trained for."""

    link = Link.TIMING
    unit = "share"
    least = 0.1
    needs = ("modes",)
    remedy = (
        "Run one step of the policy for each state that is due; look for a slower timer or a skipped state"
    )

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, ticks = signals.run, _walk_ticks(signals)
        if len(ticks) < MIN_TICKS:
            return None
        wanted = RATE_HZ if signals.policy is None else signals.policy.metadata.rate_hz
        answered = run.time[run.commands.answers[ticks]]
        periods = np.diff(answered)
        rate = 1.0 / float(np.median(periods))
        trace = Trace(
            "time between two actions, ms", answered[1:], 1e3 * periods, np.full(len(periods), 1e3 / wanted)
        )
        sentence = f"the policy acts {rate:.0f} times a second, expected {wanted:.0f}"
        return Measurement(abs(rate / wanted - 1.0), sentence, worst_span(answered[1:], periods), (trace,))


class Jitter(Cause):
    """Commands leave, or states come, at irregular times."""

    link = Link.TIMING
    unit = "s"
    least = 0.0025
    needs = ("modes",)
    remedy = (
        "Give the control loop a core and a real-time priority (`realtime_priority`, `cpus`); look for work in its "
        "callbacks, with `loop` of `quadvel plot`. A simulated robot waits for its controller: on a busy machine "
        "record it without real time, with `quadvel demo --lockstep`, and ask again"
    )

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run = signals.run
        commands = run.commands
        rows = np.flatnonzero(run.walking[commands.answers])
        if len(rows) < MIN_TICKS:
            return None
        answered = run.time[commands.answers[rows]]
        waited = commands.time[rows] - answered
        intervals = np.diff(run.time)
        late, uneven = (float(np.subtract(*np.percentile(x, [95, 5]))) for x in (waited, intervals))
        value, what, time, measured = max(
            (late, "from a state to its command", answered, waited),
            (uneven, "between states", run.time[1:], intervals),
        )
        trace = Trace(
            f"time {what}, ms", time, 1e3 * measured, np.full(len(time), 1e3 * float(np.median(measured)))
        )
        sentence = f"the time {what} varies by {1e3 * value:.1f} ms (5 to 95 %), trained with 2 ms"
        off = np.abs(measured - np.median(measured))
        return Measurement(value, sentence, worst_span(time, off), (trace,))


class RepeatedStates(Cause):
    """States repeat the ones before bit by bit, with new stamps."""

    link = Link.TIMING
    unit = "share"
    least = 0.01
    remedy = "Publish a state only when the board sent a new one; look at lost packets of the link"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, repeated = signals.run, signals.repeated
        share = float(repeated.mean())
        j = int(np.argmax(run.dq.std(axis=0)))
        moved = run.q[:, j].copy()
        moved[repeated] = np.interp(run.time[repeated], run.time[~repeated], run.q[~repeated, j])
        trace = Trace(f"angle of {run.joints[j]}, rad", run.time, run.q[:, j], moved)
        sentence = f"{100 * share:.0f} % of the states repeat the one before, expected none"
        return Measurement(share, sentence, worst_span(run.time, repeated.astype(float)), (trace,))


class LostCommands(Cause):
    """Drives follow an older command than the newest one: it was lost or came late."""

    link = Link.TIMING
    unit = "share"
    least = 0.015
    needs = ("torque",)
    remedy = (
        "Count packets on both sides of the link; look for a full queue, a busy bus, or a second publisher. "
        "A busy machine that simulates loses them, too"
    )

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        run, model = signals.run, signals.torque
        assert run.tau is not None
        keep = model.rows
        spread = np.array([fit.spread for fit in model.fits])
        sound = spread < 3.0 * np.median(spread)
        if not sound.any():
            return None
        gain = np.array([fit.command for fit in model.fits])

        def change(steps: int) -> Array:
            # Torque, if every command acts `steps` state periods later than the model has it, less the model's.
            return np.asarray(gain * (model.asked_at(model.delay + steps * run.period) - model.asked))

        def error(torque: Array) -> Array:
            # Mean over sound joints of (torque / spread)^2
            return np.asarray(np.mean(np.minimum(np.abs(torque / spread)[:, sound], 30.0) ** 2, axis=1))

        left = run.tau - model.modelled
        own = error(left)
        older = np.min([error(left - change(steps)) for steps in range(1, MAX_COMMANDS_LATE + 1)], axis=0)
        # Where the command hardly changes, a lost one does not show.
        lost = keep & (own > LOST_ERROR) & (own > LOST_BETTER * older)
        shows = lost | (keep & (error(change(1)) > VISIBLE * LOST_ERROR))
        share = float(lost.sum() / max(shows.sum(), MIN_TICKS))
        j = int(np.argmax(np.where(sound, np.abs(left[lost]).sum(axis=0), -1.0)))
        trace = joint_trace(signals, j, model.modelled[:, j])
        sentence = (
            f"in {100 * share:.0f} % of the states in which a command clearly changes the torques, they follow an "
            "older one"
        )
        return Measurement(share, sentence, worst_span(run.time, lost.astype(float)), (trace,))


class LongDelay(Cause):
    """Commands act later than in any robot of the training."""

    link = Link.TIMING
    unit = "s"
    least = 0.0
    needs = ("torque",)
    remedy = "Shorten the way of a command, or train with the measured delay: `quadvel identify` gives the drives' part"

    @override
    def measure(self, signals: Signals) -> Measurement | None:
        model, trained = signals.torque, signals.trained.delay
        variance = model.run.tau[model.rows].var(axis=0)  # type: ignore[index]
        if np.median(model.own_errors.min(axis=0) / variance) > MAX_UNEXPLAINED_SHARE:
            return None
        low, high = model.delay_range
        j = int(np.argmax(model.run.tau.std(axis=0)))  # type: ignore[union-attr]
        early = model.asked_at(0.5 * trained)[:, j]
        sentence = (
            f"torques follow commands after {1e3 * low:.0f} to {1e3 * high:.0f} ms, the training drew at most "
            f"{1e3 * trained:.0f} ms"
        )
        clock = (
            "a clock of the commands that is early looks the same: compare the stamps of both on one machine"
        )
        off = np.where(model.rows, np.abs(model.run.tau[:, j] - early), 0.0)  # type: ignore[index]
        return Measurement(
            low + 1e-9,
            f"{sentence} ({clock})",
            worst_span(model.run.time, off),
            (joint_trace(signals, j, early),),
            limit=trained + 1e-3,
        )
