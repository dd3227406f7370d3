"""A sensor that repeats its value under fresh stamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import Motion, estimator_for, follow, frames, recorded

from hiernav.runtime import freshness
from hiernav.runtime.estimate import Trust
from hiernav.runtime.freshness import SensorWatch, TermWatch
from hiernav.runtime.robot import VECTOR_SENSORS, SensorFrame

BEGIN = 1.5


def freeze(sensor: str, begin: float = BEGIN, end: float = 99.0):
    last: list[np.ndarray] = []

    def damage(frame: SensorFrame) -> SensorFrame:
        value = getattr(frame, sensor)
        if value is None:
            return frame
        if frame.stamp < begin or not last:
            last[:] = [value]
        return replace(frame, **{sensor: last[0]}) if frame.stamp < end else frame

    return damage


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("sensor", VECTOR_SENSORS)
def test_a_frozen_sensor_asks_to_hold_within_half_a_second(robot, sensor):
    motion = recorded(robot)
    estimator = estimator_for(motion)
    errors = follow(motion, estimator, frames(motion), freeze(sensor))
    held = next(each for each in errors.estimates if each.trust is not Trust.GOOD)
    assert BEGIN < held.stamp <= BEGIN + 0.5
    assert held.why.startswith(f"{sensor} says nothing usable")
    assert estimator.counts[f"{sensor}_frozen"] > 0
    assert errors.estimates[-1].trust is Trust.LOST


def freeze_all(begin: float = BEGIN, end: float = 99.0):
    """Whatever reads the sensors hangs, and shows what it read last under fresh stamps."""
    damages = [freeze(sensor, begin, end) for sensor in (*VECTOR_SENSORS, "position_fix")]

    def damage(frame: SensorFrame) -> SensorFrame:
        for each in damages:
            frame = each(frame)
        return frame

    return damage


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_sensors_that_all_freeze_at_once_are_not_driven_on_either(robot):
    motion = recorded(robot)
    errors = follow(motion, estimator_for(motion), frames(motion), freeze_all())
    held = next(each for each in errors.estimates if each.stamp > 1.0 and each.trust is not Trust.GOOD)
    assert BEGIN < held.stamp <= BEGIN + 0.5 and "says nothing usable" in held.why
    assert errors.estimates[-1].trust is Trust.LOST


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_sensors_that_froze_together_are_watched_again_once_they_have_thawed(robot):
    motion = recorded(robot)
    twice = [freeze_all(BEGIN, BEGIN + 0.5), freeze_all(BEGIN + 1.0)]
    errors = follow(
        motion, estimator_for(motion), frames(motion), lambda frame: twice[frame.stamp >= BEGIN + 0.8](frame)
    )
    assert any(each.trust is Trust.HOLD for each in errors.estimates if BEGIN < each.stamp < BEGIN + 0.5)
    assert all(each.trust is Trust.GOOD for each in errors.estimates if BEGIN + 0.7 < each.stamp < BEGIN + 1.0)
    assert any(each.trust is not Trust.GOOD for each in errors.estimates if BEGIN + 1.0 < each.stamp < BEGIN + 1.5)


def test_a_sensor_that_thaws_is_trusted_again():
    motion = recorded("car")
    errors = follow(motion, estimator_for(motion), frames(motion), freeze("gyro", end=BEGIN + 0.5))
    assert any(each.trust is Trust.HOLD for each in errors.estimates)
    assert all(each.trust is Trust.GOOD for each in errors.estimates if each.stamp > BEGIN + 0.6)


def test_a_frozen_position_fix_is_not_driven_on():
    motion = recorded("point")
    estimator = estimator_for(motion)
    errors = follow(motion, estimator, frames(motion), freeze("position_fix"))
    nominal = follow(motion, estimator_for(motion), frames(motion))
    soon = round(1.0 / motion.stamps[1])
    at = round(BEGIN / motion.stamps[1])
    assert np.abs(errors.position[at : at + soon]).max() < 0.15
    assert nominal.position[at : at + soon].max() < 0.06
    assert any(each.trust is Trust.HOLD and "position_fix" in each.why for each in errors.estimates)
    assert estimator.counts["position_fix_frozen"] > 10


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("noise", [1.0, 0.0])
def test_healthy_sensors_are_never_taken_for_frozen_with_noise_and_without(robot, noise):
    motion = recorded(robot)
    for seed in range(3):
        errors = follow(motion, estimator_for(motion), frames(motion, seed, noise=noise))
        assert all(each.trust is Trust.GOOD for each in errors.estimates)


def test_wheel_encoders_that_say_zero_at_rest_are_not_frozen():
    motion = recorded("point")
    still = {name: np.repeat(values[:1], len(values), 0) for name, values in motion.sensors.items()}
    rest = replace(motion, sensors=still, poses=np.repeat(motion.poses[:1], len(motion.poses), 0))

    def encoders(frame: SensorFrame) -> SensorFrame:
        return replace(frame, velocimeter=np.zeros(3) if frame.stamp > 0.5 else frame.velocimeter)

    errors = follow(rest, estimator_for(motion), frames(rest), encoders)
    assert all(each.trust is Trust.GOOD for each in errors.estimates)


def test_coarse_sensors_are_known_for_it_also_after_the_clock_has_started_again():
    """They repeat themselves at rest, all of them, and that is no reason not to drive."""
    watch = SensorWatch({"gyro": 0.02, "accelerometer": 0.1})

    def see(count: int, begin: float, moves: bool) -> None:
        for k in range(count):
            for name in ("gyro", "accelerometer"):
                watch.see(name, (1.0 + 0.5 * (k + 1) * moves, 0.0, 0.0), begin + 0.02 * k)

    see(10, 0.0, moves=False)
    see(20, 1.0, moves=True)
    watch.begin_again(0.0)
    see(20, 0.1, moves=True)
    see(20, 1.0, moves=False)
    assert not watch.frozen("gyro") and not watch.frozen("accelerometer")


def skill_sensors(motion: Motion, begin: float, quiet: bool = False) -> Callable[[SensorFrame], SensorFrame]:
    """A lidar's and a gripper's readings on the way, the lidar frozen from `begin` on, or `quiet`: nothing is near."""
    last: list[np.ndarray] = [np.full(10, 0.5)]
    corners = np.stack([np.cos(np.arange(10)), np.sin(np.arange(10))], axis=1)

    def damage(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < begin:
            place = motion.poses[np.searchsorted(motion.stamps, frame.stamp), :2]
            last[0] = np.exp(-np.linalg.norm(place - corners, axis=1))
        gripper = np.full(2, 0.3 if frame.stamp < 2.0 else frame.stamp)
        return replace(frame, lidar=last[0] * (not quiet), extra={"gripper": gripper})

    return damage


@pytest.mark.parametrize("robot", ["point", "car"])
def test_a_frozen_lidar_asks_to_hold_soon_after_the_robot_has_moved(robot, monkeypatch):
    monkeypatch.setattr(freshness, "TRAVEL", 0.05)  # these recordings are short, and of slow robots
    monkeypatch.setattr(freshness, "LEARN", 5)
    motion = recorded(robot)
    begin = np.searchsorted(motion.stamps, BEGIN)
    way = np.linalg.norm(motion.poses[begin:, :2] - motion.poses[begin, :2], axis=1)
    moved = motion.stamps[begin + np.flatnonzero(way > 0.1)[0]]
    errors = follow(motion, estimator_for(motion), frames(motion), skill_sensors(motion, BEGIN))
    held = next(each for each in errors.estimates if each.trust is not Trust.GOOD)
    assert BEGIN < held.stamp <= max(moved, BEGIN + 0.4) + 0.1
    assert held.why.startswith("lidar says nothing usable")
    assert errors.estimates[-1].trust is Trust.LOST


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("quiet", [True, False])
def test_a_lidar_that_reads_nothing_and_a_gripper_that_is_seldom_used_are_not_frozen(robot, quiet):
    motion = recorded(robot)
    errors = follow(motion, estimator_for(motion), frames(motion), skill_sensors(motion, 99.0, quiet))
    assert all(each.trust is Trust.GOOD for each in errors.estimates)


@pytest.mark.parametrize("grain", [0.01, 1.0 / 255.0])
@pytest.mark.parametrize("speed", [0.2, 0.5])
def test_a_coarse_lidar_that_leaves_all_obstacles_behind_is_not_frozen(grain, speed):
    watch, period = TermWatch(), 0.02
    for k in range(int(7.0 / speed / period)):
        x = speed * period * k
        closeness = np.exp(-np.hypot(x + 0.5, [0.3, -0.5, 2.0]))
        watch.see("lidar", grain * np.round(closeness / grain), k * period, (x, 0.0))
        assert list(watch.silences(k * period)) == [("lidar", 0.0, "")], f"after {x:.2f} m"


class Driven:
    """A lidar that is watched while its robot goes where it is told."""

    def __init__(self) -> None:
        self.watch, self.place, self.stamp = TermWatch({"lidar": 10}), 0.0, 0.0

    def reads(self, reading: float, way: float = 0.0, seconds: float = 0.1) -> tuple[float, str]:
        """For how long it has been silent, and why, after that way [m] in that time [s]."""
        self.place, self.stamp = self.place + way, self.stamp + seconds
        self.watch.see("lidar", np.full(10, reading), self.stamp, (self.place, 0.0))
        self.watch.see("battery", np.zeros(1), self.stamp, (self.place, 0.0))
        ((name, silent, flaw),) = self.watch.silences(self.stamp)
        assert name == "lidar"
        return silent, flaw

    def warmed_up(self) -> Driven:
        for k in range(20):
            assert self.reads(0.01 * k, 0.05) == (0.0, "")
        return self


def test_a_lidar_that_thaws_is_trusted_again_and_watched_further():
    lidar = Driven().warmed_up()
    for reading in (0.5, 0.6):
        assert lidar.reads(reading, 0.05) == (0.0, "")
        assert lidar.reads(reading, 0.15) == (0.0, "")
        assert lidar.reads(reading, 0.15) == (pytest.approx(0.1), "repeats itself")
        assert lidar.reads(reading) == (pytest.approx(0.2), "repeats itself"), "also while the robot waits"
        assert lidar.reads(reading + 0.01) == (0.0, "")
    lidar.watch.begin_again(0.0)
    assert list(lidar.watch.silences(0.3)) == [("lidar", 0.3, "")]


def test_the_time_at_rest_is_none_in_which_a_lidar_was_silent():
    lidar = Driven().warmed_up()
    assert lidar.reads(0.5) == lidar.reads(0.5, seconds=60.0) == (0.0, "")
    assert lidar.reads(0.5, 0.15) == (0.0, "")
    assert lidar.reads(0.5, 0.15) == (pytest.approx(0.1), "repeats itself")


def test_a_fault_of_a_frozen_lidar_that_was_acknowledged_is_judged_anew():
    lidar = Driven().warmed_up()
    assert lidar.reads(0.5) == (0.0, "") and lidar.reads(0.5, 0.3)[1] == "repeats itself"
    lidar.watch.renew(lidar.stamp, (lidar.place, 0.0))
    assert lidar.reads(0.5, seconds=9.0) == (0.0, "") == lidar.reads(0.5, 0.15)
    assert lidar.reads(0.5, 0.15)[1] == "repeats itself"


def test_changes_at_rest_do_not_make_a_sensor_one_that_changes_under_way():
    lidar = Driven()
    for k in range(50):
        assert lidar.reads(0.01 * k) == (0.0, "")
    for _ in range(10):
        assert lidar.reads(0.5, 0.1) == (0.0, "")


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_a_robot_that_is_not_driven_has_no_frozen_lidar_however_it_is_moved(robot):
    motion = recorded(robot)
    estimator = estimator_for(motion)

    def carried(frame: SensorFrame) -> SensorFrame:
        estimator.driven = frame.stamp < BEGIN
        return damage(frame)

    damage = skill_sensors(motion, BEGIN)
    errors = follow(motion, estimator, frames(motion), carried)
    assert all(each.trust is Trust.GOOD for each in errors.estimates)
