"""Claims about the command lines of tools: bad input is one line that says what is wrong, and exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
