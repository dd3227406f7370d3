#!/usr/bin/env python3
"""The paper's tables and figures, run again: a queue that can be stopped at any time.

    python tools/reproduce.py --list                                     # every cell, its state and how long it takes
    python tools/reproduce.py --only table2 sample_efficiency --seeds 5  # some experiments
    python tools/reproduce.py --no-training --budget 3h                  # the bundles that ship, for three hours
    python tools/reproduce.py --only 'table3/doggo-*'                    # some cells, and what they need

Results are small files, results/EXPERIMENT/CELL.json; a cell that has one is not run again, unless its settings or its
bundle have changed. A training that was stopped goes on from its checkpoint in runs/reproduce. A cell that fails is
recorded with its error and stays failed until --retry-failed. Several queues may run side by side.
`hiernav report` makes one page of the results.

Exit codes: 0 done, or the budget is used up; 1 a cell failed; 2 bad input; 130 stopped.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import sys
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from bad_input import whole  # noqa: E402
from rich.console import Console  # noqa: E402

from hiernav.reproduce.cells import TRAINING, Places  # noqa: E402
from hiernav.reproduce.child import run_in_process  # noqa: E402
from hiernav.reproduce.display import Bars, cells_as_json, print_cells, print_tally  # noqa: E402
from hiernav.reproduce.experiments import EXPERIMENTS, FULL, ROBOTS, SMOKE, catalogue  # noqa: E402
from hiernav.reproduce.queue import Queue, select  # noqa: E402

BAD_INPUT, INTERRUPTED = 2, 130


def main(argv: list[str] | None = None) -> int:
    arguments = _parser().parse_args(argv)
    signal.signal(signal.SIGTERM, _stop)
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"reproduce: {error}", file=sys.stderr)
        return BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    experiments = "\n".join(f"  {name:<18} {what}" for name, what in EXPERIMENTS.items())
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=f"experiments:\n{experiments}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="run nothing: show every cell")
    parser.add_argument("--only", nargs="+", default=[], metavar="WHAT", help="experiments, cells, or patterns of them")
    parser.add_argument("--seeds", type=whole(), metavar="N", help="of every training (5; 3 of the doggo's, of "
                        "Table II and of ablations of reward, curriculum, critics; 1 of the others)")  # fmt: skip
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=ROBOTS, help="(all)")
    parser.add_argument("--no-training", action="store_true", help="leave out what trains, or needs a training")
    parser.add_argument(
        "--budget", type=_seconds, metavar="TIME", help="45m, 3h, 1h30m: start nothing that takes longer"
    )
    parser.add_argument("--retry-failed", action="store_true", help="run failed cells again, and damaged result files")
    parser.add_argument("--json", action="store_true", help="print the cells, or what was run, as JSON")
    parser.add_argument("--results", type=Path, help="(results, or runs/smoke/results)")
    parser.add_argument("--runs", type=Path, help="trainings and logs (runs/reproduce, or runs/smoke)")
    parser.add_argument("--smoke", action="store_true", help="everything once and tiny, to see that it works")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    smoke = arguments.smoke
    runs = arguments.runs or ROOT / "runs" / ("smoke" if smoke else "reproduce")
    results = arguments.results or (runs / "results" if smoke else ROOT / "results")
    places = Places(ROOT, results.resolve(), runs.resolve())
    seeds = arguments.seeds or (1 if smoke else None)
    cells = catalogue(ROOT, SMOKE if smoke else FULL, seeds, arguments.robots)
    queue = Queue(select(cells, arguments.only, not arguments.no_training), places, run_in_process)
    screen, notes = Console(), Console(stderr=True)
    for console in (screen, notes):
        if not console.is_terminal:
            console.width = 160
    if arguments.list:
        if arguments.json:
            print(json.dumps(cells_as_json(queue.entries(), queue.estimate), indent=1))
        else:
            print_cells(screen, queue.entries(), queue.estimate)
        return 0
    left = queue.left(arguments.retry_failed)
    if any(cell.kind in TRAINING for cell in left) and find_spec("torchrl") is None:
        raise ValueError("training needs `pip install -e '.[train]'` in the checkout; --no-training leaves it out")
    bars = Bars(notes, left, queue.estimate)
    with bars.bars:
        tally = queue.run(arguments.budget, arguments.retry_failed, bars)
    if arguments.json:
        print(json.dumps(asdict(tally), indent=1))
    print_tally(notes if arguments.json else screen, tally)
    return INTERRUPTED if tally.stopped else 1 if tally.failed else 0


def _seconds(text: str) -> float:
    found = re.fullmatch(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s)?", text)
    if not text or found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no time; write 45m, 3h or 1h30m")
    hours, minutes, seconds = (float(part or 0) for part in found.groups())
    return 3600 * hours + 60 * minutes + seconds


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
