"""How well a model of the robot repeats a recorded run: open loop over short stretches, and in its velocity tracking.

Arrays of a recording in, errors out. Over longer stretches open loop says little: a walking robot is unstable, and
any two drift apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d
from scipy.signal import savgol_filter

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.robot import JOINT_NAMES
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand
from quadvel_nodes.messages import seconds
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_recordings.joint_log import JointLog, Series, expect_commands
from quadvel_recordings.reading import read_messages
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.simulator import DT, Simulator, Truth

from .recording import Recording
from .robot_loop import PERIOD, RobotLoop, make_estimator
from .segments import SETTLE, Segment, measure
from .walk import Setup

Array = NDArray[np.float64]

STRETCH = 0.2  # s, of one replay
STRIDE = 0.35  # s, from one to the next: no multiple of a step of the gait
STEADY = 2  # ms to either side, over which the noise of encoders is averaged out
PAST = 60  # ms, that the drives live through before
GROWTH = 10  # ms, from one point to the next of how an error grows
COMMAND = ("q", "dq", "tau", "kp", "kd")  # of a command, 12 numbers each


@attrs.frozen(eq=False)
class Joints:
    """Joint states and commands of a run, one row each ms, at `time` (n,) s; the command held at that instant."""

    time: Array
    q: Array  # (n, 12) rad
    dq: Array  # (n, 12) rad/s
    tau: Array  # (n, 12) N m
    command: Array  # (n, 61): the fields of COMMAND, mode
    seen: NDArray[np.bool_]  # (n,), false: interpolated

    def whole(self, begin: int, end: int) -> bool:
        """Whether every state of the rows from `begin` to before `end` is there and was seen."""
        return begin >= 0 and end <= len(self.seen) and bool(self.seen[begin:end].all())


@attrs.frozen
class ReplayError:
    """Root mean square of replayed minus recorded, over all joints and stretches.

    growth: the same of q (rad), over each GROWTH ms after the stretch's begin.
    """

    q: float  # rad
    dq: float  # rad/s
    tau: float  # N m
    stretches: int
    growth: tuple[float, ...]


def read_joints(path: Path, longest: float = DT, received: bool = False) -> Joints:
    """The joints' part of a recording at 1 kHz; states that the recorder missed are marked, and interpolated.

    A command counts from the instant of the state that it answers, whatever its own stamp says.

    Args:
        path: the recording.
        longest: s, from one state to the next, usually.
        received: take the times of receipt in place of the stamps.

    Raises:
        ValueError: the recording holds nothing of that rate.
    """
    states: dict[int, tuple[float, Any]] = {}
    commands: dict[int, Any] = {}
    for topic, receipt, message in read_messages(
        path, lambda topic, _: topic in ("/low_state", "/low_cmd"), _quiet
    ):
        if topic == "/low_state":
            states[message.tick] = 1e-9 * receipt if received else seconds(message.stamp), message
        else:
            commands[message.tick] = np.concatenate(
                [*(getattr(message, field) for field in COMMAND), [message.mode]]
            )
    ticks = sorted(states)
    time = np.array([states[tick][0] for tick in ticks])
    values = [
        np.array([getattr(states[tick][1], field) for tick in ticks], float) for field in ("q", "dq", "tau")
    ]
    return _every_millisecond(path, np.array(ticks), time, values, commands, longest)


def joints_of(path: Path, log: JointLog, longest: float, gains: tuple[float, float] | None) -> Joints:
    """The same of another robot's recording, whose times are rounded to ms.

    Args:
        path: the recording, for messages.
        log: what was read of it; all joints of the model have to be in it.
        longest: s, from one state to the next, usually.
        gains: kp and kd (N m/rad, N m s/rad) where the commands hold none.

    Raises:
        ValueError: a joint, the torque, the angles or the gains are missing.
    """
    state, command = log.state, expect_commands(path, log)
    for field, meaning in (("q", "angles"), ("tau", "torques")):
        if field not in state.values:
            raise ValueError(
                f"{path}: {state.topic}: found no {meaning} in it, expected them beside the commands"
            )
    values = {name: _of_model(path, state, each) for name, each in state.values.items()}
    speed = values.get("dq", np.gradient(values["q"], state.time, axis=0))
    ticks, first = np.unique(np.round(1e3 * state.time).astype(int), return_index=True)
    sent = {name: _of_model(path, command, each) for name, each in command.values.items()}
    for name, gain in zip(("kp", "kd"), gains or (None, None), strict=True):
        if name not in sent and gain is None:
            raise ValueError(f"{path}: {command.topic}: {name}: not in the recording, expected --gains KP KD")
        sent.setdefault(name, np.broadcast_to(np.float64(gain or 0.0), sent["q"].shape))
    none = np.zeros(sent["q"].shape)
    rows = np.hstack([*(sent.get(name, none) for name in COMMAND), np.full((len(none), 1), MODE_SERVO)])
    commands = dict(zip(np.round(1e3 * command.time).astype(int).tolist(), rows, strict=True))
    measured = [each[first] for each in (values["q"], speed, values["tau"])]
    return _every_millisecond(
        path, ticks, (state.time + 1e-9 * log.begin)[first], measured, commands, longest
    )


def _of_model(path: Path, series: Series, values: Array) -> Array:
    """Of the values (n, J) those of the model's joints, (n, 12), in its order. Raises ValueError."""
    named = [name.removesuffix("_joint") for name in series.joints]
    missing = [name for name in JOINT_NAMES if name.removesuffix("_joint") not in named]
    if missing:
        found = f"found {', '.join(series.joints[:3])}, ..."
        raise ValueError(
            f"{path}: {series.topic}: {found}, expected the model's joints, {missing[0]} among them"
        )
    return np.asarray(values[:, [named.index(name.removesuffix("_joint")) for name in JOINT_NAMES]], float)


