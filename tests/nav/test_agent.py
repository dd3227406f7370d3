"""The agent: what the skill sees of the plan, and what it answers, at each step."""

from __future__ import annotations

import numpy as np
import pytest
from nav_planners import map_with_pillars
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.frames import body_to_world
from hiernav.nav.option import WaypointOption
from hiernav.nav.planners import StraightPlanner
from hiernav.nav.termination import TerminationReason
from hiernav.sim.robots import get_robot

NONE, START = TerminationReason.NONE, TerminationReason.START
FREE = map_with_pillars()
FAR = (2.5, 0.0)


PERIOD = 0.1


@pytest.mark.parametrize("guidance", ["waypoints", "world_waypoints", "goal"])
def test_what_guides_the_skill_is_expressed_in_its_frame_at_each_step(guidance: str) -> None:
    layout = get_robot("point").observation_layout(guidance)
    sensors = {term.name: np.zeros((2, term.size)) for term in layout.terms}
    agent = HierarchicalAgent(WaypointOption(StraightPlanner(), 2), lambda o: np.tanh(o[:, :2]), layout, PERIOD)
    goal = np.array([[2.0, 0.0], [0.0, 2.0]])
    poses = [
        [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        [[0.1, 0.02, 0.7], [0.03, 0.1, -2.0]],
        [[0.2, 0.0, 3.0], [0.0, 0.2, 1.5]],
    ]
    for tick, pose in enumerate(np.asarray(poses)):
        step = agent.act(pose, sensors, goal, [FREE] * 2)
        assert step.replanned.tolist() == [tick == 0] * 2
        seen = step.observation[:, layout.slices[guidance]].astype(float).reshape(2, -1, 2)
        expected = goal[:, None] if guidance == "goal" else step.plan
        shown = seen if guidance == "world_waypoints" else body_to_world(seen, pose)
        assert_allclose(shown, expected, atol=1e-6)
        assert_allclose(step.plan[:, 4], [[0.5, 0.0], [0.0, 0.5]], atol=1e-12)
        assert_array_equal(step.action, np.tanh(step.observation[:, :2]))


def test_an_agent_that_is_reset_plans_again() -> None:
    layout = get_robot("point").observation_layout()
    sensors = {term.name: np.zeros((1, term.size)) for term in layout.terms}
    agent = HierarchicalAgent(WaypointOption(StraightPlanner(), 1), lambda o: o[:, :2], layout, PERIOD)
    reasons = []
    for _ in range(2):
        reasons += [int(agent.act(np.zeros((1, 3)), sensors, np.array([FAR]), [FREE]).reason[0]) for _ in range(2)]
        agent.reset()
    assert reasons == [START, NONE, START, NONE]


def agent_of(rows: int) -> tuple[HierarchicalAgent, dict[str, np.ndarray]]:
    layout = get_robot("point").observation_layout()
    sensors = {term.name: np.zeros((rows, term.size)) for term in layout.terms}
    return HierarchicalAgent(WaypointOption(StraightPlanner(), rows), lambda o: o[:, :2], layout, PERIOD), sensors


def test_a_new_goal_is_planned_for_at_once_and_in_its_row_alone() -> None:
    agent, sensors = agent_of(2)
    pose, maps = np.zeros((2, 3)), [FREE] * 2
    agent.act(pose, sensors, np.array([FAR, FAR]), maps)
    step = agent.act(pose, sensors, np.array([[-2.5, 0.0], FAR]), maps)
    assert step.reason.tolist() == [START, NONE] and step.replanned.tolist() == [True, False]
    assert_allclose(step.plan[:, -1], [[-1.0, 0.0], [1.0, 0.0]], atol=1e-12)
    assert agent.act(pose, sensors, np.array([[-2.5, 0.0], FAR]), maps).reason.tolist() == [NONE, NONE]


def test_a_goal_that_creeps_is_planned_for_anew_once_it_is_elsewhere() -> None:
    agent, sensors = agent_of(1)
    reasons = [
        int(agent.act(np.zeros((1, 3)), sensors, np.array([[2.0, 0.125 * k]]), [FREE]).reason[0]) for k in range(7)
    ]
    assert reasons == [START, NONE, NONE, START, NONE, NONE, START]  # the goal's radius is 0.3 m


def test_a_goal_is_another_one_by_how_far_it_is_from_the_one_that_was_planned_for() -> None:
    agent, sensors = agent_of(1)

    def reason(y: float) -> int:
        return int(agent.act(np.zeros((1, 3)), sensors, np.array([[2.0, y]]), [FREE]).reason[0])

    assert [reason(0.0), reason(0.25)] == [START, NONE]
    agent.option.waiting[0] = True  # a plan for 0.25
    assert [reason(0.25), reason(0.35), reason(-0.04), reason(-0.1)] == [NONE, NONE, NONE, START]


def test_a_new_goal_ends_a_way_out() -> None:
    agent, sensors = agent_of(1)
    goals = np.array([[FAR], [(-2.5, 0.0)]])
    agent.act(np.zeros((1, 3)), sensors, goals[0], [FREE])
    agent.recovery.ask(0)
    led_out = agent.act(np.zeros((1, 3)), sensors, goals[0], [FREE])
    assert agent.recovery.active[0]
    step = agent.act(np.zeros((1, 3)), sensors, goals[1], [FREE])
    assert not agent.recovery.active[0] and not np.array_equal(step.plan, led_out.plan)
    assert_allclose(step.plan[0, -1], [-1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(("poses", "goals", "maps"), [(3, 2, 2), (2, 1, 2), (2, 2, 1)])
def test_rows_that_the_agent_was_not_made_for_are_refused(poses: int, goals: int, maps: int) -> None:
    agent, sensors = agent_of(2)
    told = rf"poses \({poses}, 3\), goals \({goals}, 2\) and {maps} maps, expected \(2, 3\), \(2, 2\) and 2"
    with pytest.raises(ValueError, match=told):
        agent.act(np.zeros((poses, 3)), sensors, np.zeros((goals, 2)), [FREE] * maps)


def test_a_robot_that_stands_still_sees_less_of_what_holds_it_until_it_is_reset() -> None:
    layout = get_robot("point").observation_layout()
    sensors = {term.name: np.zeros((1, term.size)) for term in layout.terms} | {"lidar": np.full((1, 10), 0.5)}
    agent = HierarchicalAgent(WaypointOption(StraightPlanner(), 1), lambda o: o[:, :2], layout, PERIOD)

    def seen() -> float:
        step = agent.act(np.zeros((1, 3)), sensors, np.array([FAR]), [FREE])
        return float(step.observation[0, layout.slices["lidar"]].max())

    moments = [seen() for _ in range(round(2.0 / PERIOD))]
    assert moments[0] == 0.5 and moments[-1] == pytest.approx(0.35)
    agent.reset()
    assert seen() == 0.5


def test_a_plan_that_is_made_elsewhere_is_waited_for_and_ends_but_once() -> None:
    class Elsewhere:
        def plan(self, query: object) -> None:
            return None

    layout = get_robot("point").observation_layout()
    sensors = {term.name: np.zeros((1, term.size)) for term in layout.terms}
    agent = HierarchicalAgent(WaypointOption(Elsewhere(), 1), lambda o: o[:, :2], layout, PERIOD)
    steps = [agent.act(np.zeros((1, 3)), sensors, np.array([FAR]), [FREE]) for _ in range(3)]
    assert [int(step.reason[0]) for step in steps] == [START, NONE, NONE]


def test_the_gait_clock_starts_with_each_episode_and_runs_at_three_hertz() -> None:
    layout = get_robot("doggo").observation_layout(clock=True)
    sensors = {term.name: np.zeros((2, term.size)) for term in layout.terms}
    agent = HierarchicalAgent(WaypointOption(StraightPlanner(), 2), lambda o: o[:, :12], layout, PERIOD)

    def seen() -> np.ndarray:
        step = agent.act(np.zeros((2, 3)), sensors, np.array([FAR, FAR]), [FREE] * 2)
        return np.arctan2(*step.observation[:, layout.slices["clock"]].T) / (2.0 * np.pi) % 1.0

    phases = np.array([seen() for _ in range(6)])
    assert_allclose(phases[:, 0], np.arange(6) * 3.0 * PERIOD % 1.0, atol=1e-6)
    agent.reset(np.array([1]))
    assert_allclose(seen(), [6 * 3.0 * PERIOD % 1.0, 0.0], atol=1e-6)
