"""A viewer that stalls or floods the loop with requests: not one tick is late for it, and nothing piles up."""

from __future__ import annotations

import threading

import numpy as np
from puck import GOAL, Listener, Puck, driver_of

from hiernav.runtime.driver import REQUESTS
from hiernav.runtime.observe import Background, Observer, TickRecord
from hiernav.runtime.supervisor import Mode

PERIOD = 0.02


class Stalled(Observer):
    def __init__(self) -> None:
        self.released = threading.Event()
        self.seen = 0

    def tick(self, record: TickRecord) -> None:
        self.seen += 1
        self.released.wait()


def test_a_viewer_that_hangs_in_the_background_costs_no_tick_and_no_memory():
    stalled, seen = Stalled(), Listener()
    background = Background(stalled, capacity=20)
    driver = driver_of(Puck(control_period=PERIOD), observers=[background, seen])
    result = driver.run(GOAL)
    assert result.reached and driver.loop.overruns == 0
    assert len(seen.records) == result.steps + 1
    assert stalled.seen == 1 and background.dropped >= result.steps - 20
    assert len(background._waiting) == 20
    stalled.released.set()


def test_a_viewer_that_fails_in_the_background_is_dropped():
    class Failing(Observer):
        def tick(self, record: TickRecord) -> None:
            raise BrokenPipeError("browser gone")

    assert driver_of(Puck(control_period=PERIOD), observers=[Background(Failing())]).run(GOAL).reached


def test_background_observers_see_everything_they_can_keep_up_with():
    seen = Listener()
    result = driver_of(Puck(control_period=PERIOD), observers=[Background(seen, capacity=4096)]).run(GOAL)
    assert len(seen.records) == result.steps + 1 and seen.flushed == [result.steps + 1]


def test_a_flood_of_goals_leaves_the_newest_and_an_emergency_stop_gets_through():
    robot = Puck(control_period=PERIOD)
    driver = driver_of(robot)
    inner = driver._step
    ticks = iter(range(10**9))

    def step(now: float) -> None:
        tick = next(ticks)
        if tick < 50:
            for k in range(1000):
                driver.set_goal(np.array([0.9, 0.001 * k]))
        assert len(driver._requests) <= REQUESTS
        if tick == 50:
            driver.estop("pressed")
            for _ in range(1000):
                driver.set_goal(GOAL)
        inner(now)
        if tick == 60:
            driver.quit()

    driver._step = step
    driver.serve()
    assert driver.supervisor.mode is Mode.ESTOP and driver.supervisor.fault == "pressed"
    assert robot.log[-1] == "brake" and driver.last_result.reason in ("estop", "changed")
