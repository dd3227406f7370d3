"""Claims about training that goes wrong: it stops with one line that says what to do, and loses one segment at most."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
pytest.importorskip("torchrl", reason="needs the extra hiernav[train]")

from hiernav import cli  # noqa: E402
from hiernav.commands import exits  # noqa: E402
from hiernav.run import Run, RunError, TrainingDiverged  # noqa: E402
from hiernav.sim.layout import Layout, parse_world  # noqa: E402
from hiernav.sim.worlds import sample_layout  # noqa: E402
from hiernav.skill import collect  # noqa: E402
from hiernav.skill import replay as replay_module  # noqa: E402
from hiernav.skill.train import SkillTrainer  # noqa: E402

pytestmark = pytest.mark.train


@pytest.fixture
def at_step(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, Callable[[SkillTrainer], None]], None]:
    """Has something happen once to a trainer that has collected so many steps, before it learns from them."""

    def arrange(steps: int, act: Callable[[SkillTrainer], None]) -> None:
        update, done = SkillTrainer._update, []

        def hooked(trainer: SkillTrainer, frames: int) -> dict[str, float]:
            if trainer.steps >= steps and not done:
                done.append(steps)
                act(trainer)
            return update(trainer, frames)

        monkeypatch.setattr(SkillTrainer, "_update", hooked)

    return arrange


@pytest.fixture
def trained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Runs `hiernav train` on a tiny skill; returns the exit code and what it said last on stderr."""

    def run(*arguments: str) -> tuple[int, str]:
        capsys.readouterr()
        code = cli.main(["train", "--stage", "skill", *(arguments or tiny_run.arguments(tmp_path / "run"))])
        return code, capsys.readouterr().err.rstrip().splitlines()[-1]

    return run


def skill_lines(folder: Path) -> list[dict]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["stage"] != "planner"]


def checkpoint_steps(folder: Path) -> int:
    return Run.open(folder).load("skill")["steps"]


def test_physics_that_breaks_stops_training_and_names_the_episode(trained, at_step, tmp_path):
    layouts: list[Layout] = []
    two_segments = ("skill.num_envs=4", "skill.total_steps=1280")

    def break_simulation(trainer: SkillTrainer) -> None:
        layouts.append(trainer.batches.task.layouts[3])
        trainer.batches.task.sim.datas[3].qvel[0] = np.nan

    at_step(896, break_simulation)
    code, line = trained(*tiny_run.arguments(tmp_path / "run", *two_segments))
    assert code == 1 and line.startswith("hiernav train: the physics of simulation 3 is not finite after step ")
    assert "at step 896 of training, and the last checkpoint is of step 640" in line
    # what it prints draws the very world it happened in
    named = re.search(r"hiernav world --kind '(\S+)' --seed (\d+) --radius (\S+) --png", line)
    drawn = sample_layout(parse_world(named[1]), int(named[2]), float(named[3]))
    np.testing.assert_array_equal(drawn.pillars, layouts[0].pillars)
    np.testing.assert_array_equal(drawn.start, layouts[0].start)
    assert checkpoint_steps(tmp_path / "run") == 640


def test_a_segment_in_which_physics_broke_is_tried_in_other_worlds(trained, at_step, tmp_path, monkeypatch):
    draw, places = collect.training_layouts, []

    def recorded(config, *place: int):
        places.append(place)
        return draw(config, *place)

    def break_simulation(trainer: SkillTrainer) -> None:
        trainer.batches.task.sim.datas[3].qvel[0] = np.nan

    monkeypatch.setattr(collect, "training_layouts", recorded)
    resume = f"hiernav train --resume {tmp_path / 'run'}"
    arguments = tiny_run.arguments(tmp_path / "run", "skill.num_envs=4", "skill.total_steps=1280")
    for steps in (896, 900):
        at_step(steps, break_simulation)
        code, line = trained(*arguments)
        assert code == 1 and line.endswith(f"of step 640: `{resume}` goes on from there in other worlds")
        arguments = ["--resume", str(tmp_path / "run")]
    assert trained(*arguments)[0] == 0
    assert checkpoint_steps(tmp_path / "run") == 1280
    assert places == [(0,), (640,), (640, 1), (640, 2)]
    drawn = [draw(tiny_run.config(tmp_path / "other"), *place)(0).seed for place in places]
    assert len(set(drawn)) == 4


