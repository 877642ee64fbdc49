"""Every example of every document runs as it stands there, or shortened, or is left out for a reason.

Examples are the indented and the fenced blocks of the documents, and the commands in what `--help` shows.
"""

from __future__ import annotations

import contextlib
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import attrs
import numpy as np
import pytest
from typer.testing import CliRunner

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_bringup import cli
from quadvel_bringup.__main__ import main
from quadvel_bringup.processes import ProcessGroup
from quadvel_policy.policy_file import SHIPPED_POLICY
from tests.helpers.robots import ALIENGO
from tests.helpers.standing import READY, wait_until_ready
from tests.quadvel_sysid.joint_logs import fields, mcap

ROOT = Path(__file__).parents[2]
DOCUMENTS = ("*.md", "docs/**/*.md", "src/*/README.md", "training/README.md", "ros_ws/README.md")
PROGRAMS = {"quadvel": [sys.executable, "-m", "quadvel_bringup"], "python": [sys.executable]}


@attrs.frozen
class Step:
    """An example and how it is run. more: arguments that shorten it. served: it runs until Ctrl-C."""

    example: str
    more: str = ""
    served: bool = False
    then: str = ""  # what it says once the next step may begin


ROBOT = [
    Step("quadvel up --terrain rough", served=True, then=READY),
    Step("quadvel status"),
    Step("quadvel status --joints"),
    Step("quadvel drive --vx 0.5 --wz 0.3 --seconds 5", more="--seconds 1.5"),
    Step("quadvel drive --vx 0.5", more="--seconds 1.5"),
    Step("quadvel push --fy 60"),
    Step(
        "quadvel record low_state low_cmd --out walk.mcap --seconds 30",
        more="--seconds 0.5 --out identified.mcap",
    ),
    Step("quadvel record low_state low_cmd --out first.mcap", more="--seconds 0.5"),
    Step("quadvel record low_state low_cmd --out run.mcap", more="--seconds 0.5"),
    Step("quadvel record low_state low_cmd --out walk.mcap", more="--seconds 0.5 --out helped.mcap"),
    Step("quadvel reset"),
    Step("quadvel reset --terrain slope --slope 0.175"),
    Step("quadvel mode passive"),
    Step("quadvel mode stand_up"),
]
EXCITE = [
    Step("quadvel excite foot-lifting --out lift.mcap", more="--seconds 0.5"),
    Step("quadvel identify lift.mcap --out out/identify", more="--joints FR_calf"),
    Step("quadvel excite --after out/identify/report.json"),
    Step("quadvel excite sweep --out sweep.mcap", more="--seconds 0.5"),
    Step("quadvel identify sweep.mcap --out out/identify", more="--joints FR_calf"),
    Step("quadvel up --actuator out/identify/actuator.yaml", served=True, then=READY),
]
LOGS = [  # of one leg each, or of twelve joints
    Step("quadvel identify walk.mcap --out out/identify", more="--joints FR_calf"),
    Step("quadvel identify walk_1.npz --holdout walk_2.npz --gains 35 0.5 --robot go2 --out out/identify"),
    Step("quadvel identify walk_1.npz --joints FR_hip FR_thigh FR_calf --out out/identify"),
    Step("quadvel identify suspended.npz --gains 30 0.5 --out out/identify"),
    Step("quadvel identify out/loop/walk.npz --out out/loop/identified"),
]
NODES = [
    Step("quadvel world campus --out out/campus.png"),
    Step("quadvel people --out out/people", more="--runs 1"),
    Step("python -m quadvel_training --help"),
    Step("quadvel run sim_node --ros-args -p terrain:=rough", served=True),
    Step("quadvel run controller --ros-args -p policy:=my.onnx -r low_cmd:=/test/low_cmd", served=True),
    Step("quadvel run command_mux --ros-args -r cmd_vel:=/joy/cmd_vel", served=True),
    Step("quadvel run driver --ros-args -p dry_run:=true", served=True),
    Step("quadvel run person_tracker --ros-args -p laser_x:=0.25", served=True),
    Step("quadvel run follow_planner --ros-args -p laser_x:=0.25 -p side:=left", served=True),
    Step("quadvel run trajectory_planner --ros-args -p file:=eight -p closed_loop:=true", served=True),
    Step("quadvel doctor"),
    Step("quadvel doctor --report"),
]
GO2 = [
    Step("quadvel up --robot go2 --policy none --estimator kalman", served=True, then="stance: stood up"),
    Step("quadvel run driver --ros-args -p robot:=go2 -p dry_run:=true", served=True),
]
USUAL = ["robot", "logs", "nodes"]
SESSIONS = {"go2": GO2, "robot": ROBOT, "excite": EXCITE, "logs": LOGS, "nodes": NODES}

