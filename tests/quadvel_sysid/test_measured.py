"""Identification on measured walks of a Go2: one is fitted, the other held out; one leg only."""

import os
from pathlib import Path

import pytest

from quadvel_sysid.identify import identify
from quadvel_sysid.logs.read_log import read_log
from quadvel_sysid.options import IdentifyOptions

LEG = ("FR_hip", "FR_thigh", "FR_calf")
GAINS = (35.0, 0.5)  # of the recording lab's driver; the logs contain no gains


@pytest.fixture(scope="module")
def walks():
    folder = Path(os.environ.get("QUADVEL_MEASURED", ""))
    paths = [folder / f"go2_walk_{k}.npz" for k in (1, 2)]
    if "QUADVEL_MEASURED" not in os.environ or not all(path.is_file() for path in paths):
        pytest.skip("QUADVEL_MEASURED names no folder with go2_walk_1.npz and go2_walk_2.npz")
    return [read_log(path, LEG) for path in paths]


@pytest.mark.long
@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["1 to 2", "2 to 1"])
def test_a_model_of_one_walk_halves_the_error_of_the_eam_on_the_other(walks, order):
    fitted, heldout = (walks[k] for k in order)
    report = identify([fitted], [heldout], IdentifyOptions(gains=GAINS)).report
    effects = [effect["name"] for effect in report["effects"]]
    assert "armature" in effects[:2]
    assert report["after"]["heldout_mse"] < 0.5 * report["before"]["heldout_mse"]
