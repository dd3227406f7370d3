"""Processes that make samples for one that was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hiernav.planner.dataset import map_tasks

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


def runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


if __name__ == "__main__":
    list(map_tasks(work, [(Path(sys.argv[1]), number) for number in range(2)], 2))
