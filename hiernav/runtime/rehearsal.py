"""A tick that decides nothing, run just before the real one so that the real one finds the processor's caches warm.

Between two ticks other programs fill the caches, and the first pass over networks and filters then takes several times
as long as the second. What is rehearsed is a copy of everything that has a state: estimator, option, guard. Only code,
network and map are those of the real tick.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.option import WaypointOption
from hiernav.nav.planners import StraightPlanner
from hiernav.runtime.collision import time_to_collision
from hiernav.runtime.estimate import Estimate, EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard
from hiernav.runtime.pilot import Pilot
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.terms import TermHold


class Rehearsal:
    """Goes through the motions of a tick with its own estimator, option and guard."""

    def __init__(self, agent: HierarchicalAgent, estimator: EstimatorConfig, guard: Guard, radius: float) -> None:
        """
        Args:
            agent: whose skill and layout are used; its option and recovery are not touched.
            estimator: as of the real one.
            guard: whose limits are used.
            radius: of the robot [m].
        """
        option = agent.option
        copy = WaypointOption(
            StraightPlanner(option.num_waypoints),
            1,
            option.rule,
            option.num_waypoints,
            sweep_radius=option.sweep_radius,
        )
        self._pilot = Pilot(HierarchicalAgent(copy, agent.skill, agent.layout, agent.control_period))
        self._estimator = Estimator(estimator)
        self._guard = Guard(guard.action_dim, guard.config)
        self._terms = TermHold()
        self._period, self._radius = agent.control_period, radius
        self._stamp = 0.0

    def __call__(
        self, frame: SensorFrame, estimate: Estimate, goal: np.ndarray, occupancy: OccupancyMap, anew: bool
    ) -> None:
        """Rehearse with the last tick's values; with `anew` a tick in which a plan ends."""
        if anew:
            self._pilot.drop()
        self._stamp += self._period
        self._estimator.update(replace(frame, stamp=self._stamp, fix_stamp=None))
        terms = self._terms.fill(frame)
        if self._pilot.lacks(terms) is not None:  # a sensor that speaks less often has not been in a frame yet
            return
        decision = self._pilot.act(self._stamp, estimate, terms, goal, occupancy)
        x, y, _ = estimate.pose.tolist()
        ttc = time_to_collision(occupancy, (x, y), (1.0, 0.0), self._radius, 0.5)
        self._guard.check(decision.action, estimate.upright, ttc, velocity=estimate.body_velocity())


def warm_up(config: EstimatorConfig) -> None:
    """Have the linear algebra make its buffers now: with locked memory the first call takes up to 0.2 s."""
    scratch = Estimator(config)
    for stamp in (0.0, 0.01):
        field, still = np.array(config.magnetic_field), np.zeros(3)
        scratch.update(SensorFrame(stamp, still, still, field, still, position_fix=np.zeros(2)))
