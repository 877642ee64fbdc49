"""Measures how well a model of the robot repeats a recorded run, in open loop and in tracking.

Open loop covers short stretches only. A walking robot is unstable, so that any two runs diverge
over longer stretches.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from scipy.interpolate import interp1d
from scipy.signal import savgol_filter

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.arrays import Array, Bools
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_description.state import MODE_DAMPING, MODE_SERVO, JointCommand
from quadvel_nodes.messages import seconds
from quadvel_policy.observation import CONTROL_PERIOD_S
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_recordings.joint_log import JointLog, Series, require_commands
from quadvel_recordings.reading import read_messages, warn_of_unused_gains
from quadvel_sim.config import SensorNoise, SimulatorConfig
from quadvel_sim.simulator import DT, Simulator, Truth

from .recording import Recording
from .robot_loop import RobotLoop, make_estimator
from .segments import SETTLING_TIME_S, Segment, measure_segment

STRETCH_DURATION_S = 0.2  # of one open-loop replay
STRETCH_INTERVAL_S = 0.35  # between stretches; not a multiple of the gait period
SMOOTHING_HALF_WIDTH_MS = 2  # of the filter against encoder noise
HISTORY_MS = 60  # before a stretch, for the delays of the drives
GROWTH_INTERVAL_MS = 10  # between points of the error growth
COMMAND_FIELDS = ("q", "dq", "tau", "kp", "kd")  # 12 numbers each


@attrs.frozen(eq=False)
class JointRecord:
    """Joint states and commands of a run, one row per ms.

    Attributes:
        time: Times (n,), s.
        q: Angles (n, 12), rad.
        dq: Velocities (n, 12), rad/s.
        tau: Torques (n, 12), N m.
        command: Command in force (n, 61): COMMAND_FIELDS with 12 numbers each, then the mode.
        recorded: Whether the state was recorded (n,); False: interpolated.
    """

    time: Array
    q: Array
    dq: Array
    tau: Array
    command: Array
    recorded: Bools

    def is_complete(self, begin: int, end: int) -> bool:
        """Return whether a range of rows exists and every state in it was recorded.

        Args:
            begin: First row.
            end: Row after the last.

        Returns:
            True if no state is missing.
        """
        return begin >= 0 and end <= len(self.recorded) and bool(self.recorded[begin:end].all())


@attrs.frozen
class ReplayError:
    """Root mean square of replayed minus recorded values, over all joints and stretches.

    Attributes:
        q: Error of the angles, rad.
        dq: Error of the velocities, rad/s.
        tau: Error of the torques, N m.
        stretches: Number of stretches.
        growth: Error of the angles over each GROWTH_INTERVAL_MS from the start of a stretch, rad.
    """

    q: float
    dq: float
    tau: float
    stretches: int
    growth: tuple[float, ...]


def read_joints(path: Path, max_period: float = DT, use_receipt_times: bool = False) -> JointRecord:
    """Read the joints of a recording at 1 kHz, with missing states marked and interpolated.

    A command counts from the time of the state that it answers; its own stamp is ignored.

    Args:
        path: The recording.
        max_period: Largest accepted median period of the states, s.
        use_receipt_times: Whether to use the times of receipt instead of the stamps.

    Returns:
        The joint record.

    Raises:
        ValueError: The recording has no states of that rate, or no commands.
    """
    states: dict[int, tuple[float, Any]] = {}
    commands: dict[int, Any] = {}
    for topic, receipt, message in read_messages(
        path, lambda topic, _: topic in ("/low_state", "/low_cmd"), _ignore_warning
    ):
        if topic == "/low_state":
            states[message.tick] = 1e-9 * receipt if use_receipt_times else seconds(message.stamp), message
        else:
            commands[message.tick] = np.concatenate(
                [*(getattr(message, field) for field in COMMAND_FIELDS), [message.mode]]
            )
    ticks = sorted(states)
    time = np.array([states[tick][0] for tick in ticks])
    values = [
        np.array([getattr(states[tick][1], field) for tick in ticks], float) for field in ("q", "dq", "tau")
    ]
    return _resample_to_milliseconds(path, np.array(ticks), time, values, commands, max_period)


def joints_from_log(
    path: Path, log: JointLog, max_period: float, gains: tuple[float, float] | None
) -> JointRecord:
    """Convert another robot's joint log, with times rounded to ms.

    Args:
        path: The recording, for error messages.
        log: Its joint log; it must hold all joints of the model.
        max_period: Largest accepted median period of the states, s.
        gains: kp (N m/rad) and kd (N m s/rad) if the commands hold none.

    Returns:
        The joint record.

    Raises:
        ValueError: A joint, the torque, the angles or the gains are missing.
    """
    state, command = log.state, require_commands(path, log)
    for field, meaning in (("q", "angles"), ("tau", "torques")):
        if field not in state.values:
            raise ValueError(f"{path}: {state.topic}: found no {meaning}, expected them next to the commands")
    values = {name: _in_model_order(path, state, each) for name, each in state.values.items()}
    speed = values.get("dq", np.gradient(values["q"], state.time, axis=0))
    ticks, first = np.unique(np.round(1e3 * state.time).astype(int), return_index=True)
    sent = {name: _in_model_order(path, command, each) for name, each in command.values.items()}
    if gains is not None and {"kp", "kd"} <= sent.keys():
        warn_of_unused_gains(path)
    for name, gain in zip(("kp", "kd"), gains or (None, None), strict=True):
        if name not in sent and gain is None:
            raise ValueError(f"{path}: {command.topic}: {name}: not in the recording, expected --gains KP KD")
        sent.setdefault(name, np.broadcast_to(np.float64(gain or 0.0), sent["q"].shape))
    none = np.zeros(sent["q"].shape)
    rows = np.hstack(
        [*(sent.get(name, none) for name in COMMAND_FIELDS), np.full((len(none), 1), MODE_SERVO)]
    )
    commands = dict(zip(np.round(1e3 * command.time).astype(int).tolist(), rows, strict=True))
    measured = [each[first] for each in (values["q"], speed, values["tau"])]
    return _resample_to_milliseconds(
        path, ticks, (state.time + 1e-9 * log.start_ns)[first], measured, commands, max_period
    )


def _in_model_order(path: Path, series: Series, values: Array) -> Array:
    """Select the model's joints from values (n, J), in its order: (n, 12). Raises ValueError."""
    named = [name.removesuffix("_joint") for name in series.joints]
    missing = [name for name in JOINT_NAMES if name.removesuffix("_joint") not in named]
    if missing:
        found = f"found {', '.join(series.joints[:3])}, ..."
        raise ValueError(
            f"{path}: {series.topic}: {found}, expected all joints of the model; {missing[0]} is missing"
        )
    return np.asarray(values[:, [named.index(name.removesuffix("_joint")) for name in JOINT_NAMES]], float)


