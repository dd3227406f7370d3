"""A live page that stalls, dies or floods the loop with requests: nobody waits for it, and nothing piles up."""

from __future__ import annotations

import time
from contextlib import closing

import numpy as np
import pytest
from page_stub import link_to
from puck import GOAL, Listener, Puck, Scripted, driver_of

from hiernav.runtime.observe import TickRecord
from hiernav.runtime.requests import LIMIT
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode

PERIOD = 0.02


def test_a_page_that_hangs_misses_ticks_and_costs_the_loop_none():
    """A robot that creeps, so that more is shown than the socket holds."""
    driver = driver_of(Puck(control_period=PERIOD, noise=1e-3), Scripted(lambda step, straight: 0.01 * straight))
    seen, seconds = Listener(), []
    with closing(link_to("time.sleep(1000)", driver)) as page:
        shows = page.tick

        def show(record: TickRecord) -> None:
            began = time.perf_counter()
            shows(record)
            seconds.append(time.perf_counter() - began)

        page.tick = show
        driver.audience.observers = [page, seen]
        result = driver.run(GOAL, max_steps=2000)
        page._process.kill()
    assert (result.reason, result.steps, result.holds) == ("timeout", 2000, {})
    assert page.shown > 20 and page.dropped > 500
    assert len(seen.records) == len(seconds) == 2001
    assert np.median(seconds) < 0.1 * PERIOD


def test_a_page_that_dies_is_done_without():
    driver = driver_of(Puck(control_period=PERIOD))
    with closing(link_to("raise SystemExit", driver)) as page:
        page._process.wait()
        driver.audience.observers = [page]
        assert driver.run(GOAL).reached
        assert page._socket is None


def test_an_emergency_stop_is_obeyed_in_the_next_tick_whatever_the_page_said_before_it(tmp_path):
    driver, said = driver_of(Puck(control_period=PERIOD)), tmp_path / "said"
    program = f"""
for _ in range(150): say(kind="goal", x=1.9)
say(kind="estop")
open({str(said)!r}, "w").close()
time.sleep(1000)
"""
    inner, modes = driver._step, []

    def step(now: float) -> None:
        inner(now)
        modes.append(driver.supervisor.mode)
        if len(modes) == 2:
            driver.quit()

    driver._step = step
    with closing(link_to(program, driver)) as page:
        deadline = time.monotonic() + 30.0
        while not said.exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        driver.audience.observers = [page]
        driver.serve()
        page._process.kill()
    assert modes == [Mode.ESTOP, Mode.ESTOP] and driver.supervisor.fault == "stopped on the live page"


def test_a_page_is_listened_to_where_the_robot_cannot_be_read():
    """It acknowledges the fault, which comes again, and then stops what cannot be read."""
    driver, seen = driver_of(Puck(control_period=PERIOD)), Listener()
    program = """
def wait_for(text):
    while text not in link.recv(1000000): pass
wait_for(b"bus error")
say(kind="acknowledge")
wait_for(b"acknowledged")
say(kind="estop")
time.sleep(1000)
"""

    def unreadable() -> SensorFrame:
        time.sleep(1e-3)
        if driver.supervisor.mode is Mode.ESTOP or time.monotonic() > deadline:
            driver.quit()
        raise OSError("bus error")

    driver.robot.read = unreadable
    deadline = time.monotonic() + 60.0
    with closing(link_to(program, driver)) as page:
        driver.audience.observers = [page, seen]
        driver.serve()
        page._process.kill()
    modes = [event.values["mode"] for event in seen.events if event.kind == "mode"]
    assert modes == ["fault", "init", "fault", "estop"]
    assert driver.robot.log[-1] == "brake" and not seen.records


@pytest.mark.parametrize("floods", ["ask(goal)", "send(goal)"])
def test_an_emergency_stop_gets_through_a_page_that_floods(floods):
    """With what the page uses to ask, or with all that the socket takes, from several threads."""
    driver = driver_of(Puck(control_period=PERIOD))
    program = f"""
import threading
from hiernav.view.commands import Asker, Command
ask, goal = Asker(link), Command("goal", 1.9)
def send(command): link.send(b'{{"kind":"goal","x":1.9}}')
def flood():
    while True: {floods}
for _ in range(4): threading.Thread(target=flood).start()
time.sleep(0.5)
ask(Command("estop"))
"""
    inner, deadline = driver._step, time.monotonic() + 60.0

    def step(now: float) -> None:
        inner(now)
        time.sleep(1e-3)
        if driver.supervisor.mode is Mode.ESTOP or time.monotonic() > deadline:
            driver.quit()

    driver._step = step
    with closing(link_to(program, driver)) as page:
        driver.audience.observers = [page]
        driver.serve()
        page._process.kill()
    assert driver.supervisor.mode is Mode.ESTOP and driver.supervisor.fault == "stopped on the live page"
    assert driver.robot.log[-1] == "brake"
    assert page.refused > 100


def test_a_flood_of_goals_leaves_the_newest_and_an_emergency_stop_gets_through():
    robot = Puck(control_period=PERIOD)
    driver = driver_of(robot)
    inner, waiting = driver._step, []
    ticks = iter(range(10**9))

    def step(now: float) -> None:
        tick = next(ticks)
        if tick < 50:
            for k in range(1000):
                driver.set_goal(np.array([0.9, 0.001 * k]))
        waiting.append(len(driver._requests))
        if tick == 50:
            driver.estop("pressed")
            for _ in range(1000):
                driver.set_goal(GOAL)
        inner(now)
        if tick == 60:
            driver.quit()

    driver._step = step
    driver.serve()
    assert max(waiting) <= LIMIT
    assert driver.supervisor.mode is Mode.ESTOP and driver.supervisor.fault == "pressed"
    assert robot.log[-1] == "brake" and driver.last_result.reason in ("estop", "changed")
