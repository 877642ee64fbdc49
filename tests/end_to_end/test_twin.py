"""A plant walks as processes over DDS and leaves a recording that can be judged; identification is tested elsewhere."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quadvel_actuator import ActuatorParameters
from quadvel_eval.replay import torque_error
from quadvel_lab.ground_truth_benchmark import PLANTS, read_walk
from tests.helpers.robots import ALIENGO

PROGRAM = """
import sys
from pathlib import Path
from rich.console import Console
from quadvel_lab.scripted_walk import ScriptedWalk
from quadvel_lab.ground_truth_benchmark import plant_nodes
plant, out = map(Path, sys.argv[1:])
sys.exit(ScriptedWalk(out, "quick", plant_nodes(plant, seed=1), True, Console()).run() or 0)
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("twin") / "walk.mcap"


@pytest.mark.long
def test_a_plant_walks_and_its_recording_shows_that_the_stacks_model_lacks_something(recording: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(PLANTS / "slow_current.yaml"), str(recording)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    walk = read_walk(recording)
    assert [segment.command.tolist() for segment in walk.segments] == [[0.5, 0.0, 0.0]]
    assert walk.segments[0].error_xy < 0.15
    assert walk.joints.recorded.mean() > 0.99
    ((start, end, _),) = walk.stretches
    model = ActuatorParameters.of(ALIENGO)
    assert torque_error(model, walk.joints, start, end) > 3 * model.torque_noise
    assert np.isfinite(walk.joints.q).all()
