"""`hiernav report`: one page of all results."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hiernav.commands.arguments import Commands
from hiernav.commands.exits import FAILED


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "report",
        help="make one page of all results",
        description="Turn the results of tools/reproduce.py into one HTML file that needs no network: the paper's "
        "tables beside ours, curves, films, and what fell short. Exit code 1 if a result file is damaged.",
    )
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="DIR", help="(results)")
    parser.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE", help="(report.html)")
    parser.add_argument(
        "--curves", type=Path, metavar="FILE", help="draw the training curves of all robots as well (PNG, SVG or PDF)"
    )
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.report.figures import PICTURES, save_training
    from hiernav.report.page import write_report

    for option, file in (("--out", arguments.out), ("--curves", arguments.curves)):
        if file is not None and file.is_dir():
            raise ValueError(f"{option} {file} is a folder: name a file in it")
    if arguments.curves and arguments.curves.suffix not in PICTURES:
        raise ValueError(f"--curves {arguments.curves} must end in {', '.join(PICTURES)}")
    book = write_report(arguments.results, arguments.out)
    failed = sum(result.state == "failed" for result in book.results)
    size = arguments.out.stat().st_size / 1e6
    print(f"{arguments.out}: {size:.2f} MB; {len(book.results)} results, {failed} of them failed cells")
    if arguments.curves:
        save_training(book, arguments.curves)
        print(f"wrote {arguments.curves}")
    for line in book.damaged:
        print(f"damaged: {line}", file=sys.stderr)
    return FAILED if book.damaged else 0