def test_weights_that_break_in_the_last_update_of_a_segment_do_not_reach_the_checkpoint(tmp_path):
    run = Run.create(tiny_run.config(tmp_path / "run"))
    trainer = SkillTrainer(run.config, run)
    update = trainer.learner.update

    def broken_gradient(batch):
        metrics = update(batch)
        if trainer.learner.updates == 25:  # the last one before step 512; its losses are from before the step
            with torch.no_grad():
                trainer.learner.actor.head.weight.fill_(torch.nan)
        return metrics

    trainer.learner.update = broken_gradient
    with pytest.raises(TrainingDiverged, match=r"^weights not finite after 25 updates; .* step 512 .* of step 256"):
        trainer.train()
    state = run.load("skill")
    assert state["steps"] == 256
    assert all(value.isfinite().all() for value in state["learner"]["loss"].values() if torch.is_tensor(value))


def test_training_that_breaks_before_the_first_checkpoint_says_that_there_is_none(tmp_path):
    run = Run.create(tiny_run.config(tmp_path / "run", "skill.learning_starts=64"))
    trainer = SkillTrainer(run.config, run)
    with torch.no_grad():
        trainer.learner.loss.log_alpha.fill_(torch.nan)
    with pytest.raises(TrainingDiverged, match="alpha.*not finite.*there is no checkpoint yet"):
        trainer.train()


@pytest.fixture
def limit_files() -> Iterator[Callable[[int], None]]:
    """Makes writing a file longer than so many bytes fail, as on a full disk, until the test ends."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [20_000, 1_000], ids=["checkpoint does not fit", "log does not fit"])
def test_a_full_disk_ends_training_in_one_line_and_leaves_the_last_checkpoint(
    trained, at_step, limit_files, tmp_path, size
):
    at_step(384, lambda _: limit_files(size))
    code, line = trained()
    limit_files(resource.RLIM_INFINITY)
    run = tmp_path / "run"
    assert code == 2
    assert line == (
        f"hiernav train: {run} cannot be written to (File too large): checkpoints are as they were; "
        f"make room, then go on with: hiernav train --resume {run}"
    )
    assert checkpoint_steps(run) == 256 and not list(run.rglob("*.part"))
    assert trained("--resume", str(run))[0] == 0
    assert [line["step"] for line in skill_lines(run) if line["stage"] == "skill"] == [256, 512, 768]
    rates = [json.loads(line)["step"] for line in (run / "rates.jsonl").read_text().splitlines()]
    assert rates == [256, 512, 768]


def test_a_disk_that_is_too_full_for_tensorboard_is_told_of_once(tmp_path):
    program = f"""
import resource, threading, time
import numpy as np
from hiernav.config import load_config
from hiernav.run import Run, RunError
run = Run.create(load_config(None, ["run_dir={tmp_path / "run"}"]))
run.log("skill", 0, {{"reach_rate": 0.0}})
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, hard))  # more than the configuration, less than the curves
try:
    for step in range(1, 20):
        run._writer.add_histogram("much", np.arange(1000.0), step)
        run._writer.file_writer.flush()
        time.sleep(0.1)
        run.log("skill", step, {{"reach_rate": 0.0}})
except (RunError, OSError) as error:
    print(type(error).__name__)
    thread = threading.Thread(target=lambda: 1 / 0)
    thread.start()
    thread.join()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and done.stdout.split() in (["OSError"], ["RunError"])
    assert "File too large" not in done.stderr and done.stderr.count("Traceback") == 1
    assert "ZeroDivisionError" in done.stderr  # of other threads all is told


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="this system cannot set space aside")
def test_the_replay_takes_its_place_on_disk_before_training_begins(tmp_path):
    replay = replay_module.Replay(tmp_path / "replay", 5_000, 42, 2, 8)
    files = list((tmp_path / "replay").rglob("*.memmap"))
    assert len(files) == 6 and len(replay) == 0
    assert all(file.stat().st_blocks * 512 >= file.stat().st_size for file in files)


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
def test_what_a_checkpoint_speaks_of_is_on_disk_before_it_and_its_name_after_it(tmp_path, monkeypatch):
    config = tiny_run.config(tmp_path / "run")
    trainer, done = SkillTrainer(config, Run.create(config)), []
    trainer.run.log("skill", 0, {"reach_rate": 0.0})
    fsync, replace = os.fsync, os.replace

    def synced(file: int) -> None:
        fsync(file)
        done.append(Path(os.readlink(f"/proc/self/fd/{file}")))

    def renamed(source: Path, target: Path) -> None:
        replace(source, target)
        done.append(Path(target))

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    trainer._save()
    skill = trainer.run.path / "skill"
    before, after = (done[part] for k in [done.index(skill / "checkpoint.pt")] for part in (slice(k), slice(k, None)))
    pages = set((skill / "replay").rglob("*.memmap"))
    assert len(pages) == len(replay_module.KEYS) and pages < set(before)
    assert {skill / "replay", skill / "replay" / "meta.json", trainer.run.path / "metrics.jsonl"} < set(before)
    assert {skill, trainer.run.path} <= set(after)


