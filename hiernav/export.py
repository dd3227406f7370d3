"""Export of a run's policies to a bundle of ONNX files.

Normalisation and action scaling are inside the graphs: they take raw observations and give actions in [-1, 1].
"""

from __future__ import annotations

import logging
import math
import shlex
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import nn

from hiernav import __version__
from hiernav.config import TrainConfig, as_overrides
from hiernav.nav import goselo
from hiernav.nav.bundle import (
    PLANNER,
    SKILL,
    GoseloSpec,
    Manifest,
    ObservationField,
    PlannerSpec,
    PlanSpec,
    SkillSpec,
    TensorSpec,
    file_sha256,
    is_bundle,
    load_bundle,
    write_golden,
    write_manifest,
)
from hiernav.nav.observation import ObservationLayout
from hiernav.nav.occupancy import RESOLUTION
from hiernav.planner.dataset import label_settings
from hiernav.planner.network import HypothesisNetwork, PaperNetwork
from hiernav.planner.train import load_network, torch_planner
from hiernav.run import UNKNOWN_CODE, Run, RunError
from hiernav.runtime.policy import check_golden
from hiernav.sim.factory import make_task, replan_spec, skill_layout
from hiernav.sim.robots import get_robot
from hiernav.skill.networks import Actor
from hiernav.skill.train import TorchSkill, kept, load_actor

OPSET = 18
GOLDEN_SAMPLES = 32
_PRIVATE = ("planner.data", "skill.ray_address")
"""Settings that name places of the machine that trained; nobody else is told of them."""


class _MeanAction(nn.Module):
    def __init__(self, actor: Actor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.actor.mean_action(observation)


def export_run(run_path: str | Path, out: str | Path) -> Path:
    """Export the trained pair of a run folder.

    Args:
        run_path: run folder with a finished planner and skill.
        out: bundle folder; it is replaced as a whole, and only by a bundle that has been loaded and checked. What
            fails or is interrupted leaves the old one in its place.

    Raises:
        RunError: the run has no trained planner or skill, its planner's training was stopped early, or `out` holds
            anything but a bundle.
        OSError: the bundle cannot be written.
    """
    run, out = Run.open(run_path), Path(out)
    _require_replaceable(out)
    if run.config.skill.preset == "baseline":
        raise RunError(f"{run.path} holds a baseline, which follows no plan: a bundle needs a planner")
    states = {stage: run.load(stage) for stage in ("planner", "skill")}
    for stage, state in states.items():
        if state is None:
            raise RunError(f"{run.path} has no trained {stage} yet: go on with `hiernav train --resume {run.path}`")
    epoch, epochs = states["planner"]["epoch"], run.config.planner.epochs  # type: ignore[index]
    if epoch < epochs:
        raise RunError(
            f"the planner of {run.path} is trained for {epoch} of {epochs} epochs: go on with "
            f"`hiernav train --resume {run.path} --stage planner`"
        )
    network = load_network(run.config, states["planner"])  # type: ignore[arg-type]
    actor = load_actor(run.config, states["skill"])  # type: ignore[arg-type]
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".bundle-") as temporary:
        folder = Path(temporary) / "bundle"
        folder.mkdir()
        write_bundle(folder, run.config, network, actor, _provenance(run, states))
        _require_replaceable(out)  # again: an export takes long enough for somebody to put a file there
        _replace(out, folder, Path(temporary) / "replaced")
    return out


def _require_replaceable(out: Path) -> None:
    if out.exists() and not is_bundle(out) and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is not a bundle and not empty: choose another folder to export to")


def _replace(out: Path, folder: Path, replaced: Path) -> None:
    """Put `folder` in the place of `out`, which goes to `replaced`, or comes back whatever stops this on the way.

    Where the process is killed between the two, the old one stays in `replaced`.
    """
    try:
        if out.exists():
            out.rename(replaced)
        folder.rename(out)
    except BaseException:  # an interrupt as well
        if replaced.exists() and not out.exists():
            replaced.rename(out)
        raise


