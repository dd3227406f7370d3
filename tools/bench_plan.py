"""What a plan, a labelled sample and a step of learning cost, beside what they are made of."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from race import race, timed, typical

WORLD = "pillar(2,2,10)"
MOVING_WORLD = "gremlin"

if TYPE_CHECKING:
    from hiernav.nav.occupancy import OccupancyMap


def bench_plan(arguments: argparse.Namespace) -> dict[str, Any]:
    """One row at a time, as on the robot; the map stays, as where nothing moves."""
    from hiernav.nav import goselo
    from hiernav.nav.bundle import load_bundle
    from hiernav.nav.occupancy import VisitMap
    from hiernav.nav.option import PlanQuery
    from hiernav.nav.search import PathField
    from hiernav.planner.dataset import LabelSettings, label_world
    from hiernav.runtime.policy import load_networks, make_planner
    from hiernav.sim.layout import parse_world
    from hiernav.sim.worlds import sample_layout

    bundle = load_bundle(arguments.bundle)
    network, channels = load_networks(bundle).planner, bundle.manifest.goselo.channels
    radius, margin = bundle.manifest.plan.planning_radius_m, bundle.manifest.plan.soft_margin_m
    verified = make_planner(bundle, network, radius)
    layouts = [sample_layout(parse_world(WORLD), seed, radius) for seed in range(32)]
    maps = [layout.occupancy(0.0) for layout in layouts]
    visits = [VisitMap(occupancy) for occupancy in maps]
    frames = [goselo.GoseloFrame.of(layout.start[None, :2], layout.goal[None]) for layout in layouts]
    images = [goselo.images([m], [v], f, channels) for m, v, f in zip(maps, visits, frames, strict=True)]
    fields = [PathField(m, layout.goal, radius, margin) for m, layout in zip(maps, layouts, strict=True)]
    none = np.full((1, 10, 2), np.nan)
    queries = [
        PlanQuery(layout.start[None, :2], layout.goal[None], [m], [v], none)
        for layout, m, v in zip(layouts, maps, visits, strict=True)
    ]
    turn = iter(range(10**9))
    labels = LabelSettings((WORLD,), radius, margin)

    def each(call: Callable[[int], Any], count: int = 1) -> Callable[[], int]:
        def run() -> int:
            call(next(turn) % len(layouts))
            return count

        return run

    parts = {
        "field": each(lambda k: PathField(maps[k], layouts[k].goal, radius, margin)),
        "waypoints": each(lambda k: fields[k].waypoints(layouts[k].start[:2])),
        "image_paper": each(lambda k: goselo.images([maps[k]], [visits[k]], frames[k])),
        "image": each(lambda k: goselo.images([maps[k]], [visits[k]], frames[k], channels)),
        "network": each(lambda k: network(images[k], frames[k].distance.astype(np.float32))),
        "plan": each(lambda k: verified.planner.plan(queries[k])),
        "verified": each(lambda k: verified.plan(queries[k])),
        "sample": each(lambda k: label_world(labels, parse_world(WORLD), k, 100), 100),
    }
    results = {}
    for name, run in parts.items():
        timed(run, 0.1)
        count, seconds = timed(run, arguments.seconds / 4)
        results[name] = seconds / count
        print(f"plan {name:12s} {1e3 * seconds / count:7.3f} ms   {count / seconds:8,.0f}/s")
    results |= bench_prediction()
    # a hundred samples share a field
    bare = results["field"] / 100 + results["waypoints"] + results["image"]
    print(f"plan samples/s beside bare field / 100, waypoints and image: {bare / results['sample']:.2f}")
    return {**results, "sample_ratio": bare / results["sample"]}


def bench_prediction() -> dict[str, Any]:
    """What a prediction of a map costs, and how far from what moves it draws it, once that has been watched."""
    from hiernav.nav.prediction import AHEAD_S, WINDOW_S, MapPredictor
    from hiernav.sim.layout import parse_world
    from hiernav.sim.worlds import sample_layout

    errors, spent, count = [], 0.0, 0
    for seed in range(100):
        layout, predictor = sample_layout(parse_world(MOVING_WORLD), seed), MapPredictor()
        for now in np.arange(0.0, 4.0, 0.1).tolist():
            occupancy = layout.occupancy(now)
            began = time.process_time()
            ahead = predictor(occupancy, now, layout.start[:2])
            spent, count = spent + time.process_time() - began, count + 1
            if now > WINDOW_S:
                errors += [_off_centre(ahead, point) for point in layout.gremlin_positions(now + AHEAD_S)]
    half, most = np.percentile(errors, [50, 90]).tolist()
    print(
        f"plan {'prediction':12s} {1e3 * spent / count:7.3f} ms   {100 * half:.1f} cm from where a gremlin will be, "
        f"{100 * most:.1f} cm in one of ten"
    )
    return {"prediction": spent / count, "prediction_error": half, "prediction_error_90": most}


def _off_centre(occupancy: OccupancyMap, point: np.ndarray) -> float:
    """How far [m] from a point (2,) the middle of the obstacle is that is drawn there; inf if there is none."""
    labels, _, centers = cv2.connectedComponentsWithStats(occupancy.occupied.view(np.uint8), connectivity=4)[1:]
    label = int(labels[occupancy.pixel_of(point)])
    at = np.array(occupancy.origin) + (centers[label] + 0.5) * occupancy.resolution
    return float(np.linalg.norm(at - point)) if label else np.inf


def bench_learn(arguments: argparse.Namespace) -> dict[str, Any]:
    """Samples/s that the default network learns from, in the processor's own precision and in float32."""
    import torch

    from hiernav.device import choose_precision, keep_freed_memory
    from hiernav.planner.network import make_network
    from hiernav.planner.train import LossWeights, plan_loss

    torch.set_num_threads(arguments.threads)
    device, rows, rng = torch.device("cpu"), 256, torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (rows, 4, 64, 64), dtype=torch.uint8, generator=rng)
    distance, label = torch.rand(rows, generator=rng) * 3, torch.randn(rows, 10, 2, generator=rng)
    batch = image.contiguous(memory_format=torch.channels_last), image[:, -1], distance, label
    weights = LossWeights(1.0, 0.15, 0.3)

    def learner(precision: torch.dtype) -> Callable[[], int]:
        network = make_network("default", 10, 0.1, 6).to(memory_format=torch.channels_last)
        optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3)

        def step() -> int:
            with torch.autocast("cpu", precision, enabled=precision != torch.float32):
                output = network(batch[0], distance)
            optimizer.zero_grad(set_to_none=True)
            plan_loss(output, batch, weights).backward()
            optimizer.step()
            return rows

        return step

    precision = choose_precision("auto", device)
    keep_freed_memory()
    contenders = {"auto": learner(precision), "float32": learner(torch.float32)}
    rates = typical(race({name: partial(timed, run) for name, run in contenders.items()}, arguments.seconds, 0.5))
    ratio = rates["auto"] / rates["float32"]
    print(
        f"learn planner {rates['auto']:,.0f} samples/s in {str(precision).removeprefix('torch.')}   "
        f"float32 {rates['float32']:,.0f}   ratio {ratio:.2f}"
    )
    return {"samples_per_s": rates["auto"], "float32_samples_per_s": rates["float32"], "ratio": ratio}
