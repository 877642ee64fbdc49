"""Logs without torque: joints that swing freely, alone and on a suspended robot."""

import os
from pathlib import Path

import attrs
import numpy as np
import pytest

from quadvel_actuator import Effect
from quadvel_description.state import JointCommand
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sysid.data.motion import imply_torque
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import Log, LogError
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.options import IdentifyOptions
from tests.helpers.robots import ALIENGO
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

JOINTS = NAMES[:2]


def _swinging(*effects, seed=0):
    """Two joints without contact, seen through encoders."""
    truth = attrs.evolve(parameters(effects), joints=JOINTS)
    log = record(truth, 2, 4.0, 1000, "mixed", seed, load=0.0)
    noise = np.random.default_rng(seed).normal(size=(2, *log.q.shape))
    return attrs.evolve(log, tau=None, q=log.q + 1e-4 * noise[0], dq=log.dq + 0.005 * noise[1])


def test_the_motion_of_a_free_joint_shows_its_inertia_and_nothing_that_is_not_there():
    log = attrs.evolve(_swinging(), kp=None, kd=None)
    report = identify([log], options=IdentifyOptions(gains=(30.0, 0.5))).report
    assert report["motion"]["inertia"]["value"] == pytest.approx([0.06, 0.06], rel=0.03)
    assert report["effects"] == []
    assert report["unexplained"]["verdict"] == "white"


def test_joint_friction_is_identified_from_motion_and_improves_the_replay():
    report = identify([_swinging(Effect("coulomb_friction", JOINTS[:1], {"c": 0.5, "v_0": 0.1}))]).report
    first = report["effects"][0]
    assert (first["name"], first["joints"]) == ("coulomb_friction", [JOINTS[0]])
    # Speeds are means over 8 ms, which blurs where the friction turns.
    assert first["params"]["c"]["value"] == pytest.approx(0.5, rel=0.15)
    before, after = report["before"], report["after"]
    assert after["heldout_q_rms_rad"] < 0.3 * before["heldout_q_rms_rad"]
    assert after["heldout_dq_rms_rad_s"] < 0.3 * before["heldout_dq_rms_rad_s"]
    assert "rad" in report["decision"]


def test_log_without_torque_and_gains_is_refused():
    log = attrs.evolve(_swinging(), kp=None, kd=None)
    with pytest.raises(LogError, match="tau, kp, kd: not in the log"):
        identify([log])


def _hung(friction, seconds=5.0, seed=0):
    """A leg of the robot suspended in the air that follows steps of its targets; encoders as good as the real ones."""
    noise = SensorNoise(q=1e-4, dq=0.01)
    simulator = Simulator(
        SimulatorConfig(
            robot=ALIENGO,
            suspended=True,
            noise=noise,
            seed=seed,
            joint_friction=friction,
            joint_damping=np.full(12, 0.01),
        )
    )
    simulator.reset("stand", seed=seed)
    rng = np.random.default_rng(seed)
    rows, targets = [], []
    target = ALIENGO.nominal_q.copy()
    for k in range(round(1000 * seconds)):
        if k % 80 == 0:
            aim = ALIENGO.nominal_q + rng.uniform(-0.3, 0.3, 12)
        target = target + 0.02 * (aim - target)
        simulator.command(JointCommand(q=target, kp=np.full(12, 30.0), kd=np.full(12, 0.5)))
        state = simulator.state()
        rows.append((state.q[:3], state.dq[:3], state.tau[:3]))
        targets.append(target[:3])
        simulator.step()
    q, dq, tau = (np.array(x) for x in zip(*rows, strict=True))
    t = 0.001 * np.arange(len(q))
    held = np.array(targets)
    gains = {"kp": np.full(held.shape, 30.0), "kd": np.full(held.shape, 0.5)}
    return Log(
        name="suspended",
        joints=NAMES[:3],
        t=t,
        q=q,
        dq=dq,
        tau=tau,
        t_cmd=t,
        q_des=held,
        valid=np.ones(q.shape, dtype=bool),
        **gains,
    )


@pytest.mark.long
def test_friction_of_a_hung_leg_is_found_on_the_joint_that_has_it():
    friction = np.zeros(12)
    friction[1] = 0.6
    report = identify([attrs.evolve(_hung(friction), tau=None)]).report
    named = {joint for one in report["effects"] if "friction" in one["name"] for joint in one["joints"]}
    assert named == {NAMES[1]}
    assert report["after"]["heldout_q_rms_rad"] < 0.7 * report["before"]["heldout_q_rms_rad"]


def test_swinging_leg_is_one_body():
    """The torque that the motion implies is the one that the drives gave, though the joints push each other."""
    log = _hung(np.zeros(12), 3.0)
    coarse, body = imply_torque(log)
    assert np.all(body.inertia > 0.0)
    given = np.array([np.interp(coarse.t, log.t, tau) for tau in log.tau.T]).T
    assert np.all(np.std(coarse.tau - given, axis=0) < 0.2 * np.std(given, axis=0))


@pytest.mark.skipif("QUADVEL_MEASURED" not in os.environ, reason="QUADVEL_MEASURED names no measured logs")
@pytest.mark.long
def test_a_measured_leg_in_the_air_is_never_replayed_worse_than_before():
    log = read_log(Path(os.environ["QUADVEL_MEASURED"]) / "go2_inair.npz")
    leg = [name.startswith("FL") for name in log.joints]
    states = {name: getattr(log, name)[:, leg] for name in ("q", "dq", "valid", "q_des", "kp", "kd")}
    one = attrs.evolve(log, joints=tuple(np.array(log.joints)[leg].tolist()), **states)
    report = identify([one], options=IdentifyOptions(max_values=6000)).report
    assert 0.01 < min(report["motion"]["inertia"]["value"]) < max(report["motion"]["inertia"]["value"]) < 0.1
    for name in ("heldout_q_rms_rad", "heldout_dq_rms_rad_s"):
        assert report["after"][name] <= report["before"][name]
