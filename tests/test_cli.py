"""Claims about the command line: every bad input is one line that says what to do, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from without_torch import BLOCK

from hiernav import check, cli
from hiernav.config import describe_config, load_config
from hiernav.evaluate import wilson_interval
from hiernav.nav import mirror
from hiernav.nav.bundle import file_sha256, load_bundle

COMMANDS = ("train", "evaluate", "watch", "export", "report", "world", "config")


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Runs a command line that must be refused, in `tmp_path`; returns its one line on stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> str:
        before = contents(tmp_path)
        capsys.readouterr()
        assert cli.main([str(argument) for argument in arguments]) == 2
        line = capsys.readouterr().err
        assert line.endswith("\n") and line.count("\n") == 1, line
        assert line.startswith(f"hiernav {arguments[0]}: ")
        assert contents(tmp_path) == before
        return line

    return run


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() if file.is_file() else b"" for file in folder.rglob("*")}


def write_map(folder: Path, occupied: np.ndarray) -> Path:
    """A map_server map of 0.05 m per pixel; row 0 of `occupied` is the top."""
    rows, cols = occupied.shape
    pixels = np.where(occupied, 0, 254).astype(np.uint8)
    (folder / "hall.pgm").write_bytes(b"P5\n%d %d\n255\n" % (cols, rows) + pixels.tobytes())
    (folder / "hall.yaml").write_text(
        "image: hall.pgm\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return folder / "hall.yaml"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (None, ["robot.yaml: cannot be read: No such file"]),
        ("skill: {tau: 0.1\n", ["robot.yaml:2: malformed YAML", "expected"]),
        ("skill: {num_env: 3}\n", ["robot.yaml: unknown key 'skill.num_env', did you mean 'skill.num_envs'?"]),
        ("skill: {num_envs: many}\n", ["robot.yaml: skill.num_envs = 'many', expected int >= 1"]),
        ("planner: {hypotheses: 17}\n", ["robot.yaml: planner.hypotheses = 17, expected int >= 1 and <= 16"]),
        ("robot: ant\n", ["robot.yaml: robot = 'ant', expected car | doggo | point"]),
        ("skill: {worlds: [maze]}\n", ["robot.yaml: skill.worlds = ['maze'], expected", "pillar(2,2,10)"]),
        ("planner: {worlds: [maze]}\n", ["robot.yaml: planner.worlds = ['maze'], expected", "pillar(2,2,10)"]),
    ],
)
@pytest.mark.parametrize("command", ["train", "config"])
def test_a_configuration_that_cannot_be_used_is_named_by_file_and_key(refused, tmp_path, command, text, parts):
    if text is not None:
        (tmp_path / "robot.yaml").write_text(text)
    line = refused(command, "--config", "robot.yaml")
    for part in parts:
        assert part in line


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("skill.num_envs=0", "command line: skill.num_envs = 0, expected int >= 1"),
        ("skil.tau=1", "command line: unknown key 'skil.tau', did you mean 'skill.tau'?"),
        ("tau", "command line: 'tau', expected key.path=value"),
        ("planner=5", "command line: 'planner' is a section: set a key of it, such as 'planner."),
        ("robot=ant", "command line: robot = 'ant', expected car | doggo | point"),
        (
            "skill.worlds=['pillar(2,2)']",
            "skill.worlds = 'pillar(2,2)': world 'pillar(2,2)': 2 arguments, pillar(W,H,N) takes 3",
        ),
        (
            "skill.worlds=['pillar(0.6,0.6,9)']",
            "skill.worlds = 'pillar(0.6,0.6,9)': .* use fewer obstacles or a larger field",
        ),
        ("planner.planning_radius_m=3", "planner.worlds = 'pillar.*none of 100 layouts .* a smaller robot"),
        ("planner.planning_radius_m=0.05", "planning_radius_m = 0.05, expected at least 0.1, the radius of the point"),
        (
            "skill.worlds=['map(hall.yaml)']",
            "skill.worlds = 'map(hall.yaml)': .*: the map file cannot be read",
        ),
    ],
)
def test_training_refuses_a_setting_before_it_makes_a_folder(refused, override, part):
    line = refused("train", *tiny_run.SETTINGS, override)
    first, *rest = part.split(".*")
    assert first in line and all(piece.strip() in line for piece in rest)


def test_worlds_that_cannot_share_a_simulation_are_refused_for_training_alone(refused, tmp_path):
    write_map(tmp_path, np.zeros((40, 40), dtype=bool))
    settings = [*tiny_run.SETTINGS, "planner.samples=2", "skill.worlds=['map(hall.yaml)', 'pillar(2,2,10)']"]
    line = refused("train", *settings)
    assert "skill.worlds = ['map(hall.yaml)', 'pillar(2,2,10)']: " in line and "the only world of its scene" in line
    assert cli.main(["dataset", "--out", "data", *settings]) == 0


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--stage", "planner", "skill.preset=baseline"], "skill.preset = 'baseline' follows no plan: it has no"),
        (["--stage", "skill", "skill.planner=cnn"], "skill.planner = 'cnn' needs a trained planner: train it first"),
        (["--workers", "8"], "skill.workers = 8, expected with skill.collector = 'multi' or 'ray' only"),
        (["skill.workers=8"], "skill.workers = 8, expected with skill.collector = 'multi' or 'ray' only"),
        (
            ["--collector", "multi", "--workers", "8", "--ray-address", "local"],
            "skill.ray_address = 'local', expected with skill.collector = 'ray' only",
        ),
    ],
)
def test_what_would_be_ignored_or_fail_later_is_refused_before_a_run_folder_is_made(refused, arguments, part):
    assert part in refused("train", "planner.data=nowhere", *arguments)


def test_a_data_set_for_a_robot_that_is_wider_than_its_plans_is_not_begun(refused):
    line = refused("dataset", "--out", "data", *tiny_run.SETTINGS, "planner.planning_radius_m=0.05")
    assert "planner.planning_radius_m = 0.05, expected at least 0.1" in line


@pytest.mark.parametrize(
    "more", [["--config", "robot.yaml"], ["--samples", "5"], ["--world", "pillar(2,2,10)"], ["seed=3"]]
)
def test_what_a_check_of_a_data_set_does_not_look_at_is_refused(refused, more):
    line = refused("dataset", "--out", "data", "--check", *more)
    assert "--check reads what is there: leave out --config, --samples, --world and KEY=VALUE" in line


@pytest.mark.parametrize(("threads", "told"), [(3, 1), (2, 0)])
def test_more_threads_than_processors_are_told_of(tmp_path, monkeypatch, caplog, threads, told):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 5}, raising=False)
    small = ("--samples", "1", "planner.samples_per_world=1", f"threads={threads}")
    assert cli.main(["dataset", "--out", str(tmp_path / "data"), "--world", "pillar(1.2,1.2,2)", *small]) == 0
    monkeypatch.setattr(check, "_check_machine", lambda _: None)  # which needs torch
    check.check_training(load_config(None, [f"threads={threads}"]))
    warning = "threads = 3, but this process may use 2 processors: more threads than that gain no speed and cost memory"
    assert caplog.messages == [warning, warning][: 2 * told]


@pytest.mark.parametrize("command", ["world", "train", pytest.param("evaluate", marks=pytest.mark.train)])
def test_a_map_without_a_way_from_start_to_goal_is_refused(refused, tmp_path, request, command):
    write_map(tmp_path, np.ones((40, 40), dtype=bool))
    world = "map(hall.yaml)"
    if command == "world":
        line = refused("world", "--kind", world, "--png", "out.png")
    elif command == "train":
        line = refused("train", *tiny_run.SETTINGS, f"skill.worlds=['{world}']")
    else:
        bundle = request.getfixturevalue("able_bundle")
        line = refused("evaluate", "--bundle", bundle, "--world", world, "--episodes", 1, "--json", "out.json")
    assert "world map(hall.yaml): no place is free for a robot of radius 0.1 m" in line and "use another map" in line


@pytest.mark.train
def test_a_body_without_a_mirror_is_refused_before_its_planner_is_trained(refused, monkeypatch, tmp_path):
    monkeypatch.delitem(mirror._ROBOTS, "point")
    line = refused("train", *tiny_run.arguments(tmp_path / "run"))
    assert "skill.mirror = true: robot 'point' has no known mirror" in line and "skill.mirror=false" in line
    plain = tiny_run.config(tmp_path / "run", "skill.mirror=false")
    assert check.check_training(plain) == plain
    mirrored = tiny_run.config(tmp_path / "run")
    assert check.check_training(mirrored, "planner") == mirrored, "a planner needs no mirror"


def test_a_map_of_two_rooms_without_a_door_still_gives_tasks_within_a_room(tmp_path, capsys):
    occupied = np.zeros((60, 80), dtype=bool)
    occupied[:, 39:41] = True
    assert cli.main(["world", "--kind", str(write_map(tmp_path, occupied)), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["start"][0] < 1.95) == (shown["goal"][0] < 1.95)


@pytest.mark.parametrize("world", ["maze", "pillar", "pillar(2,2,-1)", "pillar(0.1,2,3)", "pillar(2,x,3)", "none.yaml"])
@pytest.mark.parametrize("command", ["world", "evaluate"])
def test_an_unknown_world_is_refused_with_what_is_accepted(refused, command, world):
    """Before the policies are opened: there are none here."""
    line = refused("world", "--kind", world) if command == "world" else refused(
        "evaluate", "--bundle", "nowhere", "--world", world
    )  # fmt: skip
    assert world in line
    assert any(hint in line for hint in ("accepted are pillar(W,H,N)", "must be between", "cannot be read"))


@pytest.mark.parametrize(("option", "value"), [("--seed", "-1"), ("--radius", "0"), ("--radius", "nan")])
def test_a_world_of_impossible_numbers_is_refused(refused, option, value):
    line = refused("world", option, value)
    assert "must" in line and value in line


@pytest.mark.train
def test_an_existing_run_is_not_overwritten(refused, trained_run, tmp_path):
    shutil.copytree(trained_run, tmp_path / "run")
    line = refused("train", *tiny_run.arguments(Path("run"), "seed=9"))
    assert "run holds a run already: go on with --resume run, or choose another run_dir" in line


@pytest.mark.train
@pytest.mark.parametrize("extra", [["skill.total_steps=9"], ["--config", "robot.yaml"]])
def test_going_on_with_other_settings_is_refused(refused, trained_run, extra):
    line = refused("train", "--resume", trained_run, *extra)
    assert "takes its configuration from the run folder: leave out --config and KEY=VALUE" in line


@pytest.mark.train
def test_a_folder_that_is_no_run_is_refused_wherever_a_run_is_asked_for(refused, tmp_path):
    (tmp_path / "empty").mkdir()
    for folder in ("empty", "absent"):
        assert "is not a run folder: it has no config.yaml" in refused("train", "--resume", folder)
        assert "is not a run folder: it has no config.yaml" in refused("export", "--run", folder, "--onnx", "bundle")
        line = refused("evaluate", "--run", folder, "--json", "out.json")
        assert "neither a run folder" in line or "no such folder" in line


@pytest.mark.train
@pytest.mark.parametrize("missing", ["planner", "skill"])
def test_an_incomplete_run_is_refused_with_how_to_complete_it(refused, trained_run, tmp_path, missing):
    shutil.copytree(trained_run, tmp_path / "run")
    (tmp_path / "run" / missing / "checkpoint.pt").unlink()
    line = refused("export", "--run", "run", "--onnx", "bundle")
    assert f"run has no trained {missing} yet: go on with `hiernav train --resume run`" in line
    line = refused("evaluate", "--run", "run", "--episodes", 1, "--json", "out.json")
    assert ("train the planner first, or use --planner astar" if missing == "planner" else "--resume run`") in line


@pytest.mark.train
def test_a_run_with_a_damaged_checkpoint_is_refused(refused, trained_run, tmp_path):
    shutil.copytree(trained_run, tmp_path / "run")
    checkpoint = tmp_path / "run" / "skill" / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
    for command in (
        ("train", "--resume", "run"),
        ("export", "--run", "run", "--onnx", "b"),
        ("evaluate", "--run", "run"),
    ):
        line = refused(*command)
        assert "skill/checkpoint.pt cannot be read" in line and "restore it, or remove it" in line


@pytest.mark.train
def test_a_bundle_that_must_not_be_used_is_refused(refused, able_bundle, tmp_path):
    bundle = Path(shutil.copytree(able_bundle, tmp_path / "bundle"))
    manifest = json.loads((bundle / "manifest.json").read_text())
    (bundle / "manifest.json").write_text(json.dumps(manifest | {"format_version": 2}))
    line = refused("evaluate", "--bundle", "bundle", "--json", "out.json")
    assert "format_version 2 was made by a newer hiernav" in line and "upgrade hiernav" in line
    (bundle / "manifest.json").write_text(json.dumps(manifest))
    (bundle / "skill.onnx").write_bytes((bundle / "skill.onnx").read_bytes()[:-1])
    assert "skill.onnx: SHA-256 differs" in refused("evaluate", "--bundle", "bundle", "--json", "out.json")
    line = refused("evaluate", "--bundle", able_bundle, "--robot", "car")
    assert "these policies are for robot 'point', not 'car'" in line
    assert "episodes must be at least 1, got 0" in refused("evaluate", "--bundle", able_bundle, "--episodes", 0)
    line = refused("evaluate", "--bundle", able_bundle, "--planner", "astar", "--no-repair")
    assert "--no-repair is for plans of the network, with --planner astar there are none" in line
    assert "--json . is a folder" in refused("evaluate", "--bundle", able_bundle, "--json", ".")


def test_a_world_is_drawn_and_the_seed_decides_it(tmp_path, capsys):
    drawn = []
    for seed, name in ((7, "a.png"), (7, "b.png"), (8, "c.png")):
        file = tmp_path / name
        assert cli.main(["world", "--kind", "four-room", "--seed", str(seed), "--png", str(file)]) == 0
        assert capsys.readouterr().out == f"wrote {file}\n"
        drawn.append(file.read_bytes())
    assert drawn[0].startswith(b"\x89PNG\r\n\x1a\n") and len(drawn[0]) > 5_000
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_world_is_printed_as_json(capsys):
    assert cli.main(["world", "--kind", "gremlin(2,2,4)", "--seed", "7", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["world"], shown["seed"], shown["max_steps"]) == ("gremlin(2,2,4)", 7, 300)
    assert len(shown["gremlins"]) == 4 and shown["pillars"] == shown["walls"] == []
    assert len(shown["start"]) == 3 and len(shown["goal"]) == 2


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main([command, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: hiernav {command}") and "-h, --help" in text
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    overview = capsys.readouterr().out
    assert all(f"\n    {each} " in overview for each in COMMANDS)
    options = {word.strip("[],") for word in text.split() if word.startswith("--")}
    assert options >= {"evaluate": {"--bundle", "--run", "--world", "--json"}, "export": {"--run", "--onnx"}}.get(
        command, set()
    )


@pytest.mark.parametrize("arguments", [[], ["fly"], ["export", "--run", "x"], ["evaluate"], ["world", "--seed", "one"]])
def test_a_command_line_that_makes_no_sense_exits_with_usage(arguments, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    assert left.value.code == 2
    assert "usage: hiernav" in capsys.readouterr().err


def test_config_lists_every_setting_on_a_line_of_its_own(capsys):
    assert cli.main(["config"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for setting in describe_config():
        (line,) = [line for line in lines if line.split()[0] == setting.path]
        assert setting.description in line and setting.type in line


def test_settings_may_stand_between_and_after_options(tmp_path, capsys):
    (tmp_path / "robot.yaml").write_text("robot: car\n")
    assert cli.main(["config", "skill.tau=0.03", "--config", str(tmp_path / "robot.yaml"), "seed=4"]) == 0
    assert {"robot: car", "  tau: 0.03", "seed: 4"} <= set(capsys.readouterr().out.splitlines())
    for arguments in (["config", "seed=4", "--confg", "x"], ["world", "seed=4"]):
        with pytest.raises(SystemExit):
            cli.main(arguments)
        assert "unrecognized arguments" in capsys.readouterr().err


def test_config_resolves_a_file_and_what_overrides_it(tmp_path, capsys):
    (tmp_path / "robot.yaml").write_text("robot: car\nskill: {tau: 0.02, num_envs: 4}\n")
    assert cli.main(["config", "--config", str(tmp_path / "robot.yaml"), "skill.tau=0.03"]) == 0
    (tmp_path / "resolved.yaml").write_text(capsys.readouterr().out)
    resolved = load_config(tmp_path / "resolved.yaml")
    assert resolved == load_config(tmp_path / "robot.yaml", ["skill.tau=0.03"])
    assert (resolved.robot, resolved.skill.tau, resolved.skill.num_envs) == ("car", 0.03, 4)


@pytest.mark.train
def test_training_leaves_a_complete_run(trained_run):
    config = load_config(trained_run / "config.yaml")
    assert config == tiny_run.config(trained_run)
    lines = [json.loads(line) for line in (trained_run / "metrics.jsonl").read_text().splitlines()]
    assert [(line["stage"], line["step"]) for line in lines] == [
        ("planner", 1), ("planner", 2), ("skill", 256), ("skill", 512), ("evaluation", 512), ("skill", 768),
        ("evaluation", 768),
    ]  # fmt: skip
    summary = json.loads((trained_run / "summary.json").read_text())
    assert summary["planner"]["walk_reach_rate"] >= 0.0 and summary["skill"]["reach_rate"] >= 0.0
    assert {"planner/checkpoint.pt", "skill/checkpoint.pt"} <= contents(trained_run).keys()
    assert not list(trained_run.rglob("*.part")) and not (trained_run / "skill" / "replay").exists()


@pytest.mark.train
def test_going_on_with_a_finished_run_changes_nothing(trained_run, tmp_path, capsys):
    run = Path(shutil.copytree(trained_run, tmp_path / "run"))
    before = contents(run)
    assert cli.main(["train", "--resume", str(run)]) == 0
    after = contents(run)
    assert {name for name in after if after[name] != before.get(name)} <= {"summary.json"}  # how long it took
    assert before.keys() == after.keys()
    assert (run / "commits.txt").read_text() == (trained_run / "commits.txt").read_text()
    assert f"hiernav export --run {run} --onnx" in capsys.readouterr().out


@pytest.mark.train
def test_a_run_and_its_bundle_are_evaluated(able_run, able_bundle, tmp_path, capsys):
    world = ["--world", tiny_run.WORLD, "--episodes", "5", "--seed", "4"]
    assert cli.main(["evaluate", "--run", str(able_run), *world, "--json", "-"]) == 0
    from_run = json.loads(capsys.readouterr().out)
    file = tmp_path / "deep" / "results.json"
    two = [*world, "--world", "two-room(1.5,1.5)", "--protocol", "paper", "--robot", "point", "--no-prediction"]
    assert cli.main(["evaluate", "--bundle", str(able_bundle), *two, "--json", str(file)]) == 0
    assert tiny_run.WORLD in capsys.readouterr().out.replace("\n", "")
    from_bundle = json.loads(file.read_text())
    assert list(from_run) == [tiny_run.WORLD] and list(from_bundle) == [tiny_run.WORLD, "two-room(1.5,1.5)"]
    ours, theirs = from_run[tiny_run.WORLD], from_bundle[tiny_run.WORLD]
    assert (ours["reach_rate"], ours["steps_mean"]) == (theirs["reach_rate"], theirs["steps_mean"])
    assert (ours["protocol"], theirs["protocol"]) == ("strict", "paper")
    assert (ours["predict"], theirs["predict"]) == (True, False)
    assert ours["reach_ci95"] == list(wilson_interval(round(5 * ours["reach_rate"]), 5))
    wanted = {
        "reach_rate", "reach_ci95", "steps_mean", "collisions_mean", "collision_free_rate", "spl_mean", "episodes",
        "replans", "spl_unknown", "planner", "repair", "recover", "predict", "period", "invalid",
    }  # fmt: skip
    assert all(row.keys() >= wanted for row in from_bundle.values())
    assert isinstance(ours["return_mean"], float) and theirs["return_mean"] is None
    assert not list(file.parent.glob("*.part"))


@pytest.mark.train
def test_without_torch_bundles_are_evaluated_and_training_says_what_to_install(able_bundle, tmp_path):
    code = f"""
{BLOCK}
from hiernav.cli import main
assert main(["evaluate", "--bundle", {str(able_bundle)!r}, "--world", {tiny_run.WORLD!r}, "--episodes", "2"]) == 0
print("-" * 9, file=sys.stderr)
sys.exit(main(["train", "run_dir=run"]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    line = done.stderr.partition("-" * 9 + "\n")[2]
    assert line == "hiernav train: needs torch: `pip install -e '.[train]'` in the checkout installs it\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.train
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_ctrl_c_and_sigterm_stop_training_with_how_to_go_on_and_going_on_works(tmp_path, capsys, number, code):
    settings = ("skill.num_envs=8", "skill.total_steps=7680", "skill.eval_every_steps=7680")
    run = tmp_path / "run"
    train = start("train", "--stage", "skill", *tiny_run.arguments(run, *settings))
    await_file(run / "skill" / "checkpoint.pt", train)
    train.send_signal(number)
    _, errors = train.communicate(timeout=60)
    assert train.returncode == code, errors
    assert errors.rstrip().splitlines()[-1] == (
        f"stopped; go on from the last checkpoint with: hiernav train --resume {run} --stage skill"
    )
    assert "Traceback" not in errors
    assert cli.main(["train", "--stage", "skill", "--resume", str(run)]) == 0
    assert f"run folder: {run}" in capsys.readouterr().out
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if line["stage"] == "skill"] == list(range(1280, 7681, 1280))
    assert [line["step"] for line in lines if line["stage"] == "evaluation"] == [7680]


@pytest.mark.train
def test_ctrl_c_in_the_middle_of_a_librarys_bookkeeping_is_ctrl_c(tmp_path, capsys, monkeypatch):
    def interrupted(*_: object) -> None:
        try:
            raise KeyboardInterrupt
        finally:
            raise RuntimeError("cannot close what was not opened")

    monkeypatch.setattr("hiernav.skill.train.SkillTrainer.train", interrupted)
    assert cli.main(["train", "--stage", "skill", *tiny_run.arguments(tmp_path / "run")]) == 130
    assert "stopped; there is no checkpoint yet" in capsys.readouterr().err


def test_sigterm_cleans_up_like_ctrl_c(tmp_path, capsys, monkeypatch):
    import hiernav.draw

    def drawing(_layout: object, file: Path) -> None:
        file.write_text("half")
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10.0)
        finally:
            file.unlink()

    monkeypatch.setattr(hiernav.draw, "draw_layout", drawing)
    before = signal.getsignal(signal.SIGTERM)
    assert cli.main(["world", "--png", str(tmp_path / "w.png")]) == 143
    assert capsys.readouterr().err == "interrupted\n"
    assert list(tmp_path.iterdir()) == [] and signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("arguments", [["world", "--kind", "pillar(100,100,2000)"], ["config"], ["config", "seed=1"]])
