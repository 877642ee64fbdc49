"""Types of NumPy arrays, for annotations; docstrings state shapes and units."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
"""Of single or double precision, as the columns of a log."""
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
