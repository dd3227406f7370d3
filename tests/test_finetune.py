"""Fine-tuning teaches the planner other worlds, from a run or a bundle alike, and leaves the skill as it is."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")

from hiernav import cli  # noqa: E402
from hiernav.config import load_config  # noqa: E402
from hiernav.export import export_run, write_bundle  # noqa: E402
from hiernav.finetune import begin_fine_tuning, fine_tuning_config  # noqa: E402
from hiernav.nav.bundle import load_bundle  # noqa: E402
from hiernav.planner import train as planner_train  # noqa: E402
from hiernav.planner.network import make_network  # noqa: E402
from hiernav.run import Run, RunError  # noqa: E402
from hiernav.skill.train import make_learner  # noqa: E402

pytestmark = pytest.mark.train
OTHER = "pillar(1.5,1.5,3)"


@pytest.fixture(autouse=True)
def few_walks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner_train, "_WALKS", 3)


def command(source: Path, run_dir: Path, *more: str) -> list[str]:
    arguments = ["train", "--stage", "planner", "--from", str(source), "--worlds", OTHER, f"run_dir={run_dir}"]
    return [*arguments, "planner.samples=48", "planner.epochs=2", "planner.samples_per_world=12", *more]


@pytest.mark.parametrize("kind", ["run", "bundle"])
def test_the_planner_learns_and_the_skill_stays_what_it_was(
    able_run: Path, able_bundle: Path, tmp_path: Path, kind: str
):
    source = able_run if kind == "run" else able_bundle
    assert cli.main(command(source, tmp_path / "tuned")) == 0
    run = Run.open(tmp_path / "tuned")
    assert run.config.planner.worlds == (OTHER,)
    before, after = Run.open(able_run).load("planner")["network"], run.load("planner")["network"]
    assert before.keys() == after.keys() and not all(torch.equal(before[key], after[key]) for key in before)
    ours, theirs = (load_bundle(folder) for folder in (export_run(run.path, tmp_path / "bundle"), able_bundle))
    for name, action in ((name, golden) for name, golden in ours.golden.items() if name in ("observation", "action")):
        assert action.shape == theirs.golden[name].shape
    skill = Run.open(able_run).load("skill")["best_actor"]
    assert all(torch.equal(skill[key], value) for key, value in run.load("skill")["best_actor"].items())
    assert ours.manifest.skill == theirs.manifest.skill


def test_the_planner_of_a_bundle_goes_on_learning_by_its_preset(doggo_bundle: Path, able_bundle: Path):
    paper = fine_tuning_config(doggo_bundle, []).planner
    assert (paper.preset, paper.hypotheses, paper.mirror) == ("paper", 1, False)
    assert (paper.clearance_weight, paper.heading_weight, paper.weight_decay) == (0.0, 0.0, 0.0)
    ours, default = fine_tuning_config(able_bundle, []).planner, load_config().planner
    assert (ours.preset, ours.mirror, ours.heading_weight) == ("default", default.mirror, default.heading_weight)


def test_folder_data_and_length_of_a_fine_tuning_are_its_own_and_all_else_is_the_sources(tmp_path: Path):
    theirs = tiny_run.config(tmp_path / "source", f"planner.data={tmp_path / 'data'}", "planner.weight_decay=0.5")
    source = Run.create(theirs).path
    ours = fine_tuning_config(source, [])
    assert (ours.run_dir, ours.planner.data) == (None, None)
    assert (ours.planner.samples, ours.planner.epochs, ours.planner.learning_rate) == (20_000, 4, 3e-4)
    kept = ("worlds", "preset", "hypotheses", "batch_size", "weight_decay", "samples_per_world")
    assert all(getattr(ours.planner, name) == getattr(theirs.planner, name) for name in kept)
    assert (ours.robot, ours.seed, ours.option, ours.skill) == (theirs.robot, theirs.seed, theirs.option, theirs.skill)
    assert fine_tuning_config(source, ["planner.epochs=9"]).planner.epochs == 9


def test_what_is_known_of_a_skill_goes_on_from_bundle_to_bundle(able_bundle: Path, tmp_path: Path):
    config = fine_tuning_config(able_bundle, [f"run_dir={tmp_path / 'tuned'}"])
    skill = begin_fine_tuning(config, able_bundle).load("skill")
    known = load_bundle(able_bundle).manifest.provenance
    assert known["skill_steps"] > 0 and known["skill_updates"] > 0
    assert (skill["steps"], skill["learner"]["updates"]) == (known["skill_steps"], known["skill_updates"])
    assert [entry["reach_rate"] for entry in skill["evaluations"]] == [known["skill_reach_rate"]]
    assert skill["evaluations"][0]["step"] == known["skill_steps"]


def test_a_fine_tuned_bundle_tells_that_it_is_one_and_which_code_trained_what_it_came_from(able_run, tmp_path):
    source = Run.open(shutil.copytree(able_run, tmp_path / "source"))
    source.note_code("abc")
    source.close()
    assert cli.main(command(source.path, tmp_path / "tuned")) == 0
    assert cli.main(["export", "--run", str(tmp_path / "tuned"), "--onnx", str(tmp_path / "bundle")]) == 0
    told = load_bundle(tmp_path / "bundle").manifest.provenance
    assert told["code"].startswith(", ".join(source.codes())) and "abc" in source.codes()
    assert "settings" not in told and "planner.samples" in str(told["fine_tuned_with"])
    config = fine_tuning_config(tmp_path / "bundle", [f"run_dir={tmp_path / 'again'}"])
    assert begin_fine_tuning(config, tmp_path / "bundle").codes() == str(told["code"]).split(", ")


@pytest.mark.parametrize("stage", ["planner", "skill"])
def test_a_run_that_lacks_a_network_is_told_to_go_on(able_run: Path, tmp_path: Path, stage: str):
    source = Path(shutil.copytree(able_run, tmp_path / "source"))
    shutil.rmtree(source / stage)
    config = fine_tuning_config(source, [f"run_dir={tmp_path / 'tuned'}"])
    with pytest.raises(RunError, match=f"has no trained {stage}: go on with `hiernav train --resume {source}`"):
        begin_fine_tuning(config, source)
    assert not (tmp_path / "tuned").exists()


def test_training_starts_from_the_weights_of_the_source_and_says_how_good_they_are(able_run: Path, tmp_path: Path):
    assert cli.main(command(able_run, tmp_path / "tuned", "planner.learning_rate=1e-9")) == 0
    before, run = Run.open(able_run).load("planner")["network"], Run.open(tmp_path / "tuned")
    for name, value in run.load("planner")["network"].items():
        torch.testing.assert_close(value, before[name], rtol=1e-4, atol=1e-5)
    lines = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 1, 2]
    assert lines[0]["error"] == pytest.approx(lines[2]["error"], rel=1e-3)


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (["robot=car"], "robot cannot be changed by fine-tuning"),
        (["skill.total_steps=5"], "skill.total_steps cannot be changed"),
        (["--stage", "all"], "--from fine-tunes the planner"),
    ],
)
def test_what_the_networks_were_trained_for_cannot_be_changed(able_run: Path, tmp_path: Path, capsys, more, named):
    assert cli.main(command(able_run, tmp_path / "tuned", *more)) == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "tuned").exists()


def unfinished(run: Path, folder: Path, **changes: object) -> Path:
    """A copy of a run whose skill was left halfway."""
    shutil.copytree(run, folder)
    copy = Run.open(folder)
    copy.save("skill", {**copy.load("skill"), "steps": 512, **changes})
    return folder


@pytest.mark.parametrize("kind", ["run", "unfinished run", "bundle"])
def test_a_skill_from_elsewhere_drives_but_cannot_be_trained_on(
    able_run: Path, able_bundle: Path, tmp_path: Path, capsys, kind: str
):
    source = {"run": able_run, "bundle": able_bundle}.get(kind) or unfinished(able_run, tmp_path / "unfinished")
    assert cli.main(command(source, tmp_path / "tuned")) == 0
    assert cli.main(["train", "--resume", str(tmp_path / "tuned"), "--stage", "planner"]) == 0
    assert cli.main(["train", "--resume", str(tmp_path / "tuned")]) == 2
    assert "comes from another run or a bundle" in capsys.readouterr().err
    assert cli.main(["evaluate", "--run", str(tmp_path / "tuned"), "--world", tiny_run.WORLD, "--episodes", "2"]) == 0


def test_a_skill_that_was_never_evaluated_is_not_taken_over(able_run: Path, tmp_path: Path, capsys):
    source = unfinished(able_run, tmp_path / "unfinished", best_actor=None)
    assert cli.main(command(source, tmp_path / "tuned")) == 2
    assert f"has not been evaluated yet: go on with `hiernav train --resume {source}`" in capsys.readouterr().err
    assert not (tmp_path / "tuned").exists()


def test_a_planner_of_other_layers_is_refused(tmp_path: Path, able_run: Path, capsys):
    run = Run.open(able_run)
    state = run.load("planner")
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "config.yaml").write_bytes((able_run / "config.yaml").read_bytes())
    other = Run.open(copy)
    other.save("planner", {**state, "network": {**state["network"], "head.weight": torch.zeros(3, 3)}})
    other.save("skill", run.load("skill"))
    for again in range(2):
        assert cli.main(command(copy, tmp_path / "tuned")) == 2, again
        assert "head.weight is 3x3" in capsys.readouterr().err
        assert sorted(path.name for path in tmp_path.iterdir()) == ["copy"]


def test_a_planner_that_lacks_a_layer_is_refused(tmp_path: Path, able_run: Path, capsys):
    copy = Path(shutil.copytree(able_run, tmp_path / "copy"))
    state = Run.open(copy).load("planner")
    state["network"].pop("head.weight")
    Run.open(copy).save("planner", state)
    assert cli.main(command(copy, tmp_path / "tuned")) == 2
    assert "head.weight is no such layer" in capsys.readouterr().err
    assert not (tmp_path / "tuned").exists()


@pytest.mark.parametrize("at", ["planner/checkpoint.pt", "skill/checkpoint.pt", "config.yaml"])
def test_a_start_that_is_killed_leaves_no_run_and_the_same_command_begins_anew(able_run: Path, tmp_path: Path, at: str):
    tuned = tmp_path / "tuned"
    code = f"""
