"""A planner that is killed: the loop does not notice but for its plans."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest
from puck import LAYOUT, Listener, Puck, follow
from punctual import punctual
from shipped import open_shipped
from test_09_planner_hangs import ask

from hiernav.nav.occupancy import empty_map
from hiernav.nav.option import HierarchicalAgent, WaypointOption
from hiernav.runtime.clock import MonotonicClock
from hiernav.runtime.driver import Driver
from hiernav.runtime.estimator import Estimator, EstimatorConfig
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.process_planner import ProcessPlanner

PERIOD = 0.02


def test_a_killed_planner_is_replaced_and_answers_what_was_asked():
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400)
    try:
        first = ask(planner)
        os.kill(planner.status.pid, signal.SIGKILL)
        np.testing.assert_allclose(ask(planner).plan, first.plan, atol=0.05)
        assert planner.restart_count() == 1 and planner.failed is None
        assert planner.counts()["proposals"] >= 2, "counted across the restart"
    finally:
        planner.close()


def test_a_keeper_that_is_killed_is_a_fault_and_takes_its_planner_along():
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400)
    try:
        ask(planner)
        child = planner.status.pid
        planner._child.process.kill()
        planner._child.process.wait()
        assert "keeper ended" in planner.failed
    finally:
        planner.close()
    end = time.monotonic() + 30.0
    while _alive(child) and time.monotonic() < end:
        time.sleep(0.01)
    assert not _alive(child)


@pytest.mark.realtime
def test_the_loop_misses_no_extra_tick():
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400)
    field = empty_map((2.0, 2.0))
    pilot = Pilot(HierarchicalAgent(WaypointOption(planner, 1), follow, LAYOUT, PERIOD), planner)
    seen = Listener()
    robot = Puck(noise=1e-3, control_period=PERIOD)
    estimator = Estimator(EstimatorConfig(tilts=False))
    driver = Driver(robot, pilot, lambda stamp: field, MonotonicClock(), estimator, observers=[seen])
    inner, killed = driver._step, []

    def step(now: float) -> None:
        if len(seen.records) in (50, 120):
            killed.append(planner.status.pid)
            os.kill(killed[-1], signal.SIGKILL)
        inner(now)

    driver._step = step
    try:
        ask(planner)
        with punctual():
            result = driver.run(np.array([1.9, 1.9]), max_steps=400)
    finally:
        planner.close()
    assert result.reached and len(set(killed)) == 2 and planner.restart_count() == 2
    assert driver.loop.overruns == 0


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
