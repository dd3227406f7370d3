"""The account of a run of deploy/run_loop.py: shown first, saved in one piece, never in the way of the exit code."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from run_loop_script import load_script
from shipped import RUN_LOOP

from hiernav.drive import episodes, exits, picture
from hiernav.drive import main as drive_main
from hiernav.runtime.account import KEPT, Account, Episode, FaultWatch
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.driver import Driver
from hiernav.runtime.loop import FixedRateLoop
from hiernav.runtime.observe import Event, Observer
from hiernav.runtime.robot import RobotGone
from hiernav.runtime.sim_robot import SimRobot
from hiernav.runtime.summary import print_summary, summarise
from hiernav.runtime.timing import TickTimer
from hiernav.runtime.trip import RunResult
from hiernav.sim.layout import parse_world
from hiernav.sim.worlds import sample_layout

script = load_script()
SHORT = ["--fast", "--world", "pillar(2,2,0)", "--set", "driver.max_steps=3"]
FAULTY = [*SHORT, "--robot", "doggo", "--set", "guard.tilt_limit=0.001"]
SERVE = [
    "--serve", "--world", "pillar(2,2,0)", "--planner", "sync", "--control", "socket", "--no-pictures",
    "--set", "driver.max_steps=3", "--set", "realtime.rehearsal=0",
]  # fmt: skip


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Runs a command line in `tmp_path`; returns the exit code."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: script.main([*arguments, "--out", "out"])


def test_the_folder_of_the_summary_is_made(run, tmp_path):
    assert run(*SHORT, "--no-pictures", "--json", "deep/er/x.json") == 0
    assert (tmp_path / "deep/er/x.json").read_text() == (tmp_path / "out/summary.json").read_text()
    assert [file.name for file in (tmp_path / "deep/er").iterdir()] == ["x.json"]


@pytest.mark.parametrize(
    "arguments", [["--json", "file/x.json"], ["--json", "folder"], ["--dry-run", "--json", "folder"]]
)
def test_a_summary_that_cannot_be_written_is_refused_before_anything_moves(
    run, tmp_path, capsys, monkeypatch, arguments
):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    monkeypatch.setattr("hiernav.runtime.driver.Driver.run", lambda *_: pytest.fail("it moved"))
    fast = [] if "--dry-run" in arguments else SHORT
    assert run(*fast, *arguments) == 2
    shown = capsys.readouterr()
    assert (
        shown.err.startswith("run_loop: --json: ") and "cannot be written" in shown.err and shown.err.count("\n") == 1
    )
    assert shown.out == ""


@pytest.mark.parametrize(("arguments", "code"), [(SHORT, 0), (FAULTY, 1)])
def test_a_full_disk_at_the_end_costs_neither_table_nor_exit_code(run, tmp_path, capsys, monkeypatch, arguments, code):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "x.json").write_text("of the last run")
    monkeypatch.setattr("os.replace", full)
    monkeypatch.setattr(picture.Drive, "draw", full)
    assert run(*arguments, "--json", "x.json") == code
    shown = capsys.readouterr()
    assert "goals reached" in shown.out and "run folder: out" in shown.out
    assert shown.err.splitlines() == [
        f"run_loop: {file} is not written: No space left on device"
        for file in ("out/summary.json", "x.json", "out/drive-0.png")
    ]
    assert (tmp_path / "x.json").read_text() == "of the last run"
    assert list((tmp_path / "out").iterdir()) == []


def test_ctrl_c_while_pictures_are_drawn_costs_pictures_alone(run, tmp_path, capsys, monkeypatch):
    def interrupted(_drive: object, _layout: object, file: Path, _title: str) -> None:
        file.write_bytes(b"half a pic")
        raise KeyboardInterrupt

    monkeypatch.setattr(picture.Drive, "draw", interrupted)
    assert run(*FAULTY) == exits.FAULT
    assert "0 of 1 goals reached" in capsys.readouterr().out
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["summary.json"]


def driven(folder: Path) -> list[str]:
    return [episode["reason"] for episode in json.loads((folder / "out/summary.json").read_text())["episodes"]]


def test_a_signal_between_two_worlds_costs_nothing_of_what_was_driven(run, tmp_path, monkeypatch):
    tell = episodes.Episodes._say_ended
    monkeypatch.setattr(
        episodes.Episodes, "_say_ended", lambda *given: signal.raise_signal(signal.SIGTERM) or tell(*given)
    )
    assert run(*SHORT, "--episodes", "3") == 0
    assert driven(tmp_path) == ["timeout"]


def test_a_signal_just_before_a_world_is_driven_keeps_the_robot_from_moving(run, tmp_path, monkeypatch):
    begin, begun = Driver._begin, []

    def begin_late(driver: Driver) -> None:
        begin(driver)
        begun.append((driver.loop, driver.loop.ticks))
        if len(begun) == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Driver, "_begin", begin_late)
    assert run(*SHORT, "--episodes", "3") == 0
    assert driven(tmp_path) == ["timeout", "interrupted"]
    (loop, _), (_, before) = begun
    assert loop.ticks == before > 3


def test_a_world_that_cannot_be_entered_is_a_fault_and_costs_nothing_of_what_was_driven(
    run, tmp_path, capsys, monkeypatch
):
    reset, begun = SimRobot.reset, []

    def gone(robot: SimRobot, layout: object, seed: int) -> None:
        begun.append(seed)
        if seed == 2:
            raise RobotGone("the robot's adapter ended with status -9")
        reset(robot, layout, seed)

    monkeypatch.setattr(SimRobot, "reset", gone)
    assert run(*SHORT, "--episodes", "5", "--no-pictures") == exits.FAULT
    assert driven(tmp_path) == ["timeout", "timeout"] and begun[-1] == 2
    assert capsys.readouterr().err == "run_loop: the robot's adapter ended with status -9\n"


def test_each_drive_has_its_own_collisions_and_the_distance_at_its_end_whatever_its_robot_counts(
    run, tmp_path, monkeypatch
):
    reset, stop = SimRobot.reset, Driver._stop

    def reset_some(robot: SimRobot, layout: object, seed: int) -> None:
        reset(robot, layout, seed)
        robot._collisions = 7

    def stop_elsewhere(driver: Driver) -> bool:
        driver.robot._collisions += 3
        driver.robot._sim.pose = driver.robot._sim.pose + 5.0
        return stop(driver)

    monkeypatch.setattr(SimRobot, "reset", reset_some)
    monkeypatch.setattr(Driver, "_stop", stop_elsewhere)
    assert run(*SHORT, "--episodes", "2", "--no-pictures") == 0
    for episode in json.loads((tmp_path / "out/summary.json").read_text())["episodes"]:
        assert episode["collisions"] == 0
        assert episode["true_distance"] == pytest.approx(episode["distance"], abs=0.1)


def test_a_screen_that_nobody_reads_costs_neither_worlds_nor_account_nor_exit_code(tmp_path):
    reads, writes = os.pipe()
    os.close(reads)
    command = [
        sys.executable,
        str(RUN_LOOP),
        *SHORT,
        "--episodes",
        "2",
        "--no-pictures",
        "--out",
        str(tmp_path / "out"),
    ]
    try:
        assert subprocess.run(command, stdout=writes, stderr=writes, timeout=60).returncode == 0
    finally:
        os.close(writes)
    assert driven(tmp_path) == ["timeout", "timeout"]


@pytest.mark.parametrize("dry", [False, True])
def test_a_dash_asks_for_json_alone_on_the_standard_output(run, tmp_path, capsys, monkeypatch, dry):
    if dry:
        monkeypatch.setattr(drive_main, "report", lambda *_: {"bundle": {"robot": "point"}})
    assert run(*(["--dry-run"] if dry else [*SHORT, "--no-pictures"]), "--json", "-") == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert found == ({"bundle": {"robot": "point"}} if dry else json.loads((tmp_path / "out/summary.json").read_text()))
    assert dry or "goals reached" in shown.err
    assert not (tmp_path / "-").exists()


@pytest.mark.parametrize("port", ["70000", "-1", "page"])
def test_a_port_that_is_none_is_refused_with_usage(run, capsys, port):
    with pytest.raises(SystemExit) as left:
        run(f"--view={port}")
    assert left.value.code == 2
    assert f"argument --view: '{port}' is no port, expected 0 to 65535" in capsys.readouterr().err


class Remote(SimRobot):
    """Looks like a robot in a process of its own, and lives in the test's time."""

    watchdog_trips = 0
    realtime: dict[str, str] = {}
    killed = False

    def dismiss(self) -> None:
        pass


