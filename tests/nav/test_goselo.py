"""The image shows what is where, the same wherever in the world it happens, and its frame can be inverted."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_planners import map_with_pillars
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav import goselo
from hiernav.nav.goselo import CHANNELS, CLEARANCE_CLIP, MIN_DISTANCE, PIXELS, VISIT_CLIP, GoseloFrame, images
from hiernav.nav.occupancy import OccupancyMap, VisitMap, draw_boxes, empty_map

ALL = (*CHANNELS, "clearance_local")
seeds = st.integers(0, 2**32 - 1)
angles = st.floats(-np.pi, np.pi)
LARGE = (12.0, 12.0)  # whatever is seen in these tests lies in it


def image_of(
    occupancy: OccupancyMap, position: object, goal: object, visited: object = (), channels: tuple[str, ...] = ALL
) -> dict[str, np.ndarray]:
    """The image of one robot by channel, as shares of 255."""
    visits = VisitMap(occupancy)
    visits.add(np.reshape(np.asarray(visited, float), (-1, 2)))
    frame = GoseloFrame.of(np.array([position], float), np.array([goal], float))
    image = images([occupancy], [visits], frame, channels)[0]
    return dict(zip(channels, image / 255.0, strict=True))


def turn(angle: float) -> np.ndarray:
    """(2, 2) matrix R; points (K, 2) turned by `angle` are points @ R.T."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pillars (K, 2), position and goal 0.8 to 2.5 m apart, all near the origin [m]."""
    rng = np.random.default_rng(seed)
    position, heading = rng.uniform(-1.0, 1.0, 2), rng.uniform(-np.pi, np.pi)
    goal = position + rng.uniform(0.8, 2.5) * np.array([np.cos(heading), np.sin(heading)])
    return rng.uniform(-4.0, 4.0, (20, 2)), position, goal


# the frame


@given(seeds)
def test_the_frame_can_be_inverted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = GoseloFrame.of(rng.normal(size=(3, 2)), rng.normal(size=(3, 2)))
    for shape in ((3, 2), (3, 10, 2), (3, 4, 10, 2)):
        points = rng.normal(size=shape)
        assert_allclose(frame.from_world(frame.to_world(points)), points, atol=1e-12)


@given(seeds)
def test_the_robot_is_the_origin_and_the_goal_straight_above_at_distance_l(seed: int) -> None:
    position, goal = np.random.default_rng(seed).normal(size=(2, 3, 2))
    frame = GoseloFrame.of(position, goal)
    assert_allclose(frame.from_world(position), np.zeros((3, 2)), atol=1e-12)
    assert_allclose(
        frame.from_world(goal), np.stack([np.zeros(3), np.linalg.norm(goal - position, axis=-1)], -1), atol=1e-12
    )


def test_right_is_right_of_the_way_to_the_goal() -> None:
    frame = GoseloFrame.of(np.zeros((1, 2)), np.array([[0.0, 2.0]]))
    assert_allclose(frame.to_world(np.array([[[1.0, 0.0], [0.0, 1.0]]])), [[[1.0, 0.0], [0.0, 1.0]]])
    frame = GoseloFrame.of(np.zeros((1, 2)), np.array([[2.0, 0.0]]))
    assert_allclose(frame.to_world(np.array([[[1.0, 0.0], [0.0, 1.0]]])), [[[0.0, -1.0], [1.0, 0.0]]], atol=1e-12)


def test_a_robot_at_its_goal_has_a_frame_and_an_image() -> None:
    frame = GoseloFrame.of(np.full((1, 2), 0.3), np.full((1, 2), 0.3))
    assert frame.distance[0] == MIN_DISTANCE
    assert_array_equal(frame.up, [[0.0, 1.0]])
    points = np.array([[[0.2, 0.5]]])
    assert_allclose(frame.from_world(frame.to_world(points)), points)
    image = image_of(map_with_pillars([(0.3, 0.6)]), (0.3, 0.3), (0.3, 0.3))
    assert all(np.isfinite(channel).all() for channel in image.values())


# moving the whole world


