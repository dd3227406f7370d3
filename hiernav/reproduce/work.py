"""The work of one cell, of every kind. What trains imports torch when it runs."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hiernav.config import OptionConfig, RewardConfig, TrainConfig, differences, load_config
from hiernav.evaluate import Policies, evaluate, evaluate_plans, open_policies, summarize, under_protocol
from hiernav.film.film import FilmSettings, make_film
from hiernav.film.writer import default_suffix
from hiernav.git import Code, code_name
from hiernav.planner import passes
from hiernav.reproduce.cells import Cell, Kind, Places, bundle_hashes, cell_key, training_hash
from hiernav.run import PhysicsBroke, Run, spent_seconds
from hiernav.sim.layout import parse_world
from hiernav.sim.rollout import Episode

Report = Callable[[float, str], None]
"""Takes the share that is done, 0 to 1, and what is being done."""

EVALUATION_SEED = 0
BREAKS = 10
"""Of the physics, with which a training is given up."""

WALKERS = {"network": ("cnn", False), "verified": ("cnn", True), "astar": ("astar", False)}
"""Whose plans are walked along: planner, and whether what collides is repaired."""


@dataclass
class Outcome:
    """What a cell found out."""

    metrics: dict[str, Any]
    source: dict[str, Any]
    settings: dict[str, Any] = field(default_factory=dict)
    curves: dict[str, list[dict[str, float | None]]] = field(default_factory=dict)
    gpu: str | None = None
    """That torch found, if it was of use at all."""


def run_cell(cell: Cell, places: Places, report: Report, code: Code) -> Outcome:
    """Do the work of a cell whose needs are met; a training goes on from its last checkpoint.

    Args:
        code: what this process runs, for a training to note. It is not asked of git here: what the process was forked
            from had loaded its modules before, and a commit may have come since.
    """
    works: dict[Kind, Callable[[Cell, Places, Report], Outcome]] = {
        "evaluate": _evaluate,
        "finetune": partial(_fine_tune, code=code),
        "train": partial(_train, code=code),
        "table2": partial(_table2, code=code),
        "walk": _walk,
        "film": _film,
    }
    return replace(works[cell.kind](cell, places, report), gpu=_gpu())


def _gpu() -> str | None:
    torch = sys.modules.get("torch")  # what drives a bundle does without
    return torch.cuda.get_device_name() if torch is not None and torch.cuda.is_available() else None


def training_of(cell: Cell, places: Places) -> tuple[Path, tuple[str, ...]]:
    """Run folder that a cell trains, and the stages that it trains there; none for cells that train nothing."""
    if cell.kind == "table2":
        assert cell.config is not None, cell.id
        return places.runs / "table2" / f"{cell.name}-{passes.digest(cell.config)}", ("planner",)
    if cell.kind == "finetune":
        return places.runs / f"{cell.experiment}-{cell.name}-{cell_key(cell, places)[:8]}", ("planner",)
    if cell.kind != "train" or cell.run is None:
        return places.runs, ()
    stage = cell.settings["stage"]
    return places.runs / cell.run, ("planner", "skill") if stage == "all" else (stage,)


def is_trained_here(cell: Cell, places: Places) -> bool:
    """Whether the run folder of a training holds what it trained, to its end.

    Where it was trained elsewhere its result came alone, and may have come while this place was half way with it.
    """
    folder, stages = training_of(cell, places)
    try:
        ended = json.loads((folder / "summary.json").read_text())
    except (OSError, ValueError):
        return False
    return all(stage in ended and (folder / stage / "checkpoint.pt").is_file() for stage in stages)


def trained_seconds(cell: Cell, places: Places) -> float:
    """What the training of a cell has taken so far, as its run folder tells."""
    folder, stages = training_of(cell, places)
    return sum(spent_seconds(folder, stage) for stage in stages)


def driven(
    policies: Policies, world: str, settings: Mapping[str, Any], report: Report, reward: RewardConfig | None = None
) -> dict[str, Any]:
    """Metrics of one drive through a world's episodes, under both protocols.

    The paper's episodes are the first ones of the strict protocol's, so they are driven once.

    Args:
        settings: `episodes`, and what differs: `paper_episodes`, `planner`, `repair`, `recover`, `predict`,
            `period`, `invalid`.
        reward: to measure returns by, instead of the one the policies were trained with. Without it, returns of a
            bundle, which does not tell its reward, are null.
    """
    config = policies.config
    names = {field.name for field in msgspec.structs.fields(OptionConfig)}
    option = {name: value for name, value in settings.items() if name in names}
    config = msgspec.structs.replace(config, option=msgspec.structs.replace(config.option, **option))
    if reward is not None:
        config = msgspec.structs.replace(config, reward=reward)
    policies = replace(policies, config=config, knows_reward=policies.knows_reward or reward is not None)
    spec, episodes = parse_world(world), dict[int, Episode]()

    def keep(_: str, number: int, episode: Episode) -> None:
        episodes[number] = episode
        report(len(episodes) / settings["episodes"], f"{len(episodes)} of {settings['episodes']} episodes")

    found = evaluate(
        policies,
        [spec],
        "strict",
        settings.get("planner", "cnn"),
        settings["episodes"],
        EVALUATION_SEED,
        settings.get("repair", True),
        on_episode=keep,
        recover=settings.get("recover", True),
        predict=settings.get("predict", True),
    )[str(spec)]
    found.pop("seconds")
    done = [episodes[number] for number in sorted(episodes)]
    metrics = {"strict": {**found, **_more(done)}}
    if count := settings.get("paper_episodes"):
        counted = under_protocol(done[:count], "paper", spec)
        helped = {name: found[name] for name in ("planner", "repair", "recover", "predict", "period", "invalid")}
        metrics["paper"] = {**helped, **summarize(counted, policies.knows_reward), **_more(counted)}
    return metrics


def _more(episodes: list[Episode]) -> dict[str, Any]:
    """What the summary of an evaluation lacks: half widths of 95 % intervals, and steps between plans."""
    values: dict[str, list[float]] = {
        "steps": [e.steps_counted for e in episodes],
        "collisions": [e.collisions for e in episodes],
        "spl": [e.spl for e in episodes],
    }
    ended = sum(sum(count for reason, count in e.replans.items() if reason != "goal") for e in episodes)
    plans = ended + sum(e.recoveries for e in episodes)
    return {
        **{f"{name}_half95": _half_width(each) for name, each in values.items()},
        "steps_between_plans": sum(e.steps for e in episodes) / plans if plans else None,
    }


def _half_width(values: list[float]) -> float | None:
    known = np.array(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return 1.96 * float(known.std(ddof=1)) / math.sqrt(len(known)) if len(known) > 1 else None


def _policies(cell: Cell, places: Places) -> tuple[Path, dict[str, Any]]:
    """Folder of a cell's policies, and what a result says of them."""
    if cell.bundle is not None:
        folder = places.root / cell.bundle
        return folder, {"bundle": cell.bundle, "sha256": bundle_hashes(folder)}
    assert cell.run is not None, cell.id
    return places.runs / cell.run, {"run": cell.run, "trained": training_hash(cell, places)}


