"""Logs of drives drawn at random, healthy or with one fault each: the faults that checks once mistook for others.

`python -m tests.quadvel_sysid.drawn_logs [--seeds 40] [--first 1000]` draws that many of each fault, and prints the ones
whose finding is not the expected one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
import typer

from quadvel_sysid.logs.check_log import check_log
from quadvel_sysid.logs.log import Log

Fields = dict[str, Any]

RATES = (50, 100, 200, 250, 500, 1000)
LEADS = (0.05, 6.0)
"""s, between a command's stamp and the instant at which the drive had it."""
DRIVE_STEP = 0.0005  # s


@attrs.frozen(eq=False)
class Drive:
    """J joints under PD control with gravity and friction in the drive, SI units."""

    kp: float
    kd: float
    delay: float  # s
    feeds_speed: bool  # the law is kp (q_des - q) + kd (dq_des - dq)
    inertia: np.ndarray
    weight: np.ndarray
    friction: np.ndarray
    command_period: float  # s

    @classmethod
    def draw(cls, random: np.random.Generator, joints: int, stiff: bool) -> Drive:
        """Well damped, at a natural frequency of 2 to 8 Hz, or 8 to 20 Hz where it is `stiff`."""
        kp = float(
            np.exp(random.uniform(np.log(300.0 if stiff else 10.0), np.log(5000.0 if stiff else 300.0)))
        )
        pulse = 2.0 * np.pi * random.uniform(*((8.0, 20.0) if stiff else (2.0, 8.0)))
        feeds_speed = bool(stiff and random.random() < 0.7)
        return cls(
            kp,
            2.0 * random.uniform(0.4, 0.9) * kp / pulse,
            float(random.uniform(0.0, 0.008 if stiff else 0.018)),
            feeds_speed,
            kp / pulse**2 * random.uniform(0.7, 1.4, joints),
            kp * random.uniform(0.0, 0.05 if stiff else 0.15, joints),
            kp * random.uniform(0.0, 0.01, joints),
            0.0 if stiff or random.random() < 0.4 else float(random.choice([0.005, 0.02])),
        )


def drawn(seed: int, stiff: bool | None = None, lead: float = 0.0, rate: int | None = None) -> Fields:
    """A healthy log; with `lead` (s) its commands stand that much before they were sent, or after where it is negative."""
    random = np.random.default_rng(seed)
    joints, seconds = int(random.choice([1, 2, 3, 6, 12])), float(random.uniform(8.0, 20.0))
    rate = int(random.choice(RATES)) if rate is None else rate
    drive = Drive.draw(random, joints, bool(random.random() < 0.4) if stiff is None else stiff)
    margin = abs(lead) + 1.0
    t = np.arange(-margin, seconds + margin, DRIVE_STEP)
    sent, slope = _commands(random, t, joints, drive.command_period)
    q, dq, tau = _moved(drive, sent, slope)
    step = round(1.0 / (rate * DRIVE_STEP))
    rows = np.flatnonzero((t >= 0.0) & (t < seconds))[::step]
    stamped = rows + round(lead / DRIVE_STEP)
    noise = random.normal(size=(3, len(rows), joints))
    log = {
        "t": t[rows] - t[rows[0]],
        "q": q[rows] + 1e-5 * noise[0],
        "dq": dq[rows] + 2e-3 * noise[1],
        "tau": tau[rows] + random.uniform(0.005, 0.03) * tau[rows].std(axis=0) * noise[2],
        "q_des": sent[stamped],
    }
    if drive.feeds_speed and random.random() < 0.5:
        log["dq_des"] = slope[stamped]
    if random.random() < 0.5:
        log |= {"kp": drive.kp, "kd": drive.kd}
        if drive.feeds_speed:
            log["dq_des"] = slope[stamped]
    return log