@given(seeds, angles)
@settings(max_examples=20)
def test_moving_the_world_does_not_change_waypoints_in_the_image(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    _, position, goal = scene(seed)
    shift, waypoints = rng.uniform(-3.0, 3.0, 2), rng.normal(size=(1, 10, 2))
    here = GoseloFrame.of(position[None], goal[None])
    there = GoseloFrame.of((position @ turn(angle).T + shift)[None], (goal @ turn(angle).T + shift)[None])
    assert_allclose(there.to_world(waypoints), here.to_world(waypoints) @ turn(angle).T + shift, atol=1e-12)


@given(seeds, st.sampled_from([1, 2, 3]), st.integers(-20, 20), st.integers(-20, 20))
@settings(max_examples=15)
def test_quarter_turns_and_shifts_by_pixels_leave_the_image_as_it_is(seed: int, quarters: int, x: int, y: int) -> None:
    """At the map's own resolution; coarser crops average over blocks of pixels that do not move with the world."""
    pillars, position, goal = scene(seed)
    rotation, shift = np.round(turn(quarters * np.pi / 2)), 0.05 * np.array([x, y])
    here = image_of(map_with_pillars(pillars, LARGE), position, goal)
    moved = map_with_pillars(pillars @ rotation.T + shift, LARGE)
    there = image_of(moved, rotation @ position + shift, rotation @ goal + shift)
    for name in ("obstacles_1", "clearance_local"):
        difference = np.abs(here[name] - there[name])
        assert (difference > 0.02).mean() < 0.002, name  # a pixel centre on the very edge of a disc
    for name in ("obstacles_2", "obstacles_4"):
        assert np.abs(here[name] - there[name]).mean() < 0.01, name


@given(seeds, angles)
@settings(max_examples=15)
def test_any_rigid_motion_changes_the_image_by_no_more_than_the_interpolation(seed: int, angle: float) -> None:
    pillars, position, goal = scene(seed)
    shift = np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
    here = image_of(map_with_pillars(pillars, LARGE), position, goal)
    moved = map_with_pillars(pillars @ turn(angle).T + shift, LARGE)
    there = image_of(moved, turn(angle) @ position + shift, turn(angle) @ goal + shift)
    for name in ("obstacles_1", "obstacles_2", "obstacles_4", "clearance_local"):
        difference = there[name] - here[name]
        assert np.abs(difference).mean() < 0.04, name
        # edges differ by up to a map pixel either way, which is many image pixels where the goal is near
        assert np.abs(cv2.blur(difference, (9, 9))[4:-4, 4:-4]).max() < 0.3, name


@given(seeds)
@settings(max_examples=10)
def test_a_world_twice_as_large_gives_the_same_crops_relative_to_l(seed: int) -> None:
    pillars, position, goal = scene(seed)
    once = image_of(map_with_pillars(pillars, (20.0, 20.0)), position, goal)
    twice = image_of(map_with_pillars(2 * pillars, (20.0, 20.0), radius=0.4), 2 * position, 2 * goal)
    for name in ("obstacles_2", "obstacles_4"):
        assert np.abs(once[name] - twice[name]).mean() < 0.02, name


# what is where


def blob_center(channel: np.ndarray) -> np.ndarray:
    """Row and column of the centre of what is bright, in pixels."""
    return np.array([np.average(grid, weights=channel) for grid in np.indices(channel.shape)])


@given(angles, st.floats(1.0, 2.5))
@settings(max_examples=15)
def test_the_goal_is_straight_above_and_the_robot_straight_below_the_centre(angle: float, length: float) -> None:
    position = np.array([0.3, -0.2])
    goal = position + length * np.array([np.cos(angle), np.sin(angle)])
    for where, side in ((goal, -1.0), (position, 1.0)):
        image = image_of(map_with_pillars([where], LARGE), position, goal)
        for name, crop in (("obstacles_2", 2 * length), ("obstacles_4", 4 * length)):
            expected = [31.5 + side * 0.5 * length / crop * PIXELS, 31.5]
            assert_allclose(blob_center(image[name]), expected, atol=1.0)


def test_what_stands_to_the_right_is_seen_on_the_right() -> None:
    """Looking along +x, the right is at -y."""
    image = image_of(map_with_pillars([(1.0, -0.7)], LARGE), (0.0, 0.0), (2.0, 0.0))
    for name in ("obstacles_1", "obstacles_2", "obstacles_4"):
        row, column = blob_center(image[name])
        assert row == pytest.approx(31.5, abs=0.6)
        assert column > 34
    assert image_of(map_with_pillars([(0.0, -0.7)]), (0.0, 0.0), (2.0, 0.0))["clearance_local"][32, 46] == 0.0


def test_outside_the_map_is_occupied_unvisited_and_without_clearance() -> None:
    free = map_with_pillars(half_size=(1.0, 1.0))
    image = image_of(free, (0.0, 0.0), (0.0, 0.9), visited=[(0.0, 0.0)])
    wide = image["obstacles_4"]
    assert (wide[:, 0] == 1.0).all() and (wide[0] == 1.0).all()
    share = 4.0 / 3.6**2  # the field's part of the crop of 4 L
    assert wide.mean() == pytest.approx(1.0 - share, abs=0.01)
    assert (image["visits_4"][:, 0] == 0.0).all()
    assert image["clearance_local"][32, 0] == 0.0
    far_out = image_of(free, (50.0, 50.0), (51.0, 50.0))
    assert all((far_out[name] == 1.0).all() for name in CHANNELS[:3])
    assert all((far_out[name] == 0.0).all() for name in CHANNELS[3:])


@given(seeds, st.floats(0.5, 3.5), angles)
@settings(max_examples=20)
def test_crops_preserve_area(seed: int, length: float, angle: float) -> None:
    """The mean of a crop is the occupied share of the square it shows, found here by looking at 400 x 400 points."""
    pillars = np.random.default_rng(seed).uniform(-6.0, 6.0, (60, 2))
    occupancy = map_with_pillars(pillars, LARGE)
    direction = np.array([np.cos(angle), np.sin(angle)])
    position, goal = -0.5 * length * direction, 0.5 * length * direction
    image = image_of(occupancy, position, goal)
    unit = (np.arange(400) + 0.5) / 400 - 0.5
    right = np.array([direction[1], -direction[0]])
    for name, side in (("obstacles_1", length + 0.4), ("obstacles_2", 2 * length), ("obstacles_4", 4 * length)):
        points = side * (unit[:, None, None] * direction + unit[None, :, None] * right)
        assert image[name].mean() == pytest.approx(occupancy.occupied_at(points).mean(), abs=0.01), name


def test_a_pixel_half_beyond_the_edge_of_a_map_of_odd_sides_is_half_of_what_lies_outside() -> None:
    free = np.zeros((17, 21), np.uint8)
    for outside in (0, 255):
        coarse = goselo._halve(free, outside)[1]
        assert coarse.shape == (9, 11)
        assert not coarse[:-1, :-1].any()
        assert_allclose(coarse[:-1, -1], 0.5 * outside, atol=1)
        assert_allclose(coarse[-1, :-1], 0.5 * outside, atol=1)
        assert_allclose(float(coarse[-1, -1]), 0.75 * outside, atol=1)


def test_thin_pillars_do_not_vanish_in_the_widest_crop() -> None:
    """Pillars of two map pixels in a crop of 32 m: half a pixel of the image each, wherever they stand."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        where = rng.uniform(-3.0, 3.0, 2)
        occupancy = empty_map((20.0, 20.0))
        draw_boxes(occupancy.occupied, occupancy.origin, occupancy.resolution, [where], [(0.05, 0.05)])
        pixels = int(occupancy.occupied.sum())
        seen = image_of(occupancy, (-4.0, 0.0), (4.0, 0.0))["obstacles_4"].sum()
        assert seen == pytest.approx(pixels * 0.05**2 / 0.5**2, abs=0.02)
        assert seen > 0.0


# channels


def test_visits_are_shown_where_they_were_and_grow_up_to_the_clip() -> None:
    free = map_with_pillars()
    there, away = (0.5, 0.525), (-2.5, -2.5)
    means = []
    for times in range(VISIT_CLIP + 3):
        image = image_of(free, (0.0, 0.0), (0.0, 1.05), visited=[there, away] * times)
        means.append(image["visits_2"].mean())
        if times:
            row, column = blob_center(image["visits_2"])
            assert row == pytest.approx(31.5, abs=0.8)
            assert column == pytest.approx(31.5 + 64 * 0.5 / 2.1, abs=1.0)
    assert means[0] == 0.0
    assert_allclose(means[1 : VISIT_CLIP + 1], means[1] * np.arange(1, VISIT_CLIP + 1), rtol=0.1)
    assert means[VISIT_CLIP:] == [means[VISIT_CLIP]] * 3


def test_visits_and_obstacles_do_not_show_in_each_other_s_channels() -> None:
    image = image_of(map_with_pillars(half_size=LARGE), (0.0, 0.0), (0.0, 1.0), visited=[(0.3, 0.4)])
    assert not any(image[name].any() for name in CHANNELS[:3])
    image = image_of(map_with_pillars([(0.3, 0.4)], LARGE), (0.0, 0.0), (0.0, 1.0))
    assert not any(image[name].any() for name in CHANNELS[3:])


def test_clearance_is_metric_and_clipped() -> None:
    """A pillar 0.8 m to the right, whatever L is: its near edge is 0.6 m away."""
    for length in (0.5, 2.0, 5.0):
        image = image_of(map_with_pillars([(0.8, 0.0)], LARGE), (0.0, 0.0), (0.0, length))["clearance_local"]
        assert image[31:33, 31:33].mean() * CLEARANCE_CLIP == pytest.approx(0.6, abs=0.03)
        assert image[31, 24] == 1.0
        assert image[31, 48] == 0.0


def test_a_channel_of_another_name_is_refused() -> None:
    with pytest.raises(ValueError, match=r"GOSELO channel 'obstacles_3'"):
        image_of(map_with_pillars(), (0.0, 0.0), (1.0, 0.0), channels=("obstacles_1", "obstacles_3"))


@given(seeds)
@settings(max_examples=10)
def test_an_image_does_not_depend_on_the_other_robots(seed: int) -> None:
    scenes = [scene(seed), scene(seed + 1), scene(seed + 2)]
    maps = [map_with_pillars(pillars) for pillars, _, _ in scenes]
    frame = GoseloFrame.of(np.array([p for _, p, _ in scenes]), np.array([g for _, _, g in scenes]))
    together = images(maps, [VisitMap(m) for m in maps], frame)
    for row, (_, position, goal) in enumerate(scenes):
        alone = image_of(maps[row], position, goal, channels=CHANNELS)
        assert_array_equal(together[row] / 255.0, np.stack(list(alone.values())))


# long and narrow maps


@pytest.mark.parametrize("length", [2000, 8000])
def test_a_long_and_narrow_map_is_shown_in_milliseconds(length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """From one end of a corridor 0.75 m wide to the other: the image warped for a crop stays small."""
    warped: list[tuple[int, int]] = []
    warp = cv2.warpAffine

    def noting(image: np.ndarray, matrix: np.ndarray, size: tuple[int, int], **options: object) -> np.ndarray:
        assert max(size) <= 16 * PIXELS
        warped.append(size)
        return warp(image, matrix, size, **options)

    monkeypatch.setattr(cv2, "warpAffine", noting)
    corridor = OccupancyMap(np.zeros((15, length), bool))
    shown = image_of(corridor, (0.3, 0.35), (length * 0.05 - 0.5, 0.35))
    assert warped and max(side for size in warped for side in size) <= 9 * PIXELS
    # the corridor is less than a pixel wide, in the middle of what is occupied
    assert shown["obstacles_1"][:, :28].min() == shown["obstacles_1"][:, 36:].min() == 1.0
    assert (shown["obstacles_1"][4:60, 28:36].min(axis=1) < 1.0).all()


def test_a_goal_far_beyond_the_map_is_shown_as_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    warp = cv2.warpAffine

    def checked(image: np.ndarray, matrix: np.ndarray, size: tuple[int, int], **options: object) -> np.ndarray:
        assert max(size) <= 16 * PIXELS
        return warp(image, matrix, size, **options)

    monkeypatch.setattr(cv2, "warpAffine", checked)
    shown = image_of(empty_map((2.0, 2.0)), (0.0, 0.0), (1e6, 0.0))
    assert shown["obstacles_4"].min() > 0.9


@pytest.mark.parametrize("shape", [(80, 80), (40, 80), (20, 100), (127, 16), (400, 400), (100, 700)])
def test_up_to_eight_times_as_long_as_wide_a_map_has_the_levels_down_to_a_width_of_8_to_15_pixels(shape) -> None:
    levels = goselo._halve(np.zeros(shape, np.uint8), outside=255)
    widths = [min(level.shape) for level in levels]
    assert all(width >= 16 for width in widths[:-1]) and 8 <= widths[-1] < 16
