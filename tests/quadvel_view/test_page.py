"""The page in a real browser: it opens, its pad makes the robot walk, STOP stops it, recordings play, nothing overlaps.

All without a card: Chromium draws with SwiftShader. Where there is no Chromium these tests are left out.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import yaml
from matplotlib.image import imread

from quadvel_bringup.stack import PARAMETERS
from tests.helpers.standing import wait_until_ready

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: apt install chromium")

QUADVEL = (sys.executable, "-m", "quadvel_bringup")
ARGUMENTS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
PARTS = ("main", ".controls", ".readings", "#stop")
PATIENCE = 60_000  # ms; a machine that tests run on is busy


class Served:
    """A command of quadvel that serves the page, and what it says."""

    def __init__(self, log: Path, *words: str) -> None:
        self._log = log
        with log.open("w") as file:
            self._process = subprocess.Popen(
                [*QUADVEL, *words],
                cwd=log.parent,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def said(self, pattern: str) -> str:
        """What the group of the pattern matched, once it did."""
        until = time.monotonic() + 180.0
        while (found := re.search(pattern, self._log.read_text())) is None:
            assert self._process.poll() is None, self._log.read_text()
            assert time.monotonic() < until, self._log.read_text()
            time.sleep(0.05)
        return found[1]

    def log(self) -> str:
        return self._log.read_text()

    def is_running(self) -> bool:
        return self._process.poll() is None

    def end(self) -> int:
        self._process.send_signal(signal.SIGINT)
        return self._process.wait(30.0)


@pytest.fixture(scope="module")
def launch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Any]]:
    """Starts a browser after a line of shell; it draws in software, so its priority is low."""
    with playwright.sync_playwright() as started:

        def begin(first: str) -> Any:
            program = tmp_path_factory.mktemp("browser") / "chromium"
            program.write_text(f'#!/bin/sh\n{first}\nexec nice -n 19 {CHROMIUM} "$@"\n')
            program.chmod(0o755)
            return started.chromium.launch(executable_path=program, args=[*ARGUMENTS])

        yield begin


@pytest.fixture(scope="module")
def browser(launch: Callable[[str], Any]) -> Iterator[Any]:
    """A browser that gets its share of the processor next to other tests."""
    browser = launch("")
    yield browser
    browser.close()


@pytest.fixture
def waiting_browser(launch: Callable[[str], Any]) -> Iterator[Any]:
    """A browser that waits for the robot: niceness counts within a session alone, that of autogroups between them."""
    browser = launch("echo 19 2>/dev/null >/proc/self/autogroup")
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of the page of a simulated robot that stands."""
    folder = tmp_path_factory.mktemp("view")
    parameters = yaml.safe_load(PARAMETERS.read_text())
    parameters["view"]["ros__parameters"]["port"] = 0
    (folder / "params.yaml").write_text(yaml.safe_dump(parameters))
    up = Served(folder / "up.log", "up", "--view", "--params", "params.yaml")
    wait_until_ready(up.log, up.is_running)
    yield up.said(r"open (http://127\.0\.0\.1:\d+/)")
    assert up.end() == 0


