"""Check that a part of quadvel is installed before it starts. A robot needs only some parts."""

from __future__ import annotations

from importlib.util import find_spec

PROBES = {
    "robot": ("onnxruntime",),
    "follow": ("onnxruntime", "scipy"),
    "sim": ("mujoco", "numba"),
    "log": ("mcap",),
    "identify": ("matplotlib", "numba"),
    "eval": ("matplotlib", "mujoco"),
    "view": ("evdev", "viser", "websockets"),
}
"""Extras of the distribution quadvel-core, and modules that show whether they are installed."""


def check_installed(subject: str, module: str, extra: str) -> None:
    """Check for a package of quadvel and the libraries that it needs.

    Args:
        subject: The command or node that needs them.
        module: A module of the package.
        extra: Key of PROBES.

    Raises:
        ValueError: Something is not installed; the sentence says how to install it.
    """
    package = module.partition(".")[0]
    if find_spec(package) is None:
        raise ValueError(
            f"{subject} needs the package {package}, which is not installed: build it with colcon"
        )
    missing = [name for name in PROBES[extra] if find_spec(name) is None]
    if missing:
        raise ValueError(
            f"{subject} needs {' and '.join(missing)}, not installed here: pip install 'quadvel-core[{extra}]'"
        )
