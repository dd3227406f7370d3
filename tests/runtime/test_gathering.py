"""A robot whose sensors speak at rates of their own loses nothing on the way to a loop that looks less often."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from hiernav.runtime.gathering import Gathering
from hiernav.runtime.process_robot import ProcessRobot
from hiernav.runtime.robot import SensorFrame

READ, PERIOD = 0.005, 0.02


def reading(stamp: float) -> np.ndarray:
    return np.array([stamp, 0.0, 0.0])


def taken_every(reads: int, frame_at) -> list[SensorFrame]:
    """What a loop sees that takes each `reads`-th frame."""
    gathering, seen, taken = Gathering(PERIOD), [], 0
    for k in range(60):
        shown = gathering.add(frame_at(k), k + 1, taken)
        if k % reads == reads - 1:
            seen.append(shown)
            taken = k + 1
    return seen


@pytest.mark.parametrize("reads", [3, 4, 5])
def test_every_reading_that_came_since_the_last_frame_was_taken_is_shown_once_with_its_stamp(reads):
    def frame_at(k: int) -> SensorFrame:
        stamp = k * READ
        return SensorFrame(
            stamp,
            gyro=reading(stamp) if k % 5 == 0 else None,
            lidar=np.full(10, stamp) if k % 10 == 3 else None,
            extra={"joint_sin": reading(stamp)} if k % 7 == 2 else {},
        )

    seen = taken_every(reads, frame_at)
    spoke = [frame for frame in seen if frame.gyro is not None]
    assert all(frame.gyro[0] == frame.stamp for frame in spoke), "the stamp is that of the inertial sensors"
    shown = [frame.gyro[0] for frame in spoke]
    made = [k * READ for k in range(len(seen) * reads) if k % 5 == 0]
    assert shown == made
    lidar = [frame.lidar[0] for frame in seen if frame.lidar is not None]
    joints = [frame.extra["joint_sin"][0] for frame in seen if frame.extra]
    assert lidar == [k * READ for k in range(len(seen) * reads) if k % 10 == 3]
    assert joints == [k * READ for k in range(len(seen) * reads) if k % 7 == 2]
    stamps = [frame.stamp for frame in seen]
    assert all(later > earlier for earlier, later in zip(stamps, stamps[1:], strict=False))


def test_of_several_readings_the_newest_is_shown():
    gathering = Gathering(PERIOD)
    gathering.add(SensorFrame(0.0, gyro=reading(1.0), velocimeter=reading(1.0)), 1, 0)
    gathering.add(SensorFrame(0.005, gyro=reading(2.0)), 2, 0)
    shown = gathering.add(SensorFrame(0.010), 3, 0)
    assert (shown.gyro[0], shown.velocimeter[0], shown.stamp) == (2.0, 1.0, 0.005)


@pytest.mark.parametrize("stamp", [0.0401, -1.0, math.nan])
def test_a_reading_is_not_shown_for_more_than_two_periods_nor_by_another_clock(stamp):
    gathering = Gathering(PERIOD)
    gathering.add(SensorFrame(0.0, gyro=reading(1.0)), 1, 0)
    assert gathering.add(SensorFrame(stamp), 2, 0).gyro is None
    assert gathering.add(SensorFrame(0.05), 3, 0).gyro is None


def test_a_fix_keeps_the_time_it_was_measured_at():
    gathering = Gathering(PERIOD)
    gathering.add(SensorFrame(0.0, gyro=reading(1.0)), 1, 0)
    shown = gathering.add(SensorFrame(0.01, position_fix=np.ones(2)), 2, 0)
    assert (shown.stamp, shown.fix_stamp) == (0.0, 0.01)


def test_a_robot_that_starts_anew_shows_nothing_of_before():
    gathering = Gathering(PERIOD)
    gathering.add(SensorFrame(0.0, gyro=reading(1.0)), 1, 0)
    gathering.forget()
    assert gathering.add(SensorFrame(0.01), 2, 0).gyro is None


def test_a_gyro_slower_than_the_adapter_reads_is_in_nearly_every_frame_the_loop_takes(tmp_path):
    adapter = tmp_path / "slow_gyro.py"
    adapter.write_text(
        "import time\nimport numpy as np\nfrom hiernav.runtime.robot import SensorFrame\n"
        "class Robot:\n"
        "    control_period, action_dim, next = 0.02, 2, 0.0\n"
        "    def read(self):\n"
        "        now = time.monotonic()\n"
        "        if now < self.next:\n"
        "            return SensorFrame(now)\n"
        "        self.next = now + 0.019\n"
        "        return SensorFrame(now, gyro=np.full(3, now))\n"
        "    def send(self, action): return action\n"
        "    def brake(self): pass\n"
        "    def close(self): pass\n"
        "make = Robot\n"
    )
    robot, frames = ProcessRobot(f"{adapter}:make"), []
    try:
        end = time.monotonic() + 30.0
        while len(frames) < 50 and time.monotonic() < end:
            frame = robot.read()
            if not frames or frame is not frames[-1]:
                frames.append(frame)
            robot.brake()
            time.sleep(0.025)
    finally:
        robot.close()
    shown = [frame.gyro[0] for frame in frames if frame.gyro is not None]
    assert len(shown) > 0.7 * len(frames)
    assert len(set(shown)) > 0.95 * len(shown)
