"""Claims about deploy/run_loop.py: it drives without torch, repeats itself, refuses what does not fit, and stops."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import tiny_run
from without_torch import BLOCK

from hiernav.drive import main as drive_main
from hiernav.drive.arguments import make_parser, settings_of
from hiernav.drive.exits import FAULT
from hiernav.drive.screen import new_folder
from hiernav.runtime import dry_run, process_robot
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout

SCRIPT = Path(__file__).parents[1] / "deploy" / "run_loop.py"
RUN_SCRIPT = """
import runpy
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
pytestmark = pytest.mark.train  # the bundles that are driven here are made with torch


def command(*arguments: object) -> Sequence[str]:
    """Command line of a process in which importing torch fails."""
    return [sys.executable, "-c", BLOCK + RUN_SCRIPT, str(SCRIPT), *map(str, arguments)]


@pytest.fixture(scope="module")
def drives(able_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, str]]:
    """The same two episodes driven twice, each time in a process of its own; folder and screen of each."""
    done = []
    for name in ("first", "second"):
        out = tmp_path_factory.mktemp("drives") / name
        ended = subprocess.run(
            command("--fast", "--bundle", able_bundle, "--world", tiny_run.WORLD, "--episodes", 2, "--seed", 5,
                    "--out", out, "--json", out.with_suffix(".json")),
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert ended.returncode == 0, ended.stderr
        done.append((out, ended.stdout))
    return done


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("run_loop", SCRIPT)
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    return module


@pytest.fixture
def refused(script: ModuleType, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Callable[..., str]:
    """Runs a command line that must be refused with `code`; returns its one line on stderr."""

    def run(code: int, *arguments: object) -> str:
        out = tmp_path / "out"
        assert script.main([*map(str, arguments), "--fast", "--out", str(out)]) == code
        line = capsys.readouterr().err
        assert line.startswith("run_loop: ") and line.count("\n") == 1, line
        assert not out.exists()
        return line

    return run


def test_a_simulated_robot_passes_the_dry_run(script, capsys, monkeypatch):
    monkeypatch.setattr(dry_run, "LOOK", 0.3)
    monkeypatch.setattr(dry_run, "WAKES", 1)
    assert script.main(["--dry-run", "--bundle", str(SCRIPT.parent / "bundles" / "point")]) == 0
    out = capsys.readouterr().out
    assert "│ error" not in out and "guard.slow_ttc" in out  # a setting of point.yaml


def test_a_robot_that_does_not_end_fails_the_dry_run(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(process_robot, "CLOSING", 0.2)
    monkeypatch.setattr(dry_run, "LOOK", 0.3)
    monkeypatch.setattr(dry_run, "WAKES", 1)
    adapter = tmp_path / "stuck.py"
    example = str(SCRIPT.parent)
    adapter.write_text(
        f"import sys, time\nsys.path.insert(0, {example!r})\nimport example_robot\n"
        "def make():\n    robot = example_robot.make()\n    robot.close = lambda: time.sleep(600.0)\n    return robot\n"
    )
    bundle = str(SCRIPT.parent / "bundles" / "point")
    asked = ["--dry-run", "--bundle", bundle, "--adapter", f"{adapter}:make", "--json", "-"]
    assert drive_main.main(asked, "", SCRIPT.parent) == FAULT
    assert "did not end, and was killed" in json.loads(capsys.readouterr().out)["robot"]["error"]


def test_two_runs_of_the_same_second_have_folders_of_their_own(script, tmp_path):
    folders = [new_folder(tmp_path / "runs", "drive-now") for _ in range(3)]
    assert [folder.name for folder in folders] == ["drive-now", "drive-now-2", "drive-now-3"]
    assert all(folder.is_dir() for folder in folders)


def stopped_pipe() -> tuple[int, int]:
    """Ends to read and to write of a pipe that has no room."""
    return full(*os.pipe())


def stopped_terminal() -> tuple[int, int]:
    """The same of a terminal that has room for a few bytes."""
    reader, writer = os.openpty()
    full(reader, writer)
    os.read(reader, 100)
    return reader, writer


def full(reader: int, writer: int) -> tuple[int, int]:
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, b"x" * 512)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, b"x")
    os.set_blocking(writer, True)
    return reader, writer


def end(run: subprocess.Popen[bytes]) -> int:
    """Ask for the end again and again; the exit code."""
    deadline = time.monotonic() + 60.0
    try:
        while run.poll() is None and time.monotonic() < deadline:
            run.send_signal(signal.SIGTERM)
            time.sleep(0.2)
        assert run.poll() is not None, "it waits for its reader"
        return run.returncode
    finally:
        run.kill()
        run.wait()


@pytest.mark.parametrize("stopped", [stopped_pipe, stopped_terminal])
def test_a_reader_that_has_stopped_holds_up_neither_the_end_nor_the_summary(tmp_path, stopped):
    reader, writer = stopped()
    out, bundle = tmp_path / "out", SCRIPT.parent / "bundles" / "point"
    run = subprocess.Popen(command("--fast", "--no-pictures", "--bundle", bundle, "--out", out), stdout=writer,
                           stderr=writer, cwd=tmp_path)  # fmt: skip
    while not out.exists() and run.poll() is None:
        time.sleep(0.05)
    assert end(run) == 0 and (out / "summary.json").exists()
    os.close(reader)
    os.close(writer)


def test_the_end_of_a_command_without_a_loop_is_held_up_by_no_reader_either(tmp_path):
    reader, writer = stopped_pipe()
    with socket.socket(socket.AF_UNIX) as loop:
        loop.bind(str(tmp_path / "socket"))
        loop.listen()
        run = subprocess.Popen(command("--tell", "status", "--control", tmp_path / "socket"), stdout=writer)
        client, _ = loop.accept()
        client.sendall(b'{"mode": "ready"}\n')
        client.close()
    time.sleep(0.5)
    assert end(run) == 0
    os.close(reader)
    os.close(writer)


def summary_of(drive: tuple[Path, str]) -> dict[str, Any]:
    return json.loads((drive[0] / "summary.json").read_text())


def test_a_robot_without_torch_drives_to_its_goals(drives):
    summary = summary_of(drives[0])
    assert [episode["seed"] for episode in summary["episodes"]] == [5, 6]
    for episode in summary["episodes"]:
        assert episode["reached"] and episode["reason"] == "goal"
        assert 5 < episode["steps"] < 180 and episode["collisions"] >= 0
        assert episode["stopped"] and episode["fault"] is None
        assert episode["true_distance"] == pytest.approx(episode["distance"], abs=0.1)  # reached by the estimate
        assert episode["seconds"] == pytest.approx(0.02 * episode["steps"], abs=0.05)
    assert summary["replans"] == {
        reason: sum(episode["replans"].get(reason, 0) for episode in summary["episodes"])
        for reason in summary["replans"]
    }
    assert summary["replans"]["start"] == 2


def test_the_summary_accounts_for_every_tick(drives):
    summary = summary_of(drives[0])
    timing = summary["timing"]
    assert timing["period"] == pytest.approx(0.02)
    assert timing["ticks"] >= sum(episode["steps"] for episode in summary["episodes"])
    assert timing["rate"] > 0 and timing["overruns"] >= 0
    for part in ("lateness", "tick"):
        assert 0.0 <= timing[part]["p50"] <= timing[part]["p99"] <= timing[part]["max"]
    assert timing["tick"]["max"] > 0.0
    assert timing["tick"]["count"] == timing["ticks"]
    assert set(timing["sections"]) == {"read", "estimate", "plan", "infer", "guard", "send"}
    assert timing["sections"]["plan"]["count"] == sum(summary["replans"].values())
    assert summary["realtime"] == {}


def test_pictures_and_json_are_left_in_the_folder(drives):
    out, screen = drives[0]
    assert {file.name for file in out.iterdir()} == {"summary.json", "drive-5.png", "drive-6.png"}
    for file in out.glob("*.png"):
        assert file.read_bytes().startswith(b"\x89PNG") and file.stat().st_size > 10_000
    assert out.with_suffix(".json").read_text() == (out / "summary.json").read_text()
    assert "2 of 2 goals reached" in screen and "run folder: " in screen


def test_the_same_seed_gives_the_same_drive(drives):
    first, second = map(summary_of, drives)
    assert first["episodes"] == second["episodes"] and first["replans"] == second["replans"]
    assert (drives[0][0] / "drive-5.png").read_bytes() == (drives[1][0] / "drive-5.png").read_bytes()


def test_a_goal_of_ones_own_is_driven_to(script, able_bundle, tmp_path, capsys):
    layout = sample_layout(parse_world("pillar(1.2,1.2,0)"), 3)
    goal = -0.8 * np.sign(layout.start[:2])
    arguments = ["--fast", "--bundle", str(able_bundle), "--world", "pillar(1.2,1.2,0)", "--seed", "3", "--no-pictures"]
    assert (
        script.main([*arguments, "--goal", f"{goal[0]:g},{goal[1]:g}", "--exact", "--out", str(tmp_path / "out")]) == 0
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["episodes"][0]["reached"] and summary["episodes"][0]["true_distance"] < 0.6
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["summary.json"]
    assert "goal after" in capsys.readouterr().out


MODES = pytest.mark.parametrize("mode", [[], ["--dry-run"]], ids=["drive", "dry-run"])


@MODES
@pytest.mark.parametrize("goal", ["1", "a,b", "1,2,3", "nan,0", "inf,0", "", "-1;2"])
def test_a_malformed_goal_is_refused(refused, able_bundle, goal, mode):
    line = refused(2, "--bundle", able_bundle, "--goal", goal, *mode)
    assert f"--goal {goal!r}: expected X,Y in metres, for example 1.2,-0.5" in line


@MODES
def test_a_goal_outside_the_field_is_refused_with_its_extent(refused, able_bundle, mode):
    line = refused(4, "--bundle", able_bundle, "--world", "pillar(2,1.5,2)", "--goal", "-2.5,0", *mode)
    assert "--goal -2.5,0 lies outside the field: x from -2 to 2, y from -1.5 to 1.5 m" in line


@MODES
def test_a_goal_inside_an_obstacle_is_refused_with_where_to_look(refused, able_bundle, mode):
    x, y = sample_layout(parse_world("pillar(2,2,10)"), 4).pillars[0]
    line = refused(4, "--bundle", able_bundle, "--seed", 4, "--goal", f"{x:.3f},{y:.3f}", *mode)
    where = "is less than 0.1 m from an obstacle in pillar(2,2,10), seed 4"
    assert f"{where}: choose a free place (hiernav world --png draws the world)" in line


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--robot", "ant"], "unknown robot 'ant'; accepted: point, car, doggo"),
        (["--world", "maze"], "world 'maze': unknown; accepted are pillar(W,H,N)"),
        (["--world", "hall.yaml"], "the map file cannot be read"),
        (["--world", "pillar(1,1,300)"], "use fewer obstacles or a larger field"),
        (["--episodes", "0"], "--episodes is 0, it must be at least 1"),
        (["--seed", "-1"], "seed -1, it must not be negative"),
    ],
)
def test_what_cannot_be_driven_is_refused(refused, able_bundle, arguments, part):
    assert part in refused(2, "--bundle", able_bundle, *arguments)


