#!/usr/bin/env python3
"""Time that training takes to the same reach rate, for the updates of this library and for torchrl's own.

    python tools/training_race.py --png docs/training_race.png --json runs/training_race.json

The same training with the same seed, one after the other, each in a process of its own:

    hiernav    as `hiernav train` does it: losses with written-out gradients, bfloat16 products where they are faster
    float32    the same with all products in float32
    torchrl    SACLoss, SoftUpdate and torch's Adam as they come, eager

All update on the processor, whatever else there is. Time runs from the first step, without the evaluations, which cost
all of them the same. Close other programs.
"""

from __future__ import annotations

import argparse
import copy
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bad_input import exit_code, share, whole

from hiernav.config import load_config
from hiernav.files import write_json

CONTENDERS = {"hiernav": "#2b6cb0", "float32": "#2f855a", "torchrl": "#dd6b20"}
EPISODES = 200
"""Per evaluation."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=Path("configs/point.yaml"), help="(configs/point.yaml)")
    parser.add_argument("--reach", type=share, default=0.97, help="rate at which a training is there, and ends (0.97)")
    parser.add_argument("--every", type=whole(), default=10_000, metavar="STEPS", help="between evaluations (10,000)")
    parser.add_argument("--only", nargs="+", choices=CONTENDERS, default=list(CONTENDERS), help="some of them")
    parser.add_argument("--png", type=Path, metavar="FILE", help="write a plot")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.add_argument("--train", choices=CONTENDERS, help=argparse.SUPPRESS)
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="of the training, over the file's")
    arguments = parser.parse_args()
    if arguments.train:
        _train(arguments)
        return 0
    load_config(arguments.config, arguments.settings)  # what is wrong with it is said here
    # the children get what this program got
    races = {name: _race([*sys.argv[1:], "--train", name], name) for name in arguments.only}
    for name, laps in races.items():
        there = laps[-1]["reach_rate"] >= arguments.reach
        end = f"reach {laps[-1]['reach_rate']:.3f} after {laps[-1]['step']:,} steps, {laps[-1]['seconds'] / 60:.1f} min"
        rate = laps[-1]["updates"] / laps[-1]["seconds"]
        print(f"{name:8s} {end}{'' if there else ': not there'}; {rate:.0f} updates/s beside the simulations")
    if arguments.json:
        write_json(arguments.json, races)
    if arguments.png:
        _plot(races, arguments.reach, arguments.png)
        print(f"wrote {arguments.png}")
    return 0


def _race(options: list[str], name: str) -> list[dict[str, Any]]:
    """The evaluations of one training, printed as they come."""
    command = [sys.executable, "-W", "ignore", __file__, *options]
    laps = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        for line in child.stdout or ():
            if line.startswith("{"):
                laps.append(json.loads(line))
                print(
                    f"{name:8s} step {laps[-1]['step']:9,}   {laps[-1]['seconds'] / 60:6.2f} min   "
                    f"reach {laps[-1]['reach_rate']:.3f}",
                    flush=True,
                )
    if child.returncode != 0 or not laps:
        raise RuntimeError(f"the training of {name!r} ended with exit status {child.returncode}")
    return laps


def _train(arguments: argparse.Namespace) -> None:
    import torch

    from hiernav.run import Run
    from hiernav.skill.train import SkillTrainer, make_learner

    settings = [
        f"skill.eval_every_steps={arguments.every}", f"skill.eval_episodes={EPISODES}",
        f"skill.stop_reach_rate={arguments.reach}", *arguments.settings,
        "skill.device=cpu",  # torchrl's losses as they come know no other here
    ]  # fmt: skip
    if arguments.train == "float32":
        settings.append("skill.precision=float32")
    with tempfile.TemporaryDirectory(prefix="hiernav-race-") as folder:
        config = load_config(arguments.config, [*settings, f"run_dir={json.dumps(f'{folder}/run')}"])
        torch.set_num_threads(config.threads)
        make = torchrl_learner if arguments.train == "torchrl" else make_learner
        trainer = SkillTrainer(config, Run.create(config), make=make)
        evaluate, began, outside = trainer._evaluate, time.perf_counter(), 0.0

        def timed() -> None:
            nonlocal outside
            now = time.perf_counter()
            evaluate()
            lap = {key: trainer.evaluations[-1][key] for key in ("step", "reach_rate", "steps_mean")}
            lap |= {"seconds": now - began - outside, "updates": trainer.learner.updates}
            outside += time.perf_counter() - now
            print(json.dumps(lap), flush=True)

        trainer._evaluate = timed  # type: ignore[method-assign]
        trainer.train()


def torchrl_learner(config: Any) -> Any:
    """A learner like that of `hiernav.skill.train.make_learner`, made of what torchrl and torch come with."""
    import torch
    from torchrl.modules import ValueOperator
    from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

    from hiernav.sim.factory import skill_layout
    from hiernav.sim.robots import get_robot
    from hiernav.skill.networks import Actor, Critic
    from hiernav.skill.sac import Learner, make_policy

    skill, layout, actions = config.skill, skill_layout(config), get_robot(config.robot).action_dim

    class TorchrlLearner(Learner):
        updates = 0

        def __init__(self) -> None:
            self.settings, self.device = skill, torch.device("cpu")
            self.actor = self._learning = Actor(layout, actions, skill.hidden, layer_norm=False)
            self.average = self._averaging = copy.deepcopy(self.actor) if skill.actor_average else self.actor
            self.policy = make_policy(self.actor, actions)
            critic = Critic(layout, actions, skill.hidden, skill.layer_norm)
            self.loss = SACLoss(
                self.policy,
                ValueOperator(critic, in_keys=["observation", "action"]),
                num_qvalue_nets=2,
                loss_function="l2",
                alpha_init=skill.init_alpha,
                min_alpha=max(skill.alpha_floor, 1e-8),
                target_entropy=-float(actions) if skill.target_entropy is None else skill.target_entropy,
            )
            self.loss.make_value_estimator(ValueEstimators.TD0, gamma=skill.discount)
            self._targets = SoftUpdate(self.loss, tau=skill.tau)
            self._plain_adam = torch.optim.Adam(self.loss.parameters(), lr=skill.learning_rate)
            self._weights = list(self.actor.parameters())

        def update(self, batch: Any) -> dict[str, torch.Tensor]:
            out = self.loss(batch)
            (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
            self._plain_adam.step()
            self._plain_adam.zero_grad()
            self._targets.step()
            self.updates += 1
            if self.average is not self.actor:
                weight = 1.0 / min(self.updates, skill.actor_average)
                with torch.no_grad():
                    torch._foreach_lerp_(list(self.average.parameters()), self._weights, weight)
            return {key: value.detach() for key, value in out.items()}

        @property
        def finite(self) -> bool:
            return all(bool(weight.isfinite().all()) for weight in self._weights)

        def state_dict(self) -> dict[str, Any]:
            return {}

    return TorchrlLearner()


def _plot(races: dict[str, list[dict[str, Any]]], reach: float, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, laps in races.items():
        minutes = [0.0, *(lap["seconds"] / 60.0 for lap in laps)]
        rates = [0.0, *(lap["reach_rate"] for lap in laps)]
        axes.plot(minutes, rates, color=CONTENDERS[name], marker="o", label=name)
    axes.axhline(reach, color="#8a8478", linestyle=":", linewidth=1.0)
    axes.set(xlabel="time of training [min]", ylabel="reach rate", ylim=(0.0, 1.02), xlim=(0.0, None))
    axes.grid(color="#e2e0da")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    sys.exit(exit_code("training_race", main))
