"""The diagnosis names what was changed in a recorded walk, and nothing in a sound one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import attrs
import numpy as np
import pytest

from benchmarks.why.walks import Defect, RecordedWalk
from quadvel_bringup import cli
from quadvel_policy.imported.importer import Supplement
from quadvel_policy.policy_file import PolicyFile
from quadvel_sysid.logs.readers.recordings import Topics
from quadvel_why.diagnosis import Diagnosis, diagnose
from quadvel_why.links import CAUSES
from quadvel_why.links.contract import Gains
from quadvel_why.links.drives import JammedJoint, SpeedTorqueLimit, TorqueLimit, WeakDrive
from quadvel_why.links.ground import Payload, RoughGround, Slipping, SteepGround
from quadvel_why.page import page
from quadvel_why.policy_replay import PolicyReplay
from quadvel_why.reading import read_run
from quadvel_why.report import summary
from quadvel_why.run import Commands, Modes, Run
from quadvel_why.signals import PARTS, Signals
from tests.helpers.robots import ALIENGO
from tests.quadvel_policy.test_imported import MJLAB, import_policy, write_network

ORDER = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]


@pytest.fixture(scope="module")
def run(walk: Path) -> Run:
    return read_run(walk)


def examine(run: Run) -> Diagnosis:
    return diagnose(Signals(run, PolicyFile(ALIENGO)))


def commands(run: Run, **fields: object) -> Run:
    return attrs.evolve(run, commands=attrs.evolve(run.commands, **fields))


def imu(run: Run, **fields: object) -> Run:
    assert run.imu is not None
    return attrs.evolve(run, imu=attrs.evolve(run.imu, **fields))


def scaled_targets(c: Commands) -> np.ndarray:
    offset = np.array(PolicyFile(ALIENGO).metadata.action_offset)
    walks = np.isclose(c.kp, 30.0)
    return np.where(walks, offset + 0.6 * (c.q - offset), c.q)


def flipped(values: np.ndarray, joint: int) -> np.ndarray:
    changed = values.copy()
    changed[:, joint] *= -1.0
    return changed


def held(values: np.ndarray, joint: int) -> np.ndarray:
    changed = values.copy()
    changed[200:206, joint] = changed[200, joint]
    return changed


def repeated(run: Run) -> Run:
    rows = np.arange(len(run.time))
    rows[100::10] -= 1
    return attrs.evolve(run, q=run.q[rows], dq=run.dq[rows])


def limited(run: Run, stall: float, no_load: float) -> np.ndarray:
    """Torques of drives whose limit falls with the speed while they drive, and is constant while they brake."""
    assert run.tau is not None
    limit = stall * np.clip(1.0 - run.dq * np.sign(run.tau) / no_load, 0.0, 1.0)
    return np.clip(run.tau, -limit, limit)


def first(run: Run, rows: int) -> Run:
    """The beginning of a run."""
    assert run.tau is not None
    assert run.imu is not None
    answers = run.commands.answers < rows

    def cut(record: attrs.AttrsInstance, kept: slice | np.ndarray) -> dict[str, np.ndarray]:
        return {f.name: getattr(record, f.name)[kept] for f in attrs.fields(type(record))}

    shorter = imu(commands(run, **cut(run.commands, answers)), **cut(run.imu, slice(rows)))
    return attrs.evolve(shorter, **{f: getattr(run, f)[:rows] for f in ("time", "q", "dq", "tau")})


CHANGES: dict[str, Callable[[Run], Run]] = {
    "joint_order": lambda r: attrs.evolve(r, **{f: getattr(r, f)[:, ORDER] for f in ("q", "dq", "tau")}),
    "joint_sign": lambda r: attrs.evolve(r, q=flipped(r.q, 4), dq=flipped(r.dq, 4), tau=flipped(r.tau, 4)),
    "joint_scale": lambda r: attrs.evolve(r, dq=np.rad2deg(r.dq)),
    "joint_offset": lambda r: attrs.evolve(r, q=r.q + 0.1 * (np.arange(12) == 7)),
    "gains": lambda r: commands(r, kp=1.3 * r.commands.kp, kd=1.3 * r.commands.kd),
    "quaternion_order": lambda r: imu(r, quaternion=r.imu.quaternion[:, [1, 2, 3, 0]]),  # type: ignore[union-attr]
    "gyro_frame": lambda r: imu(r, angular_velocity=-r.imu.angular_velocity),  # type: ignore[union-attr]
    "repeated_states": repeated,
    "long_delay": lambda r: commands(r, time=r.commands.time - 0.011),
    "encoder_held": lambda r: attrs.evolve(r, q=held(r.q, 5), dq=held(r.dq, 5)),
    "weak_drive": lambda r: attrs.evolve(r, tau=r.tau * np.where(np.arange(12) == 3, 0.4, 1.0)),
    "command_out_of_range": lambda r: attrs.evolve(
        r,
        velocity_command=attrs.evolve(r.velocity_command, value=8.0 * r.velocity_command.value),  # type: ignore[union-attr]
    ),
}
"""Name of a cause, and a change of a sound recording that has this cause"""


def test_a_sound_walk_has_no_finding(run: Run) -> None:
    found = examine(run)
    assert found.finding is None, found.finding
    assert not found.skipped


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_recording_is_named_by_what_was_changed(name: str, run: Run) -> None:
    if name in ("command_out_of_range", "quaternion_order", "gyro_frame", "repeated_states", "joint_offset"):
        # Other links than the actions are meant: without the estimate no policy is replayed.
        run = attrs.evolve(run, estimate=None)
    found = examine(CHANGES[name](run)).finding
    assert found is not None
    assert found.cause.name() == name, found.measurement.sentence
    assert found.measurement.value > found.limit
    assert found.measurement.traces


def test_a_robot_whose_feet_carry_nothing_hangs_and_is_not_weighed(run: Run) -> None:
    assert run.tau is not None
    policy = PolicyFile(ALIENGO)
    heavy = Payload().measure(Signals(attrs.evolve(run, tau=1.6 * run.tau), policy))
    assert heavy is not None
    assert heavy.value > 1.0
    hanging = Signals(attrs.evolve(run, tau=0.1 * run.tau), policy)
    assert diagnose(hanging, causes=[Payload]).skipped == {
        "payload": f"the recording lacks {PARTS['ground']}"
    }


def test_a_robot_that_stood_for_a_moment_has_no_weak_drive(run: Run) -> None:
    standing = first(run, 100)
    rng = np.random.default_rng(3)
    noisy = attrs.evolve(standing, tau=standing.tau + rng.normal(0.0, 0.3, standing.q.shape))
    found = examine(noisy).finding
    assert found is None, found.cause.name()


@pytest.mark.parametrize("seed", range(6))
def test_noise_of_a_standing_robot_is_neither_other_gains_nor_a_weak_drive(run: Run, seed: int) -> None:
    rng, shape = np.random.default_rng(seed), run.q.shape
    levelled = run.commands.q[0] + 1e-4 * rng.normal(0.0, 1.0, run.commands.q.shape)
    held = commands(run, q=levelled, dq=0.0 * run.commands.dq)
    load = run.tau[0] + 0.02 * np.sin(run.time)[:, None]
    standing = attrs.evolve(
        held,
        q=run.q[0] + rng.normal(0.0, 1e-3, shape),
        dq=rng.normal(0.0, 0.05, shape),
        tau=load + rng.normal(0.0, 0.3, shape),
    )
    signals = Signals(standing, PolicyFile(ALIENGO))
    for cause in (Gains(), WeakDrive()):
        measured = cause.measure(signals)
        assert measured is None or measured.value < cause.least, measured


@pytest.mark.parametrize("no_load", [20.0, 1e9])
def test_a_limit_that_falls_with_the_speed_is_told_from_a_constant_one(no_load: float, run: Run) -> None:
    limited_drives = attrs.evolve(run, tau=limited(run, stall=12.0, no_load=no_load))
    signals = Signals(limited_drives, PolicyFile(ALIENGO))
    constant, falling = TorqueLimit().measure(signals), SpeedTorqueLimit().measure(signals)
    assert constant is not None
    assert falling is not None
    assert (constant.value > TorqueLimit.least, falling.value > SpeedTorqueLimit.least) == (
        no_load > 1e6,
        no_load < 1e6,
    )


def test_another_scale_of_the_actions_is_named(run: Run) -> None:
    changed = attrs.evolve(commands(run, q=scaled_targets(run.commands)), tau=None)
    found = examine(changed).finding
    assert found is not None
    assert found.cause.name() == "action_scale", found.measurement.sentence
    assert "0.60 times" in found.measurement.sentence


def test_the_trim_of_a_controller_is_part_of_what_its_policy_got(tmp_path: Path) -> None:
    recorded = RecordedWalk(Defect(), seed=5, plant={"payload": 8.0})
    assert recorded.run([((0.8, 0.0, 0.0), 4.0)])
    run = read_run(recorded.messages.write(tmp_path / "walk.mcap"))

    def error(changed: Run) -> float:
        return PolicyReplay(changed, PolicyFile(ALIENGO)).base.error

    assert run.trim is not None
    assert np.ptp(run.trim.value[:, 0]) > 0.01
    other = attrs.evolve(run.trim, value=run.trim.value + np.array([0.1, 0.0, 0.0]))
    assert error(run) < 0.25 * error(attrs.evolve(run, trim=None))
    assert error(run) < 0.25 * error(attrs.evolve(run, trim=other))


def test_what_a_recording_lacks_is_told_and_not_guessed(run: Run) -> None:
    joints_only = attrs.evolve(run, imu=None, estimate=None, modes=None, velocity_command=None, is_own=False)
    found = diagnose(Signals(joints_only, None))
    assert found.finding is None
    assert {"quaternion_order", "slipping", "memory_reset"} <= found.skipped.keys()


def test_the_command_writes_the_finding_and_ends_with_1(run: Run, tmp_path: Path) -> None:
    rows = np.flatnonzero(run.commands.servo[np.maximum(run.command_rows(0.0), 0)])
    log = {"t": run.time[rows], "q": run.q[rows], "dq": run.dq[rows], "tau": -run.tau[rows]}  # type: ignore[index]
    now = np.maximum(run.command_rows(0.0), 0)[rows]
    log |= {"q_des": run.commands.q[now], "kp": run.commands.kp[now], "kd": run.commands.kd[now]}
    np.savez(tmp_path / "log.npz", **log)
    arguments = [str(tmp_path / "log.npz"), "--out", str(tmp_path / "out"), "--gains", "3", "0.1"]
    with pytest.raises(SystemExit) as ended, pytest.warns(UserWarning, match="so --gains is not used"):
        cli.command("why").main(arguments)
    assert ended.value.code == 1
    answer = json.loads((tmp_path / "out" / "why.json").read_text())
    assert answer["finding"]["cause"]
    assert answer["reports_walk"] is False
    assert (tmp_path / "out" / "why.png").stat().st_size > 1000


def test_of_a_sound_walk_no_picture_stays_of_another_recording(walk: Path, tmp_path: Path) -> None:
    (tmp_path / "why.png").write_text("of another recording")
    with pytest.raises(SystemExit) as ended:
        cli.command("why").main([str(walk), "--out", str(tmp_path)])
    assert ended.value.code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["why.json"]


def test_topics_are_refused_for_a_recording_of_this_stack(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected no --state-topic"):
        read_run(walk, topics_of_log=Topics(state="foo"))


def test_several_recordings_have_a_folder_each(run: Run, tmp_path: Path) -> None:
    now = np.maximum(run.command_rows(0.0), 0)
    log = {"t": run.time, "q": run.q, "dq": run.dq, "q_des": run.commands.q[now]}
    files = [tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "again" / "a.npz"]
    files[2].parent.mkdir()
    for file in files:
        np.savez(file, **log)  # type: ignore[arg-type]
    options = ["--gains", "30", "0.5", "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        cli.command("why").main([str(files[0]), str(files[1]), *options])
    assert ended.value.code in (0, 1)
    assert sorted(path.parent.name for path in tmp_path.glob("out/*/why.json")) == ["a", "b"]
    with pytest.raises(SystemExit) as ended:
        cli.command("why").main([str(files[0]), str(files[2]), *options])
    assert ended.value.code == 2


def test_a_table_with_other_names_is_read_by_a_column_map(run: Run, tmp_path: Path) -> None:
    now = np.maximum(run.command_rows(0.0), 0)
    np.savez(tmp_path / "bench.npz", t=run.time, angles=run.q, dq=run.dq, goal=run.commands.q[now])
    (tmp_path / "map.yaml").write_text("q: angles\nq_des: goal\n")
    arguments = [str(tmp_path / "bench.npz"), "--gains", "30", "0.5", "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        cli.command("why").main([*arguments, "--columns", str(tmp_path / "map.yaml")])
    assert ended.value.code in (0, 1)
    assert (tmp_path / "out/why.json").exists()


@pytest.mark.parametrize("policy", ["none", "imported.onnx"])
def test_without_a_policy_to_replay_the_other_causes_are_examined(
    policy: str,
    walk: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_network(tmp_path / "policy.onnx", 48, MJLAB)
    supplement = Supplement(limits=(1.0, 0.5, 1.0), rate_hz=50.0)
    import_policy(ALIENGO, tmp_path / "policy.onnx", None, tmp_path / "imported.onnx", supplement)
    with pytest.raises(SystemExit) as ended:
        cli.command("why").main([str(walk), "--policy", policy])
    assert ended.value.code == 0
    answer = json.loads((tmp_path / "out/why/why.json").read_text())
    assert answer["finding"] is None
    assert {"other_actions", "action_scale", "memory_reset"} <= answer["skipped"].keys()
    assert ("is of another project" in capsys.readouterr().err) == (policy != "none")


def test_every_cause_has_a_row_and_knows_what_it_needs() -> None:
    names = [cause.name() for cause in CAUSES]
    assert len(set(names)) == len(names) >= 24
    assert all(set(cause.needs) <= PARTS.keys() and cause.remedy for cause in CAUSES)


def test_the_page_is_as_printed() -> None:
    printed = Path(__file__).parents[2] / "docs" / "why.md"
    assert printed.read_text() == page(), "run: python -m quadvel_why.page > docs/why.md"


def test_lost_states_are_no_jump_of_the_angle(run: Run) -> None:
    kept = np.setdiff1d(np.arange(len(run.time)), [200, 201, 202, 300])
    lost = attrs.evolve(run, time=run.time[kept], q=run.q[kept], dq=run.dq[kept])
    whole, jumps = Signals(run, None).jumps, Signals(lost, None).jumps
    assert not jumps[[199, 296]].any()
    assert np.abs(jumps).max() <= np.abs(whole).max()


def test_states_that_were_taken_late_together_are_no_jump_of_the_angle(run: Run) -> None:
    time = run.time.copy()
    time[200] = time[201] - 3e-5  # the computer was busy
    late = attrs.evolve(run, time=time)
    assert np.abs(Signals(late, None).jumps[200]).max() <= np.abs(Signals(run, None).jumps).max()


def headline(run: Run, modes: list[str], faults: list[str]) -> str:
    """The first line of the answer for a run with these reports of the controller."""
    reported = attrs.evolve(run, modes=Modes(np.arange(len(modes)) * 0.1, tuple(modes), tuple(faults)))
    return summary(reported, Diagnosis(None, {}, {})).splitlines()[0]


def test_a_run_is_stopped_by_its_last_fault(run: Run) -> None:
    line = headline(run, ["walk", "stance", "fault"], ["", "accelerometer_implausible", "joint_too_fast"])
    assert "stopped by joint_too_fast" in line
    assert "accelerometer_implausible" not in line


def test_a_run_that_went_on_after_a_reset_was_not_stopped(run: Run) -> None:
    modes = ["walk", "stance", "fault", "passive", "stand_up", "walk"]
    line = headline(run, modes, ["", "accelerometer_implausible", "joint_too_fast", "", "", ""])
    assert "last mode walk" in line
    assert "stopped by" not in line
    assert "joint_too_fast" in line


def test_a_walk_after_a_fault_is_examined_though_the_walk_before_it_lacks_its_beginning(run: Run) -> None:
    assert run.modes is not None
    names, faults = run.modes.name, run.modes.fault
    earlier = attrs.evolve(
        run.modes,
        name=("walk", "fault", "stance", *names[3:]),
        fault=("", "joint_too_fast", *faults[2:]),
    )
    found = examine(attrs.evolve(run, modes=earlier))
    assert found.finding is None, found.finding
    assert not found.skipped


def test_causes_that_are_not_examined_for_one_reason_share_a_line(run: Run) -> None:
    joints_only = attrs.evolve(run, imu=None, estimate=None, modes=None, velocity_command=None, is_own=False)
    diagnosis = diagnose(Signals(joints_only, None))
    lines = summary(joints_only, diagnosis).splitlines()
    assert len(lines) == 2 + len(set(diagnosis.skipped.values()))
    assert all(any(name in line for line in lines) for name in diagnosis.skipped)


def test_of_a_robot_that_hangs_nothing_about_feet_and_ground_is_examined(run: Run) -> None:
    assert run.tau is not None
    light = attrs.evolve(run, tau=0.1 * run.tau)
    signals = Signals(light, PolicyFile(ALIENGO))
    assert "ground" not in signals.parts
    assert "ground" in Signals(run, PolicyFile(ALIENGO)).parts
    causes = (JammedJoint, SteepGround, RoughGround, Slipping)
    assert diagnose(signals, causes=causes).skipped.keys() == {cause.name() for cause in causes}
