"""The gait that teacher and student walk on: its legs, its forces, its clock's feet, and the ground that they feel."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel[train]'")

from quadvel_description import kinematics, robot  # noqa: E402
from quadvel_training import gait, ground  # noqa: E402
from quadvel_training.legs import Legs, angles, columns, joints  # noqa: E402


def tensor(values) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


@pytest.fixture
def postures():
    rng = np.random.default_rng(2)
    return robot.NOMINAL_Q + rng.uniform(-0.4, 0.4, (50, 12))


def test_legs_agree_with_the_kinematics_of_the_nodes(postures):
    legs = Legs(columns(tensor(postures)))
    feet, jacobians = kinematics.foot_kinematics(postures)
    assert np.allclose(legs.feet.mT, feet, atol=1e-6)
    force = np.random.default_rng(3).normal(0, 50, (50, 4, 3))
    torque = np.einsum("nfij,nfi->nfj", jacobians, force)
    assert np.allclose(legs.torques(tensor(force).mT).mT, torque, atol=1e-4)


def test_angles_lead_back_to_the_feet_and_reach_no_further_than_the_leg(postures):
    feet = kinematics.foot_positions(postures)
    assert np.allclose(joints(angles(tensor(feet).mT)), postures, atol=1e-4)
    far = tensor(feet * [1.0, 1.0, 3.0]).mT
    knees = angles(far)[..., 2, :]
    assert (knees > -0.1).all()
    assert (knees < 0).all()


@pytest.mark.parametrize("down", [(1, 1, 1, 1), (1, 0, 0, 1), (0, 1, 1, 1), (0, 0, 0, 0)])
def test_forces_are_the_regularised_least_squares_of_a_wrench(down):
    rng = np.random.default_rng(4)
    feet = kinematics.foot_positions(robot.NOMINAL_Q + rng.normal(0, 0.1, 12)) - gait.COM
    wrench = rng.normal(0, 1, 6) * [30, 30, 200, 15, 15, 15]
    load = np.array(down, float) / max(sum(down), 2)
    cross = [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in feet]
    a = np.concatenate([np.vstack([np.eye(3), s]) * w for s, w in zip(cross, load, strict=True)], axis=1)
    solved = a.T @ np.linalg.solve(a @ a.T + 1e-4 * np.eye(6), wrench)
    expected = solved.reshape(4, 3) * load[:, None]
    force, moment = tensor(wrench[:3, None]), tensor(wrench[3:, None])
    shared = gait._shared_out(force, moment, tensor(feet.T), tensor([down]))
    assert np.allclose(shared.T, expected, atol=0.02)


def test_diagonal_pairs_alternate_and_all_feet_stay_down_in_stance():
    walking, standing = tensor([0.6, 0.0, 0.0, 0.0]), tensor([0.0, 0.0, 0.0, 1.0])
    for phase, feet in ((0.3, [True, False, False, True]), (0.8, [False, True, True, False])):
        assert gait.Cycle(tensor([phase]), walking).down.tolist() == feet
        assert gait.Cycle(tensor([phase]), standing).down.all()


def test_a_swing_foot_rises_only_in_its_swing_and_lands():
    cycle = gait.Cycle(tensor(np.linspace(0, 0.99, 100)[:, None]), tensor([[0.6, 0.0, 0.0, 0.0]]))
    lift = cycle.lift(cycle.swing())
    assert (lift[cycle.down] == 0).all()
    assert lift.max() == pytest.approx(gait.LIFT, rel=0.01)


def test_a_leg_passes_from_swing_to_push_and_back_without_a_jump():
    """The same robot over a cycle in ticks of 5 ms: no target moves by more than a quarter of its range at once."""
    still, level = torch.zeros(100, 3), torch.zeros(100, 2)
    command, q = tensor([[0.6, 0.2, 0.3, 0.0]]), columns(tensor(robot.NOMINAL_Q)).expand(100, 3, 4)
    phase = gait.frequency(gait.speed(command)) * 0.005 * torch.arange(100.0)[:, None]
    cycle = gait.Cycle(phase, command)
    body = gait.Body(q, still, still, level, level, torch.full((100, 1), gait.HEIGHT))
    targets = gait.targets(cycle, body)
    step, reach = targets.diff(dim=0).abs().amax(0), targets.amax(0) - targets.amin(0)
    assert (step < 0.25 * reach).all()


def standing_legs(command, phase=0.25):
    """A robot in its nominal posture that walks as commanded, where legs 0 and 3 stand: cycle, body."""
    given = tensor([command])
    vx, vy, wz, _ = command
    q, level = columns(tensor(robot.NOMINAL_Q))[None], torch.zeros(1, 2)
    body = gait.Body(
        q, tensor([[vx, vy, 0.0]]), tensor([[0.0, 0.0, wz]]), level, level, tensor([[gait.HEIGHT]])
    )
    return gait.Cycle(tensor([[phase]]), given), body


def test_in_a_curve_the_feet_push_inward_and_nothing_else_than_the_weight():
    """A trunk that goes round at v with w accelerates by w x v; drives know of no force but what they are told."""
    cycle, body = standing_legs([1.2, 0.3, 0.8, 0.0])
    legs = Legs(body.q)
    force = gait._stance_forces(cycle, body, legs.feet, cycle.load()[..., None, :]).sum(-1)[0]
    expected = robot.MASS * np.array([-0.8 * 0.3, 0.8 * 1.2, robot.GRAVITY])
    assert np.allclose(force, expected, rtol=0.01, atol=2.0)  # shared out by least squares, with moments


def test_standing_feet_are_led_as_the_trunk_goes_over_them():
    """Targets at a command less those at rest: the joint velocities of a foot at rest on the ground, for LEAD."""
    feet, jacobians = kinematics.foot_kinematics(robot.NOMINAL_Q[None])
    at, before = feet[0, 0], robot.NOMINAL_Q[:3]
    over_ground = np.array([0.3, 0.05, 0.0]) + np.cross([0.0, 0.0, 0.2], at)
    expected = -gait.LEAD * np.linalg.solve(jacobians[0, 0], over_ground)
    cycle, body = standing_legs([0.3, 0.05, 0.2, 0.0])
    force = gait._stance_forces(cycle, body, Legs(body.q).feet, cycle.load()[..., None, :])
    held = before - (Legs(body.q).torques(force) / robot.KP)[0, :, 0].numpy()
    assert np.allclose(gait.targets(cycle, body)[0, :3].numpy() - held, expected, atol=1e-3)


@pytest.mark.parametrize("stands", [1.0, 0.0])
def test_in_stance_and_only_then_feet_are_led_back_to_where_they_stand(stands):
    """What is left of the targets of feet that parted, without the forces' share: nominal places, or the feet's own."""
    parted = robot.NOMINAL_Q + np.array([-0.1, 0.1, -0.2, 0.1, 0.1, -0.2] * 2)
    cycle, body = standing_legs([0.0, 0.0, 0.0, stands])
    legs = Legs(columns(tensor(parted))[None])
    body = attrs.evolve(body, q=columns(tensor(parted))[None])
    force = gait._stance_forces(cycle, body, legs.feet, cycle.load()[..., None, :])
    led = gait.targets(cycle, body) + joints(legs.torques(force)) / tensor(robot.KP)
    at = kinematics.foot_positions(led[0].numpy())
    expected = kinematics.foot_positions(robot.NOMINAL_Q if stands else parted)
    assert np.allclose(at[[0, 3], :2], expected[[0, 3], :2], atol=1e-3)


def test_every_leg_pushes_wholly_in_stance_and_as_the_first_step_begins():
    begin = tensor([0.0])
    assert (gait.Cycle(begin, tensor([0.0, 0.0, 0.0, 1.0])).load() == 1).all()
    assert (gait.Cycle(begin, tensor([0.05, 0.0, 0.0, 0.0])).load() > 0.99).all()


def test_the_feet_feel_height_and_slope_of_a_plane():
    height, slope = 0.37, np.array([0.15, -0.08])  # it falls away forward, and rises to the left
    feet = kinematics.foot_positions(robot.NOMINAL_Q).T
    feet[2] = robot.FOOT_RADIUS - height - slope @ feet[:2]
    known = torch.zeros(1, ground.SIZE)
    up, still, down = tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3), torch.ones(1, 4, dtype=torch.bool)
    for _ in range(2000):
        known = ground.advance(known, tensor(feet)[None], up, still, down)
    assert np.allclose(known[0], [height - gait.HEIGHT, *slope], atol=1e-3)


def test_a_trunk_along_a_hill_feels_its_height_along_the_vertical():
    steep, off = 0.26, 0.38  # rad, m at right angles to the ground
    feet = kinematics.foot_positions(robot.NOMINAL_Q).T
    feet[0] -= 0.1  # they stand behind the trunk
    feet[2] = robot.FOOT_RADIUS * np.cos(steep) - off
    up = np.array([np.sin(steep), 0.0, np.cos(steep)])  # its nose is up
    known = torch.zeros(1, ground.SIZE)
    for _ in range(2000):
        known = ground.advance(
            known, tensor(feet)[None], tensor(up)[None], torch.zeros(1, 3), torch.ones(1, 4) > 0
        )
    assert np.isclose(known[0, 0] + gait.HEIGHT, off / np.cos(steep), atol=1e-3)
    assert np.allclose(known[0, 1:], [-np.tan(steep) / np.cos(steep), 0.0], atol=1e-3)


def test_lifted_feet_tell_nothing_of_the_ground_and_a_walk_uphill_keeps_its_height():
    feet = tensor(kinematics.foot_positions(robot.NOMINAL_Q).T)[None]
    up, none = tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 4, dtype=torch.bool)
    lifted = feet + tensor([0.0, 0.0, 0.1])[:, None]
    known = tensor([[0.0265, 0.0, 0.0]])
    assert torch.equal(ground.advance(known, lifted, up, torch.zeros(1, 3), none), known)
    uphill, climbing = tensor([[0.0265, -0.2, 0.0]]), tensor([[1.0, 0.0, 0.2]])
    assert np.allclose(ground.advance(uphill, lifted, up, climbing, none), uphill, atol=1e-7)
