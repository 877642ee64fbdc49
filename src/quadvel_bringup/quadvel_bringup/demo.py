"""`quadvel demo`: a scripted walk in real time, every node a process of its own, recorded and judged.

Here the run itself; what is made of the recording is `quadvel_eval`'s matter.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import quadvel_dds
from quadvel_eval import demo_figures, demo_summary
from quadvel_eval.recording import Recording, read_recording
from quadvel_eval.report import output_folder, replacing, segment_table, write_figure, write_json
from quadvel_eval.script import SCRIPTS

from .doctor import GL_PACKAGES, gl_backend
from .nodes import command
from .processes import ProcessGroup, StopSignals
from .stack import Stack

RECORDED = {
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/command": "quadvel_msgs/msg/VelocityCommand",
    "/controller/state": "quadvel_msgs/msg/ControllerState",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/ground_truth/odom": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/low_cmd": "quadvel_msgs/msg/LowCmd",
    "/low_state": "quadvel_msgs/msg/LowState",
    "/odom": "nav_msgs/msg/Odometry",
    "/planner/step": "std_msgs/msg/String",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/velocity_estimate": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
MADE_OF_IT = ("summary.json", "demo.png", "loop.png", "demo.mp4")
"""What is made of the recording; what is left of an earlier one goes."""
LOOK = 0.2  # s, between two looks whether all nodes still run


def demo_command(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/demo"),
    video: Annotated[bool, typer.Option("--video/--no-video", help="Draw a video where GL is there.")] = True,
    quick: Annotated[bool, typer.Option("--quick", help="A short walk: forward, and stop.")] = False,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Not in real time: simulated time waits for every node.")
    ] = False,
) -> None:
    """Walk a simulated robot through all directions, in real time, through the nodes.

    Simulator, estimator, controller, command mux and a scripted planner run as processes; what they say to
    each other is recorded. Exit code 0 if the robot went through the whole script without a fall.
    """
    folder, console = output_folder(out), Console(soft_wrap=True)
    recorded = folder / "demo.mcap"
    with replacing(recorded) as draft:
        problem = _Run(draft, "quick" if quick else "full", lockstep, console).walk()
    for name in MADE_OF_IT:
        (folder / name).unlink(missing_ok=True)
    if problem:
        console.print(f"[bold red]{problem}")
    try:
        recording = read_recording(recorded)
        summary = demo_summary.summarise(recording)
    except ValueError as error:
        raise ValueError(f"the walk can't be judged: {error}") from None
    write_json(folder / "summary.json", summary)
    _report(summary, console)
    _draw(recording, folder, video, console)
    written = [name for name in ("demo.mcap", *MADE_OF_IT) if (folder / name).exists()]
    console.print(f"written to {folder}: {', '.join(written)}")
    if summary["falls"]:
        console.print(f"[bold red]falls: {summary['falls']}")
    raise typer.Exit(1 if problem or summary["falls"] else 0)


class _Run:
    """The nodes, the recorder in this process, and a bar that shows how far the script is."""

    def __init__(self, recording: Path, script: str, lockstep: bool, console: Console) -> None:
        self._recording = recording
        self._script = script
        self._stack = Stack(use_sim_time=lockstep)
        self._steps = [step.name for step in SCRIPTS[script]]
        columns = (TextColumn("{task.description:24}"), BarColumn(), TimeElapsedColumn())
        self._bar = Progress(*columns, console=console)
        self._task = self._bar.add_task("start", total=len(self._steps))

    def walk(self) -> str:
        """Run the script to its end; what went wrong, or "". Ctrl-C ends it with a typer.Exit."""
        quadvel_dds.install()
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions
        from std_msgs.msg import String

        from .recorder import Recorder

        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        use_sim_time = Parameter("use_sim_time", value=self._stack.use_sim_time)
        node = rclpy.create_node("demo", parameter_overrides=[use_sim_time])
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            node.create_subscription(String, "planner/step", self._on_step, 10)
            with StopSignals() as signals, Recorder(node, self._recording) as recorder, self._bar:
                for topic, kind in RECORDED.items():
                    recorder.record(topic, kind)
                with ProcessGroup(self._say) as group:
                    self._start(group)
                    problem = self._wait(group, signals, lambda: recorder.serve(executor, LOOK))
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
        if signals.received:
            raise typer.Exit(128 + signals.received)
        return problem

    def _start(self, group: ProcessGroup) -> None:
        for name, arguments in self._stack.arguments().items():
            group.start(name, command(name, arguments))
        planner = {"script": self._script, "use_sim_time": str(self._stack.use_sim_time).lower()}
        arguments = [word for name, value in planner.items() for word in ("-p", f"{name}:={value}")]
        group.start("planner", command("planner", ["--ros-args", *arguments]))

    def _wait(self, group: ProcessGroup, signals: StopSignals, record: Callable[[], None]) -> str:
        """Record until one of the nodes ends: the planner, if all goes well."""
        ended: dict[str, int] = {}
        while not ended and not signals.received:
            record()
            ended = group.ended()
        if ended == {"planner": 0}:
            self._bar.update(self._task, completed=len(self._steps), description="done")
            return ""
        return ", ".join(f"{name} ended with exit code {code}" for name, code in ended.items())

    def _on_step(self, message: Any) -> None:
        self._bar.update(self._task, completed=self._steps.index(message.data), description=message.data)

    def _say(self, name: str, line: str) -> None:
        self._bar.console.print(f"{name} | {line}", markup=False, highlight=False)


def _report(summary: dict[str, Any], console: Console) -> None:
    console.print(segment_table(summary["segments"]))
    loop, rmse = summary["loop"], ", ".join(f"{x:.3f}" for x in summary["estimator"]["rmse"])
    console.print(
        f"error_xy mean {summary['mean_error_xy']:.3f}, largest {summary['max_error_xy']:.3f} m/s; "
        f"falls {summary['falls']}; estimator RMSE {rmse} m/s\n"
        f"loop {loop['rate_hz']:.0f} Hz, period p99 {loop['period_p99_ms']:.2f} ms, compute p50 "
        f"{loop['compute_p50_us']:.0f}, p99 {loop['compute_p99_us']:.0f} us, inference p50 "
        f"{loop['inference_p50_us']:.0f} us, overruns {loop['overruns']}; "
        f"real-time factor {summary['realtime_factor']:.3f}",
        highlight=False,
    )


def _draw(recording: Recording, folder: Path, video: bool, console: Console) -> None:
    """Plots always; a strip of frames above them and a video where GL is there."""
    write_figure(folder / "loop.png", demo_figures.loop_figure(recording))
    write_figure(folder / "demo.png", demo_figures.tracking_figure(recording))
    if not video:
        return
    backend = gl_backend()
    if backend is None:
        console.print(f"no video: there is no off-screen GL on this machine; sudo apt install {GL_PACKAGES}")
        return
    with console.status("drawing the video"):
        drawing = subprocess.run(
            [sys.executable, "-m", "quadvel_eval.video", folder / "demo.mcap", folder],
            env={**os.environ, "MUJOCO_GL": backend},
            capture_output=True,
            text=True,
        )
    if drawing.returncode:
        reason = (drawing.stderr.strip() or f"exit code {drawing.returncode}").splitlines()[-1]
        console.print(f"no video: {reason}", markup=False)
