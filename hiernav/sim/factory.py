"""Tasks from a configuration: the same for training, evaluation and Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hiernav.config import ConfigError, TrainConfig
from hiernav.nav.bundle import ReplanSpec
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.observation import ObservationLayout
from hiernav.nav.option import Planner, WaypointOption, refresh_steps
from hiernav.nav.planners import ShortestPathPlanner, StraightPlanner
from hiernav.nav.termination import ReplanRule
from hiernav.sim.layout import Layout, WorldSpec, parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.task import LayoutSource, NavigationTask
from hiernav.sim.worlds import sample_layout


class RandomLayouts:
    """Endless layouts of one or several worlds; row r's episode k is the same whatever the other rows do.

    Args:
        worlds: drawn from in equal parts.
        seed: entropy of the whole sequence, any number of integers.
        robot_radius: for the check that a world can be solved [m].
    """

    def __init__(self, worlds: Sequence[WorldSpec], seed: Sequence[int], robot_radius: float) -> None:
        self.worlds, self.seed, self.robot_radius = tuple(worlds), tuple(seed), robot_radius
        self._episodes: dict[int, int] = {}

    def __call__(self, row: int) -> Layout:
        episode = self._episodes.get(row, 0)
        self._episodes[row] = episode + 1
        which, seed = np.random.SeedSequence(self.seed, spawn_key=(row, episode)).generate_state(2)
        return sample_layout(self.worlds[which % len(self.worlds)], int(seed), self.robot_radius)

    def of_seed(self, *seed: int) -> RandomLayouts:
        """Layouts of the same worlds from another seed, each row from its first episode on."""
        return RandomLayouts(self.worlds, seed, self.robot_radius)


def expert_planner(config: TrainConfig) -> ShortestPathPlanner:
    """The shortest-path planner with the radius and margin of a configuration."""
    least = get_robot(config.robot).radius
    radius = config.planner.planning_radius_m or least
    if radius < least:
        raise ConfigError(
            f"planner.planning_radius_m = {radius:g}, expected at least {least:g}, the radius of the {config.robot}"
        )
    return ShortestPathPlanner(
        radius, config.planner.soft_margin_m, num_waypoints=config.option.waypoints, spacing=config.option.spacing_m
    )


def default_planner(config: TrainConfig) -> Planner:
    """The expert, or no planner worth the name for a baseline that follows no plan."""
    if config.skill.preset == "baseline":
        return StraightPlanner(config.option.waypoints, config.option.spacing_m)
    return expert_planner(config)


def make_task(
    config: TrainConfig,
    num_rows: int,
    planner: Planner | None = None,
    worlds: Sequence[WorldSpec] | None = None,
    layouts: LayoutSource | None = None,
    training: bool = False,
) -> NavigationTask:
    """The task of a configuration.

    Args:
        config: robot, option, reward and kind of guidance.
        num_rows: robots side by side.
        planner: guides them; `default_planner` by default.
        worlds: that `layouts` may draw from; the skill's training worlds by default.
        layouts: random ones from the configuration's seed by default.
        training: whether episodes end as `skill.end_on_fall` and `skill.episode_steps` say, or as the protocols do.
    """
    robot = get_robot(config.robot)
    worlds = [parse_world(text) for text in config.skill.worlds] if worlds is None else list(worlds)
    option = WaypointOption(
        planner or default_planner(config),
        num_rows,
        replan_rule(config),
        num_waypoints=config.option.waypoints,
        goal_radius=GOAL_RADIUS,
        sweep_radius=robot.radius,
        refresh=refresh_steps(robot.control_period),
        predict=config.skill.preset != "baseline",  # which does not follow its plans
    )
    return NavigationTask(
        robot,
        worlds,
        layouts or RandomLayouts(worlds, (config.seed,), robot.radius),
        option,
        skill_layout(config),
        config.reward,
        config.threads,
        training and config.skill.end_on_fall,
        config.skill.episode_steps if training else None,
    )


def skill_layout(config: TrainConfig) -> ObservationLayout:
    """Observation layout of a configuration's skill."""
    guidance = "waypoints" if config.skill.waypoint_frame == "body" else "world_waypoints"
    if config.skill.preset == "baseline":
        guidance = "goal"
    return get_robot(config.robot).observation_layout(guidance, config.skill.clock)


def replan_spec(config: TrainConfig) -> ReplanSpec:
    """The thresholds of a configuration's termination rule, as a bundle has them."""
    return ReplanSpec(**{name: getattr(config.option, name) for name in ReplanSpec.__struct_fields__})


def replan_rule(config: TrainConfig) -> ReplanRule:
    """The termination rule of a configuration."""
    return replan_spec(config).rule()
