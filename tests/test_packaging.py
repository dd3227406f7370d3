"""Claims about pyproject.toml: one version, and every package that is imported is asked for by name."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import hiernav

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "yaml": "pyyaml"}
"""Of packages that are installed under another name than they are imported by."""
EXTRAS = {
    "view": {"view"},
    **dict.fromkeys(
        ("planner", "skill", "training", "export", "finetune", "envs", "device", "evaluate", "run"), {"train"}
    ),
    **dict.fromkeys(("skill/machines.py", "check.py"), {"train", "ray"}),
    "sim/gym.py": {"train"},
}
"""What files may need beyond the base installation."""


def declared(*extras: str) -> set[str]:
    listed = list(PROJECT["project"]["dependencies"])
    for extra in extras:
        listed += PROJECT["project"]["optional-dependencies"][extra]
    return {re.split(r"[<>=\[ ]", line)[0].lower() for line in listed}


def imported(file: Path) -> set[str]:
    """Distributions that a file imports from, those inside functions included."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).partition(".")[0])
    return {DISTRIBUTIONS.get(name, name) for name in names - sys.stdlib_module_names - {"hiernav"}}


def test_every_package_that_is_imported_is_declared() -> None:
    for file in (ROOT / "hiernav").rglob("*.py"):
        relative = file.relative_to(ROOT / "hiernav")
        room = relative.parts[0].removesuffix(".py")
        extras = EXTRAS.get(relative.as_posix(), EXTRAS.get(room, set()))
        assert imported(file) <= declared(*extras), relative


def test_every_package_that_is_declared_is_held_to_a_release() -> None:
    held = {
        line.partition("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
    }
    assert declared(*PROJECT["project"]["optional-dependencies"]) - {"hiernav"} <= held


def test_the_version_stands_in_one_place() -> None:
    assert "version" not in PROJECT["project"] and PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "hiernav.__version__"}
    for command in (["-m", "hiernav"], [str(ROOT / "deploy" / "run_loop.py")]):
        done = subprocess.run([sys.executable, *command, "--version"], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout) == (0, f"{hiernav.__version__}\n")
    assert hiernav.__version__ not in (ROOT / "deploy" / "README.md").read_text()
    assert (ROOT / PROJECT["project"]["readme"]).is_file()