LEFT_OUT = {
    "python -m benchmarks.identification.others walks FOLDER": "needs measured walks",
    "python -m benchmarks.identification.others faulty FILE --kinds clean": "needs a file of faults",
    "quadvel demo follow --tour --out out/tour": "tests/end_to_end/test_follow_demo.py runs the demo",
    "quadvel following --out out/following": "minutes; tests/quadvel_follow/test_follow_planner.py walks on its stage",
    "quadvel people --scans FOLDER --out out/people": "real scans that are no part of this repository; "
    "tests/quadvel_follow takes them where they are",
    "quadvel run sim_node --ros-args -p world:=park": "as with -p terrain; a second simulator is refused",
    "quadvel up": "as with --terrain",
    "quadvel up --world campus": "as with --terrain",
    'quadvel run board --ros-args -p hung:=true -p imu_mounting:="[0.03, 0.0]"': "as the next",
    "quadvel run driver --ros-args -p board_address:=127.0.0.1 -p local_port:=0 -p state_rate:=1000": ""
    "tests/end_to_end/test_board.py walks behind board and driver; tests/quadvel_bringup/test_calibrate.py calibrates",
    "quadvel up --params stamped.yaml": "as the other ups; test_yaml_examples.py loads the file",
    "quadvel demo follow --view": "the same page; tests/end_to_end/test_follow_demo.py runs the demo",
    "quadvel up --view": "tests/quadvel_view/test_page.py opens its page",
    "quadvel view": "the same page, with a robot that runs",
    "quadvel view out/demo/demo.mcap": "tests/quadvel_view/test_page.py plays one",
    "quadvel plot out/demo/demo.mcap --out out/plot": "tests/end_to_end/test_demo.py draws it",
    "quadvel replay out/demo/demo.mcap --out out/replay": "tests/end_to_end/test_demo.py asks it",
    "quadvel identify arm.mcap --gains 30 0.5 --out out/identify": "needs a recording of another robot; "
    "tests/quadvel_sysid/test_formats.py and tests/quadvel_recordings/test_joint_log.py read such recordings",
    "quadvel identify arm.mcap --state-topic /joint_states --command-topic /joint_commands --gains 30 0.5 "
    "--out out/identify": "the same",
    "quadvel replay walk.mcap --actuator out/identify/actuator.yaml": "a replay of another recording; "
    "tests/quadvel_eval/test_recorded_joints.py has several",
    "quadvel drive --vx 0.5 --seconds 40 &": "the other drives, behind the next commands",
    "quadvel record --out fall.mcap": "as the other recordings",
    "quadvel why fall.mcap": "tests/quadvel_why/test_why.py asks it about a walk and its changes",
    "quadvel why fall.mcap --policy mine.onnx": "the same",
    "quadvel why out/faults/*.mcap": "the same",
    "quadvel why out/faults/first.mcap out/faults/second.mcap": "the same",
    "quadvel why walk.npz --gains 35 0.5": "the same",
    "quadvel record --ring 30 --out out/faults": "tests/quadvel_bringup/test_recorder.py has a fault recorded",
    "quadvel view --foxglove": "tests/quadvel_view/test_foxglove.py asks such a server",
    "quadvel teleop": "tests/end_to_end/test_operator.py types its keys",
    "quadvel teleop gamepad": "needs a gamepad; tests/quadvel_view/test_hands.py has its events",
    "quadvel demo": "tests/end_to_end/test_demo.py runs it",
    "quadvel demo --robot go2": "the same",
    "quadvel pause": "tests/end_to_end/test_operator.py pauses the robot",
    "quadvel pause --off": "the same",
    "quadvel step 20": "the same",
    "quadvel demo --low-level board --loss 0.02 --jitter 2": "minutes; tests/end_to_end/test_walk_behind_network.py",
    "quadvel excite creep --seconds 60 --low-level external --out suspended.mcap": "needs the robot",
    "quadvel calibrate --suspended suspended.mcap --standing standing.mcap --out calibration.yaml": "test_calibration.py has one",
    "quadvel up --low-level board": "a board does not wait; tests/end_to_end/test_board.py, on a machine with time to spare",
    "quadvel record low_state --seconds 5 --out standing.mcap": "as the other recordings",
    "quadvel up --low-level driver": "needs the robot",
    "quadvel run driver --ros-args -p state_rate:=1000": "the same",
    "quadvel up --low-level board --params imu.yaml": "as the board without; test_yaml_examples.py loads the file",
    "quadvel run driver --ros-args -p calibration:=calibration.yaml": "the same",
    "quadvel run board --ros-args -p robot:=go2 -p state_rate:=500 -p hung:=true": "all of this machine share DDS domain 1; "
    "tests/end_to_end/test_go2_nodes.py runs both in a domain of its own",
    "quadvel run driver --ros-args -p robot:=go2 -p dds_domain:=1 -p interface:=lo": "the same",
    "quadvel twin dry_gears --out out/twin": "minutes; tests/end_to_end/test_twin.py runs a shorter script",
    "quadvel twin my_plant.yaml": "the same with a plant of the user's",
    "quadvel eval --grid quick --out out/eval": "minutes; tests/quadvel_eval/test_grid.py runs some of its walks",
    "quadvel eval --grid quick --policy NETWORK.onnx --out out/eval": "the same",
    "quadvel eval --grid quick --robot go2 --policy go2.onnx --estimator kalman": "the same",
    "quadvel eval --grid quick --robot go2 --policy kaiwu.onnx --estimator kalman --out out/kaiwu": "the same",
    "quadvel eval --grid paper --seeds 3 --cluster tcp://scheduler:8786": "needs a cluster; tests/quadvel_eval has one",
    "quadvel bench --out out/bench.json": "minutes, and only of use on an idle machine",
    "quadvel bench --live": "a minute, and only of use on an idle machine",
    "quadvel paper --out docs/results/paper": "an hour; tests/quadvel_eval/test_paper_study.py runs parts of it",
    "quadvel paper --out out/ablation --policy rl_pd=a.onnx --policy crl_eam=b.onnx --only tracking --only gap": "the same",
    "quadvel paper --out out/ablation/paper --policy rl_pd=out/ablation/rl_pd/policy.onnx "
    "--policy rl_eam=out/ablation/rl_eam/policy.onnx --policy crl_eam=out/ablation/crl_eam/policy.onnx": "the same",
    "quadvel paper --out out/loop/gap --only gap --policy before=src/quadvel_policy/quadvel_policy/policies/crl_eam.onnx "
    "--policy after=out/loop/tuned/policy.onnx": "the same",
    "quadvel identify go2_walk_1.npz --holdout go2_walk_2.npz --gains 35 0.5 --robot go2 --out out/go2_1": "measured logs that "
    "are no part of this repository; tests/quadvel_sysid/test_measured.py takes them where they are",
    "quadvel identify go2_walk_2.npz --holdout go2_walk_1.npz --gains 35 0.5 --robot go2 --out out/go2_2": "the same",
    "cd ros_ws && colcon build && source install/setup.bash": "needs ROS 2; tests/ros does it",
    "colcon build": "needs ROS 2; tests/ros does it",
    "python3 -m venv --system-site-packages .venv": "makes an environment out of the network",
}
LEFT_OUT_KINDS = {
    r"make [a-z-]+": "make sets up an environment out of the network; the CI runs these",
    r"\. .*/(activate|setup\.bash)": "changes the shell that it is typed into",
    r"export .*": "the same",
    r"(\.venv/bin/)?pip install .*": "needs the network",
    r"ssh .*": "needs another host",
    r"sudo apt install .*|git clone .*": "needs the network",
    r"(ROS_SECURITY_ENCLAVE_OVERRIDE=\S+ )?ros2 .*": "needs ROS 2; tests/ros runs the launch files there",
    r"\.venv/bin/pytest .*": "these are the tests",
    r"python -m quadvel_training (?!--help).*": "minutes to hours; tests/training runs each stage for some steps",
    r"torchrun .*": "the same",
    r"python -m benchmarks\.(tracking|identification) (enter|judge|publish|table).*": "minutes; tests/benchmarks runs parts",
    r"quadvel robot check .*": "the tutorial on other robots runs it; test_found_robot.py has files",
    r"quadvel policy import .*|python -m benchmarks\.imported_walk .*": "test_imported.py has policies",
    r"pixi run .*": "needs pixi and the network",
    r"mkdir -p out/checkpoints .*": "takes a checkpoint out of the history",
    r"(mkdir -p|cp training/checkpoints).* out/go2/.*": "takes checkpoints to the folders of the runs that follow",
    r"(board|driver|controller|command_mux|ros__parameters):": "a part of a parameter file; test_yaml_examples.py loads it",
    r"(stick_velocity|max_tilt|max_velocity|max_velocity_trim|stamped|imu_mounting): .*": "the same",
    r"\[project\.entry-points\..*|magnetic_drag = .*": "a part of another package's pyproject.toml; tests/quadvel_sysid has one",
    r"(t|q|dq|tau|kp|q_des|t_cmd|q_des_cmd|joint_names): .*": "a part of a map file for --columns",
}


