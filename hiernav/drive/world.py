"""The world that is driven in, and the goal in it."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from hiernav.runtime.control import parse_point
from hiernav.sim.layout import Layout, WorldSpec
from hiernav.sim.robots import RobotSpec
from hiernav.sim.worlds import sample_layout


class GoalError(ValueError):
    """A goal that cannot be driven to."""


def layout_of(world: WorldSpec, seed: int, spec: RobotSpec, goal: np.ndarray | None, start_known: bool) -> Layout:
    """The world of an episode, with the user's goal if there is one.

    Raises:
        GoalError: that cannot be driven to; from where a real robot stands is for the driver to find out.
    """
    layout = sample_layout(world, seed, spec.radius)
    if goal is None:
        return layout
    from hiernav.nav.search import is_solvable

    occupancy = layout.occupancy(0.0)
    if not layout.in_field(goal[None])[0]:
        xmin, xmax, ymin, ymax = layout.extent
        raise GoalError(
            f"--goal {goal[0]:g},{goal[1]:g} lies outside the field: x from {xmin:g} to {xmax:g}, "
            f"y from {ymin:g} to {ymax:g} m"
        )
    if not occupancy.is_free(goal, spec.radius):
        raise GoalError(
            f"--goal {goal[0]:g},{goal[1]:g} is less than {spec.radius:g} m from an obstacle in {world}, seed {seed}: "
            "choose a free place (hiernav world --png draws the world)"
        )
    if start_known and not is_solvable(occupancy, layout.start[:2], goal, spec.radius):
        raise GoalError(f"--goal {goal[0]:g},{goal[1]:g} cannot be reached from the start in {world}, seed {seed}")
    return replace(layout, goal=goal)


def given_goal(arguments: argparse.Namespace) -> np.ndarray | None:
    try:
        return None if arguments.goal is None else parse_point(arguments.goal)
    except ValueError as error:
        raise ValueError(f"--goal {error}") from None
