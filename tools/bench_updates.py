"""Updates of soft actor-critic per second, beside what they compete with."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from race import race, timed, typical
from turns import Skipped, Turns


def bench_update(arguments: argparse.Namespace) -> dict[str, Any]:
    """Doggo sizes, batch 256, the same batch again and again."""
    import torch
    from plain_sac import PlainSac
    from sac_peers import ACTIONS, BATCH, torch_transitions
    from tensordict import TensorDict

    from hiernav.sim.robots import get_robot
    from hiernav.skill.sac import Learner, SacSettings

    torch.set_num_threads(arguments.threads)
    layout, hidden = get_robot("doggo").observation_layout(), (arguments.hidden, arguments.hidden)
    batch = TensorDict(torch_transitions(BATCH), [BATCH])
    learners = {
        precision: Learner(layout, ACTIONS, SacSettings(hidden, precision=precision))
        for precision in ("auto", "float32")
    }
    plain = PlainSac(layout, ACTIONS, hidden)
    left, right = torch.randn(BATCH, 256), torch.randn(256, 256)

    def one(call: Callable[[], object]) -> Callable[[], int]:
        def run() -> int:
            call()
            return 1

        return run

    contenders = {
        "hiernav": one(lambda: learners["auto"].update(batch)),
        "hiernav_float32": one(lambda: learners["float32"].update(batch)),
        "plain": one(lambda: plain.update(batch)),
        "matmul": one(lambda: left.mm(right)),
    }
    rates = typical(race({name: partial(timed, run) for name, run in contenders.items()}, arguments.seconds))
    peak = rates.pop("matmul") * 2 * BATCH * 256 * 256
    flops = update_flops(layout.size, ACTIONS, BATCH, arguments.hidden)
    for name, rate in rates.items():
        ratio = f"{rate / rates['plain']:.2f} of plain torch"
        print(f"update {name:16s} {rate:6.0f}/s   {ratio}   {rate * flops / peak:.2f} of the float32 peak")
    print(f"update float32 peak {peak / 1e9:.0f} GFLOP/s, {flops / 1e9:.2f} GFLOP an update")
    return {"updates_per_s": rates, "peak_gflops": peak / 1e9, "gflop_per_update": flops / 1e9}


def bench_peers(arguments: argparse.Namespace) -> dict[str, Any]:
    """Every learner in a process of its own, taking turns; drawing the batches included."""
    from sac_peers import LEARNERS, PEERS

    print("peers: starting", end="", flush=True)
    options = ["--threads", str(arguments.threads), "--hidden", str(arguments.hidden), "--device", arguments.device]
    workers: dict[str, Turns] = {}
    skipped: dict[str, str] = {}
    for name in LEARNERS:
        print(f" {name}", end="", flush=True)
        python = arguments.peer_python if name in ("sb3", "sbx") else sys.executable
        try:
            workers[name] = Turns([python, "-W", "ignore", str(Path(__file__).parent / "sac_peers.py"), name, *options])
        except Skipped as reason:
            skipped[name] = str(reason)
    print()
    try:
        rates = typical(race(workers, arguments.seconds, 0.5))
    finally:
        for worker in workers.values():
            worker.close()
    best = max((rates[name] for name in PEERS if name in rates), default=float("nan"))
    for name, rate in rates.items():
        print(
            f"peers {name:16s} {rate:6.0f}/s   {rate / rates['plain']:.2f} of plain, {rate / best:.2f} of the best peer"
        )
    for name, reason in skipped.items():
        print(f"peers {name:16s} skipped: {reason}")
    return {"updates_per_s": rates, "skipped": skipped}


def update_flops(observation: int, actions: int, batch: int, width: int) -> float:
    """Floating point operations of the matrix products of one update."""
    actor = observation * width + width * width + width * 2 * actions
    critic = (observation + actions) * width + width * width + width
    forward = actor + 2 * critic  # target: next action, twin targets
    forward += 3 * 2 * critic  # critic loss: forward, gradients of weights and inputs
    forward += 3 * actor + 2 * 2 * critic  # actor loss: twin critics forward and input gradients
    return 2.0 * batch * forward
