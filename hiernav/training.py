"""Both stages of a run, with progress on screen: the planner on labels, then the skill in simulation."""

from __future__ import annotations

import math
import time

import torch
from rich.console import Console
from rich.progress import Progress, TaskID

from hiernav.git import code_name, package_state
from hiernav.nav.option import Planner
from hiernav.nav.planners import VerifiedPlanner
from hiernav.planner import train as planner_train
from hiernav.run import Run, check_stage
from hiernav.sim.factory import expert_planner
from hiernav.sim.robots import get_robot
from hiernav.skill import train as skill_train

_LINE_SECONDS = 30.0


def train(run: Run, stage: str = "all", progress: Progress | None = None, code: str | None = None) -> None:
    """Train "planner", "skill" or "all" of a run, from its last checkpoints on.

    Args:
        run: to train into; `Run.create` begins one, `Run.open` goes on with one.
        stage: what to train.
        progress: to show how far it is; None: it is silent.
        code: that this process runs, see `Run.note_code`; None: what git says at the beginning.

    Raises:
        KeyboardInterrupt: somebody pressed Ctrl-C, whatever a library that was interrupted made of it.
        TrainingDiverged: a loss, a weight or the physics is not finite.
        RunError: the run folder cannot be written to.
        ConfigError: see `hiernav.run.check_stage`.
    """
    code = code or code_name(package_state())  # now: what comes after is not what this process has loaded
    try:
        _train(run, stage, progress or Progress(disable=True, console=Console(quiet=True)), code)
    except Exception as error:
        # what tensordict does in the middle of its bookkeeping fails otherwise where it is interrupted
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise cause from None
            cause = cause.__context__
        raise


def _train(run: Run, stage: str, progress: Progress, code: str) -> None:
    torch.set_num_threads(run.config.threads)
    if run.config.skill.preset == "baseline":
        check_stage(run.config, stage)
        return _train_skill(run, None, progress, code)
    planner = planner_train.PlannerTrainer(run.config, run)
    done = planner.resume()
    check_stage(run.config, stage, planner.finished)
    if done and not planner.finished:
        _say_resumed(progress, run, "planner", f"epoch {done} of {run.config.planner.epochs}")
    if stage == "planner" and planner.finished:
        _say_finished(progress, stage)
    if stage in ("planner", "all") and not planner.finished:
        run.start_clock("planner")
        run.note_code(code)
        planner.train(_PlannerDisplay(progress))
        run.summarize({"planner": {**planner.validation, "seconds": round(run.seconds("planner"), 1)}})
    if stage in ("skill", "all"):
        guide: Planner | None = None
        if run.config.skill.planner == "cnn":
            guide = planner_train.torch_planner(planner.network.cpu(), planner.labels)
            if run.config.skill.preset != "paper":
                guide = VerifiedPlanner(guide, expert_planner(run.config), get_robot(run.config.robot).radius)
        _train_skill(run, guide, progress, code)


def _train_skill(run: Run, guide: Planner | None, progress: Progress, code: str) -> None:
    skill = skill_train.SkillTrainer(run.config, run, guide)
    steps = skill.resume()
    if steps is not None and not skill.finished:
        _say_resumed(progress, run, "skill", f"step {steps:,} of {run.config.skill.total_steps:,}")
    if skill.finished:
        _say_finished(progress, "skill")
    else:
        run.note_code(code)
    run.start_clock("skill")
    skill.train(_SkillDisplay(progress))
    shipped = skill_train.kept(skill.evaluations, run.config.skill.eval_episodes)
    run.summarize({"skill": {**shipped, "seconds": round(run.seconds("skill"), 1)}})


def _say_resumed(progress: Progress, run: Run, stage: str, done: str) -> None:
    when = run.saved_at(stage).strftime("%Y-%m-%d %H:%M:%S")
    progress.console.print(
        f"{stage}: going on after {done}, from the checkpoint of {when}", soft_wrap=True, highlight=False
    )


def _say_finished(progress: Progress, stage: str) -> None:
    progress.console.print(
        f"{stage}: finished already; to train for longer, begin a new run", soft_wrap=True, highlight=False
    )


class _Display:
    """One bar per stage on a terminal; a line every half minute elsewhere."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self._tasks: dict[str, TaskID] = {}
        self._printed = time.perf_counter()

    def show(self, stage: str, done: int, total: int, note: str) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self.progress.add_task(stage, total=total, note="")
        self.progress.update(self._tasks[stage], completed=done, note=note)
        if not self.progress.console.is_terminal and time.perf_counter() - self._printed > _LINE_SECONDS:
            self._printed = time.perf_counter()
            left = self.progress.tasks[self._tasks[stage]].time_remaining
            ahead = "" if left is None else f"  {left / 60:.1f} min left"
            self.progress.console.print(f"{stage} {done:,} of {total:,}  {note}{ahead}", highlight=False)


class _PlannerDisplay(_Display):
    def __call__(self, now: planner_train.Progress) -> None:
        rate = f"{now.samples_per_second:,.0f} samples/s"
        loss = f"  loss {now.loss:.4f}" if now.loss is not None else ""
        error = f"  error {100 * now.error:.1f} cm" if now.error is not None else ""
        self.show(f"planner: {now.stage}", now.done, now.total, rate + loss + error)


class _SkillDisplay(_Display):
    def __call__(self, now: skill_train.Progress) -> None:
        reach = "-" if math.isnan(now.reach_rate) else f"{now.reach_rate:.3f}"
        note = f"{now.steps_per_second:,.0f} steps/s  {now.updates:,} updates  reach {reach}"
        if now.evaluation is not None:
            note += f"  evaluated {now.evaluation:.3f}"
        self.show("skill", now.steps, now.total_steps, note)
