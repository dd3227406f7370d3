"""The `hiernav` command. A sub-command imports what it needs when it runs.

Exit codes: 0 done; 1 training diverged, processes died, a replay differs, or a result is damaged; 2 bad input, with one
line that says what to do; 130 interrupted; 141 nobody reads the output any more; 143 interrupted by SIGTERM.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from hiernav.files import write_json
from hiernav.run import TrainingDiverged, WorkersLost, check_stage

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from hiernav.config import TrainConfig
    from hiernav.sim.layout import WorldSpec

FAILED, BAD_INPUT, INTERRUPTED, UNREAD, TERMINATED = 1, 2, 130, 141, 143


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived, as from systemd, Slurm, Docker or `timeout`: all that Ctrl-C does is to happen."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    parser = _parser()
    arguments, more = parser.parse_known_args(argv)
    if more:
        if "overrides" not in arguments or any(text.startswith("-") for text in more):
            arguments.parser.error(f"unrecognized arguments: {' '.join(more)}")
        arguments.overrides += more  # argparse itself takes one group of KEY=VALUE, but no second one after an option
    try:
        with _sigterm_as_ctrl_c():
            code = arguments.run(arguments) or 0
            sys.stdout.flush()  # here, where a pipe that nobody reads can still be told from all else
            return code
    except KeyboardInterrupt as error:
        print("interrupted", file=sys.stderr)
        return _interruption(error)
    except (ValueError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _reader_is_gone():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more as it ends
            return UNREAD
        print(f"hiernav {arguments.command}: {_one_line(error)}", file=sys.stderr)
        return BAD_INPUT
    except (TrainingDiverged, WorkersLost) as error:
        print(f"hiernav {arguments.command}: {_one_line(error)}", file=sys.stderr)
        return FAILED
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("hiernav"):
            raise
        extra = "ray" if error.name == "ray" else "train"
        how = f"`pip install -e '.[{extra}]'` in the checkout installs it"
        print(f"hiernav {arguments.command}: needs {error.name}: {how}", file=sys.stderr)
        return BAD_INPUT


@contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Raise `Terminated` where SIGTERM arrives, so that nothing is left half done; in the main thread alone."""
    before = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or before not in (
        signal.SIG_DFL,
        signal.default_int_handler,
    ):
        yield  # whoever ignores or handles it already has a reason
        return
    owner = os.getpid()

    def stop(number: int, _frame: FrameType | None) -> None:
        if os.getpid() != owner:  # a fork of this process, such as a worker: it ends as if it had no handler
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        raise Terminated

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _interruption(error: KeyboardInterrupt) -> int:
    return TERMINATED if isinstance(error, Terminated) else INTERRUPTED


def _reader_is_gone() -> bool:
    """Whether the standard output is a pipe or socket that nobody reads any more."""
    poll = select.poll()
    try:
        poll.register(sys.stdout.fileno(), 0)
    except (OSError, ValueError):
        return False
    return any(state & (select.POLLERR | select.POLLHUP) for _, state in poll.poll(0))


