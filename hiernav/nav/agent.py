"""The agent: an option, the skill that follows its plan, and what helps a robot that stands still.

`observe` is what training and robot share of a control step, from poses and maps to the skill's observation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.nav import path
from hiernav.nav.frames import world_to_body
from hiernav.nav.observation import ObservationLayout, clock_phase
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.option import OptionStep, WaypointOption
from hiernav.nav.recovery import Recovery

Skill = Callable[[np.ndarray], np.ndarray]
"""Observations (N, D) float32 -> actions (N, A) float32 in [-1, 1]."""


@dataclass
class AgentStep:
    """What the agent decided in one control step."""

    action: np.ndarray
    """(N, A) float32 in [-1, 1]."""
    plan: np.ndarray
    """(N, K, 2) what the skill follows, world frame [m]: the option's plan, or a way out (`Recovery`)."""
    observation: np.ndarray
    """(N, D) float32."""
    option: OptionStep

    @property
    def reason(self) -> np.ndarray:
        return self.option.reason

    @property
    def start(self) -> np.ndarray:
        return self.option.start

    @property
    def replanned(self) -> np.ndarray:
        """(N,) bool, whether the plan is another one than at the last step."""
        return self.option.replanned

    @property
    def plan_seconds(self) -> float:
        return self.option.plan_seconds


@dataclass
class HierarchicalAgent:
    """Option and skill together: from sensors, goal and map to an action."""

    option: WaypointOption
    skill: Skill
    layout: ObservationLayout
    control_period: float
    """Time between two calls of `act` [s]."""

    def __post_init__(self) -> None:
        self.recovery = Recovery(self.option.num_rows, self.control_period, self.option.sweep_radius)
        self._steps = np.zeros(self.option.num_rows, dtype=np.int64)
        self._clocked = "clock" in self.layout.names

    def reset(self, rows: np.ndarray | None = None) -> None:
        """Start new episodes in some rows (all by default)."""
        self.option.reset(rows)
        self.recovery.reset(rows)
        self._steps[slice(None) if rows is None else rows] = 0

    def act(
        self,
        pose: np.ndarray,
        terms: Mapping[str, np.ndarray],
        goal: np.ndarray,
        occupancy: Sequence[OccupancyMap],
        stamps: np.ndarray | None = None,
    ) -> AgentStep:
        """One control step.

        Args:
            pose: (N, 3) world frame [m, m, rad].
            terms: the robot's sensors by name, (N, d) each; waypoints and goal are added here.
            goal: (N, 2) world frame [m]; see `turn_to`.
            occupancy: N maps as they are now.
            stamps: (N,) when the maps were made, on any clock [s]; the time of the steps by default.

        Raises:
            ValueError: not as many rows as the agent was made for.
        """
        pose, goal = np.asarray(pose, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        shapes, rows = (pose.shape, goal.shape, len(occupancy)), self.option.num_rows
        if shapes != ((rows, 3), (rows, 2), rows):
            raise ValueError(
                f"HierarchicalAgent.act: poses {pose.shape}, goals {goal.shape} and {len(occupancy)} maps, "
                f"expected ({rows}, 3), ({rows}, 2) and {rows}"
            )
        self.turn_to(goal)
        since = self._steps * self.control_period
        step, plan, observation = observe(
            self.option,
            self.recovery,
            self.layout,
            pose,
            terms,
            goal,
            occupancy,
            since if self._clocked else None,
            since if stamps is None else stamps,
        )
        self._steps += 1
        return AgentStep(self.skill(observation), plan, observation, step)

    def turn_to(self, goal: np.ndarray) -> np.ndarray:
        """Give up plans and ways out that lead elsewhere than to these goals (N, 2), world frame [m].

        A goal is another one where it is farther than `option.goal_radius` from the one that was planned for.

        Returns:
            The rows (M,) in which it is.
        """
        moved = (path.distances(goal, self.option.goal) > self.option.goal_radius).nonzero()[0]
        if len(moved):
            self.option.drop(moved)
            self.recovery.reset(moved)
        return moved


def observe(
    option: WaypointOption,
    recovery: Recovery | None,
    layout: ObservationLayout,
    pose: np.ndarray,
    terms: Mapping[str, np.ndarray],
    goal: np.ndarray,
    occupancy: Sequence[OccupancyMap],
    time: np.ndarray | None,
    stamps: np.ndarray,
    rows: np.ndarray | None = None,
) -> tuple[OptionStep, np.ndarray, np.ndarray]:
    """What a robot does in a control step up to its skill, in training as on the robot.

    The option ends or goes on, whoever stands still gets a way out, and what guides the skill joins what is sensed.

    Args:
        option: plans of N robots.
        recovery: of the same robots; None: nobody gets a way out.
        layout: of the observation.
        pose: (M, 3) world frame [m, m, rad].
        terms: the robots' sensors by name, (M, d) each.
        goal: (M, 2) world frame [m].
        occupancy: M maps as they are now.
        time: (M,) since the start of each episode [s]; None for a skill without a clock.
        stamps: (M,) when the maps were made, on any clock [s].
        rows: (M,) the rows these belong to; all N by default.

    Returns:
        The option's step, the plans (M, K, 2) that are followed, world frame [m], and observations (M, D) float32.
    """
    step = option.step(pose[:, :2], goal, occupancy, rows, stamps)
    plan = step.plan
    if recovery is not None:
        plan = recovery(pose, plan, occupancy, rows)
        option.waiting |= recovery.ended
        terms = recovery.dim(terms, rows)
    return step, plan, layout.build(guided(terms, pose, plan, goal, time))


def guided(
    terms: Mapping[str, np.ndarray], pose: np.ndarray, plan: np.ndarray, goal: np.ndarray, time: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Add what guides the skill to its sensors: waypoints and goal in the present body frame, and the gait clock.

    The waypoints are there in the world frame as well, for a skill that is made to observe them so.
    `time` (N,) is that since the start of each episode [s]; None for a skill without a clock.
    """
    guides = world_to_body(np.concatenate([plan, np.asarray(goal, dtype=np.float64)[:, None]], axis=1), pose)
    body, world = (points.reshape(len(pose), -1) for points in (guides[:, :-1], plan))
    values = {**terms, "waypoints": body, "world_waypoints": world, "goal": guides[:, -1]}
    if time is not None:
        values["clock"] = clock_phase(time)
    return values
