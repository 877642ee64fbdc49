"""Examples for the leg classifier, and its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs torch: pip install 'quadvel-core[train]'")

from quadvel_eval.people.laser import FloorPlan, Laser  # noqa: E402
from quadvel_follow import LegDetector  # noqa: E402
from quadvel_sim.walker import Walker  # noqa: E402
from quadvel_training import leg_classifier, leg_examples  # noqa: E402

LASER = Laser(rays=500, angle_min=-np.pi / 2, angle_increment=np.deg2rad(0.36))
ROOM = FloorPlan([[2.0, -1.5, 0.02]], [[-1.0, 4.0, 6.0, 4.0], [5.5, -4.0, 5.5, 4.0]])


def recorded(path: Path, person: bool, labels: bool) -> Path:
    """A file of scans of a fixed scanner: a person who walks, or no person."""
    rng = np.random.default_rng(3)
    walker = Walker(way=[[2.5, -1.0], [2.5, 3.0]], speed=1.0)
    ranges, legs = [], []
    for _ in range(40):
        walker.step(0.1)
        plan = ROOM.with_circles(walker.legs) if person else ROOM
        ranges.append(LASER.scan(plan, np.zeros(3), rng))
        legs.append(walker.legs[:, :2])
    fields = {"ranges": ranges, "angle_min": LASER.angle_min, "angle_increment": LASER.angle_increment,
              "range_max": LASER.range_max, "stamp": 0.1 * np.arange(40)}  # fmt: skip
    np.savez(path, **fields, **({"legs": legs} if labels else {}))
    return path


def test_labels_name_legs_and_what_is_fixed_is_none(tmp_path: Path) -> None:
    found = leg_examples.read_examples_file(
        recorded(tmp_path / "legs_a.npz", True, True), np.random.default_rng(0)
    )
    assert 60 < found.legs.sum() < 240  # 40 scans of one or two things, each thinned three times
    assert (~found.legs).sum() > 40


def test_a_walking_person_is_found_without_labels_if_the_scanner_is_fixed(tmp_path: Path) -> None:
    walking = leg_examples.read_examples_file(
        recorded(tmp_path / "legs_walk.npz", True, False), np.random.default_rng(0)
    )
    assert walking.legs.sum() > 40
    empty = leg_examples.read_examples_file(
        recorded(tmp_path / "legs_none.npz", False, False), np.random.default_rng(0)
    )
    assert not empty.legs.any()
    assert len(empty.legs) > 100


def test_a_short_training_makes_a_file_that_the_detector_takes(tmp_path: Path) -> None:
    recorded(tmp_path / "legs_a.npz", True, True)
    config = leg_classifier.LegConfig(scenes=20, steps=60, batch=256)
    real, made = leg_classifier.read_examples(config, tmp_path)
    network = leg_classifier.train(config, list(real.values()), made)
    things = torch.from_numpy(made.things)
    with torch.no_grad():
        probability = network(things).numpy()
    assert probability[made.legs].mean() > probability[~made.legs].mean() + 0.3
    leg_classifier.export(network, tmp_path / "legs.onnx", {})
    detector = LegDetector(tmp_path / "legs.onnx")
    assert detector.detect(np.full(180, np.inf), 0.0, 0.01).shape == (0, 2)


def test_a_folder_without_scans_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="has no file legs_"):
        leg_classifier.read_examples(leg_classifier.LegConfig(), tmp_path)