class Page:
    """A page of the browser, and what it asked for and complained of."""

    def __init__(
        self, browser: Any, url: str, width: int = 1280, height: int = 720, scene: bool = False
    ) -> None:
        """scene: whether it draws the robot, which without a card takes most of the time that there is."""
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.page.set_default_timeout(PATIENCE)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on(
            "console", lambda said: self.complaints.append(said.text) if said.type == "error" else None
        )
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        if not scene:
            self.page.route("**/scene/**", lambda route: route.fulfill(body=""))
        self.page.goto(url)

    def until(self, condition: str) -> None:
        """Wait until a condition on the page's last message holds."""
        self.page.wait_for_function(f"state !== null && ({condition})")

    def press(self, x: float, y: float) -> None:
        """Take the knob of the pad from its middle to a place, shares of the way to the edge, and hold it."""
        box = self.page.locator("#pad").bounding_box()
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(*middle)
        self.page.mouse.down()
        self.page.mouse.move(middle[0] + 60 * x, middle[1] - 60 * y)

    def shows_the_robot(self) -> None:
        """Wait for the picture in 3-D: light trunk, orange feet."""
        self.page.frame_locator("#scene").locator("canvas").first.wait_for()
        until = time.monotonic() + PATIENCE / 1000
        while not {"trunk", "feet"} <= self._seen():
            assert time.monotonic() < until, f"the picture shows {self._seen() or 'nothing'}"
            time.sleep(0.2)

    def _seen(self) -> set[str]:
        pixels = imread(BytesIO(self.page.locator("main").screenshot()))[..., :3]
        red, green, blue = np.moveaxis(pixels, -1, 0)
        seen = {"trunk": (pixels.min(-1) > 0.6), "feet": (red > 0.75) & (green < 0.6) & (blue < 0.4)}
        return {name for name, where in seen.items() if where.sum() > 50}


@pytest.fixture
def page(browser: Any, robot: str) -> Iterator[Page]:
    page = Page(browser, robot)
    yield page
    page.page.close()
    assert page.complaints == []


# Tests with nodes of their own stand first: `robot`, which the others share, stays on the same DDS domain once it is started.


@pytest.mark.long
@pytest.mark.parametrize("rounds", [1, 10])
def test_the_page_stays_before_during_and_after_the_start_of_each_node(
    browser: Any, tmp_path: Path, rounds: int
) -> None:
    """A page opens on no robot; then each node starts, one after the other, and with each another page opens and reads on."""
    for turn in range(rounds):
        view = Served(tmp_path / f"view_{turn}.log", "run", "view", *VIEW_PORT)
        url = view.said(r"open (http://127\.0\.0\.1:\d+/)")
        pages, nodes = [Page(browser, url)], []
        pages[0].until("state.mode === ''")
        for name in NODES:
            nodes.append(Served(tmp_path / f"{name}_{turn}.log", "run", name))
            pages.append(Page(browser, url))
            pages[-1].until("true")
            pages[-1].page.wait_for_timeout(500)
        pages[0].until("state.mode !== '' && state.lamps.length >= 4")
        for page in pages:
            assert page.page.evaluate("socket.readyState === WebSocket.OPEN")
            assert page.page.evaluate("performance.now() - heardAt < 10_000")
            assert "NaN" not in page.page.inner_text("body")
            page.page.close()
            assert page.complaints == []
        assert [one.end() for one in nodes] == [0] * len(NODES)
        assert view.end() == 0


def test_the_first_second_of_a_controller_shows_dashes(browser: Any, tmp_path: Path) -> None:
    """No state comes, so that there are no times of a loop yet."""
    view = Served(tmp_path / "view.log", "run", "view", *VIEW_PORT)
    url = view.said(r"open (http://127\.0\.0\.1:\d+/)")
    controller = Served(tmp_path / "controller.log", "run", "controller")
    page = Page(browser, url)
    page.until("state.mode === 'passive' && state.loop.compute === null")
    page.page.wait_for_timeout(300)
    assert page.page.inner_text("#loop dl").split("\n")[3::2] == ["–", "–", "0"]
    assert set(page.page.inner_text(".graphs").split()[1::2]) <= {"–", "+0.00"}
    page.page.close()
    assert controller.end() == 0
    assert view.end() == 0
    assert page.complaints == []