def _parser() -> argparse.ArgumentParser:
    from hiernav import __version__

    parser = argparse.ArgumentParser(
        prog="hiernav", description="Plan with a waypoint network, move with a learned skill, deploy without torch."
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser(
        "train",
        help="train planner and skill into one run folder",
        description="Train the planner, then the skill, into one run folder. Ctrl-C is safe: go on with --resume.",
        epilog="Every value can be set as key.path=value, for example skill.total_steps=50000; "
        "`hiernav config` lists them all.",
    )
    _add_configuration(train, "YAML with what differs from the defaults")
    train.add_argument("--resume", metavar="RUN", help="go on with this run folder from its last checkpoints")
    train.add_argument("--stage", choices=("planner", "skill", "all"), default="all", help="what to train (all)")
    train.add_argument(
        "--from",
        dest="source",
        metavar="RUN|BUNDLE",
        help="fine-tune the planner of this run or bundle into a new run, which takes over its skill (--stage planner)",
    )
    train.add_argument(
        "--worlds",
        action="append",
        metavar="WORLD",
        help="train in this world; repeat for a mix (planner.worlds, skill.worlds, or both, by --stage)",
    )
    train.add_argument(
        "--collector",
        choices=("local", "multi", "ray"),
        help="who simulates: this process, several, or a Ray cluster (skill.collector)",
    )
    train.add_argument("--workers", metavar="N", help="processes that simulate, for multi and ray (skill.workers)")
    train.add_argument("--ray-address", metavar="ADDRESS", help="Ray cluster to join (skill.ray_address)")
    train.set_defaults(run=_train, parser=train)

    evaluate = commands.add_parser(
        "evaluate",
        help="measure policies on worlds",
        description="Drive policies through sampled worlds and report reach rate, steps, collisions and SPL.",
    )
    source = evaluate.add_mutually_exclusive_group(required=True)
    source.add_argument("--bundle", metavar="DIR", help="an exported bundle")
    source.add_argument("--run", dest="run_path", metavar="RUN", help="a run folder")
    evaluate.add_argument("--robot", help="fail unless the policies are for this robot")
    evaluate.add_argument(
        "--world", action="append", metavar="WORLD", help="a world; repeat for several (pillar(2,2,10))"
    )
    evaluate.add_argument(
        "--protocol",
        choices=("paper", "strict"),
        default="strict",
        help="how to count (strict): strict is of 1000 episodes; paper of 200, and counts no contacts with gremlins",
    )
    evaluate.add_argument("--planner", choices=("cnn", "astar"), default="cnn", help="who plans (cnn)")
    evaluate.add_argument(
        "--no-repair", action="store_true", help="drive the network's plans even if they collide (cnn only)"
    )
    evaluate.add_argument("--no-recovery", action="store_true", help="let a robot that stands still stand")
    evaluate.add_argument("--no-prediction", action="store_true", help="plan on maps as they are, not as they will be")
    evaluate.add_argument("--episodes", type=int, metavar="N", help="per world (protocol's number)")
    evaluate.add_argument("--seed", type=int, default=0, help="decides the worlds (0)")
    evaluate.add_argument("--json", metavar="FILE", help="write the results, an object per world; - for the screen")
    evaluate.set_defaults(run=_evaluate, parser=evaluate)

    watch = commands.add_parser(
        "watch",
        help="film policies at work",
        description="Film the first episodes that `hiernav evaluate` would drive with the same seed: field, robot, "
        "waypoints, where plans were replaced and why, and collisions.",
        epilog="A film is named after its world; MP4 where OpenCV can encode it, GIF elsewhere.",
    )
    watch.add_argument("run_path", nargs="?", metavar="RUN", help="a run folder (the newest one in runs/)")
    watch.add_argument("--bundle", metavar="DIR", help="an exported bundle instead of a run")
    watch.add_argument("--world", action="append", metavar="WORLD", help="a world; repeat for several (pillar(2,2,10))")
    watch.add_argument("--episodes", type=int, default=3, metavar="N", help="per world (3)")
    watch.add_argument("--seed", type=int, default=0, help="decides the worlds (0)")
    watch.add_argument(
        "--planner", choices=("cnn", "astar"), help="who plans (cnn, or astar where there is no cnn yet)"
    )
    watch.add_argument("--view", choices=("top", "mujoco"), default="top", help="mujoco adds MuJoCo's camera (top)")
    watch.add_argument("--lidar", action="store_true", help="draw what the lidar reads")
    watch.add_argument("--speed", type=float, default=1.0, help="of the film; 1 is the robot's own (1)")
    watch.add_argument("--fps", type=float, help="frames per second (one for each control step, at most 25)")
    watch.add_argument("--size", type=int, default=480, metavar="PIXELS", help="longer side of the field (480)")
    watch.add_argument(
        "--out", type=Path, metavar="PATH", help="a film ending in .mp4 or .gif, or a folder (RUN/films, or runs/films)"
    )
    watch.set_defaults(run=_watch, parser=watch)

    export = commands.add_parser(
        "export",
        help="turn a run into a bundle of ONNX files",
        description="Export a run's planner and skill, with all they assume, to a verified bundle.",
    )
    export.add_argument("--run", dest="run_path", metavar="RUN", help="a run folder (the newest one in runs/)")
    export.add_argument(
        "--onnx",
        nargs="?",
        const="",
        metavar="DIR",
        required=True,
        help="write a bundle of ONNX files; DIR is replaced if it holds one (RUN/bundle)",
    )
    export.set_defaults(run=_export, parser=export)

    replay = commands.add_parser(
        "replay",
        help="run the policies again on a recording",
        description="Run estimator, planner, skill and guard again on what a recording (run_loop.py --record) says "
        "they were given, and compare bit for bit. Exit code 1 if a tick differs.",
    )
    replay.add_argument("recording", metavar="RUN.mcap", help="the recording")
    replay.add_argument("--bundle", metavar="DIR", help="policies (those of the recording)")
    replay.add_argument("--json", metavar="FILE", help="write the result; - for the screen")
    replay.set_defaults(run=_replay, parser=replay)

    dataset = commands.add_parser(
        "dataset",
        help="make labelled samples for the planner",
        description="Label starts in sampled worlds with shortest paths, for `hiernav train planner.data=DIR`. Ctrl-C "
        "is safe: the same command goes on, and one with more samples makes the data set larger.",
        epilog="An entry of a mix may have a weight, ranges, and a density: 2*pillar(2..8,2..8,0.4..0.7/m2). "
        "All else is taken from the configuration: robot, planning radius, margin, preset, seed, threads.",
    )
    dataset.add_argument("--out", metavar="DIR", required=True, help="where the data set is, or is to be")
    _add_configuration(dataset, "YAML with what differs from the defaults")
    dataset.add_argument("--samples", metavar="N", help="how many (planner.samples)")
    dataset.add_argument("--world", action="append", metavar="WORLD", help="repeat for a mix (planner.worlds)")
    dataset.add_argument("--sheet", metavar="FILE", help="write a PNG of some samples")
    dataset.add_argument("--check", action="store_true", help="make nothing: read all of it and check it")
    dataset.add_argument("--json", action="store_true", help="print what was made as JSON")
    dataset.set_defaults(run=_dataset, parser=dataset)

    report = commands.add_parser(
        "report",
        help="make one page of all results",
        description="Turn the results of tools/reproduce.py into one HTML file that needs no network: the paper's "
        "tables beside ours, curves, films, and what fell short. Exit code 1 if a result file is damaged.",
    )
    report.add_argument("--results", type=Path, default=Path("results"), metavar="DIR", help="(results)")
    report.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE", help="(report.html)")
    report.add_argument(
        "--curves", type=Path, metavar="FILE", help="draw the training curves of all robots as well (PNG, SVG or PDF)"
    )
    report.set_defaults(run=_report, parser=report)

    world = commands.add_parser(
        "world", help="draw a world", description="Sample a world from a seed and draw it, or print it as JSON."
    )
    world.add_argument(
        "--kind", "--world", default="pillar(2,2,10)", metavar="WORLD", help="which world (pillar(2,2,10))"
    )
    world.add_argument("--seed", type=int, default=0, help="decides the layout (0)")
    world.add_argument("--radius", type=float, default=0.1, help="of the robot it must be solvable for [m] (0.1)")
    world.add_argument("--png", metavar="FILE", help="picture to write")
    world.add_argument("--json", action="store_true", help="print the layout as JSON")
    world.set_defaults(run=_world, parser=world)

    config = commands.add_parser(
        "config",
        help="list every setting",
        description="List every setting with its default, or print a resolved configuration as YAML.",
    )
    _add_configuration(config, "resolve this file instead of listing the settings")
    config.set_defaults(run=_config, parser=config)
    return parser


def _add_configuration(parser: argparse.ArgumentParser, file_help: str) -> None:
    """What a command takes that runs on a configuration: a file, and values that override it."""
    parser.add_argument("--config", metavar="FILE", help=file_help)
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="values that override the file's")


