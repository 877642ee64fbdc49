"""The motions on the ground go through, on the stack's simulator and on a plant with other contacts."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from quadvel_actuator import ActuatorModel, ActuatorParameters
from quadvel_description.kinematics import foot_positions, roll_pitch
from quadvel_description.mjcf import Plant, load_model
from quadvel_description.quadruped import GRAVITY, JOINT_NAMES, LEGS
from quadvel_description.state import JointCommand, RobotState
from quadvel_lab.excite import MotionPlayer
from quadvel_sim.config import SimulatorConfig
from quadvel_sim.simulator import Simulator
from quadvel_sysid.excitation import PERIOD_S, Excitation, FootLifting, Sweep
from quadvel_sysid.identify import identify
from quadvel_sysid.logs.log import Log
from tests.helpers.robots import ALIENGO

LEVEL = 0.15  # rad, that the trunk may tilt by; the player gives up at 0.8
Body = Callable[[JointCommand], RobotState]


def play(
    excitation: Excitation, begin: RobotState, answer: Body
) -> tuple[list[RobotState], list[JointCommand]]:
    """The states of the whole motion, and what answered them. MotionError where it does not go through."""
    player, states, commands = MotionPlayer(excitation), [begin], []
    while not player.is_done:
        commands.append(player.answer(states[-1]))
        states.append(answer(commands[-1]))
    return states[:-1], commands


def largest_tilt(states: list[RobotState]) -> float:
    return float(np.abs(roll_pitch(np.array([state.quaternion for state in states]))).max())


def simulated(seed: int) -> tuple[RobotState, Body]:
    simulator = Simulator(SimulatorConfig(robot=ALIENGO, seed=seed))
    simulator.reset("stand")

    def answer(command: JointCommand) -> RobotState:
        simulator.command(command)
        simulator.step()
        return simulator.state()

    return simulator.state(), answer


def other_plant(seed: int) -> tuple[RobotState, Body]:
    """Steps of 0.5 ms, pyramidal cones, stiffer contacts; friction 0.4 to 1, payload -1 to 3 kg off the middle, drawn."""
    rng = np.random.default_rng(seed)
    friction = rng.uniform(0.4, 1.0)
    model = load_model(ALIENGO, Plant(timestep=0.0005))
    for leg in LEGS:
        model.geom(f"{leg}_foot").friction[0] = friction
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.geom_solref[:] = 0.004, 1.0
    trunk, payload = model.body("trunk").id, rng.uniform(-1.0, 3.0)
    mass, at = model.body_mass[trunk], rng.uniform(-0.05, 0.05, 3)
    model.body_ipos[trunk] = (mass * model.body_ipos[trunk] + payload * at) / (mass + payload)
    model.body_mass[trunk] = mass + payload
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    drives = ActuatorModel(ActuatorParameters.of(ALIENGO), dt=0.0005, seed=seed)

    def state() -> RobotState:
        noise, rest = rng.standard_normal((2, 12)), np.zeros(4)
        return RobotState(
            data.time,
            round(1e3 * data.time),
            data.qpos[7:] + 5e-4 * noise[0],
            data.qvel[6:] + 0.03 * noise[1],
            data.ctrl.copy(),
            data.qpos[3:7].copy(),
            data.qvel[3:6].copy(),
            rest[:3],
            rest,
        )

    def answer(command: JointCommand) -> RobotState:
        for _ in range(2):
            q, dq = data.qpos[7:], data.qvel[6:]
            data.ctrl[:] = drives.step(q, dq, command.q, command.kp, command.kd, command.dq, command.tau)
            mujoco.mj_step(model, data)
        return state()

    return state(), answer


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(4, 20))]
)
def test_foot_lifting_goes_through_on_the_ground(seed: int) -> None:
    states, _ = play(FootLifting(ALIENGO), *simulated(seed))
    assert largest_tilt(states) < LEVEL
    height = np.array([foot_positions(ALIENGO, state.q) - ALIENGO.legs.hips for state in states[2500:]])[
        :, :, 2
    ]
    np.testing.assert_allclose(
        height.min(axis=0), -0.4, atol=0.02
    )  # Eq. 9: below the hip, and 0.1 m above that
    np.testing.assert_allclose(np.ptp(height, axis=0), 0.1, atol=0.025)


@pytest.mark.parametrize(
    "seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 10))]
)
def test_foot_lifting_goes_through_on_another_plant(seed: int) -> None:
    states, _ = play(FootLifting(ALIENGO), *other_plant(seed))
    assert largest_tilt(states) < LEVEL


@pytest.mark.parametrize("plant", [simulated, other_plant])
def test_a_sweep_goes_through_on_the_ground(plant: Callable[[int], tuple[RobotState, Body]]) -> None:
    states, _ = play(Sweep(ALIENGO), *plant(0))
    assert largest_tilt(states) < LEVEL


def test_the_feet_carry_the_robots_weight_and_a_lifted_foot_nothing() -> None:
    torque = FootLifting(ALIENGO, seconds=1.0).support_torque()
    model = load_model(ALIENGO)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_forward(model, data)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, data.geom("FR_foot").xpos, model.body("FR_calf").id)
    quarter = ALIENGO.mass * GRAVITY / 4
    np.testing.assert_allclose(torque[0][:3], -quarter * jacobian[2, 6:9], atol=1e-4)
    np.testing.assert_allclose(
        torque[125][[0, 1, 2, 9, 10, 11]], 0.0, atol=1e-9
    )  # FR and RL at their highest
    np.testing.assert_allclose(torque[125][3:6], 2 * torque[0][3:6], atol=1e-6)


def test_in_the_air_nothing_is_carried() -> None:
    begin, _ = simulated(0)
    assert not MotionPlayer(FootLifting(ALIENGO), suspended=True).answer(begin).tau.any()


def test_the_motions_own_gains_are_sent_unless_others_are_asked_for() -> None:
    begin, _ = simulated(0)
    own, asked = (
        MotionPlayer(FootLifting(ALIENGO)).answer(begin),
        MotionPlayer(FootLifting(ALIENGO), 60.0, 2.0).answer(begin),
    )
    assert (own.kp[0], own.kd[0]) == (FootLifting.kp, FootLifting.kd)
    assert (asked.kp[0], asked.kd[0]) == (60.0, 2.0)


def test_the_log_of_foot_lifting_gives_the_gains_and_delays_of_the_drives() -> None:
    states, commands = play(FootLifting(ALIENGO), *simulated(3))
    state = {name: np.array([getattr(s, name) for s in states]) for name in ("q", "dq", "tau")}
    sent = {name: np.array([getattr(c, name) for c in commands]) for name in ("q", "tau", "kp", "kd")}
    t = PERIOD_S * np.arange(len(states))
    log = Log(
        name="lift",
        joints=JOINT_NAMES,
        t=t,
        **state,
        valid=np.ones((len(t), 12), bool),
        t_cmd=t,
        q_des=sent["q"],
        tau_ff=sent["tau"],
        kp=sent["kp"],
        kd=sent["kd"],
    )
    found, own = identify([log]).parameters, ActuatorParameters.of(ALIENGO)
    assert (found.kp_ref, found.kd_ref) == (FootLifting.kp, FootLifting.kd)
    assert np.mean(found.delta_kp) / found.kp_ref == pytest.approx(
        np.mean(own.delta_kp) / own.kp_ref, rel=0.1
    )
    assert np.mean(found.delta_kd) / found.kd_ref == pytest.approx(
        np.mean(own.delta_kd) / own.kd_ref, rel=0.3
    )
    assert found.pairs[0].input_delay_s == pytest.approx(0.007, abs=2e-4)
    assert found.pairs[0].output_delay_s == pytest.approx(0.001, abs=2e-4)
    assert found.effects == ()
