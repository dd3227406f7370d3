"""What the skill is shown of sensors that miss a frame or say nonsense."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from puck import GOAL, PERIOD, Listener, Puck, Scripted, driver_of

from hiernav.runtime.robot import SensorFrame


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