def _every_millisecond(
    path: Path,
    ticks: Array,
    time: Array,
    values: Sequence[Array],
    commands: Mapping[int, Array],
    longest: float,
) -> Joints:
    """States (n, 12) of q, dq and torque at `ticks` (n,), ms, and commands by the tick that they answer, a row each ms."""
    period = np.median(np.diff(ticks)) * 1e-3 if len(ticks) > 1 else np.nan
    if not period <= longest or not commands:
        raise ValueError(
            f"{path}: low_state: found a period of {period:g} s and {len(commands)} commands, expected {longest:g} s"
            " at most, and commands"
        )
    every = np.arange(ticks[0], ticks[-1] + 1)
    q, dq, tau = (interp1d(ticks, each, axis=0)(every) for each in values)
    return Joints(np.interp(every, ticks, time), q, dq, tau, _held(commands, every), np.isin(every, ticks))


def _held(commands: Mapping[int, Array], ticks: Array) -> Array:
    """The command held at each of the ticks (n,), (n, 61); before the first one the robot brakes."""
    sent = sorted(commands)
    table = np.array([np.zeros(12 * len(COMMAND) + 1), *(commands[tick] for tick in sent)], float)
    held: Array = table[np.searchsorted(sent, ticks, side="right")]
    return held


def _quiet(_: str) -> None:
    """What a reader assumes was said when the recording was read first."""


def modelled_torque(actuator: ActuatorParameters, joints: Joints, first: int, stop: int) -> Array:
    """What `actuator` says of the recorded commands and motion, (rows, 12) N m, for the rows from `first` to before `stop`.

    Noise of encoders is averaged out. What lies before `first` is not known to the drives' delays.
    """
    q, dq = (savgol_filter(values, 2 * STEADY + 1, 1, axis=0) for values in (joints.q, joints.dq))
    model = ActuatorModel(attrs.evolve(actuator, torque_noise=0.0), dt=DT)
    found = np.empty((stop - first, 12))
    for row in range(first, stop):
        c = _command(joints, row)
        found[row - first] = model.step(q[row], dq[row], c.q, c.kp, c.kd, c.dq, c.tau)
    return found


def torque_error(actuator: ActuatorParameters, joints: Joints, start: float, end: float) -> float:
    """Mean square of measured minus modelled torque, N^2 m^2, on the recorded motion between `start` and `end`.

    The drives acted on the motion itself, so that what encoders add to it is averaged out.
    """
    begin, stop = np.searchsorted(joints.time, [start, end]).tolist()
    first = max(begin - PAST, 0)
    off = joints.tau[first:stop] - modelled_torque(actuator, joints, first, stop)
    squares = [
        np.mean(off[row - first] ** 2) for row in range(begin, stop) if joints.whole(row - PAST, row + 1)
    ]
    if not squares:
        raise ValueError(f"nothing was recorded without gaps between {start:.2f} and {end:.2f} s")
    return float(np.mean(squares))


