"""The control process is killed or stopped, or the robot's driver fails: the adapter in its own process brakes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from scripted_robot import write_adapter
from shipped import RUN_LOOP
from test_20_signals import descendants

from hiernav.runtime.process_robot import ProcessRobot
from hiernav.runtime.robot import CommandWatchdog
from hiernav.runtime.robot_process import LAST_BRAKES

ROBOT = Path(__file__).parents[1] / "scripted_robot.py"
CONTROL = textwrap.dedent(
    """
    import sys, time
    import numpy as np
    from hiernav.runtime.process_robot import ProcessRobot
    robot = ProcessRobot({robot!r} + ":make", {{"path": {path!r}}})
    robot.read()
    print(robot.child.process.pid, flush=True)
    at = time.monotonic()
    while True:
        robot.send(np.array([1.0, 0.0]))
        at += robot.control_period
        time.sleep(max(at - time.monotonic(), 0.0))
    """
)


def test_the_watchdog_expires_50_ms_after_the_last_command():
    watchdog = CommandWatchdog(0.02)
    watchdog.feed(1.0)
    assert not watchdog.expired(1.0499) and watchdog.expired(1.0501)
    assert CommandWatchdog(0.04).timeout == pytest.approx(0.06)  # one period and a half, where that is longer


def watch(tmp_path: Path, number: signal.Signals) -> list[tuple[str, float]]:
    """What the adapter did with its robot, its control process being sent a signal after a moment."""
    path = tmp_path / "robot.log"
    path.touch()
    program = CONTROL.format(robot=str(ROBOT), path=str(path))
    control = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert control.stdout is not None
    adapter = int(control.stdout.readline())
    try:
        _wait_for(lambda: path.read_text().count("send") > 20)
        control.send_signal(number)
        _wait_for(lambda: "brake" in path.read_text().partition("send")[2].rpartition("send")[2])
        if number is signal.SIGKILL:
            _wait_for(lambda: path.read_text().endswith("\n") and "close" in path.read_text())
    finally:
        control.kill()
        control.wait()
    _wait_for(lambda: not os.path.exists(f"/proc/{adapter}") or _zombie(adapter))
    done = [line.split() for line in path.read_text().splitlines()]
    return [(what, float(at)) for what, at in done]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_the_adapter_brakes_by_itself_and_ends_with_the_control_process(tmp_path, number):
    done = watch(tmp_path, number)
    last = max(k for k, (what, _) in enumerate(done) if what == "send")
    assert done[last + 1][0] == "brake"
    assert done[-1][0] == "close"


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_it_does_so_within_50_ms(tmp_path, number):
    done = watch(tmp_path, number)
    last = max(k for k, (what, _) in enumerate(done) if what == "send")
    assert done[last + 1][1] - done[last][1] <= 0.055  # and what the adapter takes to wake up


@pytest.mark.parametrize(
    "fails, good, failures", [("read", 40, 1), ("send", 5, 99999), ("brake", 0, 1), ("brake", 0, 9)]
)
def test_an_adapter_whose_robot_fails_brakes_for_a_second_and_then_releases_it(tmp_path, capfd, fails, good, failures):
    path = tmp_path / "robot.log"
    robot = ProcessRobot(f"{ROBOT}:make", {"path": str(path), "fails": fails, "good": good, "failures": failures})
    try:
        _wait_for(lambda: robot.send(np.array([1.0, 0.0])) is not None and "send" in path.read_text())
        while robot.child.ended is None:
            robot.brake() if fails == "brake" else robot.send(np.array([1.0, 0.0]))
            time.sleep(robot.control_period)
        with pytest.raises(RuntimeError, match="adapter ended with status 1"):
            for _ in range(3):
                robot.read()
    finally:
        robot.close()
    done = [line.split() for line in path.read_text().splitlines()]
    last = max(k for k, (what, _) in enumerate(done) if what == "send")
    assert {what for what, _ in done[last + 1 : -1]} == {"brake"} and done[-1][0] == "close"
    assert float(done[-1][1]) - float(done[last + 1][1]) >= LAST_BRAKES
    assert f"OSError: {fails}: bus error" in capfd.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_to_the_adapter_alone_leaves_it_to_its_control_process(tmp_path, number):
    path = tmp_path / "robot.log"
    robot = ProcessRobot(f"{ROBOT}:make", {"path": str(path)})
    try:
        robot.read()
        os.kill(robot.child.process.pid, number)
        _wait_for(lambda: robot.send(np.array([1.0, 0.0])) is not None and "send" in path.read_text())
    finally:
        robot.close()
    assert robot.child.ended == 0 and path.read_text().splitlines()[-1].startswith("close")


def test_a_service_whose_adapter_dies_ends_with_code_1_so_that_it_is_started_again(tmp_path):
    log, out = tmp_path / "log", tmp_path / "out"
    adapter = write_adapter(log, tmp_path / "adapter.py")
    command = [sys.executable, str(RUN_LOOP), "--serve", "--control", str(tmp_path / "socket"), "--no-pictures"]
    command += ["--world", "pillar(2,2,10)"]
    service = subprocess.Popen(
        [*command, "--planner", "sync", "--adapter", f"{adapter}:make", "--out", str(out)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        _wait_for(lambda: log.exists() and log.read_text())
        (child,) = descendants(service.pid)
        os.kill(child, signal.SIGKILL)
        _, errors = service.communicate(timeout=60)
    finally:
        service.kill()
    assert service.returncode == 1
    assert "RobotGone: the robot's adapter ended with status -9" in errors
    assert errors.count("Traceback") <= 2, "of the tick, and of the stop that could not be verified"
    assert (out / "summary.json").exists()


def test_a_run_of_several_worlds_whose_adapter_dies_ends_with_code_1_and_the_account_of_what_was_driven(tmp_path):
    command = [sys.executable, "-u", str(RUN_LOOP), "--episodes", "500", "--world", "pillar(2,2,0)", "--no-pictures"]
    process = subprocess.Popen(
        [*command, "--planner", "sync", "--out", str(tmp_path / "out")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None and process.stdout.readline().startswith("seed 0: goal")
        (child,) = descendants(process.pid)
        os.kill(child, signal.SIGKILL)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 1 and "adapter ended with status -9" in errors
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["episodes"][0]["reached"]


@pytest.mark.parametrize("fails", ["brake", "close"])
def test_a_robot_that_fails_when_it_is_released_is_braked_all_the_same(tmp_path, fails):
    path = tmp_path / "robot.log"
    robot = ProcessRobot(f"{ROBOT}:make", {"path": str(path), "fails": fails})
    robot.read()
    robot.close()
    assert robot.child.ended == 1
    done = [line.split()[0] for line in path.read_text().splitlines()]
    assert done[-2:] == ["brake", "close"] and (done.count("brake") > 2) == (fails == "brake")


def _wait_for(condition, patience: float = 30.0) -> None:
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def _zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


SPINNING = textwrap.dedent(
    """
    import os, sys, time
    import numpy as np
    from hiernav.runtime.process_robot import ProcessRobot
    from hiernav.runtime.realtime import RealtimeConfig, request_realtime
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    asked = RealtimeConfig(lock_memory=False, freeze_gc=False)
    robot = ProcessRobot(sys.argv[1] + ":make", {"path": sys.argv[2]}, realtime=asked)
    robot.read()
    asked_for = [request_realtime(asked)["sched_fifo"], robot.realtime["sched_fifo"]]
    granted = all(text.startswith("granted") and "no more than" not in text for text in asked_for)
    robot.send(np.array([1.0, 0.0]))
    time.sleep(0.02)
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        pass
    print(int(granted), robot.watchdog_trips)
    robot.close()
    """
)


def test_the_adapter_brakes_though_the_loop_does_not_let_go_of_the_only_processor(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", SPINNING, str(ROBOT), str(tmp_path / "robot.log")],
        capture_output=True, text=True, check=True, timeout=120.0,
    )  # fmt: skip
    granted, trips = map(int, done.stdout.split())
    if not granted:
        pytest.skip("SCHED_FIFO is not granted here")
    assert trips == 1
