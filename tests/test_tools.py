"""Claims about the command lines of tools: bad input is one line that says what is wrong, and exit code 2."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("command", "line"),
    [
        (["planner_walks.py", "--bundle", "/nope"], "planner_walks: /nope: no such folder"),
        (["planner_walks.py", "--world", "foo"], "planner_walks: world 'foo': unknown;"),
        (["planner_scale.py", "--bundle", "/nope"], "planner_scale: /nope: no such folder"),
        (["noise_table.py", "--bundle", "/nope"], "noise_table: /nope: no such folder"),
        (["training_race.py", "--config", "/nope"], "training_race: /nope: cannot be read"),
        (["bench.py", "--tick", "--bundle", "/nope"], "bench: /nope: no such folder"),
        (["bench_loop.py", "--bundle", "/nope", "--rate", "50"], "bench_loop: /nope: no such folder"),
    ],
)
def test_bad_input_is_one_line(command, line):
    script, *arguments = command
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / script), *arguments],
        capture_output=True, text=True, env=environment, cwd=ROOT, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(line) and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "line"),
    [
        (["bench.py", "--seconds", "nan"], "bench.py: error: argument --seconds: nan, it must be finite and above 0"),
        (["planner_scale.py", "--worlds", "0"], "planner_scale.py: error: argument --worlds: 0, it must be at least 1"),
        (["noise_table.py", "--workers", "0"], "noise_table.py: error: argument --workers: 0, it must be at least 1"),
        (
            ["training_race.py", "--reach", "7"],
            "training_race.py: error: argument --reach: 7, it must be above 0 and at most 1",
        ),
        (
            ["bench_loop.py", "--seconds", "nan"],
            "bench_loop.py: error: argument --seconds: nan, it must be finite and at least 1",
        ),
        (
            ["bench_loop.py", "--rehearsal", "-1"],
            "bench_loop.py: error: argument --rehearsal: -1, it must be finite and at least 0",
        ),
        (["training_race.py", "--every", "x"], "training_race.py: error: argument --every: invalid number value: 'x'"),
    ],
)
def test_bad_numbers_are_named(command, line):
    script, *arguments = command
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / script), *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=120,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == line


def tool(name: str):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.train
@pytest.mark.parametrize("contender", ["hiernav", "float32", "torchrl"])
def test_all_contenders_of_a_race_update_on_the_processor(monkeypatch, contender):
    import torch

    import hiernav.skill.train as skill_train

    race, made = tool("training_race"), []

    class Stop(Exception):
        pass

    def trainer(config, run, make):
        made.append((config.skill.device, make))
        raise Stop

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(skill_train, "SkillTrainer", trainer)
    arguments = SimpleNamespace(
        train=contender, config=ROOT / "configs/point.yaml", every=100, reach=0.9, settings=["skill.device=auto"]
    )
    with pytest.raises(Stop):
        race._train(arguments)
    assert made == [("cpu", race.torchrl_learner if contender == "torchrl" else skill_train.make_learner)]