@pytest.mark.parametrize("name", ["planner.onnx", "skill.onnx", "golden.npz"])
def test_an_altered_bundle_is_never_driven(refused, able_bundle, tmp_path, name):
    bundle = Path(shutil.copytree(able_bundle, tmp_path / "bundle"))
    data = bytearray((bundle / name).read_bytes())
    data[-1] ^= 255
    (bundle / name).write_bytes(data)
    assert f"bundle refused: {name}: SHA-256 differs from the manifest" in refused(3, "--bundle", bundle)


def test_a_bundle_that_does_not_fit_is_refused(refused, able_bundle, doggo_bundle, tmp_path):
    assert "robot: the bundle is for 'doggo', this is 'point'" in refused(3, "--bundle", doggo_bundle)
    assert "robot: the bundle is for 'point', this is 'doggo'" in refused(
        3, "--bundle", able_bundle, "--robot", "doggo"
    )
    assert "no such folder" in refused(3, "--bundle", tmp_path / "absent")
    bundle = Path(shutil.copytree(able_bundle, tmp_path / "bundle"))
    manifest = json.loads((bundle / "manifest.json").read_text())
    (bundle / "manifest.json").write_text(json.dumps(manifest | {"format_version": 2}))
    assert "made by a newer hiernav" in refused(3, "--bundle", bundle)
    manifest["observation"][0]["unit"] = "g"
    (bundle / "manifest.json").write_text(json.dumps(manifest))
    assert "observation[0] 'accelerometer': unit is 'g' in the bundle" in refused(3, "--bundle", bundle)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("control_period_s", 0.05, "control_period_s: 0.05 s in the bundle, 0.02 s on this robot"),
        ("map_resolution_m", 0.1, "map_resolution_m: 0.1 m in the bundle, 0.05 m in the runtime"),
    ],
)
def test_a_bundle_of_another_rate_or_resolution_is_refused(refused, able_bundle, tmp_path, field, value, says):
    bundle = Path(shutil.copytree(able_bundle, tmp_path / "bundle"))
    manifest = json.loads((bundle / "manifest.json").read_text())
    (bundle / "manifest.json").write_text(json.dumps(manifest | {field: value}))
    assert says in refused(3, "--bundle", bundle)


