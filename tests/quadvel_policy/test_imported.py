"""Policies of other projects: read, run as their own formulas say, or refused by file and field.

The networks are written here: one matrix with known weights. The expected joint targets are computed
with loops over names, independently of the code under test.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import onnx
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

from quadvel_bringup import cli
from quadvel_bringup.import_policy import import_command
from quadvel_description.kinematics import rotate
from quadvel_description.network_file import NetworkFileError
from quadvel_description.quadruped import JOINT_NAMES
from quadvel_description.robot import Robot
from quadvel_description.state import JointCommand, RobotState
from quadvel_eval.walk import Setup, make_loop, record_until_fall
from quadvel_policy.imported.importer import Supplement
from quadvel_policy.imported.importer import import_policy as read_policy
from quadvel_policy.imported.metadata import ImportedMetadata
from quadvel_policy.imported.policy import ImportedPolicy
from quadvel_policy.modes import ModeInput, Walk
from quadvel_policy.policy_file import PolicyFile, load_policy
from tests.helpers.robots import ALIENGO, GO2

LEFT_FIRST = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
"""Motor index of each joint of a network with the order FL, FR, RL, RR."""
BY_KIND = [f"{leg}_{kind}_joint" for kind in ("hip", "thigh", "calf") for leg in ("FL", "FR", "RL", "RR")]
POSTURE = [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]
LIMITS = Supplement(limits=(1.0, 0.5, 1.0))
DEPLOY = {
    "joint_ids_map": LEFT_FIRST,
    "step_dt": 0.02,
    "stiffness": [20.0 + i for i in range(12)],
    "damping": [0.5] * 12,
    "default_joint_pos": POSTURE,
    "commands": {
        "base_velocity": {
            "ranges": {"lin_vel_x": [-1.0, 2.0], "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.5, 1.5]}
        }
    },
    "actions": {
        "JointPositionAction": {
            "clip": [[-2.0, 2.0]] * 12,
            "joint_names": [".*"],
            "scale": [0.1 + 0.01 * i for i in range(12)],
            "offset": POSTURE,
            "joint_ids": None,
        }
    },
    "observations": {
        "base_ang_vel": {"params": {}, "clip": [-1.0, 1.0], "scale": [0.25] * 3, "history_length": 3},
        "projected_gravity": {"params": {}, "clip": None, "scale": None, "history_length": 1},
        "velocity_commands": {
            "params": {"command_name": "base_velocity"}, "clip": [-9, 9], "scale": [2.0, 2.0, 0.25]
        },
        "joint_pos_rel": {"params": {}, "clip": None, "scale": [1.0] * 12, "history_length": 2},
        "joint_vel_rel": {"params": {}, "clip": [-100, 100], "scale": [0.05] * 12, "history_length": 1},
        "last_action": {"params": {}, "clip": None, "scale": [1.0] * 12, "history_length": 2},
    },
}  # fmt: skip
BASE = {
    "dt": 0.005,
    "decimation": 4,
    "num_of_dofs": 12,
    "wheel_indices": [],
    "joint_names": list(JOINT_NAMES),
    "joint_mapping": list(range(12)),
    "fixed_kp": [80.0] * 12,
}
CONFIG = {
    "model_name": "policy.pt",
    "num_observations": 48,
    "observations": ["commands", "lin_vel", "ang_vel", "gravity_vec", "dof_pos", "dof_vel", "actions"],
    "observations_history": [0, 2, 1],
    "observations_history_priority": "time",
    "clip_obs": 1.5,
    "clip_actions_lower": [-1.0] * 12,
    "clip_actions_upper": [1.2] * 12,
    "rl_kp": [40.0 + i for i in range(12)],
    "rl_kd": [1.0] * 12,
    "action_scale": [0.125, 0.25, 0.25] * 4,
    "lin_vel_scale": 2.0,
    "ang_vel_scale": 0.25,
    "dof_pos_scale": 1.0,
    "dof_vel_scale": 0.05,
    "commands_scale": [2.0, 2.0, 0.25],
    "default_dof_pos": POSTURE,
    "joint_mapping": LEFT_FIRST,
}
MJLAB = {
    "run_path": "someone/run",
    "joint_names": ",".join(BY_KIND),
    "joint_stiffness": ",".join(["20.000"] * 12),
    "joint_damping": ",".join(["1.000"] * 12),
    "default_joint_pos": ",".join(["0.100", "-0.100"] * 2 + ["0.900"] * 4 + ["-1.800"] * 4),
    "command_names": "twist",
    "observation_names": "base_lin_vel,base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
    "action_scale": "0.500",
}


def write_network(
    path: Path, size: int, properties: Mapping[str, str] | None = None, actions: int = 12, outputs: int = 1
) -> np.ndarray:
    """Write y = x W with random weights (size, actions); returns W. Operators of ONNX's set 11."""
    weights = np.random.default_rng(size).normal(0.0, 0.3, (size, actions)).astype(np.float32)
    names = ["actions", *(f"extra_{i}" for i in range(outputs - 1))]
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["observations", "W"], [name]) for name in names],
        "network",
        [helper.make_tensor_value_info("observations", TensorProto.FLOAT, ["batch", size])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", actions]) for name in names],
        [numpy_helper.from_array(weights, "W")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 11)], ir_version=6)
    helper.set_model_props(model, dict(properties or {}))
    onnx.save(model, path)
    return weights.astype(float)


