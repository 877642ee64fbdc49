"""Table of all faults, generated from the guards: `python -m quadvel_policy.faults` prints docs/faults.md."""

from __future__ import annotations

import re
from collections.abc import Iterator

import attrs

from quadvel_nodes.parameters import parameter_fields

from .command_limits import LIMITS
from .config import SupervisorConfig
from .guard import MOVING_MODES, Level
from .guards import GUARDS
from .supervisor import SUPERVISOR_FAULTS

RESPONSES = {
    Level.DAMPING: "all joints brake immediately",
    Level.STANCE: "a walking robot brakes on its policy and stands; standing up and lying down continue",
    Level.LIMIT: "the robot continues within limits",
    Level.NOTICE: "the fault is reported",
}
RECOVERIES = {
    Level.DAMPING: "`quadvel mode passive`, then `stand_up`",
    Level.STANCE: "when the cause is gone: `quadvel mode stance`, and a zero velocity",
    Level.LIMIT: "automatically",
    Level.NOTICE: "automatically",
}
PAGE = """\
# Faults and the robot's responses

The supervisor checks the reported state and the joint command at every control tick, 200 times per second. It
describes each fault in one sentence: in the log of `quadvel up`, in `quadvel status`, on `/diagnostics`, and in
`fault` and `reason` of `controller/state`. Every limit is a parameter of the node `controller`; its default is in
brackets. The joints of a robot in passive or fault mode only brake.

An unusable state is refused and counted. If no usable state comes for `max_state_age`, the fault is named after the
reason of the refusal. A simulated robot whose time stands still, because it is paused or waits for an answer, reports
this on the topic `waiting`; that is no fault.

`python -m quadvel_policy.faults` prints this page. One test causes every row, and another one checks that the first
test fails without the guard. `python -m quadvel_lab.topic_faults` starts a simulated robot and causes the faults on its
topics. `make faults` makes sensors, links and processes of a simulated robot fail at random times, and measures the
[reaction times](results/faults.md).

{tables}

Faults that are not detected as such: a sensor that is late but consistent. An encoder with a delay of 80 ms goes
unnoticed; an IMU with that delay was noticed in 19 of 20 walks by what follows from it (`estimate_wrong`,
`joint_too_fast`). A gyroscope or an orientation that alone stays constant while the trunk hardly turns, and an
unintended command, are not detected either. A robot whose IMU freezes while it walks brakes without orientation, and
falls in about one of five cases.

If the controller dies or hangs and sends no commands, the next component brakes: the driver after its
`command_timeout`, the robot's board and the simulator 20 ms after the last packet.

On a Go2, the driver stops the joints without the controller if another program writes `rt/lowcmd` or is connected to
it, or if the robot's own controller is back: it brakes for half a second, then sends nothing until it is started again.
Its sentence is on `/diagnostics` and in `quadvel status` ([robot_go2.md](robot_go2.md)).
"""


@attrs.frozen
class Row:
    """One row of the table.

    Attributes:
        name: Name of the fault.
        level: Response.
        modes: Modes in which it has an effect.
        condition: When it is found, one or more sentences.
    """

    name: str
    level: Level
    modes: tuple[str, ...]
    condition: str


def table() -> list[Row]:
    """Return all faults.

    Returns:
        The rows, those of guards first.
    """
    return [
        *(
            Row(guard.name(), guard.level, guard.modes, _first_paragraph(guard.__doc__ or ""))
            for guard in GUARDS
        ),
        *(Row(name, *fields) for name, fields in SUPERVISOR_FAULTS.items()),
        *(Row(name, Level.LIMIT, MOVING_MODES, condition) for name, condition in LIMITS.items()),
    ]


def page() -> str:
    """Return the text of docs/faults.md.

    Returns:
        Markdown.
    """
    return PAGE.format(tables="\n\n".join(_level_table(level) for level in sorted(Level, reverse=True)))


def _level_table(level: Level) -> str:
    rows = [row for row in table() if row.level is level]
    head = f"## {level.name.capitalize()}: {RESPONSES[level]}\n\nHow it ends: {RECOVERIES[level]}."
    lines = [f"| `{row.name}` | {_add_defaults(row.condition)} | {_mode_names(row.modes)} |" for row in rows]
    return "\n".join([head, "", "| fault | found when | in |", "|---|---|---|", *lines])


def _mode_names(modes: tuple[str, ...]) -> str:
    return "every mode that moves" if modes == MOVING_MODES else ", ".join(modes)


def _first_paragraph(docstring: str) -> str:
    """Return the first paragraph of a docstring as one line."""
    return " ".join(docstring.partition("\n\n")[0].split())


def _add_defaults(text: str) -> str:
    """Add default and unit to each parameter in backticks, as in `max_tilt` (1.05 rad)."""
    values = dict(_parameter_defaults())
    return re.sub(r"`(\w+)`", lambda name: f"{name[0]} ({values[name[1]]})", text)


def _parameter_defaults() -> Iterator[tuple[str, str]]:
    for field in parameter_fields(SupervisorConfig).values():
        *_, unit = field.metadata["description"].rpartition(", ")
        yield (
            field.name,
            f"{field.default:g} {unit}" if len(unit) < len("rad/s^2 x") else f"{field.default:g}",
        )


if __name__ == "__main__":
    print(page(), end="")
