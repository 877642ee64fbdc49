"""`quadvel excite`: excitation motions for the identification of the joints.

States and commands are recorded. `quadvel_sysid.excitation` defines the motions; here they are
played on any robot that serves low_state and low_cmd. The simulated robot runs in lockstep at 1
kHz, so that a busy machine causes no gaps.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import quadvel_dds
from quadvel_bringup.exclusivity import domain_claimed
from quadvel_bringup.node_output import PrefixedOutput
from quadvel_bringup.nodes import Parameters, enclave, process_command, ros_arguments
from quadvel_bringup.preflight import check_node
from quadvel_bringup.processes import ProcessGroup, StopSignals
from quadvel_bringup.stack import PARAMETERS, absolute_file
from quadvel_description.kinematics import roll_pitch
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot, load_robot
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_description.state import JointCommand, RobotState
from quadvel_eval.report import read_json
from quadvel_nodes.messages import MessageError, read_low_state, write_low_cmd
from quadvel_recordings.output import atomic_write, output_recording
from quadvel_recordings.reading import DESCRIPTION_TOPIC
from quadvel_sysid.excitation import EXCITATIONS, PERIOD_S, Excitation, Proposal, limit_torque, propose

RAMP_S = 1.5
"""Time from the initial posture to the start of the motion."""
REST_S = 0.5
"""Time of damping at the end."""
POLL_PERIOD_S = 0.05
"""Time between two checks of recorder and processes."""
MAX_TILT_RAD = 0.8
"""Largest tilt of the trunk."""
JOINT_MARGIN_RAD = 0.1
"""Largest angle beyond the mechanical range of a joint."""
FIRST_STATE_TIMEOUT_S = 20.0
"""Time to wait for the first state."""
STATE_TIMEOUT_S = 5.0
"""Longest time without a state."""
MAX_STATE_GAP_S = 0.05
"""Longest time between two states; after a longer one the motion would jump."""
ANSWER_TIMEOUT_S = 2.0
"""Time after which the simulator repeats a state."""
ROBOT_HINT = "start the robot first: its driver, or quadvel run board and quadvel run driver"
"""Advice if no robot serves low_state."""
RECORDED_TOPICS = {
    "/low_state": "quadvel_msgs/msg/LowState",
    "/low_cmd": "quadvel_msgs/msg/LowCmd",
    DESCRIPTION_TOPIC: "std_msgs/msg/String",
}


DESCRIPTION_TIMEOUT_S = 1.0  # s
"""A running robot that sends no `robot_description` for so long after its first state counts as the chosen one."""


class MotionError(RuntimeError):
    """A motion was aborted; one sentence with the reason."""


class MotionPlayer:
    """Answers states with the commands of a motion. Time is that of the states.

    Args:
        excitation: The motion.
        kp: Position gain, N m/rad; None for that of the motion.
        kd: Velocity gain, N m s/rad; None for that of the motion.
        suspended: Whether the feet are in the air; None for the choice of the motion.

    Attributes:
        robot: The robot of the motion.
        total: Duration of ramp and motion, s.
        elapsed: Time since the first state, s.
    """

    def __init__(
        self,
        excitation: Excitation,
        kp: float | None = None,
        kd: float | None = None,
        suspended: bool | None = None,
    ) -> None:

        self.robot = excitation.robot
        self._targets = excitation.targets()
        self._kp = excitation.kp if kp is None else kp
        self._kd = excitation.kd if kd is None else kd
        in_the_air = excitation.suspended if suspended is None else suspended
        self._support = np.zeros_like(self._targets) if in_the_air else excitation.support_torque()
        self._begin: RobotState | None = None
        self._last = 0.0
        self.total = RAMP_S + excitation.seconds

        self.elapsed = 0.0

    @property
    def is_done(self) -> bool:
        """Whether the motion is complete."""
        return self.elapsed >= self.total

    def answer(self, state: RobotState) -> JointCommand:
        """Return the command for a state; damping after the end of the motion.

        Args:
            state: The state.

        Returns:
            The command.

        Raises:
            MotionError: The robot left the range of the motion, or states are missing.
        """
        _check(self.robot, state)
        if self._begin is None:
            self._begin, self._last = state, state.time
        gap, self._last = state.time - self._last, state.time
        if not 0.0 <= gap <= MAX_STATE_GAP_S:
            raise MotionError(
                f"the time between two states is {gap:.3f} s, expected 0 to {MAX_STATE_GAP_S} s: "
                "robot, link or this computer was late; repeat it when the computer is idle"
            )
        self.elapsed = state.time - self._begin.time
        if self.is_done:
            return JointCommand.damping(tick=state.tick)
        target, tau = self._current_targets(self._begin.q)
        target = limit_torque(self.robot, target, state.q, state.dq, self._kp, self._kd, tau)
        return JointCommand(
            q=target, tau=tau, kp=np.full(12, self._kp), kd=np.full(12, self._kd), tick=state.tick
        )

    def _current_targets(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return joint targets (12,) rad and feed-forward torque (12,) N m at the present time."""
        if self.elapsed < RAMP_S:
            # Smoothstep from the initial posture: 3 s^2 - 2 s^3.
            s = self.elapsed / RAMP_S
            share = s * s * (3.0 - 2.0 * s)
            return start + share * (self._targets[0] - start), share * self._support[0]
        row = min(int((self.elapsed - RAMP_S) / PERIOD_S + 0.5), len(self._targets) - 1)
        return self._targets[row], self._support[row]


