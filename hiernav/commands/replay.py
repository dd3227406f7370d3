"""`hiernav replay`: the policies again on a recording."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from hiernav.commands.arguments import Commands
from hiernav.commands.exits import FAILED
from hiernav.commands.screen import progress_bars
from hiernav.files import write_json


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "replay",
        help="run the policies again on a recording",
        description="Run estimator, planner, skill and guard again on what a recording (run_loop.py --record) says "
        "they were given, and compare bit for bit. Exit code 1 if a tick differs.",
    )
    parser.add_argument("recording", metavar="RUN.mcap", help="the recording")
    parser.add_argument("--bundle", metavar="DIR", help="policies (those of the recording)")
    parser.add_argument("--json", metavar="FILE", help="write the result; - for the screen")
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.nav.bundle import load_bundle
    from hiernav.runtime.log_reader import RunLog
    from hiernav.runtime.replay import Replay

    log = RunLog(arguments.recording)
    replay = Replay(log, load_bundle(arguments.bundle or log.about.get("bundle", "")))
    with progress_bars() as progress:
        task = progress.add_task("ticks", total=sum(1 for _ in log.ticks()), note="")
        result = replay.compare(lambda ticks: progress.update(task, completed=ticks))
        progress.update(task, completed=result.ticks)
    difference = result.difference
    found = {
        "recording": arguments.recording,
        "equal": result.equal,
        "ticks": result.ticks,
        "compared": result.compared,
        "same_policies": replay.same_policies,
        "complete": log.complete if result.equal else None,
        "difference": None if difference is None else dataclasses.asdict(difference),
    }
    if arguments.json == "-":
        print(json.dumps(found, indent=2))
        return 0 if result.equal else FAILED
    if not replay.same_policies:
        print("the policies are not those of the recording")
    if difference is not None:
        print(f"after {result.ticks} equal ticks: {difference}")
    else:
        compared = ", ".join(f"{count} x {name}" for name, count in result.compared.items()) or "nothing"
        print(f"{result.ticks} ticks equal bit for bit: {compared}")
        if not log.complete:
            print("the recording is cut off there: what came later was not written, or is damaged")
    if arguments.json:
        write_json(Path(arguments.json), found)
    return 0 if result.equal else FAILED
