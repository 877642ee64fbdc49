from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadvel_description.state import JointCommand
from quadvel_eval.robot_loop import RobotLoop, Sample, TrueVelocity, make_estimator
from quadvel_policy.supervisor import Supervisor
from quadvel_policy.tick_input import TickInput
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from tests.helpers.robots import ALIENGO


def run(loop: RobotLoop, ticks: int = 60) -> list[Sample]:
    return [loop.tick((0.5, 0.0, 0.2)) for _ in range(ticks)]


def test_equal_seeds_give_equal_runs_to_the_bit_and_others_do_not(
    make_loop: Callable[..., RobotLoop],
) -> None:
    first, again, other = (run(make_loop(seed)) for seed in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        assert a.state.q.tobytes() == b.state.q.tobytes()
        assert a.truth.position.tobytes() == b.truth.position.tobytes()
        assert a.estimates["kalman"].tobytes() == b.estimates["kalman"].tobytes()
    assert first[-1].state.q.tobytes() != other[-1].state.q.tobytes()


def test_a_tick_is_five_milliseconds_and_its_command_answers_its_state(
    make_loop: Callable[..., RobotLoop],
) -> None:
    samples = run(make_loop(), 5)
    times = [sample.state.time for sample in samples]
    np.testing.assert_allclose(np.diff(times), 0.005, atol=1e-12)
    assert all(sample.command.tick == sample.state.tick for sample in samples)
    assert all(sample.truth.time == sample.state.time for sample in samples)


def test_commands_pass_the_ramp_of_the_mux_and_the_limits_of_the_policy(
    make_loop: Callable[..., RobotLoop],
) -> None:
    loop = make_loop()
    asked = []
    for _ in range(400):
        loop.tick((9.0, 0.0, 0.0))
        asked.append(loop.supervisor.command[0])
    assert np.diff(asked).max() == pytest.approx(2.0 * 0.005)  # 2 m/s^2
    assert asked[-1] == 2.0


def test_zero_velocity_is_a_command_to_stand_still(make_loop: Callable[..., RobotLoop]) -> None:
    loop = make_loop()
    loop.tick((0.3, 0.0, 0.0))
    loop.tick((0.3, 0.0, 0.0))
    assert loop.supervisor.command[3] == 0.0
    for _ in range(60):
        loop.tick()
    assert loop.supervisor.command.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert loop.supervisor.mode == "walk"


def test_the_supervisor_walks_on_the_estimate_of_the_state_before(standing_policy: Any) -> None:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO))
    simulator.reset("stand")
    used: list[object] = []

    class Spy(Supervisor):
        def tick(self, inputs: TickInput) -> JointCommand:
            used.append(inputs.velocity)
            return super().tick(inputs)

    loop = RobotLoop(simulator, Spy(ALIENGO, standing_policy), TrueVelocity(simulator))
    truths = [loop.tick().truth.linear_velocity for _ in range(5)]
    assert used[0] is None
    for velocity, truth in zip(used[1:], truths, strict=False):
        np.testing.assert_array_equal(velocity, truth)


def test_a_refused_mode_raises_with_the_reason(standing_policy: Any) -> None:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO))  # lies
    loop = RobotLoop(simulator, Supervisor(ALIENGO, standing_policy), TrueVelocity(simulator))
    with pytest.raises(RuntimeError, match=r"refused stance: .* off the nominal posture"):
        loop.start_walking()


def test_an_unknown_estimator_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'magic', expected one of learned, kalman, truth"):
        make_estimator("magic", Simulator(SimulatorConfig(robot=ALIENGO)), tmp_path)
