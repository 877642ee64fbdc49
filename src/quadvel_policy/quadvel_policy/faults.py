"""The table of faults, out of the guards themselves: `python -m quadvel_policy.faults` prints docs/faults.md."""

from __future__ import annotations

import re
from collections.abc import Iterator

import attrs

from .command_limits import LIMITS
from .guard import MOVING, Level
from .guards import GUARDS
from .supervisor import OTHER_FAULTS, SupervisorConfig

WHAT_IS_DONE = {
    Level.DAMPING: "every joint brakes at once",
    Level.STANCE: "a walking robot brakes on its policy and stands; standing up and lying down go on",
    Level.LIMIT: "the robot goes on within bounds",
    Level.NOTICE: "it is told",
}
HOW_IT_ENDS = {
    Level.DAMPING: "`quadvel mode passive`, then `stand_up`",
    Level.STANCE: "once the cause is gone: `quadvel mode stance`, and a zero velocity",
    Level.LIMIT: "by itself",
    Level.NOTICE: "by itself",
}
PAGE = """\
# What can go wrong, and what the robot does then

The supervisor looks at every control tick, 200 times a second, at what the robot reports and at what its joints are to be asked
for. What it finds is told in words: in the log of `quadvel up`, by `quadvel status`, on `/diagnostics`, and in `fault`
and `reason` of `controller/state`. Every limit is a parameter of the node `controller`; its default stands in brackets. Where a
robot is passive or in fault, its joints brake and nothing more happens to it.

A state that cannot be used is refused and counted. If no fit one comes for `max_state_age`, the fault is named after what was
wrong. A simulated robot whose time stands still, since it is paused or waits for an answer, says so on the topic `waiting`, and
that is no fault.

This page is printed by `python -m quadvel_policy.faults`; a test brings about every row, and another one sees the first fail
without its guard. `python -m quadvel_bringup.topic_faults` brings them about on the topics of a running robot. `make faults`
lets sensors, links and processes fail at random instants of a simulated robot's life, and measures
[how soon it reacts](results/faults.md).

{tables}

What it cannot see: a sensor that is late but agrees with itself, as an IMU or an encoder whose readings come 80 ms late; a
gyroscope or an orientation alone that stands still while the trunk hardly turns; a command that somebody did not mean. A robot
whose IMU freezes while it walks brakes blind, and falls in about one of three cases.

Where nobody commands the joints any more, because the controller has died or hangs, the next in line brakes: the driver after
its `command_timeout`, the robot's board and the simulator by themselves 20 ms after the last packet.
"""


@attrs.frozen
class Row:
    """One fault. notices: when it is found, one or more sentences."""

    name: str
    level: Level
    modes: tuple[str, ...]
    notices: str


def table() -> list[Row]:
    """Every fault there is, those of guards first."""
    return [
        *(Row(guard.name(), guard.level, guard.modes, _sentence(guard.__doc__ or "")) for guard in GUARDS),
        *(Row(name, *fields) for name, fields in OTHER_FAULTS.items()),
        *(Row(name, Level.LIMIT, MOVING, notices) for name, notices in LIMITS.items()),
    ]


def page() -> str:
    """docs/faults.md."""
    return PAGE.format(tables="\n\n".join(_of_level(level) for level in sorted(Level, reverse=True)))


def _of_level(level: Level) -> str:
    rows = [row for row in table() if row.level is level]
    head = f"## {level.name.capitalize()}: {WHAT_IS_DONE[level]}\n\nHow it ends: {HOW_IT_ENDS[level]}."
    lines = [f"| `{row.name}` | {_with_values(row.notices)} | {_where(row.modes)} |" for row in rows]
    return "\n".join([head, "", "| fault | found when | in |", "|---|---|---|", *lines])


def _where(modes: tuple[str, ...]) -> str:
    return "every mode that moves" if modes == MOVING else ", ".join(modes)


def _sentence(docstring: str) -> str:
    return " ".join(docstring.split())


def _with_values(text: str) -> str:
    """Each parameter that is named with its default and unit, as `max_tilt` (1.05 rad)."""
    values = dict(_settings())
    return re.sub(r"`(\w+)`", lambda name: f"{name[0]} ({values[name[1]]})", text)


def _settings() -> Iterator[tuple[str, str]]:
    for field in attrs.fields(SupervisorConfig):
        *_, unit = field.metadata["description"].rpartition(", ")
        yield (
            field.name,
            f"{field.default:g} {unit}" if len(unit) < len("rad/s^2 x") else f"{field.default:g}",
        )


if __name__ == "__main__":
    print(page(), end="")
