"""Processes that make samples for one that was killed or interrupted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hiernav.planner.dataset import LabelSettings, label_worlds, map_tasks

PATIENCE = 60.0
"""For what takes a moment on an idle machine [s]."""


def work(folder: Path, number: int) -> None:
    """Say who works, and work for longer than this test waits."""
    (folder / f"{number}.part").write_text(str(os.getpid()))
    (folder / f"{number}.part").rename(folder / str(number))
    time.sleep(4.0 * PATIENCE)


def comes_true(what: Callable[[], bool]) -> bool:
    """Whether it does so within `PATIENCE`."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if what():
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="looks for processes in /proc")
def test_no_process_goes_on_with_samples_that_nobody_waits_for(tmp_path: Path) -> None:
    trainer = subprocess.Popen([sys.executable, __file__, str(tmp_path)])
    at_work = [tmp_path / "0", tmp_path / "1"]
    workers: list[int] = []
    try:
        assert comes_true(lambda: all(file.exists() for file in at_work))
        workers = [int(file.read_text()) for file in at_work]
        trainer.kill()
        trainer.wait()
        assert comes_true(lambda: not any(map(runs, workers)))
    finally:
        trainer.kill()
        for worker in filter(runs, workers):
            os.kill(worker, signal.SIGKILL)


def test_samples_that_nobody_waits_for_are_given_up_after_a_ctrl_c() -> None:
    """To the process that waits alone: those at work have a million worlds before them."""
    trainer = subprocess.Popen([sys.executable, __file__], stdout=subprocess.PIPE, text=True, preexec_fn=hear_ctrl_c)
    try:
        assert trainer.stdout is not None and trainer.stdout.readline() == "made\n"
        trainer.send_signal(signal.SIGINT)
        trainer.wait(PATIENCE)
    finally:
        trainer.kill()
    assert trainer.returncode == -signal.SIGINT


def hear_ctrl_c() -> None:
    """Also where whoever runs the tests ignores it, as a shell does for what it runs in the background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def make_samples_without_end() -> None:
    settings = LabelSettings(("pillar(1.2,1.2,2)",), radius=0.1, soft_margin=0.0, samples_per_world=1)
    for _ in map_tasks(label_worlds, [(settings, (0,), first, 10**6 if first else 1) for first in range(5)], 2):
        print("made", flush=True)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        list(map_tasks(work, [(Path(sys.argv[1]), number) for number in range(2)], 2))
    else:
        make_samples_without_end()
