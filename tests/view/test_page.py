"""The live page in a real browser: it loads, the robot moves on it, and a click sets the goal."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from hiernav.view.commands import Command, Settings

SCRIPT = Path(__file__).parents[2] / "deploy" / "run_loop.py"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
needs_viser = pytest.mark.skipif(find_spec("viser") is None, reason="needs viser: pip install -e '.[view]'")
WAIT = 300.0
"""A browser that draws in software takes its time on a busy machine [s]."""


@pytest.fixture
def browser(tmp_path):
    """Chromium without a screen, driven by selenium."""
    if find_spec("selenium") is None:
        pytest.skip("needs selenium: pip install -e '.[dev]'")
    binary = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("needs a browser: apt-get install chromium chromium-driver")
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (
        "headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking",
        "disable-component-update", "disable-sync", "use-gl=angle", "use-angle=swiftshader",
        "enable-unsafe-swiftshader", "window-size=900,600", f"user-data-dir={tmp_path / 'browser'}",
    ):  # fmt: skip
        options.add_argument(f"--{flag}")
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.set_script_timeout(WAIT)
    browser.set_page_load_timeout(WAIT)
    yield browser
    browser.quit()


@pytest.fixture
def robot(tmp_path):
    """A robot in an empty world, driven in real time with a live page; the page's address."""
    environment = os.environ | {"PYTHONPATH": str(SCRIPT.parents[1])}
    process = subprocess.Popen(
        [sys.executable, str(SCRIPT), "--view", "0", "--world", "pillar(2,2,0)", "--goal=1.5,1.5", "--no-pictures",
         "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    line = process.stdout.readline()
    assert line.startswith("live page: http://127.0.0.1:"), line
    yield line.split()[-1]
    process.send_signal(signal.SIGINT)
    assert process.wait(WAIT) == 0
    episode = json.loads((tmp_path / "out" / "summary.json").read_text())["episodes"][-1]
    assert episode["stopped"]


def until(value: Callable[[], object], what: str) -> object:
    """The first answer that is true."""
    deadline = time.monotonic() + WAIT
    while not (answer := value()):
        assert time.monotonic() < deadline, what
        time.sleep(0.2)
    return answer


@needs_viser
@pytest.mark.slow
def test_the_page_loads_the_robot_moves_and_a_click_sets_the_goal(robot, browser):
    browser.get(robot)

    def numbers(name: str) -> tuple[float, float] | None:
        text = browser.execute_script("return document.body.innerText")
        found = re.search(rf"{name} x (-?[\d.]+) y (-?[\d.]+)", text)
        return (float(found[1]), float(found[2])) if found else None

    began = until(lambda: numbers("position"), "the page shows no position")
    until(lambda: math.dist(numbers("position"), (1.5, 1.5)) < 0.8, "the robot does not arrive at its first goal")
    until(lambda: browser.execute_script("return document.querySelectorAll('canvas').length"), "there is no canvas")

    # the camera aims at a point of the field that is in the middle of the window
    aim = (0.12 * 4.0, 0.0)
    from selenium.webdriver.common.action_chains import ActionChains

    size = browser.execute_script("return [window.innerWidth, window.innerHeight]")
    ActionChains(browser).move_by_offset(size[0] // 2, size[1] // 2).click().perform()
    until(lambda: math.dist(numbers("position"), aim) < 0.8, "the robot does not go where was clicked")
    assert math.dist(began, numbers("position")) > 0.3
    events = browser.execute_script("return document.body.innerText")
    goals = [tuple(map(float, pair)) for pair in re.findall(r"goal (-?[\d.e-]+), (-?[\d.e-]+)", events)]
    assert any(math.dist(goal, aim) < 0.3 for goal in goals), events


@needs_viser
@pytest.mark.realtime
def test_the_loop_is_as_punctual_with_the_page_open_or_stalled_as_without(browser, tmp_path):
    def lateness(condition: str) -> float:
        """99th percentile over some seconds [s]."""
        out = tmp_path / condition
        flags = ["--serve"] if condition == "closed" else ["--view", "0"]
        flags += ["--control", str(tmp_path / f"{condition}.sock")]
        process = subprocess.Popen(
            [sys.executable, str(SCRIPT), *flags, "--world", "pillar(2,2,0)", "--no-pictures", "--out", str(out)],
            stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(SCRIPT.parents[1])},
        )  # fmt: skip
        line = process.stdout.readline()
        if condition == "open":
            browser.get(line.split()[-1])
        elif condition == "stalled":
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            pages = [pid for pid in children if b"hiernav.view" in Path(f"/proc/{pid}/cmdline").read_bytes()]
            os.kill(int(pages[0]), signal.SIGSTOP)
        time.sleep(10.0)
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT) == 0
        return json.loads((out / "summary.json").read_text())["timing"]["lateness"]["p99"]

    found = {condition: lateness(condition) for condition in ("closed", "open", "stalled")}
    print({name: f"{1e3 * value:.3f} ms" for name, value in found.items()})
    assert max(found["open"], found["stalled"]) < found["closed"] + 1e-3, found


@needs_viser
def test_a_click_is_where_its_ray_meets_the_floor():
    from hiernav.view.page import on_floor

    assert on_floor((1.0, 2.0, 4.0), (0.0, 0.6, -0.8)) == pytest.approx((1.0, 5.0))
    assert on_floor((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)) is None
    assert on_floor((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)) is None
    assert on_floor((0.0, 0.0, -1.0), (0.0, 0.0, -1.0)) is None


@needs_viser
def test_a_button_asks_for_what_it_says_however_often_it_is_pressed(monkeypatch):
    """Somebody else may have resumed meanwhile, or the loop may have been too busy to listen."""
    import viser

    from hiernav.view.page import Page

    buttons: dict[str, Callable] = {}

    def add_button(label: str, **_: object) -> MagicMock:
        return MagicMock(on_click=lambda pressed: buttons.__setitem__(label, pressed))

    server = MagicMock()
    server.gui.add_button = add_button
    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: server)
    asked: list[Command] = []
    Page(Settings("", 0.1, 0.3, 0, ()), asked.append)
    (pause,) = (pressed for label, pressed in buttons.items() if label.startswith("Pause"))
    pause(None)
    pause(None)
    assert asked == [Command("pause"), Command("pause")]
    buttons["Resume"](None)
    buttons["Emergency stop"](None)
    assert asked[2:] == [Command("resume"), Command("estop")]


