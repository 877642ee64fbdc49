"""`quadvel calibrate`: encoder and IMU offsets from recordings of the robot hanging and standing.

`quadvel_driver.find_calibration` computes the offsets; `quadvel_driver.calibration` applies them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import attrs
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot, load_robot, robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_description.state import RobotState
from quadvel_driver.calibration import CalibrationError
from quadvel_driver.find_calibration import (
    CalibrationDataError,
    CalibrationFit,
    Samples,
    fit_calibration,
)
from quadvel_nodes.messages import read_low_state
from quadvel_recordings.output import atomic_write, output_file
from quadvel_recordings.reading import read_messages, recorded_description

TOPIC = "/low_state"
START_TRIM_S = 2.0
"""Time dropped at the start of a recording, while the robot settles."""
END_TRIM_S = 1.0
"""Time dropped at the end of a recording, when the robot sinks."""
MAX_UNEVENNESS_M = 0.01
"""Largest distance of standing feet from a common plane before a warning."""


def calibrate_command(
    suspended: Annotated[
        Path | None,
        typer.Option(
            "--suspended",
            "--hung",
            metavar="<file>",
            help="Recording of the suspended robot that creeps: for the joint zeros.",
        ),
    ] = None,
    standing: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="Recording of the robot standing on a level floor: for the IMU mounting.",
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="<name|file>",
            help="The robot: aliengo, go2, or a robot.yaml or its folder. Default: that of the recording.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="<file>", help="The file to write.")] = Path(
        "out/calibration.yaml"
    ),
) -> None:
    """Estimate the zero offsets of encoders and IMU; the driver applies them.

    The file corrects the encoders if their zeros together are significant, and the IMU if its tilt is.

    \b
    Suspend the robot, and let nothing else send low_cmd:
      quadvel run driver --ros-args -p state_rate:=1000
      quadvel excite creep --seconds 60 --low-level external --out suspended.mcap
    Then let the robot stand on a level floor:
      quadvel record low_state --seconds 5 --out standing.mcap
    Run the driver without a calibration for both. Then:
      quadvel calibrate --suspended suspended.mcap --standing standing.mcap --out calibration.yaml
      quadvel run driver --ros-args -p calibration:=calibration.yaml
    """
    if robot is not None:
        load_robot(robot)  # wrong files are refused first
    if suspended is None and standing is None:
        raise ValueError("no recording given: name one with --suspended, with --standing, or both")
    output_file(out)
    recordings = [path for path in (suspended, standing) if path]
    chosen = _robot(recordings, robot)
    try:
        found = fit_calibration(chosen, _samples(suspended), _samples(standing))
    except (CalibrationDataError, CalibrationError) as error:
        raise ValueError(
            f"{', '.join(map(str, recordings))}: {error}; expected a suspended robot that creeps (--suspended), and one "
            "that stands still (--standing)"
        ) from None
    console = Console(markup=False, soft_wrap=True)
    console.print(_table(found))
    for sentence in _findings(found, standing is not None):
        console.print(sentence, highlight=False)
    if found.unevenness > MAX_UNEVENNESS_M:
        uneven = f"{1e3 * found.unevenness:.0f} mm"
        console.print(
            f"the standing feet are {uneven} off a common plane: check the floor and the joints",
            style="yellow",
        )
    with atomic_write(out) as draft:
        draft.write_text(attrs.evolve(found.calibration, robot=chosen.name).to_yaml())
    console.print(f"written to {out}", highlight=False)


def _robot(paths: list[Path], asked: str | None) -> Robot:
    """Return the robot of the recordings; ValueError if they, or `asked`, are of different ones."""
    for path in paths:
        robot = robot_of_file(path, described_robot(recorded_description(path)), asked)
        asked = asked or robot.name
    return robot


def _samples(path: Path | None) -> Samples | None:
    """Return the states of a recording without its ends; ValueError names the file."""
    if path is None:
        return None
    try:
        return Samples.from_states(_trimmed(list(_states(path))))
    except CalibrationDataError as error:
        ends = f"without its first {START_TRIM_S:g} s and its last {END_TRIM_S:g} s"
        raise ValueError(f"{path}, {ends}: {error}") from None


def _states(path: Path) -> Iterator[RobotState]:
    """Yield the states of a recording."""
    for _, _, message in read_messages(path, lambda topic, _: topic == TOPIC):
        yield read_low_state(message)


def _trimmed(states: list[RobotState]) -> list[RobotState]:
    """Drop the states at both ends."""
    if not states:
        return []
    begin, end = states[0].time + START_TRIM_S, states[-1].time - END_TRIM_S
    return [state for state in states if begin <= state.time <= end]


def _findings(found: CalibrationFit, has_stood: bool) -> Iterator[str]:
    """Yield sentences on the IMU, and on what the file corrects."""
    written = found.calibration
    if written.imu_mounting.any():
        roll, pitch = np.degrees(written.imu_mounting)
        yield f"IMU: tilted by {roll:+.2f} degrees to the right and {pitch:+.2f} degrees forward"
    if not np.isnan(found.zero_errors).any() and not written.joint_zeros.any():
        yield (
            "Joints: chance explains all estimates; the file does not correct the encoders, "
            "and the IMU's tilt is estimated for encoders that are right"
        )
    if not written.imu_mounting.any():
        yield "IMU: no significant tilt; the file does not correct it"
    if not has_stood:
        yield (
            "A leaning IMU resembles four hips that are off: "
            "record the standing robot, too, and name it with --standing"
        )


def _table(found: CalibrationFit) -> Table:
    """Return a table of all offsets: estimated, standard error, and what the file corrects."""
    table = Table(
        "offset", "estimate, degrees", "standard error", "written", title="What encoders and IMU show at zero"
    )
    names = (*JOINT_NAMES, "IMU roll", "IMU pitch")
    columns = (
        np.degrees(np.concatenate(pair))
        for pair in (
            (found.estimate.joint_zeros, found.tilt),
            (found.zero_errors, found.tilt_errors),
            (found.calibration.joint_zeros, found.calibration.imu_mounting),
        )
    )
    for name, offset, error, written in zip(names, *columns, strict=True):
        shown = ("not estimated", "") if np.isnan(error) else (f"{offset:+.2f}", f"{error:.2f}")
        table.add_row(name, *shown, f"{written:+.2f}" if written else "0")
    return table