def _check(robot: Robot, state: RobotState) -> None:
    """Raise MotionError if tilt or joint angles leave the range of the motions."""
    tilt = np.abs(roll_pitch(state.quaternion)).max()
    if tilt > MAX_TILT_RAD:
        raise MotionError(f"the trunk tilts by {tilt:.3f} rad, expected at most {MAX_TILT_RAD}")
    beyond = np.maximum(robot.lower - state.q, state.q - robot.upper)
    if beyond.max() > JOINT_MARGIN_RAD:
        joint = JOINT_NAMES[int(beyond.argmax())]
        raise MotionError(f"{joint} is {beyond.max():.2f} rad beyond its range")


def excite_command(
    motion: Annotated[
        str | None, typer.Argument(help=f"One of {', '.join(EXCITATIONS)}.", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.5, help=f"Duration, s, after a ramp of {RAMP_S:g} s.", show_default="by the motion"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="The file to write.", show_default="out/excite/MOTION.mcap"),
    ] = None,
    low_level: Annotated[
        Literal["sim", "external"],
        typer.Option(help="What serves low_state and low_cmd; external: a running robot."),
    ] = "sim",
    robot: Annotated[
        str,
        typer.Option(metavar="<name|file>", help="The robot: aliengo, go2, or a robot.yaml or its folder."),
    ] = DEFAULT_ROBOT,
    suspended: Annotated[
        bool | None,
        typer.Option(
            "--suspended/--ground",
            "--hung",
            help="Feet in the air, or on the ground.",
            show_default="by the motion",
        ),
    ] = None,
    kp: Annotated[
        float | None,
        typer.Option(
            min=1.0, max=500.0, help="Position gain of the joints, N m/rad.", show_default="by the motion"
        ),
    ] = None,
    kd: Annotated[
        float | None,
        typer.Option(min=0.0, max=20.0, help="Velocity gain, N m s/rad.", show_default="by the motion"),
    ] = None,
    actuator: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="Simulated robot: its actuator.yaml.", show_default="the shipped one"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Simulated robot: seed of its noise.")] = 0,
    after: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="A report.json: propose motions that resolve its ambiguities."),
    ] = None,
) -> None:
    """Run an excitation motion; record states and commands for `quadvel identify`.

    \b
    foot-lifting  the paper's motion, Eq. 9      sweep  foot lifting, rate and height vary
    chirp         fast swings in the air         steps  steps of all sizes in the air
    creep         slow motion in the air         solo   one joint at a time in the air

    Motions on the ground use the gains of standing up (--kp 150 --kd 4) and feed-forward torque for
    the weight, because the robot tips over with those of the policy. Motions in the air use the
    policy's (--kp 30 --kd 0.5). The recording contains gains and torque.

    \b
    For example:
      quadvel excite foot-lifting --out lift.mcap
      quadvel excite --after out/identify/report.json

    On a real robot (--low-level external) let nothing else send low_cmd. For the motions in the
    air, suspend it.
    """
    console = Console(markup=False, soft_wrap=True)
    if after is not None:
        proposals = _read_proposals(after, "" if robot == DEFAULT_ROBOT else robot)
        if motion is not None:
            raise ValueError(
                f"found the motion {motion} and --after, which proposes motions: expected one of both"
            )
        _print_proposals(proposals, console)
        return
    if motion not in EXCITATIONS:
        found = "no motion given" if motion is None else f"motion is '{motion}'"
        raise ValueError(f"{found}, expected one of {', '.join(EXCITATIONS)}")
    simulated = {"--actuator": actuator is not None, "--seed": seed != 0}
    if low_level != "sim" and any(simulated.values()):
        named = ", ".join(name for name, is_given in simulated.items() if is_given)
        raise ValueError(f"{named}: only a simulated robot has this, not --low-level {low_level}")
    chosen = load_robot(robot)
    excitation = EXCITATIONS[motion](chosen, **({} if seconds is None else {"seconds": seconds}))
    path = out or Path("out/excite") / f"{motion}.mcap"
    output_recording(path)
    in_the_air = excitation.suspended if suspended is None else suspended
    parameters: dict[str, Any] = {"robot": absolute_file(robot), "hung": in_the_air, "seed": seed}
    if actuator is not None:
        parameters["actuator_file"] = str(actuator.resolve())
    nodes = {}
    if low_level == "sim":
        check_node("sim_node", sim_arguments(**parameters))
        nodes["sim_node"] = process_command("sim_node", sim_arguments(**parameters))
    try:
        record_motion(MotionPlayer(excitation, kp, kd, in_the_air), path, nodes, console)
    except MotionError as error:
        console.print(str(error), style="bold red")
        raise typer.Exit(1) from None


