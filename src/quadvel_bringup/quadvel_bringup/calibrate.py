"""`quadvel calibrate`: what one robot's encoders and IMU show at zero, from recordings of how it hangs and how it stands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from quadvel_description.robot import JOINT_NAMES
from quadvel_description.state import RobotState
from quadvel_driver.find_calibration import CalibrationDataError, CalibrationFit, Samples, fit_calibration
from quadvel_eval.output import output_file, replacing
from quadvel_nodes.messages import read_low_state
from quadvel_recordings.reading import read_messages

TOPIC = "/low_state"
SETTLING = 2.0  # s at the start and
ENDING = 1.0  # s at the end of a recording, that are left out: the robot gets there, and sinks
UNEVEN = 0.01  # m, that the feet of a standing robot are off one plane, from which on something is wrong


def calibrate_command(
    hung: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>", help="Recording of the hung robot that creeps: finds the joints' zeros."
        ),
    ] = None,
    standing: Annotated[
        Path | None,
        typer.Option(
            metavar="<file>",
            help="Recording of the robot that stands on a level floor: finds how the IMU leans.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="<file>", help="The file to write.")] = Path(
        "out/calibration.yaml"
    ),
) -> None:
    """Find what the encoders and the IMU of a robot show at zero; the driver applies what was found.

    \b
    With the robot hung, and nothing else that sends low_cmd:
      quadvel excite creep --seconds 60 --low-level external --out hung.mcap
    Then with the robot standing on a level floor:
      quadvel record low_state --seconds 5 --out standing.mcap
    Both without a calibration in the driver. Then:
      quadvel calibrate --hung hung.mcap --standing standing.mcap --out calibration.yaml
      quadvel run driver --ros-args -p calibration:=calibration.yaml
    """
    if hung is None and standing is None:
        raise ValueError("nothing to find anything from: name a recording with --hung or --standing, or both")
    output_file(out)
    found = fit_calibration(_samples(hung), _samples(standing))
    console = Console(soft_wrap=True)
    console.print(_table(found))
    if standing is not None:
        roll, pitch = np.degrees(found.calibration.imu_mounting)
        console.print(
            f"IMU: leans by {roll:+.2f} degrees to the right and {pitch:+.2f} degrees forward",
            highlight=False,
        )
    if found.unevenness > UNEVEN:
        uneven = f"{1e3 * found.unevenness:.0f} mm"
        console.print(
            f"[yellow]the standing feet are {uneven} off one plane: is the floor level, is a joint far off?"
        )
    with replacing(out) as draft:
        draft.write_text(found.calibration.to_yaml())
    console.print(f"written to {out}", highlight=False)


def _samples(path: Path | None) -> Samples | None:
    """A recording's states but for its ends. ValueError names the file."""
    if path is None:
        return None
    try:
        return Samples.from_states(_middle(list(_states(path))))
    except CalibrationDataError as error:
        raise ValueError(f"{path}: {error}") from None


def _states(path: Path) -> Iterator[RobotState]:
    for _, _, message in read_messages(path, lambda topic, _: topic == TOPIC):
        yield read_low_state(message)


def _middle(states: list[RobotState]) -> list[RobotState]:
    if not states:
        return []
    begin, end = states[0].time + SETTLING, states[-1].time - ENDING
    return [state for state in states if begin <= state.time <= end]


def _table(found: CalibrationFit) -> Table:
    table = Table("joint", "shows at zero, degrees", "standard error", title="Joints")
    zeros = np.degrees(found.calibration.joint_zeros)
    for name, zero, error in zip(JOINT_NAMES, zeros, np.degrees(found.zero_errors), strict=True):
        table.add_row(name, f"{zero:+.2f}", "not looked for" if np.isnan(error) else f"{error:.2f}")
    return table