@pytest.mark.realtime
def test_pad_walks_the_robot_and_stop_stops_it(page: Page) -> None:
    page.until("state.mode === 'stance'")
    page.press(0.0, 1.0)
    page.until("state.mode === 'walk' && state.source === 'teleop' && state.measured[0] > 0.2")
    page.page.mouse.up()
    page.until("state.commanded.every((value) => value === 0) && state.source === 'none'")

    page.press(0.0, 1.0)
    page.until("state.measured[0] > 0.1")
    page.page.keyboard.press("Space")
    page.until("state.stopped && state.mode === 'passive'")
    page.press(0.0, 1.0)
    page.page.wait_for_timeout(300)
    assert page.page.evaluate("state.source") == "none"
    page.page.mouse.up()
    page.page.click("#stop")
    page.until("!state.stopped")
    page.page.select_option("#ground", "rough")
    page.page.click("[data-do=reset]")
    page.until("state.said.includes('lie, on rough ground')")
    page.page.click("[data-do=stand_up]")
    page.until("state.mode === 'stance'")


@pytest.mark.realtime
def test_the_page_opens_soon_shows_thirty_pictures_a_second_and_costs_one_deadline_in_a_hundred_at_most(
    waiting_browser: Any, robot: str
) -> None:
    seconds = 20

    def opened() -> Page:
        page = Page(waiting_browser, robot)
        page.until("state.loop.missed !== undefined")
        return page

    def missed(page: Page) -> int:
        return int(page.page.evaluate("state.loop.missed"))

    opened().page.close()  # the first one loads the browser
    begin = time.monotonic()
    page = opened()
    opening = time.monotonic() - begin
    page.page.evaluate("words = 0; socket.addEventListener('message', () => { words += 1; })")
    before = missed(page)
    page.page.wait_for_timeout(1000 * seconds)
    with_it, rate = missed(page) - before, page.page.evaluate("words") / seconds
    before = missed(page)
    page.page.close()
    time.sleep(seconds)
    page = opened()
    without = missed(page) - before
    page.page.close()
    print(
        f"open after {opening:.2f} s, {rate:.1f} pictures/s, missed deadlines in {seconds} s: {with_it}, without {without}"
    )
    assert opening < 3.0
    assert rate > 28.0
    assert with_it <= without + 0.01 * 200 * seconds, "the browser draws on the robot's own cores"


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844)])
def test_nothing_overlaps(browser: Any, robot: str, width: int, height: int) -> None:
    page = Page(browser, robot, width, height)
    page.until("state.lamps.length > 2")
    boxes = {
        part: page.page.locator(part).bounding_box()
        for part in (PARTS if width > 820 else ("main", ".panel", "#stop"))
    }
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        apart = (
            a["x"] + a["width"] <= b["x"] + 0.5
            or b["x"] + b["width"] <= a["x"] + 0.5
            or a["y"] + a["height"] <= b["y"] + 0.5
            or b["y"] + b["height"] <= a["y"] + 0.5
        )
        assert apart, f"{one} and {other}: {a}, {b}"
    for box in boxes.values():
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] + box["height"] <= height
    assert page.page.evaluate("document.documentElement.scrollWidth") <= width
    page.page.close()
    assert page.complaints == []


NODES = ("sim_node", "estimator", "controller", "command_mux")
VIEW_PORT = ("--ros-args", "-p", "port:=0")


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (800, 600)])
def test_every_control_can_be_pressed_and_every_text_is_whole(
    browser: Any, robot: str, width: int, height: int
) -> None:
    page = Page(browser, robot, width, height)
    page.until("state.lamps.length > 2 && state.simulated")
    assert page.page.evaluate(UNREACHABLE) == []
    assert page.page.evaluate(CUT_OFF) == []
    assert page.page.inner_text("#loading") == "loading the 3-D view…"
    page.page.close()


UNREACHABLE = """[...document.querySelectorAll(".controls button, .controls select, .controls input, #pad, #strafe, #stop")]
    .filter((one) => one.offsetParent !== null)
    .filter((one) => {
        const box = one.getBoundingClientRect();
        const middle = [box.left + box.width / 2, box.top + box.height / 2];
        const corners = [[box.left + 9, box.top + 9], [box.right - 9, box.bottom - 9]];
        const places = one.type === "range" || one.id === "pad" ? [middle] : [middle, ...corners];
        return !places.every(([x, y]) => one.contains(document.elementFromPoint(x, y)));
    }).map((one) => one.id || one.textContent)"""
