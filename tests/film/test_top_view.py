"""The view from above shows the robot where it is, where it has been, where it is going, and what happened."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiernav.config import load_config
from hiernav.draw import COLLISION, GREMLIN, PATH, PLAN, field_picture
from hiernav.film.top_view import REPLAN_COLORS, TopView, rgb
from hiernav.nav.termination import TerminationReason
from hiernav.sim.factory import make_task
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.task import NavigationTask, TaskStep
from hiernav.sim.worlds import sample_layout

SIZE = 400
EMPTY = replace(
    sample_layout(parse_world("pillar(2,2,0)"), 0), start=np.array([-1.0, 0.0, 0.0]), goal=np.array([1.5, 1.5])
)
REASON = TerminationReason


class Scene:
    """A point robot in a layout, seen from above."""

    def __init__(self, layout: Layout = EMPTY, lidar: bool = False) -> None:
        self.task: NavigationTask = make_task(load_config(None, ["robot=point"]), 1, worlds=[layout.spec])
        self.field = field_picture(layout, SIZE)
        self.view = TopView(self.task, SIZE, lidar)
        self.begin(layout)

    def begin(self, layout: Layout) -> None:
        self.task.reset(layouts=[layout])
        self.view.begin()

    def drive_to(self, x: float, y: float, reason: TerminationReason = REASON.NONE, collided: bool = False) -> TaskStep:
        """One step after which the robot is found at (x, y)."""
        self.task.robot.place(self.task.sim.datas[0].qpos, np.array([x, y, 0.0]))
        step = self.task.step(np.zeros((1, 2)))
        step.option.reason[:], step.collided[:] = reason, collided
        self.view.follow(step)
        return step

    def color_at(self, picture: np.ndarray, x: float, y: float) -> tuple[int, ...]:
        column, row = np.floor(self.field.pixel_of((x, y))).astype(int)
        return tuple(picture[row, column].tolist())

    def count(self, picture: np.ndarray, color: str) -> int:
        return int((np.abs(picture.astype(int) - rgb(color)).max(axis=-1) <= 2).sum())


def test_the_robot_is_drawn_where_it_is_with_its_trail_behind_it():
    scene = Scene()
    scene.drive_to(-0.5, 0.0)
    picture = scene.view.frame(scene.drive_to(-0.5, -1.0))
    assert scene.color_at(picture, -0.55, -1.05) == rgb(PATH)
    assert scene.color_at(picture, -0.75, 0.0) == rgb(PATH) and scene.color_at(picture, -0.5, -0.5) == rgb(PATH)
    assert scene.color_at(picture, -0.75, -0.5) == scene.color_at(scene.field.pixels, -0.75, -0.5)


def test_the_waypoints_of_the_present_plan_are_drawn():
    scene = Scene()
    step = scene.drive_to(0.0, -1.0, REASON.START)
    step.option.plan[0] = np.column_stack([np.linspace(0.3, 1.2, 10), np.full(10, -1.0)])
    picture = scene.view.frame(step)
    for x in np.linspace(0.3, 1.2, 10)[2:]:
        assert scene.color_at(picture, x, -1.0) == rgb(PLAN)


@pytest.mark.parametrize("reason", list(REPLAN_COLORS))
def test_a_new_plan_leaves_a_mark_that_says_why_the_old_one_ended(reason):
    scene = Scene()
    scene.drive_to(-0.5, -1.0, reason)
    picture = scene.view.frame(scene.drive_to(1.0, -1.5))
    assert scene.count(picture, REPLAN_COLORS[reason]) > scene.count(scene.field.pixels, REPLAN_COLORS[reason]) + 10
    others = [color for other, color in REPLAN_COLORS.items() if other not in (reason, REASON.START)]
    assert [scene.count(picture, color) for color in others] == [0] * len(others)


@pytest.mark.parametrize("reason", [REASON.NONE, REASON.GOAL])
def test_a_plan_that_goes_on_or_has_arrived_leaves_no_mark(reason):
    scene = Scene()
    scene.drive_to(-0.5, -1.0, reason)
    picture = scene.view.frame(scene.drive_to(1.0, -1.5))
    assert sum(scene.count(picture, color) for r, color in REPLAN_COLORS.items() if r != REASON.START) == 0


def test_a_collision_turns_the_robot_red_and_leaves_a_mark():
    scene = Scene()
    now = scene.view.frame(scene.drive_to(-0.5, -1.0, collided=True))
    later = scene.view.frame(scene.drive_to(1.0, -1.5))
    assert scene.count(now, COLLISION) > scene.count(later, COLLISION) > 10
    assert scene.color_at(later, 0.95, -1.55) == rgb(PATH)


def test_a_new_episode_begins_without_trail_and_marks():
    scene = Scene()
    first = scene.view.frame(scene.drive_to(-0.5, -1.0, REASON.INVALID, collided=True))
    scene.begin(EMPTY)
    again = scene.view.frame(scene.drive_to(-1.0, 0.0))
    assert scene.count(first, COLLISION) > 0 and scene.count(again, COLLISION) == 0
    assert scene.count(again, REPLAN_COLORS[REASON.INVALID]) == 0


def test_gremlins_are_drawn_where_they_have_got_to():
    layout = replace(sample_layout(parse_world("gremlin(2,2,3)"), 0), start=EMPTY.start, goal=EMPTY.goal)
    scene = Scene(layout)
    for _ in range(40):
        step = scene.drive_to(-1.9, -1.9)
    picture = scene.view.frame(step)
    now = float(scene.task.sim.time[0])
    assert now > 0.5
    for x, y in layout.gremlin_positions(now):
        for dx, dy in ((-0.08, -0.08), (0.08, 0.08)):
            assert scene.color_at(picture, x + dx, y + dy) == rgb(GREMLIN)


def test_the_lidar_is_drawn_as_far_as_it_sees():
    layout = replace(sample_layout(parse_world("pillar(2,2,1)"), 0), start=EMPTY.start, goal=EMPTY.goal)
    layout = replace(layout, pillars=np.array([[1.0, 0.3]]))
    pictures = [scene.view.frame(scene.drive_to(-1.0, 0.0)) for scene in (Scene(layout), Scene(layout, lidar=True))]
    scene, changed = Scene(layout), (pictures[0] != pictures[1]).any(axis=-1)
    inside, beyond = [np.floor(scene.field.pixel_of(p)).astype(int) for p in ((0.3, 0.5), (1.3, 0.6))]
    assert changed[inside[1], inside[0]] and not changed[beyond[1], beyond[0]]


def test_a_robot_whose_physics_broke_is_left_out():
    scene = Scene()
    scene.drive_to(-0.5, -1.0)
    scene.task.sim.datas[0].qvel[0] = np.nan
    step = scene.task.step(np.zeros((1, 2)))
    assert step.broken[0]
    scene.view.follow(step)
    assert scene.color_at(scene.view.frame(step), -0.45, -1.05) != rgb(PATH)