def write_yaml(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def write_rl_sar(folder: Path, config: Mapping[str, Any] = CONFIG, base: Mapping[str, Any] = BASE) -> Path:
    write_yaml(folder / "go2" / "base.yaml", {"go2": dict(base)})
    return write_yaml(folder / "go2" / "mine" / "config.yaml", {"go2/mine": dict(config)})


def import_policy(
    robot: Robot, weights: Path, config: Path | None, out: Path, supplement: Supplement | None = None
) -> ImportedMetadata:
    """Import into a file."""
    metadata, content = read_policy(robot, weights, config, supplement)
    out.write_bytes(content)
    return metadata


def some_walk(ticks: int = 24) -> list[ModeInput]:
    """Random states, velocities and commands of successive ticks."""
    rng = np.random.default_rng(7)
    inputs = []
    for tick in range(ticks):
        quaternion = rng.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        state = RobotState(
            0.005 * tick, 5 * tick, GO2.nominal_q + rng.normal(0.0, 0.3, 12), rng.normal(0.0, 3.0, 12),
            np.zeros(12), quaternion, rng.normal(0.0, 3.0, 3), np.zeros(3), np.zeros(4),
        )  # fmt: skip
        command = np.array([*rng.uniform(-1.0, 1.0, 3), 0.0])
        inputs.append(ModeInput(1.0, state, rng.normal(size=3), command, JointCommand.damping()))
    return inputs


def walked(policy: ImportedPolicy, inputs: list[ModeInput]) -> list[JointCommand]:
    mode = Walk(policy, blend_time=0.0)
    mode.enter(inputs[0])
    return [mode.tick(one) for one in inputs]


def test_the_command_of_an_imported_policy_is_not_trimmed(tmp_path: Path) -> None:
    size = 3 * 3 + 3 + 3 + 2 * 12 + 12 + 2 * 12
    write_network(tmp_path / "policy.onnx", size, outputs=3)
    out = tmp_path / "out.onnx"
    import_policy(GO2, tmp_path / "policy.onnx", write_yaml(tmp_path / "deploy.yaml", DEPLOY), out)
    constant = [attrs.evolve(one, command=np.array([0.5, 0.0, 0.0, 0.0])) for one in some_walk(600)]
    untrimmed, trimmed = Walk(ImportedPolicy(GO2, out), 0.0), Walk(ImportedPolicy(GO2, out), 0.0, 0.1)
    for one in constant:
        np.testing.assert_array_equal(trimmed.tick(one).q, untrimmed.tick(one).q)


def gravity(state: RobotState) -> list[float]:
    """Projections of the direction down on the axes of the body, by the axes in the world."""
    return [float(rotate(state.quaternion, axis) @ [0.0, 0.0, -1.0]) for axis in np.eye(3)]


def by_name(values: Any, names: list[str]) -> list[float]:
    return [float(values[JOINT_NAMES.index(name)]) for name in names]


def motors(indices: list[int]) -> list[str]:
    return [JOINT_NAMES[i] for i in indices]


def test_a_deploy_yaml_runs_as_its_terms_and_its_joint_map_say(tmp_path: Path) -> None:
    size = 3 * 3 + 3 + 3 + 2 * 12 + 12 + 2 * 12
    weights = write_network(tmp_path / "policy.onnx", size, outputs=3)
    config = write_yaml(tmp_path / "deploy.yaml", DEPLOY)
    out = tmp_path / "out.onnx"
    metadata = import_policy(GO2, tmp_path / "policy.onnx", config, out)
    inputs, names = some_walk(), motors(LEFT_FIRST)
    commands = walked(ImportedPolicy(GO2, out), inputs)

    scale = DEPLOY["actions"]["JointPositionAction"]["scale"]
    turns: list[list[float]] = []
    postures: list[list[float]] = []
    actions: list[list[float]] = []
    previous = [0.0] * 12
    for tick, (one, command) in enumerate(zip(inputs, commands, strict=True)):
        if tick % 4 == 0:
            turns.append([0.25 * min(max(v, -1.0), 1.0) for v in one.state.angular_velocity])
            postures.append([q - p for q, p in zip(by_name(one.state.q, names), POSTURE, strict=True)])
            actions.append(previous)
            while len(turns) < 3:  # the history starts full of the first observation
                turns, postures, actions = turns + turns[:1], postures + postures[:1], actions + actions[:1]
            x = [*turns[-3], *turns[-2], *turns[-1], *gravity(one.state)]
            x += [2.0 * one.command[0], 2.0 * one.command[1], 0.25 * one.command[2]]
            x += [*postures[-2], *postures[-1], *(0.05 * dq for dq in by_name(one.state.dq, names))]
            x += [*actions[-2], *actions[-1]]
            previous = (np.array(x) @ weights).tolist()
            wanted = {
                name: min(max(p + s * a, -2.0), 2.0)
                for name, p, s, a in zip(names, POSTURE, scale, previous, strict=True)
            }
        np.testing.assert_allclose(command.q, [wanted[name] for name in JOINT_NAMES], atol=1e-4)
        np.testing.assert_array_equal(command.kp, DEPLOY["stiffness"])  # in the order of the motors
    assert metadata.rate_hz == 50.0
    assert metadata.limits.clamp((9.0, -9.0, 9.0)) == (2.0, -0.5, 1.5)
    assert dict(zip(JOINT_NAMES, metadata.nominal_q, strict=True))["FL_hip_joint"] == 0.1


def test_gym_history_puts_step_after_step(tmp_path: Path) -> None:
    config = copy.deepcopy(DEPLOY)
    config["observations"] = {
        "use_gym_history": True,
        "base_ang_vel": {"params": {}, "clip": None, "scale": None, "history_length": 2},
        "projected_gravity": {"params": {}, "clip": None, "scale": None, "history_length": 2},
    }
    write_network(tmp_path / "policy.onnx", 12)
    path = write_yaml(tmp_path / "deploy.yaml", config)
    observer = import_policy(GO2, tmp_path / "policy.onnx", path, tmp_path / "out.onnx").observer
    first, second = some_walk(2)
    for one in (first, second):
        observed = observer.observe(one.state, np.zeros(3), one.command, np.zeros(12))
    expected = [
        value for one in (first, second) for value in (*one.state.angular_velocity, *gravity(one.state))
    ]
    np.testing.assert_allclose(observed, expected, atol=1e-6)


def test_rl_sar_files_run_with_the_newest_observation_first(tmp_path: Path) -> None:
    weights = write_network(tmp_path / "policy.onnx", 3 * 48)
    out = tmp_path / "out.onnx"
    metadata = import_policy(GO2, tmp_path / "policy.onnx", write_rl_sar(tmp_path), out, LIMITS)
    inputs, names = some_walk(), motors(LEFT_FIRST)
    commands = walked(ImportedPolicy(GO2, out), inputs)

    frames: list[list[float]] = []
    action = [0.0] * 12
    for tick, (one, command) in enumerate(zip(inputs, commands, strict=True)):
        if tick % 4 == 0:
            assert one.velocity is not None
            frame = [2.0 * one.command[0], 2.0 * one.command[1], 0.25 * one.command[2]]
            frame += [2.0 * v for v in one.velocity] + [0.25 * w for w in one.state.angular_velocity]
            frame += gravity(one.state)
            frame += [q - p for q, p in zip(by_name(one.state.q, names), POSTURE, strict=True)]
            frame += [0.05 * dq for dq in by_name(one.state.dq, names)] + action
            frame = [min(max(value, -1.5), 1.5) for value in frame]
            frames = [frame, *frames] if frames else [frame] * 3
            raw = np.array(frames[0] + frames[2] + frames[1]) @ weights
            action = [min(max(a, -1.0), 1.2) for a in raw]
            wanted = {
                name: p + s * a
                for name, p, s, a in zip(names, POSTURE, CONFIG["action_scale"], action, strict=True)
            }
        np.testing.assert_allclose(command.q, [wanted[name] for name in JOINT_NAMES], atol=1e-4)
    gains = dict(zip(names, CONFIG["rl_kp"], strict=True))
    np.testing.assert_array_equal(commands[0].kp, [gains[name] for name in JOINT_NAMES])
    assert metadata.limits.clamp((-9.0, 9.0, 0.5)) == (-1.0, 0.5, 0.5)


def test_mjlab_metadata_run_in_the_order_of_its_joint_names(tmp_path: Path) -> None:
    weights = write_network(tmp_path / "policy.onnx", 48, MJLAB)
    out = tmp_path / "out.onnx"
    supplement = Supplement(limits=(1.0, 0.5, 1.0), rate_hz=100.0)
    import_policy(GO2, tmp_path / "policy.onnx", None, out, supplement)
    inputs = some_walk()
    commands = walked(ImportedPolicy(GO2, out), inputs)

    posture = [float(text) for text in MJLAB["default_joint_pos"].split(",")]
    action = [0.0] * 12
    for tick, (one, command) in enumerate(zip(inputs, commands, strict=True)):
        if tick % 2 == 0:
            assert one.velocity is not None
            x = [*one.velocity, *one.state.angular_velocity, *gravity(one.state)]
            x += [q - p for q, p in zip(by_name(one.state.q, BY_KIND), posture, strict=True)]
            x += [*by_name(one.state.dq, BY_KIND), *action, *one.command[:3]]
            action = (np.array(x) @ weights).tolist()
            wanted = {name: p + 0.5 * a for name, p, a in zip(BY_KIND, posture, action, strict=True)}
        np.testing.assert_allclose(command.q, [wanted[name] for name in JOINT_NAMES], atol=1e-4)


def test_a_new_entry_forgets_history_and_action(tmp_path: Path) -> None:
    write_network(tmp_path / "policy.onnx", 3 * 48)
    out = tmp_path / "out.onnx"
    import_policy(GO2, tmp_path / "policy.onnx", write_rl_sar(tmp_path), out, LIMITS)
    inputs = some_walk()
    mode = Walk(ImportedPolicy(GO2, out), blend_time=0.0)
    runs = []
    for _ in range(2):
        mode.enter(inputs[0])
        runs.append([mode.tick(one).q for one in inputs[:6]])
    np.testing.assert_array_equal(*runs)


def changed(content: Any, place: str, value: object) -> Any:
    """A copy with the value at a place such as `a.b`; None removes the field."""
    copied = copy.deepcopy(content)
    inner, names = copied, place.split(".")
    for name in names[:-1]:
        inner = inner[name]
    if value is None:
        del inner[names[-1]]
    else:
        inner[names[-1]] = value
    return copied


@pytest.mark.parametrize(
    ("place", "value", "sentence"),
    [
        ("step_dt", None, "step_dt: found nothing, expected a finite number"),
        ("step_dt", 0.017, "step_dt: found 0.017, expected a multiple of 0.005 s"),
        ("step_dt", 20.0, "step_dt: found 20.0, expected a multiple of 0.005 s, at most 0.1 s"),
        ("joint_ids_map", [0] * 12, "joint_ids_map: found [0, 0, "),
        ("stiffness", [1.0, 2.0], "stiffness: found [1.0, 2.0], expected a finite number or 12 of them"),
        ("damping", "soft", "damping: found 'soft'"),
        ("motors", 12, "motors: found 12, expected only joint_ids_map"),
        ("default_joint_pos", [0.0] * 12, "default_joint_pos[5], FR_calf_joint"),
        ("commands.base_velocity.ranges.lin_vel_y", None, "ranges.lin_vel_y: found nothing"),
        ("actions.JointVelocityAction", {}, "actions.JointVelocityAction: found {}"),
        ("actions.JointPositionAction.offset", None, "JointPositionAction.offset: found nothing"),
        ("actions.JointPositionAction.joint_ids", [0, 1], "joint_ids: found [0, 1], expected null"),
        ("observations.height_scan", {"params": {}}, "observations.height_scan: found "),
        ("observations.last_action.scale", [1.0], "last_action.scale: found [1.0]"),
        ("observations.last_action.clip", [1, -1], "last_action.clip: found [1, -1], expected a pair"),
        ("observations.last_action.noise", 0.1, "last_action.noise: found 0.1"),
        ("observations.joint_pos_rel.params", {"asset_cfg": {"joint_ids": [0]}}, "joint_pos_rel.params"),
        ("observations.joint_pos_rel.history_length", 0.5, "history_length: found 0.5"),
    ],
)  # fmt: skip
def test_a_deploy_yaml_that_does_not_fit_is_refused_by_field(
    tmp_path: Path, place: str, value: object, sentence: str
) -> None:
    write_network(tmp_path / "policy.onnx", 75)
    config = write_yaml(tmp_path / "deploy.yaml", changed(DEPLOY, place, value))
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        import_policy(GO2, tmp_path / "policy.onnx", config, tmp_path / "out.onnx")
    assert str(caught.value).startswith(f"{config}: ")
    assert sentence in str(caught.value)
    assert not (tmp_path / "out.onnx").exists()


@pytest.mark.parametrize(
    ("place", "value", "sentence"),
    [
        ("rl_kp", None, "config.yaml: rl_kp: found nothing"),
        ("num_observations", 45, "num_observations: found 45.* expected 48"),
        ("observations", ["gait_phase"], "observations: found .'gait_phase'., expected only .* not 'gait_phase'"),
        ("use_pmtg_controller", True, "use_pmtg_controller: found True, expected only dt"),
        ("wheel_indices", [3], r"wheel_indices: found \[3\], expected none"),
        ("observations_history", [-1], r"observations_history: found \[-1\]"),
        ("observations_history_priority", "place", "observations_history_priority: found 'place'"),
        ("decimation", 3.5, r"decimation: found 3.5, expected dt \* decimation"),
    ],
)  # fmt: skip
def test_rl_sar_files_that_do_not_fit_are_refused_by_field(
    tmp_path: Path, place: str, value: object, sentence: str
) -> None:
    write_network(tmp_path / "policy.onnx", 3 * 48)
    config = write_rl_sar(tmp_path, changed(CONFIG, place, value))
    with pytest.raises(ValueError, match=sentence):
        import_policy(GO2, tmp_path / "policy.onnx", config, tmp_path / "out.onnx", LIMITS)


def test_a_wrong_field_of_the_base_yaml_is_named_with_that_file(tmp_path: Path) -> None:
    write_network(tmp_path / "policy.onnx", 3 * 48)
    config = write_rl_sar(tmp_path, base=BASE | {"num_of_dofs": 16})
    with pytest.raises(ValueError, match=r"base\.yaml: num_of_dofs: found 16, expected 12"):
        import_policy(GO2, tmp_path / "policy.onnx", config, tmp_path / "out.onnx", LIMITS)
    (tmp_path / "go2" / "base.yaml").unlink()
    with pytest.raises(ValueError, match=r"config\.yaml: found no base\.yaml"):
        import_policy(GO2, tmp_path / "policy.onnx", config, tmp_path / "out.onnx", LIMITS)


def test_rl_sar_files_of_another_robot_are_refused(tmp_path: Path) -> None:
    write_network(tmp_path / "policy.onnx", 3 * 48)
    with pytest.raises(ValueError, match="robot: found 'go2', expected 'aliengo'"):
        import_policy(
            ALIENGO, tmp_path / "policy.onnx", write_rl_sar(tmp_path), tmp_path / "out.onnx", LIMITS
        )


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("joint_names", "a,b", "metadata.joint_names: found .'a', 'b'., expected each of FR_hip_joint"),
        ("joint_damping", None, "metadata.joint_damping: found nothing"),
        ("command_names", "twist,height", "metadata.command_names"),
        ("observation_names", "height_scan", "observation_names: .* not 'height_scan'"),
        ("anchor_body_name", "torso", "metadata.anchor_body_name: found .'torso'., expected only"),
    ],
)
def test_mjlab_metadata_that_do_not_fit_are_refused_by_field(
    tmp_path: Path, field: str, value: str | None, sentence: str
) -> None:
    weights = tmp_path / "policy.onnx"
    write_network(weights, 48, changed(MJLAB, field, value))
    supplement = Supplement(limits=(1.0, 1.0, 1.0), rate_hz=50.0)
    with pytest.raises(ValueError, match=sentence):
        import_policy(GO2, weights, None, tmp_path / "out.onnx", supplement)


