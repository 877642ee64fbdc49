"""Numerical functions of the effects: a smooth sign, and functions of a batch of parameters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quadvel_description.arrays import Array, Indices


def smooth_sign(v: Array, width: Array) -> Array:
    """Smooth sign function tanh(v / width).

    Args:
        v: rad/s, velocity.
        width: rad/s, velocity at which the result is 0.76.

    Returns:
        Values from -1 to 1, 0 at rest.
    """
    return evaluate_distinct(lambda each: np.tanh(v / each), width)


def evaluate_distinct(function: Callable[..., Array], *parameters: Array) -> Array:
    """Evaluate a function once for each distinct parameter set of a batch.

    Finite differences move one parameter at a time, so most sets of a batch are equal. Use it for
    functions that take far longer than a copy of their result.

    Args:
        function: function of the parameters.
        *parameters: each (J,) or (B, 1, J).

    Returns:
        The value of `function`, as if it had been called with the whole batch.
    """
    moved = [one for one in parameters if np.ndim(one) == 3]
    if not moved:
        return function(*parameters)
    first, which = distinct_indices(np.concatenate(moved, axis=-1))
    return function(*(one[first] if np.ndim(one) == 3 else one for one in parameters))[which]


def distinct_indices(batch: Array) -> tuple[Indices, Indices]:
    """Find the distinct elements of a batch.

    Args:
        batch: (B, ...).

    Returns:
        Index of the first occurrence of each distinct element, and for each element (B,) which
        distinct one it is.
    """
    met: dict[bytes, int] = {}
    which = np.array([met.setdefault(one.tobytes(), len(met)) for one in batch])
    return np.unique(which, return_index=True)[1], which