def test_a_pipe_that_nobody_reads_is_no_bad_input(arguments):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "hiernav", *arguments]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_broken_pipe_elsewhere_is_told(refused, monkeypatch):
    def broken(*_: object) -> None:
        raise BrokenPipeError(32, "a worker is gone")

    monkeypatch.setattr("hiernav.sim.worlds.sample_layout", broken)
    assert "a worker is gone" in refused("world")


@pytest.mark.parametrize("command", ["evaluate", "watch"])
def test_a_negative_seed_is_refused_by_name_and_value(refused, command):
    assert "--seed is -3, it must not be negative" in refused(command, "--bundle", "nowhere", "--seed", -3)


@pytest.mark.train
def test_a_world_that_is_named_twice_is_driven_once(able_bundle, capsys, monkeypatch):
    asked: list[list[str]] = []

    def watched(policies: object, worlds: list[object], *_: object, **__: object) -> dict[str, object]:
        asked.append([str(world) for world in worlds])
        return {}

    monkeypatch.setattr("hiernav.evaluate.evaluate", watched)
    worlds = ["--world", "gremlin", "--world", "two-room", "--world", "gremlin"]
    assert cli.main(["evaluate", "--bundle", str(able_bundle), *worlds, "--json", "-"]) == 0
    assert [text.partition("(")[0] for text in asked[0]] == ["gremlin", "two-room"]


