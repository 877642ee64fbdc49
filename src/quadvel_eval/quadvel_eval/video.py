"""Pictures of the robot of a recording, drawn by MuJoCo: a video, and frames for a strip.

A program of its own, `python -m quadvel_eval.video RECORDING FOLDER`, because MuJoCo reads MUJOCO_GL when it
is imported, and a broken GL library must not take the caller down.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.mjcf import load_model

from .demo_figures import tracking_figure
from .demo_summary import commands
from .output import replacing
from .recording import Recording, read_recording
from .report import write_figure

Image = NDArray[np.uint8]

RATE = 20  # frames a second
SIZE = (640, 360)
STRIP = 5  # frames
STRIP_SIZE = (400, 300)


class Film:
    """Draws the robot of `recording` at given times, with a camera that goes along."""

    def __init__(self, recording: Recording, width: int, height: int) -> None:
        self._recording = recording
        self._model = load_model()
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 1.6, 130.0, -16.0

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *error: object) -> None:
        self._renderer.close()

    def frames(self, times: ArrayLike) -> Iterator[Image]:
        """One image (height, width, 3) for each of the times (n,), s on the recording's clock."""
        times = np.asarray(times, float)
        r = self._recording
        poses = np.hstack([r.position.at(times), r.quaternion.at(times), r.joints.at(times)])
        for pose in poses:
            self._data.qpos[:] = pose
            mujoco.mj_forward(self._model, self._data)
            self._camera.lookat[:] = [pose[0], pose[1], 0.25]
            self._renderer.update_scene(self._data, self._camera)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # thrice the time, in software
            yield self._renderer.render().copy()


def strip(recording: Recording) -> list[tuple[str, Image]]:
    """Frames from the middle of some segments in which the robot moves, with the command as caption."""
    moving = [c for c in commands(recording.planned.time, recording.planned.value) if c[2].any()]
    picked = [moving[i] for i in np.unique(np.linspace(0, len(moving) - 1, STRIP).round().astype(int))]
    with Film(recording, *STRIP_SIZE) as film:
        images = list(film.frames([0.5 * (start + end) for start, end, _ in picked]))
    return [(_caption(velocity), image) for (_, _, velocity), image in zip(picked, images, strict=True)]


def _caption(velocity: NDArray[np.float64]) -> str:
    return ", ".join(f"{axis} {x:g}" for axis, x in zip(("vx", "vy", "wz"), velocity, strict=True) if x)


def write_video(path: Path, recording: Recording) -> None:
    """The whole recording as an MP4 in real time."""
    from imageio_ffmpeg import write_frames

    start, end = recording.position.time[[0, -1]]
    with replacing(path) as draft, Film(recording, *SIZE) as film:
        video = write_frames(str(draft), SIZE, fps=RATE, quality=7, macro_block_size=8)
        video.send(None)  # starts the encoder
        for frame in film.frames(np.arange(start, end, 1.0 / RATE)):
            video.send(np.ascontiguousarray(frame))
        video.close()


def main(arguments: Sequence[str]) -> None:
    """`demo.png` with a strip of frames, then `demo.mp4`."""
    recording, folder = read_recording(Path(arguments[0])), Path(arguments[1])
    write_figure(folder / "demo.png", tracking_figure(recording, strip(recording)))
    write_video(folder / "demo.mp4", recording)


if __name__ == "__main__":
    main(sys.argv[1:])
