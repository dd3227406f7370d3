"""The account of a run of deploy/run_loop.py: shown first, saved in one piece, never in the way of the exit code."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from run_loop_script import load_script
from shipped import RUN_LOOP

from hiernav.runtime.driver import Driver
from hiernav.runtime.robot import RobotGone
from hiernav.runtime.sim_robot import SimRobot

script = load_script()
SHORT = ["--fast", "--world", "pillar(2,2,0)", "--set", "driver.max_steps=3"]
FAULTY = [*SHORT, "--robot", "doggo", "--set", "guard.tilt_limit=0.001"]


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
    monkeypatch.setattr(script.Drive, "draw", full)
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

    monkeypatch.setattr(script.Drive, "draw", interrupted)
    assert run(*FAULTY) == script.FAULT
    assert "0 of 1 goals reached" in capsys.readouterr().out
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["summary.json"]


def driven(folder: Path) -> list[str]:
    return [episode["reason"] for episode in json.loads((folder / "out/summary.json").read_text())["episodes"]]


def test_a_signal_between_two_worlds_costs_nothing_of_what_was_driven(run, tmp_path, monkeypatch):
    episode = script.Episodes._episode
    monkeypatch.setattr(
        script.Episodes, "_episode", lambda *given: signal.raise_signal(signal.SIGTERM) or episode(*given)
    )
    assert run(*SHORT, "--episodes", "3") == 0
    assert driven(tmp_path) == ["timeout"]


def test_a_signal_just_before_a_world_is_driven_keeps_the_robot_from_moving(run, tmp_path, monkeypatch):
    begin, begun = Driver._begin, []

    def begin_late(driver: Driver) -> None:
        begin(driver)
        begun.append(driver)
        if len(begun) == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Driver, "_begin", begin_late)
    assert run(*SHORT, "--episodes", "3") == 0
    assert driven(tmp_path) == ["timeout", "interrupted"] and begun[0].loop.ticks == 4


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
    assert run(*SHORT, "--episodes", "5", "--no-pictures") == script.FAULT
    assert driven(tmp_path) == ["timeout", "timeout"] and begun[-1] == 2
    assert capsys.readouterr().err == "run_loop: the robot's adapter ended with status -9\n"


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
        monkeypatch.setattr(script, "report", lambda *_: {"bundle": {"robot": "point"}})
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