def test_an_adapter_of_another_rate_is_refused_before_it_is_driven(script, able_bundle, tmp_path, capsys):
    adapter = tmp_path / "slow.py"
    tests = str(Path(__file__).parent / "runtime")
    adapter.write_text(f"import sys\nsys.path.insert(0, {tests!r})\nfrom puck import Puck\nmake = Puck\n")
    arguments = ["--bundle", str(able_bundle), "--adapter", f"{adapter}:make", "--out", str(tmp_path / "out")]
    assert script.main([*arguments, "--world", "pillar(2,2,10)", "--goal", "0,0"]) == 3
    assert "control_period_s: 0.02 s in the bundle, 0.1 s on this robot" in capsys.readouterr().err
    assert script.main([*arguments, "--dry-run"]) == 1
    assert "0.1 s on this robot" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        ([], "--world"),
        (["--goal", "1,1"], "--world"),
        (["--serve"], "--world"),
        (["--world", "pillar(2,2,0)"], "--goal"),
    ],
)
def test_a_real_robot_is_driven_nowhere_that_nobody_named(script, tmp_path, capsys, monkeypatch, arguments, missing):
    monkeypatch.setattr(drive_main, "_run", lambda _: pytest.fail("it was begun"))
    assert script.main(["--adapter", "my_robot.py:make", *arguments, "--out", str(tmp_path)]) == 2
    assert f"--adapter moves a real robot: name {'the map' if missing == '--world' else 'its --goal'}" in (
        capsys.readouterr().err
    )


