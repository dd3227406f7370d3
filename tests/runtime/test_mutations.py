"""Every watchdog is switched off in turn, in a copy of the source: the test of its fault must then fail."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PATIENCE = 150.0
"""Time for one test [s]. A loop that never ends, for want of what would have ended it, has failed as well."""


@dataclass(frozen=True)
class Mutant:
    """A watchdog switched off by replacing one piece of source, and the tests that must notice."""

    name: str
    file: str
    source: str
    instead: str
    tests: str


R, F, T = "hiernav/runtime", "tests/runtime/faults", "tests/runtime"
WATCH, PREDICTION, P = f"{R}/watchdogs.py", "hiernav/nav/prediction.py", "tests/nav/test_prediction.py"
MUTANTS = (
    Mutant("lost sensors", WATCH, "if age > self.lost_after:", "if False:", f"{F}/test_01_waiting_for_sensors.py"),
    Mutant("silent sensors", WATCH, "if age > self.hold_after:", "if False:", f"{F}/test_01_waiting_for_sensors.py"),
    Mutant("frozen sensor", f"{R}/freshness.py", "if sensor.repeats < REPEATS", "if True or sensor.repeats < REPEATS",
           f"{F}/test_02_frozen_value.py"),
    Mutant("old stamp", f"{R}/estimator.py", "or 0.0 < step <=", "or step <=", f"{F}/test_06_stamps.py"),
    Mutant("lone stamp ahead", f"{R}/estimator.py", "JUMP_AFTER, RESTART_AFTER = 2,", "JUMP_AFTER, RESTART_AFTER = 1,",
           f"{F}/test_06_stamps.py"),
    Mutant("clock that starts again", f"{R}/estimator.py", "RESTART_AFTER = 2, 10", "RESTART_AFTER = 2, 10**9",
           f"{F}/test_06_stamps.py"),
    Mutant("plan from before", f"{R}/estimator.py", "self._starts += 1", "self._starts = 1", f"{F}/test_06_stamps.py"),
    Mutant("gate of positions", f"{R}/planar_filter.py", "if not 0.0 <= distance <= gate:", "if False:",
           f"{F}/test_04_spikes.py"),
    Mutant("nothing but lies", f"{R}/freshness.py", "if self.frozen(name) else sensor.believed)",
           "if self.frozen(name) else stamp)", f"{F}/test_04_spikes.py"),
    Mutant("overruns", WATCH, "if overruns_in_a_row >= OVERRUNS:", "if False:", f"{F}/test_22_overload.py"),
    Mutant("overdue plan, slow", WATCH, "if overdue <= self.slow_after:", "if overdue <= self.hold_after:",
           f"{F}/test_09_planner_hangs.py::test_the_old_plan_is_followed_then_slowly_and_then_the_robot_holds"),
    Mutant("overdue plan, hold", WATCH, "if overdue <= self.hold_after:", "if True:",
           f"{F}/test_09_planner_hangs.py::test_the_old_plan_is_followed_then_slowly_and_then_the_robot_holds"),
    Mutant("no way", WATCH, "waited > self.give_up_after", "False", f"{F}/test_24_goal_unreachable.py"),
    Mutant("saturation", WATCH, "and self._sum >= self._limit", "and False", f"{F}/test_13_saturated_action.py"),
    Mutant("stop", WATCH, "math.hypot(*estimate.velocity.tolist()) < speed", "True", f"{T}/test_driver.py"),
    Mutant("adapter", f"{R}/robot.py", "if now - self._fed_at <= self.timeout:", "if True:",
           f"{F}/test_21_control_process_gone.py"),
    Mutant("adapter before the loop", f"{R}/realtime.py", "if above:", "if False:", f"{T}/test_realtime.py"),
    Mutant("old command", f"{R}/robot_process.py", "fresh = now - given <= self.watchdog.timeout", "fresh = True",
           f"{T}/test_process_robot.py::test_a_command_counts_from_when_it_was_given_and_an_old_one_is_not_followed"),
    Mutant("adapter that fails", f"{R}/robot_process.py", "failures += self._brake_for(last_brakes)", "pass",
           f"{F}/test_21_control_process_gone.py"),
    Mutant("signals to all", f"{R}/child.py", "signal.signal(number, signal.SIG_IGN)", "pass",
           f"{F}/test_21_control_process_gone.py"),
    Mutant("action not finite", f"{R}/guard.py", "if not np.isfinite(action).all():", "if False:",
           f"{F}/test_12_skill_not_finite.py"),
    Mutant("third action not finite", f"{R}/guard.py", "if self._non_finite >= self.config.max_non_finite:",
           "if False:", f"{F}/test_12_skill_not_finite.py"),
    Mutant("actuator limits", f"{R}/guard.py", "min(max(value, low), high) for value in values",
           "value for value in values", f"{T}/test_guard.py"),
    Mutant("slew limit", f"{R}/guard.py", "            limited = steady\n", "            pass\n", f"{T}/test_guard.py"),
    Mutant("tilt", f"{R}/guard.py", "if self._tilted < self.config.max_tilted:", "if True:", f"{F}/test_30_fallen.py"),
    Mutant("tilt of a braked robot", f"{R}/driver.py", "if fallen is not None and", "if False and",
           f"{F}/test_30_fallen.py"),
    Mutant("tilted tick", f"{R}/guard.py", "if self._tilted:  #", "if fault:  #", f"{F}/test_30_fallen.py"),
    Mutant("time to collision", f"{R}/guard.py", "not ttc >= slow", "False", f"{F}/test_26_obstacle_moves_in.py"),
    Mutant("recoveries", "hiernav/nav/recovery.py", "stuck & (self._tries[rows] >= LIMIT)", "stuck & False",
           f"{F}/test_28_pinned.py"),
    Mutant("reach of a recovery", "hiernav/nav/recovery.py", "> REACH_M or", "> 1e9 or",
           f"{F}/test_28_pinned.py"),
    Mutant("hanging planner", f"{R}/process_planner.py", 'self._child.nudge(b"r")', "pass",
           f"{F}/test_09_planner_hangs.py::test_a_hanging_process_is_replaced_three_times_and_then_given_up"),
    Mutant("killed planner", f"{R}/planner_process.py", "memory.status.restarts >= MAX_RESTARTS", "True",
           f"{F}/test_10_planner_killed.py"),
    Mutant("late plan", f"{R}/pilot.py", "if not 0.0 <= stamp - answer.stamp <= MAX_PLAN_AGE:", "if False:",
           f"{F}/test_09_planner_hangs.py::test_an_answer_that_comes_too_late_is_not_followed"),
    Mutant("unsound plan", f"{R}/pilot.py", "if occupancy.contains(plan).all():", "if True:",
           f"{F}/test_11_unsound_plan.py"),
    Mutant("endless hold", f"{R}/mission.py", "elif now - self._held_since > self.config.hold_timeout:", "elif False:",
           f"{F}/test_09_planner_hangs.py::test_the_old_plan_is_followed_then_slowly_and_then_the_robot_holds"),
    Mutant("goal in an obstacle", "hiernav/nav/goal.py", "if not occupancy.occupied_at(goal):", "if True:",
           f"{F}/test_23_goal_in_obstacle.py"),
    Mutant("start in an obstacle", "hiernav/nav/goal.py", "if occupancy.occupied_at(start):", "if False:",
           f"{F}/test_27_start_outside.py"),
    Mutant("brake on every way out", f"{R}/loop.py", "                self._brake()\n", "                pass\n",
           f"{T}/test_loop.py"),
    Mutant("latch", f"{R}/supervisor.py", "Mode.FAULT: frozenset({Mode.ESTOP})",
           "Mode.FAULT: frozenset({Mode.ESTOP, Mode.RUNNING})", f"{T}/test_supervisor.py"),
    Mutant("other robot", "hiernav/nav/bundle.py", "if sha256 != self.manifest.robot_sha256:", "if False:",
           f"{F}/test_16_other_robot.py"),
    Mutant("value not finite", f"{R}/estimator.py", "if not -ABSURD < component < ABSURD:", "if False:",
           f"{F}/test_03_not_finite.py"),
    Mutant("silent lidar", f"{R}/estimator.py", "for name, silence, flaw in self._terms.silences(self._stamp):",
           "for name, silence, flaw in ():",
           f"{F}/test_01_sensor_dropout.py"),
    Mutant("lidar out of range", f"{R}/terms.py", "return 0.0 <= min(closeness", "return True or 0.0 <= min(closeness",
           f"{F}/test_03_not_finite.py"),
    Mutant("no value but garbage", f"{R}/estimator.py", "if reading is None and value is not None:", "if False:",
           f"{F}/test_03_not_finite.py"),
    Mutant("carried away", f"{R}/doubts.py", "if self._rejected[sensor] < self._patience(sensor) or not agrees:",
           "if True:", f"{F}/test_05_kidnapped.py"),
    Mutant("lost too early", f"{R}/doubts.py", "return speaks and (unsure or 0 <", "return False and (unsure or 0 <",
           f"{F}/test_05_kidnapped.py"),
    Mutant("lost too late", f"{R}/doubts.py", "return speaks and (unsure or 0 <", "return (unsure or 0 <",
           f"{F}/test_05_kidnapped.py"),
    Mutant("latency of a fix", f"{R}/estimator.py", "then = self._history.at(stamp)",
           "then = self._history.at(self._stamp)", f"{F}/test_08_fix_latency.py"),
    Mutant("altered model", "hiernav/nav/bundle.py", "if hashlib.sha256(data).hexdigest() != manifest.files[name]:",
           "if False:", f"{F}/test_14_altered_model.py"),
    Mutant("observation", "hiernav/nav/bundle.py", "if getattr(here, key) != getattr(there, key):", "if False:",
           f"{F}/test_15_wrong_observation.py"),
    Mutant("chunks", f"{R}/recorder.py", "self._writer.flush()\n", "pass\n", f"{F}/test_18_truncated_log.py"),
    Mutant("full disk", f"{R}/recorder.py", "if self.error is not None or self._queue.qsize() >= QUEUE_LENGTH:",
           "if False:", f"{F}/test_19_disk_full.py"),
    Mutant("size of a picture", "hiernav/nav/mapfile.py", "if width * height > MAX_PIXELS:", "if False:",
           f"{F}/test_25_impossible_map.py"),
    Mutant("flood from the page", "hiernav/view/link.py", "elif left:", "elif True:", "tests/view/test_link.py"),
    Mutant("endless flood from the page", "hiernav/view/link.py", "for _ in range(HEARD_PER_TICK):",
           "for _ in range(10**9):", "tests/view/test_link.py"),
    Mutant("stop in a flood from the page", "hiernav/view/commands.py", 'if command.kind == "estop":', "if False:",
           "tests/view/test_link.py"),
    Mutant("limit of requests", f"{R}/requests.py", "while len(self._waiting) >= LIMIT:", "while False:",
           f"{F}/test_29_viewer_stalls.py"),
    Mutant("what became of a goal", f"{R}/mission.py", "ticket.trip = self.trip", "pass", f"{T}/test_control.py"),
    Mutant("a command that nobody takes", f"{R}/control.py", "if ticket.taken is None:", "if False:",
           f"{T}/test_control.py"),
    Mutant("file for whoever says stop", f"{R}/control.py", "            if self._reserve is None:\n",
           "            if True:\n",
           f"{T}/test_control.py::test_a_robot_is_stopped_by_a_process_that_may_have_no_more_files"),
    Mutant("head-on obstacle", PREDICTION, "occupied[row, col] = stays[label]", "occupied[row, col] = False", P),
    Mutant("wall in sight", PREDICTION, "* occupancy.resolution <= LARGEST_M", "<= np.inf", P),
    Mutant("obstacle that grows", PREDICTION, "moves &= self._drifts[watched] <= _DRIFT * np.abs(way)", "pass", P),
    Mutant("obstacle that stops", PREDICTION, "<= _ASTRAY * np.abs(should))", "<= np.inf)", P),
    Mutant("map that stands", PREDICTION, "elif len(self._times) and not 0.0 <= gap <= GAP_S:", "elif False:", P),
    Mutant("map after a gap", PREDICTION, "not (0.0 < gap <= GAP_S and", "not (True and", P),
    Mutant("same map again", f"{R}/driver.py", "or not occupancy.shows_the_same_as(before):", "or True:",
           f"{T}/test_driver.py"),
    Mutant("first reading", f"{R}/doubts.py", "if self._config.confirm:", "if False:",
           f"{F}/test_04_spikes.py"),
    Mutant("sensors that all hang", f"{R}/freshness.py", "return any(sensor.value) and self._all_repeat(sensor.new)",
           "return False", f"{F}/test_02_frozen_value.py"),
    Mutant("sensors that hang again", f"{R}/freshness.py", "self._thawed = stamp  #", "pass  #",
           f"{F}/test_02_frozen_value.py"),
    Mutant("speed that passes through zero", f"{R}/watchdogs.py", "SETTLED = 0.2", "SETTLED = 0.0",
           f"{T}/test_driver.py"),
    Mutant("robot that spins", f"{R}/watchdogs.py", "not abs(estimate.yaw_rate) < turn", "False",
           f"{T}/test_driver.py"),
    Mutant("robot that moves again", f"{R}/watchdogs.py", "self._since, self._told = now, False\n        if not",
           "self._told = True\n        if not", f"{T}/test_driver.py"),
    Mutant("goal of a robot that rolls", f"{R}/mission.py", "if self.must_stand:\n            wait",
           "if False:\n            wait", f"{T}/test_driver.py"),
    Mutant("fault upon a fault", f"{R}/supervisor.py", "kind in self._kinds or", "True or", f"{T}/test_supervisor.py"),
    Mutant("frozen lidar", f"{R}/freshness.py", "way > max(TRAVEL, SPARE", "way > max(math.inf, SPARE",
            f"{F}/test_02_frozen_value.py"),
    Mutant("frozen fix", f"{R}/estimator.py", 'if self._watch.repetition("position_fix", stamp) >=',
           'if False and self._watch.repetition("position_fix", stamp) >=', f"{F}/test_02_frozen_value.py"),
    Mutant("gate of headings", f"{R}/planar_filter.py", "if not 0.0 <= residual * residual / spread <= gate:",
           "if False:", f"{F}/test_04_spikes.py"),
    Mutant("leap of the gyro", f"{R}/estimator.py", "if jump > self.config.max_jump and not", "if False and not",
           f"{F}/test_04_spikes.py"),
    Mutant("own brake", f"{R}/driver.py", "if guarded.brake or guarded.fault is not None:",
           "if guarded.fault is not None:", f"{F}/test_12_skill_not_finite.py"),
    Mutant("saturation that does not end", f"{R}/mission.py", "if trip.saturated > MAX_SATURATED:", "if False:",
           f"{F}/test_13_saturated_action.py"),
    Mutant("recoveries anywhere", f"{R}/mission.py", "if trip.recoveries >= self.config.max_recoveries:", "if False:",
           f"{F}/test_28_pinned.py"),
    Mutant("armed for ever", f"{R}/mission.py", "elif supervisor.mode is Mode.ARMED and now - self._held_since >",
           "elif supervisor.mode is Mode.ARMED and 0.0 >", f"{T}/test_terms.py"),
    Mutant("braked when it raises", f"{R}/driver.py",
           "# what cannot be read cannot be seen to stand\n            self.robot.brake()",
           "# what cannot be read cannot be seen to stand", f"{T}/test_driver.py"),
    Mutant("planner that has failed", f"{R}/mission.py", "if failed is not None:", "if False:", f"{T}/test_driver.py"),
    Mutant("page of another site", "hiernav/view/__main__.py", "if not is_own(request.headers):", "if False:",
           "tests/view/test_page.py"),
    Mutant("page for this machine", "hiernav/view/page.py", 'HOST = "127.0.0.1"', 'HOST = "0.0.0.0"',
           "tests/view/test_page.py"),
    Mutant("hold without a way", WATCH, "waited > self.hold_after else", "False else",
           f"{F}/test_26_obstacle_moves_in.py"),
    Mutant("stop in time", WATCH, "now - self._since > self.timeout:", "False:", f"{T}/test_driver.py"),
    Mutant("rehearsal that takes too long", f"{R}/loop.py", "if self._spoilt > SPOILT:", "if False:",
           f"{T}/test_loop.py"),
    Mutant("plan on its way to another goal", f"{R}/pilot.py", "if len(self.agent.turn_to(goal[None])):", "if False:",
           f"{T}/test_pilot.py"),
    Mutant("policies of another rate", f"{R}/driver.py", "if not math.isclose(trained,",
           "if False and not math.isclose(trained,", f"{T}/test_driver.py"),
    Mutant("bundle of another rate", "hiernav/nav/bundle.py", "if not abs(period - theirs) <= 1e-6:", "if False:",
           "tests/test_run_loop.py"),
    Mutant("golden values", f"{R}/policy.py", "    check_golden(bundle, networks)\n", "    pass\n",
           f"{T}/test_policy.py"),
    Mutant("fault without a goal", f"{R}/account.py", 'if event.kind == "fault" or mode == Mode.FAULT.value:',
           "if False:", f"{T}/test_account.py"),
)  # fmt: skip


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the tests need."""
    folder = tmp_path_factory.mktemp("mutant")
    skip = shutil.ignore_patterns("__pycache__", "*.onnx.tmp")
    for part in ("hiernav", "tests", "deploy"):
        shutil.copytree(ROOT / part, folder / part, ignore=skip)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def test_every_mutant_finds_its_source_once():
    """Cheap, and in the default run: a mutant whose source has been rewritten would check nothing."""
    for mutant in MUTANTS:
        assert (ROOT / mutant.file).read_text().count(mutant.source) == 1, mutant.name
        assert (ROOT / mutant.tests.partition("::")[0]).is_file(), mutant.name


@pytest.mark.slow
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name.replace(" ", "_"))
def test_its_fault_is_noticed_when_a_watchdog_is_off(mutant: Mutant, copy: Path) -> None:
    file = copy / mutant.file
    before = file.read_text()
    file.write_text(before.replace(mutant.source, mutant.instead))
    try:
        code = run_tests(copy, mutant.tests)
    finally:
        file.write_text(before)
    assert code == 1, f"{mutant.name}: {mutant.tests} ended with {code} although it was switched off"


def run_tests(folder: Path, tests: str) -> int:
    """Exit code of pytest: 0 passed, 1 failed; a run that takes too long has failed."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", tests]
    try:
        return subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=PATIENCE).returncode
    except subprocess.TimeoutExpired:
        return 1
