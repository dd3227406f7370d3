"""A planner that hangs: the old plan for a while, then slowly, then not at all; three restarts, then a fault."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from puck import GOAL, Listener, Puck, driver_of, pilot_for
from shipped import open_shipped

from hiernav.nav.occupancy import OccupancyMap, VisitMap, empty_map
from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import StraightPlanner
from hiernav.nav.search import grid_cells
from hiernav.runtime.process_planner import SECONDS_PER_CELL, ProcessPlanner
from hiernav.runtime.supervisor import Mode

FAR = np.array([1.9, 0.0])
FREE = empty_map((2.0, 2.0))
QUERY = PlanQuery(np.zeros((1, 2)), GOAL[None], [FREE], [VisitMap(FREE)], np.full((1, 10, 2), np.nan))


def hanging_from(seconds: float, until: float = math.inf) -> tuple[Listener, object, Puck]:
    robot, seen = Puck(noise=1e-3, control_period=0.02), Listener()
    pilot = pilot_for(StraightPlanner(), 0.02, period=0.02)
    driver = driver_of(robot, pilot, observers=[seen])
    inner = driver._step

    def step(now: float) -> None:
        pilot.link.delay = math.inf if seconds <= now < until else 0.02
        inner(now)

    driver._step = step
    return seen, driver.run(FAR, max_steps=2000), robot


def test_the_old_plan_is_followed_then_slowly_and_then_the_robot_holds():
    seen, result, _ = hanging_from(0.5)
    ended = next(r for r in seen.records if r.time >= 0.5 and r.reason.name != "NONE").time
    speed = {record.time - ended: record.speed_scale for record in seen.records if record.mode is Mode.RUNNING}
    assert all(scale == 1.0 for after, scale in speed.items() if after < 0.29)
    assert all(scale == 0.5 for after, scale in speed.items() if 0.33 < after < 0.99)
    assert max(speed) == pytest.approx(1.0, abs=0.05)
    held = [record for record in seen.records if record.mode is Mode.HOLD and record.time > ended]
    assert held and all(record.sent is None for record in held)
    assert result.reason == "fault" and "held for 10 s: no new plan" in result.fault


def test_a_planner_that_wakes_up_is_driven_by_again():
    _, result, _ = hanging_from(0.5, until=3.0)
    assert result.reached and "no new plan" in " ".join(result.holds)


def test_an_answer_that_comes_too_late_is_not_followed():
    pilot = pilot_for(StraightPlanner(), 1.5, period=0.02)
    result = driver_of(Puck(noise=1e-3, control_period=0.02), pilot).run(GOAL, max_steps=100)
    assert result.fault == "armed for 10 s: no plan yet" or "no new plan" in result.fault
    assert result.steps == 0 and result.planner["late"] == pilot.late > 0


@pytest.fixture
def planner() -> Iterator[ProcessPlanner]:
    made = ProcessPlanner(open_shipped("point"), 0.1, 6400, hang_after=1.0)
    yield made
    made.close()


def query_on(occupancy: OccupancyMap) -> PlanQuery:
    return PlanQuery(np.zeros((1, 2)), GOAL[None], [occupancy], [VisitMap(occupancy)], np.full((1, 10, 2), np.nan))


def ask_once(planner: ProcessPlanner, occupancy: OccupancyMap) -> None:
    planner.plan(query_on(occupancy))


def ask(planner: ProcessPlanner, patience: float = 60.0, query: PlanQuery = QUERY) -> object:
    """Ask until there is an answer, as the loop does."""
    end = time.monotonic() + patience
    while time.monotonic() < end and planner.failed is None:
        planner.plan(query)
        time.sleep(0.01)
        answer = planner.answer(time.monotonic())
        if answer is not None:
            return answer
    return None


def test_a_hanging_process_is_replaced_three_times_and_then_given_up(planner):
    assert ask(planner) is not None
    for restart in (1, 2, 3):
        os.kill(planner.status.pid, signal.SIGSTOP)
        assert ask(planner) is not None
        assert planner.restart_count() == restart
    os.kill(planner.status.pid, signal.SIGSTOP)
    assert ask(planner) is None
    assert "failed again after 3 restarts" in planner.failed
    planner.renew()
    end = time.monotonic() + 30.0
    while planner.failed is not None and time.monotonic() < end:
        time.sleep(0.01)
    assert ask(planner) is not None and planner.restart_count() == 1


def until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def kill_until_it_fails(planner: ProcessPlanner, restarts: range) -> None:
    for count in restarts:
        until(lambda count=count: planner.ready and planner.restart_count() == count)
        os.kill(planner.status.pid, signal.SIGKILL)
    until(lambda: planner.failed is not None)


def test_a_failure_that_was_acknowledged_is_not_told_of_again_before_its_keeper_has_looked(planner):
    """A goal that is set in the same breath is driven to; the keeper, here, takes its time."""
    kill_until_it_fails(planner, range(4))
    keeper = planner._child.process.pid
    os.kill(keeper, signal.SIGSTOP)
    try:
        planner.renew()
        assert planner.failed is None
    finally:
        os.kill(keeper, signal.SIGCONT)
    assert ask(planner) is not None and planner.restart_count() == 1
    kill_until_it_fails(planner, range(1, 4))


def test_a_planner_is_given_the_longer_the_larger_the_map_is():
    made = ProcessPlanner(open_shipped("point"), 0.1, 1_000_000, hang_after=0.5)
    try:
        assert made.patience == 0.5
        for half_size, searching in ((2.0, 1600), (25.0, 250_000), (2.0, 250_000)):
            ask_once(made, empty_map((half_size, half_size)))
            assert made.patience == pytest.approx(0.5 + SECONDS_PER_CELL * searching)
        assert grid_cells(empty_map((40.0, 40.0), 0.2)) == 640_000, "whatever its pixels"
        assert SECONDS_PER_CELL * 640_000 > 3.0
    finally:
        made.close()


def test_the_first_plan_on_a_large_map_comes_although_the_search_takes_longer_than_a_planner_hangs():
    large = empty_map((10.0, 10.0))
    made = ProcessPlanner(open_shipped("point"), 0.1, large.occupied.size, hang_after=0.005, seconds_per_cell=1e-3)
    try:
        assert ask(made, query=query_on(large)) is not None
        assert made.restart_count() == 0
    finally:
        made.close()
