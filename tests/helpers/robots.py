"""The shipped robots, and one for which no policy is shipped."""

from pathlib import Path

from quadvel_description.robot import load_robot

ALIENGO, GO2 = load_robot("aliengo"), load_robot("go2")


def write_third_robot(folder: Path) -> Path:
    """Write a robot like the Go2 by another name, for which no network is shipped; return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in GO2.folder.iterdir():
        text = file.read_text()
        for before in ("name: go2", "robot: go2", 'robot name="go2"'):
            text = text.replace(before, before.replace("go2", "third"))
        (folder / file.name).write_text(text)
    return folder
