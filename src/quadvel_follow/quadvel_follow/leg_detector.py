"""Leg detector for laser scans: clusters and a small network that classifies them.

`clusters` segments the scan; `quadvel_training.leg_classifier` trains the network; `person_tracker`
joins legs to people over time.
"""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import onnxruntime
from numpy.typing import ArrayLike

from quadvel_description.arrays import Array

from .clusters import FEATURE_COUNT, MAX_CLUSTER_WIDTH_M, Scan, cluster_features, find_clusters

SHIPPED_MODEL = Path(__file__).parent / "models" / "legs.onnx"
LEG_PROBABILITY = 0.55
"""Probability from which `detect` reports a leg."""
LEG_AXIS_DEPTH_M = 0.045
"""Distance from the visible side of a leg to its axis."""


@attrs.frozen
class LegCandidates:
    """Clusters that may be a leg or a pair of touching legs.

    Attributes:
        position: Position of the leg's axis in the sensor frame, (K, 2), m.
        probability: Probability of a leg or pair, (K,).
        width: Width of the cluster, (K,), m.
    """

    position: Array
    probability: Array
    width: Array


class LegDetector:
    """Detects legs in single scans of any resolution."""

    def __init__(self, model: str | Path = SHIPPED_MODEL) -> None:
        """Load the network.

        Args:
            model: ONNX file of the classifier.

        Raises:
            ValueError: The file is missing or of another kind; the message names it.
        """
        self._session = _open_session(Path(model))

    def detect(self, ranges: ArrayLike, angle_min: float, angle_increment: float) -> Array:
        """Detect legs, or pairs of legs if they touch.

        Args:
            ranges: Ranges, (rays,), m; NaN, infinite and non-positive ones are rays without an
                echo.
            angle_min: Angle of the first ray, rad, counter-clockwise.
            angle_increment: Angle between two rays, rad.

        Returns:
            Positions in the sensor frame, (K, 2), m, x ahead.

        Raises:
            ValueError: The scan is malformed.
        """
        legs = self.find_candidates(Scan.validated(ranges, angle_min, angle_increment))
        return legs.position[legs.probability >= LEG_PROBABILITY]

    def find_candidates(self, scan: Scan) -> LegCandidates:
        """Classify all clusters that are narrow enough.

        Args:
            scan: The scan.

        Returns:
            Candidates with their probabilities.
        """
        clusters = find_clusters(scan)
        narrow = clusters.width < MAX_CLUSTER_WIDTH_M
        probability = np.zeros(0)
        if narrow.any():
            things = cluster_features(scan, clusters)[narrow]
            (probability,) = self._session.run(None, {"things": things})
        centre = clusters.centre[narrow]
        outward = centre / np.hypot(*centre.T)[:, None]
        return LegCandidates(
            centre + LEG_AXIS_DEPTH_M * outward, probability.astype(float), clusters.width[narrow]
        )


def _open_session(path: Path) -> onnxruntime.InferenceSession:
    """Return the session of a classifier file."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file, expected a network that finds legs, ONNX")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 4  # what goes wrong is raised, not printed
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no other base
        raise ValueError(f"{path}: is not an ONNX network that onnxruntime can read") from error
    found = [(entry.name, entry.shape[-1]) for entry in session.get_inputs()]
    if found != [("things", FEATURE_COUNT)]:
        raise ValueError(f"{path}: inputs are {found}, expected {[('things', FEATURE_COUNT)]}")
    return session