@pytest.mark.parametrize(
    ("supplement", "sentence"),
    [
        (Supplement(rate_hz=50.0), "command limits: found nothing"),
        (LIMITS, "metadata.rate: found nothing"),
        (Supplement(limits=(1.0, 1.0, 1.0), rate_hz=60.0), "rate_hz: found 60.0, expected 200 divided by"),
        (Supplement(limits=(-1.0, 1.0, 1.0), rate_hz=50.0), "command_limits.vx"),
    ],
)
def test_what_a_format_lacks_has_to_be_given(tmp_path: Path, supplement: Supplement, sentence: str) -> None:
    write_network(tmp_path / "policy.onnx", 48, MJLAB)
    with pytest.raises(ValueError, match=sentence):
        import_policy(GO2, tmp_path / "policy.onnx", None, tmp_path / "out.onnx", supplement)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"size": 74}, r"shape of input observations is \['batch', 74\], expected \[1, 75\]"),
        ({"size": 75, "actions": 24}, r"shape of output actions is \(1, 24\), expected \(1, 12\)"),
    ],
)
def test_a_network_that_does_not_fit_its_file_is_refused(
    tmp_path: Path, changes: dict[str, int], sentence: str
) -> None:
    weights = tmp_path / "policy.onnx"
    write_network(weights, **changes)
    with pytest.raises(NetworkFileError, match=rf"policy\.onnx: {sentence}"):
        import_policy(GO2, weights, write_yaml(tmp_path / "deploy.yaml", DEPLOY), tmp_path / "out.onnx")


