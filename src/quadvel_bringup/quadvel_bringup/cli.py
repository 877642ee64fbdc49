"""The command line `quadvel`. A command imports what it needs when it runs: --help answers at once."""

from __future__ import annotations

import json
import signal
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import attrs
import typer

from .nodes import NODES
from .stack import PARAMETERS, Stack

# A line with only \b keeps the lines that follow it as they are, up to the next empty one.
EXAMPLES = """
A quadruped that follows velocity commands: in simulation, and as ROS 2 nodes.

\b
Try, one after the other:
  quadvel doctor              what this machine can run
  quadvel demo                walk in all directions; results in out/demo
  quadvel up                  the same robot, waiting for your commands
  quadvel drive --vx 0.5      one of them, from another terminal
  quadvel status              how the robot does
  quadvel eval --grid quick --out out/eval

\b
Where ROS 2 is sourced, the nodes talk to it:
  ros2 topic pub -r 20 /cmd_vel geometry_msgs/msg/Twist "{linear: {x: 0.5}}"
"""

NODE_LIST = "\n".join(f"  {name:18} {entry.about}" for name, entry in NODES.items())
RUN_HELP = f"""
Run one node in this process.

\b
Nodes:
{NODE_LIST}

\b
What follows are arguments of ROS 2:
  quadvel run sim_node --ros-args -p terrain:=rough
  quadvel run controller --ros-args -p policy:=my.onnx -r cmd_vel:=/joy/cmd_vel
"""

PLAIN: Any = {"add_completion": False, "rich_markup_mode": None, "pretty_exceptions_enable": False}
app = typer.Typer(no_args_is_help=True, **{**PLAIN, "add_completion": True})
# Commands whose arguments belong to somebody else: handed on as they are, --help too.
HANDED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}


@attrs.frozen
class Elsewhere:
    """A command of another module. where: "module:member", a function or a typer application; about: its line in the help."""

    where: str
    about: str


ELSEWHERE = {
    "demo": Elsewhere(
        "quadvel_bringup.demo:demo_command",
        "Walk a simulated robot through all directions, in real time, through the nodes.",
    ),
    "excite": Elsewhere(
        "quadvel_bringup.excite:excite_command",
        "Move the joints so that they show what they are, and record it for `quadvel identify`.",
    ),
    "identify": Elsewhere("quadvel_sysid.cli:app", "Find what the actuator model lacks, from measured logs."),
    "calibrate": Elsewhere(
        "quadvel_bringup.calibrate:calibrate_command",
        "Find what the encoders and the IMU of a robot show at zero.",
    ),
    "twin": Elsewhere(
        "quadvel_bringup.ground_truth_benchmark:twin_command",
        "Close the loop on the stack itself: plants that its model does not know, identified from their walks.",
    ),
    "eval": Elsewhere(
        "quadvel_eval.cli:eval_command",
        "Measure how well a policy tracks a grid of commands, faster than real time.",
    ),
    "compare": Elsewhere("quadvel_eval.cli:compare_command", "Show two evaluations side by side."),
    "faults": Elsewhere(
        "quadvel_eval.cli:faults_command",
        "Let things go wrong in a simulated robot, and measure what it does.",
    ),
    "paper": Elsewhere(
        "quadvel_eval.paper.cli:paper_command",
        "Measure what the paper's figures show: a page, pictures, tables.",
    ),
    "people": Elsewhere(
        "quadvel_eval.people.cli:people_command",
        "Measure how well persons are found and tracked in laser scans, real and simulated.",
    ),
    "world": Elsewhere(
        "quadvel_eval.world_map:world_command", "Check a world's file, and draw the world from above."
    ),
    "following": Elsewhere(
        "quadvel_eval.following.cli:following_command",
        "Measure how well a person is followed, in simulated scenes in the plane.",
    ),
    "plot": Elsewhere(
        "quadvel_eval.recording_plot:plot_command",
        "Draw what was recorded of a run: velocity, joints, torques, the controller's loop.",
    ),
    "replay": Elsewhere(
        "quadvel_eval.offline:replay_command",
        "Ask the actuator model and the estimator offline what they say of a recording.",
    ),
    "bench": Elsewhere(
        "quadvel_eval.cli:bench_command", "Measure the speed of simulator, policy and loop on this machine."
    ),
}

# Commands that Ctrl-C ends as it should, with exit code 0: they allow it themselves, where they are ready for it.
ENDED_BY_CTRL_C = ("run", "up", "drive", "record", "view", "teleop")


def _version(asked: bool) -> None:
    if asked:
        from .version import version

        print(f"quadvel {version()}")
        raise typer.Exit