def _evaluate(cell: Cell, places: Places, report: Report) -> Outcome:
    assert cell.world is not None
    folder, source = _policies(cell, places)
    return Outcome(driven(open_policies(folder), cell.world, cell.settings, report), source, cell.settings)


def _fine_tune(cell: Cell, places: Places, report: Report, code: Code) -> Outcome:
    """Fine-tune the planner on the cell's world, then drive there."""
    from hiernav.finetune import begin_fine_tuning, fine_tuning_config

    assert cell.world is not None
    source, about = _policies(cell, places)
    folder, _ = training_of(cell, places)
    if not (folder / "skill" / "checkpoint.pt").exists():
        shutil.rmtree(folder, ignore_errors=True)  # begun by an older version and killed: nothing to go on with
        overrides = [f"planner.worlds={json.dumps([cell.world])}", _run_dir(folder), f"seed={cell.seed or 0}"]
        begin_fine_tuning(fine_tuning_config(source, [*overrides, *cell.settings["fine_tuning"]]), source).close()
    _train_run(folder, "planner", report, code)
    metrics = driven(open_policies(folder), cell.world, cell.settings, report)
    return Outcome(metrics, {**about, "fine_tuned": folder.name, "commits": Run.open(folder).codes()}, cell.settings)


def _train(cell: Cell, places: Places, report: Report, code: Code) -> Outcome:
    """Train the skill, then drive with A* plans; or train the planner of a run whose skill is trained."""
    assert cell.run is not None and cell.config is not None
    folder, stage = training_of(cell, places)[0], cell.settings["stage"]
    if not (folder / "config.yaml").exists():
        folder.mkdir(parents=True, exist_ok=True)
        given = folder / "given.yaml"
        given.write_text(cell.config)
        Run.create(load_config(given, [_run_dir(folder)])).close()
    _train_run(folder, stage, report, code)
    if stage == "planner":
        curves = {"planner": _curve(folder, "planner")}
        metrics: dict[str, Any] = {"last": curves["planner"][-1]}
    else:
        curves = {"evaluation": _curve(folder, "evaluation")}
        # returns of all trainings by the baseline's reward, as in the paper
        reward = load_config(None, ["skill.preset=baseline"]).reward
        settings = {**cell.settings, "planner": "astar"}
        best = json.loads((folder / "summary.json").read_text())["skill"]
        found = driven(open_policies(folder), cell.world or "", settings, report, reward)
        metrics = {"best": {key: value for key, value in best.items() if key != "seconds"}, **found}
    source = {"run": cell.run, "commits": Run.open(folder).codes()}
    config = Run.open(folder).config
    computed = {key: value for part in training_of(cell, places)[1] for key, value in _computed(config, part).items()}
    return Outcome(metrics, source, {**cell.settings, **differences(config), **computed}, curves)


