"""A robot that is held fast: three recoveries, bounded in time and distance, then a fault."""

from __future__ import annotations

import numpy as np
from puck import Listener, Puck, Scripted, driver_of, pilot_for

from hiernav.nav import recovery as recovery_module
from hiernav.nav.occupancy import empty_map
from hiernav.nav.planners import StraightPlanner
from hiernav.nav.recovery import Recovery
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.supervisor import Mode

PERIOD, GOAL = 0.02, np.array([1.5, 0.0])


def drive(robot: Puck) -> tuple[Listener, object]:
    seen = Listener()
    return seen, driver_of(robot, pilot_for(StraightPlanner(), period=PERIOD), observers=[seen]).run(GOAL, 5000)


def test_a_pinned_robot_is_a_fault_after_three_bounded_recoveries():
    seen, result = drive(Puck(control_period=PERIOD, noise=1e-3, pinned=True))
    assert result.reason == "fault" and "stuck: recoveries in this place did not help" in result.fault
    assert result.recoveries == 3
    out = [record for record in seen.records if record.mode is Mode.RECOVERING]
    assert len(out) == 3 * round(3.0 / PERIOD)
    ways = [(record.plan[-1] - record.estimate.pose[:2]).round(1) for record in out[:: round(0.5 / PERIOD)]]
    assert len(ways) == 18, "six ways each, half a second each"
    assert len({tuple(np.sign(way)) for way in ways}) == 8, "in all directions"


def test_each_recovery_is_followed_by_a_new_plan():
    seen, _ = drive(Puck(control_period=PERIOD, noise=1e-3, pinned=True))
    modes = [record.mode for record in seen.records]
    ends = [k for k in range(1, len(modes)) if modes[k - 1] is Mode.RECOVERING and modes[k] is Mode.RUNNING]
    assert len(ends) == 3
    assert all(any(seen.records[k + j].replanned for j in (0, 1, 2)) for k in ends)


def test_a_robot_that_gets_free_goes_on():
    robot = Puck(control_period=PERIOD, noise=1e-3, pinned=True)
    sends = robot._move

    def move(velocity: np.ndarray) -> None:
        robot.pinned = robot.pinned and robot.stamp < 2.0
        sends(velocity)

    robot._move = move
    _, result = drive(robot)
    assert result.reached and 1 <= result.recoveries <= 3


def test_a_way_out_ends_after_half_a_metre_however_fast(monkeypatch):
    monkeypatch.setattr(recovery_module, "TRY_S", 10.0)
    monkeypatch.setattr(recovery_module, "LIMIT", 1)
    recovery, plan = Recovery(1, 0.1), np.full((1, 10, 2), 0.9)
    pose, moved, occupancy = np.zeros((1, 3)), [], empty_map((2.0, 2.0))
    for _ in range(30):
        if recovery(pose, plan, [occupancy]) is not plan:
            pose = pose + [[0.12, 0.0, 0.0]]
        moved.append(pose[0, 0])
    assert 0.5 <= max(moved) <= 0.75


def test_waiting_is_not_being_stuck():
    robot = Puck(control_period=PERIOD, noise=1e-3)
    driver = driver_of(robot, pilot_for(StraightPlanner(), period=PERIOD))
    inner = driver._step

    def step(now: float) -> None:
        if round(now / PERIOD) == 40:
            driver.pause()
        if round(now / PERIOD) == 40 + round(5.0 / PERIOD):
            driver.resume()
        inner(now)

    driver._step = step
    result = driver.run(GOAL)
    assert result.reached and result.recoveries == 0 and result.holds == {"paused": 1}


def test_recoveries_are_limited_wherever_they_are():
    """One that goes to and fro between two traps never has its third in one place."""
    pilot = Scripted(lambda step, straight: 0.0 * straight, changes=lambda step: {"recovering": step % 4 > 1})
    result = driver_of(Puck(noise=1e-3), pilot, config=DriverConfig(max_recoveries=5)).run(GOAL)
    assert result.reason == "fault" and "stuck: 5 recoveries on the way to this goal" in result.fault
    assert result.recoveries == 5