def _train(arguments: argparse.Namespace) -> int:
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
        run = begin_fine_tuning(_check_training(config, arguments.stage, overrides), arguments.source)
    elif arguments.resume:
        if arguments.config or overrides:
            raise RunError(
                "--resume takes its configuration from the run folder: leave out --config and KEY=VALUE, "
                "also as --worlds, --collector, --workers or --ray-address"
            )
        run = Run.open(arguments.resume)
    else:
        config = load_config(arguments.config, overrides)
        _check_collector(config, overrides)
        run = Run.create(_check_training(config, arguments.stage, overrides))
    from hiernav.training import train

    print(f"run folder: {run.path}")
    try:
        with _progress() as progress:
            train(run, arguments.stage, progress)
    except KeyboardInterrupt as error:
        again = f"hiernav train --resume {run.path}" + (arguments.stage != "all") * f" --stage {arguments.stage}"
        saved = any(run.has(stage) for stage in stages)
        where = "go on from the last checkpoint" if saved else "there is no checkpoint yet, begin it again"
        print(f"stopped; {where} with: {again}", file=sys.stderr)
        return _interruption(error)
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


def _worlds(arguments: argparse.Namespace) -> list[WorldSpec]:
    """Those of `--world`, each once, in the order of their first mention, with a `--seed` that can decide them.

    Raises:
        ValueError: there is no such world, or the seed is negative.
    """
    from hiernav.sim.layout import parse_world

    if arguments.seed < 0:
        raise ValueError(f"--seed is {arguments.seed}, it must not be negative")
    worlds = (parse_world(text) for text in arguments.world or ["pillar(2,2,10)"])
    return list({str(world): world for world in worlds}.values())


