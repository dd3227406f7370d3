"""The cost to go is what independent searches find, and no corner is cut."""

from __future__ import annotations

import heapq
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_planners import pillar_world
from numpy.testing import assert_allclose
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import dijkstra

from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.search import CELL, PathField, is_solvable

RADIUS = 0.1
seeds = st.integers(0, 2**32 - 1)


def map_of(cells: np.ndarray) -> OccupancyMap:
    """Free where `cells` (rows, cols) is True: one planning cell each, 2 x 2 pixels, radius to be taken as 0.02."""
    return OccupancyMap(np.repeat(np.repeat(~cells, 2, axis=0), 2, axis=1))


def random_cells(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.random(rng.integers(2, 12, 2)) < rng.uniform(0.5, 1.0)


def costs_by_hand(free: np.ndarray, goal: tuple[int, int], factor: np.ndarray) -> np.ndarray:
    """Cost to go of every cell: Dijkstra with a heap, cell by cell."""
    cost = np.full(free.shape, np.inf)
    cost[goal], queue = 0.0, [(0.0, goal)]
    while queue:
        so_far, (row, col) = heapq.heappop(queue)
        if so_far > cost[row, col]:
            continue
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                r, c = row + dr, col + dc
                if not (0 <= r < free.shape[0] and 0 <= c < free.shape[1]) or not (dr or dc):
                    continue
                if not (free[r, c] and free[r, col] and free[row, c]):
                    continue
                total = so_far + CELL * math.hypot(dr, dc) * 0.5 * (factor[row, col] + factor[r, c])
                if total < cost[r, c] - 1e-12:
                    cost[r, c] = total
                    heapq.heappush(queue, (total, (r, c)))
    return cost


def length_of(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum())


@given(seeds)
def test_the_cost_to_go_is_that_of_two_independent_searches(seed: int) -> None:
    free = random_cells(seed)
    rows, cols = free.shape
    goal = tuple(int(v) for v in np.argwhere(free)[seed % free.sum()]) if free.any() else (0, 0)
    field = PathField(map_of(free), CELL * (np.array(goal[::-1]) + 0.5), radius=0.02)
    got = field.distance_at(CELL * (np.argwhere(np.ones_like(free))[:, ::-1] + 0.5)).reshape(free.shape)
    by_hand = costs_by_hand(free, goal, np.ones(free.shape)) if free.any() else np.full(free.shape, np.inf)
    assert_allclose(got, by_hand)

    graph = lil_matrix((rows * cols, rows * cols))
    for row, col in np.argwhere(free):
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            r, c = row + dr, col + dc
            if 0 <= r < rows and 0 <= c < cols and free[r, c] and free[r, col] and free[row, c]:
                graph[row * cols + col, r * cols + c] = CELL * math.hypot(dr, dc)
    if free.any():
        by_scipy = dijkstra(graph.tocsr(), directed=False, indices=goal[0] * cols + goal[1]).reshape(free.shape)
        assert_allclose(got, by_scipy)


@given(seeds)
@settings(max_examples=15)
def test_with_a_soft_margin_the_cost_to_go_is_that_of_an_independent_search(seed: int) -> None:
    pillars, occupancy, _, goal = pillar_world(seed)
    field = PathField(occupancy, goal, RADIUS, soft_margin=0.15, soft_weight=4.0)
    grid = CELL * (np.indices((40, 40)).transpose(1, 2, 0)[..., ::-1] + 0.5) - 2.0
    clearance = occupancy.clearance_at(grid)
    free = clearance >= RADIUS
    factor = 1.0 + 4.0 * np.clip(1.0 - (clearance - RADIUS) / 0.15, 0.0, 1.0) ** 2
    nearest = np.argwhere(free)[np.linalg.norm(grid[free] - goal, axis=-1).argmin()]
    by_hand = costs_by_hand(free, tuple(int(v) for v in nearest), factor)
    assert_allclose(field.distance_at(grid.reshape(-1, 2)).reshape(40, 40), by_hand)


@given(seeds)
def test_a_path_is_as_long_as_its_cost_and_cuts_no_corner(seed: int) -> None:
    free = random_cells(seed)
    if not free.any():
        return
    goal, start = CELL * (np.argwhere(free)[[0, -1], ::-1] + 0.5)
    field = PathField(map_of(free), goal, radius=0.02)
    path = field.path_from(start)
    if not np.isfinite(field.distance_at(start[None])[0]):
        return
    assert_allclose(path[[0, -1]], [start, goal])
    assert length_of(path) == pytest.approx(field.distance_at(start[None])[0])
    cells = np.floor(path / CELL).astype(int)
    for (col, row), (c, r) in zip(cells[:-1], cells[1:], strict=True):
        assert max(abs(col - c), abs(row - r)) <= 1
        assert free[r, c] and free[row, c] and free[r, col]


def test_the_gap_between_two_obstacles_that_touch_at_their_corners_is_closed() -> None:
    free = np.array([[True, False], [False, True]])
    field = PathField(map_of(free), np.array([0.05, 0.05]), radius=0.02)
    assert field.distance_at(np.array([[0.15, 0.15]]))[0] == np.inf
    assert not is_solvable(map_of(free), np.array([0.15, 0.15]), np.array([0.05, 0.05]), 0.02)


@given(seeds)
@settings(max_examples=20)
def test_a_mirrored_world_has_mirrored_costs(seed: int) -> None:
    pillars, occupancy, start, goal = pillar_world(seed)
    points = np.random.default_rng(seed).uniform(-2.0, 2.0, (40, 2))
    here = PathField(occupancy, goal, RADIUS, 0.15)
    for mirror in ([-1.0, 1.0], [1.0, -1.0]):
        flipped = OccupancyMap(np.flip(occupancy.occupied, axis=1 if mirror[0] < 0 else 0).copy(), origin=(-2.0, -2.0))
        there = PathField(flipped, goal * mirror, RADIUS, 0.15)
        assert_allclose(there.distance_at(points * mirror), here.distance_at(points), atol=1e-6)
        ways = [field.path_from(start * sign) for field, sign in ((here, 1.0), (there, np.array(mirror)))]
        assert (ways[0] is None) == (ways[1] is None)
