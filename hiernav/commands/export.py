"""`hiernav export`: a run as a bundle of ONNX files."""

from __future__ import annotations

import argparse
from pathlib import Path

from hiernav.commands.arguments import Commands


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "export",
        help="turn a run into a bundle of ONNX files",
        description="Export a run's planner and skill, with all they assume, to a verified bundle.",
    )
    parser.add_argument("--run", dest="run_path", metavar="RUN", help="a run folder (the newest one in runs/)")
    parser.add_argument(
        "--onnx",
        nargs="?",
        const="",
        metavar="DIR",
        required=True,
        help="write a bundle of ONNX files; DIR is replaced if it holds one (RUN/bundle)",
    )
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.export import export_run
    from hiernav.run import newest_run

    run = Path(arguments.run_path) if arguments.run_path else newest_run()
    out = export_run(run, arguments.onnx or run / "bundle")
    total = sum(file.stat().st_size for file in out.iterdir())
    print(f"{out}: {', '.join(sorted(file.name for file in out.iterdir()))}; {total / 1e6:.2f} MB, checked")
    return 0
