"""What `pip wheel` makes of the checkout: it has all that the library needs, and nothing of it is read from here."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]

pytest.importorskip("setuptools", minversion="77")  # what builds it, from here and not from a network


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder into which the wheel alone is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    source, site = folder / "source", folder / "site"
    shutil.copytree(ROOT / "hiernav", source / "hiernav", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = [*PIP, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", folder, source]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("hiernav-*.whl")
    subprocess.run([*PIP, "install", "--no-deps", "--no-index", "--target", site, wheel], check=True)
    return site


def run(site: Path, *arguments: object) -> str:
    """What Python says, with the wheel before everything else."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, cwd=site.parent, env={"PYTHONPATH": str(site)}
    ).stdout


def test_an_installed_wheel_draws_a_world(site):
    shown = json.loads(run(site, "-m", "hiernav", "world", "--kind", "two-room", "--seed", 1, "--json"))
    assert shown["world"].startswith("two-room") and shown["seed"] == 1


def test_an_installed_wheel_simulates_all_robots(site):
    program = (
        "import hiernav\n"
        "from hiernav.sim.batch import BatchSim\n"
        "from hiernav.sim.robots import ROBOTS\n"
        "from hiernav.sim.scene import SceneSpec\n"
        "print(hiernav.__file__, *(BatchSim(robot, 1, SceneSpec()).model.nu for robot in ROBOTS.values()))\n"
    )
    file, *actuators = run(site, "-c", program).split()
    assert Path(file).is_relative_to(site) and actuators == ["2", "2", "12"]


def test_a_wheel_holds_every_file_of_the_package(site):
    there = {file.relative_to(site) for file in (site / "hiernav").rglob("*") if file.suffix not in (".pyc", "")}
    here = {file.relative_to(ROOT) for file in (ROOT / "hiernav").rglob("*") if file.suffix not in (".pyc", "")}
    assert here <= there
