"""Commands of `quadvel`. They import their modules when they run, so that --help is fast."""

from __future__ import annotations

import json
import signal
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import attrs
import typer
from typer.core import TyperGroup

from quadvel_description.robot_name import DEFAULT_ROBOT

from .installation import check_installed
from .nodes import NODES
from .stack import PARAMETERS, Stack

ROBOT, SIMULATOR, LOGS, EVALUATION = PANELS = ("Robot", "Simulator", "Logs", "Evaluation")
"""Panels of the help, in order."""
EXAMPLES = """\
Usage: quadvel [--version | --install-completion] COMMAND [ARGS]... For example:
  quadvel demo               walk a simulated robot; results in out/demo
  quadvel up --view          run the simulated robot with the operator page
  quadvel drive --vx 0.5     drive it, from another terminal"""

# In help texts, \b on a line keeps the format of the lines up to the next empty one.
NODE_LIST = "\n".join(f"  {name:18} {entry.about}" for name, entry in NODES.items())
RUN_HELP = f"""
Run one node in this process.

\b
Nodes:
{NODE_LIST}

\b
Further arguments are those of ROS 2:
  quadvel run sim_node --ros-args -p terrain:=rough
  quadvel run command_mux --ros-args -r cmd_vel:=/joy/cmd_vel
"""


class _PanelGroup(TyperGroup):
    """Prints the help on one screen of 80 x 40: examples, then the commands in panels.

    Errors of values name the value.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run a command.

        Args:
            ctx: The context of the command line.

        Returns:
            What the command returns.

        Raises:
            typer.BadParameter: An option has a wrong value.
        """
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            of_pydantic = getattr(error.__cause__, "errors", None)  # by which typer checks values
            found = of_pydantic()[0]["input"] if of_pydantic else None
            if found is not None and repr(found) not in error.message:
                error.message = f"found {found!r}: {error.message}"
            raise

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help.

        Args:
            ctx: The context of the command line.
            formatter: Receives the text.
        """
        lines = [EXAMPLES]
        for panel in PANELS:
            lines.append(typer.style(panel, bold=True))
            for name, command in sorted(self.commands.items(), key=lambda item: hasattr(item[1], "commands")):
                if getattr(command, "rich_help_panel", None) == panel:
                    lines.append(f"  {name:11} {command.get_short_help_str(66)}")
        formatter.write("\n".join([*lines, ""]))


PLAIN: Any = {"add_completion": False, "rich_markup_mode": None, "pretty_exceptions_enable": False}
app = typer.Typer(no_args_is_help=True, cls=_PanelGroup, **{**PLAIN, "add_completion": True})
PASS_THROUGH = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Settings of commands that pass all arguments on, including --help."""


@attrs.frozen
class DelegatedCommand:
    """A command of another module.

    Attributes:
        target: "module:member", a function or a typer application.
        extra: Extra of quadvel-core with the libraries that it needs.
        panel: Its panel in the help.
        about: Its line in the help.
    """

    target: str
    extra: str
    panel: str
    about: str