def _evaluate(arguments: argparse.Namespace) -> int:
    from hiernav.evaluate import EPISODES, evaluate, fingerprints, open_policies

    worlds = _worlds(arguments)
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
    with _progress() as progress:
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
        _print_results(results)
        if arguments.json:
            write_json(Path(arguments.json), results)
    return 0


def _watch(arguments: argparse.Namespace) -> int:
    from hiernav.film.gl import choose_gl

    if arguments.view == "mujoco":
        choose_gl()
    from hiernav.evaluate import open_policies
    from hiernav.film.film import FilmSettings, film_names, make_film
    from hiernav.film.writer import SUFFIXES, default_suffix
    from hiernav.run import newest_run

    worlds = _worlds(arguments)
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
    with _progress() as progress:
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


def _export(arguments: argparse.Namespace) -> int:
    from hiernav.export import export_run
    from hiernav.run import newest_run

    run = Path(arguments.run_path) if arguments.run_path else newest_run()
    out = export_run(run, arguments.onnx or run / "bundle")
    total = sum(file.stat().st_size for file in out.iterdir())
    print(f"{out}: {', '.join(sorted(file.name for file in out.iterdir()))}; {total / 1e6:.2f} MB, checked")
    return 0


def _replay(arguments: argparse.Namespace) -> int:
    from hiernav.nav.bundle import load_bundle
    from hiernav.runtime.log_reader import RunLog
    from hiernav.runtime.replay import Replay

    log = RunLog(arguments.recording)
    replay = Replay(log, load_bundle(arguments.bundle or log.about.get("bundle", "")))
    with _progress() as progress:
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


def _dataset(arguments: argparse.Namespace) -> int:
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
    with _progress() as progress:
        if arguments.check:
            manifest = read_manifest(folder)
        else:
            config = load_config(arguments.config, overrides)
            _check_worlds(config)
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


def _report(arguments: argparse.Namespace) -> int:
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


def _world(arguments: argparse.Namespace) -> int:
    from hiernav.sim.layout import parse_world
    from hiernav.sim.worlds import sample_layout

    if arguments.png and Path(arguments.png).suffix != ".png":
        raise ValueError(f"--png {arguments.png} must end in .png")
    layout = sample_layout(parse_world(arguments.kind), arguments.seed, arguments.radius)
    if arguments.json or not arguments.png:
        shown = {
            "world": str(layout.spec),
            "seed": layout.seed,
            "start": layout.start.tolist(),
            "goal": layout.goal.tolist(),
            "pillars": layout.pillars.tolist(),
            "gremlins": layout.gremlins.tolist(),
            "walls": layout.walls.tolist(),
            "max_steps": layout.spec.max_steps,
            "redraws": layout.redraws,
        }
        print(json.dumps(shown, indent=2))
    if arguments.png:
        from hiernav.draw import draw_layout

        draw_layout(layout, Path(arguments.png))
        print(f"wrote {arguments.png}", file=sys.stderr if arguments.json else sys.stdout)
    return 0


def _config(arguments: argparse.Namespace) -> int:
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
    _console(piped_width=1_000).print(table)  # one line per setting, for grep
    return 0


def _check_training(config: TrainConfig, stage: str, overrides: Sequence[str]) -> TrainConfig:
    """Refuse what cannot be trained, or not on this machine, before a run folder is made; what will be trained."""
    check_stage(config, stage)
    _check_worlds(config)
    _check_scene(config)
    _check_machine(config)
    return _with_worlds_of_data(config, overrides)


