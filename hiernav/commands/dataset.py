"""`hiernav dataset`: labelled samples for the planner."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from hiernav.commands.arguments import Commands, add_configuration
from hiernav.commands.screen import progress_bars


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "dataset",
        help="make labelled samples for the planner",
        description="Label starts in sampled worlds with shortest paths, for `hiernav train planner.data=DIR`. Ctrl-C "
        "is safe: the same command goes on, and one with more samples makes the data set larger.",
        epilog="An entry of a mix may have a weight, ranges, and a density: 2*pillar(2..8,2..8,0.4..0.7/m2). "
        "All else is taken from the configuration: robot, planning radius, margin, preset, seed, threads.",
    )
    parser.add_argument("--out", metavar="DIR", required=True, help="where the data set is, or is to be")
    add_configuration(parser, "YAML with what differs from the defaults")
    parser.add_argument("--samples", metavar="N", help="how many (planner.samples)")
    parser.add_argument("--world", action="append", metavar="WORLD", help="repeat for a mix (planner.worlds)")
    parser.add_argument("--sheet", metavar="FILE", help="write a PNG of some samples")
    parser.add_argument("--check", action="store_true", help="make nothing: read all of it and check it")
    parser.add_argument("--json", action="store_true", help="print what was made as JSON")
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.check import check_threads, check_worlds
    from hiernav.config import load_config
    from hiernav.planner.dataset import data_seed, label_settings
    from hiernav.planner.store import read_dataset, read_manifest, write_dataset

    overrides = list(arguments.overrides)
    if arguments.check and (overrides or arguments.config or arguments.samples or arguments.world):
        raise ValueError("--check reads what is there: leave out --config, --samples, --world and KEY=VALUE")
    if arguments.samples:
        overrides.append(f"planner.samples={arguments.samples}")
    if arguments.world:
        overrides.append(f"planner.worlds={json.dumps(arguments.world)}")
    began, folder = time.perf_counter(), Path(arguments.out)
    with progress_bars() as progress:
        if arguments.check:
            manifest = read_manifest(folder)
        else:
            config = load_config(arguments.config, overrides)
            check_worlds(config)
            check_threads(config)
        total = manifest.samples if arguments.check else config.planner.samples
        task = progress.add_task("checking" if arguments.check else "samples", total=total, note="")
        first: list[int] = []

        def show(done: int) -> None:
            first.append(done)
            rate = (done - first[0]) / max(time.perf_counter() - began, 1e-6)
            progress.update(task, completed=done, note=f"{rate:,.0f} samples/s")

        if arguments.check:
            read_dataset(folder, None, show)
        else:
            manifest = write_dataset(folder, label_settings(config), total, data_seed(config), config.threads, show)
    seconds = time.perf_counter() - began
    size = sum((folder / shard.file).stat().st_size for shard in manifest.shards)
    made = 0 if arguments.check else manifest.samples - first[0]
    if arguments.json:
        shown = {"folder": str(folder), "samples": manifest.samples, "made": made, "bytes": size, "seconds": seconds}
        print(json.dumps(shown, indent=2))
    else:
        what = "checked" if arguments.check else f"{made:,} made in {seconds:.1f} s, {made / seconds:,.0f}/s"
        print(f"{folder}: {manifest.samples:,} samples in {len(manifest.shards)} shards, {size / 1e6:.0f} MB; {what}")
    if arguments.sheet:
        from hiernav.planner.sheet import draw_sheet

        draw_sheet(read_dataset(folder, min(manifest.samples, 2000)), manifest.settings, arguments.sheet)
        print(f"wrote {arguments.sheet}", file=sys.stderr if arguments.json else sys.stdout)
    return 0