def test_a_disk_that_cannot_take_the_replay_ends_training_before_the_checkpoint(tmp_path, monkeypatch):
    config = tiny_run.config(tmp_path / "run")
    trainer = SkillTrainer(config, Run.create(config))

    def broken(path: Path) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(replay_module, "sync", broken)
    with pytest.raises(RunError, match=r"cannot be written to \(Input/output error\)"):
        trainer._save()
    assert not (trainer.run.path / "skill" / "checkpoint.pt").exists()


def test_a_disk_without_room_for_the_replay_is_reported_at_once(tmp_path, monkeypatch):
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(replay_module.os, "posix_fallocate", full, raising=False)
    run = Run.create(tiny_run.config(tmp_path / "run"))
    with pytest.raises(RunError, match="cannot be written to .No space left on device.* make room"):
        SkillTrainer(run.config, run)
    assert not (run.path / "skill" / "replay").exists()


def test_a_training_does_not_go_on_without_its_replay(trained, at_step, tmp_path):
    def stop(_: SkillTrainer) -> None:
        raise KeyboardInterrupt

    run, copy = tmp_path / "run", tmp_path / "copy"
    at_step(384, stop)
    assert trained()[0] == exits.INTERRUPTED
    shutil.copytree(run, copy)
    shutil.rmtree(copy / "skill" / "replay")
    for _ in range(2):  # what the first attempt has made is not taken for the lost one by the second
        code, line = trained("--resume", str(copy))
        assert code == exits.BAD_INPUT
        assert line.startswith(f"hiernav train: {copy / 'skill' / 'replay'} is missing, ") and "from step 256: " in line
    shutil.copytree(run / "skill" / "replay", copy / "skill" / "replay")
    assert trained("--resume", str(copy))[0] == 0


def test_a_finished_training_is_not_made_longer(trained_run, trained, tmp_path):
    run = Path(shutil.copytree(trained_run, tmp_path / "longer"))
    longer = (run / "config.yaml").read_text().replace("total_steps: 768", "total_steps: 1024")
    (run / "config.yaml").write_text(longer)
    code, line = trained("--resume", str(run))
    assert code == exits.BAD_INPUT and "begin a new run to train for longer" in line


KILLED_IN_A_SEGMENT = """
update = train.SkillTrainer._update
def _update(self, frames):
    if self.steps > 256:
        os.kill(os.getpid(), signal.SIGKILL)
    return update(self, frames)
train.SkillTrainer._update = _update
"""
KILLED_HALFWAY_THROUGH_A_CHECKPOINT = """
fsync, written = os.fsync, []
def _fsync(file):
    written.append(os.readlink(f"/proc/self/fd/{file}"))
    if sum(name.endswith("skill/checkpoint.pt.part") for name in written) == 2:
        os.ftruncate(file, os.fstat(file).st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)
    fsync(file)
os.fsync = _fsync
"""


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
@pytest.mark.parametrize("how", [KILLED_IN_A_SEGMENT, KILLED_HALFWAY_THROUGH_A_CHECKPOINT], ids=["segment", "save"])
def test_a_killed_run_goes_on_from_its_last_checkpoint_as_if_nothing_had_happened(tmp_path, trained_run, capsys, how):
    run = tmp_path / "run"
    code = f"""
import os, signal, sys
from hiernav import cli
from hiernav.skill import train
{how}
cli.main({["train", "--stage", "skill", *tiny_run.arguments(run)]!r})
"""
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert (run / "skill" / "checkpoint.pt.part").exists() == (how is KILLED_HALFWAY_THROUGH_A_CHECKPOINT)
    saved = (run / "skill" / "checkpoint.pt").stat().st_mtime
    assert checkpoint_steps(run) == 256

    assert cli.main(["train", "--stage", "skill", "--resume", str(run)]) == 0
    said = re.search(
        r"skill: going on after step 256 of 768, from the checkpoint of (\S+ \S+)\n", capsys.readouterr().err
    )
    assert said and said[1] == datetime.fromtimestamp(saved).strftime("%Y-%m-%d %H:%M:%S")
    assert skill_lines(run) == skill_lines(trained_run)
    assert not list(run.rglob("*.part"))
