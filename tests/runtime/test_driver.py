from __future__ import annotations

import io
import json
import math
import signal
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from puck import GOAL, PERIOD, Listener, Puck, Scripted, driver_of
from rich.console import Console

from hiernav.nav.occupancy import OccupancyMap, draw_discs, empty_map
from hiernav.runtime.account import Account, Episode
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.driver import Driver
from hiernav.runtime.driver_config import DriverConfig
from hiernav.runtime.estimate import Estimate, EstimatorConfig, StateEstimator
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.runtime.robot import RobotGone, SensorFrame
from hiernav.runtime.sim_robot import SimRobot
from hiernav.runtime.summary import print_summary, summarise
from hiernav.runtime.supervisor import InvalidTransition, Mode
from hiernav.runtime.terms import TermHold
from hiernav.runtime.trip import RunResult
from hiernav.runtime.watchdogs import StopWatch
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout


def test_a_goal_in_the_open_is_reached_and_the_robot_stands_there():
    robot = Puck()
    driver = driver_of(robot)
    result = driver.run(GOAL)
    assert result.reached and result.reason == "goal" and result.stopped
    assert result.distance <= 0.3
    assert np.linalg.norm(robot.position - GOAL) < 0.35
    assert result.steps == 14
    assert result.seconds == pytest.approx(1.4)
    assert result.replans == {"start": 1, "half_index": 2}
    assert driver.supervisor.mode is Mode.INIT


def test_policies_of_another_rate_and_a_guard_of_another_robot_are_refused():
    with pytest.raises(ValueError, match=r"the policies act every 0.1 s, the robot every 0.02 s"):
        driver_of(Puck(control_period=0.02), Scripted(control_period=0.1))
    with pytest.raises(ValueError, match=r"the guard is for 3 actuators, the robot has 2"):
        driver_of(Puck(), guard=Guard(3))


def test_every_tick_reads_before_it_sends_and_the_run_ends_with_the_brake():
    robot = Puck()
    driver_of(robot).run(GOAL)
    drive = robot.log[: robot.log.index("brake")]
    assert drive == ["read", "send"] * 14 + ["read"]
    assert robot.log[-1] == "brake"
    assert "send" not in robot.log[len(drive) :]


def test_a_run_that_takes_too_long_ends_by_timeout():
    result = driver_of(pilot=Scripted(lambda step, straight: np.zeros(2))).run(GOAL, max_steps=7)
    assert (result.reason, result.steps, result.reached) == ("timeout", 7, False)


def test_leaving_the_field_ends_the_run():
    robot = Puck()
    result = driver_of(robot, Scripted(lambda step, straight: np.array([-1.0, 0.0]))).run(GOAL)
    assert result.reason == "left_field"
    assert robot.position[0] == pytest.approx(-2.0, abs=0.35)


def test_an_exception_in_the_agent_is_a_fault_that_brakes_and_latches():
    def script(step: int, straight: np.ndarray) -> np.ndarray:
        if step == 3:
            raise RuntimeError("network exploded")
        return straight

    robot = Puck()
    driver = driver_of(robot, Scripted(script))
    result = driver.run(GOAL)
    assert (result.reason, result.fault) == ("fault", "RuntimeError: network exploded")
    assert result.stopped and robot.log[-1] == "brake"
    with pytest.raises(InvalidTransition):
        driver.run(GOAL)
    driver.supervisor.acknowledge(0.0)
    robot.position = np.zeros(2)
    assert driver.run(GOAL).reason == "fault"


def test_three_actions_that_are_not_finite_end_in_a_fault_and_none_is_sent():
    robot = Puck()
    result = driver_of(robot, Scripted(lambda step, straight: straight * (math.nan if step >= 5 else 1.0))).run(GOAL)
    assert result.reason == "fault" and "not finite 3 times in a row" in result.fault
    assert result.guard == {"non_finite": 3}
    assert result.steps == 5  # the others are braked, not sent
    assert np.isfinite(robot.position).all()


def test_a_single_bad_action_only_brakes_its_tick():
    result = driver_of(pilot=Scripted(lambda step, straight: straight * (math.nan if step == 5 else 1.0))).run(GOAL)
    assert result.reached
    assert result.steps == 14 and result.seconds == pytest.approx(1.5)