def _resample_to_milliseconds(
    path: Path,
    ticks: Array,
    time: Array,
    values: Sequence[Array],
    commands: Mapping[int, Array],
    max_period: float,
) -> JointRecord:
    """Interpolate states (n, 12) at `ticks` (n,) ms to one row per ms, and attach the commands."""
    if len(ticks) < 2 or not commands:
        missing = "low_cmd" if len(ticks) > 1 else "low_state"
        raise ValueError(
            f"{path}: {missing}: found no message, expected a recording of low_state and low_cmd"
        )
    period = np.median(np.diff(ticks)) * 1e-3
    if not period <= max_period:
        raise ValueError(
            f"{path}: low_state: found a period of {period:g} s, expected {max_period:g} s at most"
        )
    every = np.arange(ticks[0], ticks[-1] + 1)
    q, dq, tau = (interp1d(ticks, each, axis=0)(every) for each in values)
    return JointRecord(
        np.interp(every, ticks, time), q, dq, tau, _commands_at(commands, every), np.isin(every, ticks)
    )


def _commands_at(commands: Mapping[int, Array], ticks: Array) -> Array:
    """Command in force at each tick (n,), as (n, 61); damping before the first command."""
    sent = sorted(commands)
    table = np.array([np.zeros(12 * len(COMMAND_FIELDS) + 1), *(commands[tick] for tick in sent)], float)
    in_force: Array = table[np.searchsorted(sent, ticks, side="right")]
    return in_force