def _read_proposals(report: Path, robot: str) -> Sequence[Proposal]:
    """Return the motions that would resolve the ambiguities of a report; `robot`: "" for the report's."""
    try:
        return propose(read_json(report), robot)
    except (KeyError, TypeError) as error:
        missing = f"the field {error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{report}: {missing}; expected the report.json of `quadvel identify`") from None


def _print_proposals(proposals: Sequence[Proposal], console: Console) -> None:
    """Print motions, and why they help."""
    if not proposals:
        console.print("The report has no ambiguity that another motion would resolve.")
    for one in proposals:
        console.print(f"{one.command}\n  for {', '.join(one.separates)}: {one.reason}", highlight=False)


def sim_arguments(**parameters: Any) -> list[str]:
    """Return the arguments of a simulator in lockstep at 1 kHz with a standing robot.

    Args:
        parameters: Further parameters of the node.

    Returns:
        Arguments of ROS 2.
    """
    lockstep: Parameters = {
        "mode": "lockstep",
        "state_rate": 1000,
        "keyframe": "stand",
        "answer_timeout": ANSWER_TIMEOUT_S,
    }
    return ros_arguments("sim_node", {**lockstep, **parameters}, PARAMETERS)


def record_motion(
    player: MotionPlayer, path: Path, nodes: Mapping[str, Sequence[str]], console: Console
) -> None:
    """Play and record a motion. The file is written only if the motion is completed.

    Args:
        player: The motion.
        path: The MCAP file to write.
        nodes: Command lines by name of the nodes to start; empty for a running robot.
        console: Console for output and bar.

        Errors pass through: MotionError for an aborted motion, NotRunningError without a robot,
        typer.Exit after a signal.
    """
    quadvel_dds.install()
    import rclpy
    from rclpy.parameter import Parameter
    from rclpy.signals import SignalHandlerOptions

    columns = (TextColumn("{task.completed:5.1f} of {task.total:.1f} s"), BarColumn(), TimeElapsedColumn())
    bar = Progress(*columns, console=console)

    rclpy.init(args=["--ros-args", *enclave("excite")], signal_handler_options=SignalHandlerOptions.NO)
    clock = [Parameter("use_sim_time", value=bool(nodes))]
    node, recorder = (rclpy.create_node(name, parameter_overrides=clock) for name in ("excite", "recorder"))
    try:
        with (
            domain_claimed(node) if nodes else nullcontext(),
            StopSignals() as signals,
            bar,
            atomic_write(path) as draft,
            ProcessGroup(PrefixedOutput(nodes, console)) as group,
        ):
            for name, line in nodes.items():
                group.start(name, line)
            session = _Session(node, recorder, player, simulated=bool(nodes))
            session.run(draft, group, signals, bar)
    finally:
        node.destroy_node()
        recorder.destroy_node()
        rclpy.try_shutdown()
    console.print(f"written to {path}: {session.summary()}", highlight=False)