@pytest.fixture
def serve(run, tmp_path, monkeypatch) -> Callable[..., tuple[int, dict[str, Any]]]:
    """Serves while `at(driver, tick)` is called in each tick; returns the exit code and the summary."""
    serve = Driver.serve

    def served(at: Callable[[Driver, int], object], *arguments: str) -> tuple[int, dict[str, Any]]:
        class Operator(Observer):
            def __init__(self, driver: Driver) -> None:
                self.driver, self.ticks = driver, 0

            def make_requests(self) -> None:
                at(self.driver, self.ticks)
                self.ticks += 1

        def commanded(driver: Driver) -> None:
            driver.audience.observers.append(Operator(driver))
            serve(driver)

        monkeypatch.setattr(Driver, "serve", commanded)
        code = run(*SERVE, *arguments)
        return code, json.loads((tmp_path / "out/summary.json").read_text())

    layout = sample_layout(parse_world("pillar(2,2,0)"), 0)
    monkeypatch.setattr(
        drive_main, "_process_robot", lambda _, spec, settings, __: Remote(spec, layout, settings.noise)
    )
    monkeypatch.setattr(episodes, "MonotonicClock", FakeClock)
    monkeypatch.setattr(episodes, "request_realtime", lambda _: {})
    return served


GOAL = sample_layout(parse_world("pillar(2,2,0)"), 0).goal


