"""`hiernav train`: planner and skill into one run folder."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from hiernav.commands.arguments import Commands, add_configuration
from hiernav.commands.exits import interruption
from hiernav.commands.screen import progress_bars


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "train",
        help="train planner and skill into one run folder",
        description="Train the planner, then the skill, into one run folder. Ctrl-C is safe: go on with --resume.",
        epilog="Every value can be set as key.path=value, for example skill.total_steps=50000; "
        "`hiernav config` lists them all.",
    )
    add_configuration(parser, "YAML with what differs from the defaults")
    parser.add_argument("--resume", metavar="RUN", help="go on with this run folder from its last checkpoints")
    parser.add_argument("--stage", choices=("planner", "skill", "all"), default="all", help="what to train (all)")
    parser.add_argument(
        "--from",
        dest="source",
        metavar="RUN|BUNDLE",
        help="fine-tune the planner of this run or bundle into a new run, which takes over its skill (--stage planner)",
    )
    parser.add_argument(
        "--worlds",
        action="append",
        metavar="WORLD",
        help="train in this world; repeat for a mix (planner.worlds, skill.worlds, or both, by --stage)",
    )
    parser.add_argument(
        "--collector",
        choices=("local", "multi", "ray"),
        help="who simulates: this process, several, or a Ray cluster (skill.collector)",
    )
    parser.add_argument("--workers", metavar="N", help="processes that simulate, for multi and ray (skill.workers)")
    parser.add_argument("--ray-address", metavar="ADDRESS", help="Ray cluster to join (skill.ray_address)")
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.check import check_collector, check_threads, check_training
    from hiernav.config import load_config
    from hiernav.run import Run, RunError

    flags = {"skill.collector": arguments.collector, "skill.workers": arguments.workers}
    flags["skill.ray_address"] = arguments.ray_address
    stages = ("planner", "skill") if arguments.stage == "all" else (arguments.stage,)
    overrides = [f"{key}={value}" for key, value in flags.items() if value is not None]
    overrides += _worlds_of_stages(arguments, stages) + arguments.overrides
    if arguments.source:
        if arguments.stage != "planner" or arguments.config or arguments.resume:
            raise RunError("--from fine-tunes the planner: use it with --stage planner, without --config and --resume")
        from hiernav.finetune import begin_fine_tuning, fine_tuning_config

        config = fine_tuning_config(arguments.source, overrides)
        run = begin_fine_tuning(check_training(config, arguments.stage, overrides), arguments.source)
    elif arguments.resume:
        if arguments.config or overrides:
            raise RunError(
                "--resume takes its configuration from the run folder: leave out --config and KEY=VALUE, "
                "also as --worlds, --collector, --workers or --ray-address"
            )
        run = Run.open(arguments.resume)
        check_threads(run.config)
    else:
        config = load_config(arguments.config, overrides)
        check_collector(config, overrides)
        run = Run.create(check_training(config, arguments.stage, overrides))
    from hiernav.training import train

    print(f"run folder: {run.path}")
    try:
        with progress_bars() as progress:
            train(run, arguments.stage, progress)
    except KeyboardInterrupt as error:
        again = f"hiernav train --resume {run.path}" + (arguments.stage != "all") * f" --stage {arguments.stage}"
        saved = any(run.has(stage) for stage in stages)
        where = "go on from the last checkpoint" if saved else "there is no checkpoint yet, begin it again"
        print(f"stopped; {where} with: {again}", file=sys.stderr)
        return interruption(error)
    finally:
        run.close()
    missing = [stage for stage in ("planner", "skill") if not run.has(stage)]
    if run.config.skill.preset == "baseline":
        print(f"done; measure with: hiernav evaluate --run {run.path}")
    elif missing:
        print(f"done; train the {missing[0]} with: hiernav train --resume {run.path} --stage {missing[0]}")
    else:
        print(f"done; export with: hiernav export --run {run.path} --onnx")
    return 0


def _worlds_of_stages(arguments: argparse.Namespace, stages: Sequence[str]) -> list[str]:
    """What `train --worlds` sets; a setting that is spelled out on the command line goes before.

    Raises:
        ValueError: the skill would be trained in what is no world, but a mix.
    """
    from hiernav.sim.layout import parse_world

    worlds = arguments.worlds or []
    spelled = {text.partition("=")[0] for text in arguments.overrides}
    for world in worlds if "skill" in stages and "skill.worlds" not in spelled else ():
        try:
            parse_world(world)
        except ValueError as error:
            raise ValueError(
                f"--worlds {world}: {error}; a mix is for the planner alone: say skill.worlds=[...] too"
            ) from None
    return [f"{stage}.worlds={json.dumps(worlds)}" for stage in stages if worlds]
