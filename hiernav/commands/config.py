"""`hiernav config`: every setting, or a resolved configuration."""

from __future__ import annotations

import argparse

from hiernav.commands.arguments import Commands, add_configuration
from hiernav.commands.screen import screen


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "config",
        help="list every setting",
        description="List every setting with its default, or print a resolved configuration as YAML.",
    )
    add_configuration(parser, "resolve this file instead of listing the settings")
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.config import describe_config, dump_config, load_config
    from hiernav.decode import as_text

    if arguments.config or arguments.overrides:
        print(dump_config(load_config(arguments.config, arguments.overrides)), end="")
        return 0
    from rich.markup import escape
    from rich.table import Table

    table = Table("key", "type", "default", "what it is", box=None, pad_edge=False)
    for setting in describe_config():
        # escaped: units in brackets are no markup
        table.add_row(*map(escape, (setting.path, setting.type, as_text(setting.default), setting.description)))
    screen(piped_width=1_000).print(table)  # one line per setting, for grep
    return 0
