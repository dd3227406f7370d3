"""Claims about a robot whose adapter lives in a process of its own."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from puck import Puck
from shipped import ROOT

from hiernav.runtime import process_robot
from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.mailbox import Mailbox, mapped, shared_memory
from hiernav.runtime.process_robot import ProcessRobot, simulated
from hiernav.runtime.realtime import RealtimeConfig
from hiernav.runtime.robot import RobotGone, SensorFrame, Truth
from hiernav.runtime.robot_process import LAST_BRAKES, SLOW, STATUS, Adapter, make_robot
from hiernav.runtime.settings import load_settings
from hiernav.runtime.wire import CAPACITY, decode_frame, encode_command, encode_frame

EXAMPLE = f"{ROOT / 'deploy' / 'example_robot.py'}:make"
SCRIPTED = f"{Path(__file__).parent / 'scripted_robot.py'}:make"
anything = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.floats(allow_nan=False),
    st.one_of(st.none(), st.lists(anything, min_size=3, max_size=3)),
    st.dictionaries(st.text(max_size=5), st.lists(anything, max_size=4), max_size=3),
)
def test_a_frame_arrives_bit_for_bit(stamp, gyro, extra):
    frame = SensorFrame(
        stamp,
        gyro=None if gyro is None else np.array(gyro),
        extra={name: np.array(value, float) for name, value in extra.items()},
        position_fix=np.array([1.0, math.nan]),
    )
    truth = Truth(1.0, np.ones(3), np.zeros(2), 1.0, True, 3)
    back, true = decode_frame(encode_frame(frame, truth))
    assert back.stamp == frame.stamp and back.fix_stamp is None and back.lidar is None
    for ours, theirs in ((back.terms(), frame.terms()), ({"fix": back.position_fix}, {"fix": frame.position_fix})):
        assert ours.keys() == theirs.keys()
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name])
    assert true is not None and (true.pose == 1.0).all() and (true.collided, true.collisions) == (True, 3)


def test_commands_reach_the_robot_and_frames_come_back(tmp_path):
    log = tmp_path / "log"
    robot = ProcessRobot(SCRIPTED, {"path": str(log)})
    try:
        assert (robot.control_period, robot.action_dim) == (0.02, 2)
        assert robot.read().gyro is not None and robot.truth() is None
        while "send" not in log.read_text():  # a command that is found late is not followed
            np.testing.assert_array_equal(robot.send(np.array([2.0, -0.5])), [1.0, -0.5])
            time.sleep(0.001)
        with pytest.raises(ValueError, match="finite"):
            robot.send(np.array([math.nan, 0.0]))
        with pytest.raises(RuntimeError, match="OSError: bus error"):
            robot.call("fail")
        assert set(robot.realtime) >= {"sched_fifo", "timer_slack"}
    finally:
        robot.close()
    done = [line.split()[0] for line in log.read_text().splitlines()]
    assert "send" in done and done[-2:] == ["brake", "close"]


def test_the_adapter_asks_for_what_the_settings_say(tmp_path):
    allowed = sorted(os.sched_getaffinity(0))
    asked = RealtimeConfig(fifo_priority=None, lock_memory=False, cpus=(allowed[-1],))
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log")}, realtime=asked)
    try:
        granted = dict(robot.realtime)
        assert os.sched_getaffinity(robot.child.process.pid) == {allowed[-1]}
    finally:
        robot.close()
    assert granted["cpu_affinity"] == f"granted: CPU {allowed[-1]}"
    assert granted["sched_fifo"] == granted["mlockall"] == "not asked"


def test_a_robot_is_released_at_once_where_it_stands_and_else_after_a_second_of_brakes(tmp_path):
    def released(name: str, does: Callable[[ProcessRobot], object]) -> tuple[list[str], float]:
        """What was done after the last command, and for how long [s]."""
        log = tmp_path / name
        robot = ProcessRobot(SCRIPTED, {"path": str(log)})
        try:
            robot.read()
            does(robot)
        finally:
            robot.close()
        assert robot.child.ended == 0
        done = [line.split() for line in log.read_text().splitlines()]
        last = max((k for k, (what, _) in enumerate(done) if what == "send"), default=-1)
        return [what for what, _ in done[last + 1 :]], float(done[-1][1]) - float(done[last + 1][1])

    def drive(robot: ProcessRobot) -> None:
        while "send" not in (tmp_path / "driven").read_text():
            robot.send(np.array([1.0, 0.0]))
            time.sleep(0.001)
        robot.brake()

    done, seconds = released("driven", drive)
    assert done[-1] == "close" and set(done[:-1]) == {"brake"} and seconds >= LAST_BRAKES
    assert released("never", lambda robot: None)[0] == ["brake", "close"]
    assert released("stands", lambda robot: (setattr(robot, "_driven", True), robot.stands()))[0] == ["brake", "close"]


def test_a_robot_that_is_slow_at_first_is_waited_for(tmp_path):
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log"), "slow": 0.3})
    try:
        assert robot.control_period == 0.02
        assert robot.read().gyro is not None
    finally:
        robot.close()


def test_an_adapter_without_a_first_frame_is_an_error_once_patience_ends(tmp_path):
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log")})
    try:
        robot.read()
        os.kill(robot.child.process.pid, signal.SIGSTOP)
        robot._patience = 0.2
        with pytest.raises(RuntimeError, match="adapter shows no frame for 0.2 s"):
            for _ in range(3):
                robot._newest = None
                robot.read()
    finally:
        os.kill(robot.child.process.pid, signal.SIGCONT)
        robot.close()


def test_every_fix_of_the_example_robot_reaches_a_loop_that_sees_every_fourth_frame(monkeypatch):
    robot = make_robot(EXAMPLE, {})
    now = robot._board._at
    monkeypatch.setattr(sys.modules["example_robot"], "time", SimpleNamespace(monotonic=lambda: now))
    memory = shared_memory(STATUS + 2 * Mailbox.size(CAPACITY))
    adapter = Adapter(robot, -1, -1, memory)
    frames = Mailbox(mapped(memory), STATUS + Mailbox.size(CAPACITY), CAPACITY)
    read, made, seen, silences = robot.read, [], [], []
    estimator = Estimator(EstimatorConfig(tilts=False))

    def noting() -> SensorFrame:
        frame = read()
        made.extend([] if frame.fix_stamp is None else [frame.fix_stamp])
        return frame

    monkeypatch.setattr(robot, "read", noting)
    for _ in range(500):
        for _ in range(4):
            now += 0.25 * robot.control_period
            adapter._publish()
        frame, _ = decode_frame(frames.get())
        estimator.update(frame)
        seen.extend([] if frame.fix_stamp in seen else [frame.fix_stamp])
        silences.append(estimator._watch.silence("position_fix", frame.stamp))
    os.close(memory)
    assert len(made) > 90 and seen == made
    assert max(silences) < 0.13
    assert estimator.counts["stale_fix"] == 1, "the first one is older than the first frame that is seen"


def test_a_command_counts_from_when_it_was_given_and_an_old_one_is_not_followed():
    memory = shared_memory(STATUS + 2 * Mailbox.size(CAPACITY))
    robot = Puck(control_period=0.02)
    adapter, commands = Adapter(robot, -1, -1, memory), Mailbox(mapped(memory), STATUS, CAPACITY)

    def done(now: float, command: np.ndarray | None = None, given: float | None = None) -> list[str]:
        """What the adapter does at `now`, where it finds a command that was given at `given`."""
        robot.log.clear()
        if given is not None:
            commands.put(encode_command(command, given))
        adapter._obey(now)
        return robot.log

    go = np.array([1.0, 0.0])
    assert done(1.0) == [], "nothing has moved that could be braked"
    assert done(3.0, go, given=1.0) == ["brake"] and robot.sent == []
    assert done(4.0, go, given=4.0001) == ["send"], "given while the adapter looked"
    assert done(5.04, go, given=5.0) == ["send"]
    np.testing.assert_array_equal(robot.sent[-1], go)
    assert done(5.0499) == [] and adapter.watchdog.trips == 0
    assert done(5.0501) == ["brake"] and adapter.watchdog.trips == 1
    assert done(6.0, go, given=5.9) == ["brake"] and len(robot.sent) == 2
    assert done(6.03) == ["brake"], "it has not fed the watchdog"
    assert done(7.0, None, given=6.0) == ["brake"] and done(7.0, None, given=7.0) == ["brake"]
    os.close(memory)


def test_the_newest_fix_of_the_example_robot_is_in_every_frame():
    robot, stamps = ProcessRobot(EXAMPLE), set()
    try:
        while len(stamps) < 4:
            frame = robot.read()
            assert frame.position_fix is not None and frame.fix_stamp is not None
            stamps.add(frame.fix_stamp)
            time.sleep(0.002)
    finally:
        robot.close()


def test_a_fix_that_was_overtaken_does_not_hide_the_newer_one():
    adapter = Adapter(make_robot(EXAMPLE, {}), -1, -1, shared_memory(STATUS + 2 * Mailbox.size(CAPACITY)))
    for stamp, fix_stamp, shown in ((1.0, None, 1.0), (1.1, 0.9, 1.0), (1.2, 99.0, 99.0), (1.3, 1.25, 1.25),
                                    (0.1, 0.05, 0.05)):  # fmt: skip
        frame = adapter._with_newest_fix(SensorFrame(stamp, position_fix=np.zeros(2), fix_stamp=fix_stamp))
        assert frame.fix_stamp == shown
        assert adapter._with_newest_fix(SensorFrame(stamp + 0.01)).fix_stamp == shown


def test_a_robot_that_starts_anew_has_no_fix_of_before():
    robot = simulated(robot="point", world="pillar(2,2,0)", noise={"fix_latency": 0.3})
    try:
        while robot.read().position_fix is None:
            robot.brake()
            time.sleep(robot.control_period)
        robot.call("restart", seed=1)
        assert robot.read().position_fix is None
    finally:
        robot.close()


def test_an_adapter_that_ends_is_an_error_at_the_next_read(tmp_path):
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log")})
    robot.read()
    robot.child.process.kill()
    robot.child.process.wait()
    robot.brake()
    with pytest.raises(RobotGone, match="adapter ended with status -9"):
        for _ in range(3):
            robot.read()
    with pytest.raises(RobotGone, match="adapter ended with status -9"):
        robot.call("restart", seed=1)
    robot.close()


THREADED = """
import sys, threading, time
sys.path.insert(0, {folder!r})
import scripted_robot

