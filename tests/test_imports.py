"""Who may import whom: the rooms of the library, read off every file, and torch kept out of what runs on a robot."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hiernav

PACKAGE = Path(hiernav.__file__).parent
# Room -> the rooms it may import. A room is a folder or a file directly under hiernav/.
ALLOWED = {
    "__init__": {"config", "nav", "sim", "envs", "runtime"},
    "__main__": {"cli"},
    "envs": set(),
    "decode": {"nav"},
    "config": {"decode"},
    "device": {"decode"},
    "files": set(),
    "git": set(),
    "nav": {"files"},
    "sim": {"nav", "config"},
    "lock": set(),
    "orphans": set(),
    "run": {"config", "files", "git", "lock"},
    "planner": {"nav", "sim", "config", "run", "device", "files", "lock", "orphans"},
    "skill": {"nav", "sim", "config", "run", "device", "files"},
    "training": {"git", "nav", "sim", "planner", "skill", "run"},
    "runtime": {"nav", "decode", "__init__"},
    "finetune": {"nav", "planner", "config", "run", "evaluate"},
    "view": {"nav", "runtime"},
    "drive": {"nav", "sim", "runtime", "view", "draw", "decode", "files", "__init__"},
    "evaluate": {"nav", "sim", "planner", "skill", "runtime", "config", "run"},
    "export": {"nav", "sim", "planner", "skill", "runtime", "config", "run"},
    "draw": {"nav", "sim"},
    "film": {"nav", "sim", "evaluate", "draw"},
    "reproduce": {
        "nav",
        "sim",
        "planner",
        "evaluate",
        "finetune",
        "training",
        "film",
        "config",
        "run",
        "device",
        "files",
        "git",
        "lock",
        "orphans",
    },
    "report": {"nav", "evaluate", "reproduce", "run", "sim", "files"},
    "check": {"nav", "sim", "planner", "config", "run", "device"},
    "commands": {
        "check",
        "nav",
        "sim",
        "evaluate",
        "export",
        "report",
        "draw",
        "film",
        "config",
        "decode",
        "run",
        "planner",
        "training",
        "finetune",
        "device",
        "files",
        "runtime",
    },
    "cli": {"commands", "run"},
}
EXTRA_ALLOWED = {"runtime/sim_robot.py": {"sim"}}
TRAINING_PACKAGES = {"torch", "torchrl", "tensordict"}
FORBIDDEN_PACKAGES = {
    "nav": TRAINING_PACKAGES | {"mujoco", "onnxruntime"},
    "sim": TRAINING_PACKAGES,
    "runtime": TRAINING_PACKAGES,
    "film": TRAINING_PACKAGES,
    "view": TRAINING_PACKAGES | {"mujoco", "onnxruntime"},
    "config": TRAINING_PACKAGES,
    "decode": TRAINING_PACKAGES,
    "__init__": TRAINING_PACKAGES,
    "planner": {"torchrl", "tensordict"},
}
FILES = sorted(PACKAGE.rglob("*.py"))
TORCH_FREE = sorted(f for f in FILES if f.relative_to(PACKAGE).parts[0] in ("nav", "sim", "runtime", "drive"))


def imported_modules(source: str) -> set[str]:
    """Dotted names of all modules a file may import, those inside functions included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def forbidden_imports(relative: str, source: str) -> set[str]:
    """Imports that the file at `relative` (under hiernav/) must not make."""
    room = relative.partition("/")[0].removesuffix(".py")
    assert room in ALLOWED, f"hiernav/{relative}: {room!r} is not a room of this library; add it to ALLOWED"
    allowed = ALLOWED[room] | EXTRA_ALLOWED.get(relative, set()) | {room}
    bad = set()
    for module in imported_modules(source):
        package, _, rest = module.partition(".")
        if package == "hiernav":
            if (target := rest.partition(".")[0]) in ALLOWED and target not in allowed:
                bad.add(module)
        elif package in FORBIDDEN_PACKAGES.get(room, set()):
            bad.add(module)
    return bad


