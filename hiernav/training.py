"""Both stages of a run, with progress on screen: the planner on labels, then the skill in simulation."""

from __future__ import annotations

import time

import torch
from rich.progress import Progress, TaskID

from hiernav.planner import train as planner_train
from hiernav.run import Run
from hiernav.skill import train as skill_train


def train(run: Run, stage: str, progress: Progress) -> None:
    """Train "planner", "skill" or "all" of a run, from its last checkpoints on.

    Raises:
        TrainingDiverged: a loss is not finite.
    """
    torch.set_num_threads(run.config.threads)
    planner = planner_train.PlannerTrainer(run.config, run)
    done = planner.resume()
    if done is not None and not planner.finished:
        progress.console.print(f"planner: going on after epoch {done} of {run.config.planner.epochs}")
    if stage in ("planner", "all") and not planner.finished:
        began = time.perf_counter()
        planner.train(_PlannerDisplay(progress))
        run.summarize({"planner": {**planner.validation, "seconds": round(time.perf_counter() - began, 1)}})
    if stage in ("skill", "all"):
        guide = None
        if run.config.skill.planner == "cnn":
            if not planner.finished:
                raise ValueError("skill.planner = cnn needs a trained planner: run the planner stage first")
            guide = planner_train.torch_planner(planner.network, planner.labels.radius)
        skill = skill_train.SkillTrainer(run.config, run, guide)
        steps = skill.resume()
        if steps is not None and not skill.finished:
            progress.console.print(f"skill: going on after step {steps:,} of {run.config.skill.total_steps:,}")
        began = time.perf_counter()
        skill.train(_SkillDisplay(progress))
        best = max(skill.evaluations, key=lambda evaluation: evaluation["reach_rate"])
        run.summarize({"skill": {**best, "seconds": round(time.perf_counter() - began, 1)}})


class _PlannerDisplay:
    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, now: planner_train.Progress) -> None:
        if now.stage not in self._tasks:
            self._tasks[now.stage] = self.progress.add_task(f"planner: {now.stage}", total=now.total, note="")
        task = self._tasks[now.stage]
        speed = self.progress.tasks[task].speed or 0.0
        note = f"{speed:,.0f} samples/s"
        if now.stage == "training":
            note += f"  loss {now.loss:.4f}"
        if now.error is not None:
            note += f"  error {100 * now.error:.1f} cm"
        self.progress.update(task, completed=now.done, note=note)


class _SkillDisplay:
    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self._task: TaskID | None = None

    def __call__(self, now: skill_train.Progress) -> None:
        if self._task is None:
            self._task = self.progress.add_task("skill", total=now.total_steps, note="")
        note = f"{now.steps_per_second:,.0f} steps/s  {now.updates:,} updates  reach {now.reach_rate:.3f}"
        if now.evaluation is not None:
            note += f"  evaluated {now.evaluation:.3f}"
        self.progress.update(self._task, completed=now.steps, note=note)
