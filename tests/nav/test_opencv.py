"""What OpenCV's loader does to the environment reaches no program that is started from here."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import hiernav

PACKAGE = Path(hiernav.__file__).parent
PROGRAM = """
import os
import hiernav.nav.occupancy
print(os.environ.get("LD_LIBRARY_PATH"))
"""


@pytest.mark.parametrize("path", [None, "/opt/ros/lib"])
def test_no_folder_is_added_to_those_that_libraries_are_loaded_from(path: str | None) -> None:
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(PACKAGE.parent)}
    if path is not None:
        environment["LD_LIBRARY_PATH"] = path
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, check=True, capture_output=True, text=True)
    assert done.stdout == f"{path}\n"


def test_opencv_is_imported_in_one_place() -> None:
    places = {
        file.relative_to(PACKAGE).as_posix()
        for file in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Import)
        and any(name.name.partition(".")[0] == "cv2" for name in node.names)
        or isinstance(node, ast.ImportFrom)
        and (node.module or "").partition(".")[0] == "cv2"
    }
    assert places == {"nav/opencv.py"}