@pytest.mark.parametrize(("option", "folder"), [("--out", "."), ("--out", "results"), ("--curves", ".")])
def test_a_folder_in_the_place_of_a_file_of_the_report_is_refused(refused, tmp_path, option, folder):
    (tmp_path / "results").mkdir()
    assert f"{option} {folder} is a folder: name a file in it" in refused("report", option, folder)


def test_curves_of_a_kind_that_cannot_be_drawn_are_refused_before_the_report_is_made(refused, tmp_path):
    out = tmp_path / "report.html"
    assert "must end in .png, .svg, .pdf" in refused("report", "--out", str(out), "--curves", "curves.xyz")
    assert not out.exists()


@pytest.mark.train
def test_a_data_set_that_is_not_there_leaves_no_run_folder(refused, tmp_path):
    run = tmp_path / "run"
    assert "data" in refused("train", "--stage", "planner", "planner.data=nowhere", f"run_dir={run}")
    assert not run.exists()
    data = ["dataset", "--out", str(tmp_path / "data"), "--world", "pillar(1.2,1.2,2)", "planner.samples=6"]
    assert cli.main(data) == 0
    line = refused("train", "--stage", "planner", f"planner.data={tmp_path / 'data'}", f"run_dir={run}")
    assert "has 6 samples, 60,000 are wanted" in line and not run.exists()


