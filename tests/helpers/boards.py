"""States that boards may report, and simulated boards that run in a thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import attrs
import numpy as np

from quadvel_description.state import RobotState
from quadvel_driver.board_state import Battery, BoardState, Button, Remote
from quadvel_sim.board import Board
from quadvel_sim.loop import SimulationLoop
from quadvel_sim.simulator import Simulator


def random_state(
    seed: int, motor_mode: int, imu_temperature: int, battery: Battery | None = None
) -> BoardState:
    """Numbers that a robot may report, exact in the resolution of the packets of all robots."""
    rng = np.random.default_rng(seed)

    def numbers(size: int, step: float, reach: int) -> np.ndarray:
        return step * rng.integers(-reach, reach, size)

    robot = RobotState(
        time=0.0,
        tick=int(rng.integers(1, 2**32)),
        q=numbers(12, 2**-10, 3000),
        dq=numbers(12, 2**-10, 20000),
        tau=numbers(12, 2**-8, 10000),
        quaternion=np.array([0.5, -0.5, 0.5, 0.5]),
        angular_velocity=numbers(3, 2**-10, 3000),
        linear_acceleration=numbers(3, 2**-10, 20000),
        foot_force=numbers(4, 1.0, 300),
    )
    return BoardState(
        robot=robot,
        motor_mode=np.full(12, motor_mode, np.uint8),
        motor_error=np.arange(12, dtype=np.uint32),
        temperature=rng.integers(-20, 100, 12).astype(np.int8),
        imu_temperature=imu_temperature,
        remote=Remote(Button.L1 | Button.UP, lx=-0.5, ly=0.25, rx=1.0, ry=-1.0),
        battery=battery,
    )


def equal(a: object, b: object) -> bool:
    """Whether two records hold the same, arrays included."""
    pairs = zip(attrs.astuple(a, recurse=False), attrs.astuple(b, recurse=False), strict=True)
    return all(
        equal(x, y) if attrs.has(type(x)) else np.array_equal(x, y)  # type: ignore[arg-type]
        for x, y in pairs
    )


def wait_for(condition: Callable[[], object], board: Board, patience: float = 30.0) -> None:
    """Wait until a condition holds; fail with what the board counted after `patience` s."""
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, f"time is up; {board.counts}, {board.last_refusal}"
        time.sleep(0.005)


@contextmanager
def running(board: Board, simulator: Simulator) -> Iterator[None]:
    """Run a standing robot behind a board; states are published every 2 ms."""
    simulator.reset("stand")
    board.loop = SimulationLoop(simulator, board.publish, period=2, answer_timeout=0.0)
    board.loop.receive = board.receive
    thread = threading.Thread(target=board.loop.run)
    thread.start()
    try:
        yield
    finally:
        board.loop.stop()
        thread.join()
        board.close()
