"""What counts as independent evidence: a stretch of motion, and a stand but once."""

import attrs
import numpy as np
from simulated_joints import parameters, record

from quadvel_sysid.engine.judging import Judge
from quadvel_sysid.engine.signals import Samples
from quadvel_sysid.logs.log import Log

BEGIN, END = 2.0, 4.0  # s, of a stand


def judge_of(log: Log) -> Judge:
    samples = Samples([log])
    every = np.ones_like(samples.judged)
    return Judge.of(samples, every, every)


def standing(log: Log, sway: float, rate: float) -> Log:
    """The log with a stand, in which encoders say what the joints do not and one joint sways (rad, Hz)."""
    rng = np.random.default_rng(1)
    still = ((log.t >= BEGIN) & (log.t < END))[:, None]
    stand = log.q[int(BEGIN * 1000)] + 0.5e-3 * rng.normal(size=log.q.shape)
    stand[:, 0] += sway * np.sin(2.0 * np.pi * rate * log.t)
    return attrs.evolve(log, q=np.where(still, stand, log.q))


def test_a_stand_says_once_what_it_says_and_motion_each_tenth_of_a_second() -> None:
    log = record(parameters(), joints=2, seconds=5.0)
    moving, stood = judge_of(log), judge_of(standing(log, 0.0, 1.0))
    assert len(moving.starts) == 50
    at = log.t[stood.starts]
    assert len(at) == 31
    assert not ((at > BEGIN + 0.05) & (at < END - 0.05)).any()


def test_a_fast_sway_about_one_posture_is_motion() -> None:
    log = record(parameters(), joints=2, seconds=5.0)
    assert len(judge_of(standing(log, 0.03, 20.0)).starts) == 50