def _computed(config: TrainConfig, stage: str) -> dict[str, str]:
    """Device and precision that a stage is trained with in this process, "auto" resolved."""
    from hiernav.device import choose_device, choose_precision

    given = config.planner if stage == "planner" else config.skill
    device = choose_device(given.device, f"{stage}.device")
    precision = str(choose_precision(given.precision, device)).removeprefix("torch.")
    return {f"{stage}.device": device.type, f"{stage}.precision": precision}


def _table2(cell: Cell, places: Places, report: Report, code: Code) -> Outcome:
    from hiernav.planner.table import measure

    assert cell.world is not None and cell.seed is not None
    wanted = cell.settings
    folder, (run, _) = places.runs / "table2", training_of(cell, places)

    def show(what: str, done: int, total: int) -> None:
        report(done / total, f"{what}: {done:,} of {total:,}")

    more = {"world": cell.world, "episodes": wanted["episodes"], "settings": wanted.get("settings", ())}
    more["code"] = code_name(code)
    found = measure(folder, wanted["samples"], wanted["preset"], cell.seed, **more, on_progress=show)
    return Outcome(found, {"run": "table2", "commits": Run.open(run).codes()}, wanted)


def _walk(cell: Cell, places: Places, report: Report) -> Outcome:
    assert cell.world is not None
    folder, source = _policies(cell, places)
    policies, world, count = open_policies(folder), parse_world(cell.world), cell.settings["episodes"]
    metrics: dict[str, Any] = {}

    def show(done: int) -> None:
        report((len(metrics) + done / count) / len(WALKERS), f"{done} of {count} walks, {len(metrics)} planners done")

    for name, (planner, repair) in WALKERS.items():
        metrics[name] = evaluate_plans(policies, world, planner, repair, count, EVALUATION_SEED, show)
        metrics[name].pop("seconds")
    return Outcome(metrics, source, cell.settings)


def _film(cell: Cell, places: Places, report: Report) -> Outcome:
    assert cell.world is not None
    folder, source = _policies(cell, places)
    file, count = places.results / "films" / f"{cell.name}{default_suffix()}", cell.settings["episodes"]
    look = FilmSettings(**{name: value for name, value in cell.settings.items() if name != "episodes"})
    episodes = make_film(
        open_policies(folder),
        parse_world(cell.world),
        file,
        episodes=count,
        seed=EVALUATION_SEED,
        settings=look,
        on_episode=lambda number, _: report((number + 1) / count, f"{number + 1} of {count} episodes"),
    )
    metrics = {"file": file.name, "bytes": file.stat().st_size, "reached": sum(e.reached for e in episodes)}
    return Outcome(metrics, source, cell.settings)


def _run_dir(folder: Path) -> str:
    """The setting, for a path that YAML could take for something else too: "~/a", "a #1", "[x]"."""
    return f"run_dir={json.dumps(str(folder))}"


def _train_run(folder: Path, stage: str, report: Report, code: Code) -> None:
    """Train a stage of a run folder from its last checkpoint on, and on in other worlds where the physics breaks.

    Raises:
        TrainingDiverged: it breaks `BREAKS` times, or a loss or a weight is not finite.
    """
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from hiernav.training import train

    class Reporting(Progress):
        """Bars that are not drawn here but reported."""

        def update(self, task_id: TaskID, **changes: Any) -> None:
            super().update(task_id, **changes)
            task = self.tasks[task_id]
            report(task.completed / (task.total or 1.0), f"{task.description}: {changes.get('note', '')}")

    for left in reversed(range(BREAKS)):
        run = Run.open(folder)
        try:
            train(run, stage, Reporting(console=Console(file=sys.stdout, width=160), disable=True), code_name(code))
            return
        except PhysicsBroke:
            if not left:
                raise
        finally:
            run.close()


def _curve(folder: Path, stage: str) -> list[dict[str, float | None]]:
    """What a run logged of a stage: `step` and values.

    Raises:
        ValueError: nothing, as in a run whose checkpoint of that stage came from elsewhere.
    """
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    curve = [{k: v for k, v in line.items() if k != "stage"} for line in lines if line["stage"] == stage]
    if not curve:
        raise ValueError(f"{folder / 'metrics.jsonl'} has no row of {stage!r}: it was not trained in this run")
    return curve
