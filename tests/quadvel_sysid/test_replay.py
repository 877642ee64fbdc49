"""Commands replayed on the legs of a robot's description."""

import subprocess
import sys

import attrs
import numpy as np
import pytest

from quadvel_actuator import ActuatorParameters, Effect
from quadvel_sysid.data.dataset import Dataset
from quadvel_sysid.export.legs import Legs, replay_deviations, stretch_starts
from quadvel_sysid.export.replay import find_load
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import Log, LogError
from quadvel_sysid.options import IdentifyOptions
from tests.helpers.robots import ALIENGO
from tests.quadvel_sysid.simulated_joints import NAMES, parameters, record

CALF = ("FR_calf_joint",)
IDEAL = attrs.evolve(ActuatorParameters.ideal(ALIENGO), torque_limit=45.0)


def _still(joints=CALF, seconds=1.0, **fields):
    """A log of joints that rest, without torque."""
    t = 0.002 * np.arange(round(seconds / 0.002))
    none = np.zeros((len(t), len(joints)))
    given = {"q": none - 1.5, "dq": none, "tau": none, "q_des": none, "kp": none, "kd": none}
    return Log(name="still", joints=joints, t=t, t_cmd=t, valid=none == 0.0, **(given | fields))


def test_the_inertia_of_a_calf_is_that_of_its_parts_about_its_axis():
    links = 0.0011 + 0.154 * (
        0.00548**2 + 0.115**2
    )  # go2.xml: inertia about its own centre, mass, where that is
    foot = 9.6e-06 + 0.04 * 0.213**2
    legs = Legs.load("go2", CALF)
    assert legs.inertia(np.array([[-1.5], [-2.0]])).ravel() == pytest.approx(
        [0.01 + links + foot] * 2, rel=1e-6
    )


def test_a_leg_that_is_bent_is_turned_more_easily_about_the_hip():
    bent, straight = Legs.load("go2", ("FR_thigh_joint", "FR_calf_joint")).inertia(
        np.array([[0.9, -2.4], [0.9, -0.9]])
    )
    assert bent[0, 0] < 0.7 * straight[0, 0]
    assert bent == pytest.approx(bent.T)


def test_excess_torque_moves_the_legs_as_a_free_body():
    log = _still(tau_ff=np.ones((500, 1)))  # the model gives 1 N m, no torque was measured
    legs = Legs.load("go2", CALF)
    angle, speed = replay_deviations(log, IDEAL, legs, np.array([0.1, 0.5]))
    inertia = legs.inertia(np.array([[-1.5]]))[0, 0, 0]
    assert angle.shape == speed.shape == (round(Legs.stretch_s / 0.001), 2, 1)
    assert speed[-1].ravel() == pytest.approx([Legs.stretch_s / inertia] * 2, rel=0.01)
    assert angle[-1].ravel() == pytest.approx([0.5 * Legs.stretch_s**2 / inertia] * 2, rel=0.02)


def test_model_with_the_measured_torque_does_not_deviate():
    truth = attrs.evolve(parameters(), joints=NAMES[:3], torque_noise=0.0)
    log = record(truth, 3, 2.0, 1000, seed=1)
    legs, begins = Legs.load("aliengo", log.joints), np.array([0.5, 1.0, 1.5])
    with_it, _ = replay_deviations(log, truth, legs, begins)
    without, _ = replay_deviations(log, attrs.evolve(truth, delta_kp=truth.delta_kp + 3.0), legs, begins)
    # A row's torque is here the mean of the millisecond after it, half a step late for a replay.
    assert np.sqrt(np.mean(with_it**2)) < 0.12 * np.sqrt(np.mean(without**2))


def test_stretches_lie_in_the_given_rows_and_not_across_a_gap():
    log = _still(seconds=2.0)
    rows = np.ones((1000, 1), dtype=bool)
    rows[300:400] = False  # 0.6 to 0.8 s
    late = attrs.evolve(log, t=np.where(log.t > 1.5, log.t + 0.1, log.t))
    for begin in stretch_starts(late, rows):
        assert begin >= 0.04 - 1e-9
        assert begin + Legs.stretch_s <= 0.6 or begin >= 0.8
        assert begin + Legs.stretch_s <= 1.5 + 1e-9 or begin >= 1.6
    assert len(stretch_starts(late, rows)) == 2 + 3 + 2


def test_report_states_replay_deviations_before_and_after():
    friction = Effect("coulomb_friction", NAMES[:3], {"c": 1.5, "v_0": 0.05})
    log = record(attrs.evolve(parameters((friction,)), joints=NAMES[:3]), 3, 3.0, 500, seed=2)
    report = identify([log], options=IdentifyOptions(robot="aliengo")).report
    before, after = report["replay"]["before"], report["replay"]["after"]
    assert after["q_rms_rad"] < 0.5 * before["q_rms_rad"]
    assert len(after["q_rms_rad_per_joint"]) == 3
    assert after["stretches"] >= 2


@pytest.mark.parametrize(
    ("robot", "joints", "said"),
    [
        ("dog", CALF, "--robot: found dog, expected aliengo, go2 or an MJCF or URDF file"),
        (
            "go2",
            ("knee_joint",),
            "--robot go2: joint 'knee_joint' of the log is missing, found FL_calf_joint",
        ),
        ("aliengo", ("knee_joint",), "--robot aliengo: joint 'knee_joint' of the log is missing"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_by_name(robot, joints, said):
    with pytest.raises((OSError, ValueError), match=said):
        Legs.load(robot, joints)


def test_a_file_that_is_no_description_is_named(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text("<nothing/>")
    with pytest.raises(ValueError, match=r"robot.xml: no MJCF or URDF that MuJoCo reads"):
        Legs.load(str(path), CALF)


def test_a_log_without_torque_is_not_identified_with_a_replay():
    log = record(attrs.evolve(parameters(), joints=NAMES[:2]), 2, 2.0, 1000, load=0.0)
    with pytest.raises(LogError, match="tau: not in the log, expected the torque to replay"):
        identify([attrs.evolve(log, tau=None)], options=IdentifyOptions(robot="aliengo"))
    with pytest.raises(
        LogError, match=r"kd: not in the log, expected the commanded gains \(or --gains KP KD\)"
    ):
        identify([attrs.evolve(log, kd=None)], options=IdentifyOptions(robot="aliengo"))


def test_a_log_without_torque_is_not_replayed():
    with pytest.raises(LogError, match="still: tau, kp, kd: expected all three"):
        replay_deviations(_still(tau=None), IDEAL, Legs.load("go2", CALF), np.array([0.2]))


def test_logs_are_identified_without_mujoco_and_legs_are_refused(monkeypatch):
    program = (
        "import sys; sys.modules['mujoco'] = None; import quadvel_sysid.identify, quadvel_sysid.report.report"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
    monkeypatch.setitem(sys.modules, "quadvel_sysid.export.legs", None)
    dataset = Dataset(train=(_still(),), heldout=(), pieces=((0,),), findings=(), body=None)
    with pytest.raises(ValueError, match=r"--robot needs mujoco, .* 'quadvel-core\[sim\]'"):
        find_load(dataset, "go2")