def _commands(
    random: np.random.Generator, t: np.ndarray, joints: int, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sums of three sines (N, J) about a middle, and their slopes; new ones every `period` s."""
    held = t if period == 0.0 else np.floor(t / period + 1e-6) * period
    pulse, phase = 2.0 * np.pi * random.uniform(0.15, 1.8, (3, joints)), random.uniform(0.0, 6.3, (3, joints))
    size, angle = random.uniform(0.08, 0.35, (3, joints)), held[:, None, None] * pulse + phase
    middle = random.uniform(-0.8, 0.8, joints)
    return middle + (size * np.sin(angle)).sum(axis=1), (size * pulse * np.cos(angle)).sum(axis=1)


def _moved(drive: Drive, sent: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Angles, speeds and torques of the drives (3, N, J)."""
    late = round(drive.delay / DRIVE_STEP)
    ahead = drive.feeds_speed * slope
    q, dq, rows = sent[0].copy(), np.zeros(sent.shape[1]), np.empty((3, *sent.shape))
    for k in range(len(sent)):
        k_sent = max(k - late, 0)
        tau = (
            drive.kp * (sent[k_sent] - q)
            + drive.kd * (ahead[k_sent] - dq)
            - drive.friction * np.tanh(dq / 0.03)
        )
        rows[:, k] = q, dq, tau
        dq = dq + DRIVE_STEP * (tau - drive.weight * np.sin(q)) / drive.inertia
        q = q + DRIVE_STEP * dq
    return rows


def as_log(fields: Fields) -> Log:
    """The log, its joints numbered."""
    shape = fields["q"].shape
    given = {
        name: np.broadcast_to(fields[name], shape)
        for name in ("kp", "kd", "tau_ff", "dq_des", "tau")
        if name in fields
    }
    return Log(
        name="drawn.npz",
        joints=tuple(f"{j}_joint" for j in range(shape[1])),
        **{name: fields[name] for name in ("t", "q", "dq", "q_des")},
        t_cmd=fields["t"],
        valid=np.ones(shape, bool),
        **given,
    )


def with_spikes(log: Log, share: float, size: float, seed: int) -> tuple[Log, np.ndarray]:
    """A share of the torque's rows moved up or down by `size` standard deviations, and which (N, J) these are."""
    assert log.tau is not None
    random = np.random.default_rng(seed)
    rows = random.random(log.tau.shape) < share
    spike = size * log.tau.std(axis=0) * random.choice([-1.0, 1.0], log.tau.shape)
    return attrs.evolve(log, tau=np.where(rows, log.tau + spike, log.tau)), rows


def of_torque_commands(log: Log, rests: np.ndarray, command: float, seed: int) -> Log:
    """The joints in `rests` (J,) driven by a torque that knows no position, their command `command` throughout."""
    assert log.tau is not None
    walk = np.cumsum(np.random.default_rng(seed).normal(size=log.tau.shape), axis=0)
    torque = (walk - walk.mean(axis=0)) / walk.std(axis=0) + 0.5 * np.sign(log.dq)
    speed = None if log.dq_des is None else np.where(rests, 0.0, log.dq_des)
    return attrs.evolve(
        log,
        q_des=np.where(rests, command, log.q_des),
        dq_des=speed,
        tau=np.where(rests, torque, log.tau),
        kp=None,
        kd=None,
    )


# By hand


def _of_offset(random: np.random.Generator, seed: int) -> Log:
    log, sign = as_log(drawn(seed)), random.choice([-1.0, 1.0])
    assert log.tau is not None
    return attrs.evolve(log, tau=log.tau - sign * (sign * log.tau).min(axis=0))


def _of_lead(random: np.random.Generator, seed: int) -> Log:
    lead = np.exp(random.uniform(*np.log(LEADS))) * random.choice([-1.0, 1.0])
    return as_log(drawn(seed, lead=float(lead)))


def _of_spikes(random: np.random.Generator, seed: int) -> Log:
    share, size = (float(np.exp(random.uniform(*np.log(span)))) for span in ((0.001, 0.1), (3.0, 100.0)))
    return with_spikes(as_log(drawn(seed)), share, size, seed)[0]


def _of_rest(random: np.random.Generator, seed: int) -> Log:
    log = as_log(drawn(seed))
    return of_torque_commands(
        log, np.arange(len(log.joints)) >= 0, float(random.choice([0.0, 0.3, -1.0])), seed
    )


EXPECTED: dict[str, tuple[Callable[[np.random.Generator, int], Log], tuple[tuple[str, str], ...]]] = {
    "healthy": (lambda random, seed: as_log(drawn(seed)), ()),
    "offset": (_of_offset, ()),
    "lead": (_of_lead, (("refusal", "t_cmd"),)),
    "spikes": (_of_spikes, (("warning", "tau"),)),
    "rest": (_of_rest, (("refusal", "q_des"),)),
}
"""Of each fault: how to draw it, and the kinds and fields of what has to be found."""


def main(seeds: int = 40, first: int = 1000) -> None:
    """Draw `seeds` logs of each fault and print those with other findings."""
    for name, (draw, expected) in EXPECTED.items():
        missed = 0
        for seed in range(first, first + seeds):
            findings = check_log(draw(np.random.default_rng([seed, 1]), seed)).findings
            reported = [one for one in findings if one.kind != "note" and "hardly separates" not in one.text]
            if tuple((one.kind, one.field) for one in reported) != expected:
                missed += 1
                print(f"{name} {seed}: {[one.text for one in reported]}")
        print(f"{name}: {seeds - missed} of {seeds} as expected")


if __name__ == "__main__":
    typer.run(main)
