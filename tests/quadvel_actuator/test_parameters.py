"""The actuator parameter file: Table 4, round trip, and errors that name field and value."""

import attrs
import numpy as np
import pytest
import yaml

from quadvel_actuator import ActuatorModel, ActuatorParameters, DelayPair, Effect
from tests.helpers.robots import ALIENGO, GO2


def _written(tmp_path, **changes):
    path = tmp_path / "changed.yaml"
    ActuatorParameters.of(ALIENGO).save(path)
    values = yaml.safe_load(path.read_text()) | changes
    path.write_text(yaml.safe_dump({key: value for key, value in values.items() if value is not None}))
    return path


def test_the_shipped_default_is_table_4():
    shipped = ActuatorParameters.of(ALIENGO)
    assert (shipped.kp_ref, shipped.kd_ref, shipped.delta_kp, shipped.delta_kd) == (30.0, 0.5, -0.706, -0.021)
    assert shipped.torque_noise == 0.066
    assert shipped.best_pair == DelayPair(0.007, 0.001, 0.066)
    inputs = {pair.input_delay_s for pair in shipped.probable_pairs}
    outputs = {pair.output_delay_s for pair in shipped.probable_pairs}
    assert inputs == {0.006, 0.007, 0.008}
    assert outputs == {0.0, 0.001, 0.002}


def test_probable_pairs_lie_under_one_and_a_half_times_the_least_error():
    errors = [0.5, 0.25, 0.374, 0.375]
    pairs = [DelayPair(0.001 * i, 0.0, error) for i, error in enumerate(errors)]
    parameters = attrs.evolve(ActuatorParameters.of(ALIENGO), pairs=pairs)
    assert [pair.mse for pair in parameters.probable_pairs] == [0.25, 0.374]


@pytest.mark.parametrize("robot", [ALIENGO, GO2], ids=lambda robot: robot.name)
def test_ideal_is_a_plain_pd_law(robot):
    ideal = ActuatorParameters.ideal(robot)
    assert ideal.effects == ()
    assert (ideal.delta_kp, ideal.delta_kd, ideal.torque_noise) == (0.0, 0.0, 0.0)
    assert ideal.probable_pairs == (DelayPair(0.0, 0.0, 0.0),)


def test_saved_parameters_load_unchanged_with_their_effects(tmp_path):
    effect = Effect(
        "friction", ["FR_hip_joint"], {"coulomb": 0.4}, {"coulomb": "N m"}, {"coulomb": [0.35, 0.45]}
    )
    saved = attrs.evolve(
        ActuatorParameters.of(ALIENGO), delta_kp=[-0.1 * i for i in range(12)], effects=[effect]
    )
    saved.save(tmp_path / "saved.yaml")
    assert ActuatorParameters.load(ALIENGO, tmp_path / "saved.yaml") == saved
    assert "# Variance of the torque noise (N^2 m^2)." in (tmp_path / "saved.yaml").read_text()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"schema": 2}, "ActuatorParameters.schema: found 2, expected one of 1"),
        ({"robot": "go2"}, "ActuatorParameters.robot: found 'go2', expected 'aliengo'"),
        ({"kp_ref": -1}, "ActuatorParameters.kp_ref: found -1.0, expected above 0"),
        (
            {"delta_kp": [0.1] * 11},
            "ActuatorParameters.delta_kp: found .* expected a number, 3 numbers or 12 numbers",
        ),
        ({"delta_kd": "soft"}, "delta_kd: found 'soft', expected a number"),
        ({"torque_noise": float("nan")}, "ActuatorParameters.torque_noise: found nan, expected at least 0"),
        (
            {"torque_limit": [35.0, 0.0, 44.0]},
            r"ActuatorParameters.torque_limit: found .*, expected finite numbers, above 0",
        ),
        ({"pairs": []}, "ActuatorParameters.pairs: found .*, expected at least one pair"),
        (
            {"pairs": [{"input_delay_s": -0.1, "output_delay_s": 0, "mse": 1}]},
            r"pairs\[0\]: DelayPair.input_delay_s: found -0.1, expected at least 0",
        ),
        (
            {"pairs": [{"input_delay_s": 0.1, "mse": 1}]},
            r"pairs\[0\].output_delay_s: found nothing, expected a value",
        ),
        ({"torque_noise": None}, "torque_noise: found nothing, expected a value"),
        ({"stiffness": 3}, "found the field 'stiffness', expected one of schema, name"),
        (
            {"effects": [{"name": "friction", "joints": [], "parameters": {}}]},
            r"effects\[0\]: Effect.joints: found",
        ),
    ],
)
def test_a_wrong_file_is_refused_with_file_field_value_and_expectation(tmp_path, changes, sentence):
    path = _written(tmp_path, **changes)
    with pytest.raises(ValueError, match=f"^{path}: {sentence}"):
        ActuatorParameters.load(ALIENGO, path)


