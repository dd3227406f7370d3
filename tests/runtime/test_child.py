"""What processes that a loop starts take from the folder in which it was started."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from shipped import ROOT

from hiernav.runtime.process_robot import ProcessRobot, simulated
from hiernav.view.link import PROGRAM


def trap(folder: Path, module: str) -> None:
    """Have whoever takes a file of this folder for that module end at once."""
    (folder / f"{module}.py").write_text(f"raise SystemExit('not the real {module}')\n")


@pytest.mark.parametrize("module", ["random", "numpy"])
def test_no_file_there_is_taken_for_a_module_of_the_adapter(tmp_path, monkeypatch, module: str) -> None:
    trap(tmp_path, module)
    monkeypatch.chdir(tmp_path)
    robot = simulated(robot="point", world="pillar(1,1,1)")
    try:
        assert robot.action_dim == 2
    finally:
        robot.close()


def test_a_robot_may_be_made_by_a_module_there(tmp_path, monkeypatch) -> None:
    shutil.copy(ROOT / "deploy" / "example_robot.py", tmp_path / "robot_of_mine.py")
    monkeypatch.chdir(tmp_path)
    robot = ProcessRobot("robot_of_mine:make")
    try:
        assert robot.action_dim == 2
    finally:
        robot.close()


def test_no_file_there_is_taken_for_a_module_of_the_page(tmp_path) -> None:
    pytest.importorskip("viser", reason="needs the extra hiernav[view]")
    trap(tmp_path, "msgspec")
    done = subprocess.run([*PROGRAM, "no descriptor"], cwd=tmp_path, capture_output=True, text=True)
    assert "not the real" not in done.stderr and "invalid literal for int()" in done.stderr