def test_settings_that_are_accepted_are_obeyed(script, able_bundle, tmp_path):
    made: list[object] = []

    class Watched(drive_main.Episodes):
        def drive(self) -> int:
            made.append(self.driver)
            return super().drive()

    drive_main.Episodes, before = Watched, drive_main.Episodes
    try:
        asked = {"driver.goal_radius": 0.2, "driver.max_steps": 7, "driver.robot_radius": 0.12, "guard.slew_limit": 0.3}
        settings = [text for key, value in asked.items() for text in ("--set", f"{key}={value}")]
        out = tmp_path / "out"
        arguments = ["--fast", "--bundle", str(able_bundle), "--no-pictures", "--out", str(out), *settings]
        script.main(arguments)
    finally:
        drive_main.Episodes = before
    driver = made[0]
    option = driver.pilot.agent.option
    assert (driver.config.goal_radius, option.goal_radius) == (0.2, 0.2)
    assert (driver.config.robot_radius, option.sweep_radius) == (0.12, 0.12)
    assert driver.guard.config.slew_limit == 0.3
    assert json.loads((out / "summary.json").read_text())["episodes"][0]["steps"] == 7


def test_ctrl_c_brakes_and_still_writes_the_summary(able_bundle, tmp_path):
    """Sent once the first of three drives has ended, while the second one is on its way."""
    field = parse_world("pillar(4,4,0)")
    away = [float(np.linalg.norm(x.start[:2] - x.goal)) for x in (sample_layout(field, seed) for seed in range(200))]
    seed = next(k for k in range(199) if away[k] < 1.2 and away[k + 1] > 5.0)
    process = subprocess.Popen(
        command("--realtime", "--bundle", able_bundle, "--world", field, "--seed", seed, "--episodes", 3,
                "--out", tmp_path),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        first = process.stdout.readline()  # type: ignore[union-attr]
        assert first.startswith(f"seed {seed}: "), process.communicate()[1]
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.5)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, output + errors
    assert "Traceback" not in errors
    episodes = json.loads((tmp_path / "summary.json").read_text())["episodes"]
    assert [episode["reason"] for episode in episodes][1:] == ["interrupted"]
    assert episodes[1]["stopped"] and not episodes[1]["reached"] and episodes[1]["fault"] is None
    assert {file.name for file in tmp_path.iterdir()} == {"summary.json", f"drive-{seed}.png", f"drive-{seed + 1}.png"}


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        ({"mode": "running"}, 0),
        ({"error": "unknown command"}, 2),
        ({"mode": "running", "taken": False, "error": "the loop stands"}, 1),
        ({"mode": "ready", "refused": "goal_outside", "error": "outside"}, 4),
    ],
)
def test_what_a_loop_answers_is_printed_and_decides_the_exit_code(script, monkeypatch, capsys, answer, code):
    monkeypatch.setattr(drive_main, "tell", lambda path, line: answer)
    assert script.main(["--tell", "goal 50,50"]) == code
    assert json.loads(capsys.readouterr().out) == answer