def test_who_serves_accounts_for_every_goal_also_for_those_that_others_overtake(serve, capsys):
    goals = {10: GOAL, 60: np.array([50.0, 50.0]), 110: GOAL, 112: GOAL}

    def at(driver: Driver, tick: int) -> None:
        if tick in goals:
            driver.set_goal(goals[tick])
        if tick == 160:
            driver.quit()

    code, summary = serve(at)
    episodes = summary["episodes"]
    assert code == 0 and summary["faults"] == {"count": 0, "newest": []}
    assert [episode["reason"] for episode in episodes] == ["timeout", "goal_outside", "changed", "timeout"]
    assert [episode["stopped"] for episode in episodes] == [True, True, False, True]
    assert [episode["steps"] for episode in episodes][::3] == [3, 3]
    assert summary["ends"] == {"timeout": 2, "goal_outside": 1, "changed": 1}
    assert all(episode["seed"] == 0 and episode["collisions"] == 0 for episode in episodes)
    away = np.linalg.norm(sample_layout(parse_world("pillar(2,2,0)"), 0).start[:2] - GOAL)
    assert episodes[0]["true_distance"] == pytest.approx(away, abs=0.1) and episodes[1]["true_distance"] > 60.0
    assert summary["replans"]["start"] == sum(episode["replans"].get("start", 0) for episode in episodes)
    assert "0 of 4 goals reached" in capsys.readouterr().out


@pytest.mark.parametrize(("then", "code"), [("acknowledge", 0), ("estop", 1), ("cancel", 1)])
def test_a_fault_without_a_goal_is_named_and_ends_with_code_1_unless_it_was_acknowledged(serve, capsys, then, code):
    def at(driver: Driver, tick: int) -> None:
        if tick == 10:
            whole = driver.occupancy

            def broken(_: float) -> object:
                driver.occupancy = whole
                raise OSError("no map [/tmp/map]")

            driver.occupancy = broken
        if tick == 20:
            getattr(driver, then)()
        if tick == 40:
            driver.quit()

    ended, summary = serve(at)
    faults = summary["faults"]
    assert (ended, summary["episodes"], faults["count"]) == (code, [], 1)
    assert faults["newest"][0]["why"] == "OSError: no map [/tmp/map]" and 0.1 < faults["newest"][0]["seconds"] < 0.5
    assert faults["newest"][0]["acknowledged"] == (code == 0)
    shown = " ".join(capsys.readouterr().out.split())
    assert "faults: 1 after 0.2 s: OSError: no map [/tmp/map]" in shown
    assert (", acknowledged" in shown) == (code == 0)


def test_the_fault_of_a_goal_is_told_with_it_although_it_was_acknowledged_before_the_robot_stood(serve):
    def at(driver: Driver, tick: int) -> None:
        if tick == 10:
            driver.set_goal(GOAL)
        if tick == 12:

            def fails(_: np.ndarray) -> None:
                del driver.robot.send
                raise OSError("bus error")

            driver.robot.send = fails
        if tick == 13:
            driver.acknowledge()
        if tick == 60:
            driver.quit()

    code, summary = serve(at)
    (episode,) = summary["episodes"]
    assert code == 0 and summary["faults"]["newest"][0]["acknowledged"]
    assert (episode["reason"], episode["fault"]) == ("fault", "OSError: bus error")


@pytest.mark.parametrize("seen", [True, False])
def test_a_robot_that_was_not_seen_to_stand_ends_with_code_1(serve, monkeypatch, seen):
    if not seen:
        monkeypatch.setattr(Driver, "_stop", lambda _: False)

    def at(driver: Driver, tick: int) -> None:
        if tick == 10:
            driver.set_goal(GOAL)
        if tick == 12:
            driver.estop("pressed")
            driver.quit()

    code, summary = serve(at)
    (episode,) = summary["episodes"]
    assert (code, episode["reason"], episode["stopped"]) == (0 if seen else 1, "estop", seen)
    told = [fault["why"] for fault in summary["faults"]["newest"]]
    assert told == ([] if seen else ["the robot does not stop within 3 s"])