import os, signal
from hiernav import cli
replace = os.replace
def kill(source, target):
    if str(target).endswith({at!r}):
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)
os.replace = kill
cli.main({command(able_run, tuned)!r})
"""
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert not tuned.exists()
    assert cli.main(["train", "--stage", "planner", "--resume", str(tuned)]) == 2
    assert cli.main(command(able_run, tuned, "planner.learning_rate=1e-9")) == 0
    assert os.listdir(tmp_path) == ["tuned"]
    before = Run.open(able_run).load("planner")["network"]
    for name, value in Run.open(tuned).load("planner")["network"].items():
        torch.testing.assert_close(value, before[name], rtol=1e-4, atol=1e-5)


def test_a_fine_tuning_does_not_go_on_from_random_weights_where_its_own_are_gone(
    able_run: Path, tmp_path: Path, capsys
):
    tuned = tmp_path / "tuned"
    begin_fine_tuning(fine_tuning_config(able_run, [f"run_dir={tuned}"]), able_run).close()
    (tuned / "planner" / "checkpoint.pt").unlink()
    assert cli.main(["train", "--stage", "planner", "--resume", str(tuned)]) == 2
    assert "planner/checkpoint.pt is missing: restore it, or begin anew with --from" in capsys.readouterr().err


def test_a_disk_without_room_for_the_start_is_one_line_and_leaves_no_run(
    able_run: Path, tmp_path: Path, capsys, monkeypatch
):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hiernav.files.os.replace", full)
    assert cli.main(command(able_run, tmp_path / "tuned")) == 2
    told = capsys.readouterr().err
    assert f"{tmp_path / 'tuned'} cannot be written to (No space left on device): there is no run yet" in told
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_not_taken_for_a_fine_tuning(able_run: Path, tmp_path: Path, capsys):
    (tmp_path / "tuned").mkdir()
    (tmp_path / "tuned" / "notes.txt").write_text("mine")
    assert cli.main(command(able_run, tmp_path / "tuned")) == 2
    assert "is not empty: choose another run_dir" in capsys.readouterr().err
    assert os.listdir(tmp_path / "tuned") == ["notes.txt"]


def test_layers_of_a_bundle_are_told_in_their_order(tmp_path: Path):
    widths = [12, 11, 10, 9, 8, 7, 6]
    (tmp_path / "bundle").mkdir()
    config = tiny_run.config(tmp_path / "run", f"skill.hidden={widths}")
    planner = config.planner
    network = make_network(planner.preset, config.option.waypoints, config.option.spacing_m, planner.hypotheses)
    write_bundle(tmp_path / "bundle", config, network, make_learner(config).actor, {})
    assert list(fine_tuning_config(tmp_path / "bundle", []).skill.hidden) == widths
