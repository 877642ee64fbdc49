"""Walks of the simulated robot with an injected defect, written as a recording of the stack.

The loop runs simulator, estimator, command mux and supervisor in lockstep, in one process and without middleware.
A `Defect` changes one thing: a plant, a message, a policy or the timing. Nothing here is shared with `quadvel_why`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from quadvel_bringup.recording_file import RawMessage, RecordingFile
from quadvel_description.arrays import Array
from quadvel_description.state import JointCommand, RobotState
from quadvel_estimator.features import previous_action
from quadvel_estimator.learned import LearnedEstimator
from quadvel_policy.command_mux import CommandMux, MuxInput
from quadvel_policy.config import SupervisorConfig
from quadvel_policy.modes import Policy
from quadvel_policy.policy_file import PolicyFile
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import MotorStatus, TickInput
from quadvel_recordings.definitions import STORE
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO

TICK_MS = 5
MUX_MS = 20
STANCE_S = 0.6
AFTER_FALL_S = 0.6
"""How long a recording goes on after a fall or a fault."""
MODES = ("passive", "stand_up", "stance", "walk", "lie_down", "fault")
PLANNER = MuxInput("planner", priority=0, timeout=1.0)
Velocity = tuple[float, float, float]


class Defect:
    """A robot without a defect; subclasses change one thing each."""

    plant: dict[str, Any] = {}  # noqa: RUF012 - replaced by subclasses, never changed

    def begin(self, simulator: Simulator) -> None:
        """Change the simulator before the walk."""

    def at(self, simulator: Simulator, time: float) -> None:
        """Change the simulator during the walk; `time` since its start, s."""

    def reported(self, state: RobotState) -> RobotState:
        """The state that the driver publishes."""
        return state

    def perceived(self, state: RobotState) -> RobotState:
        """The state that the controller computes with."""
        return state

    def policy(self, policy: Policy) -> Policy:
        """The policy that the controller runs."""
        return policy

    def estimate(self, velocity: Array) -> Array:
        """The velocity that the estimator publishes."""
        return velocity

    def answers(self, tick: int) -> bool:
        """Whether the controller answers this state."""
        return True

    def latency_ms(self) -> int:
        """Time from a state to the command that answers it."""
        return 0

    def received(self, command: JointCommand) -> JointCommand | None:
        """The command that reaches the drives; None: it is lost."""
        return command

    def transport_ms(self) -> int:
        """Time from the sending of a command, as it is stamped, to the drives."""
        return 0

    def temperatures(self, time: float) -> Array:
        """Temperatures of the motors, deg C."""
        return 42.0 + 0.1 * np.arange(12) + 0.05 * time

    def velocities(self, wanted: Velocity) -> Velocity:
        """The velocity that the planner commands."""
        return wanted


@attrs.define
class Messages:
    """Messages of a walk: topic, type, time in ns, fields."""

    rows: list[tuple[str, str, int, Any]] = attrs.field(factory=list)

    def add(self, topic: str, typename: str, ns: int, **fields: Any) -> None:
        """Append a message of a topic at a time, ns."""
        self.rows.append((topic, typename, ns, STORE.types[typename](**fields)))

    def write(self, path: Path) -> Path:
        """Write the messages to a recording and return its path."""
        file = RecordingFile(path)
        for topic, typename, ns, message in self.rows:
            data = bytes(STORE.serialize_cdr(message, typename))
            file.keep(RawMessage(topic, typename, ns, ns, data))
        file.close()
        return path


def _time(ns: int) -> Any:
    return STORE.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


def _single(values: Any) -> Array:
    return np.asarray(values, np.float32)


def _vector(x: float, y: float, z: float) -> Any:
    return STORE.types["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z))


def _twist(vx: float, vy: float, vz: float, wz: float = 0.0) -> Any:
    return STORE.types["geometry_msgs/msg/Twist"](linear=_vector(vx, vy, vz), angular=_vector(0.0, 0.0, wz))


def rounded(state: RobotState) -> RobotState:
    """The state as it is after the transport in single precision."""
    fields = ("q", "dq", "tau", "quaternion", "angular_velocity", "linear_acceleration", "foot_force")
    return attrs.evolve(state, **{f: _single(getattr(state, f)).astype(float) for f in fields})


class RecordedWalk:
    """One walk of a robot with a defect."""

    def __init__(
        self,
        defect: Defect,
        seed: int,
        plant: dict[str, Any] | None = None,
        prepare: Callable[[Simulator], None] | None = None,
    ) -> None:
        self.defect, self.messages = defect, Messages()
        self.simulator = Simulator(
            SimulatorConfig(robot=ALIENGO, **{"seed": seed, **(plant or {}), **defect.plant})
        )
        self.simulator.reset("stand")
        if prepare is not None:
            prepare(self.simulator)
        defect.begin(self.simulator)
        # The posture may lean further than usual, so that walks can begin on steep ground.
        config = SupervisorConfig(max_posture_error=1.0)
        self.supervisor = Supervisor(ALIENGO, defect.policy(PolicyFile(ALIENGO)), config)
        self.estimator = LearnedEstimator(ALIENGO)
        self.mux = CommandMux([PLANNER])
        self.velocity: Array | None = None
        self.action = np.zeros(12)
        self.pending: list[tuple[int, JointCommand]] = []
        self.last_estimate_time = -1.0
        self.ended: int | None = None
        self.errors: list[float] = []

    def run(self, script: Sequence[tuple[Velocity, float]]) -> bool:
        """Walk through velocities and durations (s); False if the robot fell or stopped in a fault."""
        self.tick((0.0, 0.0, 0.0))
        self.supervisor.request("stance")
        for _ in range(round(1000 * STANCE_S / TICK_MS)):
            self.tick((0.0, 0.0, 0.0))
        self.supervisor.request("walk")
        for velocity, seconds in script:
            for _ in range(round(1000 * seconds / TICK_MS)):
                try:
                    self.tick(self.defect.velocities(velocity))
                except FloatingPointError:
                    return False
                if self._is_over():
                    return False
        return self.ended is None

    @property
    def tracking_error(self) -> float:
        """Root mean square of true minus commanded velocity in the plane, m/s."""
        return float(np.sqrt(np.mean(self.errors))) if self.errors else float("inf")

    def _is_over(self) -> bool:
        now = self.simulator.steps
        if self.ended is None and (self.supervisor.mode != "walk" or self.simulator.fallen):
            self.ended = now
        return self.ended is not None and now - self.ended > 1000 * AFTER_FALL_S

    def tick(self, wanted: Velocity) -> None:
        """Run one control tick: state, command, estimate, and the physics until the next one."""
        sim, defect, now = self.simulator, self.defect, self.simulator.time
        defect.at(sim, now)
        state = rounded(defect.reported(sim.state()))
        self._record_state(state)
        if sim.steps % MUX_MS == 0:
            self.mux.receive(PLANNER.name, now, wanted)
            self.output = self.mux.update(now)
        output = self.output
        self._record_surroundings(now, output)
        off = sim.truth().linear_velocity[:2] - np.array(output.velocity[:2])
        self.errors.append(float(off @ off))
        if defect.answers(sim.steps // TICK_MS):
            self._answer(state, [*output.velocity, output.stance])
        try:
            if state.time > self.last_estimate_time:
                self.velocity = _single(defect.estimate(self.estimator.update(state, self.action)[0])).astype(
                    float
                )
                self.last_estimate_time = state.time
        except FloatingPointError:
            self.velocity = None
        if self.velocity is not None:
            self._record_estimate(now, self.velocity)
        for _ in range(TICK_MS):
            while self.pending and self.pending[0][0] <= sim.steps:
                sim.command(self.pending.pop(0)[1])
            sim.step()

    def _answer(self, state: RobotState, commanded: Sequence[float]) -> None:
        perceived, now = self.defect.perceived(state), self.simulator.time
        motors = MotorStatus(self.defect.temperatures(now), np.zeros(12, bool))
        if not np.isfinite(perceived.q).all():
            return  # the node refuses it
        answer = self.supervisor.tick(TickInput(now, perceived, self.velocity, commanded, motors=motors))
        self.action = previous_action(ALIENGO, answer.q, answer.mode)
        sent = self.simulator.steps + self.defect.latency_ms()
        self._record_command(answer, 1_000_000 * sent)
        copy = attrs.evolve(answer, **{f: getattr(answer, f).copy() for f in ("q", "dq", "tau", "kp", "kd")})
        received = self.defect.received(copy)
        if received is not None:
            self.pending.append((sent + self.defect.transport_ms(), received))
            self.pending.sort(key=lambda entry: entry[0])

    def _record_state(self, state: RobotState) -> None:
        ns = round(1e9 * state.time)
        self.messages.add(
            "/low_state",
            "quadvel_msgs/msg/LowState",
            ns,
            stamp=_time(ns),
            tick=state.tick,
            orientation_wxyz=_single(state.quaternion),
            **{
                f: _single(getattr(state, f))
                for f in ("q", "dq", "tau", "angular_velocity", "linear_acceleration", "foot_force")
            },
        )

    def _record_command(self, command: JointCommand, ns: int) -> None:
        self.messages.add(
            "/low_cmd",
            "quadvel_msgs/msg/LowCmd",
            ns,
            stamp=_time(ns),
            tick=command.tick,
            mode=command.mode,
            **{f: _single(getattr(command, f)) for f in ("q", "dq", "tau", "kp", "kd")},
        )

    def _record_estimate(self, now: float, velocity: Array) -> None:
        ns, types = round(1e9 * now), STORE.types
        header = types["std_msgs/msg/Header"](stamp=_time(ns), frame_id="base_link")
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            twist=_twist(*velocity), covariance=np.zeros(36)
        )
        kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
        self.messages.add("/velocity_estimate", kind, ns, header=header, twist=twist)

    def _record_surroundings(self, now: float, output: Any) -> None:
        """What is published more slowly: command and mode at 50 Hz, the motors at 5 Hz."""
        ns, steps = round(1e9 * now), self.simulator.steps
        if steps % MUX_MS == 0:
            vx, vy, wz = output.velocity
            self.messages.add(
                "/command",
                "quadvel_msgs/msg/VelocityCommand",
                ns,
                stamp=_time(ns),
                twist=_twist(vx, vy, 0.0, wz),
                stance=bool(output.stance),
                source="planner",
            )
            self._record_mode(ns)
        if steps % 200 == 0:
            self.messages.add(
                "/motor_status",
                "quadvel_msgs/msg/MotorStatus",
                ns,
                stamp=_time(ns),
                temperature=_single(self.defect.temperatures(now)),
                dropped_out=np.zeros(12, bool),
            )

    def _record_mode(self, ns: int) -> None:
        supervisor, (vx, vy, wz, stance) = self.supervisor, self.supervisor.command.tolist()
        numbers = ("rate_hz", "period_p99_ms", "inference_p50_us", "compute_p50_us", "compute_p99_us")
        self.messages.add(
            "/controller/state",
            "quadvel_msgs/msg/ControllerState",
            ns,
            stamp=_time(ns),
            mode=MODES.index(supervisor.mode),
            mode_name=supervisor.mode,
            reason=supervisor.reason,
            fault=supervisor.fault,
            findings=[finding.sentence for finding in supervisor.findings],
            walk_allowed=True,
            walk_refusal="",
            command=_twist(vx, vy, 0.0, wz),
            stance=bool(stance),
            trim=_twist(*supervisor.trim[:2], 0.0, supervisor.trim[2]),
            overruns=0,
            refused=0,
            **dict.fromkeys(numbers, 0.0),
        )


def make_script(seed: int, seconds: float) -> list[tuple[Velocity, float]]:
    """Random velocities that the policy can follow, 2 s each."""
    rng = np.random.default_rng([seed, 7])
    script, left = [], seconds
    while left > 0.0:
        speed, turn = rng.uniform(0.3, 1.4), rng.uniform(-0.8, 0.8)
        kind = rng.integers(5)
        velocity = (
            (speed, 0.0, 0.0),
            (speed, 0.0, turn),
            (0.6 * speed, rng.uniform(-0.4, 0.4), 0.0),
            (-0.4 * speed, 0.0, 0.5 * turn),
            (0.5 * speed, rng.uniform(-0.3, 0.3), turn),
        )[kind]
        script.append((tuple(map(float, velocity)), min(2.0, left)))
        left -= 2.0
    return script  # type: ignore[return-value]
