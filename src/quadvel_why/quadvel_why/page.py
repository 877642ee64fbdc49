"""Prints docs/why.md: `python -m quadvel_why.page`. Its table comes from the docstrings of the causes."""

from __future__ import annotations

from .cause import Cause, Link
from .diagnosis import healthy_values
from .links import CAUSES

LINKS = {
    Link.CONTRACT: "do robot, driver and controller mean the same by order, sign, zero, unit, frame, scale and memory?",
    Link.TIMING: "do states come, does the policy run at its rate, and do commands act, each once and soon?",
    Link.SENSORS: "does each sensor follow what the others show?",
    Link.ESTIMATOR: "does the estimated velocity agree with the planted feet?",
    Link.DRIVES: "do the drives give the torque that is asked for, and do the joints move?",
    Link.GROUND: "do the feet hold, and are slope, roughness and load those of the training?",
    Link.TASK: "was the robot asked for something that it can do?",
}
PAGE = """\
# Why did it fail? From a recording to its cause

`quadvel why` reads the recording of a run that failed and names the first link that breaks in the
chain contract, timing, sensors, estimator, drives, ground, task. The contract is what robot, driver
and controller have to agree on: order, sign, zero, unit and frame of all values.

    quadvel record --out fall.mcap       # while it happens; Ctrl-C stops
    quadvel why fall.mcap                # names the cause; writes out/why/why.json and why.png
    quadvel why fall.mcap --policy mine.onnx
    quadvel why out/faults/*.mcap        # all faults of `quadvel record --ring`, each with its own folder
    quadvel why walk.npz --gains 35 0.5  # joints of another robot, as `quadvel identify` reads them

![Torque of a joint, and the torque that its command asks for](images/why.png)

| exit code | meaning |
|---|---|
| 0 | every link holds, as far as the recording shows |
| 1 | a link breaks; it is named |
| 2 | a wrong argument or file |

The answer is one cause: the first that is found. Later ones may be its consequences, so they are
not examined. Repair it, record again and ask again. If two causes look the same in the recording,
both are named, with the experiment that distinguishes them.

A recording of this stack holds everything that the causes need. In `LowState` and `LowCmd` of
another robot, and in a table, kinematics and policy are missing. The causes that need them are then
not examined, and the answer lists them.

The limits are those of healthy walks. Other motions and drives with friction can exceed them. Of a
robot that hangs, whose feet carry less than half of its weight, nothing about feet and ground is
examined; of one that only stands, no gains. If the recording reports no walk, the answer has a
note; `quadvel identify` is for such logs.

A policy of another project (`quadvel policy import`) is not replayed; `--policy none` does
the same for one of this project.

## How a cause is found

Each cause is one physical check that gives a number: the torque against the PD law of the commands,
the slope of an angle against its reported speed, the turn of the orientation against the gyroscope,
the accelerometer against the vertical, planted feet against each other and against the trunk. The
policy is replayed on what was recorded. If its actions are not the recorded ones, other scales and
orders of the observation are tried, another scale of the actions, older states, and a memory that
is cleared during the walk. The right hypothesis reproduces the actions to the digit.

A cause is found if its number exceeds its limit. For delay, load and slope this is the range of the
training. For all others it is the smallest number that is worth naming, or 1.5 times the largest
number of {healthy} healthy walks if that is more. The walks that set the limits differ from those of
the test in seed and simulated robot. With
no false alarm in n walks, the rate of false alarms is below 3 / n at a confidence of 95 %.

`python -m benchmarks.why.score` measures the diagnosis on walks with hidden defects, injected by
code that shares nothing with it ([results](results/why.md)). `python -m quadvel_why.page` prints
this page.

{tables}
"""


def page() -> str:
    """Return the text of docs/why.md.

    Returns:
        Markdown.
    """
    tables = "\n\n".join(_table(link) for link in Link)
    return PAGE.format(tables=tables, healthy=int(healthy_values().get("walks", 0)))


def _table(link: Link) -> str:
    rows = [
        f"| `{cause.name()}` | {_first_paragraph(cause)} | {_limit(cause)} | {cause.remedy} |"
        for cause in CAUSES
        if cause.link is link
    ]
    head = f"## {link.value.capitalize()}: {LINKS[link]}"
    return "\n".join([head, "", "| cause | found when | limit | what to do |", "|---|---|---|---|", *rows])


def _first_paragraph(cause: type[Cause]) -> str:
    return " ".join((cause.__doc__ or "").partition("\n\n")[0].split())


def _limit(cause: type[Cause]) -> str:
    return f"{cause.least:g} {cause.unit}" if cause.least else "range of the training"


if __name__ == "__main__":
    print(page(), end="")
