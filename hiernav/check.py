"""What cannot be trained is refused before a run folder is made."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from hiernav.config import ConfigError, TrainConfig
from hiernav.nav.mirror import mirror_of
from hiernav.planner.mix import WorldRange
from hiernav.run import check_stage
from hiernav.sim.batch import processors
from hiernav.sim.factory import expert_planner, skill_layout
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.scene import scene_for
from hiernav.sim.worlds import sample_layout

log = logging.getLogger(__name__)


def check_training(config: TrainConfig, stage: str = "all", overrides: Sequence[str] = ()) -> TrainConfig:
    """Refuse what cannot be trained, or not on this machine, before a run folder is made.

    Args:
        config: what is to be trained.
        stage: "planner", "skill" or "all".
        overrides: KEY=VALUE of the command line, which are not to be contradicted by a data set.

    Returns:
        What will be trained: with the worlds that its planner's data set was made in, if it has one.

    Raises:
        ConfigError: a setting, or a combination of them, that cannot be trained.
        ModuleNotFoundError: what the training needs is not installed.
    """
    check_stage(config, stage)
    check_worlds(config)
    check_threads(config)
    _check_scene(config)
    if stage != "planner":
        _check_mirror(config)
    _check_machine(config)
    return _with_worlds_of_data(config, overrides)


def check_collector(config: TrainConfig, overrides: list[str]) -> None:
    """Refuse settings of workers and clusters where nobody would ask for them."""
    skill = config.skill
    # a file may say it for whenever there are workers
    if skill.collector == "local" and any(text.startswith("skill.workers=") for text in overrides):
        raise ConfigError(f"skill.workers = {skill.workers}, expected with skill.collector = 'multi' or 'ray' only")
    if skill.collector != "ray" and skill.ray_address is not None:
        raise ConfigError(f"skill.ray_address = {skill.ray_address!r}, expected with skill.collector = 'ray' only")


def check_worlds(config: TrainConfig) -> None:
    """Refuse worlds that cannot be built or solved, or planned in, before anything is written."""
    expert_planner(config)  # no narrower than the robot
    body = get_robot(config.robot).radius
    planned = config.planner.planning_radius_m or body
    for key, texts, radius in (
        ("planner.worlds", config.planner.worlds, planned),
        ("skill.worlds", config.skill.worlds, body),
    ):
        for text in texts:
            try:
                specs = WorldRange(text).extremes() if key == "planner.worlds" else (parse_world(text),)
                for spec in specs:
                    sample_layout(spec, 0, radius)
            except ValueError as error:
                raise ConfigError(f"{key} = {text!r}: {error}") from None


def check_threads(config: TrainConfig) -> None:
    """Warn of more threads than there are processors to run them."""
    there = processors()
    if config.threads > there:
        use = "1 processor" if there == 1 else f"{there} processors"
        log.warning(
            "threads = %d, but this process may use %s: more threads than that gain no speed and cost memory",
            config.threads,
            use,
        )


def _check_scene(config: TrainConfig) -> None:
    """Refuse training worlds of the skill that one simulation cannot show in turn."""
    try:
        scene_for([parse_world(text) for text in config.skill.worlds])
    except ValueError as error:
        raise ConfigError(f"skill.worlds = {list(config.skill.worlds)}: {error}") from None


def _check_mirror(config: TrainConfig) -> None:
    """Refuse a body that the skill could not be trained in mirrored, before its planner is trained."""
    if not config.skill.mirror:
        return
    try:
        mirror_of(config.robot, skill_layout(config))
    except ValueError as error:
        raise ConfigError(
            f"skill.mirror = true: {error}; tell hiernav/nav/mirror.py how, or train with skill.mirror=false"
        ) from None


def _check_machine(config: TrainConfig) -> None:
    """Fail before a run folder is made when what the training needs is not installed, or there is no such device."""
    import tensorboard  # noqa: F401
    import torch  # noqa: F401
    import torchrl  # noqa: F401

    from hiernav.device import choose_device

    choose_device(config.planner.device, "planner.device")
    choose_device(config.skill.device, "skill.device")
    if config.skill.collector == "ray":
        import ray  # noqa: F401


def _with_worlds_of_data(config: TrainConfig, overrides: Sequence[str]) -> TrainConfig:
    """The configuration with the worlds that its planner's data set was made in.

    Refuses a data set that is not there or that this run cannot learn from, and other worlds on the command line; those
    of a file give way.
    """
    if config.planner.data is None or config.skill.preset == "baseline":  # which has no planner
        return config
    from hiernav.planner.train import with_worlds_of_data

    found = with_worlds_of_data(config)
    if found != config and any(text.startswith("planner.worlds=") for text in overrides):
        raise ConfigError(
            f"planner.worlds = {list(config.planner.worlds)}, but planner.data = {config.planner.data!r} "
            f"was made in {list(found.planner.worlds)}: leave one of them out"
        )
    return found