@needs_viser
def test_the_page_is_for_this_machine_and_for_its_own_site_only(tmp_path):
    """It listens on 127.0.0.1 alone, and refuses what a page of another site, in the same browser, would send."""
    import websockets.sync.client as client
    from websockets.exceptions import InvalidHandshake

    from hiernav.view.link import ViewerLink

    link = ViewerLink(object(), 0.1, 0.3, port=0)
    try:
        port = int(link.url.rpartition(":")[2])
        local = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        assert f"0100007F:{port:04X}" in local and f"00000000:{port:04X}" not in local
        assert b"<html" in urllib.request.urlopen(link.url, timeout=60).read(2000).lower()
        version = client.Subprotocol(f"viser-v{__import__('viser').__version__}")
        address = f"ws://127.0.0.1:{port}"
        for elsewhere in ("http://elsewhere.example", f"http://127.0.0.1:{port - 1}", f"http://localhost:{port}"):
            with pytest.raises(InvalidHandshake):
                client.connect(address, origin=elsewhere, subprotocols=[version])
        for own in (link.url, None):
            with client.connect(address, origin=own, subprotocols=[version]) as connection:
                assert connection.recv(timeout=60)
    finally:
        link.close()


@needs_viser
@pytest.mark.parametrize(
    ("host", "origins", "own"),
    [
        ("127.0.0.1:8080", ["http://127.0.0.1:8080"], True),
        ("localhost:9000", ["http://localhost:9000"], True),  # a tunnel with a port of its own
        ("127.0.0.1:8080", [], True),  # no browser
        ("127.0.0.1:8080", ["http://127.0.0.1:3000"], False),
        ("127.0.0.1:8080", ["http://localhost:3000"], False),
        ("127.0.0.1:8080", ["http://elsewhere.example:8080"], False),
        ("elsewhere.example:8080", ["http://elsewhere.example:8080"], False),  # its name leads here
        ("127.0.0.1:8080", ["null"], False),
        ("127.0.0.1:8080", ["http://127.0.0.1:8080", "http://127.0.0.1:3000"], False),
    ],
)
def test_a_request_is_the_page_s_own_if_its_origin_has_the_host_and_the_port_that_are_asked(host, origins, own):
    from websockets.datastructures import Headers

    from hiernav.view.__main__ import is_own

    assert is_own(Headers([("Host", host), *(("Origin", origin) for origin in origins)])) == own


def test_what_is_said_over_the_socket_is_small():
    import msgspec

    assert len(msgspec.json.encode(Settings("t" * 100, 0.1, 0.3, 8080, ("x" * 50,) * 20))) < 2000
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(msgspec.json.encode(Command("fault", text="x" * 201)), type=Command)
