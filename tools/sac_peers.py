"""SAC learners that `tools/bench.py --peers` races, each in a process and, if need be, a Python of its own.

    python tools/sac_peers.py NAME [--threads 1] [--hidden 256] [--device cpu]

prints "ready", or "skip" and a reason, and then takes turns (see tools/turns.py). An update is a batch of 256 drawn
from a replay buffer and one gradient step of actor, twin critics and temperature, at the quadruped's sizes. Each
learner runs as its own documentation shows it.

The peers, in an environment of their own:

    python -m venv peers && peers/bin/pip install torch stable-baselines3 sbx-rl
    python tools/bench.py --peers --peer-python peers/bin/python
"""

from __future__ import annotations

import argparse
import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from turns import take_turns

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

OBSERVATION, ACTIONS, BATCH, STORED = 78, 12, 256, 10_000
BURST = 16
"""Updates between two looks at the clock: learners that compile a loop over their updates get to use it."""

Burst = Callable[[], object]


def hiernav(hidden: int, device: str, precision: str = "auto") -> Burst:
    """`Learner` and `Replay`, as `hiernav train` uses them."""
    import torch
    from tensordict import TensorDict

    from hiernav.device import Recorded
    from hiernav.sim.robots import get_robot
    from hiernav.skill.replay import Replay
    from hiernav.skill.sac import Learner, SacSettings

    settings = SacSettings(hidden=(hidden, hidden), precision=precision)
    learner = Learner(get_robot("doggo").observation_layout(), ACTIONS, settings, device)
    folder = tempfile.mkdtemp(prefix="hiernav-bench-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    replay = Replay(Path(folder) / "replay", STORED, OBSERVATION, ACTIONS, BATCH, device)
    replay.extend(TensorDict(torch_transitions(), [STORED]))
    learn = Recorded(lambda rows: learner.update(replay.batch(rows)), torch.device(device))
    return lambda: [learn(rows) for rows in replay.draw(BURST)]


def hiernav_float32(hidden: int, device: str) -> Burst:
    """The same with all products in float32."""
    return hiernav(hidden, device, "float32")


def plain(hidden: int, device: str) -> Burst:
    """SAC written by hand in plain torch, with autograd."""
    import torch
    from plain_sac import PlainSac

    from hiernav.sim.robots import get_robot

    learner = PlainSac(get_robot("doggo").observation_layout(), ACTIONS, (hidden, hidden), device)
    stored = torch_transitions(device=device)

    def sample() -> dict[str, Any]:
        rows = torch.randint(STORED, (BATCH,), device=device)
        return {k: v[rows] for k, v in stored.items() if k != "next"} | {
            "next": {k: v[rows] for k, v in stored["next"].items()}
        }

    return lambda: [learner.update(sample()) for _ in range(BURST)]


def torchrl(hidden: int, device: str) -> Burst:
    """SACLoss, its optimiser and its target updater in a loop, eager."""
    import torch
    from tensordict import TensorDict
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torch import nn
    from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import SACLoss, SoftUpdate

    shape: dict[str, Any] = {"num_cells": [hidden, hidden], "activation_class": nn.ReLU}
    network = nn.Sequential(MLP(OBSERVATION, 2 * ACTIONS, **shape), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        spec=Bounded(-1.0, 1.0, (ACTIONS,), device=device),
    ).to(device)
    critic = ValueOperator(MLP(OBSERVATION + ACTIONS, 1, **shape).to(device), in_keys=["observation", "action"])
    loss = SACLoss(actor, critic, num_qvalue_nets=2, loss_function="l2", target_entropy=-float(ACTIONS))
    loss.make_value_estimator(gamma=0.99)
    updater = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    replay = ReplayBuffer(storage=LazyTensorStorage(STORED, device=device), batch_size=BATCH)
    replay.extend(TensorDict(torch_transitions(device=device), [STORED]))

    def update() -> None:
        out = loss(replay.sample())
        (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()

    return lambda: [update() for _ in range(BURST)]


def sb3(hidden: int, device: str) -> Burst:
    """Stable-Baselines3's SAC."""
    from stable_baselines3 import SAC

    return _baselines(SAC, hidden, device)


def sbx(hidden: int, device: str) -> Burst:
    """SBX's SAC: Stable-Baselines in JAX, compiled."""
    os.environ["JAX_PLATFORMS"] = device
    from sbx import SAC

    return _baselines(SAC, hidden, device)


LEARNERS = {f.__name__: f for f in (hiernav, hiernav_float32, plain, torchrl, sb3, sbx)}
PEERS = ("torchrl", "sb3", "sbx")


def transitions(count: int = STORED) -> dict[str, np.ndarray]:
    """Random transitions, rows of float32."""
    rng = np.random.default_rng(0)
    draws = {
        "observation": rng.standard_normal((count, OBSERVATION)),
        "action": rng.uniform(-1.0, 1.0, (count, ACTIONS)),
        "following": rng.standard_normal((count, OBSERVATION)),
        "reward": rng.standard_normal((count, 1)),
    }
    return {name: values.astype(np.float32) for name, values in draws.items()}


def torch_transitions(count: int = STORED, device: str = "cpu") -> dict[str, Any]:
    """Random transitions as torchrl names them."""
    import torch

    drawn = {name: torch.from_numpy(values).to(device) for name, values in transitions(count).items()}
    following = {"observation": drawn.pop("following"), "reward": drawn.pop("reward")}
    flags = {name: torch.zeros((count, 1), dtype=torch.bool, device=device) for name in ("done", "terminated")}
    return {**drawn, "next": {**following, **flags}}


def _baselines(algorithm: Any, hidden: int, device: str) -> Burst:
    """A learner with the interface of Stable-Baselines3, its replay buffer filled."""
    import gymnasium
    from stable_baselines3.common.logger import configure

    class Spaces(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)

    model = algorithm(
        "MlpPolicy",
        Spaces(),
        batch_size=BATCH,
        buffer_size=STORED,
        device=device,
        policy_kwargs={"net_arch": [hidden] * 2},
    )
    model.set_logger(configure(None, []))
    model._current_progress_remaining = 1.0
    drawn, buffer = transitions(), model.replay_buffer
    for row in range(STORED):
        now, then = drawn["observation"][row], drawn["following"][row]
        buffer.add(now, then, drawn["action"][row], drawn["reward"][row], np.zeros(1), [{}])
    return lambda: model.train(gradient_steps=BURST, batch_size=BATCH)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=LEARNERS)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--hidden", type=int, default=256, help="width of both hidden layers (256)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="of the updates (cpu)")
    arguments = parser.parse_args()
    # not every library asks how many threads it may start, but all of them stay on the cores they are given
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.threads])
    try:
        if arguments.name != "sbx":
            import torch

            torch.set_num_threads(arguments.threads)
        burst = LEARNERS[arguments.name](arguments.hidden, arguments.device)
        burst()
    except ImportError as error:
        print(f"skip {error}", flush=True)
        return
    wait = torch.cuda.synchronize if arguments.device == "cuda" and arguments.name != "sbx" else lambda: None

    def run() -> int:
        burst()
        wait()
        return BURST

    take_turns(run)


if __name__ == "__main__":
    main()
