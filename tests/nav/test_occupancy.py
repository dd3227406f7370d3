"""The occupancy map agrees with the geometry drawn into it, and refuses what cannot be a map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.nav.occupancy import MAX_SIDE, OccupancyMap, VisitMap, draw_boxes, draw_discs, empty_map

seeds = st.integers(0, 2**32 - 1)


def random_discs(seed: int, radius: float, count: int = 12) -> tuple[OccupancyMap, np.ndarray]:
    field = empty_map((2.0, 1.5))
    centers = np.random.default_rng(seed).uniform((-2.5, -2.0), (2.5, 2.0), (count, 2))
    draw_discs(field.occupied, field.origin, field.resolution, centers, radius)
    return field, centers


def test_an_empty_map_covers_the_field_and_is_free() -> None:
    field = empty_map((2.0, 1.5))
    assert field.occupied.shape == (60, 80)
    assert field.extent == pytest.approx((-2.0, 2.0, -1.5, 1.5))
    assert not field.occupied.any()


def test_row_0_is_the_lowest_y_and_column_0_the_lowest_x() -> None:
    centers = empty_map((1.0, 0.5)).pixel_centers()
    assert centers[0, 0] == pytest.approx([-0.975, -0.475])
    assert centers[-1, 0] == pytest.approx([-0.975, 0.475])
    assert centers[0, -1] == pytest.approx([0.975, -0.475])


@given(seeds, st.floats(0.03, 0.8))
def test_a_pixel_is_occupied_exactly_if_its_centre_is_in_a_disc(seed: int, radius: float) -> None:
    field, centers = random_discs(seed, radius)
    distance = np.linalg.norm(field.pixel_centers()[:, :, None] - centers, axis=-1).min(axis=-1)
    assert field.occupied[distance < radius - 1e-6].all()
    assert not field.occupied[distance > radius + 1e-6].any()


@given(seeds)
def test_a_pixel_is_occupied_exactly_if_its_centre_is_in_a_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field = empty_map((2.0, 1.5))
    centers, halves = rng.uniform((-2.5, -2.0), (2.5, 2.0), (6, 2)), rng.uniform(0.01, 0.6, (6, 2))
    draw_boxes(field.occupied, field.origin, field.resolution, centers, halves)
    depth = (halves - np.abs(field.pixel_centers()[:, :, None] - centers)).min(axis=-1).max(axis=-1)
    assert field.occupied[depth > 1e-6].all()
    assert not field.occupied[depth < -1e-6].any()


def test_a_wall_of_0_1_m_is_two_pixels_thick() -> None:
    field = empty_map((2.0, 2.0))
    draw_boxes(field.occupied, field.origin, field.resolution, [(-1.0, 0.0)], [(1.0, 0.05)])
    assert np.flatnonzero(field.occupied[:, 10]).tolist() == [39, 40]
    assert np.flatnonzero(field.occupied[39]).tolist() == list(range(40))


def test_drawing_outside_of_the_map_marks_nothing() -> None:
    field = empty_map((1.0, 1.0))
    draw_discs(field.occupied, field.origin, field.resolution, [(5.0, 0.0), (-9.0, 1.0)], 0.2)
    draw_boxes(field.occupied, field.origin, field.resolution, [(0.0, 4.0), (-3.0, 0.0)], [(0.1, 0.1), (0.5, 9.0)])
    assert not field.occupied.any()


@given(seeds)
def test_clearance_is_the_distance_to_obstacle_or_border_within_a_pixel(seed: int) -> None:
    field, centers = random_discs(seed, 0.2)
    points = np.random.default_rng(seed + 1).uniform((-2.0, -1.5), (2.0, 1.5), (300, 2))
    to_disc = np.linalg.norm(points[:, None] - centers, axis=-1).min(axis=-1) - 0.2
    to_border = np.minimum(2.0 - np.abs(points[:, 0]), 1.5 - np.abs(points[:, 1]))
    expected = np.maximum(np.minimum(to_disc, to_border), 0.0)
    assert np.abs(field.clearance_at(points) - expected).max() < field.resolution


def test_clearance_is_exact_towards_a_straight_wall() -> None:
    field = empty_map((2.0, 2.0))
    draw_boxes(field.occupied, field.origin, field.resolution, [(0.0, 0.0)], [(2.0, 0.05)])
    heights = np.array([0.1, 0.237, 0.5, 0.9])
    points = np.stack((np.zeros(4), heights), axis=-1)
    assert field.clearance_at(points) == pytest.approx(heights - 0.05, abs=1e-6)
    assert field.clearance.dtype == np.float32 and field.clearance.shape == field.occupied.shape


def test_outside_counts_as_occupied() -> None:
    field = empty_map((1.0, 1.0))
    outside = np.array([[1.2, 0.0], [0.0, -1.01], [np.nan, 0.0], [np.inf, 0.0], [1e300, -1e300]])
    assert not field.contains(outside).any()
    assert (field.clearance_at(outside) == 0.0).all()
    assert field.occupied_at(outside).all()
    assert not field.is_free(outside, 0.0).any()


def test_a_disc_is_free_until_it_touches() -> None:
    field = empty_map((2.0, 2.0))
    draw_boxes(field.occupied, field.origin, field.resolution, [(0.0, 0.0)], [(2.0, 0.05)])
    assert field.is_free((0.0, 0.16), 0.1)
    assert not field.is_free((0.0, 0.14), 0.1)
    assert not field.is_free((1.95, 1.0), 0.1)
    assert field.is_free((0.0, 0.1), 0.0)
    assert not field.is_free((0.0, 0.0), 0.0)


def test_a_map_full_of_obstacles_has_no_clearance() -> None:
    field = OccupancyMap(np.ones((7, 5), dtype=bool))
    assert (field.clearance == 0.0).all()


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_a_map_without_pixels_is_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"between 1 and 16384"):
        OccupancyMap(np.zeros(shape, dtype=bool))


@pytest.mark.parametrize("resolution", [0.0, -0.05, float("nan"), float("inf")])
def test_a_resolution_that_is_not_finite_and_positive_is_refused(resolution: float) -> None:
    with pytest.raises(ValueError, match=f"resolution {resolution}.*finite and positive"):
        OccupancyMap(np.zeros((4, 4), dtype=bool), resolution)
    with pytest.raises(ValueError, match="finite and positive"):
        empty_map((1.0, 1.0), resolution)


def test_a_map_of_65536_pixels_a_side_is_refused_before_memory_is_taken() -> None:
    with pytest.raises(ValueError, match=f"65536 x 65536 pixels.*{MAX_SIDE}"):
        empty_map((65536 * 0.05 / 2, 65536 * 0.05 / 2))
    # a view of one byte: the check cannot have touched 4 GB
    huge = np.broadcast_to(np.zeros((1, 1), dtype=bool), (65536, 65536))
    with pytest.raises(ValueError, match="65536 x 65536"):
        OccupancyMap(huge)


def test_other_arrays_and_origins_are_refused() -> None:
    with pytest.raises(ValueError, match="3 dimensions"):
        OccupancyMap(np.zeros((4, 4, 1), dtype=bool))
    with pytest.raises(ValueError, match="uint8"):
        OccupancyMap(np.zeros((4, 4), dtype=np.uint8))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="origin"):
        OccupancyMap(np.zeros((4, 4), dtype=bool), 0.05, (np.nan, 0.0))
    with pytest.raises(ValueError, match="half size"):
        empty_map((np.inf, 1.0))


def test_visits_count_entries_not_time_spent() -> None:
    visits = VisitMap(empty_map((1.0, 1.0)))
    visits.add([(0.01, 0.01), (0.02, 0.03), (0.04, 0.01)])
    visits.add((0.03, 0.03))
    assert visits.counts[20, 20] == 1 and visits.counts.sum() == 1
    visits.add([(0.06, 0.01), (0.01, 0.01)])
    assert visits.counts[20, 20] == 2 and visits.counts[20, 21] == 1


@given(seeds)
def test_visits_do_not_depend_on_how_the_track_is_cut(seed: int) -> None:
    rng = np.random.default_rng(seed)
    track = np.cumsum(rng.normal(0.0, 0.04, (200, 2)), axis=0)
    whole, pieces = VisitMap(empty_map((1.0, 1.0))), VisitMap(empty_map((1.0, 1.0)))
    whole.add(track)
    for piece in np.split(track, np.sort(rng.integers(0, 200, 7))):
        pieces.add(piece)
    assert (whole.counts == pieces.counts).all() and whole.counts.any()


def test_visits_are_clipped_and_ignore_what_lies_outside() -> None:
    visits = VisitMap(empty_map((1.0, 1.0)))
    visits.add(np.tile([(0.01, 0.01), (0.06, 0.01)], (400, 1)))
    assert visits.counts[20, 20] == 255
    before = visits.counts.copy()
    visits.add([(3.0, 0.0), (np.nan, np.nan), (-1.2, 0.5)])
    assert (visits.counts == before).all()


def test_visits_are_found_within_a_square_around_a_position() -> None:
    visits = VisitMap(empty_map((1.0, 1.0)))
    assert not visits.near((0.0, 0.0), 5.0)
    visits.add((0.525, 0.025))
    assert visits.near((0.525, 0.025), 0.0)
    assert visits.near((0.3, 0.2), 0.25)
    assert not visits.near((0.3, 0.2), 0.15)
    assert not visits.near((-0.525, 0.025), 0.3)
    assert visits.near((1.3, 0.0), 0.9), "a position outside the map, its square reaching in"
    assert not visits.near((-3.0, -3.0), 0.5)


def test_visits_stay_where_they_were_when_the_map_grows_or_moves() -> None:
    visits = VisitMap(empty_map((1.0, 1.0)))
    visits.add([(0.525, 0.025), (0.325, 0.025), (0.525, 0.025), (-0.925, -0.525)])
    grown = OccupancyMap(np.zeros((60, 80), dtype=np.bool_), 0.05, (-1.0, -1.5))
    assert not visits.lies_on(grown)
    moved = visits.moved_to(grown)
    assert moved.lies_on(grown) and moved.counts.sum() == visits.counts.sum() == 4
    assert moved.counts[30, 30] == 2 and moved.counts[30, 26] == 1 and moved.counts[19, 1] == 1
    moved.add((-0.93, -0.53))
    assert moved.counts[19, 1] == 1, "resting where the last position was"
    moved.add((0.525, 0.025))
    assert moved.counts[30, 30] == 3
    rolled = visits.moved_to(OccupancyMap(np.zeros((40, 40), dtype=np.bool_), 0.05, (-0.5, -1.0)))
    assert rolled.counts.sum() == 3 and rolled.counts[20, 20] == 2, "what lies outside is lost"
    coarse = visits.moved_to(OccupancyMap(np.zeros((20, 20), dtype=np.bool_), 0.1, (-1.0, -1.0)))
    assert coarse.counts[10, 15] == 2 and coarse.counts[4, 0] == 1


def test_clearances_are_the_same_to_the_bit_whenever_they_are_computed() -> None:
    occupied = np.random.default_rng(0).random((60, 50)) < 0.01
    row, col = np.indices(occupied.shape)
    near = np.argwhere(occupied).T[:, :, None, None]
    squares = ((row - near[0]) ** 2 + (col - near[1]) ** 2).min(axis=0).astype(np.float32)
    expected = np.maximum(np.sqrt(squares) - np.float32(0.5), np.float32(0.0)) * np.float32(0.05)
    # nearer to an obstacle than to the border
    inside = (np.minimum.reduce([row, col, 59 - row, 49 - col]) >= 8) & (squares < 64)
    for _ in range(3):
        clearance = OccupancyMap(occupied.copy(), 0.05, (0.0, 0.0)).clearance
        np.testing.assert_array_equal(clearance[inside], expected[inside])