def test_a_keyboard_interrupt_stops_the_robot():
    def script(step: int, straight: np.ndarray) -> np.ndarray:
        if step == 4:
            raise KeyboardInterrupt
        return straight

    robot = Puck()
    driver = driver_of(robot, Scripted(script))
    result = driver.run(GOAL)
    assert (result.reason, result.stopped) == ("interrupted", True)
    assert robot.log[-1] == "brake"
    assert driver.supervisor.mode is Mode.INIT


@pytest.mark.parametrize("first", [True, False])
def test_signals_while_the_robot_rolls_out_do_not_cut_its_stop_short(first):
    """Both where a signal had ended the drive, and where it comes at the goal."""

    class Rolling(Puck):
        def brake(self) -> None:
            self.log.append("brake")
            signal.raise_signal(signal.SIGINT if len(self.log) % 2 else signal.SIGTERM)
            self._move(0.8 * self.velocity)

    def script(step: int, straight: np.ndarray) -> np.ndarray:
        if first and step == 8:
            signal.raise_signal(signal.SIGINT)
        return straight

    robot = Rolling(noise=1e-3)
    driver = driver_of(robot, Scripted(script))
    result = driver.run(GOAL)
    assert (result.reason, result.stopped, result.fault) == ("interrupted" if first else "goal", True, None)
    assert driver.interrupted and driver.supervisor.mode is Mode.INIT
    assert np.linalg.norm(robot.velocity) < 0.1


def test_a_robot_that_does_not_stop_is_a_fault():
    robot = Puck(stops=False)
    driver = driver_of(robot, config=DriverConfig(stop_timeout=1.0))
    result = driver.run(GOAL)
    assert result.reached and not result.stopped
    assert result.fault == "the robot does not stop within 1 s"
    assert driver.supervisor.mode is Mode.FAULT
    assert robot.log[-1] == "brake"


@pytest.mark.parametrize("stops", [True, False])
def test_a_robot_is_told_that_it_stands_where_that_was_seen(stops):
    class Told(Puck):
        def stands(self) -> None:
            self.log.append("stands")

    robot = Told(stops=stops, noise=1e-3)
    assert driver_of(robot).run(GOAL).stopped == stops
    assert robot.log.count("stands") == stops and (robot.log[-1] == "stands") == stops


def test_a_robot_that_does_not_stop_while_it_serves_is_a_fault_of_that_goal():
    results: list[RunResult | None] = []

    class Watcher(Observer):
        def tick(self, record: TickRecord) -> None:
            if record.index == 1:
                driver.set_goal(GOAL)
            elif driver.last_result is not None:
                results.append(driver.last_result)
                driver.quit()

    driver = driver_of(Puck(stops=False), config=DriverConfig(stop_timeout=0.5), observers=[Watcher()])
    driver.serve()
    assert results[0] is not None
    assert results[0].reason == "goal" and not results[0].stopped
    assert results[0].fault == "the robot does not stop within 0.5 s"


def test_a_robot_that_rolls_on_after_an_emergency_stop_is_told_and_not_driven_before_it_stands():
    """Also once that was acknowledged; a goal that is set meanwhile waits."""
    robot, seen = Puck(stops=False), {}

    class Operator(Observer):
        def tick(self, record: TickRecord) -> None:
            at = record.index
            seen[at] = (driver.supervisor.mode, driver.supervisor.fault, len(robot.sent))
            if at == 1:
                driver.set_goal(np.array([0.98, 0.9]))
            elif at == 6:
                driver.estop("pressed")
            elif at in (20, 40):
                driver.acknowledge()
                driver.set_goal(GOAL)
            elif at == 45:
                robot.velocity, robot.stops = np.zeros(2), True
            elif at == 60:
                driver.quit()

    driver = driver_of(robot, config=DriverConfig(stop_timeout=1.0), observers=[Operator()])
    driver.serve()
    assert seen[19][:2] == (Mode.ESTOP, "pressed; the robot does not stop within 1 s")
    assert seen[25][0] is Mode.ARMED
    assert seen[39][:2] == (Mode.FAULT, "the robot does not stop within 1 s")
    assert seen[8][2] == seen[45][2], "nothing is sent while it rolls"
    assert seen[59][2] > seen[45][2] and driver.supervisor.fault is None


