"""Safety-Gymnasium's environments for `tools/bench.py --env`, in a Python of their own.

    python tools/env_peers.py ROBOT

prints "ready", or "skip" and a reason, and then takes turns (see tools/turns.py). A step is one control step under
random actions, with its own observation, reward and cost; an episode that ends is reset.

Version 1.0.0 wants packages of its time, and one of them does not build any more:

    python -m venv safety && safety/bin/pip install --no-deps safety-gymnasium==1.0.0 gymnasium==0.28.1 \
        gymnasium-robotics==1.2.2 pettingzoo==1.23.1
    safety/bin/pip install mujoco==2.3.3 "numpy<2" jax-jumpy cloudpickle farama-notifications typing_extensions \
        glfw pyopengl absl-py imageio pyyaml xmltodict pygame jinja2
    python tools/bench.py --env --safety-python safety/bin/python
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import warnings
from typing import Any

import numpy as np
from turns import take_turns

NAMES = {"point": "SafetyPointGoal1-v0", "car": "SafetyCarGoal1-v0", "doggo": "SafetyDoggoGoal1-v0"}


class _Constant(np.ndarray):
    """An array that Python 3.11 takes as the default of a dataclass's field."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def make(robot: str) -> Any:
    """The environment of a robot that looks for a goal among hazards."""
    of_field = dataclasses._get_field  # type: ignore[attr-defined]

    def tolerant(cls: type, name: str, *more: Any) -> Any:
        default = getattr(cls, name, None)
        if isinstance(default, np.ndarray):
            setattr(cls, name, default.view(_Constant))
        return of_field(cls, name, *more)

    dataclasses._get_field = tolerant  # type: ignore[attr-defined]
    try:
        import safety_gymnasium
    finally:
        dataclasses._get_field = of_field  # type: ignore[attr-defined]
    return safety_gymnasium.make(NAMES[robot])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=NAMES)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    try:
        env = make(arguments.robot)
    except ImportError as error:
        print(f"skip {error}", flush=True)
        return
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, *env.action_space.shape))
    env.reset(seed=0)
    turn = 0

    def step() -> int:
        nonlocal turn
        turn += 1
        *_, terminated, truncated, _ = env.step(actions[turn % 64])
        if terminated or truncated:
            env.reset()
        return 1

    take_turns(step)


if __name__ == "__main__":
    main()