CUT_OFF = """(() => {
    const pen = document.createElement("canvas").getContext("2d");
    const cut = (one) => {
        if (one.tagName !== "SELECT") return one.scrollWidth > one.clientWidth + 1;
        pen.font = getComputedStyle(one).font;
        const widest = Math.max(...[...one.options].map((option) => pen.measureText(option.textContent).width));
        return widest + 26 > one.clientWidth;  // with its arrow
    };
    return [...document.querySelectorAll("button, select, .controls p, h1, h2, .pill, dt, dd, output, .graph span")]
        .filter((one) => one.offsetParent !== null && cut(one)).map((one) => one.id || one.textContent);
})()"""


@pytest.mark.long
@pytest.mark.parametrize("ground", ["slope", "rough"])
def test_a_walking_robot_that_is_reset_lies_in_passive_and_is_seen_on_its_ground(
    browser: Any, robot: str, ground: str
) -> None:
    page = Page(browser, robot, scene=True)
    stand = "[data-do=stand_up]"
    page.until("state.mode !== ''")
    if page.page.evaluate("state.mode") == "passive":
        page.page.click(stand)
    page.until("state.mode === 'stance' && state.refusal === ''")
    page.press(0.0, 1.0)
    page.until("state.mode === 'walk'")
    page.page.select_option("#ground", ground)
    page.page.evaluate("send({ do: 'reset', terrain: $('ground').value })")
    page.page.mouse.up()
    page.until(f"state.said.includes('lie, on {ground} ground')")
    page.page.wait_for_timeout(1000)
    assert page.page.evaluate("state.mode") == "passive"
    page.shows_the_robot()
    page.page.click(stand)
    page.until("state.mode === 'stance'")
    page.shows_the_robot()
    page.page.close()
    assert page.complaints == []


def test_a_recording_plays_and_nothing_comes_from_elsewhere(
    browser: Any, walked: Path, tmp_path: Path
) -> None:
    view = Served(tmp_path / "view.log", "view", str(walked), "--port", "0")
    url = view.said(r"open (http://127\.0\.0\.1:\d+/)")
    page = Page(browser, url, 800, 600, scene=True)
    page.until("state.playback.playing && state.playback.time > 0.3 && state.measured[0] > 0.4")
    page.page.click("#play")
    page.until("!state.playback.playing")
    page.page.evaluate("send({ do: 'seek', time: 0.5 })")
    page.until("state.loop.period === null && state.mode === 'walk'")
    page.page.evaluate("$('time').value = 1.5; $('time').dispatchEvent(new Event('input'))")
    page.until("state.playback.time === 1.5 && state.measured[0] > 0.4")
    assert page.page.locator("#stop").is_hidden()
    page.shows_the_robot()
    ours = (url, url.replace("127.0.0.1", "localhost"), "data:", "blob:")
    assert [one for one in page.requests if not one.startswith(ours)] == []
    page.page.close()
    assert view.end() == 0
    assert page.complaints == []


@pytest.mark.long
@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_with_a_token_the_scene_is_drawn_under_each_name_of_this_host(
    browser: Any, walked: Path, tmp_path: Path, name: str
) -> None:
    view = Served(tmp_path / "view.log", "view", str(walked), "--port", "0", "--host", "0.0.0.0")
    printed = urlsplit(view.said(r"open (http://\S+)"))
    url = printed._replace(netloc=f"{name}:{printed.port}").geturl()
    page = Page(browser, url, 800, 600, scene=True)
    page.page.frame_locator("#scene").locator("canvas").first.wait_for()
    page.until("state.playback.time > 0")
    page.page.goto(url.partition("?")[0])  # by the cookie alone
    page.page.frame_locator("#scene").locator("canvas").first.wait_for()
    page.page.close()
    assert view.end() == 0
    assert page.complaints == []