@pytest.mark.parametrize("text", ["a: [1, 2", "- 1\n- 2\n", ""])
def test_a_file_that_is_no_parameter_mapping_is_refused(tmp_path, text):
    path = tmp_path / "odd.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"^{path}: .+"):
        ActuatorParameters.load(ALIENGO, path)


def test_a_file_without_a_name_is_that_of_the_aliengo(tmp_path):
    assert ActuatorParameters.load(ALIENGO, _written(tmp_path, robot=None)).robot == "aliengo"
    with pytest.raises(ValueError, match=r"changed\.yaml: .*robot: found 'aliengo', expected 'go2'"):
        ActuatorParameters.load(GO2, _written(tmp_path, robot=None))


def test_a_file_of_some_joints_is_refused_where_all_are_needed(tmp_path):
    few = attrs.evolve(ActuatorParameters.of(ALIENGO), joints=["FR_hip_joint", "FR_thigh_joint"], effects=())
    few.save(tmp_path / "few.yaml")
    assert ActuatorParameters.load(ALIENGO, tmp_path / "few.yaml", some_joints=True) == few
    with pytest.raises(
        ValueError, match=r"few.yaml: joints: found 2 \(FR_hip_joint, FR_thigh_joint\), expected all 12"
    ):
        ActuatorParameters.load(ALIENGO, tmp_path / "few.yaml")


def test_the_drive_of_a_bench_moves_every_joint_of_a_robot(tmp_path):
    bench = attrs.evolve(
        ActuatorParameters.of(ALIENGO),
        joints=["knee"],
        torque_noise=0.0,
        delta_kp=[-3.0],
        delta_kd=0.1,
        torque_limit=[5.0],
        effects=(
            Effect(
                name="coulomb_friction",
                joints=["knee"],
                parameters={"c": [0.8], "v_0": 0.02},
                intervals={"c": [[0.7, 0.9]], "v_0": [0.01, 0.03]},
            ),
        ),
    )
    bench.on_all_joints(GO2).save(tmp_path / "twelve.yaml")
    twelve = ActuatorParameters.load(GO2, tmp_path / "twelve.yaml")
    drives = ActuatorModel(twelve, shape=(12,), dt=1e-3, seed=0)
    one = ActuatorModel(attrs.evolve(bench, torque_limit=40.0), shape=(1,), dt=1e-3, seed=0)
    for _ in range(40):
        expected = one.step(q=np.zeros(1), dq=np.ones(1), q_des=0.3 * np.ones(1), kp=30.0, kd=0.5)
        torque = drives.step(q=np.zeros(12), dq=np.ones(12), q_des=0.3 * np.ones(12), kp=30.0, kd=0.5)
    np.testing.assert_allclose(torque, np.full(12, expected.item()), atol=1e-12)
    np.testing.assert_array_equal(twelve.torque_limit, GO2.torque_limit)
    with pytest.raises(ValueError, match=r"joints: found .* expected one joint"):
        twelve.on_all_joints(GO2)


def test_an_effect_that_reads_another_joint_is_not_spread(tmp_path):
    effect = Effect(name="x", joints=["knee"], parameters={"source": ["ankle/dq"], "w": 1.0})
    with pytest.raises(ValueError, match="expected an effect that names no other joint"):
        attrs.evolve(
            ActuatorParameters.of(ALIENGO), joints=["knee"], delta_kp=0.0, delta_kd=0.0, effects=(effect,)
        ).on_all_joints(ALIENGO)
