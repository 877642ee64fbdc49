"""Work on several cores: the answers of one."""

import json
import os
import signal
import time
from pathlib import Path

import attrs
import pytest
from simulated_joints import NAMES, parameters, record

from quadvel_actuator import Effect
from quadvel_sysid.identify import identify
from quadvel_sysid.parallel import parallel_map
from quadvel_sysid.signals import Samples


@pytest.fixture(scope="module")
def samples():
    return Samples([record(parameters(joints=1), joints=1, seconds=1.0)])


def test_answers_are_those_of_one_core_and_name_the_samples_that_are_here(samples):
    for cores in (1, 2):
        found = parallel_map(lambda k: (k * k, samples), 4, cores, samples)
        assert [square for square, _ in found] == [0, 1, 4, 9]
        assert all(one is samples for _, one in found)


def of_the_helper(act):
    """Work that only waits in this process, until the helper has acted."""
    here = os.getpid()
    return lambda k: time.sleep(0.5) if os.getpid() == here else act(k)


def test_an_error_of_the_work_and_the_end_of_a_helper_come_out(samples):
    for work in (lambda k: 1 // 0, of_the_helper(lambda k: 1 // 0)):
        with pytest.raises(ZeroDivisionError):
            parallel_map(work, 4, 2, samples)
    with pytest.raises(ChildProcessError, match="killed"):
        parallel_map(of_the_helper(lambda k: os.kill(os.getpid(), signal.SIGKILL)), 4, 2, samples)


def test_a_helper_ends_with_the_work_that_was_broken_off(samples, monkeypatch):
    fork, helpers = os.fork, []

    def remembered():
        helpers.append(fork())
        return helpers[-1]

    def work(k):
        if os.getpid() == here:
            raise KeyboardInterrupt
        time.sleep(60.0)

    monkeypatch.setattr(os, "fork", remembered)
    here, begun = os.getpid(), time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        parallel_map(work, 4, 2, samples)
    assert time.monotonic() - begun < 5.0
    assert len(helpers) == 1
    assert not Path(f"/proc/{helpers[0]}").exists()


def test_the_report_of_two_cores_is_that_of_one():
    joints = NAMES[:2]
    truth = attrs.evolve(parameters((Effect("quadratic_drag", joints[:1], {"c": 0.05}),)), joints=joints)
    log = record(truth, 2, 3.0, 500, seed=4)
    one, two = (json.dumps(identify([log], cores=n).report, default=float) for n in (1, 2))
    assert one == two
