"""Model cards agree with the file and its evaluation."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="model cards need onnx: pip install 'quadvel-core[train]'")

from quadvel_estimator.learned import SHIPPED_MODEL  # noqa: E402
from quadvel_eval.grid import Cell, CellResult, summarise  # noqa: E402
from quadvel_eval.segments import Segment  # noqa: E402
from quadvel_eval.walk import Setup  # noqa: E402
from quadvel_policy.policy_file import SHIPPED_POLICY, PolicyFile  # noqa: E402
from quadvel_training import __main__ as main  # noqa: E402
from quadvel_training.card import SECTIONS, TABLES, card  # noqa: E402
from tests.helpers.robots import ALIENGO  # noqa: E402


@pytest.fixture
def evaluation(tmp_path):
    """Of the shipped networks: one walk 0.02, one 0.11 m/s off, and one fall."""
    commands = [(0.5, 0.0, 0.0), (1.5, 0.0, -1.0), (-1.0, 0.4, 0.0)]
    cells = [Cell(command, 0) for command in commands]
    mse = {"learned": np.full(3, 0.01**2)}
    results = [
        CellResult(cell, Segment(np.array(cell.command), np.array(cell.command) - [off, 0, 0]), 0.01, 0.9, mse,
                   {"learned": 0.1}, 10.0)
        for cell, off in zip(cells[:2], (0.02, 0.11), strict=True)
    ]  # fmt: skip
    found = summarise([*results, CellResult(cells[2])], [0.01])
    setup = Setup().to_json() | {"grid": "quick", "seeds": 1}
    path = tmp_path / "eval.json"
    path.write_text(json.dumps({**found, "setup": setup}))
    return path


def test_a_policys_card_names_its_figures_and_where_it_fails(evaluation):
    text, metadata = card(SHIPPED_POLICY, [evaluation]), PolicyFile(ALIENGO).metadata
    low, high = metadata.command_limits["vx"]
    for said in (
        f"| samples | {metadata.recipe['samples']:,} |",
        "| largest error, m/s | 0.11 |",
        "aliengo: ΔKp -0.706 N m/rad",
        f"Commands beyond vx {low:g} to {high:g} m/s",
        "fell in 1 of 3 runs, at commands (vx, vy, wz) (-1, 0.4, 0)",
        "furthest off at the command (1.5, 0, -1), 0.110 m/s",
    ):
        assert said in text


def test_an_estimators_card_names_the_policy_of_its_evaluation(evaluation):
    text = card(SHIPPED_MODEL, [evaluation])
    assert "| learned estimator, largest RMSE, m/s | 0.01 |" in text
    assert "largest error" not in text
    assert "Measured on walks under crl_eam.onnx" in text


def test_an_evaluation_of_another_network_is_refused(evaluation, tmp_path):
    other = tmp_path / "other.onnx"
    model = onnx.load(SHIPPED_POLICY)
    model.doc_string = "another one"
    onnx.save(model, other)
    with pytest.raises(ValueError, match=r"is an evaluation of .*crl_eam[.]onnx, expected one of .*other"):
        card(other, [evaluation])


def test_a_policys_card_has_what_the_papers_sections_measured_of_it(evaluation, tmp_path):
    digest = hashlib.sha256(SHIPPED_POLICY.read_bytes()).hexdigest()[:12]
    row = {"what": "1 m/s: diagonal feet alike", "unit": "%", "ours": {"mine": 5.0}}
    for name in SECTIONS:
        made = {"made_with": {"policies": {"other": "0" * 12, "mine": digest}}, "rows": [row]}
        (tmp_path / name).write_text(json.dumps(made))
    assert card(SHIPPED_POLICY, [evaluation], tmp_path).count("| 1 m/s: diagonal feet alike, % | 5 |") == len(
        TABLES
    )
    made["made_with"]["policies"].pop("mine")
    (tmp_path / SECTIONS[0]).write_text(json.dumps(made))
    with pytest.raises(ValueError, match=f"made with .*, expected {digest}"):
        card(SHIPPED_POLICY, [evaluation], tmp_path)


GAIT = {"feet of one side alike": 97.0, "diagonal feet alike": 6.0, "gait frequency": 3.8}
JOINT = "fastest joint, share of its drive's speed"


def section(folder, name, rows):
    digest = hashlib.sha256(SHIPPED_POLICY.read_bytes()).hexdigest()[:12]
    rows = [{"what": what, "unit": "", "ours": {"mine": value}} for what, value in rows.items()]
    (folder / name).write_text(json.dumps({"made_with": {"policies": {"mine": digest}}, "rows": rows}))


@pytest.mark.parametrize(
    ("gait", "kind"), [(GAIT, "a pace"), (GAIT | {"diagonal feet alike": 98.0}, "a trot")]
)
def test_a_policys_known_limits_follow_from_the_papers_sections(evaluation, tmp_path, gait, kind):
    section(tmp_path, "gait.json", {f"0.5 m/s: {name}": value for name, value in gait.items()})
    joints = {f"forward: {JOINT}": 0.9, f"left: {JOINT}": 0.8, f"second plant, left: {JOINT}": 1.04,
              f"second plant, loose joints, left: {JOINT}": 1.21}  # fmt: skip
    section(tmp_path, "sustained.json", joints)
    slopes = {"15 degrees up: survive and follow": 100.0, "started at once, 15 degrees down: survive and follow": 66.7,
              "started at once, 15 degrees down: survival": 77.8}  # fmt: skip
    section(tmp_path, "slopes.json", slopes)
    limits = [
        line for line in card(SHIPPED_POLICY, [evaluation], tmp_path).splitlines() if line.startswith("- ")
    ]
    assert f"Its gait is {kind}" in limits[0]
    shares = [[plant in line and share in line for line in limits].count(True)
              for plant, share in (("usual plant", "0.90"), ("second plant,", "1.04"), ("loose joints", "1.21"))]  # fmt: skip
    assert shares == [1, 1, 1]
    assert [line for line in limits if "stuck" in line] == [
        "- Slopes, started at once, 15 degrees down: 33 % of the robots fall, are stuck, or are off by more than 0.15 m/s."
    ]


def test_limits_of_commands_are_narrowed_in_the_file_and_the_network_stays(tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_bytes(SHIPPED_POLICY.read_bytes())
    before = PolicyFile(ALIENGO, path)
    main.limit(path, forward=1.5, turn=0.7, curve=1.2)
    after = PolicyFile(ALIENGO, path)
    vx, vy = (before.metadata.command_limits[axis] for axis in ("vx", "vy"))
    assert after.metadata.command_limits == {"vx": (vx[0], 1.5), "vy": vy, "wz": (-0.7, 0.7)}
    kept, now = (json.loads(one.metadata.to_json()) for one in (before, after))
    assert {name for name in kept if kept[name] != now[name]} == {"command_limits", "curve_limit"}
    assert after.metadata.curve_limit == 1.2
    seen = np.linspace(-1.0, 1.0, before.metadata.observation.size, dtype=np.float32)
    assert np.array_equal(before.step(seen), after.step(seen))


@pytest.mark.parametrize(
    "wider", [{axis: 9.0} for axis in ("forward", "backward", "sideways", "turn", "curve")]
)
def test_limits_are_never_widened_beyond_what_was_trained(tmp_path, wider):
    path = tmp_path / "policy.onnx"
    path.write_bytes(SHIPPED_POLICY.read_bytes())
    with pytest.raises(ValueError, match=r"policy.onnx: (command_limits[.]|curve_limit)"):
        main.limit(path, **wider)
    assert path.read_bytes() == SHIPPED_POLICY.read_bytes()