def test_a_baseline_has_no_use_for_a_data_set():
    config = load_config(None, ["skill.preset=baseline", "planner.data=nowhere"])
    assert check._with_worlds_of_data(config, []) is config


def start(*arguments: str) -> subprocess.Popen[str]:
    command: Sequence[str] = (sys.executable, "-m", "hiernav.cli", *arguments)
    # where the tests run in the background of a shell, Ctrl-C is ignored by all that they start
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed)


def await_file(file: Path, process: subprocess.Popen[str], timeout: float = 120.0) -> None:
    end = time.monotonic() + timeout
    while not file.exists():
        if process.poll() is not None or time.monotonic() > end:
            process.kill()
            pytest.fail(f"{file.name} never came: {process.communicate()}")
        time.sleep(0.01)


WORLDLESS = [text for text in tiny_run.SETTINGS if ".worlds=" not in text]


@pytest.mark.train
@pytest.mark.parametrize(
    ("stage", "trained"), [("planner", {"planner"}), ("skill", {"skill"}), ("all", {"planner", "skill"})]
)
def test_worlds_on_the_command_line_are_those_of_what_is_trained(tmp_path, monkeypatch, stage, trained):
    monkeypatch.setattr("hiernav.training.train", lambda *_: None)
    run = tmp_path / "run"
    assert cli.main(["train", "--stage", stage, "--worlds", "two-room", *WORLDLESS, f"run_dir={run}"]) == 0
    config, default = load_config(run / "config.yaml"), load_config()
    assert config.planner.worlds == (("two-room",) if "planner" in trained else default.planner.worlds)
    assert config.skill.worlds == (("two-room",) if "skill" in trained else default.skill.worlds)