@pytest.mark.parametrize("mode", [Mode.READY, Mode.FAULT, Mode.ESTOP])
def test_a_braked_robot_that_begins_to_move_again_is_a_fault(mode):
    robot, seen = Puck(), []

    class Operator(Observer):
        def tick(self, record: TickRecord) -> None:
            at = record.index
            seen.append((driver.supervisor.mode, driver.supervisor.fault))
            if at == 1:
                driver.set_goal(GOAL)
            elif at == 5:
                {Mode.READY: driver.cancel, Mode.ESTOP: driver.estop, Mode.FAULT: lambda: robot_fails()}[mode]()
            elif at == 15:
                robot.stops, robot.velocity = False, np.array([0.0, 0.3])
            elif at == 40:
                driver.quit()

    def robot_fails() -> None:
        def send(_: np.ndarray) -> np.ndarray:
            raise OSError("bus error")

        robot.send = send  # type: ignore[method-assign]

    driver = driver_of(robot, config=DriverConfig(stop_timeout=1.0), observers=[Operator()])
    driver.serve()
    assert seen[15][0] is mode and "does not stop" not in (seen[15][1] or "")
    assert seen[35][0] is (Mode.FAULT if mode is Mode.READY else mode)
    assert seen[35][1].endswith("the robot does not stop within 1 s")


def operated(driver_settings: dict[str, object], puck: dict[str, object], until: float, **at: object) -> list[str]:
    """Modes of a served Puck, one a tick, with a fault's text behind it; `at` maps `t<ticks>` to what is done then."""
    seen: list[str] = []

    class Operator(Observer):
        def make_requests(self) -> None:
            act = at.get(f"t{len(seen)}")
            if act is not None:
                act(driver)
            if len(seen) >= until / PERIOD:
                driver.quit()

        def tick(self, record: TickRecord) -> None:
            seen.append(f"{record.mode.value} {driver.supervisor.fault or ''}".strip())

    driver = driver_of(Puck(**puck), observers=[Operator()], **driver_settings)
    driver.serve()
    return seen


def test_an_emergency_stop_before_the_first_estimate_is_no_robot_that_does_not_stop():
    modes = operated(
        {}, {"sees": lambda frame: replace(frame, position_fix=None)}, 10.0, t10=Driver.estop, t60=Driver.acknowledge
    )
    assert modes[59] == "estop emergency stop" and modes[-1] == "init"


def test_goals_that_come_one_after_the_other_do_not_keep_a_robot_from_driving_that_was_acknowledged():
    def goal(driver: Driver) -> None:
        driver.set_goal(GOAL)

    modes = operated({}, {}, 4.0, t5=Driver.estop, t10=Driver.acknowledge, **{f"t{k}": goal for k in range(11, 30)})
    assert "running" in modes[11:25]


def test_an_estimator_of_ones_own_needs_what_its_protocol_says_and_no_more():
    """Through an emergency stop and its acknowledgement as well: no attribute is missed for the first time there."""
    asked = {name for name in (*StateEstimator.__annotations__, *vars(StateEstimator)) if not name.startswith("_")}
    inner, used = Estimator(EstimatorConfig(tilts=False, confirm=False)), set()

    class Own:
        def __getattr__(self, name: str) -> object:
            used.add(name)
            return getattr(inner, name)

        def __setattr__(self, name: str, value: object) -> None:
            used.add(name)
            setattr(inner, name, value)

    modes = operated(
        {"estimator": Own()},
        {},
        4.0,
        t2=lambda driver: driver.set_goal(GOAL),
        t8=Driver.estop,
        t15=Driver.acknowledge,
        t20=lambda driver: driver.set_goal(GOAL),
    )
    assert "running" in modes[2:8] and "running" in modes[20:]
    assert used == asked


def test_a_loop_that_begins_again_does_not_drive_a_robot_that_was_not_seen_to_stand():
    robot = Puck(stops=False)
    driver = driver_of(robot, config=DriverConfig(stop_timeout=0.5))
    assert not driver.run(GOAL).stopped
    driver.supervisor.acknowledge(driver.clock.now())
    sent = len(robot.sent)
    result = driver.run(-GOAL)
    assert result.fault == "the robot does not stop within 0.5 s" and len(robot.sent) == sent


def test_a_turning_rate_that_no_gyro_says_any_more_does_not_keep_a_robot_from_standing():
    watch, seen = StopWatch(0.1, 1.0, 3.0), []
    watch.begin(0.0)
    for k in range(20):
        estimate = Estimate(0.02 * k, np.zeros(3), np.zeros(2), np.eye(6), 1.0, 1.5)
        seen.append(watch.check(estimate, 0.02 * k, turn_measured=False))
    assert seen.count(True) == 1


