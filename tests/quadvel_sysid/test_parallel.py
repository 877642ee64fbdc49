"""Parallel map: same results as on one core, errors, and end of workers."""

import json
import os
import signal
import time
from pathlib import Path

import attrs
import pytest

from quadvel_actuator import Effect
from quadvel_sysid.data.signals import Samples
from quadvel_sysid.identify import identify
from quadvel_sysid.options import IdentifyOptions
from quadvel_sysid.parallel import parallel_map
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record


@pytest.fixture(scope="module")
def samples():
    return Samples.of([record(parameters(joints=1), joints=1, seconds=1.0)])


def test_results_equal_those_of_one_core_and_refer_to_the_same_samples(samples):
    for cores in (1, 2):
        found = parallel_map(lambda k: (k * k, samples), 4, cores, samples)
        assert [square for square, _ in found] == [0, 1, 4, 9]
        assert all(one is samples for _, one in found)


def work_of_the_worker(act):
    """Work that waits in this process and acts in the worker."""
    here = os.getpid()
    return lambda k: time.sleep(0.5) if os.getpid() == here else act(k)


def test_errors_of_tasks_and_killed_workers_are_raised(samples):
    for work in (lambda k: 1 // 0, work_of_the_worker(lambda k: 1 // 0)):
        with pytest.raises(ZeroDivisionError):
            parallel_map(work, 4, 2, samples)
    with pytest.raises(AttributeError, match="pickle"):  # a result that cannot be sent
        parallel_map(work_of_the_worker(lambda k: lambda: k), 4, 2, samples)
    with pytest.raises(ChildProcessError, match="killed"):
        parallel_map(work_of_the_worker(lambda k: os.kill(os.getpid(), signal.SIGKILL)), 4, 2, samples)


def test_an_interrupt_ends_the_workers(samples, monkeypatch):
    fork, workers = os.fork, []

    def recorded_fork():
        workers.append(fork())
        return workers[-1]

    def work(k):
        if os.getpid() == here:
            raise KeyboardInterrupt
        time.sleep(60.0)

    monkeypatch.setattr(os, "fork", recorded_fork)
    here, start = os.getpid(), time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        parallel_map(work, 4, 2, samples)
    assert time.monotonic() - start < 5.0
    assert len(workers) == 1
    assert not Path(f"/proc/{workers[0]}").exists()


def test_the_report_does_not_depend_on_the_number_of_cores():
    joints = NAMES[:2]
    truth = attrs.evolve(parameters((Effect("quadratic_drag", joints[:1], {"c": 0.05}),)), joints=joints)
    log = record(truth, 2, 3.0, 500, seed=4)
    one, two = (
        json.dumps(identify([log], options=IdentifyOptions(cores=n)).report, default=float) for n in (1, 2)
    )
    assert one == two
