"""`quadvel demo`: a scripted walk in real time, one process per node, recorded and evaluated.

This module runs the demo; `quadvel_eval` evaluates the recording.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from quadvel_bringup.doctor import GL_PACKAGES, gl_backend, video_encoder
from quadvel_bringup.preflight import check_stack
from quadvel_bringup.stack import Stack
from quadvel_description.robot_name import DEFAULT_ROBOT
from quadvel_eval import demo_figures, demo_summary
from quadvel_eval.following.tour import TourSetup
from quadvel_eval.following.tour_cli import run_tour
from quadvel_eval.recording import Recording, read_recording
from quadvel_eval.report import segment_table, write_figure, write_json
from quadvel_nodes.number_text import number_text
from quadvel_recordings.output import atomic_write, output_folder
from quadvel_sim.world import SHIPPED_WORLDS

from .follow_demo import follow
from .recorded_run import LOCKSTEP_HINT
from .scripted_walk import ScriptedWalk

WALK, FOLLOW, TOUR = "quadvel demo walk", "quadvel demo follow", "quadvel demo follow --tour"
OPTION_SCOPES = {
    **dict.fromkeys(("quick", "low_level", "loss", "jitter", "actuator", "video"), (WALK,)),
    **dict.fromkeys(("world", "tour"), (FOLLOW, TOUR)),
    **dict.fromkeys(("metres", "seed"), (TOUR,)),
    "seconds": (FOLLOW,),
    **dict.fromkeys(("lockstep", "view"), (WALK, FOLLOW)),
}
"""Options that not every kind of demo has, and the kinds that have them."""
DERIVED_FILES = ("summary.json", "demo.png", "loop.png", "demo.mp4")
"""Files made from the recording; those of an earlier run are deleted."""


def demo_command(
    context: typer.Context,
    what: Annotated[
        Literal["walk", "follow"],
        typer.Argument(help="A walk in all directions, or following a person through a world."),
    ] = "walk",
    robot: Annotated[
        str,
        typer.Option(metavar="<name|file>", help="The robot: aliengo, go2, or a robot.yaml or its folder."),
    ] = DEFAULT_ROBOT,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="<folder>", help="Folder for the results.", show_default="out/demo, out/follow, out/tour"
        ),
    ] = None,
    video: Annotated[
        bool, typer.Option("--video/--no-video", help="With walk: render a video if GL is available.")
    ] = True,
    quick: Annotated[bool, typer.Option("--quick", help="With walk: a short one, forward and stop.")] = False,
    low_level: Annotated[
        Literal["sim", "board"],
        typer.Option(
            help="The robot: simulated, or simulated behind the interface of its board and its driver."
        ),
    ] = "sim",
    loss: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="With board: share of lost packets, each way.")
    ] = 0.0,
    jitter: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="With board: largest delay of a packet, ms, each way.")
    ] = 0.0,
    actuator: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="The robot's actuator.yaml.", show_default="the shipped one"),
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Simulated time waits for the controller: not real time.")
    ] = False,
    view: Annotated[bool, typer.Option("--view", help="Serve the operator page in the browser.")] = False,
    world: Annotated[
        str,
        typer.Option(
            metavar="<name|file>", help=f"With follow: world, {', '.join(SHIPPED_WORLDS)} or a YAML file."
        ),
    ] = "campus",
    seconds: Annotated[float, typer.Option(min=5.0, help="With follow: duration, s.")] = 180.0,
    tour: Annotated[
        bool,
        typer.Option("--tour", help="With follow: a tour in one process, faster than real time."),
    ] = False,
    metres: Annotated[float, typer.Option(min=1.0, help="With --tour: distance, m.")] = 3100.0,
    seed: Annotated[int, typer.Option(min=0, help="With --tour: seed of the sensor noise.")] = 0,
) -> None:
    """Run a scripted walk in all directions, or follow a person, in simulation and in real time.

    Simulator, estimator, controller, command mux and a scripted planner run as processes, and their
    topics are recorded. Exit code 0 if the robot completed the script without a fall.

    \b
    For example:
      quadvel demo
    """
    _check_options(context, WALK if what == "walk" else TOUR if tour else FOLLOW)
    console = Console(markup=False, soft_wrap=True)
    if what == "follow":
        folder = output_folder(out or Path("out/tour" if tour else "out/follow"))
        if tour:
            good = run_tour(
                TourSetup(robot=robot, world=world, path_length=metres, seed=seed), folder, console
            )
        else:
            good = follow(folder, robot, world, seconds, lockstep, view, console)
        raise typer.Exit(0 if good else 1)
    stack = _stack(robot, low_level, loss, jitter, lockstep, actuator)
    check_stack(stack)
    folder = output_folder(out or Path("out/demo"))
    recorded = folder / "demo.mcap"
    with atomic_write(recorded) as draft:
        script = "quick" if quick else "full"
        problem = ScriptedWalk(draft, script, stack.commands(view), lockstep, console).run()
    for name in DERIVED_FILES:
        (folder / name).unlink(missing_ok=True)
    if problem:
        console.print(problem, style="bold red")
        if not lockstep and low_level == "sim":
            console.print(LOCKSTEP_HINT)
    try:
        recording = read_recording(recorded)
        summary = demo_summary.summarise_demo(recording)
    except ValueError as error:
        console.print(f"no summary of the walk: {error}", highlight=False)
        raise typer.Exit(1) from None
    write_json(folder / "summary.json", summary)
    _report(summary, console)
    _draw(recording, folder, video, console)
    written = [name for name in ("demo.mcap", *DERIVED_FILES) if (folder / name).exists()]
    console.print(f"written to {folder}: {', '.join(written)}")
    if summary["falls"]:
        console.print(f"falls: {summary['falls']}", style="bold red")
    raise typer.Exit(1 if problem or summary["falls"] else 0)


def _check_options(context: typer.Context, demo: str) -> None:
    """Raise ValueError for an option that this kind of demo does not have."""
    for name, demos in OPTION_SCOPES.items():
        source = context.get_parameter_source(name)
        if (
            source
            and source.name == "COMMANDLINE"
            and context.params[name] is not False
            and demo not in demos
        ):
            kinds = (FOLLOW,) if demos == (FOLLOW, TOUR) else demos  # a tour is one of following
            raise ValueError(f"--{name.replace('_', '-')} belongs to {' and '.join(kinds)}, not to {demo}")


def _stack(
    robot: str, low_level: str, loss: float, jitter: float, lockstep: bool, actuator: Path | None
) -> Stack:
    """Return the stack of a scripted walk."""
    network = {"network_loss": loss, "network_jitter": 1e-3 * jitter}
    given = {name: value for name, value in network.items() if value}
    return Stack(robot=robot, low_level=low_level, use_sim_time=lockstep, network=given, actuator=actuator)


def _report(summary: dict[str, Any], console: Console) -> None:
    """Print the summary of a walk."""
    console.print(segment_table(summary["segments"]))
    loop, n = summary["loop"], number_text
    rmse = ", ".join(n(x, ".3f") for x in summary["estimator"]["rmse"])
    console.print(
        f"error_xy mean {n(summary['mean_error_xy'], '.3f')}, largest {n(summary['max_error_xy'], '.3f')} m/s; "
        f"yaw rate off by {n(summary['mean_error_wz'], '.3f')}, at most {n(summary['max_error_wz'], '.3f')} rad/s; "
        f"falls {summary['falls']}; estimator RMSE {rmse} m/s\n"
        f"loop {n(loop['rate_hz'], '.0f')} Hz, period p99 {n(loop['period_p99_ms'], '.2f')} ms, compute p50 "
        f"{n(loop['compute_p50_us'], '.0f')}, p99 {n(loop['compute_p99_us'], '.0f')} us, inference p50 "
        f"{n(loop['inference_p50_us'], '.0f')} us, overruns {loop['overruns']}; "
        f"real-time factor {n(summary['realtime_factor'], '.3f')}",
        highlight=False,
    )


def _draw(recording: Recording, folder: Path, video: bool, console: Console) -> None:
    """Draw the plots and, if GL and an encoder are available, a strip of frames and a video."""
    write_figure(folder / "loop.png", demo_figures.loop_figure(recording))
    write_figure(folder / "demo.png", demo_figures.tracking_figure(recording))
    if not video:
        return
    backend, encoder = gl_backend(), video_encoder()
    if backend is None:
        console.print(f"no video: no off-screen GL on this machine; sudo apt install {GL_PACKAGES}")
        return
    if not encoder.good:
        console.print(f"no video: {encoder.text}")
        return
    console.print("rendering the video of the walk; this may take minutes")
    with console.status("rendering the video"):
        drawing = subprocess.run(
            [sys.executable, "-m", "quadvel_eval.video", folder / "demo.mcap", folder],
            env={**os.environ, "MUJOCO_GL": backend},
            capture_output=True,
            text=True,
        )
    if drawing.returncode:
        reason = (drawing.stderr.strip() or f"exit code {drawing.returncode}").splitlines()[-1]
        console.print(f"no video: {reason}")
