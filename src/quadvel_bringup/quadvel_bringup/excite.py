"""`quadvel excite`: moves the joints so that they show what they are, and records state and command.

The motions are `quadvel_sysid.excitation`'s; here they are played on a robot that serves low_state and
low_cmd. The simulated one runs in lockstep at 1 kHz, so that a busy machine leaves no gaps.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import quadvel_dds
from quadvel_description import robot
from quadvel_description.kinematics import roll_pitch
from quadvel_description.state import JointCommand, RobotState
from quadvel_eval.output import output_file, replacing
from quadvel_eval.report import read_json
from quadvel_nodes.messages import MessageError, read_low_state, write_low_cmd
from quadvel_sysid.excitation import EXCITATIONS, PERIOD_S, Excitation, limit_torque, propose

from .exclusivity import ensure_alone
from .node_output import PrefixedOutput
from .nodes import Parameters, arguments, command, enclave
from .preflight import rehearse_node
from .processes import ProcessGroup, StopSignals
from .stack import PARAMETERS

RAMP = 1.5  # s, from where the robot is to where the motion begins
REST = 0.5  # s of damping at the end
LOOK = 0.05  # s, from one look at recorder and processes to the next
MAX_TILT = 0.8  # rad
JOINT_MARGIN = 0.1  # rad, that a joint may pass its mechanical range by
PATIENCE = 20.0  # s, for the first state
MAX_SILENCE = 5.0  # s, without a state
MAX_GAP = 0.05  # s, between two states: after a longer one the motion would jump
ANSWER_TIMEOUT = 2.0  # s, after which the simulator asks again
RECORDED = {"/low_state": "quadvel_msgs/msg/LowState", "/low_cmd": "quadvel_msgs/msg/LowCmd"}


class MotionError(RuntimeError):
    """Why a motion was ended, in one sentence."""


class Player:
    """Answers states with the commands of one motion; time is the states' own."""

    def __init__(
        self,
        excitation: Excitation,
        kp: float | None = None,
        kd: float | None = None,
        hung: bool | None = None,
    ) -> None:
        """kp (N m/rad), kd (N m s/rad), hung: whether the feet are in the air; the motion's own where None."""
        self._targets = excitation.targets()
        self._kp = excitation.kp if kp is None else kp
        self._kd = excitation.kd if kd is None else kd
        in_the_air = excitation.hung if hung is None else hung
        self._support = np.zeros_like(self._targets) if in_the_air else excitation.support_torque()
        self._begin: RobotState | None = None
        self._last = 0.0
        self.total = RAMP + excitation.seconds
        """s, of ramp and motion"""
        self.elapsed = 0.0
        """s, of these"""

    @property
    def done(self) -> bool:
        """Whether the motion is at its end."""
        return self.elapsed >= self.total

    def answer(self, state: RobotState) -> JointCommand:
        """The command at `state`; damping once the motion is done. Raises MotionError."""
        _check(state)
        if self._begin is None:
            self._begin, self._last = state, state.time
        gap, self._last = state.time - self._last, state.time
        if not 0.0 <= gap <= MAX_GAP:
            raise MotionError(
                f"from one state to the next time went by {gap:.3f} s, expected 0 to {MAX_GAP} s"
            )
        self.elapsed = state.time - self._begin.time
        if self.done:
            return JointCommand.damping(tick=state.tick)
        target, tau = self._wanted(self._begin.q)
        target = limit_torque(target, state.q, state.dq, self._kp, self._kd, tau)
        return JointCommand(
            q=target, tau=tau, kp=np.full(12, self._kp), kd=np.full(12, self._kd), tick=state.tick
        )

    def _wanted(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint targets (12,) rad and feed-forward torque (12,) N m of this instant."""
        if self.elapsed < RAMP:
            s = self.elapsed / RAMP
            share = s * s * (3.0 - 2.0 * s)
            return start + share * (self._targets[0] - start), share * self._support[0]
        row = min(int((self.elapsed - RAMP) / PERIOD_S + 0.5), len(self._targets) - 1)
        return self._targets[row], self._support[row]


def _check(state: RobotState) -> None:
    """Raises MotionError where the robot is no longer where these motions are made for."""
    tilt = np.abs(roll_pitch(state.quaternion)).max()
    if tilt > MAX_TILT:
        raise MotionError(f"the trunk tilts by {tilt:.2f} rad, expected at most {MAX_TILT}")
    beyond = np.maximum(robot.LOWER - state.q, state.q - robot.UPPER)
    if beyond.max() > JOINT_MARGIN:
        joint = robot.JOINT_NAMES[int(beyond.argmax())]
        raise MotionError(f"{joint} is {beyond.max():.2f} rad beyond its range")


def excite_command(
    motion: Annotated[
        str | None, typer.Argument(help=f"One of {', '.join(EXCITATIONS)}.", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.5, help="For how long.", show_default="the motion's own")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="The file to write.", show_default="out/excite/MOTION.mcap"),
    ] = None,
    low_level: Annotated[
        Literal["sim", "external"],
        typer.Option(help="What serves low_state and low_cmd; external: a robot that is there."),
    ] = "sim",
    hung: Annotated[
        bool | None,
        typer.Option("--hung/--ground", help="Are the feet in the air?", show_default="as the motion wants"),
    ] = None,
    kp: Annotated[
        float | None,
        typer.Option(
            min=1.0, max=500.0, help="Gain of the joints' angles, N m/rad.", show_default="the motion's own"
        ),
    ] = None,
    kd: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=20.0, help="Gain of their speeds, N m s/rad.", show_default="the motion's own"
        ),
    ] = None,
    actuator: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="Simulated robot: its actuator.yaml.", show_default="the shipped one"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Simulated robot: of its noise.")] = 0,
    after: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="A report.json: say which motions would settle what it left open."
        ),
    ] = None,
) -> None:
    """Move the joints so that they show what they are; record state and command for `quadvel identify`.

    \b
    foot-lifting  the paper's motion, Eq. 9      sweep  foot lifting, rate and height vary
    chirp         fast swings in the air         steps  steps of all sizes in the air
    creep         slow motion in the air         solo   one joint at a time in the air

    On the ground the legs are as stiff as this robot stands up with (--kp 150 --kd 4) and carry its weight by
    feed-forward torque: with the policy's gains (--kp 30 --kd 0.5), which the motions in the air take, it tips over.
    Gains and torque are in the recording.

    \b
    For example:
      quadvel excite foot-lifting --out lift.mcap
      quadvel excite --after out/identify/report.json

    On a robot (--low-level external) let nothing else send low_cmd, and hang it for the motions in the air.
    """
    console = Console(soft_wrap=True)
    if after is not None:
        _propose(after, console)
        return
    if motion not in EXCITATIONS:
        raise ValueError(f"motion is {motion!r}, expected one of {', '.join(EXCITATIONS)}")
    excitation = EXCITATIONS[motion]() if seconds is None else EXCITATIONS[motion](seconds=seconds)
    path = out or Path("out/excite") / f"{motion}.mcap"
    if path.exists():
        raise FileExistsError(f"{path} exists already; name another file with --out")
    output_file(path)
    in_the_air = excitation.hung if hung is None else hung
    parameters: dict[str, Any] = {"hung": in_the_air, "seed": seed}
    if actuator is not None:
        parameters["actuator_file"] = str(actuator.resolve())
    nodes = {}
    if low_level == "sim":
        rehearse_node("sim_node", sim_arguments(**parameters))
        nodes["sim_node"] = command("sim_node", sim_arguments(**parameters))
    try:
        record_motion(Player(excitation, kp, kd, in_the_air), path, nodes, console)
    except MotionError as error:
        console.print(f"[bold red]{error}")
        raise typer.Exit(1) from None


def _propose(report: Path, console: Console) -> None:
    try:
        proposals = propose(read_json(report))
    except (KeyError, TypeError) as error:
        raise ValueError(f"{report}: no report of `quadvel identify`: {error!r}") from None
    if not proposals:
        console.print("The report leaves nothing open that another motion would settle.")
    for one in proposals:
        console.print(f"{one.command}\n  for {', '.join(one.separates)}: {one.reason}", highlight=False)


def sim_arguments(**parameters: Any) -> list[str]:
    """Arguments of a simulator that stands, in lockstep, at 1 kHz."""
    lockstep: Parameters = {
        "mode": "lockstep",
        "state_rate": 1000,
        "keyframe": "stand",
        "answer_timeout": ANSWER_TIMEOUT,
    }
    return arguments("sim_node", {**lockstep, **parameters}, PARAMETERS)


def record_motion(player: Player, path: Path, nodes: Mapping[str, Sequence[str]], console: Console) -> None:
    """Play the motion on the robot that `nodes` (name: command line) make, or that is there where they are none.

    Writes state and command to `path`, which comes to be only where the motion went through. Raises MotionError
    where it did not; Ctrl-C ends it with a typer.Exit.
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
        if nodes:
            ensure_alone(node)
        with (
            StopSignals() as signals,
            bar,
            replacing(path) as draft,
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
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=left)


class _Session:
    """A player on the topics of a robot, and a recorder beside it."""

    def __init__(self, node: Any, recorder_node: Any, player: Player, simulated: bool) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        from quadvel_msgs.msg import LowCmd, LowState

        self._node, self._recorder_node = node, recorder_node
        self._player, self._simulated = player, simulated
        self._message = LowCmd
        self._started = time.monotonic()
        self._heard: float | None = None  # when the last state came, s
        self._counts: Counter[str] = Counter()
        self._failure: MotionError | None = None
        self._resting, self._tick = False, 0
        self._publisher = node.create_publisher(LowCmd, "low_cmd", 1)
        # In lockstep no state may be lost; a robot's driver may send them as best it can.
        reliability = ReliabilityPolicy.RELIABLE if simulated else ReliabilityPolicy.BEST_EFFORT
        newest = QoSProfile(depth=1, reliability=reliability)
        node.create_subscription(LowState, "low_state", self._on_state, newest)

    def run(self, draft: Path, group: ProcessGroup, signals: StopSignals, bar: Progress) -> None:
        """Play to the end and record it in `draft`; then, whatever ended it, let a real robot sink to rest."""
        from rclpy.executors import SingleThreadedExecutor

        from .recorder import Recorder
        from .recording_file import RecordingFile

        task = bar.add_task("", total=self._player.total)
        playing, recording = SingleThreadedExecutor(), SingleThreadedExecutor()  # neither waits for the other
        playing.add_node(self._node)
        recording.add_node(self._recorder_node)
        try:
            with Recorder(self._recorder_node, RecordingFile(draft)) as recorder:
                for topic, kind in RECORDED.items():
                    recorder.record(topic, kind)
                while not self._player.done:
                    _spin(playing, LOOK)
                    recorder.write_waiting(recording)
                    bar.update(task, completed=min(self._player.elapsed, self._player.total))
                    self._look(group, signals)
                time.sleep(LOOK)  # what was sent last is under way
                recorder.write_waiting(recording)
            self._counts = recorder.counts
        finally:
            if not self._simulated:
                self._rest(playing)

    def _rest(self, playing: Any) -> None:
        """Damping, at once and as the answer to all that comes."""
        self._resting = True
        if self._heard is not None:
            self._send(JointCommand.damping(tick=self._tick), self._node.get_clock().now().to_msg())
        _spin(playing, REST)

    def summary(self) -> str:
        """What was recorded."""
        return ", ".join(f"{count} on {topic}" for topic, count in self._counts.items())

    def _look(self, group: ProcessGroup, signals: StopSignals) -> None:
        """Raises what ends the motion early."""
        if signals.received:
            raise typer.Exit(128 + signals.received)
        if self._failure:
            raise self._failure
        if ended := group.ended():
            raise MotionError(
                ", ".join(f"{name} ended with exit code {code}" for name, code in ended.items())
            )
        patience = PATIENCE if self._heard is None else MAX_SILENCE
        since = self._started if self._heard is None else self._heard
        if time.monotonic() - since > patience:
            raise MotionError(f"nothing came on low_state for {patience:g} s")

    def _on_state(self, message: Any) -> None:
        self._heard, self._tick = time.monotonic(), message.tick
        answer = self._answer(message)
        if self._simulated and (self._failure or self._player.done):
            return
        self._send(answer, message.stamp if self._simulated else self._node.get_clock().now().to_msg())

    def _answer(self, message: Any) -> JointCommand:
        """The player's answer; damping once something went wrong, or the end has come."""
        if not (self._failure or self._resting):
            try:
                if self._player.elapsed == 0.0 and self._node.count_publishers("low_cmd") > 1:
                    raise MotionError("somebody else sends low_cmd too; stop the controller first")
                return self._player.answer(read_low_state(message))
            except (MessageError, MotionError) as error:
                self._failure = MotionError(str(error))
        return JointCommand.damping(tick=message.tick)

    def _send(self, answer: JointCommand, stamp: Any) -> None:
        command = self._message(stamp=stamp)
        write_low_cmd(answer, command)
        self._publisher.publish(command)
