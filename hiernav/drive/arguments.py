"""The command line of `run_loop.py`, and the settings it leads to."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hiernav import __version__
from hiernav.decode import ConfigError
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.runtime.control import default_socket
from hiernav.runtime.noise import EXACT
from hiernav.runtime.settings import Settings, load_settings
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import RobotSpec

WORLD = "pillar(2,2,10)"
TILT_LIMIT = 1.31
"""Of a robot that can fall, where no file sets another one [rad]: 75 degrees."""


def make_parser(description: str, home: Path) -> argparse.ArgumentParser:
    """Arguments have `home`, where bundles and settings are, besides what is said on the command line."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(home=home)
    parser.add_argument("--version", action="version", version=__version__)
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--realtime", action="store_true", help="at the robot's control rate (default)")
    pace.add_argument("--fast", action="store_true", help="as fast as the machine can; the same for the same seed")
    parser.add_argument("--robot", default="point", help="point, car or doggo (point)")
    parser.add_argument("--bundle", type=Path, metavar="DIR", help="exported policies (deploy/bundles/ROBOT)")
    parser.add_argument("--world", help=f"kind of world, or a map's YAML ({WORLD}; with --adapter there is no default)")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; the next ones count up (0)")
    parser.add_argument("--episodes", type=int, default=1, metavar="N", help="how many worlds to cross (1)")
    parser.add_argument("--goal", metavar="X,Y", help="goal in the world frame [m]; a simulated world has its own")
    parser.add_argument("--exact", action="store_true", help="sensors without noise")
    parser.add_argument("--adapter", metavar="FILE.py:FUNCTION", help="makes your robot (deploy/README.md)")
    parser.add_argument("--planner", choices=("process", "sync"), help="where plans are made (process; sync if --fast)")
    parser.add_argument("--settings", type=Path, metavar="YAML", help="sections of settings (deploy/ROBOT.yaml)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="one setting, several times")
    parser.add_argument("--serve", action="store_true", help="stay ready for goals instead of driving episodes")
    parser.add_argument("--control", type=Path, metavar="SOCKET", help=f"for --tell and --serve ({default_socket()})")
    parser.add_argument("--tell", metavar="COMMAND", help="command the loop that runs")
    parser.add_argument("--dry-run", action="store_true", help="check everything, and move nothing")
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (runs/drive-TIME)")
    parser.add_argument("--record", type=Path, metavar="FILE", help="MCAP file with every tick (hiernav replay FILE)")
    parser.add_argument(
        "--view", nargs="?", type=_port, const=8080, metavar="PORT",
        help="live page in the browser, for this machine alone (8080); stays ready for goals, until Ctrl-C",
    )  # fmt: skip
    parser.add_argument("--no-pictures", action="store_true", help="draw nothing")
    parser.add_argument("--json", metavar="FILE", help="write the summary here too; - for the screen, alone on it")
    return parser


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no port, expected 0 to 65535")
    return int(text)


def join_goal(argv: Sequence[str]) -> list[str]:
    """Have `--goal -1,2` mean `--goal=-1,2`: argparse would take -1,2 for an option."""
    joined = list(argv)
    if "--goal" in joined[:-1]:
        at = joined.index("--goal")
        joined[at : at + 2] = [f"--goal={joined[at + 1]}"]
    return joined


def require_place(arguments: argparse.Namespace) -> None:
    """Fill in the world of a simulated robot. Where a real one is, and where it is to go, must be said.

    Raises:
        ValueError: it was not.
    """
    if arguments.adapter and not arguments.dry_run:
        if arguments.world is None:
            raise ValueError("--adapter moves a real robot: name the map it is on (--world office.yaml)")
        if arguments.goal is None and not arguments.serve and arguments.view is None:
            raise ValueError(
                "--adapter moves a real robot: name its --goal X,Y, or --serve or --view and give it later"
            )
    arguments.world = arguments.world or WORLD


def settings_of(arguments: argparse.Namespace, spec: RobotSpec) -> Settings:
    """`robot_settings` with what the command line says."""
    files = () if arguments.settings is None else (arguments.settings,)
    steps = parse_world(arguments.world).max_steps
    settings = robot_settings(spec, arguments.home, files, arguments.set, max_steps=steps)
    return replace(settings, noise=EXACT) if arguments.exact else settings


def robot_settings(
    spec: RobotSpec, home: Path, files: Sequence[Path] = (), overrides: Sequence[str] = (), **driver: Any
) -> Settings:
    """What a robot is driven with.

    Args:
        spec: of the robot.
        home: folder with a file of its own settings, if there is one.
        files: whose settings go over those.
        overrides: KEY=VALUE, which go over all files.
        driver: of its settings, those that differ from the defaults where no file says anything.

    Raises:
        ConfigError: they are wrong, or leave a robot that can fall without a limit of its tilt.
    """
    own = home / f"{spec.name}.yaml"
    asked: dict[str, dict[str, Any]] = {
        "estimator": {"tilts": spec.free_base},
        "driver": {"robot_radius": spec.radius, "goal_radius": GOAL_RADIUS, **driver},
        "guard": {"tilt_limit": TILT_LIMIT} if spec.free_base else {},
    }
    settings = load_settings([*([own] if own.exists() else []), *files], overrides, asked)
    if spec.free_base and settings.guard.tilt_limit is None:
        raise ConfigError(f"guard.tilt_limit is null: a {spec.name} can fall, which must be a fault; set it in rad")
    return settings