def test_a_file_of_settings_takes_nothing_away_from_the_robot_s_own(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("estimator: {gyro_sigma: 0.05}\n")
    asked = ["--robot", "doggo", "--world", "gremlin", "--settings", str(own)]
    settings = settings_of(make_parser("", SCRIPT.parent).parse_args(asked), get_robot("doggo"))
    assert settings.estimator.gyro_sigma == 0.05 and settings.guard.tilt_limit == 1.31


@pytest.mark.parametrize(("robot", "limit"), [("doggo", 1.31), ("car", 1.31), ("point", None)])
def test_a_robot_that_can_fall_has_a_limit_of_its_tilt_also_where_its_file_is_missing(tmp_path, robot, limit):
    """The script may have been copied alone."""
    asked = ["--world", "gremlin", "--robot", robot, "--set", "guard.slew_limit=0.3"]
    settings = settings_of(make_parser("", tmp_path).parse_args(asked), get_robot(robot))
    assert (settings.guard.tilt_limit, settings.guard.slew_limit) == (limit, 0.3)


@pytest.mark.parametrize("mode", ["--fast", "--dry-run"])
def test_a_robot_that_can_fall_is_not_driven_without_a_limit_of_its_tilt(refused, doggo_bundle, mode):
    line = refused(2, "--robot", "doggo", "--bundle", doggo_bundle, "--set", "guard.tilt_limit=null", mode)
    assert "guard.tilt_limit is null: a doggo can fall" in line


def test_a_fault_ends_its_episode_and_not_the_run(script, doggo_bundle, tmp_path):
    file = tmp_path / "out.json"
    arguments = ["--fast", "--robot", "doggo", "--bundle", str(doggo_bundle), "--episodes", "2", "--no-pictures"]
    arguments += ["--set", "guard.tilt_limit=0.001"]
    assert script.main([*arguments, "--out", str(tmp_path / "run"), "--json", str(file)]) == FAULT
    episodes = json.loads(file.read_text())["episodes"]
    assert [episode["reason"] for episode in episodes] == ["fault", "fault"]
    assert all("tilted" in episode["fault"] for episode in episodes)
