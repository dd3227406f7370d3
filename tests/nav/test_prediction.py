"""Maps as they will be: what moves is drawn where it will be, and everything else stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav.occupancy import OccupancyMap, draw_boxes, draw_discs, empty_map
from hiernav.nav.option import PlanQuery, WaypointOption
from hiernav.nav.prediction import AHEAD_S, LOOK_S, MOST, NEAR_M, WINDOW_S, MapPredictor

HERE = np.zeros(2)
PERIOD = 0.1
RADIUS = 0.15


def drawn(*centers: tuple[float, float] | np.ndarray, half: float = 3.0) -> OccupancyMap:
    """Discs, between two walls that stand."""
    field = empty_map((half, half))
    draw_boxes(field.occupied, field.origin, field.resolution, np.array([[0.0, 1.5]]), np.array([[1.0, 0.05]]))
    draw_discs(field.occupied, field.origin, field.resolution, np.array(centers).reshape(-1, 2), RADIUS)
    return field


def watched(path, steps: int, period: float = PERIOD, position: np.ndarray = HERE) -> tuple[OccupancyMap, OccupancyMap]:
    """The last of some maps with discs at `path(time)`, and its prediction."""
    predictor = MapPredictor()
    for step in range(steps):
        now = drawn(*path(step * period))
        ahead = predictor(now, step * period, position)
    return now, ahead


def centre_near(occupancy: OccupancyMap, point: np.ndarray) -> np.ndarray:
    """Centre [m] of what is occupied within 0.3 m of a point (2,) [m]."""
    row, col = np.nonzero(occupancy.occupied)
    at = np.array(occupancy.origin) + (np.stack([col, row], axis=1) + 0.5) * occupancy.resolution
    near = at[np.linalg.norm(at - point, axis=1) < 0.3]
    assert len(near), f"nothing at {point}"
    return near.mean(axis=0)


def straight(time: float) -> list[np.ndarray]:
    return [np.array([-0.8, -0.5]) + time * np.array([0.4, 0.2])]


def circling(time: float) -> list[np.ndarray]:
    return [np.array([-0.5, -1.0]) + 0.35 * np.array([np.cos(1.2 * time), np.sin(1.2 * time)])]


@pytest.mark.parametrize("path", [straight, circling])
@pytest.mark.parametrize("period", [0.02, 0.04, 0.1, 0.2])
def test_what_moves_is_where_it_will_be_and_no_longer_where_it_is(path, period: float) -> None:
    steps = round(1.6 / period) + 1
    now, ahead = watched(path, steps, period)
    # the map is looked at every 0.1 s, so that the prediction may be that much older
    moments = 1.6 + AHEAD_S - np.array([0.0, LOOK_S, 2 * period])
    there = [path(moment)[0] for moment in moments]
    assert min(np.linalg.norm(centre_near(ahead, there[0]) - each) for each in there) < 0.07
    assert not ahead.occupied_at(path(1.6)[0])
    assert abs(int(ahead.occupied.sum()) - int(now.occupied.sum())) <= 4  # a disc on other pixels


def test_what_stands_is_left_as_it_is() -> None:
    now, ahead = watched(lambda time: [*straight(time), np.array([1.0, 0.5])], 15)
    standing = drawn((1.0, 0.5)).occupied
    assert ahead.occupied[standing].all()
    assert (ahead.resolution, ahead.origin, ahead.occupied.shape) == (now.resolution, now.origin, now.occupied.shape)
    assert not now.occupied[ahead.occupied & ~now.occupied].any()


def test_a_map_on_which_nothing_moves_is_its_own_prediction() -> None:
    predictor, one = MapPredictor(), drawn((0.5, 0.5))
    assert all(predictor(one, step * PERIOD, HERE) is one for step in range(30))
    for step in range(30, 60):  # published again and again
        again = drawn((0.5, 0.5))
        assert predictor(again, step * PERIOD, HERE) is again


def test_a_map_is_given_back_untouched() -> None:
    predictor, maps = MapPredictor(), [drawn(*straight(step * PERIOD)) for step in range(20)]
    copies = [each.occupied.copy() for each in maps]
    for step, each in enumerate(maps):
        predictor(each, step * PERIOD, HERE)
    for each, copy in zip(maps, copies, strict=True):
        assert_array_equal(each.occupied, copy)


def test_the_same_map_has_the_same_prediction_until_it_is_old() -> None:
    predictor = MapPredictor()
    for step in range(15):
        now = drawn(*straight(step * PERIOD))
        ahead = predictor(now, step * PERIOD, HERE)
    last = 14 * PERIOD
    assert ahead is not now
    assert predictor(now, last + 0.5, HERE) is ahead
    assert predictor(now, last + WINDOW_S, HERE) is now, "it has not moved for so long"
    assert predictor(now, last + WINDOW_S + 9.0, HERE) is now


def test_maps_that_come_faster_are_not_all_looked_at() -> None:
    predictor, different = MapPredictor(), []
    for step in range(200):
        ahead = predictor(drawn(*straight(0.01 * step)), 0.01 * step, HERE)
        if not different or different[-1] is not ahead:
            different.append(ahead)
    moving = 200 - round(0.3 / 0.01)  # as long as it is not known to move, a map is given back as it is
    assert len(different) <= 200 - moving + round(moving * 0.01 / LOOK_S) + 2


def test_what_has_just_appeared_is_not_predicted() -> None:
    predictor = MapPredictor()
    for step in range(10):
        predictor(drawn((1.0, 0.5)), step * PERIOD, HERE)
    for step in (10, 11):
        now = drawn((1.0, 0.5), straight(step * PERIOD)[0])
        assert predictor(now, step * PERIOD, HERE) is now


def test_what_comes_to_lie_outside_of_the_map_is_gone() -> None:
    now, ahead = watched(lambda time: [np.array([0.5 + 1.4 * time, -1.0])], 16)
    assert now.occupied_at(np.array([0.5 + 1.4 * 1.5, -1.0]))
    assert ahead.occupied.sum() < now.occupied.sum()
    assert_array_equal(ahead.occupied, drawn().occupied)


def test_where_two_touch_they_stand_until_they_have_been_watched_anew() -> None:
    def meeting(time: float) -> list[np.ndarray]:
        return [np.array([-0.9 + 0.5 * time, -0.8]), np.array([0.9 - 0.5 * time, -0.8])]

    now, ahead = watched(meeting, 18)  # 0.05 m apart by now, so that their pixels touch
    assert ahead is now
    now, ahead = watched(meeting, 10)
    assert ahead is not now


def test_obstacles_that_change_their_shape_or_jump_are_others() -> None:
    predictor = MapPredictor()
    for step in range(20):
        field = empty_map((3.0, 3.0))
        center = np.array([[-0.8 + 0.04 * step, -0.5]])
        draw_discs(field.occupied, field.origin, field.resolution, center, 0.1 if step % 2 else 0.25)
        assert predictor(field, step * PERIOD, HERE) is field
    for step in range(20, 40):
        now = drawn((-1.0, -0.5) if step % 2 else (0.5, -1.5))
        assert predictor(now, step * PERIOD, HERE) is now


def test_far_obstacles_are_left_as_they_are() -> None:
    def far(time: float) -> OccupancyMap:
        return drawn(np.array([NEAR_M + 1.0 - 0.3 * time, 0.0]), half=6.0)

    predictor = MapPredictor()
    for step in range(20):
        now = far(step * PERIOD)
        assert predictor(now, step * PERIOD, HERE) is now
    for step in range(20, 40):
        now = far(step * PERIOD)
        ahead = predictor(now, step * PERIOD, np.array([3.0, 0.0]))
    assert ahead is not now


def test_with_too_many_obstacles_none_is_predicted() -> None:
    specks = np.stack(np.meshgrid(np.arange(-2.8, 2.8, 0.2), np.arange(-2.8, -1.2, 0.2)), axis=-1).reshape(-1, 2)
    assert len(specks) > MOST
    predictor = MapPredictor()
    for step in range(20):
        now = drawn(*straight(step * PERIOD))
        row, col = now.pixel_of(specks)
        now.occupied[row, col] = True
        assert predictor(now, step * PERIOD, HERE) is now


def test_an_unknown_position_a_clock_that_goes_back_and_another_map_are_no_trouble() -> None:
    predictor = MapPredictor()
    for step in range(15):
        now = drawn(*straight(step * PERIOD))
        ahead = predictor(now, step * PERIOD, HERE)
    assert ahead is not now
    unknown = drawn(*straight(1.5))
    assert predictor(unknown, 1.5, np.full(2, np.nan)) is not unknown, "the last one is good enough"
    now = drawn(*straight(0.0))
    assert predictor(now, 0.0, HERE) is now
    other = OccupancyMap(np.zeros((7, 5), bool), 0.3, (9.0, -9.0))
    assert predictor(other, 0.1, HERE) is other
    assert predictor(drawn(*straight(0.2)), 0.2, HERE).occupied.shape == now.occupied.shape


def test_after_a_reset_nothing_is_known() -> None:
    predictor = MapPredictor()
    for step in range(15):
        predictor(drawn(*straight(step * PERIOD)), step * PERIOD, HERE)
    predictor.reset()
    now = drawn(*straight(1.5))
    assert predictor(now, 1.5, HERE) is now


class Asked:
    """Goes straight on, and keeps the maps that it was asked with."""

    def __init__(self) -> None:
        self.maps: list[OccupancyMap] = []

    def plan(self, query: PlanQuery) -> np.ndarray:
        self.maps += query.occupancy
        return query.position[:, None] + 0.1 * np.arange(1, 11)[None, :, None] * [0.0, -1.0]


@pytest.mark.parametrize("predict", [True, False])
def test_an_option_plans_on_the_map_ahead(predict: bool) -> None:
    planner = Asked()
    option = WaypointOption(planner, 1, predict=predict)
    for step in range(16):
        now = drawn(*straight(step * PERIOD))
        if step == 15:
            option.waiting[0] = True
        option.step(HERE[None], np.array([[0.0, -2.5]]), [now], stamps=np.array([step * PERIOD]))
    assert (planner.maps[-1] is now) is not predict
    assert planner.maps[-1].occupied_at(straight(1.5 + AHEAD_S * predict)[0])


def test_rows_have_times_of_their_own_and_without_time_nothing_is_predicted() -> None:
    planner = Asked()
    option, goal = WaypointOption(planner, 2), np.array([[0.0, -2.5]] * 2)
    for step in range(16):
        now = drawn(*straight(step * PERIOD))
        option.waiting[:] = step == 15
        # the second one's clock runs so fast that what moves is slower than what counts as moving
        option.step(np.zeros((2, 2)), goal, [now, now], stamps=np.array([PERIOD, 10.0]) * step)
    assert planner.maps[-2] is not now and planner.maps[-1] is now
    option.reset()
    option.step(np.zeros((2, 2)), goal, [now, now], stamps=np.array([1.6, 160.0]))
    assert planner.maps[-2:] == [now, now]
    timeless = WaypointOption(planner, 1)
    for step in range(16):
        now = drawn(*straight(step * PERIOD))
        timeless.waiting[0] = step == 15
        timeless.step(HERE[None], goal[:1], [now])
    assert planner.maps[-1] is now


def test_a_finer_map_is_known_better() -> None:
    """The centre of what is drawn, against where it will be, on pixels of 5 and of 2 cm."""
    errors = []
    for resolution in (0.05, 0.02):
        predictor, side = MapPredictor(), round(6.0 / resolution)
        for step in range(16):
            field = OccupancyMap(np.zeros((side, side), bool), resolution, (-3.0, -3.0))
            draw_discs(field.occupied, field.origin, resolution, np.array(circling(step * PERIOD)), RADIUS)
            ahead = predictor(field, step * PERIOD, HERE)
        there = circling(1.5 + AHEAD_S)[0]
        errors.append(float(np.linalg.norm(centre_near(ahead, there) - there)))
    assert errors[1] < 0.02
    assert_allclose(errors[0], 0.0, atol=0.07)