DELEGATED_COMMANDS = {
    "robot check": DelegatedCommand(
        "quadvel_eval.robot_check:check_command",
        "eval",
        ROBOT,
        "Check the MJCF or URDF of a new quadruped, and write its folder.",
    ),
    "demo": DelegatedCommand(
        "quadvel_lab.demo:demo_command",
        "eval",
        SIMULATOR,
        "Walk a simulated robot in all directions, or after a person.",
    ),
    "policy import": DelegatedCommand(
        "quadvel_bringup.import_policy:import_command",
        "robot",
        ROBOT,
        "Import a policy of another project into one ONNX file.",
    ),
    "world": DelegatedCommand(
        "quadvel_eval.world_map:world_command",
        "eval",
        SIMULATOR,
        "Check the file of a world, and draw a map of it.",
    ),
    "plot": DelegatedCommand(
        "quadvel_eval.recording_plot:plot_command",
        "eval",
        LOGS,
        "Plot velocity, joints, torques and loop timing of a recording.",
    ),
    "replay": DelegatedCommand(
        "quadvel_eval.offline:replay_command",
        "eval",
        LOGS,
        "Run actuator model and estimator offline on a recording.",
    ),
    "why": DelegatedCommand(
        "quadvel_why.cli:why_command",
        "eval",
        LOGS,
        "Find the cause in the recording of a run that failed.",
    ),
    "excite": DelegatedCommand(
        "quadvel_lab.excite:excite_command",
        "identify",
        LOGS,
        "Run an excitation motion and record it for identification.",
    ),
    "identify": DelegatedCommand(
        "quadvel_sysid.cli:app",
        "identify",
        LOGS,
        "Identify what the actuator model lacks, from measured logs.",
    ),
    "calibrate": DelegatedCommand(
        "quadvel_bringup.calibrate:calibrate_command",
        "identify",
        LOGS,
        "Estimate the zero offsets of encoders and IMU.",
    ),
    "eval": DelegatedCommand(
        "quadvel_eval.cli:eval_command",
        "eval",
        EVALUATION,
        "Measure velocity tracking of a policy on a command grid.",
    ),
    "compare": DelegatedCommand(
        "quadvel_eval.cli:compare_command",
        "eval",
        EVALUATION,
        "Compare two evaluations.",
    ),
    "faults": DelegatedCommand(
        "quadvel_eval.cli:faults_command",
        "eval",
        EVALUATION,
        "Inject faults into a simulated robot and measure the reaction.",
    ),
    "people": DelegatedCommand(
        "quadvel_eval.people.cli:people_command",
        "eval",
        EVALUATION,
        "Measure detection and tracking of people in laser scans.",
    ),
    "following": DelegatedCommand(
        "quadvel_eval.following.cli:following_command",
        "eval",
        EVALUATION,
        "Measure person following in simulated planar scenes.",
    ),
    "bench": DelegatedCommand(
        "quadvel_eval.cli:bench_command",
        "eval",
        EVALUATION,
        "Measure the speed of simulator, policy and control loop.",
    ),
    "paper": DelegatedCommand(
        "quadvel_eval.paper.cli:paper_command",
        "eval",
        EVALUATION,
        "Reproduce the figures of the paper: page, plots, tables.",
    ),
    "twin": DelegatedCommand(
        "quadvel_lab.ground_truth_benchmark:twin_command",
        "eval",
        EVALUATION,
        "Benchmark the identification on plants with hidden effects.",
    ),
}
"""Commands of other modules by name; the first of two words is a group."""

RUN_UNTIL_CTRL_C = ("run", "up", "drive", "record", "view", "teleop")
"""Commands that Ctrl-C ends with exit code 0.

They unblock SIGINT themselves when they are ready for it.
"""


def _version(asked: bool) -> None:
    if asked:
        from .version import version

        print(f"quadvel {version()}")
        raise typer.Exit