def _ignore_warning(_: str) -> None:
    """Ignore a warning that the first reading of the recording has printed already."""


def modelled_torque(actuator: ActuatorParameters, joints: JointRecord, first: int, stop: int) -> Array:
    """Predict the torques of the recorded commands and motion with an actuator model.

    Encoder noise is smoothed. The delays of the drives know nothing before `first`.

    Args:
        actuator: Parameters of the model.
        joints: The recorded joints.
        first: First row.
        stop: Row after the last.

    Returns:
        Torques (stop - first, 12), N m.
    """
    q, dq = (
        savgol_filter(values, 2 * SMOOTHING_HALF_WIDTH_MS + 1, 1, axis=0) for values in (joints.q, joints.dq)
    )
    model = ActuatorModel(attrs.evolve(actuator, torque_noise=0.0), dt=DT)
    found = np.empty((stop - first, 12))
    for row in range(first, stop):
        c = _command_at(joints, row)
        found[row - first] = model.step(q[row], dq[row], c.q, c.kp, c.kd, c.dq, c.tau)
    return found


def torque_error(actuator: ActuatorParameters, joints: JointRecord, start: float, end: float) -> float:
    """Return the mean square error of the modelled torque on the recorded motion.

    The drives act on the true motion; therefore encoder noise is smoothed.

    Args:
        actuator: Parameters of the model.
        joints: The recorded joints.
        start: Start of the interval, s.
        end: End of the interval, s.

    Returns:
        Mean square of measured minus modelled torque, N^2 m^2.

    Raises:
        ValueError: The interval holds no row with a complete history.
    """
    begin, stop = np.searchsorted(joints.time, [start, end]).tolist()
    first = max(begin - HISTORY_MS, 0)
    off = joints.tau[first:stop] - modelled_torque(actuator, joints, first, stop)
    squares = [
        np.mean(off[row - first] ** 2)
        for row in range(begin, stop)
        if joints.is_complete(row - HISTORY_MS, row + 1)
    ]
    if not squares:
        raise ValueError(f"nothing was recorded without gaps between {start:.2f} and {end:.2f} s")
    return float(np.mean(squares))


def open_loop_error(
    robot: Robot,
    actuator: ActuatorParameters,
    joints: JointRecord,
    truth: Callable[[float], Truth],
    start: float,
    end: float,
) -> ReplayError:
    """Replay short stretches of recorded commands on a simulated robot without noise.

    Each stretch starts from the recorded state.

    Args:
        robot: The robot.
        actuator: Parameters of the robot's drives.
        joints: The recorded joints.
        truth: Function from a time (s) to the recorded state of the trunk.
        start: Start of the interval, s.
        end: End of the interval, s.

    Returns:
        Errors over all stretches.

    Raises:
        ValueError: The interval holds no complete stretch.
    """
    quiet = attrs.evolve(actuator, torque_noise=0.0)
    simulator = Simulator(SimulatorConfig(robot=robot, actuator=quiet, noise=SensorNoise.none()))
    errors = [
        _stretch_errors(simulator, joints, truth, row)
        for row in np.searchsorted(
            joints.time, np.arange(start, end - STRETCH_DURATION_S, STRETCH_INTERVAL_S)
        ).tolist()
        if joints.is_complete(row - HISTORY_MS, row + round(STRETCH_DURATION_S / DT))
    ]
    if not errors:
        raise ValueError(f"nothing to replay between {start:.2f} and {end:.2f} s")
    # errors: (stretches, rows, 3). Average over stretches, then over rows for each quantity; growth
    # averages over GROWTH_INTERVAL_MS of the angles only.
    squares = np.mean(errors, axis=0)
    q, dq, tau = np.sqrt(squares.mean(axis=0)).tolist()
    growth = np.sqrt(squares[:, 0].reshape(-1, GROWTH_INTERVAL_MS).mean(axis=1))
    return ReplayError(q, dq, tau, len(errors), tuple(growth.tolist()))


