"""Renders the robot of a recording with MuJoCo: a video, and frames for a figure.

It is a separate program, `python -m quadvel_eval.video RECORDING FOLDER`, that `quadvel demo`
starts. MuJoCo reads MUJOCO_GL at import, and a broken GL library must not end the demo.
`demo_figures` draws the curves below the frames.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadvel_description.arrays import Array
from quadvel_description.mjcf import load_model
from quadvel_description.robot import Robot, robot_of_file
from quadvel_description.robot_name import described_robot
from quadvel_recordings.output import atomic_write
from quadvel_recordings.reading import recorded_description

from .demo_figures import tracking_figure
from .demo_summary import constant_commands
from .recording import Recording, read_recording
from .report import write_figure

Image = NDArray[np.uint8]

FRAMES_PER_SECOND = 20
VIDEO_SIZE = (640, 360)  # width and height, pixels
STRIP_FRAMES = 5  # frames of the figure, at most
STRIP_SIZE = (400, 300)  # width and height of each, pixels


class Film:
    """Renders the robot of a recording, with a camera that follows it.

    Args:
        robot: The robot.
        recording: The recording.
        width: Width of a frame, pixels.
        height: Height of a frame, pixels.
    """

    def __init__(self, robot: Robot, recording: Recording, width: int, height: int) -> None:
        self._recording = recording
        self._model = load_model(robot)
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, height, width)
        self._camera = mujoco.MjvCamera()
        # m, and degrees about the robot in the world frame
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 1.6, 130.0, -16.0

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *error: object) -> None:
        self._renderer.close()

    def frames(self, times: ArrayLike) -> Iterator[Image]:
        """Render frames.

        Args:
            times: Times (n,), s, on the clock of the recording.

        Yields:
            One image (height, width, 3) per time.
        """
        times = np.asarray(times, float)
        r = self._recording
        poses = np.hstack(
            [r.position.latest_at(times), r.quaternion.latest_at(times), r.joints.latest_at(times)]
        )
        for pose in poses:
            self._data.qpos[:] = pose
            mujoco.mj_forward(self._model, self._data)
            self._camera.lookat[:] = [pose[0], pose[1], 0.25]
            self._renderer.update_scene(self._data, self._camera)
            self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = (
                False  # shadows triple the time of software rendering
            )
            yield self._renderer.render().copy()


def frame_strip(robot: Robot, recording: Recording) -> list[tuple[str, Image]]:
    """Render frames from the middle of some segments with motion.

    Args:
        robot: The robot.
        recording: The recording.

    Returns:
        Caption (the command) and image of each frame.
    """
    moving = [c for c in constant_commands(recording.planned.time, recording.planned.value) if c[2].any()]
    picked = [moving[i] for i in np.unique(np.linspace(0, len(moving) - 1, STRIP_FRAMES).round().astype(int))]
    with Film(robot, recording, *STRIP_SIZE) as film:
        images = list(film.frames([0.5 * (start + end) for start, end, _ in picked]))
    return [(_caption(velocity), image) for (_, _, velocity), image in zip(picked, images, strict=True)]


def _caption(velocity: Array) -> str:
    """Nonzero components of a command as text."""
    return ", ".join(f"{axis} {x:g}" for axis, x in zip(("vx", "vy", "wz"), velocity, strict=True) if x)


def write_video(robot: Robot, path: Path, recording: Recording) -> None:
    """Write the whole recording as an MP4 in real time.

    Args:
        robot: The robot.
        path: The MP4 file.
        recording: The recording.
    """
    from imageio_ffmpeg import write_frames

    start, end = recording.position.time[[0, -1]]
    with atomic_write(path) as draft, Film(robot, recording, *VIDEO_SIZE) as film:
        video = write_frames(str(draft), VIDEO_SIZE, fps=FRAMES_PER_SECOND, quality=7, macro_block_size=8)
        video.send(None)  # starts the encoder
        for frame in film.frames(np.arange(start, end, 1.0 / FRAMES_PER_SECOND)):
            video.send(np.ascontiguousarray(frame))
        video.close()


def main(arguments: Sequence[str]) -> None:
    """Write demo.png with a strip of frames, then demo.mp4.

    Args:
        arguments: Recording and folder.
    """
    path, folder = Path(arguments[0]), Path(arguments[1])
    recording = read_recording(path)
    robot = robot_of_file(path, described_robot(recorded_description(path)), None)
    write_figure(folder / "demo.png", tracking_figure(recording, frame_strip(robot, recording)))
    write_video(robot, folder / "demo.mp4", recording)


if __name__ == "__main__":
    main(sys.argv[1:])
