"""Work on several cores: the answers of one, in the order in which they are asked for."""

import json
import os
import signal
from concurrent.futures.process import BrokenProcessPool

import attrs
import pytest
from simulated_joints import NAMES, parameters, record

from quadvel_actuator import Effect
from quadvel_sysid.engine.ahead import Ahead
from quadvel_sysid.engine.identify import Options, identify
from quadvel_sysid.engine.signals import Samples


@pytest.fixture(scope="module")
def samples():
    return Samples([record(parameters(joints=1), joints=1, seconds=1.0)])


def test_answers_are_those_of_one_core_and_name_the_samples_that_are_here(samples):
    with Ahead(lambda k: (k * k, samples), 2, samples) as ahead:
        taken = [ahead.take(k, range(k + 1, 6)) for k in range(0, 6, 2)]
    assert [square for square, _ in taken] == [0, 4, 16]
    assert all(one is samples for _, one in taken)


def test_with_one_core_nothing_is_done_before_it_is_asked_for(samples):
    done = []
    with Ahead(done.append, 1, samples) as ahead:
        ahead.take(1, range(2, 5))
    assert done == [1]


def test_an_error_of_the_work_and_the_end_of_a_worker_come_out_where_the_answer_is_asked_for(samples):
    with Ahead(lambda k: 1 // k, 2, samples) as ahead, pytest.raises(ZeroDivisionError):
        ahead.take(0, [1])
    with (
        pytest.raises(BrokenProcessPool),
        Ahead(lambda k: os.kill(os.getpid(), signal.SIGKILL), 2, samples) as ahead,
    ):
        ahead.take(0, [1])


def test_the_report_of_two_cores_is_that_of_one():
    joints = NAMES[:2]
    truth = attrs.evolve(parameters((Effect("quadratic_drag", joints[:1], {"c": 0.05}),)), joints=joints)
    log = record(truth, 2, 3.0, 500, seed=4)
    one, two = (json.dumps(identify([log], options=Options(cores=n)).report, default=float) for n in (1, 2))
    assert one == two