def module_name(file: Path) -> str:
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(PACKAGE).as_posix())
def test_a_room_imports_only_what_it_may(file: Path) -> None:
    relative = file.relative_to(PACKAGE).as_posix()
    assert not forbidden_imports(relative, file.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("relative", "source"),
    [
        ("nav/path.py", "import hiernav.sim.batch"),
        ("nav/path.py", "def f():\n    from mujoco import MjModel"),
        ("nav/path.py", "from hiernav import sim"),
        ("sim/batch.py", "import torch.nn as nn"),
        ("planner/train.py", "from hiernav.skill.env import Env"),
        ("skill/env.py", "from hiernav.planner import network"),
        ("runtime/loop.py", "from hiernav.sim.batch import BatchSim"),
        ("runtime/sim_robot.py", "from hiernav.planner import network"),
        ("evaluate.py", "import hiernav.cli"),
    ],
)
def test_a_wrong_import_is_found(relative: str, source: str) -> None:
    assert len(forbidden_imports(relative, source)) == 1


def test_only_the_simulated_robot_of_the_runtime_may_use_the_simulator() -> None:
    assert not forbidden_imports("runtime/sim_robot.py", "from hiernav.sim.batch import BatchSim")


def test_what_runs_on_a_robot_imports_without_torch() -> None:
    """In a process where importing torch fails, every module of nav, sim, runtime and drive can be imported."""
    modules = [module_name(file) for file in TORCH_FREE] + ["hiernav", "hiernav.config"]
    assert len(modules) > 5
    code = f"""
import importlib, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted(TRAINING_PACKAGES)!r}:
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Absent())
for name in {modules!r}:
    importlib.import_module(name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_deployed_scripts_name_no_training_package() -> None:
    for file in (PACKAGE.parent / "deploy").rglob("*.py"):
        packages = {module.partition(".")[0] for module in imported_modules(file.read_text(encoding="utf-8"))}
        assert not packages & TRAINING_PACKAGES, file


def test_a_control_process_loads_neither_physics_nor_search_nor_plots() -> None:
    """They take longer to import than all the rest together, and a robot is to be ready within moments."""
    code = (
        f"import sys\nsys.path.insert(0, {str(PACKAGE.parent / 'deploy')!r})\nimport run_loop\n"
        "print(*sorted(set(sys.modules) & {'scipy', 'filterpy', 'mujoco', 'matplotlib', 'mcap', 'viser'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""


def test_the_first_step_of_an_agent_imports_nothing_any_more() -> None:
    """What it plans with takes a quarter of a second to import, which is many control steps."""
    code = (
        "import sys\nimport numpy as np\nimport hiernav\n"
        f"bundle = hiernav.load_bundle({str(PACKAGE.parent / 'deploy' / 'bundles' / 'point')!r})\n"
        "agent = hiernav.make_agent(bundle, robot_radius=0.1)\n"
        f"office = hiernav.load_map({str(PACKAGE.parent / 'configs' / 'maps' / 'office.yaml')!r})\n"
        "readings = {name: np.zeros((1, size)) for name, size in bundle.layout.sensors.items()}\n"
        "before = set(sys.modules)\n"
        "agent.act(np.array([[1.5, 2.0, 0.0]]), readings, np.array([[10.0, 6.0]]), [office])\n"
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""


def test_importing_hiernav_on_a_robot_loads_nothing_else() -> None:
    code = (
        "import sys\n"
        "sys.modules['gymnasium'] = None  # not installed there\n"
        "import hiernav\n"
        "print(*sorted(set(sys.modules) & {'numpy', 'mujoco', 'msgspec', 'torch', 'hiernav.nav', 'hiernav.config'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == ""


@pytest.mark.parametrize("name", sorted(set(hiernav.__all__) - {"__version__"}))
def test_a_public_name_is_where_it_says(name: str) -> None:
    assert getattr(hiernav, name).__name__ == name
    assert name in dir(hiernav)


def test_an_unknown_public_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        hiernav.nothing  # noqa: B018
