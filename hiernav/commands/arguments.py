"""What several commands take on the command line."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from hiernav.sim.layout import WorldSpec

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""Where a command adds itself."""


def add_configuration(parser: argparse.ArgumentParser, file_help: str) -> None:
    """What a command takes that runs on a configuration: a file, and values that override it."""
    parser.add_argument("--config", metavar="FILE", help=file_help)
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="values that override the file's")


def worlds_of(arguments: argparse.Namespace) -> list[WorldSpec]:
    """Those of `--world`, each once, in the order of their first mention; `--seed` is checked too.

    Raises:
        ValueError: there is no such world, or the seed is negative.
    """
    from hiernav.sim.layout import parse_world

    if arguments.seed < 0:
        raise ValueError(f"--seed is {arguments.seed}, it must not be negative")
    worlds = (parse_world(text) for text in arguments.world or ["pillar(2,2,10)"])
    return list({str(world): world for world in worlds}.values())
