"""An evaluation drives every layout once, whatever comes of it, and counts failures in full."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenery import layout_of
from small_tasks import WORLD

from hiernav.config import TrainConfig
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.sim.factory import make_task
from hiernav.sim.layout import Layout
from hiernav.sim.robots import get_robot
from hiernav.sim.rollout import Episode, run_episodes, shortest_length
from hiernav.sim.worlds import sample_layout

WAYPOINTS = get_robot("point").observation_layout().slices["waypoints"]


def follow(observation: np.ndarray) -> np.ndarray:
    """A hand-made skill of the point robot: turn towards the third waypoint and go where it is ahead."""
    target = observation[:, WAYPOINTS].reshape(-1, 10, 2)[:, 2]
    bearing = np.arctan2(target[:, 1], target[:, 0])
    return np.stack([np.clip(np.cos(bearing), 0.0, 1.0) * 0.5, np.clip(3.0 * bearing, -1.0, 1.0)], axis=-1)


def stand(observation: np.ndarray) -> np.ndarray:
    return np.zeros((len(observation), 2))


def ahead(observation: np.ndarray) -> np.ndarray:
    return np.tile([1.0, 0.0], (len(observation), 1))


def run(skill: object, layouts: list[Layout], num_rows: int = 3, **kwargs: object) -> list[Episode]:
    return run_episodes(make_task(TrainConfig(), num_rows, worlds=[WORLD]), skill, layouts, **kwargs)


def capped(layout: Layout, cap: int, seed: int = 0) -> Layout:
    """The layout with another cap on steps, under another number."""
    return replace(layout, spec=replace(layout.spec, max_steps=cap), seed=seed)


def test_every_layout_is_driven_once_and_results_are_in_order() -> None:
    """Layouts of very different caps, more of them than rows: the short ones end first."""
    caps = [40, 5, 17, 60, 3, 9, 26]
    layouts = [capped(layout_of(start=(-1.0, -1.0, 0.0)), cap, seed=100 + k) for k, cap in enumerate(caps)]
    ended = []
    episodes = run(stand, layouts, on_episode=lambda index, episode: ended.append((index, episode.seed)))
    assert [episode.seed for episode in episodes] == [100 + k for k in range(7)]
    assert [episode.steps for episode in episodes] == caps
    assert sorted(ended) == [(k, 100 + k) for k in range(7)]
    assert ended[0][0] == 1 and ended[-1][0] in (3, 6)


def test_every_step_is_shown_before_a_row_starts_anew() -> None:
    layouts = [capped(layout_of(start=(-1.0, -1.0, 0.0)), cap) for cap in (3, 2)]
    task, seen = make_task(TrainConfig(), 1, worlds=[WORLD]), []
    run_episodes(task, stand, layouts, on_step=lambda step: seen.append((int(task.steps[0]), bool(step.truncated[0]))))
    assert seen == [(1, False), (2, False), (3, True), (1, False), (2, True)]


@pytest.mark.parametrize("num_rows", [1, 5])
def test_an_episode_does_not_depend_on_what_runs_beside_it(num_rows: int) -> None:
    layouts = [sample_layout(WORLD, seed) for seed in range(4)]
    three, other = run(follow, layouts), run(follow, layouts, num_rows)
    assert three == other


def test_a_skill_that_follows_waypoints_reaches_goals_on_short_ways() -> None:
    episodes = run(follow, [sample_layout(WORLD, seed) for seed in range(6)])
    assert sum(episode.reached for episode in episodes) >= 5
    for episode in episodes:
        assert 0.0 <= episode.spl <= 1.0
        assert episode.replans["start"] == 1
        assert episode.refused == 0
        if episode.reached:
            assert episode.reason == "goal" and episode.replans["goal"] == 1
            assert episode.spl > 0.7
            assert episode.steps_counted == episode.steps < episode.cap
            if not episode.collisions:
                assert episode.return_ > 0.0
            assert episode.path_length >= 0.9 * episode.shortest_length


def test_a_policy_that_fails_counts_the_cap_and_no_spl() -> None:
    episode = run(stand, [capped(layout_of(start=(-1.0, -1.0, 0.0)), 30)])[0]
    assert (episode.reached, episode.reason) == (False, "timeout")
    assert (episode.steps, episode.steps_counted, episode.cap) == (30, 30, 30)
    assert episode.spl == 0.0
    assert episode.path_length == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("quaternion", "reason"), [((1.0, 0.0, 0.0, 0.0), "timeout"), ((0.0, 1.0, 0.0, 0.0), "fallen")]
)
def test_a_robot_that_lies_on_its_back_at_the_cap_has_fallen(quaternion: tuple[float, ...], reason: str) -> None:
    config = TrainConfig(robot="doggo")
    task = make_task(config, 1, worlds=[WORLD])

    def lie(observation: np.ndarray) -> np.ndarray:
        task.sim.datas[0].qpos[3:7] = quaternion
        return np.zeros((1, task.robot.action_dim))

    episode = run_episodes(task, lie, [capped(layout_of(start=(-1.0, -1.0, 0.0)), 3)])[0]
    assert (episode.reached, episode.reason) == (False, reason)
    assert (episode.steps, episode.steps_counted) == (3, 3)


def test_leaving_the_field_early_counts_the_cap_as_well() -> None:
    episode = run(ahead, [layout_of(start=(1.5, -1.0, 0.0))])[0]
    assert (episode.reached, episode.reason) == (False, "left_field")
    assert episode.steps < 100
    assert episode.steps_counted == episode.cap == 300
    assert episode.path_length == pytest.approx(0.5, abs=0.1)


def test_steps_in_contact_are_counted() -> None:
    into = layout_of(start=(-1.5, -1.0, 0.0), pillars=[(-0.8, -1.0)])
    past = layout_of(start=(-1.5, 1.0, 0.0), pillars=[(-0.8, -1.0)])
    episodes = run(ahead, [capped(into, 60), capped(past, 60)])
    assert episodes[0].collisions > 10
    assert episodes[1].collisions == 0


def test_the_driven_length_and_the_return_are_those_of_every_step() -> None:
    task, steps = make_task(TrainConfig(), 1, worlds=[WORLD]), []
    layouts = [capped(layout_of(start=(-1.0, -1.0, 0.0)), 20)]
    episode = run_episodes(
        task, ahead, layouts, on_step=lambda step: steps.append((float(task.pose[0, 0]), float(step.reward[0])))
    )[0]
    places, rewards = zip(*steps, strict=True)
    assert episode.path_length == pytest.approx(places[-1] + 1.0, rel=1e-3)
    assert episode.return_ == pytest.approx(sum(rewards)) and len(rewards) == 20


def test_a_robot_that_stood_still_in_the_last_episode_is_helped_in_the_next_as_if_in_its_first() -> None:
    episodes = run(stand, [capped(layout_of(start=(-1.0, -1.0, 0.0)), 160)] * 2, num_rows=1)
    assert [episode.recoveries for episode in episodes] == [1, 1]


def test_fewer_layouts_than_rows_are_driven_once() -> None:
    episodes = run(stand, [capped(layout_of(start=(-1.0, -1.0, 0.0)), 5, seed=7)], num_rows=4)
    assert [episode.seed for episode in episodes] == [7]
    assert run(stand, [], num_rows=4) == []


def test_a_straight_drive_has_an_spl_of_almost_one() -> None:
    episode = run(follow, [layout_of(start=(-1.0, 1.5, 0.0))])[0]
    assert episode.reached
    assert episode.shortest_length == pytest.approx(2.5 - GOAL_RADIUS, abs=0.05)
    assert 0.9 < episode.spl <= 1.0


def test_the_shortest_length_goes_around_obstacles_and_ends_at_the_goal_s_radius() -> None:
    free = layout_of(start=(-1.5, 1.5, 0.0))
    assert shortest_length(free, 0.1) == pytest.approx(3.0 - GOAL_RADIUS, abs=0.05)
    blocked = layout_of(start=(-1.5, 1.5, 0.0), pillars=[(0.0, y) for y in (1.9, 1.5, 1.1, 0.7)])
    # a taut string around the lowest pillar, 0.1 m off it: two tangents and the arc between them
    tangent = np.sqrt(1.5**2 + 0.8**2 - 0.3**2)
    arc = 0.3 * (np.pi - np.arctan2(1.5, 0.8) - np.arctan2(tangent, 0.3))
    assert shortest_length(blocked, 0.1) == pytest.approx(2 * (tangent + arc) - GOAL_RADIUS, rel=0.05)
    closed = layout_of(start=(-1.5, 1.5, 0.0), walls=[(0.0, -2.0, 0.0, 2.0)])
    assert np.isnan(shortest_length(closed, 0.1))
    assert shortest_length(layout_of(start=(1.4, 1.5, 0.0)), 0.1) == 0.0
