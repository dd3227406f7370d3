"""A planner that is killed: the loop does not notice but for its plans."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from puck import LAYOUT, Listener, Puck, follow
from punctual import punctual
from shipped import open_shipped
from test_09_planner_hangs import QUERY, ask

from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.occupancy import empty_map
from hiernav.nav.option import WaypointOption
from hiernav.runtime import planner_process
from hiernav.runtime.clock import MonotonicClock
from hiernav.runtime.driver import Driver
from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.mailbox import mapped, shared_memory
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.planner_memory import PlannerMemory
from hiernav.runtime.process_planner import ProcessPlanner

PERIOD = 0.02
PROGRAM = textwrap.dedent(
    """
    import sys, time
    sys.path[:0] = [{tests!r}, {faults!r}]
    from shipped import open_shipped
    from test_09_planner_hangs import ask
    from hiernav.runtime.process_planner import ProcessPlanner
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400)
    ask(planner)
    print(planner._child.process.pid, planner.status.pid, flush=True)
    sys.stdin.readline()
    ask(planner)
    print(f"answered, restarts {{planner.restart_count()}}, failed {{planner.failed}}", flush=True)
    time.sleep(60.0)
    """
)


def test_a_killed_planner_is_replaced_and_answers_what_was_asked():
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400)
    try:
        first = ask(planner)
        os.kill(planner.status.pid, signal.SIGKILL)
        np.testing.assert_allclose(ask(planner).plan, first.plan, atol=0.05)
        assert planner.restart_count() == 1 and planner.failed is None
    finally:
        planner.close()


def test_plans_are_counted_over_all_starts_of_the_planner():
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400, hang_after=60.0)
    try:
        for start in (1, 2, 3):
            await_that(lambda start=start: planner.ready and planner.status.starts == start)
            planner.plan(QUERY)
            await_that(lambda: planner.answer(time.monotonic()) is not None)
            assert planner.counts()["proposals"] == start
            os.kill(planner.status.pid, signal.SIGKILL)
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
    wait_for_the_end_of(child)


def test_a_keeper_that_was_killed_is_replaced_once_somebody_acknowledges():
    planner = ProcessPlanner(open_shipped("point"), 0.1, 6400)
    try:
        first, stopped = ask(planner), planner.status.pid
        planner._memory.set_status("restarts", 3)
        planner._memory.set_status("exhausted", 1)  # as after the third restart
        os.kill(stopped, signal.SIGSTOP)  # it cannot see that its keeper is gone
        planner._child.process.kill()
        planner._child.process.wait()
        planner.renew()
        assert planner.failed is None
        np.testing.assert_allclose(ask(planner).plan, first.plan, atol=0.05)
        assert planner.restart_count() == 0 and planner.status.starts == 2
        wait_for_the_end_of(stopped)
        os.kill(planner.status.pid, signal.SIGSTOP)
        os.kill(planner._child.process.pid, signal.SIGSTOP)
        last = planner._child.process.pid, planner.status.pid
    finally:
        planner.close()
    wait_for_the_end_of(*last)


def test_a_planner_is_started_again_where_the_system_had_no_room_for_it(monkeypatch):
    news, wake = os.pipe()
    settings, model = b"{}", b""
    memory = PlannerMemory.create(
        mapped(shared_memory(PlannerMemory.size(64, 10, settings, model))), 64, 10, settings, model
    )
    started: list[subprocess.Popen[bytes]] = []

    def fork() -> int:
        if memory.status.starts < 2:
            raise BlockingIOError("no room")
        started.append(subprocess.Popen(["sleep", "60"]))
        os.close(wake)  # and that is the end
        return started[-1].pid

    monkeypatch.setattr(planner_process.os, "fork", fork)
    planner_process.keep(news, -1, memory)
    assert memory.status.starts == 2 and memory.status.restarts == 1 and not memory.status.exhausted
    assert not _alive(started[0].pid)
    started[0].wait()
    os.close(news)


def test_signals_are_left_to_the_control_process_and_without_it_keeper_and_planner_end():
    program = PROGRAM.format(tests=str(Path(__file__).parents[1]), faults=str(Path(__file__).parent))
    control = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert control.stdin is not None and control.stdout is not None
    processes = [int(pid) for pid in control.stdout.readline().split()]
    for pid in processes:
        for number in (signal.SIGTERM, signal.SIGINT):
            os.kill(pid, number)
    control.stdin.write("go on\n")
    control.stdin.flush()
    assert control.stdout.readline() == "answered, restarts 0, failed None\n"
    control.kill()
    control.communicate()
    wait_for_the_end_of(*processes)


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


def wait_for_the_end_of(*processes: int) -> None:
    await_that(lambda: not any(map(_alive, processes)))


def await_that(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not (there := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    assert there


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