def test_a_robot_that_stood_while_it_could_not_be_read_is_not_one_that_does_not_stop():
    robot, faults = Puck(), []

    class Operator(Observer):
        def make_requests(self) -> None:
            at = len(robot.log)
            if at == 21:  # a reading and a brake in every tick before
                driver.set_goal(GOAL)
            elif at > 400:
                driver.quit()

        def event(self, event: Event) -> None:
            if event.kind in ("fault", "stop") or event.values.get("mode") == "fault":
                faults.append(event.text)

    def sees(frame: SensorFrame) -> SensorFrame:
        if 50 < len(robot.log) < 200:
            raise OSError("bus error")
        return frame

    robot.sees = sees
    driver = driver_of(robot, config=DriverConfig(stop_timeout=1.0), observers=[Operator()])
    driver.serve()
    assert faults[-2:] == ["OSError: bus error", "the robot stands"] and driver.stopped


def test_a_robot_without_a_velocimeter_is_not_told_to_move_by_the_noise_of_its_fixes():
    modes = operated({}, {"noise": 0.005, "sees": lambda frame: replace(frame, velocimeter=None)}, 20.0,
                     t5=lambda driver: driver.set_goal(GOAL), t15=Driver.cancel)  # fmt: skip
    assert set(modes[60:]) == {"ready"}


def speeds_of(watch: StopWatch, *speeds: tuple[float, float], step: float = 0.02) -> list[bool | None]:
    """What a watch says of consecutive speeds and turning rates."""
    watch.begin(0.0)
    pose, covariance = np.zeros(3), np.eye(6)
    return [
        watch.check(Estimate(k * step, pose, np.array([v, 0.0]), covariance, 1.0, w), k * step)
        for k, (v, w) in enumerate(speeds)
    ]


def test_a_speed_that_passes_through_zero_and_a_robot_that_spins_are_no_robot_that_stands():
    watch = StopWatch(0.1, 1.0, 3.0)
    through = [(0.02 * (20 - k), 0.0) for k in range(60)]
    assert set(speeds_of(watch, *through)) == {None} and not watch.stands
    assert set(speeds_of(watch, *[(0.0, 2.9)] * 100)) == {None} and not watch.stands
    told = speeds_of(watch, *[(0.5, 0.0)] * 5, *[(0.01, 0.1)] * 30, (0.4, 0.0), *[(0.01, 0.1)] * 30)
    assert told.index(True) in (15, 16) and told.count(True) == 1, "an odd reading does not make it move again"
    assert speeds_of(watch, *[(0.01, 0.0)] * 9, step=0.25).index(True) == 2