@app.callback()
def begin(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Learned velocity control of a quadruped: in simulation, on the robot, and as ROS 2 nodes."""
    if context.invoked_subcommand not in RUN_UNTIL_CTRL_C:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@app.command(rich_help_panel=ROBOT)
def doctor(
    robot: Annotated[
        str, typer.Option(metavar="<name|file>", help="aliengo, go2 or the folder of a robot.")
    ] = DEFAULT_ROBOT,
    report: Annotated[
        bool, typer.Option("--report", help="Print a text for a bug report, with versions and system.")
    ] = False,
) -> None:
    """Check what is installed on this machine and what it can run.

    \b
    For example:
      quadvel doctor
      quadvel doctor --report
    """
    from quadvel_description.robot import load_robot

    from . import doctor

    load_robot(robot)
    if report:
        print(doctor.report([*doctor.examine()]))
        return
    findings = []
    for finding in chain(doctor.examine(), [doctor.robot_files(robot)]):
        findings.append(finding)
        print(f"{'ok  ' if finding.good else 'note'} {finding.subject:12} {finding.text}", flush=True)
    for ability, possible in doctor.abilities(findings):
        print(f"{'can' if possible else 'cannot'} run {ability}")


@app.command(help=RUN_HELP, context_settings=PASS_THROUGH, rich_help_panel=ROBOT)
def run(
    context: typer.Context,
    node: Annotated[str, typer.Argument()],
    actuator: Annotated[
        Path | None,
        typer.Option(metavar="<file>", help="sim_node: its actuator.yaml.", show_default="the shipped one"),
    ] = None,
) -> None:
    """Run one node in this process; the help is RUN_HELP."""
    from . import nodes
    from .exclusivity import refuse_beside_a_robot
    from .preflight import check_arguments

    arguments = [*context.args]
    if actuator is not None:
        file = json.dumps(str(actuator.resolve()))
        arguments = [*(arguments or ["--ros-args"]), "-p", f"actuator_file:={file}"]
    check_arguments(node, arguments)
    if node == "sim_node":
        refuse_beside_a_robot()
    nodes.run(node, arguments)


@app.command(rich_help_panel=ROBOT)
def up(
    low_level: Annotated[
        Literal["sim", "board", "driver", "external"],
        typer.Option(
            help="simulator; simulator behind the UDP interface of a board; a real robot; or one that is served elsewhere."
        ),
    ] = "sim",
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>", help="aliengo, go2 or the folder of a robot.", show_default=DEFAULT_ROBOT
        ),
    ] = None,
    policy: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="ONNX file of the policy; none: only stand.",
            show_default="the shipped one",
        ),
    ] = None,
    terrain: Annotated[
        str | None,
        typer.Option(metavar="<name>", help="flat, slope (10 degrees) or rough.", show_default="flat"),
    ] = None,
    world: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>",
            help="Simulated robot: its surroundings, corridor, park, campus or a file.",
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
    view: Annotated[bool, typer.Option("--view", help="Serve the operator page in the browser.")] = False,
) -> None:
    """Start a robot: simulated, real, or a running one.

    Low-level interface, estimator, controller and command mux run as processes; Ctrl-C stops them.

    \b
    Then, from another terminal:
      quadvel drive --vx 0.5
    or, where ROS 2 is sourced:
      ros2 topic pub -r 20 /cmd_vel geometry_msgs/msg/Twist "{linear: {x: 0.5}}"
    """
    from .up import up as run_up

    stack = Stack(
        low_level=low_level,
        robot=robot,
        policy=policy,
        terrain=terrain,
        world=world,
        actuator=actuator,
        estimator=estimator,
        parameters=params,
    )
    raise typer.Exit(run_up(stack, view))


@app.command(rich_help_panel=ROBOT)
def view(
    recording: Annotated[
        Path | None,
        typer.Argument(help="A recording to play: MCAP, rosbag2.", show_default=False),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>",
            help="aliengo, go2 or the folder of a robot.",
            show_default="as recorded, or aliengo",
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            metavar="<address>",
            help="Address to listen on; other than loopback ones require the printed token.",
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="TCP port.", show_default="8770, for Foxglove 8765")
    ] = None,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Serve the topics to Foxglove or Lichtblick instead of a page.")
    ] = False,
) -> None:
    """Serve the operator page in the browser, or play a recording.

    It prints the address to open. It requires the extra quadvel-core[view].

    \b
    For example:
      quadvel view
      quadvel view out/demo/demo.mcap
    """
    check_installed("view", "quadvel_view", "view")
    from .view import view as run_view

    run_view(recording, robot, host, port, foxglove)


@app.command(rich_help_panel=ROBOT)
def drive(
    vx: Annotated[float, typer.Option(help="Forward, m/s.")] = 0.0,
    vy: Annotated[float, typer.Option(help="To the left, m/s.")] = 0.0,
    wz: Annotated[float, typer.Option(help="Turn rate to the left, rad/s.")] = 0.0,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration, s.")] = 3.0,
    topic: Annotated[
        str, typer.Option(metavar="<topic>", help="Input topic of the command mux.")
    ] = "cmd_vel_teleop",
) -> None:
    """Command one velocity for some seconds, then stop.

    It prints the measured velocity. Exit code 1 if the robot did not follow, 2 if no robot is
    running.

    \b
    For example:
      quadvel drive --vx 0.5 --wz 0.3 --seconds 5
    """
    raise typer.Exit(_with_middleware("drive").drive(vx, vy, wz, seconds, topic))


@app.command(rich_help_panel=ROBOT)
def teleop(
    by: Annotated[Literal["keyboard", "gamepad"], typer.Argument(help="Input device.")] = "keyboard",
) -> None:
    """Drive the robot by keyboard or gamepad.

    The robot moves while a key is held, and stops on release.

    \b
    For example:
      quadvel teleop
      quadvel teleop gamepad
    """
    if by == "gamepad":
        check_installed("teleop gamepad", "quadvel_view", "view")
    module = _with_middleware("teleop")
    raise typer.Exit(module.drive_by_keyboard() if by == "keyboard" else module.drive_by_gamepad())


@app.command(rich_help_panel=ROBOT)
def mode(
    wanted: Annotated[
        Literal["passive", "stand_up", "stance", "walk", "lie_down"], typer.Argument(metavar="mode")
    ],
) -> None:
    """Request a mode: passive, stand_up, stance, walk or lie_down.

    passive damps the joints and resets a fault.

    \b
    Recover from a fault, once its cause is gone:
      quadvel mode passive
      quadvel mode stand_up
    """
    raise typer.Exit(_with_middleware("operator_commands").mode(wanted))


@app.command(rich_help_panel=ROBOT)
def enable(
    on: Annotated[bool, typer.Option("--on/--off", help="Permit or forbid walking.")] = True,
) -> None:
    """Permit or forbid walking.

    Real robots require the permission. A simulated one does not, and --off has no effect: exit code 1.
    """
    raise typer.Exit(_with_middleware("operator_commands").enable(on))


@app.command(rich_help_panel=ROBOT)
def status(
    joints: Annotated[bool, typer.Option("--joints", help="Show joints and IMU, too.")] = False,
) -> None:
    """Show nodes, mode, velocity, rates and files of the robot.

    Exit code 1 if no robot runs, its controller is missing or in fault, or a node reports an error.

    \b
    For example:
      quadvel status
      quadvel status --joints
    """
    raise typer.Exit(_with_middleware("status").status(joints))


@app.command(rich_help_panel=SIMULATOR)
def reset(
    keyframe: Annotated[Literal["lie", "stand"], typer.Option(help="Initial posture.")] = "lie",
    terrain: Annotated[
        Literal["flat", "slope", "rough"] | None,
        typer.Option(help="New ground.", show_default="the present ground"),
    ] = None,
    slope: Annotated[
        float,
        typer.Option(help="With slope or rough: inclination, rad.", show_default="slope 0.175, rough 0"),
    ] = 0.0,
) -> None:
    """Reset the simulated robot to its start, or onto other ground.

    \b
    After a fall, from any mode:
      quadvel reset
      quadvel mode stand_up
    Onto a slope of 10 degrees that rises ahead:
      quadvel reset --terrain slope --slope 0.175
    """
    raise typer.Exit(_with_middleware("operator_commands").reset(keyframe, terrain or "", slope))


@app.command(rich_help_panel=SIMULATOR)
def pause(
    on: Annotated[bool, typer.Option("--on/--off", help="Pause or resume.")] = True,
) -> None:
    """Pause simulated time, or resume it with --off.

    \b
    For example:
      quadvel pause
      quadvel pause --off
    """
    raise typer.Exit(_with_middleware("operator_commands").pause(on))


@app.command(rich_help_panel=SIMULATOR)
def step(milliseconds: Annotated[int, typer.Argument(min=1)] = 5) -> None:
    """Advance a paused simulation by some milliseconds.

    \b
    For example:
      quadvel step 20
    """
    raise typer.Exit(_with_middleware("operator_commands").step(milliseconds))


@app.command(rich_help_panel=SIMULATOR)
def push(
    fx: Annotated[float, typer.Option(help="Force along x of the world frame, N.")] = 0.0,
    fy: Annotated[float, typer.Option(help="Force along y, N.")] = 0.0,
    fz: Annotated[float, typer.Option(help="Force along z, N.")] = 0.0,
    seconds: Annotated[float, typer.Option(min=0.001, help="Duration, s.")] = 0.2,
    body: Annotated[str, typer.Option(metavar="<name>", help="Body of the robot.")] = "trunk",
) -> None:
    """Apply a force to the simulated robot.

    \b
    For example:
      quadvel push --fy 60
    """
    raise typer.Exit(_with_middleware("operator_commands").push((fx, fy, fz), seconds, body))


@app.command(rich_help_panel=LOGS)
def record(
    topics: Annotated[list[str] | None, typer.Argument(help="Topics to record.", show_default="all")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="File to write; with --ring a folder.",
            show_default="out/record.mcap, out/faults",
        ),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Duration, s; it starts with the first messages.")
    ] = None,
    ring: Annotated[
        float | None,
        typer.Option(min=1.0, help="Record faults only, each with the given seconds before it."),
    ] = None,
) -> None:
    """Record topics to an MCAP file for Foxglove and ros2 bag.

    With --ring the latest messages stay in memory, and each fault of the robot is written to its
    own file. Exit code 1 if a given topic brought no message; without any message there is no file.
    If the recorder is killed, all but the last second is readable.

    \b
    For example:
      quadvel record low_state low_cmd --out walk.mcap
      quadvel record --ring 30 --out out/faults
    """
    check_installed("record", "quadvel_recordings", "log")
    from .record import record as run_record
    from .record import record_faults

    if ring is not None:
        heard = record_faults(out or Path("out/faults"), topics or [], ring, seconds)
    else:
        heard = run_record(out or Path("out/record.mcap"), topics or [], seconds)
    if not heard:
        raise typer.Exit(1)


def _register(name: str, delegated: DelegatedCommand, groups: dict[str, typer.Typer]) -> None:
    """Register a delegated command, in its group of `groups` if its name has two words.

    Its arguments are passed on, and its module is loaded when it runs.
    """
    outer, _, inner = name.rpartition(" ")
    if outer not in groups:
        groups[outer] = typer.Typer(no_args_is_help=True, **PLAIN)
        app.add_typer(groups[outer], name=outer, help=delegated.about, rich_help_panel=delegated.panel)

    @groups[outer].command(
        inner,
        help=delegated.about,
        context_settings=PASS_THROUGH,
        add_help_option=False,
        rich_help_panel=delegated.panel,
    )
    def hand_on(context: typer.Context) -> None:
        code = command(name).main(context.args, prog_name=context.command_path, standalone_mode=False)
        if isinstance(code, int):
            raise typer.Exit(code)


_groups = {"": app}
for _name, _delegated in DELEGATED_COMMANDS.items():
    _register(_name, _delegated, _groups)


def command_names() -> list[str]:
    """List all commands, those of groups with both words.

    Returns:
        Their names after `quadvel`, in the order of registration.
    """
    commands = typer.main.get_group(app).commands.items()
    return [
        f"{name} {inner}".strip() for name, found in commands for inner in getattr(found, "commands", [""])
    ]


def command(name: str) -> Any:
    """Return a command with all its arguments and options.

    Args:
        name: Name of the command after `quadvel`, one of `command_names`.

    Returns:
        The command as a click object. KeyError is raised if there is none.

    Raises:
        ValueError: The command is not installed; the sentence says how to install it.
    """
    if name not in DELEGATED_COMMANDS:
        return typer.main.get_group(app).commands[name]
    delegated = DELEGATED_COMMANDS[name]
    module, _, member = delegated.target.partition(":")
    check_installed(name, module, delegated.extra)
    found = getattr(import_module(module), member)
    if isinstance(found, typer.Typer):
        return typer.main.get_command(found)
    alone = typer.Typer(**PLAIN)
    alone.command(name)(found)
    return typer.main.get_command(alone)


def _with_middleware(module: str) -> Any:
    """Import a module of this package that needs rclpy, after the choice of the middleware."""
    import quadvel_dds

    quadvel_dds.install()
    return import_module(f".{module}", __package__)
