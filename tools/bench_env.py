"""Control steps per second of the batched task, beside bare physics of the same scenes."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from race import Stretch, overall, race, timed
from turns import Skipped, Turns

from hiernav.config import load_config
from hiernav.nav.bundle import load_bundle
from hiernav.nav.option import Planner
from hiernav.runtime.policy import load_networks, make_planner
from hiernav.sim.factory import make_task
from hiernav.sim.robots import ROBOTS, get_robot
from hiernav.sim.task import NavigationTask

ROWS = 32
BUNDLES = Path(__file__).resolve().parent.parent / "deploy" / "bundles"


def bench_env(arguments: argparse.Namespace) -> dict[str, Any]:
    """Observation, reward and planning included: by the expert, and by a bundle's network.

    With several threads, the same beside one thread: what the task gains, and what bare physics can gain at most.
    """
    return {robot: _bench_robot(robot, arguments) for robot in ROBOTS}


def _bench_robot(robot: str, arguments: argparse.Namespace) -> dict[str, Any]:
    contenders: dict[str, Stretch] = {}
    for threads in sorted({1, arguments.threads}):
        task = _task(robot, threads)
        contenders[f"expert planner, {threads}"] = partial(timed, Driven(task).step)
        contenders[f"bare mj_step, {threads}"] = Bare(task, threads).run
    # a network of the same size stands in where a robot's own does not ship
    bundle = load_bundle(BUNDLES / (robot if (BUNDLES / robot).exists() else "car"))
    planner = make_planner(bundle, load_networks(bundle).planner, get_robot(robot).radius)
    contenders["learned planner, 1"] = partial(timed, Driven(_task(robot, 1, planner)).step)
    peer = _peer(robot, arguments.safety_python)
    if peer is not None:
        contenders["Safety-Gymnasium, 1"] = peer
    try:
        rates = overall(race(contenders, arguments.seconds, 0.1))
    finally:
        if peer is not None:
            peer.close()
    for name, rate in rates.items():
        what, threads = name.split(", ")
        line = f"env {robot:6s} {what:16s} {threads} thread(s) {rate:8,.0f} steps/s"
        if what.endswith("planner"):
            line += f"   {rate / rates[f'bare mj_step, {threads}']:.2f} of bare mj_step"
        if what.endswith("planner") and peer is not None:
            line += f"   {rate / rates['Safety-Gymnasium, 1']:.1f} times Safety-Gymnasium"
        if threads != "1":
            line += f"   {rate / rates[f'{what}, 1']:.2f} times one thread"
        print(line)
    return rates


def _peer(robot: str, python: str | None) -> Turns | None:
    """Safety-Gymnasium's environment of the same robot, in a process and a Python of its own."""
    if python is None:
        return None
    try:
        return Turns([python, "-W", "ignore", str(Path(__file__).parent / "env_peers.py"), robot])
    except Skipped as reason:
        print(f"env {robot:6s} Safety-Gymnasium skipped: {reason}")
        return None


def _task(robot: str, threads: int, planner: Planner | None = None) -> NavigationTask:
    return make_task(load_config(None, [f"robot={robot}", f"threads={threads}"]), ROWS, planner)


class Driven:
    """A task under random actions, reset where episodes end."""

    def __init__(self, task: NavigationTask) -> None:
        self.task, self._turn = task, 0
        self._actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, ROWS, task.robot.action_dim))
        task.reset()

    def step(self) -> int:
        self._turn += 1
        step = self.task.step(self._actions[self._turn % 64])
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended):
            self.task.reset(ended)
        return ROWS


class Bare:
    """`mj_step` alone, from the states that a task is in at the time."""

    def __init__(self, task: NavigationTask, threads: int) -> None:
        self.task, self._turn, self._model = task, 0, task.sim.model
        self._datas = [mujoco.MjData(self._model) for _ in range(ROWS)]
        self._actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, ROWS, task.robot.action_dim))
        self._threads, self._pool = threads, ThreadPoolExecutor(threads)

    def run(self, seconds: float) -> tuple[int, float]:
        for data, source in zip(self._datas, self.task.sim.datas, strict=True):
            mujoco.mj_copyData(data, self._model, source)
        return timed(self._step, seconds)

    def _step(self) -> int:
        self._turn += 1
        rows = iter(range(ROWS))
        if self._threads == 1:
            self._step_rows(rows)
        else:
            list(self._pool.map(self._step_rows, [rows] * self._threads))  # each takes the next row when done with one
        return ROWS

    def _step_rows(self, rows: Iterator[int]) -> None:
        actions = self._actions[self._turn % 64]
        for row in rows:
            self._datas[row].ctrl[:] = actions[row]
            mujoco.mj_step(self._model, self._datas[row], nstep=self.task.robot.substeps)
