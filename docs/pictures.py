"""Takes the pictures of the documents again: `make pictures`, on an idle machine with Chromium.

It fails if the control loop missed deadlines: such a picture shows a busy machine, not the robot.
"""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

IMAGES = Path(__file__).parent / "images"
WORK = Path("out/pictures")
QUADVEL = (sys.executable, "-m", "quadvel_bringup")
SOFTWARE_GL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PATIENCE_S = 120.0
WALK_S = 4.0
"""Seconds of walking before the page is photographed, and while deadlines are counted."""
MOVIE = {"start_s": 6.0, "seconds": 6.0, "rate": 12, "width": 480}
"""Part of the demo's video that is shown, its frames a second, and its width in pixels."""


def main() -> None:
    """Take all pictures, and write them to docs/images.

    Raises:
        SystemExit: Chromium is missing, or the control loop missed deadlines.
    """
    if CHROMIUM is None:
        sys.exit("no Chromium on this machine: apt install chromium")
    WORK.mkdir(parents=True, exist_ok=True)
    subprocess.run([*QUADVEL, "demo", "--out", WORK / "demo"], check=True)
    _require_none(json.loads((WORK / "demo" / "summary.json").read_text())["loop"]["overruns"], "the demo")
    pictures = {"demo.png": WORK / "demo" / "demo.png", "demo.webp": movie(WORK / "demo" / "demo.mp4")}
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=[*SOFTWARE_GL])
        pictures["view.png"] = live_page(browser)
        pictures["view_phone.png"] = recorded_page(browser)
        browser.close()
    for name, path in pictures.items():
        shutil.copy(path, IMAGES / name)
    print("written to docs/images:", ", ".join(pictures))


def _require_none(missed: int, where: str) -> None:
    if missed:
        sys.exit(f"{missed} deadlines missed in {where}: no picture was written; use an idle machine")


def movie(video: Path) -> Path:
    """Make the small moving picture of the first page.

    Args:
        video: The demo's video.

    Returns:
        An animated WebP file.
    """
    frames = imageio_ffmpeg.read_frames(
        str(video),
        input_params=["-ss", str(MOVIE["start_s"])],
        output_params=["-t", str(MOVIE["seconds"]), "-vf", f"fps={MOVIE['rate']},scale={MOVIE['width']}:-2"],
    )
    width, height = next(frames)["size"]
    height = MOVIE["width"] * height // width // 2 * 2
    images = [Image.fromarray(np.frombuffer(frame, np.uint8).reshape(height, -1, 3)) for frame in frames]
    path = WORK / "demo.webp"
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=1000 // MOVIE["rate"], loop=0, quality=60
    )
    return path


@contextmanager
def served(*words: str) -> Iterator[str]:
    """Run a command that serves the operator page.

    Args:
        *words: The command.

    Yields:
        The address of the page.
    """
    log = WORK / "served.log"
    with log.open("w") as output:
        process = subprocess.Popen([*QUADVEL, *words], stdout=output, stderr=subprocess.STDOUT)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while (address := re.search(r"http://\S+", log.read_text())) is None:
            if process.poll() is not None or time.monotonic() > deadline:
                sys.exit(f"no page is served: {log.read_text()}")
            time.sleep(0.2)
        yield address[0]
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


def _open(browser: Any, address: str, width: int, height: int) -> Any:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.goto(address)
    page.frame_locator("#scene").locator("canvas").first.wait_for(timeout=1000 * PATIENCE_S)
    return page


def live_page(browser: Any) -> Path:
    """Photograph the page of a walking robot at 1280 x 720.

    Args:
        browser: The browser.

    Returns:
        The picture.
    """
    path = WORK / "view.png"
    with served("up", "--view", "--terrain", "rough") as address:
        page = _open(browser, address, 1280, 720)
        page.wait_for_function("state !== null && state.mode === 'stance'", timeout=1000 * PATIENCE_S)
        before = page.evaluate("state.loop.missed")
        page.keyboard.down("w")
        page.wait_for_timeout(1000 * WALK_S)
        page.screenshot(path=path)
        page.keyboard.up("w")
        _require_none(page.evaluate("state.loop.missed") - before, "the page")
    return path


def recorded_page(browser: Any) -> Path:
    """Photograph the demo's recording at 390 x 844.

    Args:
        browser: The browser.

    Returns:
        The picture.
    """
    path = WORK / "view_phone.png"
    with served("view", str(WORK / "demo" / "demo.mcap")) as address:
        page = _open(browser, address, 390, 844)
        page.wait_for_timeout(1000 * WALK_S)
        page.screenshot(path=path, full_page=True)
    return path


if __name__ == "__main__":
    main()
