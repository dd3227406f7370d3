"""SIGTERM, and SIGINT twice: the brake at once, what was observed brought to safety within a second, exit code 0."""

from __future__ import annotations

import configparser
import fcntl
import inspect
import json
import os
import signal
import subprocess
import sys
import termios
import textwrap
import time
from argparse import Namespace
from pathlib import Path

import pytest
from scripted_robot import write_adapter
from shipped import RUN_LOOP

from hiernav.drive.episodes import Episodes
from hiernav.drive.exits import OK
from hiernav.runtime import driver, patient, process_robot
from hiernav.runtime.control import tell
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.recorder import Recorder
from hiernav.view import link

PROGRAM = textwrap.dedent(
    """
    import sys, time
    sys.path.insert(0, {tests!r})
    import numpy as np
    from puck import Puck, driver_of
    from hiernav.runtime.clock import MonotonicClock
    from hiernav.runtime.observe import Observer

    class Robot(Puck):
        told = False

        def brake(self):
            if self.sent and not self.told:
                self.told = True
                print("brake", time.monotonic(), flush=True)
            self.log.append("brake")
            self._move(0.8 * self.velocity)  # it rolls out

    class Saver(Observer):
        def tick(self, record):
            if record.index == 20:
                print("driving", time.monotonic(), flush=True)
        def flush(self, timeout):
            print("flush", time.monotonic(), flush=True)

    robot = Robot(control_period=0.02, noise=1e-3)
    driver = driver_of(robot, clock=MonotonicClock(), observers=[Saver()])
    result = driver.run(np.array([1.9, 1.9]), max_steps=100000)
    print("ended", result.reason, result.stopped, robot.log[-1], flush=True)
    """
)


@pytest.mark.parametrize("signals", [[signal.SIGTERM], [signal.SIGINT], [signal.SIGINT, signal.SIGINT]])
def test_a_signal_brakes_and_saves_before_anything_else(signals):
    program = PROGRAM.format(tests=str(Path(__file__).parents[1]))
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("driving")
    sent = time.monotonic()
    process.send_signal(signals[0])
    lines = [process.stdout.readline()]
    for number in signals[1:]:
        process.send_signal(number)
    lines += process.stdout.readlines()
    assert process.wait(60) == 0
    assert [line.split()[0] for line in lines] == ["brake", "flush", "ended"]
    assert lines[-1].split()[1] == "interrupted"
    assert float(lines[1].split()[1]) - sent < 1.0
    assert lines[-1].split()[2] == "True"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_the_command_line_ends_with_code_0_and_its_summary(tmp_path, number):
    out = tmp_path / "out"
    command = [sys.executable, str(RUN_LOOP), "--serve", "--control", str(tmp_path / "socket"), "--no-pictures"]
    process = subprocess.Popen(
        [*command, "--planner", "sync", "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert "ready for goals" in process.stdout.readline()
    time.sleep(0.2)
    process.send_signal(number)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert json.loads((out / "summary.json").read_text())["timing"]["ticks"] > 0


def test_who_serves_ends_with_code_0_although_a_goal_was_refused(tmp_path):
    socket, out = tmp_path / "socket", tmp_path / "out"
    command = [sys.executable, str(RUN_LOOP), "--serve", "--control", str(socket), "--no-pictures"]
    process = subprocess.Popen(
        [*command, "--planner", "sync", "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert "ready for goals" in process.stdout.readline()
    tell(socket, "goal 100,100")
    end = time.monotonic() + 30.0
    while (last := tell(socket, "status")["last"]) is None and time.monotonic() < end:
        time.sleep(0.05)
    assert last["reason"] == "goal_outside"
    tell(socket, "quit")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_to_all_processes_ends_them_in_order_and_the_robot_is_braked_and_released(tmp_path, number):
    log, adapter = tmp_path / "log", write_adapter(tmp_path / "log", tmp_path / "adapter.py")
    command = [sys.executable, str(RUN_LOOP), "--serve", "--control", str(tmp_path / "socket"), "--no-pictures"]
    process = subprocess.Popen(
        [*command, "--adapter", f"{adapter}:make", "--world", "pillar(2,2,10)", "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert "ready for goals" in process.stdout.readline()
    family = descendants(process.pid)
    for _ in range(300):  # the keeper of the planner, the planner and the adapter
        if len(family) == 3 and log.exists() and log.read_text():
            break
        time.sleep(0.1)
        family = descendants(process.pid)
    assert len(family) == 3
    for pid in (*family, process.pid):
        os.kill(pid, number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0 and "Traceback" not in errors, errors
    done = [line.split()[0] for line in log.read_text().splitlines()]
    assert set(done[:-1]) == {"brake"} and done[-1] == "close"
    assert not any(os.path.exists(f"/proc/{pid}") for pid in family)


def test_a_terminal_that_is_closed_ends_the_command_line_as_well_and_costs_no_summary(tmp_path):
    """Nothing can be shown any more: every write to it fails."""
    ours, theirs = os.openpty()
    out = tmp_path / "out"
    command = [sys.executable, str(RUN_LOOP), "--serve", "--control", str(tmp_path / "socket"), "--no-pictures"]
    process = subprocess.Popen(
        [*command, "--planner", "sync", "--out", str(out)],
        stdin=theirs, stdout=theirs, stderr=theirs,
        start_new_session=True, preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(theirs)
    shown = b""
    while b"ready for goals" not in shown:
        shown += os.read(ours, 4096)
    os.close(ours)
    assert process.wait(60) == 0
    assert json.loads((out / "summary.json").read_text())["episodes"] == []


def test_the_processes_end_while_the_recording_is_finished_and_the_account_is_given(monkeypatch):
    done = []

    class Part:
        def __init__(self, name: str) -> None:
            self.name = name

        def dismiss(self) -> None:
            done.append(self.name)

        close = dismiss

    episodes = object.__new__(Episodes)
    episodes.remote, episodes.link, episodes.recorder = Part("adapter"), Part("planner"), Part("recorder")
    episodes.page, episodes.arguments = Part("page"), Namespace(no_pictures=True)
    monkeypatch.setattr(Episodes, "_finish", lambda self, drives: done.append("account") or OK)
    assert episodes._account_for(lambda drives: done.append("loop")) == OK
    assert done == ["loop", "adapter", "planner", "recorder", "account", "page"]


def test_what_is_waited_for_where_everything_hangs_fits_into_what_the_service_manager_gives():
    """One after another: observers, a complaint, the stop; then the adapter, beside recorder, screen and page."""
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.read(RUN_LOOP.with_name("hiernav.service"))
    recording = inspect.signature(Recorder.close).parameters["timeout"].default
    beside = max(process_robot.CLOSING, recording + patient.PATIENCE + link.CLOSING)
    waits = driver.FLUSH_SECONDS + patient.BRIEFLY + DriverConfig().stop_timeout + beside
    assert waits <= unit.getfloat("Service", "TimeoutStopSec") - 0.5


def descendants(pid: int) -> list[int]:
    """Processes that it started, and those that these did."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(stat.parent.name))
        except OSError:
            continue
    return [each for child in found for each in (child, *descendants(child))]
