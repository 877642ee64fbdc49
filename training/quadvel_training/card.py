"""Model card of a policy or estimator file, from its metadata and evaluations, as Markdown.

Nothing is measured here. The only statement that does not follow from these files is that no robot
was involved.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from quadvel_description.network_file import metadata_texts, read_network
from quadvel_description.recurrent_network import METADATA_KEY
from quadvel_description.robot import load_robot
from quadvel_description.robot_name import UNNAMED_ROBOT, shipped_robots
from quadvel_estimator.features import KIND
from quadvel_eval.compare import comparison_figures, read_evaluation

Json = Mapping[str, Any]
UNITS = {"vx": "m/s", "vy": "m/s", "wz": "rad/s"}


def card(network: Path, evaluations: Sequence[Path], paper: Path | None = None) -> str:
    """Write the text of a model card.

    Args:
        network: policy or estimator file.
        evaluations: results of `quadvel eval`, files or folders.
        paper: folder of `quadvel paper`; its gait, sustained and slopes sections go into a policy's
            card.

    Returns:
        Markdown.

    Raises:
        ValueError: results of another network.
        FileNotFoundError: a file is missing.
    """
    metadata, found = _metadata(network), [read_evaluation(path) for path in evaluations]
    estimator = metadata.get("kind") == KIND
    for path, one in zip(evaluations, found, strict=True):
        _check_belongs(network, one["setup"]["estimator_file" if estimator else "policy"], path)
    limits = _estimator_limits if estimator else _policy_limits
    digest = hashlib.sha256(network.read_bytes()).hexdigest()[:12]
    return "\n".join(
        [
            f"# {network.name}",
            "",
            (ESTIMATOR if estimator else POLICY).format(robot=_title(metadata)),
            f"Written by `python -m quadvel_training card` from the file (SHA-256 {digest}...) and evaluations; do not edit.",
            "",
            *_table("how it was made", "", _origin(metadata)),
            "",
            *(line for one in found for line in (*_measured(one, estimator), "")),
            *(line for name in TABLES if paper for line in (*_section(network, paper / name), "")),
            "Known limits:",
            "",
            *(f"- {limit}" for limit in (_paper_limits(network, paper) if paper else ())),
            *(f"- {limit}" for limit in limits(metadata, found)),
            "- Trained and evaluated in simulation alone.",
            "",
        ]
    )


POLICY = "A recurrent policy for velocity tracking of the {robot}, one step at 200 Hz; metadata in the file say how to run it."
ESTIMATOR = "A recurrent estimator of the {robot}'s linear velocity from IMU, encoders and torques, one step at 200 Hz."


def _title(metadata: Json) -> str:
    """Return the title of the robot that a file belongs to; that of a user's robot is its name."""
    name: str = metadata.get("robot", UNNAMED_ROBOT)
    return load_robot(name).title if name in shipped_robots() else name


def _metadata(network: Path) -> dict[str, Any]:
    """Read the metadata of a network file."""
    texts = metadata_texts(read_network(network))
    if METADATA_KEY not in texts:
        raise ValueError(f"{network}: no metadata {METADATA_KEY}, expected a policy or an estimator")
    found: dict[str, Any] = json.loads(texts[METADATA_KEY])
    return found


def _check_belongs(network: Path, evaluated: str, evaluation: Path) -> None:
    """Raise ValueError if an evaluation is of another network."""
    other = Path(evaluated)
    same = other.read_bytes() == network.read_bytes() if other.exists() else other.name == network.name
    if not same:
        raise ValueError(f"{evaluation}: is an evaluation of {evaluated}, expected one of {network}")


def _origin(metadata: Json) -> Iterable[tuple[str, str]]:
    """Yield rows about the training."""
    recipe = metadata.get("recipe") or {}
    for name in ("stage", "recipe", "samples"):
        value = recipe.get(name, "not kept")
        yield name, f"{value:,}" if isinstance(value, int) else str(value)
    yield "hours of training", str(recipe.get("hours") or "not kept")
    for field, setting in recipe.get("configuration", {}).items():
        yield f"`{field}`", f"`{json.dumps(setting)}`"
    yield "commit", metadata["commit"]
    if "actuator" in metadata:
        yield "actuator model", _actuator_text(metadata["actuator"])


def _actuator_text(actuator: Json | None) -> str:
    """Describe the actuator model in one line."""
    if not actuator:
        return "not kept"
    delays = [1e3 * (pair["input_delay_s"] + pair["output_delay_s"]) for pair in actuator["pairs"]]
    effects = ", ".join(effect["name"] for effect in actuator["effects"]) or "none"
    return (
        f"{actuator['name']}: ΔKp {actuator['delta_kp']} N m/rad, ΔKd {actuator['delta_kd']} N m s/rad, "
        f"delays together {min(delays):.1f} to {max(delays):.1f} ms, effects beyond the EAM: {effects}"
    )


def _conditions(setup: Json) -> str:
    """Describe the conditions of an evaluation."""
    drawn = "drawn at random" if setup["randomised"] else "nominal"
    seeds = "1 seed" if setup["seeds"] == 1 else f"{setup['seeds']} seeds"
    return f"{setup['grid']} grid, {seeds}, {setup['terrain']} ground, {drawn} robot, {setup['estimator']} estimator"


def _measured(found: Json, estimator: bool) -> list[str]:
    """Return the table of an evaluation; for an estimator, its figures alone."""
    rows = [
        (name, _number(value))
        for name, value in comparison_figures(found).items()
        if not estimator or "estimator" in name or name in ("runs", "falls")
    ]
    return _table(f"evaluation: {_conditions(found['setup'])}", "measured", rows)