def test_torchscript_is_refused_unopened(tmp_path: Path) -> None:
    (tmp_path / "policy.pt").touch()
    with pytest.raises(NetworkFileError, match=r"policy\.pt: is a pickle, .* expected ONNX"):
        import_policy(GO2, tmp_path / "policy.pt", None, tmp_path / "out.onnx")


def test_a_policy_that_holds_its_posture_stands_in_the_loop(tmp_path: Path) -> None:
    """With a network of zeros, and the supervisor, the guards and the filter of our own policies."""
    path, out = tmp_path / "policy.onnx", tmp_path / "out.onnx"
    write_network(path, 75)
    model = onnx.load(path)
    model.graph.initializer[0].raw_data = bytes(len(model.graph.initializer[0].raw_data))
    onnx.save(model, path)
    deploy = changed(DEPLOY, "stiffness", 40.0)
    import_policy(GO2, path, write_yaml(tmp_path / "deploy.yaml", deploy), out)
    loop = make_loop(Setup(robot="go2", policy=out, estimator="kalman"), 0, ())
    walk, stood = record_until_fall(loop, [((0.0, 0.0, 0.0), 1.0)])
    assert stood, loop.supervisor.reason
    assert walk is not None
    posture = dict(zip(motors(LEFT_FIRST), POSTURE, strict=True))
    np.testing.assert_allclose(walk.targets[-1], [posture[name] for name in JOINT_NAMES], atol=1e-6)
    assert np.abs(walk.velocity[-1]).max() < 0.02