@cache
def examples() -> dict[str, str]:
    """Where each example stands first, by its text."""
    found: dict[str, str] = {}
    for document in sorted({path for pattern in DOCUMENTS for path in ROOT.glob(pattern)}):
        for line in _blocks(document.read_text(encoding="utf-8")):
            found.setdefault(_bare(line), str(document.relative_to(ROOT)))
    for name, text in _helps():
        for line in re.findall(r"^ {2,4}((?:quadvel|ros2|python) .*)", text, re.MULTILINE):
            found.setdefault(_bare(line), f"quadvel {name} --help")
    return found


def _blocks(text: str) -> Iterator[str]:
    """The lines of indented blocks, which follow an empty line, and of fenced ones; continued lines are joined.

    Left out are diagrams, and directives of the site: `make tutorials` runs its cells.
    """
    text = re.sub(r"^```(?:mermaid$|\{).*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r" *\\\n *", " ", text)
    inside = fenced = False
    before = ""
    for line in text.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced:
            yield line
        elif line.startswith("    ") and (inside or not before):
            inside = True
            yield line
        else:
            inside = False
        before = line.strip()


def _bare(line: str) -> str:
    """Without the comment or the explanation behind it, and with single blanks."""
    return " ".join(re.split(r" +# | {5,}", line.strip())[0].split())


def _helps() -> Iterator[tuple[str, str]]:
    for name in ("", *cli.command_names()):
        asked = [*name.split(), "--help"]
        yield name, CliRunner().invoke(cli.app, asked, env={"COLUMNS": "200"}).output


def test_every_example_runs_or_is_left_out_for_a_reason() -> None:
    run = {step.example for session in SESSIONS.values() for step in session}
    new = [
        f"{where}: {text}"
        for text, where in examples().items()
        if text not in run | LEFT_OUT.keys() and not any(re.fullmatch(kind, text) for kind in LEFT_OUT_KINDS)
    ]
    assert new == []
    assert [text for text in (*run, *LEFT_OUT) if text not in examples()] == [], (
        "no document has these any more"
    )


@pytest.fixture
def sandbox(tmp_path: Path) -> Path:
    """A folder with the files that the examples take for there."""
    shutil.copy(SHIPPED_POLICY, tmp_path / "my.onnx")
    mcap(tmp_path / "walk.mcap", fields(seconds=2.0))
    (tmp_path / "out" / "loop").mkdir(parents=True)
    for seed, name in enumerate(("walk_1", "walk_2", "suspended", "out/loop/walk")):
        np.savez(tmp_path / f"{name}.npz", **leg_log(seed, with_torque=name != "suspended"))
    return tmp_path


def leg_log(seed: int, with_torque: bool) -> dict[str, np.ndarray]:
    """A good second of one leg that swings under the actuator model, at 1 kHz."""
    rng = np.random.default_rng(seed)
    t, kp, kd, inertia = 1e-3 * np.arange(1200), 30.0, 0.5, 0.05
    phase, pace = rng.uniform(0.0, 2 * np.pi, 3), np.array([2.0, 3.1, 4.3])
    sent = 0.3 * np.sin(2 * np.pi * t[:, None] * pace + phase) + 0.1 * np.sin(
        2 * np.pi * 5.3 * t[:, None] * pace
    )
    drives = ActuatorModel(ActuatorParameters.of(ALIENGO), shape=(12,), seed=seed)
    q, dq, rows = sent[0].copy(), np.zeros(3), []
    for wanted in sent:
        padded = [np.concatenate([x, np.zeros(9)]) for x in (q, dq, wanted)]
        torque = drives.step(padded[0], padded[1], padded[2], kp, kd)[:3]
        rows.append((q.copy(), dq.copy(), torque))
        dq += 1e-3 * (torque - 0.05 * dq) / inertia
        q += 1e-3 * dq
    state = dict(zip(("q", "dq", "tau"), map(np.array, zip(*rows, strict=True)), strict=True))
    names = np.array(["FR_hip", "FR_thigh", "FR_calf"])
    log = {"t": t, "q_des": sent, "joint_names": names, "kp": np.array(kp), "kd": np.array(kd), **state}
    if not with_torque:
        del log["tau"]
    return log


@pytest.mark.parametrize(
    "name",
    [*USUAL, *(pytest.param(one, marks=pytest.mark.long) for one in SESSIONS if one not in USUAL)],
)
def test_the_examples_run(name: str, sandbox: Path) -> None:
    said: list[str] = []
    with ProcessGroup(lambda process, line: said.append(line)) as group:
        for step in SESSIONS[name]:
            words = shlex.split(step.example.rstrip(" &"))
            line = [*PROGRAMS[words[0]], *words[1:], *shlex.split(step.more)]
            if step.served:
                group.start(step.example, ["env", "-C", str(sandbox), *line])
                _wait_for(step, group, said)
            elif words[0] == "quadvel":
                assert set(group.ended().values()) <= {0}, (group.ended(), said[-5:])
                assert _run_here(line[len(PROGRAMS["quadvel"]) :], sandbox) == 0, step.example
            else:
                subprocess.run(line, cwd=sandbox, timeout=300, check=True)
        codes = group.stop()
    assert not any(codes.values()), f"{codes}: {said[-5:]}"


def _run_here(words: list[str], folder: Path) -> int:
    """Run a command of quadvel in this process, which has loaded most of it, and return its exit code."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    try:
        with contextlib.chdir(folder), pytest.raises(SystemExit) as ended:
            main(words)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    code = ended.value.code
    return code if isinstance(code, int) else 0 if code is None else 1


def _wait_for(step: Step, group: ProcessGroup, said: list[str]) -> None:
    if step.then == READY:
        wait_until_ready(lambda: "\n".join(said), lambda: not group.ended())
        return
    until = time.monotonic() + 120.0
    while step.then and not any(step.then in line for line in said):
        assert not group.ended(), f"{step.example}: {said[-5:]}"
        assert time.monotonic() < until, f"{step.example}: {said[-5:]}"
        time.sleep(0.1)