def make(**manners):
    threading.Thread(target=time.sleep, args=(600.0,)).start()  # as drivers of serial ports and the like do
    print("connected")
    return scripted_robot.make({log!r}, **manners)
"""


@pytest.mark.parametrize("fails", ["", "read"])
def test_a_thread_that_the_robots_driver_leaves_running_keeps_no_process(tmp_path, capfd, fails):
    file, log = tmp_path / "threaded.py", tmp_path / "log"
    file.write_text(THREADED.format(folder=str(Path(__file__).parent), log=str(log)))
    robot = ProcessRobot(f"{file}:make", {"fails": fails, "good": 3})
    try:
        robot.read()
        if fails:
            with pytest.raises(RobotGone, match=r": OSError: read: bus error \(scripted_robot.py:"):
                while True:
                    robot.read()
                    time.sleep(0.005)
    finally:
        robot.close()
    assert not robot.killed and log.read_text().split()[-2] == "close"
    said = capfd.readouterr()
    assert said.out == "" and "connected" in said.err  # the standard output is this process's own


PRINTING = """
import sys
sys.path.insert(0, {folder!r})
import scripted_robot

class Robot(scripted_robot.ScriptedRobot):
    def read(self):
        print("reading " * 20, flush=True)
        return super().read()

make = Robot
"""


@pytest.mark.parametrize("fails", ["", "read"])
def test_a_robot_whose_messages_nobody_reads_is_braked_and_released_and_its_adapter_ends(tmp_path, monkeypatch, fails):
    file, log = tmp_path / "printing.py", tmp_path / "log"
    file.write_text(PRINTING.format(folder=str(Path(__file__).parent)))
    monkeypatch.setattr(process_robot, "CLOSING", 20.0)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, b"x")
    os.set_blocking(writer, True)
    before = os.dup(2)
    os.dup2(writer, 2)
    try:
        robot = ProcessRobot(f"{file}:make", {"path": str(log), "fails": fails, "good": 3})
        with pytest.raises(RobotGone) if fails else nullcontext():
            first = robot.read().stamp
            while robot.read().stamp < first + 0.1 or fails:
                time.sleep(0.005)
        robot.close()
    finally:
        os.dup2(before, 2)
        for each in (before, reader, writer):
            os.close(each)
    assert not robot.killed and robot.child.ended == (1 if fails else 0)
    assert [line.split()[0] for line in log.read_text().splitlines()][-2:] == ["brake", "close"]


def test_an_adapter_that_was_dismissed_has_no_more_time_to_end_than_since_then(tmp_path, monkeypatch):
    monkeypatch.setattr(process_robot, "CLOSING", 2.0)
    robot, waits = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log")}), []
    robot.read()
    os.kill(robot.child.process.pid, signal.SIGSTOP)
    wait = robot.child.process.wait
    monkeypatch.setattr(robot.child.process, "wait", lambda timeout: (waits.append(timeout), wait(timeout))[1])
    robot.dismiss()
    time.sleep(0.5)
    robot.close()
    assert robot.killed and waits[0] <= 1.5


def test_an_adapter_that_does_not_end_is_killed_and_that_is_known(tmp_path, monkeypatch):
    file = tmp_path / "stuck.py"
    file.write_text(
        THREADED.format(folder=str(Path(__file__).parent), log=str(tmp_path / "log"))
        + "\nscripted_robot.ScriptedRobot.close = lambda self: time.sleep(600.0)\n"
    )
    monkeypatch.setattr(process_robot, "CLOSING", 0.2)
    robot = ProcessRobot(f"{file}:make")
    robot.read()
    robot.close()
    assert robot.killed


def test_a_robot_that_was_made_too_late_is_released_without_a_word(capfd):
    memory, robot = shared_memory(STATUS + 2 * Mailbox.size(CAPACITY)), Puck(control_period=0.02)
    calls, ours = socket.socketpair()
    calls.close()
    news, wake = os.pipe()
    adapter = Adapter(robot, news, ours.fileno(), memory)
    assert adapter.run() == 0 and robot.log[-1] == "close" and "send" not in robot.log
    assert capfd.readouterr().err == ""
    for each in (news, wake, memory):
        os.close(each)
    ours.close()


def test_a_robot_that_keeps_commands_waiting_again_and_again_is_told_of():
    memory = shared_memory(STATUS + 2 * Mailbox.size(CAPACITY))
    adapter, status = Adapter(Puck(control_period=0.02), -1, -1, memory), np.frombuffer(mapped(memory), np.float64, 3)

    def looked(*gaps: float) -> float:
        for gap in gaps:
            looked.now += gap
            adapter._kept = gap  # by `read` and `send`
            adapter._obey(looked.now)
        return float(status[SLOW])

    looked.now = 0.0
    assert looked(*[0.045] * 40) == 0.0, "as fast as a robot may be left alone"
    assert looked(0.3, *[0.005] * 100, 0.2, 0.2, 0.2) == 0.0, "now and then, as a busy machine does"
    assert looked(0.12) == pytest.approx(0.3) and looked(0.12) == pytest.approx(0.2)
    assert looked(*[0.12] * 10) == pytest.approx(0.12)
    assert looked(*[0.01] * 140) == pytest.approx(0.12) and looked(*[0.01] * 60) == 0.0
    os.close(memory)


class Unspeakable(Exception):
    def __str__(self) -> str:
        raise RuntimeError("never to be said")


@pytest.mark.parametrize("error", [OSError("bad packet " + 1_000_000 * "x"), Unspeakable()])
def test_a_robot_is_braked_at_once_whatever_its_error_looks_like(error, capfd):
    memory, robot = shared_memory(STATUS + 2 * Mailbox.size(CAPACITY)), Puck(control_period=0.02)
    calls, ours = socket.socketpair()
    news, wake = os.pipe()
    adapter, read, done = Adapter(robot, news, ours.fileno(), memory), robot.read, []

    def failing() -> SensorFrame:
        if len(done) == 3:
            robot.log.append("failed")
            raise error
        done.append("read")
        return read()

    robot.read = failing
    assert adapter.run() == 1
    after = robot.log[robot.log.index("failed") + 1 :]
    assert after[0] == "brake" and after[-1] == "close" and len(after) > 10
    assert type(error).__name__ in capfd.readouterr().err
    said = calls.recv(65536).splitlines()[-1]
    assert type(error).__name__ in json.loads(said)["gone"] and len(said) < 1500
    for each in (news, wake, memory):
        os.close(each)
    calls.close()
    ours.close()


def test_a_robot_whose_brake_is_slow_is_driven(tmp_path):
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log"), "slow_brake": 0.06})
    try:
        robot.read()
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            robot.brake()
            time.sleep(0.02)
        assert robot.trouble() is None
    finally:
        robot.close()


def test_the_control_process_knows_of_a_robot_that_is_too_slow(tmp_path):
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log"), "slow": 0.12, "slow_reads": 1000})
    try:
        robot.read()
        end = time.monotonic() + 20.0
        while robot.trouble() is None and time.monotonic() < end:
            time.sleep(0.01)
        assert "keeps commands waiting for 0." in robot.trouble()
    finally:
        robot.close()


@pytest.mark.parametrize(
    ("code", "name", "why", "traced"),
    [
        (None, "a.py:make", "there is no such file", False),
        (None, "foo", "expected file.py:function or package.module:function", False),
        (None, "no_such_module:make", "ModuleNotFoundError: No module named 'no_such_module'", False),
        ("make = 3 +\n", "a.py:make", "SyntaxError: invalid syntax (a.py, line 1)", False),
        ("def make(): return 5\n", "a.py:make", "make makes int, which has no control_period, action_dim, read", False),
        ("x = 1\n", "a.py:make", "a.py has no 'make'", False),
        ("def make(port): ...\n", "a.py:make", "TypeError: make() missing 1 required positional argument", False),
        ("def make():\n    return open('/dev/none')\n", "a.py:make", "none' (a.py:2)", True),
        ("import sys\nsys.exit('no bus')\n", "a.py:make", "SystemExit: no bus (a.py:2)", True),
    ],
)  # fmt: skip
def test_a_robot_that_cannot_be_made_is_refused_at_once_in_one_line(
    tmp_path, monkeypatch, capfd, code, name, why, traced
):
    monkeypatch.chdir(tmp_path)
    if code is not None:
        Path("a.py").write_text(code)
    robot = ProcessRobot(name, patience=60.0)
    with pytest.raises(RobotGone) as refused:
        robot.control_period  # noqa: B018
    robot.close()
    assert str(refused.value).startswith(f"adapter {name!r}: ") and why in str(refused.value)
    assert "\n" not in str(refused.value)
    assert ("Traceback" in capfd.readouterr().err) == traced


def test_a_robot_that_cannot_be_read_at_first_is_braked_and_refused_with_what_it_said(tmp_path):
    log = tmp_path / "log"
    robot = ProcessRobot(SCRIPTED, {"path": str(log), "fails": "read"})
    with pytest.raises(RobotGone, match=r"cannot start: OSError: read: bus error \(scripted_robot.py:\d+\)"):
        robot.read()
    robot.close()
    assert [line.split()[0] for line in log.read_text().splitlines()][-2:] == ["brake", "close"]


def test_an_adapter_that_has_ended_is_noticed_although_what_it_started_lives(tmp_path):
    adapter, over = tmp_path / "forks.py", tmp_path / "over"
    adapter.write_text(
        "import os, time\n"
        "def make():\n"
        "    end = time.monotonic() + 90.0\n"
        "    child = os.fork() == 0\n"
        f"    while child and not os.path.exists({str(over)!r}) and time.monotonic() < end: time.sleep(0.1)\n"
        "    os._exit(7)\n"
    )
    robot = ProcessRobot(f"{adapter}:make", patience=60.0)
    try:
        with pytest.raises(RobotGone, match="adapter ended with status 7"):
            robot.read()
    finally:
        over.touch()
        robot.close()


@pytest.mark.parametrize(
    ("name", "why"),
    [("foo", "expected file.py:function"), ("x.py:make", "no such file"), ("json:no", "has no 'no'")],
)  # fmt: skip
def test_a_name_that_leads_to_no_robot_is_refused(name, why):
    with pytest.raises(ValueError, match=why):
        make_robot(name, {})


class ExampleDrive:
    """The example robot on a clock of its own."""

    def __init__(self, monkeypatch) -> None:
        self.robot = make_robot(EXAMPLE, {})
        self.now = self.robot._board._at
        monkeypatch.setattr(sys.modules["example_robot"], "time", SimpleNamespace(monotonic=lambda: self.now))

    def speed_after(self, seconds: float, action: Sequence[float] | None = None) -> float:
        """True forward speed once that time has passed, under `action` in each period if there is one [m/s]."""
        for _ in range(round(seconds / self.robot.control_period)):
            if action is not None:
                self.robot.send(np.array(action))
            self.now += self.robot.control_period
        self.robot.read()
        return self.robot._board._speed


def test_the_example_robot_drives_where_it_is_told(monkeypatch):
    drive = ExampleDrive(monkeypatch)
    robot = drive.robot
    frame = robot.read()
    assert frame.position_fix is not None and np.linalg.norm(frame.position_fix) < 0.2
    assert robot.send(np.array([1.5, -1.5])).tolist() == [0.05, -1.0]
    assert drive.speed_after(1.0, (1.0, 0.0)) > 1.0
    assert robot.read().velocimeter[0] > 1.0
    robot.brake()
    assert abs(drive.speed_after(3.0)) < 0.01
    robot.close()


def test_the_example_robot_saturates_as_the_body_does_so_that_its_guard_slows_it_in_proportion(monkeypatch):
    saturation = load_settings([ROOT / "deploy" / "point.yaml"]).guard.saturation
    full, slightly_slowed, half = (
        ExampleDrive(monkeypatch).speed_after(4.0, (scale * saturation, 0.0)) for scale in (20.0, 0.99, 0.5)
    )
    assert full == pytest.approx(1.5, rel=0.01)
    assert slightly_slowed == pytest.approx(0.99 * full) and half == pytest.approx(0.5 * full)


def test_the_board_of_the_example_stops_by_itself_when_nobody_commands_it(monkeypatch):
    drive = ExampleDrive(monkeypatch)
    fast = drive.speed_after(1.0, (1.0, 0.5))
    slightly_later = drive.speed_after(0.06)
    assert slightly_later >= fast, "a command is late, not lost"
    assert drive.speed_after(0.1) < slightly_later
    assert drive.speed_after(2.0) < 0.05 * fast and abs(drive.robot._board._turn) < 0.01
    assert drive.speed_after(0.5, (1.0, 0.0)) > 0.5, "it drives on with the next command"
