"""`hiernav watch`: films of policies at work."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from hiernav.commands.arguments import Commands, worlds_of
from hiernav.commands.screen import progress_bars


def add(commands: Commands) -> None:
    """Add it to the command line."""
    parser = commands.add_parser(
        "watch",
        help="film policies at work",
        description="Film the first episodes that `hiernav evaluate` would drive with the same seed: field, robot, "
        "waypoints, where plans were replaced and why, and collisions.",
        epilog="A film is named after its world; MP4 where OpenCV can encode it, GIF elsewhere.",
    )
    parser.add_argument("run_path", nargs="?", metavar="RUN", help="a run folder (the newest one in runs/)")
    parser.add_argument("--bundle", metavar="DIR", help="an exported bundle instead of a run")
    parser.add_argument(
        "--world", action="append", metavar="WORLD", help="a world; repeat for several (pillar(2,2,10))"
    )
    parser.add_argument("--episodes", type=int, default=3, metavar="N", help="per world (3)")
    parser.add_argument("--seed", type=int, default=0, help="decides the worlds (0)")
    parser.add_argument(
        "--planner", choices=("cnn", "astar"), help="who plans (cnn, or astar where there is no cnn yet)"
    )
    parser.add_argument("--view", choices=("top", "mujoco"), default="top", help="mujoco adds MuJoCo's camera (top)")
    parser.add_argument("--lidar", action="store_true", help="draw what the lidar reads")
    parser.add_argument("--speed", type=float, default=1.0, help="of the film; 1 is the robot's own (1)")
    parser.add_argument("--fps", type=float, help="frames per second (one for each control step, at most 25)")
    parser.add_argument("--size", type=int, default=480, metavar="PIXELS", help="longer side of the field (480)")
    parser.add_argument(
        "--out", type=Path, metavar="PATH", help="a film ending in .mp4 or .gif, or a folder (RUN/films, or runs/films)"
    )
    parser.set_defaults(run=run, parser=parser)


def run(arguments: argparse.Namespace) -> int:
    from hiernav.film.gl import choose_gl

    if arguments.view == "mujoco":
        choose_gl()
    from hiernav.evaluate import open_policies
    from hiernav.film.film import FilmSettings, film_names, make_film
    from hiernav.film.writer import SUFFIXES, default_suffix
    from hiernav.run import newest_run

    worlds = worlds_of(arguments)
    settings = FilmSettings(arguments.view, arguments.lidar, arguments.size, arguments.speed, arguments.fps)
    if arguments.run_path and arguments.bundle:
        raise ValueError("a run and a bundle at once: leave out one of them")
    source = Path(arguments.bundle or arguments.run_path or newest_run())
    policies = open_policies(source)
    planner = arguments.planner or ("cnn" if policies.network is not None else "astar")
    if arguments.planner is None and planner == "astar" and not policies.is_baseline:
        print(f"{source} has no planner network yet: the shortest-path planner plans", file=sys.stderr)
    if arguments.out and arguments.out.suffix not in SUFFIXES and arguments.out.suffix[1:].isalpha():
        raise ValueError(f"--out {arguments.out}: the name of a film must end in {' or '.join(SUFFIXES)}")
    out = arguments.out or (Path("runs/films") if arguments.bundle else source / "films")
    if out.suffix not in SUFFIXES:
        films = {world: out / f"{name}{default_suffix()}" for world, name in film_names(worlds).items()}
    elif len(worlds) == 1:
        films = {worlds[0]: out}
    else:
        raise ValueError(f"--out {out} is one film, and there are {len(worlds)} worlds: name a folder")
    reached: dict[Path, int] = {}
    with progress_bars() as progress:
        tasks = {world: progress.add_task(str(world), total=arguments.episodes, note="") for world in worlds}
        for world, film in films.items():
            began = time.perf_counter()

            def show(frames: int, task: Any = tasks[world], began: float = began) -> None:
                rate = frames / max(time.perf_counter() - began, 1e-6)
                progress.update(task, note=f"{frames:,} frames  {rate:.0f} frames/s")

            episodes = make_film(
                policies,
                world,
                film,
                episodes=arguments.episodes,
                seed=arguments.seed,
                planner=planner,
                settings=settings,
                on_frame=show,
                on_episode=lambda *_, task=tasks[world]: progress.advance(task),
            )
            reached[film] = sum(episode.reached for episode in episodes)
    for film, count in reached.items():
        print(f"{film}: {arguments.episodes} episodes, {count} reached the goal")
    return 0
