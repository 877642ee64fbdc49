"""Where in a laser scan legs are: things in it, and a small network that knows legs from the rest."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from .clusters import NUMBERS, WIDEST, Scan, describe, find_clusters

Array = NDArray[np.float64]

SHIPPED_MODEL = Path(__file__).parent / "models" / "legs.onnx"
SURE = 0.55  # probability from which `detect` names a thing
INWARD = 0.045  # m, from the readings on a leg's near side to its axis


@attrs.frozen
class Legs:
    """What may be legs, one of a pair or a pair that touches: position (K, 2) in m of their axes, sensor frame; probability (K,);
    width (K,) in m.
    """

    position: Array
    probability: Array
    width: Array


class LegDetector:
    """Finds legs in single scans of any resolution.

    model: the network's file, ONNX. Raises ValueError, one sentence with the file's name, where it is missing or
    another kind of network.
    """

    def __init__(self, model: str | Path = SHIPPED_MODEL) -> None:
        self._session = _open(Path(model))

    def detect(self, ranges: ArrayLike, angle_min: float, angle_increment: float) -> Array:
        """Positions (K, 2) in m of legs, or of pairs of legs where these touch, in the sensor's frame, x ahead.

        ranges (rays,) in m; NaN, infinite, zero and negative ones are rays without a reading. Angles in rad,
        counter-clockwise. Raises ValueError for what is no scan.
        """
        legs = self.find(Scan.checked(ranges, angle_min, angle_increment))
        return legs.position[legs.probability >= SURE]

    def find(self, scan: Scan) -> Legs:
        """Everything in a scan that is narrow enough, with the probability that it is a leg or a pair."""
        clusters = find_clusters(scan)
        narrow = clusters.width < WIDEST
        probability = np.zeros(0)
        if narrow.any():
            things = describe(scan, clusters)[narrow]
            (probability,) = self._session.run(None, {"things": things})
        centre = clusters.centre[narrow]
        outward = centre / np.hypot(*centre.T)[:, None]
        return Legs(centre + INWARD * outward, probability.astype(float), clusters.width[narrow])


def _open(path: Path) -> onnxruntime.InferenceSession:
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
    if found != [("things", NUMBERS)]:
        raise ValueError(f"{path}: inputs are {found}, expected {[('things', NUMBERS)]}")
    return session
