"""Parameters of the empirical actuator model and their YAML file.

`quadvel_actuator.model` computes torques from these parameters. Each robot has a file; the
AlienGo's is Table 4 of the paper.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import yaml

from quadvel_description.bounded_yaml import read_yaml
from quadvel_description.fields import Numbers, field, positive, refusal
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.records import structure_record
from quadvel_description.robot import Robot
from quadvel_description.robot_name import UNNAMED_ROBOT

SCHEMA = 1
DEFAULT_JOINT_COUNT = 12
PROBABLE_ERROR_RATIO = 1.5  # pairs below this multiple of the least error are probable (Section 3.1)

_COMMENTS = {
    "kp_ref": "Gains at which the deviations were identified (N m/rad, N m s/rad).",
    "delta_kp": "Deviation of the gains, Eq. 2: one number, one per hip, thigh and calf, or one per joint "
    "(N m/rad, N m s/rad).",
    "pairs": "Delays of command and torque (s), and the pair's mean squared torque error (N^2 m^2).",
    "torque_noise": "Variance of the torque noise (N^2 m^2).",
    "torque_limit": "Largest torque: one number, one per hip, thigh and calf, or one per joint (N m).",
    "joints": "Names of the joints in order; without them those of the AlienGo.",
    "effects": "What the model adds to the PD law: name, joints, parameters, units and intervals of each.",
}


def _to_tuple(values: Iterable[Any]) -> tuple[Any, ...]:
    """Convert any sequence to a tuple."""
    return tuple(values)


@attrs.frozen
class DelayPair:
    """One pair of delays and the error of the model that has them.

    Attributes:
        input_delay_s: s, delay of the command on its way to the drive, t_i of Eq. 1.
        output_delay_s: s, delay from the drive's torque to the torque on the joint, t_o of Eq. 1.
        mse: N^2 m^2, mean squared torque error of a model with these delays.
    """

    input_delay_s: float = field(at_least=0.0)
    output_delay_s: float = field(at_least=0.0)
    mse: float = field(at_least=0.0)


@attrs.frozen
class Effect:
    """One effect beyond the PD law, as an entry of the parameter file.

    Attributes:
        name: name in the registry (`quadvel_actuator.effects.registry`).
        joints: names of the joints that the effect acts on.
        parameters: values by name: one number for all of these joints, or one per joint; and the
            settings of the effect, which are words.
        units: unit of each parameter, for readers of the file.
        intervals: [low, high] by parameter name, or one such pair per joint. Domain randomisation
            draws from them.
    """

    name: str
    joints: tuple[str, ...] = attrs.field(converter=_to_tuple)
    parameters: Mapping[str, Any]
    units: Mapping[str, str] = attrs.field(factory=dict)
    intervals: Mapping[str, Any] = attrs.field(factory=dict)

    def __attrs_post_init__(self) -> None:
        if not self.joints:
            raise refusal(self, "joints", self.joints, "names of joints")


def _on_all_joints(effect: Effect) -> Effect:
    """Extend an effect of one joint to the joints of a robot."""
    words = [name for name, value in effect.parameters.items() if np.asarray(value).dtype.kind == "U"]
    if any("/" in str(effect.parameters[name]) for name in words):
        raise refusal(effect, "parameters", dict(effect.parameters), "an effect that names no other joint")
    return attrs.evolve(
        effect,
        joints=JOINT_NAMES,
        parameters={
            name: value if name in words else _only(value) for name, value in effect.parameters.items()
        },
        intervals={name: np.reshape(pair, 2).tolist() for name, pair in effect.intervals.items()},
    )


def _only(value: Any) -> float:
    """Return the only one of some numbers."""
    return float(np.reshape(value, -1).item())


@attrs.frozen(kw_only=True)
class ActuatorParameters:
    """Parameters of the empirical actuator model (Eq. 1 and 2 of the paper), in SI units.

    A wrong value raises a ValueError that names the field, the value found and the expected one.
    `robots/aliengo/actuator.yaml` of `quadvel_description` is an example of the file.

    Attributes:
        schema: version of the file format, `SCHEMA`.
        name: name of the actuators, for people.
        robot: name of the robot; UNNAMED_ROBOT if a file has none.
        kp_ref: N m/rad, proportional gain at which the deviations were identified.
        kd_ref: N m s/rad, derivative gain at which the deviations were identified.
        delta_kp: N m/rad, deviation of the proportional gain at `kp_ref`: one number, three (hip,
            thigh, calf) or one per joint.
        delta_kd: N m s/rad, deviation of the derivative gain at `kd_ref`; shape as `delta_kp`.
        pairs: delays with their errors, at least one.
        torque_noise: N^2 m^2, variance of the torque noise.
        torque_limit: N m, largest torque; shape as `delta_kp`.
        effects: what the model adds to the PD law.
        joints: joint names in order; empty for those of the AlienGo.
    """

    schema: int = field(one_of=(SCHEMA,), whole=True)
    name: str
    robot: str = field(UNNAMED_ROBOT)
    kp_ref: float = positive()
    kd_ref: float = positive()
    delta_kp: Numbers = field(at_least=-np.inf)
    delta_kd: Numbers = field(at_least=-np.inf)
    pairs: tuple[DelayPair, ...] = attrs.field(converter=_to_tuple)
    torque_noise: float = field(at_least=0.0)
    torque_limit: Numbers = positive()
    effects: tuple[Effect, ...] = attrs.field(converter=_to_tuple, default=())
    joints: tuple[str, ...] = attrs.field(converter=_to_tuple, default=())

    def __attrs_post_init__(self) -> None:
        joint_count = len(self.joints) or DEFAULT_JOINT_COUNT
        for name in ("delta_kp", "delta_kd", "torque_limit"):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) not in (3, joint_count):
                raise refusal(self, name, value, f"a number, 3 numbers or {joint_count} numbers")
        if not self.pairs:
            raise refusal(self, "pairs", self.pairs, "at least one pair")

    @property
    def best_pair(self) -> DelayPair:
        """Pair of delays with the least error; the first of several."""
        return min(self.pairs, key=lambda pair: pair.mse)

    @property
    def probable_pairs(self) -> tuple[DelayPair, ...]:
        """Pairs for randomisation: error below 1.5 times the least one (Section 3.1)."""
        least = self.best_pair.mse
        return tuple(
            pair for pair in self.pairs if pair.mse < PROBABLE_ERROR_RATIO * least or pair.mse == least
        )

    @classmethod
    def load(cls, robot: Robot | None, path: str | Path, some_joints: bool = False) -> ActuatorParameters:
        """Read a parameter file.

        Args:
            robot: The robot that the file has to belong to; None: any.
            path: YAML file.
            some_joints: Whether it may hold some joints only.

        Returns:
            The parameters.

        Raises:
            ValueError: the file is no valid parameter file, or that of another robot; the message
                names the file, the field, the value found and the expected one.
        """
        content = read_yaml(Path(path), "a YAML file of actuator parameters")
        parameters = structure_record(cls, content, Path(path))
        if robot is not None and parameters.robot != robot.name:
            found = refusal(cls, "robot", parameters.robot, repr(robot.name))
            raise ValueError(f"{path}: {found}: identify the logs with --robot {robot.name}")
        if not some_joints and len(names := parameters.joints or JOINT_NAMES) != len(JOINT_NAMES):
            raise ValueError(
                f"{path}: joints: found {len(names)} ({', '.join(names)}), expected all {len(JOINT_NAMES)} of the "
                "robot: identify logs of all of them, without --joints, or give the drive of one joint to all "
                "(ActuatorParameters.on_all_joints, tutorial 3)"
            )
        return parameters

    def save(self, path: str | Path) -> None:
        """Write the parameters as YAML with units in comments; `load` is the inverse.

        Args:
            path: file to write.
        """
        lines: list[str] = []
        for key, value in attrs.asdict(self).items():
            if key in _COMMENTS:
                lines += ["", f"# {_COMMENTS[key]}"]
            flow = None if isinstance(value, list) else False  # of a list of records, one line each
            text = yaml.safe_dump({key: value}, default_flow_style=flow, sort_keys=False, width=110)
            lines.append(text.rstrip())
        Path(path).write_text("\n".join(lines) + "\n")

    def on_all_joints(self, robot: Robot) -> ActuatorParameters:
        """Give the drive of one joint, as a test bench measures it, to every joint of a robot.

        Args:
            robot: The robot, which keeps its torque limits.

        Returns:
            The parameters of the robot.

        Raises:
            ValueError: These are of more joints than one, or an effect names another joint.
        """
        if len(self.joints) != 1:
            raise refusal(self, "joints", self.joints or JOINT_NAMES, "one joint")
        return attrs.evolve(
            self,
            robot=robot.name,
            delta_kp=_only(self.delta_kp),
            delta_kd=_only(self.delta_kd),
            torque_limit=tuple(robot.torque_limit.tolist()),
            effects=tuple(_on_all_joints(effect) for effect in self.effects),
            joints=(),
        )

    @classmethod
    def of(cls, robot: Robot) -> ActuatorParameters:
        """Read the parameters of a robot.

        Args:
            robot: The robot.

        Returns:
            The parameters in the robot's folder; without its file, those of a plain PD law.
        """
        if robot.actuator_file.exists():
            return cls.load(robot, robot.actuator_file)
        return cls(
            schema=SCHEMA,
            name=robot.name,
            robot=robot.name,
            kp_ref=robot.kp,
            kd_ref=robot.kd,
            delta_kp=0.0,
            delta_kd=0.0,
            pairs=(DelayPair(0.0, 0.0, 0.0),),
            torque_noise=0.0,
            torque_limit=tuple(robot.torque_limit.tolist()),
        )

    @classmethod
    def ideal(cls, robot: Robot) -> ActuatorParameters:
        """Return the parameters of a plain PD law.

        Args:
            robot: The robot.

        Returns:
            Those of the robot without delay, gain deviation, effects and noise; the torque limit stays.
        """
        at_once = DelayPair(0.0, 0.0, 0.0)
        return attrs.evolve(
            cls.of(robot),
            name="ideal",
            delta_kp=0.0,
            delta_kd=0.0,
            pairs=(at_once,),
            torque_noise=0.0,
            effects=(),
        )