def open_loop(
    actuator: ActuatorParameters, joints: Joints, truth: Callable[[float], Truth], start: float, end: float
) -> ReplayError:
    """Replay stretches of the commands between `start` and `end` (s) on a robot with `actuator`, without noise.

    Each stretch begins in the recorded state; truth(t) tells the trunk's.
    """
    quiet = attrs.evolve(actuator, torque_noise=0.0)
    simulator = Simulator(SimulatorConfig(actuator=quiet, noise=SensorNoise.none()))
    errors = [
        _stretch(simulator, joints, truth, row)
        for row in np.searchsorted(joints.time, np.arange(start, end - STRETCH, STRIDE)).tolist()
        if joints.whole(row - PAST, row + round(STRETCH / DT))
    ]
    if not errors:
        raise ValueError(f"nothing to replay between {start:.2f} and {end:.2f} s")
    squares = np.mean(errors, axis=0)
    q, dq, tau = np.sqrt(squares.mean(axis=0)).tolist()
    growth = np.sqrt(squares[:, 0].reshape(-1, GROWTH).mean(axis=1))
    return ReplayError(q, dq, tau, len(errors), tuple(growth.tolist()))


def _stretch(simulator: Simulator, joints: Joints, truth: Callable[[float], Truth], row: int) -> Array:
    """Mean squares over the joints of the errors of q, dq and torque, (n, 3), a row each ms from `row` on."""
    past = [(joints.q[i], joints.dq[i], _command(joints, i)) for i in range(row - PAST, row)]
    simulator.set_state(truth(joints.time[row]), joints.q[row], joints.dq[row], past)
    squares = np.empty((round(STRETCH / DT), 3))
    for i, square in enumerate(squares, start=row):
        simulator.command(_command(joints, i))
        state = simulator.state()
        found = (joints.q[i] - state.q, joints.dq[i] - state.dq, joints.tau[i] - state.tau)
        square[:] = [np.mean(error**2) for error in found]
        simulator.step()
    return squares


def _command(joints: Joints, row: int) -> JointCommand:
    q, dq, tau, kp, kd, mode = np.split(joints.command[row], range(12, 12 * len(COMMAND) + 1, 12))
    return JointCommand(q, dq, tau, kp, kd, MODE_SERVO if mode else MODE_DAMPING)


def trunk_at(recording: Recording) -> Callable[[float], Truth]:
    """The recorded truth at the sample next to a time."""

    def truth(time: float) -> Truth:
        row = int(np.abs(recording.position.time - time).argmin())
        velocity = recording.velocity.value[row]
        return Truth(
            time=time,
            tick=0,
            position=recording.position.value[row],
            quaternion=recording.quaternion.value[row],
            linear_velocity=velocity[:3],
            angular_velocity=velocity[3:],
            contact=np.zeros(4, bool),
            contact_force=np.zeros((4, 3)),
        )

    return truth


def predicted_tracking(
    actuator: ActuatorParameters, commands: Sequence[tuple[Array, float]], seed: int
) -> list[Segment]:
    """The velocities that a model with `actuator` shows under the shipped policy: each command for its seconds."""
    setup = Setup()
    simulator = Simulator(SimulatorConfig(actuator=actuator, seed=seed))
    simulator.reset("stand")
    supervisor = Supervisor(PolicyFile(SHIPPED_POLICY))
    loop = RobotLoop(simulator, supervisor, make_estimator(setup.estimator, simulator, setup.estimator_file))
    loop.start_walking()
    segments = []
    for command, duration in commands:
        begin, times, velocities = simulator.time, [], []
        for _ in range(round(duration / PERIOD)):
            truth = loop.tick(command).truth
            times.append(truth.time)
            velocities.append([*truth.linear_velocity[:2], truth.angular_velocity[2]])
        segments.append(measure(times, velocities, command, begin + SETTLE, begin + duration))
    return segments


def tracking_gap(plant: Sequence[Segment], model: Sequence[Segment]) -> tuple[float, float]:
    """Mean distance between the mean velocities of plant and model: in the plane (m/s), and of turning (rad/s)."""
    apart = np.array([a.mean - b.mean for a, b in zip(plant, model, strict=True)])
    return float(np.hypot(apart[:, 0], apart[:, 1]).mean()), float(np.abs(apart[:, 2]).mean())