def test_a_loop_that_listens_already_or_a_page_that_fails_spends_no_recording_s_name(serve, run, tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(tmp_path / "socket"))
        other.listen()
        assert run(*SERVE, "--record", "a.mcap") == 2
    (tmp_path / "socket").unlink()

    def fails(*_: object) -> None:
        raise ValueError("the live page does not come up")

    monkeypatch.setattr(episodes, "_open_page", fails)
    assert run(*SERVE, "--view", "--record", "a.mcap") == 2
    assert not (tmp_path / "a.mcap").exists() and not (tmp_path / "socket").exists()
    (tmp_path / "a.mcap").write_text("of the last run")
    assert run(*SERVE, "--record", "a.mcap") == 2
    assert not (tmp_path / "socket").exists()


def test_an_error_out_of_the_loop_is_a_fault_and_costs_nothing_of_what_was_driven(run, tmp_path, capsys, monkeypatch):
    drive, goals = Driver.run, []

    def fails(driver: Driver, goal: np.ndarray) -> RunResult:
        goals.append(goal)
        return drive(driver, goal) if len(goals) == 1 else 1 / 0

    monkeypatch.setattr(Driver, "run", fails)
    assert run(*SHORT, "--episodes", "3", "--no-pictures", "--record", "a.mcap") == exits.FAULT
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert [episode["reason"] for episode in summary["episodes"]] == ["timeout"] and len(goals) == 2
    assert summary["settings"]["driver.max_steps"] == 3
    assert [fault["why"] for fault in summary["faults"]["newest"]] == ["ZeroDivisionError: division by zero"]
    assert summary["recording"]["ticks"] == summary["timing"]["ticks"]
    assert (tmp_path / "a.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")
    assert "Traceback" in capsys.readouterr().err


def account_of(ends: int, kept: int | None = None) -> Account:
    account = Account(kept=kept)
    for k in range(ends):
        account.add(Episode(k, RunResult("goal" if k else "timeout", 1, 0.1, 0.0, True, guard={"clipped": 2})))
    return account


def summary_of(account: Account, loop: FixedRateLoop | None = None, timer: TickTimer | None = None) -> dict[str, Any]:
    loop = loop or FixedRateLoop(FakeClock(), 0.1, lambda _: True, lambda: None)
    return summarise(account, timer or TickTimer(), loop, {})


def test_a_summary_tells_that_ticks_are_no_longer_rehearsed():
    loop = FixedRateLoop(FakeClock(), 0.1, lambda _: True, lambda: None, prepare=lambda again: None, lead=0.01)
    assert "rehearsal" not in summary_of(account_of(1), loop)["realtime"]
    loop.drop_preparation("it made ticks late")
    summary, screen = summary_of(account_of(1), loop), io.StringIO()
    assert summary["realtime"]["rehearsal"] == "dropped: it made ticks late"
    print_summary(summary, Console(file=screen, width=120))
    assert "rehearsal dropped: it made ticks late" in screen.getvalue()


def test_an_acknowledgement_is_one_of_all_that_had_gone_wrong():
    account = Account()
    watch = FaultWatch(account)
    for kind, text, mode in (
        ("mode", "pressed", "estop"), ("fault", "does not stop", None), ("mode", "acknowledged", "init"),
        ("mode", "bus error", "fault"), ("fault", "gone", None),
    ):  # fmt: skip
        watch.event(Event(1.0, kind, text, {"mode": mode}))
    assert [(fault.why, fault.acknowledged) for fault in account.faults] == [
        ("does not stop", True), ("bus error", False), ("gone", False),
    ]  # fmt: skip
    assert watch.open == list(account.faults)[1:]


def test_of_many_goals_and_faults_the_newest_are_named_and_all_are_counted():
    account = account_of(5, kept=3)
    for k in range(KEPT + 2):
        account.add_fault(f"fault {k}", float(k))
    summary = summary_of(account)
    assert [episode["seed"] for episode in summary["episodes"]] == [2, 3, 4]
    assert summary["ends"] == {"timeout": 1, "goal": 4} and summary["guard"] == {"clipped": 10}
    assert summary["faults"]["count"] == KEPT + 2 and len(summary["faults"]["newest"]) == KEPT
    screen = io.StringIO()
    print_summary(summary, Console(file=screen, width=120))
    assert "4 of 5 goals reached" in screen.getvalue() and "guard: clipped 10" in screen.getvalue()
    assert f"fault {KEPT + 1}" in screen.getvalue() and f"fault {KEPT - 9}" not in screen.getvalue()