TABLES = ("gait.json", "sustained.json")
SECTIONS = (*TABLES, "slopes.json")
Rows = Sequence[tuple[str, str, float | None]]
"""Name, unit and value of a figure"""


def _read_section(network: Path, file: Path) -> Rows:
    """Read a section of `quadvel paper`; raise ValueError for another network."""
    content = json.loads(file.read_text())
    digest = hashlib.sha256(network.read_bytes()).hexdigest()
    names = [name for name, made in content["made_with"]["policies"].items() if digest.startswith(made)]
    if not names:
        raise ValueError(f"{file}: made with {content['made_with']['policies']}, expected {digest[:12]}")
    return [(row["what"], row["unit"], row["ours"][names[0]]) for row in content["rows"]]


def _section(network: Path, file: Path) -> list[str]:
    """Return the table of a section of `quadvel paper`."""
    rows = [
        (f"{what}, {unit}" if unit else what, _number(value))
        for what, unit, value in _read_section(network, file)
    ]
    return _table(f"`quadvel paper`: {file.stem}", "measured", rows)


def _paper_limits(network: Path, paper: Path) -> Iterable[str]:
    """Yield limits shown by sections of `quadvel paper`: kind of gait, speed of the drives, slopes."""
    gait, sustained, slopes = (_read_section(network, paper / name) for name in SECTIONS)
    yield from _gait_limit(gait)
    yield from _drive_limits(sustained)
    yield from _slope_limits(slopes)


def _gait_limit(rows: Rows) -> Iterable[str]:
    """Yield the kind of gait at 0.5 m/s."""
    found = {what: value for what, _, value in rows}
    names = ("feet of one side alike", "diagonal feet alike", "gait frequency")
    side, diagonal, steps = (found.get(f"0.5 m/s: {name}") for name in names)
    if side is None or diagonal is None or steps is None:
        return
    kind = "pace, not a trot" if side > diagonal else "trot"
    yield (
        f"Its gait is a {kind}: at 0.5 m/s feet of one side are alike in contact {side:.0f} % of the time, "
        f"diagonal feet {diagonal:.0f} %, at {steps:.1f} steps a second."
    )


def _drive_limits(rows: Rows) -> Iterable[str]:
    """Yield the fastest joint of each plant, at the commands of the section."""
    fastest: dict[str, float] = {}
    for what, _, value in rows:
        where, _, drive = what.rpartition(": ")
        if drive.startswith("fastest joint") and value is not None:
            plant = where.rpartition(", ")[0] or "usual plant"
            fastest[plant] = max(fastest.get(plant, 0.0), value)
    for plant, share in fastest.items():
        yield f"On the {plant}, on straight walks and spins, joints reach {share:.2f} of their drives' speed."


def _slope_limits(rows: Rows) -> Iterable[str]:
    """Yield how many slopes all robots walk, and those on which robots fell or were stuck."""
    measured = {what.rpartition(": ")[0]: value for what, _, value in rows if "survive and follow" in what}
    shares = {where: value for where, value in measured.items() if value is not None}
    walked = sum(value == 100.0 for value in shares.values())
    yield f"All robots walk and follow on {walked} of {len(shares)} combinations of slope, plant and start."
    for where, value in shares.items():
        if value < 100.0:
            yield f"Slopes, {where}: {100.0 - value:.0f} % of the robots fall, are stuck, or are off by more than 0.15 m/s."


def _policy_limits(metadata: Json, found: Sequence[Json]) -> Iterable[str]:
    """Yield the known limits of a policy."""
    limits = metadata["command_limits"]
    spans = ", ".join(
        f"{axis} {limits[axis][0]:g} to {limits[axis][1]:g} {unit}" for axis, unit in UNITS.items()
    )
    yield f"Commands beyond {spans} are cut to that."
    if curve := metadata.get("curve_limit"):
        yield "Together vx and vy are held to the ellipse that these limits span; r is the part of it that they use."
        yield f"In curves |wz| is cut to {curve:g} m/s² √(1 - r²) / v, v the speed."
    yield f"Its gains are part of it: kp {_value_or_range(metadata['kp'])} N m/rad, kd {_value_or_range(metadata['kd'])} N m s/rad."
    for one in found:
        where, stood = _conditions(one["setup"]), [cell for cell in one["cells"] if not cell["fell"]]
        fell = sorted({_command(cell) for cell in one["cells"] if cell["fell"]})
        if fell:
            share = f"{one['falls']} of {len(one['cells'])} runs"
            yield f"On the {where}: fell in {share}, at commands (vx, vy, wz) {'; '.join(fell)}."
        if stood:
            worst = max(stood, key=lambda cell: cell["error_xy"])
            yield f"On the {where}: furthest off at the command {_command(worst)}, {worst['error_xy']:.3f} m/s."


def _estimator_limits(metadata: Json, found: Sequence[Json]) -> Iterable[str]:
    """Yield the known limits of an estimator."""
    policies = ", ".join(sorted({Path(one["setup"]["policy"]).name for one in found}))
    yield f"Measured on walks under {policies} that ended on their feet; other gaits were not tried."


def _command(cell: Json) -> str:
    """Format the command of a cell."""
    return "({:g}, {:g}, {:g})".format(*cell["command"])


def _value_or_range(values: Any) -> str:
    """Format one number if all are equal, else their range."""
    numbers = sorted(set(values))
    return f"{numbers[0]:g}" if len(numbers) == 1 else f"{numbers[0]:g} to {numbers[-1]:g}"


def _number(value: float | None) -> str:
    """Format a figure; a dash if it is missing."""
    return "–" if value is None else f"{value:.4g}"


def _table(head: str, second: str, rows: Iterable[tuple[str, str]]) -> list[str]:
    """Return the lines of a table."""
    return [f"| {head} | {second} |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