@pytest.mark.train
def test_a_mix_of_worlds_is_for_the_planner_and_what_is_spelled_out_goes_before(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("hiernav.training.train", lambda *_: None)
    mix = ["train", "--worlds", "2*two-room(2..4,2..4)", *WORLDLESS]
    assert "a mix is for the planner alone: say skill.worlds=[...] too" in refused(*mix)
    assert cli.main([*mix, "skill.worlds=['gremlin']", "run_dir=run"]) == 0
    config = load_config(tmp_path / "run" / "config.yaml")
    assert (config.planner.worlds, config.skill.worlds) == (("2*two-room(2..4,2..4)",), ("gremlin",))


@pytest.mark.train
def test_a_planner_that_learns_from_a_data_set_says_so_with_the_worlds_of_that(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("hiernav.training.train", lambda *_: None)
    settings = [*tiny_run.SETTINGS, "planner.samples=12"]
    assert cli.main(["dataset", "--out", "data", "--samples", "12", "--world", "pillar(1.5,1.5,1)", *settings]) == 0
    assert cli.main(["train", *settings, "planner.data=data", "run_dir=run"]) == 2  # SETTINGS have worlds of their own
    settings = [text for text in settings if not text.startswith("planner.worlds")]
    assert cli.main(["train", *settings, "planner.data=data", "run_dir=run"]) == 0
    assert load_config(tmp_path / "run" / "config.yaml").planner.worlds == ("pillar(1.5,1.5,1)",)
    line = refused("train", *settings, "planner.data=data", "planner.worlds=['four-room']")
    assert "planner.worlds = ['four-room'], but planner.data = 'data' was made in ['pillar(1.5,1.5,1)']" in line


@pytest.mark.train
@pytest.mark.parametrize(
    ("stage", "made", "end"),
    [
        ("planner", ["planner"], "done; train the skill with: hiernav train --resume {run} --stage skill"),
        ("skill", ["skill"], "done; train the planner with: hiernav train --resume {run} --stage planner"),
        ("all", ["planner", "skill"], "done; export with: hiernav export --run {run} --onnx"),
    ],
)
def test_a_training_ends_with_what_to_do_next(tmp_path, capsys, monkeypatch, stage, made, end):
    run = tmp_path / "run"

    def trained(*_: object) -> None:
        for name in made:
            (run / name).mkdir()
            (run / name / "checkpoint.pt").touch()

    monkeypatch.setattr("hiernav.training.train", trained)
    assert cli.main(["train", "--stage", stage, *tiny_run.arguments(run)]) == 0
    assert capsys.readouterr().out.endswith(end.format(run=run) + "\n")


@pytest.mark.train
def test_stages_that_are_finished_are_not_trained_on_and_say_so(trained_run, capsys):
    for stage, also in (("planner", "skill"), ("skill", "planner")):
        assert cli.main(["train", "--resume", str(trained_run), "--stage", stage]) == 0
        told = capsys.readouterr().err
        assert f"{stage}: finished already; to train for longer, begin a new run" in told and also not in told


@pytest.mark.train
def test_a_training_that_is_stopped_before_its_first_checkpoint_says_that_it_begins_again(
    tmp_path, capsys, monkeypatch
):
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hiernav.training.train", stopped)
    assert cli.main(["train", *tiny_run.arguments(tmp_path / "run")]) == 130
    told = f"stopped; there is no checkpoint yet, begin it again with: hiernav train --resume {tmp_path / 'run'}\n"
    assert capsys.readouterr().err.lstrip() == told


def test_defaults_are_listed_as_they_are_written(capsys):
    assert cli.main(["config"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    for key, default in (
        ("skill.alpha_fall", "[0.5, 1.0]"),
        ("skill.stop_reach_rate", "null"),
        ("skill.mirror", "true"),
    ):
        assert f" {default} " in lines[key]
        load_config(None, [f"{key}={default}"])


@pytest.mark.parametrize(
    ("given", "right"),
    [
        ("planner.worlds=two-room", ["two-room"]),
        ("planner.worlds='pillar(2,2,10)'", ["pillar(2,2,10)"]),
        ("planner.worlds=two-room,pillar(2,2,10)", ["two-room", "pillar(2,2,10)"]),
        ("skill.hidden=128,128", [128, 128]),
        ("skill.total_steps=1e5", 100_000),
    ],
)
def test_a_value_of_nearly_the_right_type_is_told_how_it_is_written_in_a_shell(refused, given, right):
    (hint,) = shlex.split(refused("config", given).partition("; write ")[2])
    (section, _, key), value = hint.partition("=")[0].partition("."), right
    found = getattr(getattr(load_config(None, [hint]), section), key)
    assert (list(found) if isinstance(right, list) else found) == value


def test_an_unknown_option_is_told_with_the_options_of_its_command(capsys):
    with pytest.raises(SystemExit):
        cli.main(["evaluate", "--bundle", "b", "--worlds", "gremlin"])
    assert capsys.readouterr().err.startswith("usage: hiernav evaluate ")


def test_a_picture_of_a_world_is_a_png(refused):
    assert "--png world.txt must end in .png" in refused("world", "--png", "world.txt")


def test_an_evaluation_says_whose_it_is(tmp_path, capsys):
    bundle = Path(__file__).parents[1] / "deploy" / "bundles" / "point"
    arguments = ["evaluate", "--bundle", str(bundle), "--world", "pillar(1.2,1.2,2)", "--episodes", "1", "--json", "-"]
    assert cli.main(arguments) == 0
    row = json.loads(capsys.readouterr().out)["pillar(1.2,1.2,2)"]
    assert row["policies"] == str(bundle)
    files = load_bundle(bundle).manifest.files
    assert row["sha256"] == {name: files[name] for name in ("planner.onnx", "skill.onnx")} | {
        "manifest.json": file_sha256(bundle / "manifest.json")
    }
