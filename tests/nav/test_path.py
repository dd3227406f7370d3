"""Distances and progress along a plan are what a ruler would say, and no closed motion makes progress."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav.path import (
    arc_lengths,
    divide,
    nearest_vertex,
    path_distance,
    point_at,
    polyline,
    signed_progress,
)

seeds = st.integers(0, 2**32 - 1)
STRAIGHT = polyline(np.zeros((1, 2)), np.stack([0.1 * np.arange(1, 11), np.zeros(10)], axis=-1)[None])
CORNER = np.array([[[0.0, 0.0], [0.3, 0.0], [0.3, 0.4]]])
POINT = np.full((1, 11, 2), 0.7)


def random_lines(seed: int, rows: int = 3) -> np.ndarray:
    """Plans as they occur and worse: turning at every waypoint, some waypoints repeated, some padded with the goal."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, 0.1, (rows, 10, 2)) * (rng.random((rows, 10, 1)) < 0.8)
    steps[0, rng.integers(0, 10) :] = 0.0
    start = rng.uniform(-2.0, 2.0, (rows, 2))
    return polyline(start, start[:, None] + np.cumsum(steps, axis=1))


def distance_to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance of (M, 2) points to one polyline (V, 2), by looking at a great many of its points."""
    t = np.linspace(0.0, 1.0, 40)[:, None, None]
    dense = ((1.0 - t) * line[:-1] + t * line[1:]).reshape(-1, 2)
    return np.linalg.norm(points[:, None] - dense, axis=-1).min(axis=1)


def test_a_plan_gets_the_position_it_was_made_from_in_front() -> None:
    line = polyline(np.array([[1.0, 2.0]]), np.array([[[3.0, 4.0]]]))
    assert_array_equal(line, [[[1.0, 2.0], [3.0, 4.0]]])


def test_arc_lengths_run_around_the_corner() -> None:
    assert_allclose(arc_lengths(CORNER), [[0.0, 0.3, 0.7]])
    assert_array_equal(arc_lengths(POINT), np.zeros((1, 11)))


def test_points_at_arc_lengths_are_clamped_to_both_ends() -> None:
    stations = np.array([[-1.0, 0.0, 0.15, 0.3, 0.5, 0.7, 9.0]])
    expected = [[0.0, 0.0], [0.0, 0.0], [0.15, 0.0], [0.3, 0.0], [0.3, 0.2], [0.3, 0.4], [0.3, 0.4]]
    assert_allclose(point_at(CORNER, stations)[0], expected, atol=1e-12)


# division


@given(seeds, st.sampled_from([0.005, 0.03, 0.1, 0.25]))
def test_a_divided_plan_has_a_vertex_at_every_interval_and_ends_where_the_plan_ends(seed: int, spacing: float) -> None:
    lines = random_lines(seed)
    divided, total = divide(lines, spacing), arc_lengths(lines)[:, -1]
    for line, vertices, length in zip(lines, divided, total, strict=True):
        stations = np.minimum(spacing * np.arange(len(vertices)), length)
        assert_allclose(vertices, point_at(line[None], stations[None])[0], atol=1e-12)
        assert_allclose(vertices[-1], line[-1], atol=1e-9)
        assert distance_to_line(vertices, line).max() < 0.01


def test_a_plan_of_regular_waypoints_is_divided_into_its_waypoints() -> None:
    divided = divide(STRAIGHT, 0.1)[0]
    assert_allclose(divided[:11], STRAIGHT[0], atol=1e-12)
    assert_allclose(divided[11:], np.broadcast_to([1.0, 0.0], divided[11:].shape), atol=1e-12)


def test_a_plan_without_extent_is_divided_into_its_one_point() -> None:
    assert_allclose(divide(POINT, 0.1), np.full(divide(POINT, 0.1).shape, 0.7))


def test_a_plan_that_is_not_a_number_does_not_keep_others_from_being_divided() -> None:
    both = np.concatenate([STRAIGHT, np.full_like(STRAIGHT, np.nan)])
    assert_allclose(divide(both, 0.1)[0], divide(STRAIGHT, 0.1)[0])
    assert np.isnan(divide(both, 0.1)[1]).all()


@pytest.mark.parametrize("spacing", [0.0, -0.1, np.nan])
def test_a_spacing_that_divides_nothing_is_refused(spacing: float) -> None:
    with pytest.raises(ValueError, match=r"spacing must be positive"):
        divide(STRAIGHT, spacing)


# nearest neighbour index and d_path


@given(seeds)
def test_the_nearest_vertex_is_the_nearest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, vertices = rng.normal(size=(2, 4, 2)), rng.normal(size=(2, 9, 2))
    index, distance = nearest_vertex(points, vertices)
    every = np.linalg.norm(points[:, :, None] - vertices[:, None], axis=-1)
    assert_allclose(distance, every.min(axis=-1))
    assert_allclose(np.take_along_axis(every, index[..., None], -1)[..., 0], distance)


def test_of_equally_near_vertices_the_first_one_counts() -> None:
    index, distance = nearest_vertex(np.array([[[0.7, 0.9]]]), POINT)
    assert index[0, 0] == 0
    assert distance[0, 0] == pytest.approx(0.2)


def test_a_point_that_is_not_a_number_has_no_distance() -> None:
    points = np.array([[[np.nan, 0.0], [0.1, 0.0]]])
    assert_array_equal(np.isnan(nearest_vertex(points, STRAIGHT)[1]), [[True, False]])


def test_d_path_is_the_largest_distance_on_the_way_and_not_only_at_its_ends() -> None:
    """Both ends of the motion lie on the two arms of a plan that goes around three sides of a square."""
    arch = divide(np.array([[[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]]), 0.1)
    chord = path_distance(np.array([[0.0, 0.3]]), np.array([[1.0, 0.3]]), arch, 0.1)
    assert chord[0] == pytest.approx(0.5)


def test_d_path_counts_the_distance_to_vertices() -> None:
    still = np.array([[0.25, 0.0]])
    assert path_distance(still, still, divide(STRAIGHT, 0.1), 0.1)[0] == pytest.approx(0.05)
    assert path_distance(still, still, divide(STRAIGHT, 0.005), 0.1)[0] == pytest.approx(0.0, abs=1e-9)
    aside = np.array([[0.2, 0.3]])
    assert path_distance(aside, np.array([[0.2, 0.1]]), divide(STRAIGHT, 0.1), 0.1)[0] == pytest.approx(0.3)


@given(seeds)
def test_d_path_does_not_depend_on_the_other_rows(seed: int) -> None:
    """A long motion in one row divides the motions of all rows more finely; the distances agree within that."""
    rng = np.random.default_rng(seed)
    vertices = divide(random_lines(seed), 0.1)
    before = rng.uniform(-2.0, 2.0, (3, 2))
    after = before + rng.normal(0.0, 0.2, (3, 2)) * np.array([[1.0], [0.1], [5.0]])
    together = path_distance(before, after, vertices, 0.1)
    for row in range(3):
        one = slice(row, row + 1)
        assert together[row] == pytest.approx(path_distance(before[one], after[one], vertices[one], 0.1)[0], abs=0.05)


def test_a_motion_that_is_not_a_number_has_no_d_path_and_the_others_keep_theirs() -> None:
    vertices = np.repeat(divide(STRAIGHT, 0.1), 2, axis=0)
    before, after = np.array([[0.2, 0.3], [0.2, 0.3]]), np.array([[0.2, 0.3], [np.nan, np.nan]])
    distance = path_distance(before, after, vertices, 0.1)
    assert distance[0] == pytest.approx(0.3)
    assert np.isnan(distance[1])


# progress


def progress_of(points: object, line: np.ndarray) -> np.ndarray:
    points = np.asarray(points, float)
    return signed_progress(points, np.repeat(line, len(points), axis=0))


def test_on_a_straight_plan_progress_is_the_arc_length_and_a_step_aside_costs_its_detour() -> None:
    points = [[0.0, 0.0], [0.25, 0.0], [1.0, 0.0], [0.0, 0.1]]
    # the vertex half a metre on is the one that counts
    detour = 0.5 - np.hypot(0.5, 0.1)
    assert_allclose(progress_of(points, STRAIGHT), [0.0, 0.25, 1.0, detour], atol=1e-12)
    assert detour > -0.01


def test_progress_looks_no_farther_ahead_than_half_a_metre() -> None:
    """A plan that comes back close to itself, around something, must not be cut short."""
    hairpin = np.array([[[0.0, 0.0], [0.7, 0.0], [0.7, 0.3], [0.0, 0.3]]])
    assert_allclose(progress_of([[0.0, 0.0], [0.1, 0.1]], hairpin), [0.0, 0.0], atol=1e-12)


def test_backing_off_a_fresh_plan_is_negative_without_end() -> None:
    assert_allclose(progress_of([[-0.1, 0.0], [-7.0, 0.0]], STRAIGHT), [-0.1, -7.0], atol=1e-12)
    assert progress_of([[-0.3, 0.4]], STRAIGHT)[0] == pytest.approx(0.5 - np.hypot(0.8, 0.4))


def test_on_a_plan_without_extent_progress_is_coming_nearer() -> None:
    assert_allclose(progress_of([[0.7, 0.7], [0.7, 1.0], [0.3, 0.7]], POINT), [0.0, -0.3, -0.4], atol=1e-12)


@given(seeds, st.integers(2, 12))
def test_over_any_closed_motion_progress_sums_to_zero(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    line = random_lines(seed, rows=1)
    tour = rng.normal(line[0, 0], 0.5, (count, 2))
    values = progress_of(np.concatenate([tour, tour[:1]]), line)
    assert np.diff(values).sum() == pytest.approx(0.0, abs=1e-9)


@given(seeds)
def test_following_a_plan_makes_progress_at_every_step_up_to_its_length(seed: int) -> None:
    """Plans that bend but do not turn back on themselves, as those of a planner."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.uniform(-0.4, 0.4, 10)) / 2
    plan = 0.1 * np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    line = polyline(np.zeros((1, 2)), plan[None])
    along = divide(line, 0.02)[0]
    values = progress_of(along, line)
    assert (np.diff(values) >= -1e-9).all()
    # a bent plan is a little longer than the straight line to the vertex half a metre on
    assert -1e-9 <= values[0] < 0.06
    assert values[-1] == pytest.approx(1.0)


@given(seeds)
def test_progress_never_exceeds_the_length_of_the_plan(seed: int) -> None:
    line = random_lines(seed, rows=1)
    points = np.random.default_rng(seed).normal(line[0, 0], 1.0, (50, 2))
    assert progress_of(points, line).max() <= arc_lengths(line)[0, -1] + 1e-9
