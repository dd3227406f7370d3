"""Claims about a robot whose adapter lives in a process of its own."""

from __future__ import annotations

import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shipped import ROOT

from hiernav.runtime.process_robot import ProcessRobot
from hiernav.runtime.robot import SensorFrame, Truth
from hiernav.runtime.robot_process import make_robot
from hiernav.runtime.wire import decode_frame, encode_frame

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
        np.testing.assert_array_equal(robot.send(np.array([2.0, -0.5])), [1.0, -0.5])
        with pytest.raises(ValueError, match="finite"):
            robot.send(np.array([math.nan, 0.0]))
        with pytest.raises(RuntimeError, match="OSError: bus error"):
            robot.call("fail")
        assert set(robot.realtime) >= {"sched_fifo", "timer_slack"}
    finally:
        robot.close()
    done = [line.split()[0] for line in log.read_text().splitlines()]
    assert done[0] == "send" and done[-2:] == ["brake", "close"]


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


def test_an_adapter_that_ends_is_an_error_at_the_next_read(tmp_path):
    robot = ProcessRobot(SCRIPTED, {"path": str(tmp_path / "log")})
    robot.read()
    robot.child.process.kill()
    robot.child.process.wait()
    robot.brake()
    with pytest.raises(RuntimeError, match="adapter ended with status -9"):
        for _ in range(3):
            robot.read()
    robot.close()


def test_a_robot_that_cannot_be_made_is_refused_at_once(tmp_path):
    robot = ProcessRobot("nothing.py:make", {})
    with pytest.raises(RuntimeError, match="adapter ended with status 1"):
        robot.read()
    robot.close()
    for name, why in (("no_colon", "expected module:function"), (f"{tmp_path}/x.py:make", "no such file"),
                      ("hiernav.runtime.sim_robot:nothing", "has no 'nothing'")):  # fmt: skip
        with pytest.raises(ValueError, match=why):
            make_robot(name, {})


def test_the_example_robot_drives_where_it_is_told():
    robot = make_robot(str(ROOT / "deploy" / "example_robot.py") + ":make", {})
    frame = robot.read()
    assert frame.position_fix is not None and np.linalg.norm(frame.position_fix) < 0.2
    assert robot.send(np.array([1.5, 0.0])).tolist() == [1.0, 0.0]
    board = robot._board
    board._at -= 1.0  # a second passes
    assert robot.read().velocimeter[0] > 1.0
    robot.brake()
    board._at -= 3.0
    assert abs(robot.read().velocimeter[0]) < 0.15
    robot.close()