def test_the_rate_is_that_of_driving_whatever_lies_between_two_runs():
    clock, left = FakeClock(), iter(range(20))
    timer = TickTimer(stopwatch=clock.now)

    def tick(_: float) -> bool:
        timer.begin()
        index = next(left)
        clock.advance(0.25 if index == 3 else 0.0)  # two deadlines are missed
        timer.end()
        return index % 10 == 9

    loop = FixedRateLoop(clock, 0.1, tick, lambda: None)
    loop.run()
    clock.advance(1000.0)
    loop.run()
    assert (loop.ticks, loop.overruns) == (20, 2)
    assert summary_of(account_of(2), loop, timer)["timing"]["rate"] == pytest.approx(20 / 2.2)


def test_a_disk_that_is_full_already_is_refused_before_anything_moves(run, capsys, monkeypatch):
    """An empty file fits onto it, the summary would not."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr("hiernav.runtime.driver.Driver.run", lambda *_: pytest.fail("it moved"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))  # the kernel refuses more, as a full disk does
    try:
        code = run(*SHORT)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == exits.BAD_INPUT
    assert capsys.readouterr().err == "run_loop: --out: out/summary.json cannot be written: File too large\n"


@pytest.mark.parametrize(
    ("error", "says"), [(MemoryError(), "no memory is left (RLIMIT_AS is "), (ImportError("no matplotlib"), "no mat")]
)
def test_a_picture_that_cannot_be_drawn_changes_no_exit_code(run, tmp_path, capsys, monkeypatch, error, says):
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr(picture.Drive, "draw", failing)
    assert run(*SHORT) == exits.OK
    assert capsys.readouterr().err.startswith(f"run_loop: out/drive-0.png is not written: {says}")


def test_what_has_watched_a_run_and_failed_is_named_in_its_summary(run, tmp_path, capsys, monkeypatch):
    def failing(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("hiernav.runtime.recorder.Recorder.tick", failing)
    assert run(*SHORT, "--no-pictures", "--record", "drive.mcap") == exits.OK
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["dropped_observers"] == {"Recorder": "MemoryError"}
    assert "\ndropped: Recorder, MemoryError\n" in capsys.readouterr().out
    assert run(*SHORT, "--no-pictures") == exits.OK
    assert json.loads((tmp_path / "out/summary.json").read_text())["dropped_observers"] == {}


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (MemoryError(), exits.FAULT, "no memory is left (RLIMIT_AS is "),
        (OSError(errno.EMFILE, "Too many open files"), exits.BAD_INPUT, "Too many open files (RLIMIT_NOFILE is "),
        (BlockingIOError(errno.EAGAIN, "No room"), exits.BAD_INPUT, "No room (RLIMIT_NPROC is "),
        (RuntimeError("can't start new thread"), exits.BAD_INPUT, "can't start new thread (RLIMIT_NPROC is "),
    ],
)
def test_what_the_system_has_no_room_for_is_told_in_one_line_with_limit_and_place(
    run, capsys, monkeypatch, error, code, says
):
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr(drive_main, "load_bundle", failing)
    assert run(*SHORT) == code
    told = capsys.readouterr().err
    assert told.startswith("run_loop: ") and says in told and told.count("\n") == 1
    assert re.search(r", at main\.py:[0-9]+$", told.rstrip()), told


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_json_that_the_disk_did_not_take_is_told(tmp_path):
    with open("/dev/full", "wb") as full:
        command = [sys.executable, RUN_LOOP, *SHORT, "--no-pictures", "--out", tmp_path / "out", "--json", "-"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0
    assert done.stderr.endswith("run_loop: not all of the output was taken: No space left on device\n")


def test_a_signal_that_whoever_started_it_had_blocked_is_heard(run, capsys):
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        run("--tell", "status", "--control", "nobody")
        assert signal.SIGTERM not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def test_how_a_child_has_ended_is_known_also_where_sigchld_was_ignored():
    """Else the planner's keeper fails as soon as its planner ends, and a killed adapter seems to have ended well."""
    program = (
        "import subprocess, sys\nfrom hiernav.runtime.child import leave_signals_to_parent\n"
        "leave_signals_to_parent()\nprint(subprocess.call([sys.executable, '-c', 'raise SystemExit(7)']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGCHLD, signal.SIG_IGN),
    )  # fmt: skip
    assert done.stdout == "7\n"