@app.callback(help=EXAMPLES)
def begin(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    if context.invoked_subcommand not in ENDED_BY_CTRL_C:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@app.command()
def doctor() -> None:
    """Say what this machine has and what it can run."""
    from .doctor import abilities, examine

    findings = []
    for finding in examine():
        findings.append(finding)
        print(f"{'ok  ' if finding.good else 'note'} {finding.subject:12} {finding.text}", flush=True)
    for ability, possible in abilities(findings):
        print(f"{'can' if possible else 'cannot'} run {ability}")


@app.command(help=RUN_HELP, context_settings=HANDED_ON)
def run(
    context: typer.Context,
    node: Annotated[str, typer.Argument()],
    actuator: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="sim_node: its actuator.yaml.", show_default="the shipped one"),
    ] = None,
) -> None:
    from . import nodes

    arguments = [*context.args]
    if actuator is not None:
        file = json.dumps(str(actuator.resolve()))
        arguments = [*(arguments or ["--ros-args"]), "-p", f"actuator_file:={file}"]
    nodes.run(node, arguments)


@app.command()
def up(
    low_level: Annotated[
        Literal["sim", "board", "aliengo", "external"],
        typer.Option(
            help="The robot: simulated; simulated behind the AlienGo's UDP interface; the AlienGo; or others serve it."
        ),
    ] = "sim",
    policy: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="ONNX file of the policy.", show_default="the shipped one"),
    ] = None,
    terrain: Annotated[
        str | None, typer.Option(metavar="<name>", help="flat, slope or rough.", show_default="flat")
    ] = None,
    world: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>",
            help="Simulated robot: what is around it, corridor, park, campus or a file.",
            show_default="nothing",
        ),
    ] = None,
    actuator: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="Simulated robot: its actuator.yaml.", show_default="the shipped one"
        ),
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(metavar="<name>", help="learned or kalman.", show_default="learned")
    ] = None,
    params: Annotated[
        Path,
        typer.Option(metavar="<file>", help="YAML file with the nodes' parameters.", show_default="shipped"),
    ] = PARAMETERS,
    view: Annotated[bool, typer.Option("--view", help="With the operator's page in the browser.")] = False,
) -> None:
    """Start robot, estimator, controller and command mux, each as a process; Ctrl-C stops them.

    \b
    Then, from another terminal:
      quadvel drive --vx 0.5
    or, where ROS 2 is sourced:
      ros2 topic pub -r 20 /cmd_vel geometry_msgs/msg/Twist "{linear: {x: 0.5}}"
    """
    from .up import up as run_up

    stack = Stack(
        low_level=low_level,
        policy=policy,
        terrain=terrain,
        world=world,
        actuator=actuator,
        estimator=estimator,
        parameters=params,
    )
    raise typer.Exit(run_up(stack, view))


@app.command()
def view(
    recording: Annotated[
        Path | None,
        typer.Argument(help="A recording to play: MCAP, rosbag2.", show_default=False),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            metavar="<address>",
            help="Address to listen on; others than this host's own need the token that is shown.",
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="TCP port.", show_default="8770, for Foxglove 8765")
    ] = None,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve the topics to Foxglove or Lichtblick instead of a page.")
    ] = False,
) -> None:
    """Show the robot in the browser, in 3-D, with all that its operator needs; or play a recording of it.

    It prints the address to open. What it needs, pip brings with quadvel[view].

    \b
    For example:
      quadvel view
      quadvel view out/demo/demo.mcap
    """
    from .view import view as run_view

    run_view(recording, host, port, foxglove)


@app.command()
def drive(
    vx: Annotated[float, typer.Option(help="Forward, m/s.")] = 0.0,
    vy: Annotated[float, typer.Option(help="To the left, m/s.")] = 0.0,
    wz: Annotated[float, typer.Option(help="Turn to the left, rad/s.")] = 0.0,
    seconds: Annotated[float, typer.Option(min=0.1, help="For how long.")] = 3.0,
    topic: Annotated[
        str, typer.Option(metavar="<topic>", help="An input of the command mux.")
    ] = "cmd_vel_teleop",
) -> None:
    """Drive the robot that `quadvel up` started: one velocity for some seconds, then stop; says what came of it.

    Exit code 1 where the robot did not follow, 2 where nobody listens.

    \b
    For example:
      quadvel drive --vx 0.5 --wz 0.3 --seconds 5
    """
    raise typer.Exit(_with_middleware("drive").drive(vx, vy, wz, seconds, topic))


@app.command()
def teleop(
    by: Annotated[Literal["keyboard", "gamepad"], typer.Argument(help="What the hands are on.")] = "keyboard",
) -> None:
    """Drive the robot by the keys of this terminal, or by a gamepad: it goes while something is held, and stands once it is let go.

    \b
    For example:
      quadvel teleop
      quadvel teleop gamepad
    """
    module = _with_middleware("teleop")
    raise typer.Exit(module.by_keyboard() if by == "keyboard" else module.by_gamepad())


@app.command()
def mode(
    wanted: Annotated[
        Literal["passive", "stand_up", "stance", "walk", "lie_down"], typer.Argument(metavar="mode")
    ],
) -> None:
    """Ask the controller for a mode: passive, stand_up, stance, walk or lie_down.

    passive damps the joints, and is the way out of a fault.

    \b
    In fault, once its cause is gone:
      quadvel mode passive
      quadvel mode stand_up
    """
    raise typer.Exit(_with_middleware("operator_commands").mode(wanted))