def write_bundle(
    folder: Path,
    config: TrainConfig,
    network: PaperNetwork | HypothesisNetwork,
    actor: Actor,
    provenance: dict[str, str | int | float],
) -> None:
    """Write and check all files of a bundle in an empty folder."""
    robot, layout = get_robot(config.robot), skill_layout(config)
    golden = record_inputs(config, network, actor, GOLDEN_SAMPLES)
    network, mean_action = network.eval(), _MeanAction(actor).eval()
    _export(
        network, (golden["image"], golden["distance"]), ("image", "distance"), ("waypoints", "scores"), folder / PLANNER
    )
    _export(mean_action, (golden["observation"],), ("observation",), ("action",), folder / SKILL)
    with torch.no_grad():
        waypoints, scores = network(torch.from_numpy(golden["image"]), torch.from_numpy(golden["distance"]))
        golden["action"] = mean_action(torch.from_numpy(golden["observation"])).numpy()
    golden["waypoints"], golden["scores"] = waypoints.numpy(), scores.numpy()
    write_golden(folder, golden)
    option, planner = config.option, config.planner
    write_manifest(
        folder,
        Manifest(
            robot=robot.name,
            robot_sha256=file_sha256(robot.xml_path),
            control_period_s=robot.control_period,
            map_resolution_m=RESOLUTION,
            planner=PlannerSpec(
                inputs=(_spec("image", golden), _spec("distance", golden)),
                outputs=(_spec("waypoints", golden), _spec("scores", golden)),
                preset=planner.preset,
                channels=len(network.channels),
            ),
            skill=SkillSpec(inputs=(_spec("observation", golden),), outputs=(_spec("action", golden),)),
            observation=_fields(layout),
            goselo=GoseloSpec(channels=tuple(network.channels), **goselo.constants()),
            plan=PlanSpec(
                waypoints=option.waypoints,
                spacing_m=option.spacing_m,
                planning_radius_m=planner.planning_radius_m or robot.radius,
                soft_margin_m=planner.soft_margin_m,
            ),
            replan=replan_spec(config),
            provenance=provenance,
        ),
    )
    check_golden(load_bundle(folder))


def record_inputs(
    config: TrainConfig, network: PaperNetwork | HypothesisNetwork, actor: Actor, count: int
) -> dict[str, np.ndarray]:
    """Inputs of both networks recorded while they drive: observation (count, D), image, distance."""
    planner = torch_planner(network, label_settings(config))
    images: list[np.ndarray] = []
    distances: list[np.ndarray] = []
    inner = planner.network

    def recording(image: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        images.append(image)
        distances.append(distance)
        return inner(image, distance)

    planner.network = recording
    task = make_task(config, 8, planner)
    task.reset()
    skill = TorchSkill(actor)
    observations: list[np.ndarray] = []
    while sum(map(len, images)) < count or len(observations) * 8 < count:
        observations.append(task.observation)
        step = task.step(skill(task.observation))
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended):
            task.reset(ended)
    return {
        "observation": np.concatenate(observations)[:count],
        "image": np.concatenate(images)[:count],
        "distance": np.concatenate(distances)[:count],
    }


def _export(
    module: nn.Module, inputs: tuple[np.ndarray, ...], names: tuple[str, ...], outputs: tuple[str, ...], file: Path
) -> None:
    batch = torch.export.Dim("batch", min=1, max=65536)
    with _only_errors():
        torch.onnx.export(
            module,
            tuple(torch.from_numpy(value) for value in inputs),
            str(file),
            input_names=list(names),
            output_names=list(outputs),
            dynamic_shapes=tuple({0: batch} for _ in inputs),
            opset_version=OPSET,
            external_data=False,
            dynamo=True,
            verbose=False,
        )


@contextmanager
def _only_errors() -> Iterator[None]:
    """Without what the exporter says of packages that are not needed here, and of its own insides."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _spec(name: str, golden: dict[str, np.ndarray]) -> TensorSpec:
    return TensorSpec(name=name, shape=(None, *golden[name].shape[1:]), dtype=str(golden[name].dtype))


def _fields(layout: ObservationLayout) -> tuple[ObservationField, ...]:
    return tuple(ObservationField(name=t.name, size=t.size, unit=t.unit, scale=t.scale) for t in layout.terms)


def _provenance(run: Run, states: dict) -> dict[str, str | int | float]:
    skill = kept(states["skill"]["evaluations"], run.config.skill.eval_episodes)
    values = {
        "hiernav": __version__,
        "torch": torch.__version__.split("+")[0],
        "code": ", ".join(run.codes()) or UNKNOWN_CODE,
        "fine_tuned_with" if states["skill"].get("imported") else "settings": shlex.join(
            override for override in as_overrides(run.config) if override.partition("=")[0] not in _PRIVATE
        ),
        "seed": run.config.seed,
        "skill_steps": int(states["skill"]["steps"]),
        "skill_updates": int(states["skill"]["learner"]["updates"]),
        "skill_reach_rate": float(skill["reach_rate"]),
        "planner_samples": run.config.planner.samples,
        "planner_epochs": int(states["planner"]["epoch"]),
        "planner_error_m": round(float(states["planner"]["validation"].get("error", float("nan"))), 5),
    }
    return {name: value for name, value in values.items() if not isinstance(value, float) or math.isfinite(value)}
