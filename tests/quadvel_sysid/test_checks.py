"""Findings in logs with one defect, none in a clean log, and findings in measured logs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_sysid.logs.check_log import CheckedLog, check_log, check_logs
from quadvel_sysid.logs.log import Log, LogError
from quadvel_sysid.logs.read_log import read_log
from tests.helpers.robots import ALIENGO
from tests.quadvel_sysid.joint_logs import KD, KP, fields, npz

SHARE = np.pi / 180.0


def log(**changes: Any) -> Log:
    """The clean log with some arrays changed."""
    given = fields()
    shape = given["q"].shape
    values: dict[str, Any] = {
        **{name: given[name] for name in ("t", "q", "dq", "tau", "q_des")},
        "t_cmd": given["t"],
        "valid": np.ones(shape, bool),
        "kp": np.full(shape, 30.0),
        "kd": np.full(shape, 0.5),
    }
    return Log(name="a.npz", joints=JOINT_NAMES, **(values | changes))


def texts(checked: CheckedLog, kind: str) -> list[str]:
    return [finding.text for finding in checked.findings if finding.kind == kind]


def exchanged(values: np.ndarray, a: int = 0, b: int = 4) -> np.ndarray:
    order = list(range(12))
    order[a], order[b] = b, a
    return values[:, order]


def of_one(values: np.ndarray, factor: float) -> np.ndarray:
    """Scale the second joint alone."""
    return values * np.where(np.arange(12) == 1, factor, 1.0)


def set_back(t: np.ndarray) -> np.ndarray:
    """Set the clock back in the middle."""
    return t + np.where(np.arange(len(t)) >= len(t) // 2, 1.7e9, 0.0)


def read_in_bursts(t: np.ndarray, size: int) -> np.ndarray:
    """Stamps of a buffer that is read whenever it holds `size` rows."""
    row = np.arange(len(t))
    last = np.minimum((row // size + 1) * size - 1, len(t) - 1)
    return t[last] + 0.02 * (t[1] - t[0]) * (row % size)


@pytest.mark.parametrize("size", [2, 3, 5])
def test_rows_that_were_read_in_bursts_get_the_times_of_their_measurement(size: int) -> None:
    t = fields()["t"]
    checked = check_log(log(t=read_in_bursts(t, size), t_cmd=t))
    checked.raise_refusal()
    assert np.abs(checked.log.t - t)[:-size].max() < 0.2 * (t[1] - t[0])
    assert any(finding.field == "t" and finding.kind == "warning" for finding in checked.findings)


def test_a_receiver_that_is_late_at_times_keeps_its_stamps() -> None:
    t = fields()["t"]
    late = t + np.abs(np.random.default_rng(0).normal(0.0, 0.5 * (t[1] - t[0]), len(t)))
    stamps = np.maximum.accumulate(late) + 1e-6 * np.arange(len(t))
    assert np.array_equal(check_log(log(t=stamps, t_cmd=t)).log.t, stamps)


def test_finding_names_the_joint_with_the_defect() -> None:
    noise = np.where(np.arange(12) == 1, np.random.default_rng(0).normal(size=(2000, 12)), fields()["tau"])
    warnings = texts(check_log(log(tau=noise)), "warning")
    assert any(
        text.startswith("tau: does not answer the position error on FR_thigh_joint") for text in warnings
    )
    copied = fields()["q"].copy()
    copied[:, 1] = copied[:, 0]
    warnings = texts(check_log(log(q=copied)), "warning")
    assert any(
        text.startswith("q: FR_thigh_joint and FR_hip_joint are the same to the bit") for text in warnings
    )
    found = check_log(log(kp=of_one(np.full((2000, 12), 30.0), 0.0)))
    assert texts(found, "refusal") == []
    assert "kp: 0 at times on FR_thigh_joint alone; left out there" in texts(found, "warning")


def test_gains_that_the_log_holds_are_kept_with_a_warning() -> None:
    checked = check_log(log(), gains=(300.0, 0.5))
    assert texts(checked, "warning") == ["kp, kd: the log holds them, so --gains is not used"]
    assert checked.log.kp is not None
    assert checked.log.kp.max() == 30.0


def test_a_joint_that_moves_more_than_it_is_told_to_is_not_in_degrees() -> None:
    rng, t = np.random.default_rng(0), fields()["t"]
    small = 0.002 * np.sin(2 * np.pi * 0.7 * t + rng.uniform(0.0, 6.0, (12, 1))).T
    moved = 0.12 * np.sin(2 * np.pi * 1.3 * t + rng.uniform(0.0, 6.0, (12, 1))).T
    dq = np.gradient(moved, t, axis=0)
    tau = 30.0 * (small - moved) - 0.5 * dq
    assert not any(
        "degrees" in text for text in texts(check_log(log(q=moved, dq=dq, q_des=small, tau=tau)), "refusal")
    )


@pytest.mark.parametrize(("factor", "kind"), [(1.0 / SHARE, "refusal"), (1.0, "warning")])
def test_joints_of_others_turn_far_in_radians_and_not_in_degrees(factor: float, kind: str) -> None:
    """Turns are far in both: in degrees the joint seems to miss its command by as much."""
    slow = np.linspace(0.0, 20.0 / factor, 2000)[:, None]
    values = fields()
    moved = {"q": values["q"] + slow, "q_des": values["q_des"] + slow, "dq": values["dq"] + slow[1] / 0.002}
    given = attrs.evolve(
        log(**{name: factor * value for name, value in moved.items()}),
        joints=[f"motor_{k}" for k in range(12)],
    )
    found = check_log(given)
    assert any(text.startswith("q: up to ") for text in texts(found, kind)), found.findings


def test_clean_log_yields_only_its_rate() -> None:
    checked = check_log(log())
    assert texts(checked, "warning") == []
    assert texts(checked, "refusal") == []
    assert "t: 2000 rows over 4.00 s, 500 Hz" in texts(checked, "note")[0]
    assert checked.log.valid.all()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"q": fields()["q"] / SHARE}, "dq: the slope of q is 57.3 times dq"),
        ({"dq": fields()["dq"] / SHARE}, "dq: the slope of q is 0.017"),
        (
            {"t": fields()["t"] * 1e3, "t_cmd": fields()["t"] * 1e3},
            "t: a row comes every 2 s; is t in milliseconds",
        ),
        ({name: fields()[name] / SHARE for name in ("q", "dq", "q_des")}, "q: up to "),
        ({"q_des": fields()["q_des"] / SHARE}, "q_des: about 57 times as large as q: degrees?"),
        ({"dq": -fields()["dq"]}, "dq: has the opposite sign"),
        (
            {"q": fields()["q_des"], "q_des": fields()["q"]},
            "q: dq is the slope of q_des, and not of q, on FR_hip",
        ),
        ({"tau": -fields()["tau"]}, "tau: has the opposite sign on FR_hip"),
        (
            {"q_des": exchanged(fields()["q_des"])},
            "q_des: a joint's q follows another joint's command (FR_hip",
        ),
        (
            {"q_des": exchanged(fields()["q_des"]), "tau": None},
            "q_des: a joint's q follows another joint's command (",
        ),
        (
            {"q": exchanged(fields()["q"]), "dq": exchanged(fields()["dq"])},
            "q: a joint's torque answers its own command at another joint's angle (FR_hip",
        ),
        (
            {"tau": exchanged(fields()["tau"])},
            "tau: a joint's tau follows another joint's command and motion (FR_",
        ),
        ({"tau": 1e3 * fields()["tau"]}, "tau: 1e+03 times what kp asks for on FR_hip_joint"),
        (
            {"tau": np.random.default_rng(0).normal(size=(2000, 12))},
            "tau: does not answer the position error",
        ),
        ({"q": np.zeros((2000, 12)), "dq": np.zeros((2000, 12))}, "q: no joint moves by more than"),
        (
            {"q": fields()["q"][0] + np.random.default_rng(1).normal(0.0, 1e-3, (2000, 12))},
            "q: no joint moves by more than",
        ),
        ({"kp": np.zeros((2000, 12))}, "valid: 0.00 s under PD control are left"),
        ({"kp": np.full((2000, 12), -30.0)}, "kp: found -30"),
        (
            {"t": fields()["t"] * 1e6, "t_cmd": fields()["t"] * 1e6},
            "t: a row comes every 2000 s; is t in",
        ),
        ({"t": set_back(fields()["t"])}, "t: jumps by 1.7e+09 s from row 999 to row 1000"),
        ({"t_cmd": fields()["t"] + 1e9}, "t_cmd: 1e+09 to 1e+09 s, t: 0 to 3.998 s: nothing in common"),
        ({"t_cmd": fields()["t"] * 1e3}, "t_cmd: 0 to 3998 s, t: 0 to 3.998 s: 1e+03 times as long"),
        ({"t_cmd": fields()["t"] + 0.2}, "t_cmd: the torque answers commands 0.20 s before they were sent"),
        ({"t_cmd": fields()["t"] - 0.2}, "t_cmd: the torque answers commands 0.20 s after they were sent"),
        ({"dq": of_one(fields()["dq"], 0.0)}, "dq: is 0 on FR_thigh_joint although q moves"),
        ({"dq": 2.0 * fields()["dq"]}, "dq: the slope of q is 0.5 times dq on FR_hip_joint"),
        (
            {"q": of_one(fields()["q"], -1.0), "dq": of_one(fields()["dq"], -1.0)},
            "q: FR_thigh_joint has the opposite sign of its command and its torque",
        ),
        (
            {"q_des": of_one(fields()["q_des"], -1.0)},
            "q_des: FR_thigh_joint answers its own command with the opposite sign",
        ),
        ({"tau": of_one(fields()["tau"], 1e3)}, "tau: 1e+03 times what kp asks for on FR_thigh_joint"),
        ({"kp": of_one(np.full((2000, 12), 30.0), 100.0)}, "tau: 0.00999 times what kp asks for on FR_thigh"),
    ],
)
def test_misleading_log_is_refused(changes: dict[str, Any], sentence: str) -> None:
    checked = check_log(log(**changes))
    assert any(text.startswith(sentence) for text in texts(checked, "refusal")), checked.findings
    with pytest.raises(LogError, match=r"^a\.npz: "):
        checked.raise_refusal()


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_strong_spring_at_one_joint_is_not_a_wrong_unit(share: float) -> None:
    """The torque answers the position error with a `share` of kp, and the command with all of it."""
    given = fields()
    error, angle = (given["q_des"] - given["q"])[:, 1], given["q"][:, 1] - given["q"][:, 1].mean()
    spring = (1.0 - share) * KP * (error @ (error - error.mean())) / (error @ angle) * angle
    tau = given["tau"] - np.outer(spring, np.arange(12) == 1)
    assert texts(check_log(log(tau=tau)), "refusal") == []


def test_gaps_dropped_and_repeated_rows_are_counted() -> None:
    t = fields()["t"]
    keep = ((t < 1.0) | (t > 1.3)) & (np.arange(2000) % 50 != 7)
    given = {name: fields()[name][keep] for name in ("t", "q", "dq", "tau", "q_des")}
    for name in ("q", "dq", "tau"):
        given[name][100:400:10] = given[name][99:399:10]
    shape = given["q"].shape
    same = {"kp": np.full(shape, 30.0), "kd": np.full(shape, 0.5), "valid": np.ones(shape, bool)}
    warnings = texts(check_log(log(**given, t_cmd=given["t"], **same)), "warning")
    assert "t: 1 gap, the longest of 0.304 s at 1.00 s" in warnings
    assert "t: about 37 rows were dropped, one at a time" in warnings
    assert any(text.startswith("q: 30 rows (") for text in warnings)


def test_repeated_rows_are_shares_of_the_rows_also_where_the_torque_repeats_more_often() -> None:
    given = {name: fields()[name].copy() for name in ("q", "dq", "tau")}
    given["tau"] = given["tau"][np.arange(2000) // 4 * 4]
    for name in ("q", "dq"):
        given[name][101:401:12] = given[name][100:400:12]
    warnings = texts(check_log(log(**given)), "warning")
    assert any(text.startswith("tau: 75 % of the rows repeat") for text in warnings)
    repeated = next(text for text in warnings if text.startswith("q: 25 rows ("))
    assert float(repeated.split("(")[1].split(" %")[0]) < 5.0


def test_the_same_channel_twice_is_named_in_each_field() -> None:
    q, tau = fields()["q"].copy(), fields()["tau"].copy()
    q[:, 1], tau[:, 4] = q[:, 0], tau[:, 3]
    warnings = texts(check_log(log(q=q, tau=tau)), "warning")
    assert {text.partition(":")[0] for text in warnings if "the same to the bit" in text} == {"q", "tau"}


def test_clipped_channels_and_joints_at_rest_are_named() -> None:
    dq, q = fields()["dq"], fields()["q"]
    q[:, 7] = 0.6
    dq[:, 7] = 0.0
    tau = fields()["tau"]
    tau[:, 2] = np.clip(tau[:, 2], -0.5, 0.5)
    checked = check_log(log(q=q, dq=dq, tau=tau))
    found = {finding.text.split(":")[1].strip(): finding.joints for finding in checked.findings}
    assert found["never moves"] == ("RR_thigh_joint",)
    assert found["clipped (N m)"] == ("FR_calf_joint",)


def test_a_clipped_command_is_noted_and_a_held_or_constant_one_is_not() -> None:
    t, q_des = fields()["t"], fields()["q_des"].copy()
    swing = np.sin(2.0 * np.pi * 2.0 * t)  # 2 Hz: half a period takes 0.25 s
    q_des[:, 0] = np.clip(0.2 * swing, -1.0, 0.15)
    q_des[:, 1] = 0.2 * np.maximum(np.sin(2.0 * np.pi * t), 0.0)  # between two steps held for 0.5 s
    q_des[:, 2] = np.where(swing > 0.0, 2.2e-16, 0.0)
    q_des[:, 3] = 0.2 * np.maximum(np.sin(2.0 * np.pi * 3.0 * t), 0.0) ** 4  # comes to rest smoothly
    found = [finding for finding in check_log(log(q_des=q_des)).findings if "clipped" in finding.text]
    assert [(finding.field, finding.joints) for finding in found] == [("q_des", ("FR_hip_joint",))]
    assert "FR_hip_joint at 0.15" in found[0].text


def test_names_that_contradict_the_model_are_reported() -> None:
    order = list(np.roll(np.arange(12), 1))
    moved = {name: fields()[name][:, order] for name in ("q", "dq", "tau", "q_des")}
    warnings = texts(check_log(attrs.evolve(log(**moved), robot=ALIENGO)), "warning")
    assert any(text.startswith("joint_names: q contradicts the model's range") for text in warnings)
    strange = attrs.evolve(log(), joints=(*JOINT_NAMES[:11], "RL_knee_joint"))
    assert "joint_names: RL_knee_joint: not among" in " ".join(texts(check_log(strange), "warning"))


def test_a_gain_of_zero_is_left_out() -> None:
    kp = np.full((2000, 12), 30.0)
    kp[1000:] = 0.0
    checked = check_log(log(kp=kp))
    assert "kp: 0 (damping, switched off or torque control) 2.00 s to the end" in texts(checked, "warning")[0]
    assert checked.log.valid[:1000].all()
    assert not checked.log.valid[1000:].any()


@pytest.mark.parametrize("gains_known", [True, False])
@pytest.mark.parametrize("damping", [0.0, 5.0])
def test_damping_and_switching_off_show_in_the_torque(gains_known: bool, damping: float) -> None:
    given = fields()
    off = given["t"] > 2.5
    tau = np.where(off[:, None], -damping * given["dq"], given["tau"])
    tau += np.random.default_rng(1).normal(0.0, 0.05, tau.shape)
    q_des = np.where(off[:, None], given["q_des"][~off][-1] + 0.1, given["q_des"])
    gains = {} if gains_known else {"kp": None, "kd": None}
    checked = check_log(log(tau=tau, q_des=q_des, **gains))
    assert any("tau: the torque no longer answers" in text for text in texts(checked, "warning"))
    valid = checked.log.valid.any(axis=1)
    assert not valid[off].any()
    assert valid[given["t"] < 2.3].all()


def test_drive_under_a_constant_load_is_not_switched_off() -> None:
    """A spring in part of the range cancels the mean torque, which still follows the error."""
    t = np.arange(3000) * 0.002
    error = (0.1 * np.sin(0.5 * np.pi * t) + 0.01 * np.sin(6.0 * np.pi * t))[:, None]
    q = 0.4 * np.sin(0.9 * t)[:, None]
    one = {"t": t, "t_cmd": t, "q": q, "dq": np.gradient(q, t, axis=0), "q_des": q + error}
    gains = {"valid": np.ones(q.shape, bool), "kp": np.full(q.shape, 30.0), "kd": np.full(q.shape, 0.5)}
    tau = 30.0 * error - 0.5 * one["dq"]
    pushed = error[:, 0] > 0.07
    tau[pushed] -= tau[pushed].mean()
    assert check_log(Log(name="a.npz", joints=("a",), tau=tau, **one, **gains)).log.valid.all()


def test_saturation_and_friction_are_not_damping() -> None:
    given = fields()
    tau = np.clip(given["tau"], -0.6, 0.6) - 0.3 * np.tanh(given["dq"] / 0.02)
    assert check_log(log(tau=tau)).log.valid.all()


def test_feed_forward_torque_is_subtracted_before_the_checks() -> None:
    given = fields()
    held = np.clip(given["q_des"], ALIENGO.nominal_q - 0.05, ALIENGO.nominal_q + 0.05)
    checked = check_log(log(q_des=held, tau_ff=KP * (given["q_des"] - held)))
    assert texts(checked, "warning") == texts(checked, "refusal") == []
    assert checked.log.valid.all()
    weight = np.full(held.shape, -40.0)
    checked = check_log(log(tau=given["tau"] + weight, tau_ff=weight))
    assert texts(checked, "warning") == texts(checked, "refusal") == []


def test_unknown_gains_and_missing_torque_are_reported() -> None:
    notes = texts(check_log(log(kp=None, kd=None)), "note")
    assert "kp: not in the log; it is fitted" in notes
    assert "kd: not in the log; it is fitted" in notes
    notes = texts(check_log(log(tau=None)), "note")
    assert any(one.startswith("tau: not in the log; effects") for one in notes)


def test_log_without_torque_and_gains_is_refused() -> None:
    (text,) = texts(check_log(log(kd=None, tau=None)), "refusal")
    assert text.startswith("tau, kd: not in the log; expected the torque, or the commanded gains")
    assert texts(check_log(log(kp=None, kd=None, tau=None), gains=(30.0, 0.5)), "refusal") == []


def test_given_gains_are_not_reported_missing() -> None:
    assert not any(
        "kp: not in" in text for text in texts(check_log(log(kp=None, kd=None), gains=(30.0, 0.5)), "note")
    )


def test_constant_torque_is_treated_as_not_logged() -> None:
    checked = check_log(log(tau=np.zeros((2000, 12))))
    assert checked.log.tau is None
    assert "tau: is 0 throughout, which is no measurement; treated as not logged" in texts(checked, "warning")


def test_inseparable_parameters_are_reported() -> None:
    still = np.tile(fields()["q_des"].mean(axis=0), (2000, 1))
    warnings = texts(check_log(log(q_des=still)), "warning")
    assert "q_des: the command never changes, so that no delay of the command can be identified" in warnings
    slow = np.linspace(0.0, 4.0, 2000)[:, None] * np.ones(12)
    steady = {"q": 0.1 * slow, "dq": np.full((2000, 12), 0.1), "q_des": 0.1 * slow + 0.05}
    sentences = " ".join(finding.text for finding in check_log(log(**steady, tau=None)).findings)
    assert "this motion hardly separates kp from torque offset" in sentences


MEASURED = Path(os.environ.get("QUADVEL_MEASURED", ""))
measured = pytest.mark.skipif(
    "QUADVEL_MEASURED" not in os.environ, reason="QUADVEL_MEASURED names no folder of measured logs"
)


@measured
@pytest.mark.parametrize(("number", "begins"), [(1, 9.64), (2, 11.45)])
@pytest.mark.parametrize("without", [(), ("kp", "kd"), ("tau",)])
def test_the_damping_after_a_walk_is_noticed(number: int, begins: float, without: tuple[str, ...]) -> None:
    walk = read_log(MEASURED / f"go2_walk_{number}.npz")
    checked = check_log(attrs.evolve(walk, **dict.fromkeys(without)))
    checked.raise_refusal()
    valid = checked.log.valid.any(axis=1)
    assert not valid[walk.t > begins + 0.15].any()
    before = (walk.t > walk.t_cmd[0]) & (walk.t < begins - 0.5)
    assert valid[before].all()


@measured
def test_measured_logs_with_commands_are_accepted() -> None:
    for name in ("go2_inair", "go2_replay_50hz"):
        checked = check_log(read_log(MEASURED / f"{name}.npz"))
        checked.raise_refusal()
        assert checked.log.valid.all()


@measured
@pytest.mark.parametrize("name", ["ak80_acrobot", "ak80_pendubot"])
def test_measured_logs_of_torque_commands_are_refused(name: str) -> None:
    with pytest.raises(LogError, match=rf"{name}\.npz: q_des: the field is missing"):
        read_log(MEASURED / f"{name}.npz")


def test_commanded_speed_is_not_a_clock_offset(tmp_path):
    """kd dq_des leads kp q_des, as a torque before its command would."""
    log, kd = fields(), 4.0
    dq_des = np.gradient(log["q_des"], log["t"], axis=0)
    tau = log["tau"] + kd * (dq_des - log["dq"]) + KD * log["dq"]
    found = check_log(read_log(npz(tmp_path / "log.npz", dq_des=dq_des, tau=tau, kd=kd)))
    assert not [one.text for one in found.findings if one.kind == "refusal"]


def test_joint_that_turns_far_without_a_position_command_does_not_stop_the_others() -> None:
    """The command of the second joint is 0 while a torque turns it by 40 rad."""
    given, second = fields(), np.arange(12) == 1
    turned = 10.0 * given["t"] + np.sin(3.0 * given["t"])
    far = np.where(second, turned[:, None], given["q"])
    fast = np.where(second, np.gradient(turned, given["t"])[:, None], given["dq"])
    loose = log(q=far, dq=fast, q_des=np.where(second, 0.0, given["q_des"]), kp=None, kd=None)
    (checked,), _ = check_logs([loose])
    assert checked.log.joints == tuple(name for name in JOINT_NAMES if name != "FR_thigh_joint")
    named = [(one.kind, one.field) for one in checked.findings if one.joints == ("FR_thigh_joint",)]
    assert named == [("warning", "q_des"), ("note", "valid")]
    assert len(texts(checked, "warning")) == 1


def test_logs_that_leave_no_joint_both_fitted_and_reported_are_refused() -> None:
    first, second = (np.arange(12) == j for j in (0, 1))
    logs = [log(valid=np.tile(one, (2000, 1))) for one in (first, second)]
    with pytest.raises(LogError, match="valid: no joint has rows both in the logs to fit"):
        check_logs(logs[:1], logs[1:])
    (fitted, other), _ = check_logs(logs)
    assert fitted.log.joints == other.log.joints == JOINT_NAMES[:2]
