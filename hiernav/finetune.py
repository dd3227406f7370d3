"""Fine-tuning of the planner of a finished run or bundle on other worlds; the skill is carried along untouched."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hiernav.config import ConfigError, TrainConfig, dump_config, load_config
from hiernav.evaluate import open_policies
from hiernav.nav.bundle import Bundle, load_bundle
from hiernav.run import UNKNOWN_CODE, Run, RunError

DEFAULTS = {
    "run_dir": "null",
    "planner.data": "null",
    "planner.samples": "20_000",
    "planner.epochs": "4",
    "planner.learning_rate": "3e-4",
}
"""What differs from the source's own training, unless it is said otherwise.

A bundle does not hold the worlds or the reward that it was trained with: there they are the robot's defaults.
"""
_CHANGEABLE = {
    "seed", "threads", "run_dir", "planner.data", "planner.samples", "planner.samples_per_world", "planner.epochs",
    "planner.batch_size", "planner.device", "planner.learning_rate", "planner.weight_decay", "planner.precision",
    "planner.clearance_weight", "planner.heading_weight", "planner.mirror", "planner.worlds",
}  # fmt: skip


def fine_tuning_config(source: str | Path, overrides: list[str]) -> TrainConfig:
    """The configuration of a fine-tuning: the source's, what differs by default, and overrides.

    Raises:
        ConfigError: an override changes what the source's networks were trained for.
        ValueError: the source is neither a run folder nor a bundle, or has no trained planner or skill.
    """
    values = [f"{key}={value}" for key, value in DEFAULTS.items()] + overrides
    for override in values:
        key = override.partition("=")[0]
        if key not in _CHANGEABLE:
            raise ConfigError(
                f"command line: {key} cannot be changed by fine-tuning; what can: {', '.join(sorted(_CHANGEABLE))}"
            )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "config.yaml"
        file.write_text(dump_config(_source_config(Path(source))))
        return load_config(file, values, begun=True)


def begin_fine_tuning(config: TrainConfig, source: str | Path) -> Run:
    """A new run folder whose planner starts from the source's weights and whose skill is the source's.

    Raises:
        RunError: the folder is not empty or cannot be written to, or the source's networks do not fit this version.
            There is no run folder then.
    """
    from hiernav.planner.train import PlannerTrainer

    source = Path(source)
    planner, skill = _run_states(source) if _is_run(source) else _bundle_states(load_bundle(source))
    codes = _codes(source)

    def begin(run: Run) -> None:
        for code in codes:
            run.note_code(code)
        trainer = PlannerTrainer(config, run)
        expected, missing = trainer.network.state_dict(), "no such layer"
        for name in dict.fromkeys((*planner, *expected)):
            found, wanted = (
                "x".join(map(str, layers[name].shape)) if name in layers else missing for layers in (planner, expected)
            )
            if found != wanted:
                raise RunError(
                    f"{source}: the planner's {name} is {found}, {wanted} in this hiernav: train a planner anew"
                )
        trainer.network.load_state_dict(planner)
        trainer.save()
        run.save("skill", skill)

    return Run.create(config, begin)


def _codes(source: Path) -> list[str]:
    """Which code has trained a run or bundle, as far as it tells."""
    if _is_run(source):
        return Run.open(source).codes() or [UNKNOWN_CODE]
    return str(load_bundle(source).manifest.provenance.get("code", UNKNOWN_CODE)).split(", ")


def _is_run(path: Path) -> bool:
    return (path / "config.yaml").exists()


def _source_config(path: Path) -> TrainConfig:
    if _is_run(path):
        return Run.open(path).config
    config, bundle = open_policies(path).config, load_bundle(path)
    layers = {int(name.split(".")[2]): value for name, value in _actor(bundle).items() if _is_hidden(name)}
    hidden = tuple(len(layers[number]) for number in sorted(layers))
    return msgspec.structs.replace(config, skill=msgspec.structs.replace(config.skill, hidden=hidden))


def _run_states(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    run = Run.open(path)
    states = {stage: run.load(stage) for stage in ("planner", "skill")}
    for stage, state in states.items():
        if state is None:
            raise RunError(f"{path} has no trained {stage}: go on with `hiernav train --resume {path}`")
    planner, skill = states["planner"], states["skill"]
    assert planner is not None and skill is not None
    if skill["best_actor"] is None:
        raise RunError(f"the skill of {path} has not been evaluated yet: go on with `hiernav train --resume {path}`")
    # the lengths of the source's logs say nothing about those of the new run, and its replay stays where it is
    kept = {key: value for key, value in skill.items() if not key.endswith("_length")}
    return planner["network"], {**kept, "imported": True}


def _bundle_states(bundle: Bundle) -> tuple[dict[str, Any], dict[str, Any]]:
    import torch

    planner = {name: torch.from_numpy(v.copy()) for name, v in _weights(bundle.planner).items() if "." in name}
    provenance = bundle.manifest.provenance
    skill = {
        "best_actor": {name: torch.from_numpy(value.copy()) for name, value in _actor(bundle).items()},
        "steps": int(provenance.get("skill_steps", 0)),
        "learner": {"updates": int(provenance.get("skill_updates", 0))},
        "evaluations": [
            {
                "step": int(provenance.get("skill_steps", 0)),
                "reach_rate": float(provenance.get("skill_reach_rate", float("nan"))),
                "collisions_mean": float("nan"),
                "steps_mean": float("nan"),
            }
        ],
        "imported": True,
    }
    return planner, skill


def _actor(bundle: Bundle) -> dict[str, np.ndarray]:
    return {n.removeprefix("actor."): v for n, v in _weights(bundle.skill).items() if n.startswith("actor.")}


def _is_hidden(name: str) -> bool:
    return name.startswith("trunk.layers.") and name.endswith(".weight")


def _weights(model: bytes) -> dict[str, np.ndarray]:
    """Named tensors of an ONNX model; the exporter leaves a network's parameters under their own names.

    It leaves out biases that are 0 everywhere; every layer of these networks has one.
    """
    import onnx
    from onnx import numpy_helper

    graph = onnx.load_from_string(model).graph
    tensors = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    for name in [name for name in tensors if name.endswith(".weight")]:
        tensors.setdefault(name.removesuffix("weight") + "bias", np.zeros(len(tensors[name]), np.float32))
    return tensors