def _stretch_errors(
    simulator: Simulator, joints: JointRecord, truth: Callable[[float], Truth], row: int
) -> Array:
    """Mean square errors of q, dq and torque over the joints, (n, 3), one row per ms from `row` on."""
    past = [(joints.q[i], joints.dq[i], _command_at(joints, i)) for i in range(row - HISTORY_MS, row)]
    simulator.set_state(truth(joints.time[row]), joints.q[row], joints.dq[row], past)
    squares = np.empty((round(STRETCH_DURATION_S / DT), 3))
    for i, square in enumerate(squares, start=row):
        simulator.command(_command_at(joints, i))
        state = simulator.state()
        found = (joints.q[i] - state.q, joints.dq[i] - state.dq, joints.tau[i] - state.tau)
        square[:] = [np.mean(error**2) for error in found]
        simulator.step()
    return squares


def _command_at(joints: JointRecord, row: int) -> JointCommand:
    """Joint command of a row."""
    q, dq, tau, kp, kd, mode = np.split(joints.command[row], range(12, 12 * len(COMMAND_FIELDS) + 1, 12))
    return JointCommand(q, dq, tau, kp, kd, MODE_SERVO if mode else MODE_DAMPING)


def recorded_truth(recording: Recording) -> Callable[[float], Truth]:
    """Return a function that looks up the recorded state of the trunk.

    Args:
        recording: The recording.

    Returns:
        Function from a time (s) to the nearest true sample, without contacts.
    """

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
    robot: Robot, actuator: ActuatorParameters, commands: Sequence[tuple[Array, float]], seed: int
) -> list[Segment]:
    """Simulate the shipped policy on a robot with an actuator model.

    Args:
        robot: The robot.
        actuator: Parameters of the robot's drives.
        commands: Velocity (3,) and duration (s) of each command.
        seed: Seed of the simulator.

    Returns:
        Command and mean velocity of each command.
    """
    simulator = Simulator(SimulatorConfig(robot=robot, actuator=actuator, seed=seed))
    simulator.reset("stand")
    supervisor = Supervisor(robot, PolicyFile(robot))
    loop = RobotLoop(simulator, supervisor, make_estimator("learned", simulator, None))
    loop.start_walking()
    segments = []
    for command, duration in commands:
        begin, times, velocities = simulator.time, [], []
        for _ in range(round(duration / CONTROL_PERIOD_S)):
            truth = loop.tick(command).truth
            times.append(truth.time)
            velocities.append([*truth.linear_velocity[:2], truth.angular_velocity[2]])
        segments.append(
            measure_segment(times, velocities, command, begin + SETTLING_TIME_S, begin + duration)
        )
    return segments


def tracking_gap(plant: Sequence[Segment], model: Sequence[Segment]) -> tuple[float, float]:
    """Return the mean distance between the mean velocities of plant and model.

    Args:
        plant: Segments of the plant.
        model: Segments of the model, same commands.

    Returns:
        Mean distance in the plane (m/s), and of the yaw rates (rad/s).
    """
    apart = np.array([a.mean - b.mean for a, b in zip(plant, model, strict=True)])
    return float(np.hypot(apart[:, 0], apart[:, 1]).mean()), float(np.abs(apart[:, 2]).mean())
