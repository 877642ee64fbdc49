"""Walks under the paper's random commands in raw steps: how often robots fall, or move a joint too fast.

`python -m quadvel_training random-walks` runs them in the batched environment, for the teacher or for
a policy that learns from it. `quadvel paper --only steps` does the same with a policy file in the
whole stack.
"""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import torch

from quadvel_description.robot import load_robot
from quadvel_eval.paper.steps import HOLD_S, draw_velocities
from quadvel_policy.guard import GuardConfig
from quadvel_policy.observation import VelocityCommandLimits

from .dagger import DaggerConfig, action_map, load_policy, observe
from .env import TICK_S, EnvConfig, NeverReversed, VelocityEnv
from .loop import load
from .randomisation import Randomisation, load_actuator
from .teacher import Teacher


@attrs.frozen
class RandomCommands(NeverReversed):
    """Commands of the paper's training, held to the limits of a policy.

    Attributes:
        limits: limits.
        hold: s, from and to, until the next command.
    """

    limits: VelocityCommandLimits
    hold: tuple[float, float] = HOLD_S

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw commands.

        Args:
            rng: source of randomness.
            n: number of commands.

        Returns:
            (n, 4): vx, vy (m/s), yaw rate (rad/s), 1 to stand.
        """
        velocity = np.array([self.limits.clamp(one) for one in draw_velocities(rng, n).tolist()])
        return np.column_stack([velocity, ~velocity.any(axis=1)])


@attrs.frozen
class RandomWalks:
    """Outcome of random walks.

    Attributes:
        robots: number of robots.
        fell: number of those that fell.
        stopped: number of those that fell, or moved a joint so fast that the supervisor stops them.
    """

    robots: int
    fell: int
    stopped: int


def walk_randomly(
    teacher_file: Path, student_file: Path | None, config: DaggerConfig, robots: int, seconds: float
) -> RandomWalks:
    """Let nominal robots walk on level ground under random commands.

    Args:
        teacher_file: checkpoint of `privileged`.
        student_file: checkpoint of `dagger`, which drives; None: the teacher drives.
        config: configuration of stage 2: robot, actuators, time step, limits of the commands.
        robots: number of robots.
        seconds: duration of each walk.

    Returns:
        The outcome.
    """
    robot = load_robot(config.robot)
    env_config = EnvConfig(
        robot=robot,
        n=robots,
        threads=config.threads,
        seed=config.seed,
        timestep=config.timestep,
        actuator=load_actuator(robot, config.actuator),
        randomisation=Randomisation.none(),
        ramped=0.0,
        episode=10.0 * seconds,
    )
    env = VelocityEnv(env_config, RandomCommands(config.grid.answered))
    teacher, joint_targets = Teacher(load(teacher_file), env), action_map(env).targets
    student = load_policy(student_file) if student_file else None
    memory = student.initial_state(robots) if student else None
    action = np.zeros((robots, 12), np.float32)
    fell, too_fast = np.zeros(robots, bool), np.zeros(robots, bool)
    fastest = GuardConfig().max_joint_speed * robot.velocity_limit
    for _ in range(round(seconds / TICK_S)):
        observed, action = observe(env, action), teacher.action()
        if student:
            with torch.no_grad():
                chosen, memory = student(torch.from_numpy(observed)[None], memory)
            action = chosen[0].numpy()
        command = env.command.copy()
        env.tick(joint_targets(action))
        teacher.advance(command, action)
        too_fast |= (np.abs(env.dq) > fastest).any(axis=1) & ~fell
        fell |= env.fallen
    return RandomWalks(robots, int(fell.sum()), int((fell | too_fast).sum()))
