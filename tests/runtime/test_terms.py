"""What the skill is shown of sensors that miss a frame or say nonsense."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from puck import GOAL, PERIOD, Listener, Puck, Scripted, driver_of
from recorded_drive import BUNDLE, Memory, drive

from hiernav.nav.bundle import load_bundle
from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard
from hiernav.runtime.policy import make_agent
from hiernav.runtime.rehearsal import Rehearsal
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout


class GivesAGoal(Listener):
    """Gives a goal after the tick `at`, and ends the service 10 ticks later."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at = at

    def tick(self, record):
        super().tick(record)
        if record.index == self.at:
            self.driver.set_goal(GOAL)
        if record.index == self.at + 10:
            self.driver.quit()


def test_what_is_held_is_the_last_good_reading_also_of_ticks_in_which_nothing_was_decided():
    """The frame in which a goal is taken on lacks the lidar; the one before it had it."""

    def sees(frame: SensorFrame) -> SensorFrame:
        count = round(frame.stamp / PERIOD)
        return replace(frame, lidar=None if count == 6 else np.full(10, 0.01 * count))

    seen, pilot = GivesAGoal(5), Scripted()
    seen.driver = driver_of(Puck(sees=sees), pilot, observers=[seen])
    seen.driver.serve()
    np.testing.assert_allclose(pilot.seen[0]["lidar"], np.full((1, 10), 0.05))


@pytest.mark.parametrize("sensor", ["gyro", "lidar"])
def test_a_robot_whose_sensor_speaks_a_moment_later_than_the_others_waits_for_it(sensor):
    seen = Memory()
    result = drive(seen, damage=lambda frame: frame if frame.stamp > 0.11 else replace(frame, **{sensor: None}))
    assert result.fault is None and result.reached
    before = [record.mode for record in seen.records if record.frame.stamp <= 0.11]
    assert before[-1] is Mode.ARMED and Mode.RUNNING not in before


def test_a_robot_without_a_sensor_that_the_skill_observes_never_moves_and_is_told_which():
    seen = Memory()
    result = drive(seen, damage=lambda frame: replace(frame, lidar=None))
    assert result.reason == "fault" and result.fault == "armed for 10 s: nothing from lidar yet"
    assert all(record.sent is None for record in seen.records)


def test_a_rehearsal_puts_up_with_sensors_that_miss_frames():
    spec, layout = get_robot("point"), sample_layout(parse_world("pillar(2,2,0)"), 0, 0.1)
    agent = make_agent(load_bundle(BUNDLE), spec.radius)
    rehearsal = Rehearsal(agent, EstimatorConfig(tilts=False), Guard(2), spec.radius)
    still, estimator = np.zeros(3), Estimator(EstimatorConfig(tilts=False))
    field = np.array([0.0, -0.5, 0.0])
    frame = SensorFrame(0.0, still, still, field, still, np.zeros(10), position_fix=np.zeros(2))
    estimate, occupancy = estimator.update(frame), layout.occupancy(0.0)
    for each in (replace(frame, lidar=None), frame, replace(frame, lidar=None)):
        rehearsal(each, estimate, layout.goal, occupancy, anew=False)


@pytest.mark.parametrize(("sensor", "size"), [("gyro", 4), ("lidar", 9)])
@pytest.mark.parametrize("ticks", [1, 99])
def test_a_reading_of_another_size_is_none_and_only_many_of_them_are_a_fault(sensor, size, ticks):
    seen = Memory()

    def damage(frame: SensorFrame) -> SensorFrame:
        wrong = 0.5 <= frame.stamp < 0.5 + 0.02 * ticks - 0.01
        return replace(frame, **{sensor: np.full(size, 0.5)}) if wrong else frame

    result = drive(seen, damage=damage)
    if ticks == 1:
        assert result.reached and result.fault is None and not result.holds
    else:
        assert f"{sensor} says nothing usable" in result.fault
        assert f"({size} values instead of {10 if sensor == 'lidar' else 3})" in result.fault