def _check_collector(config: TrainConfig, overrides: list[str]) -> None:
    """Refuse settings of workers and clusters where nobody would ask for them."""
    from hiernav.config import ConfigError

    skill = config.skill
    # a file may say it for whenever there are workers
    if skill.collector == "local" and any(text.startswith("skill.workers=") for text in overrides):
        raise ConfigError(f"skill.workers = {skill.workers}, expected with skill.collector = 'multi' or 'ray' only")
    if skill.collector != "ray" and skill.ray_address is not None:
        raise ConfigError(f"skill.ray_address = {skill.ray_address!r}, expected with skill.collector = 'ray' only")


def _check_worlds(config: TrainConfig) -> None:
    """Refuse worlds that cannot be built or solved, or planned in, before anything is written."""
    from hiernav.config import ConfigError
    from hiernav.planner.mix import WorldRange
    from hiernav.sim.factory import expert_planner
    from hiernav.sim.layout import parse_world
    from hiernav.sim.robots import get_robot
    from hiernav.sim.worlds import sample_layout

    expert_planner(config)  # no narrower than the robot
    body = get_robot(config.robot).radius
    planned = config.planner.planning_radius_m or body
    for key, texts, radius in (
        ("planner.worlds", config.planner.worlds, planned),
        ("skill.worlds", config.skill.worlds, body),
    ):
        for text in texts:
            try:
                specs = WorldRange(text).extremes() if key == "planner.worlds" else (parse_world(text),)
                for spec in specs:
                    sample_layout(spec, 0, radius)
            except ValueError as error:
                raise ConfigError(f"{key} = {text!r}: {error}") from None


def _check_scene(config: TrainConfig) -> None:
    """Refuse training worlds of the skill that one simulation cannot show in turn."""
    from hiernav.config import ConfigError
    from hiernav.sim.layout import parse_world
    from hiernav.sim.scene import scene_for

    try:
        scene_for([parse_world(text) for text in config.skill.worlds])
    except ValueError as error:
        raise ConfigError(f"skill.worlds = {list(config.skill.worlds)}: {error}") from None


def _check_machine(config: TrainConfig) -> None:
    """Fail before a run folder is made when what the training needs is not installed, or there is no such device."""
    import tensorboard  # noqa: F401
    import torch  # noqa: F401
    import torchrl  # noqa: F401

    from hiernav.device import choose_device

    choose_device(config.planner.device, "planner.device")
    choose_device(config.skill.device, "skill.device")
    if config.skill.collector == "ray":
        import ray  # noqa: F401


def _with_worlds_of_data(config: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    """The configuration with the worlds that its planner's data set was made in.

    Refuses a data set that is not there or that this run cannot learn from, and other worlds on the command line; those
    of a file give way.
    """
    from hiernav.config import ConfigError

    if config.planner.data is None or config.skill.preset == "baseline":  # which has no planner
        return config
    from hiernav.planner.train import with_worlds_of_data

    found = with_worlds_of_data(config)
    if found != config and any(text.startswith("planner.worlds=") for text in overrides):
        raise ConfigError(
            f"planner.worlds = {list(config.planner.worlds)}, but planner.data = {config.planner.data!r} "
            f"was made in {list(found.planner.worlds)}: leave one of them out"
        )
    return found


def _print_results(results: dict[str, dict[str, Any]]) -> None:
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
    console = _console()
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


@contextmanager
def _progress() -> Iterator[Progress]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(compact=True, elapsed_when_finished=False),
        TextColumn("{task.fields[note]}"),
        console=_console(stderr=True),
    )
    with progress:
        try:
            yield progress
        except (ValueError, OSError):
            # bad input: the error is all there is to see
            progress.live.transient = True
            progress.console.quiet = not progress.console.is_interactive
            raise


def _console(stderr: bool = False, piped_width: int = 120) -> Console:
    """As wide as the terminal, or as `piped_width` columns where there is none."""
    from rich.console import Console

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            raise  # called while BrokenPipeError is handled: rich itself would exit with code 1

    console = Screen(stderr=stderr)
    if not console.is_terminal:
        console.width = piped_width
    return console


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    sys.exit(main())
