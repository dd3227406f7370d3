"""A disc can follow the paths, smoothing makes them shorter, and what cannot be reached has none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_planners import map_with_pillars, pillar_world
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav.occupancy import OccupancyMap, draw_boxes, empty_map
from hiernav.nav.path import arc_lengths
from hiernav.nav.search import CELL, LEAD, PathField, is_solvable, random_shortcuts, resample
from hiernav.sim.layout import parse_world
from hiernav.sim.worlds import sample_layout

RADIUS = 0.1
PIXELATION = 0.03
"""Discs are drawn in pixels of 0.05 m: the map may give away this much [m]."""
SHIFT = 0.02
"""Waypoints may leave the path by this much to have room [m]."""
seeds = st.integers(0, 2**32 - 1)
margins = st.sampled_from([0.0, 0.15])


def walls(*boxes: tuple[float, float, float, float]) -> OccupancyMap:
    """A field of 4 x 4 m with boxes x, y, half width, half height [m]."""
    field = empty_map((2.0, 2.0))
    draw_boxes(field.occupied, field.origin, field.resolution, np.array(boxes)[:, :2], np.array(boxes)[:, 2:])
    return field


def sampled(path: np.ndarray, spacing: float = 0.01) -> np.ndarray:
    """Points all along a path (K, 2)."""
    parts = [
        np.linspace(a, b, 2 + int(np.linalg.norm(b - a) / spacing)) for a, b in zip(path[:-1], path[1:], strict=True)
    ]
    return np.concatenate(parts)


def length_of(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())


def room_around(path: np.ndarray, pillars: np.ndarray) -> float:
    """Smallest distance from a path to the exact discs and the border of the 4 x 4 m field [m]."""
    points = sampled(path)
    to_disc = np.linalg.norm(points[:, None] - pillars, axis=-1).min() - 0.2
    return float(min(to_disc, (2.0 - np.abs(points)).min()))


# the disc fits


@given(seeds, margins)
@settings(max_examples=60)
def test_the_disc_stays_clear_of_pillars_and_border_along_every_kind_of_path(seed: int, margin: float) -> None:
    pillars, occupancy, start, goal = pillar_world(seed)
    field = PathField(occupancy, goal, RADIUS, margin)
    if not np.isfinite(field.distance_at(start[None])[0]):
        return
    path = field.path_from(start)
    shortcut = random_shortcuts(path, field, np.random.default_rng(seed))
    for way in (path, field.smooth(path), shortcut, np.concatenate([start[None], field.waypoints(start)])):
        # between waypoints 0.1 m apart a corner of the smoothed path is cut by 0.02 m at most
        assert room_around(way, pillars) >= RADIUS - PIXELATION - 0.02 * (len(way) == 11)


@given(seeds, margins)
@settings(max_examples=40)
def test_smoothing_and_shortcuts_never_make_a_path_longer(seed: int, margin: float) -> None:
    _, occupancy, start, goal = pillar_world(seed)
    field = PathField(occupancy, goal, RADIUS, margin)
    path = field.path_from(start)
    if path is None:
        return
    for way in (field.smooth(path), random_shortcuts(path, field, np.random.default_rng(seed))):
        assert_allclose(way[[0, -1]], path[[0, -1]])
        assert length_of(way) <= length_of(path) + 1e-9


def test_with_a_soft_margin_the_way_through_a_wide_gap_keeps_to_its_middle() -> None:
    field = walls((0.0, 1.25, 0.1, 0.75), (0.0, -1.25, 0.1, 0.75))
    start, goal = np.array([-1.5, -0.35]), np.array([1.5, -0.35])
    hard = PathField(field, goal, RADIUS).smooth(PathField(field, goal, RADIUS).path_from(start))
    soft_field = PathField(field, goal, RADIUS, soft_margin=0.3)
    soft = soft_field.smooth(soft_field.path_from(start))
    assert field.clearance_at(sampled(soft)).min() > field.clearance_at(sampled(hard)).min() + 0.05
    assert length_of(soft) > length_of(hard)


def test_a_straight_line_costs_its_length_and_infinity_where_the_disc_does_not_fit() -> None:
    field = PathField(map_with_pillars([(0.0, 0.0)], (2.0, 2.0)), np.array([1.5, 0.0]), RADIUS)
    begin = np.array([[-1.0, 1.0], [-1.0, 0.0], [-1.0, 0.25], [-1.0, 0.4]])
    cost = field.line_cost(begin, begin + [2.0, 0.0])
    assert_allclose(cost, [2.0, np.inf, np.inf, 2.0])


# what cannot be reached


def test_no_path_leads_through_a_wall() -> None:
    """Nor from a free place behind it, nor from one so close to it that the disc does not fit there."""
    field = PathField(walls((0.0, 0.0, 2.0, 0.05)), np.array([0.0, 1.0]), RADIUS)
    for y in (-1.0, -0.17, -0.12, -0.07):
        start = np.array([0.3, y])
        assert field.distance_at(start[None])[0] == np.inf
        assert field.path_from(start) is None
        assert field.waypoints(start) is None
        assert not is_solvable(field.occupancy, start, field.goal, RADIUS)
    assert field.path_from(np.array([0.3, 0.12])) is not None


@pytest.mark.parametrize("radius", [0.1, 0.2])
@pytest.mark.parametrize("start", [(0.0, -0.6), (0.0, -0.25), (0.0, -0.12), (0.03, -1.7), (0.2, -0.3)])
def test_a_start_is_not_led_through_an_opening_that_the_disc_does_not_fit(radius: float, start: tuple) -> None:
    """Whether the disc fits at the start or, as close to the wall as that, does not."""
    opening = walls((-1.025, 0.0, 0.975, 0.05), (1.025, 0.0, 0.975, 0.05))
    assert not opening.occupied_at([[0.0, y] for y in (-0.05, 0.0, 0.05)]).any(), "0.1 m wide"
    field = PathField(opening, np.array([0.0, 1.0]), radius)
    assert field.path_from(np.array(start)) is None and field.waypoints(np.array(start)) is None
    assert field.refusal(np.array(start)) == "enclosed"
    assert not is_solvable(opening, np.array(start), field.goal, radius)
    assert field.refusal(np.array([0.0, 0.6])) is None


@pytest.mark.parametrize("radius", [0.1, 0.2])
def test_a_lead_is_short_and_the_disc_moves_along_it(radius: float) -> None:
    """It fits all along where it fits at the start; where it does not, there is ever more room until it does."""
    led = np.zeros(2, int)
    for seed in range(6):
        layout = sample_layout(parse_world("pillar(2,2,10)"), seed, radius)
        occupancy = layout.occupancy(0.0)
        field = PathField(occupancy, layout.goal, radius)
        for start in np.random.default_rng(seed).uniform(-2.0, 2.0, (150, 2)):
            if np.isfinite(field.distance_at(start[None])[0]) or not occupancy.clearance_at(start) > 0.0:
                continue
            path = field.path_from(start, max_vertices=1)
            if path is None:
                continue
            clearance = occupancy.clearance_at(sampled(path))
            assert length_of(path) <= radius + LEAD
            has_room = clearance[0] >= radius
            led[int(has_room)] += 1
            fits = 0 if has_room else int(np.argmax(clearance >= radius))
            assert (clearance[fits:] >= radius - 0.008).all()
            assert (np.maximum.accumulate(clearance)[: fits + 1] - clearance[: fits + 1] <= 0.008).all()
    assert led.min() >= 2


def test_a_goal_walled_in_is_not_reached_from_outside() -> None:
    box = walls((0.0, 0.5, 0.5, 0.05), (0.0, -0.5, 0.5, 0.05), (0.5, 0.0, 0.05, 0.5), (-0.5, 0.0, 0.05, 0.5))
    field = PathField(box, np.zeros(2), RADIUS)
    assert field.path_from(np.array([1.0, 1.0])) is None
    assert_allclose(field.path_from(np.array([0.2, 0.0]))[-1], [0.0, 0.0])


@given(st.floats(-np.pi, np.pi), st.floats(0.0, 0.3))
def test_a_start_in_or_too_close_to_an_obstacle_is_led_out_of_it(angle: float, depth: float) -> None:
    """A pose a few centimetres wrong must not leave the robot without a path."""
    occupancy = map_with_pillars([(0.0, 0.0)], (2.0, 2.0))
    start = depth * np.array([np.cos(angle), np.sin(angle)])
    path = PathField(occupancy, np.array([1.5, 0.0]), RADIUS).path_from(start)
    assert_allclose(path[[0, -1]], [start, [1.5, 0.0]])
    distances = np.linalg.norm(sampled(path), axis=-1)
    out = int(np.argmax(distances >= 0.3 - PIXELATION))
    assert (np.diff(distances[: out + 1]) >= -0.011).all(), "straight out"
    assert (distances[out:] >= 0.3 - 0.05 - PIXELATION).all(), "and not in again"


def test_a_start_outside_the_map_is_led_in() -> None:
    field = PathField(map_with_pillars(half_size=(2.0, 2.0)), np.zeros(2), RADIUS)
    assert_allclose(field.path_from(np.array([2.3, 0.4]))[[0, -1]], [[2.3, 0.4], [0.0, 0.0]])


def test_the_way_of_a_start_whose_own_cell_lacks_room_counts_from_where_it_is_led() -> None:
    occupancy = map_with_pillars([(0.0, 0.0), (1.0, 0.3), (-0.7, 0.5)])
    field, rng = PathField(occupancy, np.array([1.7, -1.6]), 0.1), np.random.default_rng(0)
    starts = rng.uniform(-1.8, 1.8, (4000, 2))
    led = starts[np.isinf(field.distance_at(starts)) & (occupancy.clearance_at(starts) >= 0.1)]
    assert len(led) > 10
    for start in led:
        line = field.path_from(start)
        way = field.way_from(start)
        assert np.isfinite(way) == (line is not None)
        if line is not None:
            assert way == pytest.approx(arc_lengths(line[None])[0, -1], abs=0.15)
    assert field.way_from(np.array([-1.0, -1.0])) == field.distance_at(np.array([[-1.0, -1.0]]))[0]


def test_a_goal_far_outside_is_blocked_without_a_search_on_the_way_there(monkeypatch) -> None:
    def search(*_: object) -> None:
        raise AssertionError("the long way to the goal was looked at")

    monkeypatch.setattr(PathField, "_nearest_end", search)
    field = PathField(map_with_pillars(), np.array([3e5, 0.0]), 0.1)
    assert field.goal_cell is None
    assert field.refusal(np.zeros(2)) == "goal_blocked"


def test_at_the_goal_the_plan_stays_there() -> None:
    goal = np.array([0.33, -0.21])
    field = PathField(map_with_pillars(half_size=(2.0, 2.0)), goal, RADIUS)
    assert_array_equal(field.path_from(goal), [goal, goal])
    assert_allclose(field.waypoints(goal), np.broadcast_to(goal, (10, 2)))


@pytest.mark.parametrize("step", [(0.1, 0.0), (0.0, -0.1), (0.1, 0.1)])
def test_a_goal_one_cell_away_is_gone_to_straight(step: tuple[float, float]) -> None:
    goal = np.array([0.05, 0.05])
    field = PathField(map_with_pillars(half_size=(2.0, 2.0)), goal, RADIUS)
    start = goal + step
    assert_allclose(field.path_from(start), [start, goal])
    assert field.distance_at(start[None])[0] == pytest.approx(np.linalg.norm(step))


@pytest.mark.parametrize("occupied", [False, True])
def test_a_map_of_one_pixel_has_a_path_if_it_is_free_and_large_enough(occupied: bool) -> None:
    field = PathField(OccupancyMap(np.array([[occupied]]), resolution=1.0), np.array([0.6, 0.5]), RADIUS)
    path = field.path_from(np.array([0.4, 0.5]))
    if occupied:
        assert path is None
    else:
        assert_allclose(path[[0, -1]], [[0.4, 0.5], [0.6, 0.5]])
    tiny = PathField(OccupancyMap(np.array([[False]])), np.array([0.02, 0.02]), RADIUS)
    assert tiny.path_from(np.array([0.02, 0.02])) is None, "the disc fits nowhere in 5 cm"


def test_where_everything_is_occupied_there_is_no_path() -> None:
    field = PathField(OccupancyMap(np.ones((20, 20), bool)), np.array([0.5, 0.5]), RADIUS)
    assert field.goal_cell is None
    assert field.path_from(np.array([0.2, 0.2])) is None
    assert (field.distance_at(np.random.default_rng(0).uniform(-1, 2, (50, 2))) == np.inf).all()
    assert not is_solvable(field.occupancy, np.array([0.2, 0.2]), field.goal, RADIUS)


@given(seeds)
def test_in_a_free_map_the_smoothed_path_is_almost_straight(seed: int) -> None:
    start, goal = np.random.default_rng(seed).uniform(-1.8, 1.8, (2, 2))
    field = PathField(map_with_pillars(half_size=(2.0, 2.0)), goal, RADIUS)
    path = field.smooth(field.path_from(start))
    # lines of up to 24 cells between cells of a grid path, which alone may be 8 % longer
    assert length_of(path) <= 1.07 * np.linalg.norm(goal - start) + 0.02


@given(seeds)
@settings(max_examples=40)
def test_a_world_is_solvable_exactly_if_there_is_a_path(seed: int) -> None:
    _, occupancy, start, goal = pillar_world(seed)
    cost = PathField(occupancy, goal, RADIUS).distance_at(start[None])[0]
    own_cell_free = occupancy.clearance_at((np.floor(start / CELL) + 0.5) * CELL) >= RADIUS
    if own_cell_free:
        assert is_solvable(occupancy, start, goal, RADIUS) == np.isfinite(cost)


# waypoints


@given(seeds, margins)
@settings(max_examples=40)
def test_waypoints_are_0_1_m_apart_along_the_path_and_padded_with_the_goal(seed: int, margin: float) -> None:
    _, occupancy, start, goal = pillar_world(seed)
    field = PathField(occupancy, goal, RADIUS, margin)
    waypoints = field.waypoints(start)
    if waypoints is None:
        return
    path = field.smooth(field.path_from(start))
    steps = np.linalg.norm(np.diff(np.concatenate([start[None], waypoints]), axis=0), axis=-1)
    assert steps.max() <= 0.1 + SHIFT
    points = sampled(path, 0.002)
    near = np.linalg.norm(waypoints[:, None] - points, axis=-1).min(axis=1)
    assert near.max() < 0.005 + SHIFT
    at_goal = np.linalg.norm(waypoints - goal, axis=-1) < 1e-9
    assert at_goal.sum() == np.clip(math.floor(10 + 1 - length_of(path) / 0.1 + 1e-6), 0, 10)
    assert (np.diff(at_goal.astype(int)) >= 0).all()


@pytest.mark.parametrize("margin", [0.2, 0.35])
@pytest.mark.parametrize("seed", [1156077361, 2144140404, 3669516656, *range(20)])
def test_every_waypoint_has_room_where_the_start_has(seed: int, margin: float) -> None:
    """The first worlds have passages in which the disc only just fits."""
    layout = sample_layout(parse_world("pillar(2,2,10)"), seed, 0.2)
    occupancy, here = layout.occupancy(0.0), layout.start[:2]
    field = PathField(occupancy, layout.goal, 0.2, margin)
    for _ in range(40):
        waypoints = field.waypoints(here)
        assert occupancy.is_free(waypoints, 0.2).all()
        here = waypoints[4]
    assert np.linalg.norm(here - layout.goal) < 0.3


def test_resampling_is_even_and_padded() -> None:
    path = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.15]])
    expected = [[0.1, 0.0], [0.2, 0.0], [0.3, 0.0], [0.3, 0.1], [0.3, 0.15], [0.3, 0.15]]
    assert_allclose(resample(path, 6, 0.1), expected, atol=1e-12)


def test_shortcuts_straighten_a_detour_and_keep_points_a_fixed_distance_apart() -> None:
    field = PathField(map_with_pillars(half_size=(2.0, 2.0)), np.array([1.0, 0.0]), RADIUS)
    up, down = np.linspace([-1.0, 0.0], [0.0, 1.0], 15), np.linspace([0.0, 1.0], [1.0, 0.0], 15)
    path = np.concatenate([up, down[1:]])
    better = random_shortcuts(path, field, np.random.default_rng(0), tries=60, spacing=0.1)
    assert length_of(better) < 0.9 * length_of(path)
    assert np.linalg.norm(np.diff(better, axis=0), axis=-1).max() <= 0.11