@app.command()
def enable(
    on: Annotated[bool, typer.Option("--on/--off", help="Allow walking, or forbid it.")] = True,
) -> None:
    """Allow a robot that asks for it to walk; a simulated one needs no permission."""
    raise typer.Exit(_with_middleware("operator_commands").enable(on))


@app.command()
def status() -> None:
    """Show the robot that runs on one page: nodes, mode, velocity, rates, files, temperatures."""
    raise typer.Exit(_with_middleware("status").status())


@app.command()
def reset(
    keyframe: Annotated[Literal["lie", "stand"], typer.Option(help="Its posture.")] = "lie",
    terrain: Annotated[
        Literal["flat", "slope", "rough"] | None,
        typer.Option(help="Ground to start on.", show_default="the ground that is there"),
    ] = None,
    slope: Annotated[float, typer.Option(help="With slope or rough: inclination, rad.")] = 0.0,
) -> None:
    """Put the simulated robot back to where it started, or on other ground.

    \b
    After a fall, or from any mode:
      quadvel reset
      quadvel mode stand_up
    On a slope of 10 degrees that rises ahead:
      quadvel reset --terrain slope --slope 0.175
    """
    raise typer.Exit(_with_middleware("operator_commands").reset(keyframe, terrain or "", slope))


@app.command()
def pause(
    on: Annotated[bool, typer.Option("--on/--off", help="Stand still, or go on.")] = True,
) -> None:
    """Let simulated time stand still, or go on with --off."""
    raise typer.Exit(_with_middleware("operator_commands").pause(on))


@app.command()
def step(milliseconds: Annotated[int, typer.Argument(min=1)] = 5) -> None:
    """Let a paused simulation run on for some milliseconds."""
    raise typer.Exit(_with_middleware("operator_commands").step(milliseconds))


@app.command()
def push(
    fx: Annotated[float, typer.Option(help="Force to the front of the world, N.")] = 0.0,
    fy: Annotated[float, typer.Option(help="Force to its left, N.")] = 0.0,
    fz: Annotated[float, typer.Option(help="Force upwards, N.")] = 0.0,
    seconds: Annotated[float, typer.Option(min=0.001, help="For how long.")] = 0.2,
    body: Annotated[str, typer.Option(metavar="<name>", help="Which body of the robot.")] = "trunk",
) -> None:
    """Push the simulated robot.

    \b
    For example:
      quadvel push --fy 60
    """
    raise typer.Exit(_with_middleware("operator_commands").push((fx, fy, fz), seconds, body))


@app.command()
def record(
    topics: Annotated[list[str] | None, typer.Argument(help="Topics to record.", show_default="all")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="The file to write; with --ring the folder.",
            show_default="out/record.mcap, out/faults",
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after these.")] = None,
    ring: Annotated[
        float | None,
        typer.Option(min=1.0, help="Write only faults: each with so many seconds before it."),
    ] = None,
) -> None:
    """Record running topics to an MCAP file for Foxglove and ros2 bag.

    With --ring what came last is kept in memory, and written to a file of its own whenever the robot goes into fault.
    Exit code 1, and no file, where nothing came. Of a recorder that was killed all but the last second can be read.

    \b
    For example:
      quadvel record low_state low_cmd --out walk.mcap
      quadvel record --ring 30 --out out/faults
    """
    from .record import record as run_record
    from .record import record_faults

    if ring is not None:
        record_faults(out or Path("out/faults"), topics or [], ring, seconds)
        return
    out = out or Path("out/record.mcap")
    if not run_record(out, topics or [], seconds):
        raise typer.Exit(1)


def _register(name: str, about: str) -> None:
    """A command of ELSEWHERE: its arguments are handed on as they are, and its module is loaded when it runs."""

    @app.command(name, help=about, context_settings=HANDED_ON, add_help_option=False)
    def hand_on(context: typer.Context) -> None:
        command(name).main(context.args, prog_name=context.command_path)


for _name, _elsewhere in ELSEWHERE.items():
    _register(_name, _elsewhere.about)


def command(name: str) -> Any:
    """A command with all its arguments and options, as click has it.

    Args:
        name: of the command, as after `quadvel`.

    Raises:
        KeyError: there is no command of this name.
    """
    if name not in ELSEWHERE:
        return typer.main.get_group(app).commands[name]
    module, _, member = ELSEWHERE[name].where.partition(":")
    found = getattr(import_module(module), member)
    if isinstance(found, typer.Typer):
        return typer.main.get_command(found)
    alone = typer.Typer(**PLAIN)
    alone.command(name)(found)
    return typer.main.get_command(alone)


def _with_middleware(module: str) -> Any:
    """A module of this package that needs rclpy, with whichever rclpy there is."""
    import quadvel_dds

    quadvel_dds.install()
    return import_module(f".{module}", __package__)