@pytest.mark.parametrize("silent", ["all", "velocimeter"])
def test_a_robot_whose_speed_is_not_measured_is_not_shown_to_stand(silent):
    """Frames that do not change, or have no velocity any more, say nothing about a robot that was slow before."""
    last: list[SensorFrame] = []

    def sees(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < 1.25:
            last[:] = [frame]
        return last[0] if silent == "all" else replace(frame, velocimeter=None if frame.stamp > 1.25 else np.zeros(3))

    slow = Scripted(lambda step, straight: np.array([0.05, 0.0]))
    result = driver_of(Puck(sees=sees), slow).run(GOAL)
    assert result.reason == "fault" and not result.stopped


def frozen_after(stamp: float) -> Callable[[SensorFrame], SensorFrame]:
    """What a robot sees that shows the same frame again and again after `stamp` [s]."""
    last: list[SensorFrame] = []

    def sees(frame: SensorFrame) -> SensorFrame:
        if frame.stamp > stamp:
            last.append(frame)
        return last[0] if last else frame

    return sees


def test_a_fault_that_is_acknowledged_does_not_make_dead_sensors_good():
    robot, modes = Puck(sees=frozen_after(0.55)), []

    class Watcher(Observer):
        def tick(self, record: TickRecord) -> None:
            modes.append(record.mode)
            if record.index == 1:
                driver.set_goal(GOAL)
            elif len(modes) > 1 and modes[-1] is Mode.FAULT is not modes[-2]:
                robot.sent.clear()
                driver.acknowledge()
                driver.set_goal(GOAL)
            elif record.index == 100:
                driver.quit()

    driver = driver_of(robot, observers=[Watcher()])
    driver.serve()
    assert modes.count(Mode.FAULT) > 1 and robot.sent == []


def test_a_robot_that_waited_starts_again_from_rest():
    robot, before = Puck(), []

    class Watcher(Observer):
        def tick(self, record: TickRecord) -> None:
            if record.index == 12:
                driver.pause()
            elif record.index == 16:
                before.extend(robot.sent)
                driver.resume()

    driver = driver_of(robot, guard=Guard(2, GuardConfig(slew_limit=0.05)), observers=[Watcher()])
    driver.run(GOAL)
    assert before[-1][0] > 0.3
    assert robot.sent[len(before)][0] <= 0.05


def test_a_robot_that_does_not_know_where_it_is_stays_braked():
    robot = Puck(sees=lambda frame: replace(frame, position_fix=None))
    driver = driver_of(robot)
    result = driver.run(GOAL)
    assert result.reason == "fault" and "no position and heading for 2" in result.fault
    assert "send" not in robot.log
    assert result.steps == 0 and math.isnan(result.distance)


def test_a_robot_whose_fixes_have_three_coordinates_is_told_so():
    result = driver_of(Puck(sees=lambda frame: replace(frame, position_fix=np.zeros(3)))).run(GOAL)
    assert result.reason == "fault" and " s (position_fix: 3 values instead of 2)" in result.fault


def test_a_robot_waits_for_its_first_fix_and_then_goes():
    robot = Puck(sees=lambda frame: frame if frame.stamp > 0.75 else replace(frame, position_fix=None))
    result = driver_of(robot).run(GOAL)
    assert result.reached and result.steps == 14


def without_fix_before(stamp: float) -> Callable[[SensorFrame], SensorFrame]:
    return lambda frame: frame if frame.stamp >= stamp else replace(frame, position_fix=None)


def test_a_first_fix_may_take_longer_than_a_stop():
    config = DriverConfig(first_estimate=10.0, stop_timeout=1.0)
    result = driver_of(Puck(sees=without_fix_before(6.0)), config=config).run(GOAL)
    assert result.reached and result.fault is None


def test_a_service_gives_the_first_fix_its_time_from_the_goal_on():
    modes: list[Mode] = []

    class Watcher(Observer):
        def tick(self, record: TickRecord) -> None:
            modes.append(record.mode)
            if record.index == 40:
                driver.cancel()
            elif record.index == 50:
                driver.set_goal(GOAL)
            elif driver.last_result is not None or record.index == 200:
                driver.quit()

    robot = Puck(sees=without_fix_before(6.5), noise=1e-3)
    driver = driver_of(robot, observers=[Watcher()])
    driver.serve()
    assert driver.last_result is not None and driver.last_result.reached and Mode.FAULT not in modes
    robot.sees = without_fix_before(7.5 + robot.stamp)
    driver.serve()
    assert driver.supervisor.mode is Mode.FAULT
    assert driver.supervisor.fault == "no position and heading for 2.10 s (position_fix: silent)"


@pytest.mark.parametrize("reason", ["goal", "cancelled"])
def test_a_signal_between_the_end_of_a_trip_and_its_change_of_mode_leaves_them_agreed(reason):
    driver = driver_of(
        pilot=Scripted(lambda step, straight: (driver.cancel(), straight)[1]) if reason != "goal" else None
    )
    change = driver.supervisor.change

    def change_late(mode: Mode, why: str, now: float) -> None:
        if why == reason:
            signal.raise_signal(signal.SIGINT)
        change(mode, why, now)

    driver.supervisor.change = change_late  # type: ignore[method-assign]
    result = driver.run(GOAL)
    assert (result.reason, result.stopped) == ("interrupted", True) and driver.supervisor.mode is Mode.INIT


def test_sensors_that_repeat_themselves_are_not_driven_on_for_long():
    robot = Puck(sees=frozen_after(0.35))
    result = driver_of(robot, Scripted(lambda step, straight: np.array([0.1, 0.0]))).run(GOAL)
    assert result.reason == "fault" and "no new sensor frame for 0.8" in result.fault
    assert result.steps == 7
    assert result.holds == {"no new sensor frame": 1}


def test_a_fallen_robot_is_a_fault():
    on_its_side = {"accelerometer": np.array([0.0, 9.81, 0.0]), "magnetometer": np.array([-0.5, 0.0, 0.0])}
    robot = Puck(sees=lambda frame: frame if frame.stamp < 0.25 else replace(frame, **on_its_side), control_period=0.02)
    driver = driver_of(
        robot,
        Scripted(lambda step, straight: np.array([0.02, 0.0])),
        estimator=Estimator(EstimatorConfig()),
        guard=Guard(2, GuardConfig(tilt_limit=1.0)),
    )
    result = driver.run(GOAL)
    assert result.reason == "fault" and "tilted" in result.fault


def serve_failing(
    does: dict[int, Callable[[Driver], object]],
    until: float = math.inf,
    message: Callable[[int], str] = lambda tick: "bus error",
) -> list[Mode]:
    """Serve a robot whose readings fail from the tenth on; what `does` says is done at readings; the mode at each."""
    modes: list[Mode] = []

    def see(frame: SensorFrame) -> SensorFrame:
        modes.append(driver.supervisor.mode)
        tick = len(modes)
        does.get(tick, lambda driver: None)(driver)
        if 10 <= tick < until:
            raise OSError(message(tick))
        return frame

    driver = driver_of(Puck(sees=see, noise=1e-3))
    driver.serve()
    return modes


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [str(record.exc_info[1]) for record in caplog.records if record.message == "control step failed"]


def test_a_robot_that_cannot_be_read_is_told_of_once_and_again_after_an_acknowledgement(caplog):
    modes = serve_failing({500: Driver.acknowledge, 1000: Driver.quit}, message=lambda tick: f"no bus at {tick} ms")
    assert set(modes[10:1000]) == {Mode.FAULT}
    assert told(caplog) == ["no bus at 10 ms", "no bus at 500 ms"]


def test_another_failure_is_told_of_as_well(caplog):
    serve_failing({90: Driver.quit}, message=lambda tick: "bus error" if tick < 50 else "bus gone")
    assert told(caplog) == ["bus error", "bus gone"]


def test_a_robot_that_can_be_read_again_stays_in_fault_until_that_is_acknowledged(caplog):
    modes = serve_failing({60: Driver.acknowledge, 70: Driver.quit}, until=20)
    assert set(modes[10:60]) == {Mode.FAULT} and modes[69] is Mode.READY
    assert told(caplog) == ["bus error"]


def test_commands_get_through_where_the_robot_cannot_be_read():
    waiting: list[int] = []
    modes = serve_failing(
        {
            30: Driver.estop,
            31: lambda driver: driver.set_goal(GOAL),
            32: lambda driver: waiting.append(len(driver._requests)),
            40: Driver.acknowledge,
            50: Driver.quit,
        }
    )
    assert set(modes[30:40]) == {Mode.ESTOP} and waiting == [0]
    assert set(modes[40:50]) == {Mode.FAULT}, "acknowledged, but the cause is not gone"


def test_a_robot_that_says_it_is_in_trouble_waits_and_goes_on():
    robot, seen = Puck(noise=1e-3), Listener()
    robot.trouble = lambda: "the adapter is slow" if 10 <= len(robot.log) < 30 else None
    result = driver_of(robot, observers=[seen]).run(GOAL)
    assert result.reached and result.holds == {"the adapter is slow": 1}
    held = [record for record in seen.records if record.mode is Mode.HOLD]
    assert len(held) == 10 and all(record.sent is None for record in held)


@pytest.mark.parametrize("part", ["robot", "pilot"])
def test_a_robot_is_braked_in_every_tick_that_raises(part):
    robot, pilot, braked = Puck(noise=1e-3), Scripted(), []

    class Operator(Observer):
        def make_requests(self) -> None:
            braked.append(robot.log.count("brake"))
            if len(braked) == 2:
                driver.set_goal(GOAL)
            elif len(braked) == 10:  # from the next tick on
                assert driver.supervisor.mode is Mode.RUNNING
                setattr(robot, "read", fails) if part == "robot" else setattr(pilot, "act", fails)
            elif len(braked) == 60:
                driver.quit()

    def fails(*_: object) -> None:
        raise OSError("bus error")

    driver = driver_of(robot, pilot, observers=[Operator()])
    driver.serve()
    assert driver.supervisor.fault.startswith("OSError: bus error")
    assert (np.diff(braked[11:]) >= 1).all()


def test_a_planner_that_has_failed_for_good_is_a_fault_in_that_tick():
    robot, pilot, seen = Puck(), Scripted(), Listener()

    def script(step: int, straight: np.ndarray) -> np.ndarray:
        pilot.failed = "the planner's process failed again" if step >= 5 else None
        return straight

    pilot.script = script
    result = driver_of(robot, pilot, observers=[seen]).run(GOAL)
    assert result.fault == "the planner's process failed again" and len(robot.sent) == 5


@pytest.mark.parametrize("error", [RobotGone("it ended: bus error"), OSError("bus error")])
def test_a_stop_that_nobody_can_see_is_not_said_to_last_too_long(error):
    robot = Puck(noise=1e-3)
    read, robot.failing = robot.read, False

    def failing() -> SensorFrame:
        robot.failing |= len(robot.sent) >= 5
        if robot.failing:
            raise error
        return read()

    robot.read = failing
    result = driver_of(robot).run(GOAL)
    assert not result.stopped and "bus error" in result.fault
    assert "nobody can see whether the robot stands" in result.fault and "does not stop" not in result.fault


def test_a_robot_that_is_gone_ends_the_service():
    class Gone(Puck):
        def read(self) -> SensorFrame:
            if len(self.log) > 90:
                driver.quit()
            if len(self.log) > 30:
                raise RobotGone("the robot's adapter ended with status 1")
            return super().read()

    robot = Gone(noise=1e-3)
    driver = driver_of(robot)
    driver.serve()
    assert driver.gone == driver.supervisor.fault == "RobotGone: the robot's adapter ended with status 1"
    assert len(robot.log) < 50 and robot.log[-1] == "brake"


def test_a_plan_from_before_the_robot_was_lost_is_not_followed():
    """The robot is armed, with a plan on its way, when its clock jumps: it must be found anew."""
    pilot = Scripted(changes=lambda step: {"has_plan": step > 8})

    def jump(frame: SensorFrame) -> SensorFrame:
        if frame.stamp < 0.45:
            return frame
        return replace(frame, stamp=frame.stamp + 10.0, position_fix=None if frame.stamp < 0.85 else frame.position_fix)

    listener = Listener()
    driver = driver_of(Puck(sees=jump), pilot, observers=[listener])
    assert driver.run(GOAL).reached
    modes = [event.values["mode"] for event in listener.events if event.kind == "mode"]
    assert modes[:5] == ["ready", "armed", "init", "ready", "armed"]
    assert pilot.calls.count("drop") == 1


def test_each_run_starts_the_agent_afresh():
    agent, robot = Scripted(), Puck()
    driver = driver_of(robot, agent)
    first = driver.run(GOAL)
    robot.position = np.zeros(2)
    second = driver.run(GOAL)
    assert agent.resets == 2
    assert first.replans == second.replans
    assert second.steps == first.steps


@pytest.mark.parametrize("goal", [[math.nan, 0.0], [1.0], [[1.0, 2.0]]])
def test_a_goal_must_be_two_finite_coordinates(goal):
    robot = Puck()
    with pytest.raises(ValueError, match="goal"):
        driver_of(robot).run(goal)
    assert robot.log == []


class Broken(Observer):
    def tick(self, record: TickRecord) -> None:
        raise OSError("disk full")


class Unsayable(Observer):
    """Raises an error that cannot say what it is."""

    def tick(self, record: TickRecord) -> None:
        class Mute(Exception):
            def __str__(self) -> str:
                raise RuntimeError

        raise Mute


def test_observers_see_every_tick_and_a_failing_one_does_not_stop_the_robot():
    seen = Listener()
    driver = driver_of(observers=[Broken(), Unsayable(), seen])
    result = driver.run(GOAL)
    assert result.reached and driver.supervisor.fault is None
    assert driver.audience.dropped["Broken"] == "OSError: disk full" and "Mute" in driver.audience.dropped["Unsayable"]
    assert [record.index for record in seen.records] == list(range(result.steps + 1))
    assert all(record.mode is Mode.RUNNING and record.sent is not None for record in seen.records[:-1])
    assert seen.records[-1].sent is None
    assert seen.records[7].plan_age == pytest.approx(2 * PERIOD)
    assert {"read", "estimate", "infer", "guard", "send"} <= set(seen.records[7].timings)


def test_events_tell_of_goal_modes_and_end_and_the_flush_comes_once_braked():
    seen = Listener()
    result = driver_of(observers=[seen]).run(GOAL)
    assert [(event.kind, event.text) for event in seen.events][::5] == [("goal", "0.98, 0"), ("end", "goal")]
    assert [event.values["mode"] for event in seen.events if event.kind == "mode"] == [
        "ready", "armed", "running", "ready", "init"]  # fmt: skip
    assert seen.flushed == [result.steps + 1]


def test_a_missing_or_broken_reading_keeps_its_last_good_value():
    hold = TermHold()
    gyro = np.array([1.0, 2.0, 3.0])
    hold.fill(SensorFrame(0.0, gyro=gyro, extra={"wheel": np.array([4.0])}))
    missing = hold.fill(SensorFrame(0.1))
    np.testing.assert_array_equal(missing["gyro"], gyro[None])
    np.testing.assert_array_equal(missing["wheel"], [[4.0]])
    partly = hold.fill(SensorFrame(0.2, gyro=np.array([7.0, math.nan, 9.0])))
    np.testing.assert_array_equal(partly["gyro"], [[7.0, 2.0, 9.0]])


def test_the_summary_is_json_and_readable():
    driver = driver_of()
    result = driver.run(GOAL)
    summary = summarise(
        Account([Episode(3, result, collisions=0)]), driver.timer, driver.loop, {"timer_slack": "granted"}
    )
    again = json.loads(json.dumps(summary, allow_nan=False))
    assert again == summary
    episode = summary["episodes"][0]
    assert (episode["seed"], episode["reached"], episode["reason"], episode["steps"]) == (3, True, "goal", 14)
    assert set(summary["timing"]["sections"]) == {"read", "estimate", "plan", "infer", "guard", "send"}
    assert summary["timing"]["sections"]["plan"]["count"] == 3
    assert summary["timing"]["sections"]["send"]["count"] == 15
    assert set(summary["timing"]["lateness"]) >= {"p50", "p99", "max"}
    assert summary["replans"] == {"start": 1, "half_index": 2}
    screen = io.StringIO()
    print_summary(summary, Console(file=screen, width=120))
    assert "1 of 1 goals reached" in screen.getvalue()
    assert "half_index 2, start 1" in screen.getvalue()


def test_a_summary_without_a_position_is_json_too():
    driver = driver_of(Puck(sees=lambda frame: replace(frame, position_fix=None)))
    summary = summarise(Account([Episode(None, driver.run(GOAL))]), driver.timer, driver.loop, {})
    assert json.loads(json.dumps(summary, allow_nan=False))["episodes"][0]["distance"] is None
    print_summary(summary, Console(file=io.StringIO()))


def test_a_simulated_point_robot_drives_to_its_goal_on_noisy_sensors():
    layout = sample_layout(parse_world("pillar(2,2,0)"), seed=5)
    robot = SimRobot(get_robot("point"), layout, seed=1)

    class Steering(Scripted):
        def act(self, now, estimate, terms, goal, occupancy):
            self.yaw = float(estimate.pose[2])
            return super().act(now, estimate, terms, goal, occupancy)

    def steer(step: int, straight: np.ndarray) -> np.ndarray:
        turn = math.remainder(math.atan2(straight[1], straight[0]) - pilot.yaw, 2 * math.pi)
        return np.array([0.3 * (math.cos(turn) > 0.9), np.clip(2.0 * turn, -1.0, 1.0)])

    pilot = Steering(steer, control_period=robot.control_period)
    driver = Driver(
        robot, pilot, robot.occupancy, FakeClock(), Estimator(EstimatorConfig(tilts=False)), Guard(robot.action_dim)
    )
    result = driver.run(layout.goal, max_steps=2000)
    assert result.reached and result.stopped
    truth = robot.truth()
    assert np.linalg.norm(truth.pose[:2] - layout.goal) < 0.5
    assert np.linalg.norm(truth.velocity) < 0.15


def test_a_map_that_is_published_again_unchanged_is_no_other_map():
    listener, pillar = Listener(), np.array([[1.5, 1.5]])

    def published(stamp: float) -> OccupancyMap:
        again = empty_map((2.0, 2.0))
        if stamp > 0.55:
            draw_discs(again.occupied, again.origin, again.resolution, pillar, 0.2)
        return again

    result = driver_of(occupancy=published, observers=(listener,)).run(GOAL)
    assert result.reached
    maps = [tick.occupancy for tick in listener.records if tick.occupancy is not None]
    assert len({id(each) for each in maps}) == 2 < len(maps)
    assert [bool(each.occupied.any()) for each in maps] == sorted(bool(each.occupied.any()) for each in maps)