def test_a_network_without_configuration_is_refused(tmp_path: Path) -> None:
    write_network(tmp_path / "policy.onnx", 45)
    with pytest.raises(ValueError, match=r"metadata: found nothing, expected mjlab's observation_names"):
        import_policy(GO2, tmp_path / "policy.onnx", None, tmp_path / "out.onnx")


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    write_network(tmp_path / "policy.onnx", 75)
    out = tmp_path / "out.onnx"
    import_policy(GO2, tmp_path / "policy.onnx", write_yaml(tmp_path / "deploy.yaml", DEPLOY), out)
    return out


def test_the_command_prints_what_it_read_of_each_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_network(tmp_path / "policy.onnx", 75)
    deploy = {**DEPLOY, "stiffness": [20.0 + i for i in range(12)]}
    config = write_yaml(tmp_path / "deploy.yaml", deploy)
    import_command(tmp_path / "policy.onnx", tmp_path / "out.onnx", "go2", config, None, None)
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "_joint " in line]
    assert [row[1] for row in rows] == motors(DEPLOY["joint_ids_map"])
    assert [float(row[-2]) for row in rows] == [20.0 + motor for motor in DEPLOY["joint_ids_map"]]


def test_an_imported_file_loads_for_its_robot_alone(imported: Path) -> None:
    assert isinstance(load_policy(GO2, imported), ImportedPolicy)
    with pytest.raises(NetworkFileError, match="robot is 'go2', expected 'aliengo'"):
        load_policy(ALIENGO, imported)
    with pytest.raises(
        NetworkFileError, match=r"out\.onnx: found a policy of another project \(quadvel_imported\)"
    ):
        PolicyFile(GO2, imported)


def test_the_figures_of_the_paper_are_refused_for_an_imported_policy(imported: Path) -> None:
    with pytest.raises(NetworkFileError, match="expected one of this project: imported policies run with up"):
        cli.command("paper").main(["--robot", "go2", "--policy", f"mine={imported}"], standalone_mode=False)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("rate_hz", 60.0, "rate_hz: found 60.0"),
        ("terms", [], "terms: found"),
        ("joint_map", [1] * 12, "joint_map: found"),
        ("schema", 2, "schema: found 2, expected one of 1"),
        ("gain", 1.0, "found the field 'gain'"),
    ],
)
def test_changed_metadata_are_refused_by_field(
    imported: Path, field: str, value: object, sentence: str
) -> None:
    model = onnx.load(imported)
    (entry,) = model.metadata_props
    entry.value = json.dumps(json.loads(entry.value) | {field: value})
    onnx.save(model, imported)
    with pytest.raises(NetworkFileError, match=rf"out\.onnx: .*{sentence}"):
        load_policy(GO2, imported)