def _spin(executor: Any, seconds: float) -> None:
    """Spin an executor for a duration, s."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=left)


class _Session:
    """A motion player on the topics of a robot, with a recorder."""

    def __init__(self, node: Any, recorder_node: Any, player: MotionPlayer, simulated: bool) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from std_msgs.msg import String

        from quadvel_msgs.msg import LowCmd, LowState
        from quadvel_nodes.robot_view import LATCHED

        self._node, self._recorder_node = node, recorder_node
        self._player, self._simulated = player, simulated
        self._message = LowCmd
        self._started = time.monotonic()
        self._heard: float | None = None  # time of the last state, s
        self._counts: Counter[str] = Counter()
        self._failure: MotionError | None = None
        self._resting, self._tick, self._has_sent = False, 0, False
        self._is_described = simulated  # a running robot says which one it is, or is silent about it
        self._first_heard = float("inf")  # time of the first state, s
        self._publisher = node.create_publisher(LowCmd, "low_cmd", 1)
        # Lockstep must not lose a state; drivers may send states best-effort.
        reliability = ReliabilityPolicy.RELIABLE if simulated else ReliabilityPolicy.BEST_EFFORT
        newest = QoSProfile(depth=1, reliability=reliability)
        node.create_subscription(LowState, "low_state", self._on_state, newest)
        node.create_subscription(String, "robot_description", self._on_description, LATCHED)

    def run(self, draft: Path, group: ProcessGroup, signals: StopSignals, bar: Progress) -> None:
        """Play and record the motion; in any case end with damping on a real robot.

        Args:
            draft: The file to write.
            group: Processes to monitor.
            signals: Ends the motion on Ctrl-C.
            bar: Progress bar.
        """
        from rclpy.executors import SingleThreadedExecutor

        from quadvel_bringup.recorder import Recorder
        from quadvel_bringup.recording_file import RecordingFile

        task = bar.add_task("", total=self._player.total)
        playing, recording = (
            SingleThreadedExecutor(),
            SingleThreadedExecutor(),
        )  # so that neither blocks the other
        playing.add_node(self._node)
        recording.add_node(self._recorder_node)
        try:
            with Recorder(self._recorder_node, RecordingFile(draft)) as recorder:
                for topic, kind in RECORDED_TOPICS.items():
                    recorder.record(topic, kind)
                while not self._player.is_done:
                    _spin(playing, POLL_PERIOD_S)
                    recorder.write_waiting(recording)
                    bar.update(task, completed=min(self._player.elapsed, self._player.total))
                    self._check_running(group, signals)
                time.sleep(POLL_PERIOD_S)  # the last messages are in transit
                recorder.write_waiting(recording)
            self._counts = recorder.counts
        finally:
            if not self._simulated:
                self._rest(playing)

    def _rest(self, playing: Any) -> None:
        """Damp the joints that were moved, at once and as the answer to all further states."""
        self._resting = True
        if self._has_sent:
            self._send(JointCommand.damping(tick=self._tick), self._node.get_clock().now().to_msg())
        _spin(playing, REST_S)

    def summary(self) -> str:
        """Summarise the recorded messages.

        Returns:
            Counts by topic.
        """
        return ", ".join(f"{count} on {topic}" for topic, count in self._counts.items())

    def _check_running(self, group: ProcessGroup, signals: StopSignals) -> None:
        """Raise the error or the exit that ends the motion early."""
        from quadvel_bringup.session import not_running

        if signals.received:
            raise typer.Exit(128 + signals.received)
        if self._failure:
            raise self._failure
        if ended := group.ended():
            raise MotionError(
                ", ".join(f"{name} ended with exit code {code}" for name, code in ended.items())
            )
        now = time.monotonic()
        if self._heard is None and now - self._started > FIRST_STATE_TIMEOUT_S:
            raise not_running(
                self._node, f"low_state: no message for {FIRST_STATE_TIMEOUT_S:g} s; {ROBOT_HINT}"
            )
        if self._heard is not None and now - self._heard > STATE_TIMEOUT_S:
            raise MotionError(f"no message on low_state for {STATE_TIMEOUT_S:g} s")

    def _on_description(self, message: Any) -> None:
        """Refuse the robot of another motion: its lengths, postures and limits are others."""
        from quadvel_nodes.robot_check import other_robot

        self._is_described = True
        if found := other_robot(message, self._player.robot):
            self._failure = MotionError(
                f"robot_description is that of {found!r}, expected {self._player.robot.name!r}: play its own "
                f"motion with --robot {found}"
            )

    def _on_state(self, message: Any) -> None:
        """Answer a state, once it is known which robot this is."""
        self._heard, self._tick = time.monotonic(), message.tick
        self._first_heard = min(self._first_heard, self._heard)
        if not self._is_described and self._heard < self._first_heard + DESCRIPTION_TIMEOUT_S:
            return
        answer = self._answer(message)
        if (self._failure or self._resting) and (self._simulated or not self._has_sent):
            return
        if self._simulated and self._player.is_done:
            return
        self._send(answer, message.stamp if self._simulated else self._node.get_clock().now().to_msg())

    def _answer(self, message: Any) -> JointCommand:
        """Return the player's command, or damping after a failure or the end."""
        if not (self._failure or self._resting):
            try:
                if self._player.elapsed == 0.0 and self._node.count_publishers("low_cmd") > 1:
                    raise MotionError("another node sends low_cmd; stop the controller first")
                return self._player.answer(read_low_state(message))
            except (MessageError, MotionError) as error:
                self._failure = MotionError(str(error))
        return JointCommand.damping(tick=message.tick)

    def _send(self, answer: JointCommand, stamp: Any) -> None:
        """Publish a command."""
        command = self._message(stamp=stamp)
        write_low_cmd(answer, command)
        self._publisher.publish(command)
        self._has_sent = True
