"""`hiernav evaluate`: policies measured on worlds."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from hiernav.commands.arguments import Commands, worlds_of
from hiernav.commands.screen import progress_bars, screen
from hiernav.files import write_json


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "evaluate",
        help="measure policies on worlds",
        description="Drive policies through sampled worlds and report reach rate, steps, collisions and SPL.",
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--bundle", metavar="DIR", help="an exported bundle")
    source.add_argument("--run", dest="run_path", metavar="RUN", help="a run folder")
    parser.add_argument("--robot", help="fail unless the policies are for this robot")
    parser.add_argument(
        "--world", action="append", metavar="WORLD", help="a world; repeat for several (pillar(2,2,10))"
    )
    parser.add_argument(
        "--protocol",
        choices=("paper", "strict"),
        default="strict",
        help="how to count (strict): strict is of 1000 episodes; paper of 200, and counts no contacts with gremlins",
    )
    parser.add_argument("--planner", choices=("cnn", "astar"), default="cnn", help="who plans (cnn)")
    parser.add_argument(
        "--no-repair", action="store_true", help="drive the network's plans even if they collide (cnn only)"
    )
    parser.add_argument("--no-recovery", action="store_true", help="let a robot that stands still stand")
    parser.add_argument("--no-prediction", action="store_true", help="plan on maps as they are, not as they will be")
    parser.add_argument("--episodes", type=int, metavar="N", help="per world (protocol's number)")
    parser.add_argument("--seed", type=int, default=0, help="decides the worlds (0)")
    parser.add_argument("--json", metavar="FILE", help="write the results, an object per world; - for the screen")
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.evaluate import EPISODES, evaluate, fingerprints, open_policies

    worlds = worlds_of(arguments)
    if arguments.no_repair and arguments.planner == "astar":
        raise ValueError("--no-repair is for plans of the network, with --planner astar there are none")
    if arguments.json and arguments.json != "-" and Path(arguments.json).is_dir():
        raise ValueError(f"--json {arguments.json} is a folder, it must be a file")
    source = arguments.bundle or arguments.run_path
    policies, files = open_policies(source), fingerprints(source)
    robot = policies.config.robot
    if arguments.robot and arguments.robot != robot:
        raise ValueError(f"these policies are for robot {robot!r}, not {arguments.robot!r}")
    count = EPISODES[arguments.protocol] if arguments.episodes is None else arguments.episodes
    with progress_bars() as progress:
        tasks = {str(world): progress.add_task(str(world), total=count, note="") for world in worlds}
        reached = dict.fromkeys(tasks, 0)

        def show(world: str, _: int, episode: Any) -> None:
            reached[world] += episode.reached
            progress.advance(tasks[world])
            done = progress.tasks[tasks[world]].completed
            progress.update(tasks[world], note=f"reach {reached[world] / done:.3f}")

        results = evaluate(
            policies,
            worlds,
            arguments.protocol,
            arguments.planner,
            arguments.episodes,
            arguments.seed,
            repair=not arguments.no_repair,
            on_episode=show,
            recover=not arguments.no_recovery,
            predict=not arguments.no_prediction,
        )
    results = {world: {"policies": source, "sha256": files, **row} for world, row in results.items()}
    if arguments.json == "-":
        print(json.dumps(results, indent=2))
    else:
        _print(results)
        if arguments.json:
            write_json(Path(arguments.json), results)
    return 0


def _print(results: dict[str, dict[str, Any]]) -> None:
    from rich.table import Table

    first = next(iter(results.values()))
    title = f"{first['robot']}, {first['planner']} planner, {first['protocol']} protocol, seed {first['seed']}"
    table = Table(title=title)
    for column in ("world", "episodes", "reach rate", "95 %", "steps", "collisions", "collision-free", "SPL"):
        table.add_column(column, justify="left" if column == "world" else "right")
    for name, row in results.items():
        low, high = row["reach_ci95"]
        table.add_row(
            name,
            str(row["episodes"]),
            f"{row['reach_rate']:.3f}",
            f"{low:.3f} - {high:.3f}",
            f"{row['steps_mean']:.1f}",
            f"{row['collisions_mean']:.2f}",
            f"{row['collision_free_rate']:.3f}",
            "-" if row["spl_mean"] is None else f"{row['spl_mean']:.3f}",
        )
    console = screen()
    console.print(table)
    for name, row in results.items():
        replans = ", ".join(f"{reason} {count}" for reason, count in row["replans"].items())
        checked = (
            f"; {row['repairs']} of {row['proposals']} plans repaired, "
            f"{row['loops']} for leading back, {row['detours']} for leading away"
            if "repairs" in row
            else ""
        )
        console.print(f"{name}: plans ended by {replans}{checked}", style="dim", highlight=False)
